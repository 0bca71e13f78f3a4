"""Files of a unit that several stages read: the fit of each sensor and its noise."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.estimation.noise import estimate_noise, noise_of
from pipeline.files import read_json, write_json
from pipeline.records import SENSORS, Noise, SensorCalibration

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from pipeline.records import Recording


def load_fits(folders: Mapping[str, Path], unit: str) -> dict[str, SensorCalibration | None]:
    """Return each sensor's calibration, None for one that could not be calibrated."""
    found = {sensor: read_json(folders[sensor] / f"{unit}.json") for sensor in SENSORS}
    return {s: None if "not_calibrated" in data else SensorCalibration.from_json(s, data) for s, data in found.items()}


def save_noises(folder: Path, unit: str, recordings: list[Recording], settings: dict[str, Any]) -> None:
    """Estimate and write the noise of each sensor, null where neither recordings nor data sheet determine it."""
    found = {sensor: noise_of(sensor, recordings, settings) for sensor in SENSORS}
    write_json(folder / f"{unit}.noise.json", {sensor: noise and noise.to_json() for sensor, noise in found.items()})


def load_noises(folder: Path, unit: str) -> dict[str, Noise | None]:
    """Read the noise of each sensor, as ``save_noises`` wrote it."""
    found = read_json(folder / f"{unit}.noise.json")
    return {sensor: data and Noise.from_json(data) for sensor, data in found.items()}


def require_noises(
    folder: Path,
    unit: str,
    recordings: list[Recording],
    sheets: dict[str, dict[str, Any]],
    fits: Mapping[str, SensorCalibration | None],
) -> dict[str, Noise]:
    """Read the noise of each calibrated sensor.

    Raises ``ConfigurationError`` if nothing determines it; ``estimate_noise`` names what is missing.
    """
    found = load_noises(folder, unit)
    return {s: found[s] or estimate_noise(s, recordings, sheets[s]) for s, fit in fits.items() if fit is not None}
