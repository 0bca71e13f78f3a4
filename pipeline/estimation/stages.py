"""Which function runs a stage of a fit.

A stage is a module ``pipeline/estimation/<sensor>/<stage>.py`` with ``fit(recordings, previous, settings)``: a new
stage needs only such a module and its name in a method's list. The stages of the staged method are functions of one
module for each sensor, and some stages are the same for both sensors.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from pipeline.errors import CannotCalibrateError, ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.records import Recording, SensorCalibration

STAGED = {
    "accelerometer": ("orthogonality", "misalignment", "bias", "scale_factor"),
    "gyroscope": ("bias", "orthogonality_and_misalignment", "scale_factor"),
}
OF_BOTH_SENSORS = ("reference_least_squares", "effects")
NOT_WANTED = "not_wanted"  # the stage of a sensor whose method is null


def stage_module(sensor: str, stage: str) -> str:
    """Return the module that holds a stage."""
    if stage in STAGED[sensor]:
        return f"pipeline.estimation.{sensor}.staged"
    if stage == NOT_WANTED:
        return __name__
    return f"pipeline.estimation.{stage}" if stage in OF_BOTH_SENSORS else f"pipeline.estimation.{sensor}.{stage}"


def fit_stage(
    sensor: str,
    stage: str,
    recordings: Sequence[Recording],
    previous: SensorCalibration | None,
    settings: Mapping[str, Any],
) -> SensorCalibration:
    """Run a stage on the result of the stage before.

    Raises ``CannotCalibrateError`` if the sensor's method is null, or the stage cannot use these recordings.
    """
    if stage == NOT_WANTED:
        raise CannotCalibrateError(f"method.{sensor} is null: the configuration leaves this sensor uncalibrated")
    fit = import_module(stage_module(sensor, stage)).fit
    named = (stage,) if stage in STAGED[sensor] else (sensor,) if stage in OF_BOTH_SENSORS else ()
    found: SensorCalibration = fit(*named, recordings, previous, settings)
    return found


def stages_before(sensor: str, previous: SensorCalibration | None, stages: Mapping[str, Any]) -> list[str]:
    """Return the names of the stages so far; refuse what is no stage of the staged method."""
    done = () if previous is None else previous.stages
    unknown = [stage.name for stage in done if stage.name not in stages or stage.correction is None]
    if unknown:
        raise ConfigurationError(
            f"a stage of the staged method cannot follow {unknown[0]!r}, which leaves no corrected readings for it; "
            f"the stages of the {sensor} are {', '.join(stages)}"
        )
    return [stage.name for stage in done]
