"""Units that are calibrated by hand: simulated rests and moves, their truth, and the settings of a run."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from unit_settings import settings_of, with_noise

from pipeline.estimation.accelerometer import nonlinear_least_squares
from pipeline.estimation.gyroscope import rests_and_moves
from pipeline.estimation.noise import estimate_noise
from pipeline.estimation.stages import StageInput
from pipeline.output.exports.sensors import rotation_times_lower
from pipeline.simulation.campaign import simulate_unit
from pipeline.simulation.description import UnitDescription
from tests.published import diagnose

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.core.records import Recording, SensorCalibration
    from pipeline.core.settings import Settings

METHODS = {"accelerometer": nonlinear_least_squares, "gyroscope": rests_and_moves}
WARM = {"warm_up": 25.0}  # degC in a session of some minutes: a unit that is heated


def fitted(sensor: str, recordings: Sequence[Recording], settings: Settings) -> SensorCalibration:
    """Return the fit of a sensor to recordings by hand."""
    return METHODS[sensor].fit(StageInput(sensor, with_noise(recordings, settings), None, settings))


@dataclass(frozen=True)
class Unit:
    """A simulated unit: its recordings, its truth, and the settings of a run."""

    recordings: list[Recording]
    truth: dict[str, Any]
    settings: Settings

    def calibrated(self, sensor: str) -> SensorCalibration:
        return fitted(sensor, self.recordings, self.settings)

    def diagnosed(self, sensor: str, configured: Any = (), calibration: SensorCalibration | None = None) -> Any:
        names = configured if isinstance(configured, str) else list(configured)
        settings = settings_of(self.settings, effects={sensor: names})
        noise = estimate_noise(sensor, self.recordings, settings.sensor.of(sensor))
        return diagnose(calibration or self.calibrated(sensor), self.recordings, noise, settings)

    def true_matrix(self, sensor: str) -> np.ndarray:
        """Return the true matrix in the frame of the calibration: that in which the accelerometer's is triangular."""
        frame, _ = rotation_times_lower(np.array(self.truth["accelerometer"]["matrix"]))
        return frame.T @ np.array(self.truth[sensor]["matrix"])


@cache
def _simulated(  # noqa: PLR0917  (its arguments are the key)
    model: str, seed: int, procedure: str, effects: tuple, temperature: tuple, other: tuple
) -> Any:
    more = {"effects": dict(effects), "temperature": dict(temperature), **dict(other)}
    return simulate_unit(UnitDescription("U", sensor=model, table="hand", procedure=procedure, **more), seed, 0)


def hand_held(
    model: str = "mpu6050",
    seed: int = 1,
    effects: dict[str, Any] | None = None,
    *,
    procedure: str = "multi_position",
    temperature: dict[str, float] | None = None,
    holdout_every: int = 3,
    **other: Any,
) -> Unit:
    """Return a unit; ``effects`` maps ``sensor.effect`` to None for a size of the sensor file, at random."""
    parts = (tuple((effects or {}).items()), tuple((temperature or {}).items()), tuple(other.items()))
    recordings, truth = _simulated(model, seed, procedure, *parts)
    settings = settings_of(sensor=model, table="hand", procedure={"holdout_every": holdout_every})
    return Unit(recordings, truth, settings)
