"""Read the files of a unit that several stages use: its recordings, the fit of each sensor and its noise."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.estimation.noise import estimate_noise, noise_of
from pipeline.io.arrow import from_parquet
from pipeline.records import SENSORS, Noise, Recording, SensorCalibration

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pipeline.pack import Files, Pack


def recordings_of(packs: Mapping[str, Pack], unit: str) -> list[Recording]:
    """Return the filtered recordings of a unit, or those of ingest without a filter or before the stage filter."""
    name = f"{unit}.parquet"
    pack = packs["filter"] if "filter" in packs and name in packs["filter"] else packs["ingest"]
    return from_parquet(pack.read(name), str(pack.path))


def load_fits(packs: Mapping[str, Pack], unit: str) -> dict[str, SensorCalibration | None]:
    """Return the calibration of each sensor; None for a sensor that could not be calibrated."""
    found = {sensor: packs[sensor].json(f"{unit}.json") for sensor in SENSORS}
    return {s: None if "not_calibrated" in data else SensorCalibration.from_json(s, data) for s, data in found.items()}


def noise_file(unit: str, recordings: list[Recording], settings: dict[str, Any]) -> Files:
    """Return the file with the noise of each sensor; null if neither recordings nor data sheet determine it."""
    found = {sensor: noise_of(sensor, recordings, settings) for sensor in SENSORS}
    return {f"{unit}.noise.json": {sensor: noise and noise.to_json() for sensor, noise in found.items()}}


def load_noises(pack: Pack, unit: str) -> dict[str, Noise | None]:
    """Read the noise of each sensor from the file of ``noise_file``."""
    found = pack.json(f"{unit}.noise.json")
    return {sensor: data and Noise.from_json(data) for sensor, data in found.items()}


def require_noises(
    pack: Pack,
    unit: str,
    recordings: list[Recording],
    sensor_configs: dict[str, dict[str, Any]],
    fits: Mapping[str, SensorCalibration | None],
) -> dict[str, Noise]:
    """Read the noise of each calibrated sensor.

    Raises ``ConfigurationError`` if nothing determines it; its message states what is missing.
    """
    found = load_noises(pack, unit)
    return {
        s: found[s] or estimate_noise(s, recordings, sensor_configs[s]) for s, fit in fits.items() if fit is not None
    }
