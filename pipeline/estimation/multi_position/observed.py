"""The gyroscope's model by hand from recordings: their rests and moves, and gravity by the accelerometer."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import CannotCalibrateError, NotObservableError
from pipeline.estimation.accelerometer import nonlinear_least_squares
from pipeline.estimation.multi_position.gravity import gravity_of
from pipeline.estimation.multi_position.gyroscope import HandHeldGyroscope
from pipeline.estimation.multi_position.moves import moves_of
from pipeline.estimation.multi_position.rests import ROLE, rests_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.estimation.multi_position.gravity import Gravity
    from pipeline.estimation.multi_position.rests import Rests
    from pipeline.records import Noise, Recording, SensorCalibration


def model_of(
    recordings: Sequence[Recording],
    calibration: SensorCalibration | None,
    noise: Noise | None,
    settings: Mapping[str, Any],
    accelerometer: SensorCalibration | None = None,
) -> HandHeldGyroscope | None:
    """Return the model of the recordings' rests and moves, or None where they hold no rest.

    Parameters
    ----------
    recordings : sequence of Recording
    calibration : SensorCalibration or None
        Of the gyroscope: moves that its method found far off the others are left out.
    noise : Noise or None
    settings : mapping
        Sections ``table`` and ``procedure``.
    accelerometer : SensorCalibration, optional
        Without it, the accelerometer is calibrated here.

    Raises
    ------
    CannotCalibrateError
        If the accelerometer cannot be calibrated.
    """
    if accelerometer is None:
        try:
            accelerometer = nonlinear_least_squares.fit(recordings, None, settings)
        except NotObservableError as lack:
            raise CannotCalibrateError(
                f"the gyroscope by hand needs the direction of gravity by a calibrated accelerometer: {lack.message}"
            ) from lack
    observed = observed_rests(recordings, accelerometer, settings)
    if observed is None:
        return None
    rests, gravity = observed
    moves = moves_of(recordings, rests)
    if moves is not None and calibration is not None:
        told = [move for stage in calibration.stages for move in stage.details.get("moves_outlying", ())]
        off = {(move["recording"], float(move["time_s"])) for move in told}
        names = [recordings[int(i)].name for i in rests.recording[moves.after]]
        keys = zip(names, moves.time[:, 0].tolist(), strict=True)
        moves = moves.select(np.array([key not in off for key in keys]))
    return HandHeldGyroscope(rests, moves, gravity, noise)


def observed_rests(
    recordings: Sequence[Recording], accelerometer: SensorCalibration, settings: Mapping[str, Any], role: str = ROLE
) -> tuple[Rests, Gravity] | None:
    """Return the gyroscope's rests and gravity at them, or None where the recordings of a role hold none."""
    felt = rests_of("accelerometer", recordings, settings, accelerometer, role)
    turned = rests_of("gyroscope", recordings, settings, accelerometer, role)
    if felt is None or turned is None:
        return None
    keys = [list(zip(r.recording.tolist(), r.span[:, 0].tolist(), strict=True)) for r in (felt, turned)]
    both = set(keys[0]) & set(keys[1])
    felt, turned = (r.select(np.array([key in both for key in k])) for r, k in zip((felt, turned), keys, strict=True))
    if len(turned.time) == 0:
        return None
    return turned, gravity_of(recordings, felt, accelerometer)
