"""What a gyroscope by hand is worth: held-out moves, integrated, against the gravity that is felt after them.

    error = angle(A u_before, u_after)

where

    u : direction of gravity by the calibrated accelerometer
    A : what the gyroscope says that the move turned (``pipeline.estimation.multi_position.moves``)

The integral starts anew at each rest. Held out are the moves that end at a held-out rest, or those of a recording for
validation.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.estimation.design import Term
from pipeline.estimation.multi_position.gyroscope import HandHeldGyroscope
from pipeline.estimation.multi_position.model import State
from pipeline.estimation.multi_position.moves import moves_of
from pipeline.estimation.multi_position.observed import observed_rests
from pipeline.estimation.multi_position.rests import HELD_OUT, ROLE, by_hand
from pipeline.model.effects import effect

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from pipeline.records import Noise, Recording, SensorCalibration


def gravity_direction(
    accelerometer: SensorCalibration | None,
    gyroscope: SensorCalibration | None,
    recordings: Sequence[Recording],
    noise: Noise | None,
    settings: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the part ``gravity_direction`` of ``validations/<unit>.json``.

    Parameters
    ----------
    accelerometer, gyroscope : SensorCalibration or None
    recordings : sequence of Recording
    noise : Noise or None
        Of the gyroscope.
    settings : mapping
        Section ``procedure``.

    Returns
    -------
    dict
        ``reason`` (why there is none, else None), ``moves`` (how many), ``mean_deg``, ``rms_deg`` and ``max_deg`` (each
        ``before`` and ``after`` the gyroscope's calibration), ``noise_floor_deg`` (the mean that white noise alone
        gives) and ``creeping_rests`` (in which the unit went on turning).
    """
    if not by_hand("gyroscope", recordings):
        return {"reason": "not recorded by hand"}
    if accelerometer is None or gyroscope is None:
        return {"reason": "both sensors have to be calibrated"}
    role = HELD_OUT if any(r.role == HELD_OUT for r in recordings) else ROLE
    observed = observed_rests(recordings, accelerometer, settings, role)
    if observed is None:
        return {"reason": "no rest is held out"}
    rests, gravity = observed
    judged = replace(rests, held_out=~rests.held_out)
    model = HandHeldGyroscope(judged, moves_of(recordings, judged), gravity, noise, fewest=1)
    if model.moves is None:
        return {"reason": "no move is held out"}
    terms = tuple(Term(effect(e.name), e.values) for e in gyroscope.effects)
    before = model.missed(State(np.zeros(3), np.eye(3)))[0]
    after, floor = model.missed(State(gyroscope.bias, gyroscope.matrix, terms))
    return {
        "reason": None,
        "moves": model.moves.count,
        **{
            f"{name}_deg": {"before": _figure(name, before), "after": _figure(name, after)}
            for name in ("mean", "rms", "max")
        },
        "noise_floor_deg": float(np.mean(floor)),
        "creeping_rests": int(np.count_nonzero(gravity.creeping)),
    }


def _figure(name: str, error: NDArray[np.float64]) -> float:
    of = {"mean": np.mean(error), "rms": np.sqrt(np.mean(error**2)), "max": np.max(error)}
    return float(of[name])
