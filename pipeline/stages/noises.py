"""The noise of a unit's sensors, found by the stage filter and read by those after it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.records import SENSORS, Noise
from pipeline.signal.noise import estimate_noise, noise_of
from pipeline.stages.batch import read_json, write_json

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from pipeline.records import Recording, SensorCalibration


def save_noises(folder: Path, unit: str, recordings: list[Recording], settings: dict[str, Any]) -> None:
    """Estimate and write the noise of each sensor, null where nothing tells it."""
    found = {sensor: noise_of(sensor, recordings, settings) for sensor in SENSORS}
    write_json(folder / f"{unit}.noise.json", {sensor: noise and noise.to_json() for sensor, noise in found.items()})


def load_noises(folder: Path, unit: str) -> dict[str, Noise | None]:
    """Read the noise of each sensor, None where nothing tells it."""
    found = read_json(folder / f"{unit}.noise.json")
    return {sensor: data and Noise.from_json(data) for sensor, data in found.items()}


def require_noises(
    folder: Path,
    unit: str,
    recordings: list[Recording],
    sheets: dict[str, dict[str, Any]],
    fits: Mapping[str, SensorCalibration | None],
) -> dict[str, Noise]:
    """Read the noise of each sensor that is calibrated.

    Raises
    ------
    ConfigurationError
        If nothing tells it; what is lacking is found by looking once more.
    """
    found = load_noises(folder, unit)
    return {s: found[s] or estimate_noise(s, recordings, sheets[s]) for s, fit in fits.items() if fit is not None}
