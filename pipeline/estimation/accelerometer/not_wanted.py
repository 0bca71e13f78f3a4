"""The stage of a method that leaves the accelerometer uncalibrated: ``method.accelerometer=null``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NoReturn

from pipeline.errors import CannotCalibrateError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.records import Recording, SensorCalibration


def fit(recordings: Sequence[Recording], previous: SensorCalibration | None, settings: Mapping[str, Any]) -> NoReturn:
    """Refuse, with the setting as the reason.

    Raises
    ------
    CannotCalibrateError
        Always.
    """
    del recordings, previous, settings
    raise CannotCalibrateError("method.accelerometer is null: the configuration leaves this sensor uncalibrated")
