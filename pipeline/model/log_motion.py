"""The motion by a log's own calibrated signals, causally: no sample depends on later ones.

    domega/dt[n] = (omega[n] - omega[n-1]) / (t[n] - t[n-1]),    df/dt likewise; 0 at the first sample

The temperature is smoothed by ``pipeline.model.exponential_regression``. A ``LogEnd`` carries the state from one block
to the next, so that blocks of any size give the same result as the whole log.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import ConfigurationError, InputError
from pipeline.model.effects import effect_of
from pipeline.model.effects.base import turning_direction
from pipeline.records import Motion

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from pipeline.records import FittedEffect

    Known = tuple[float, NDArray[np.float64]]  # the last sample that is not missing: time in s, value

SIGNALS = {
    "time": {"time"},
    "temperature": {"temperature"},
    "specific_force": {"accelerometer"},
    "specific_force_rate": {"accelerometer", "time"},
    "angular_rate": {"gyroscope"},
    "angular_acceleration": {"gyroscope", "time"},
    "direction": {"gyroscope"},
}


@dataclass(frozen=True)
class LogEnd:
    """The state at the end of a block of a log: its last samples that are not missing, and its last turn."""

    force: Known | None = None
    rate: Known | None = None
    direction: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))

    def after(self, motion: Motion, used: set[str]) -> LogEnd:
        """Return the end of the next block; only what is used is kept."""
        force = _last_known(motion.time, motion.specific_force) if "specific_force_rate" in used else None
        rate = _last_known(motion.time, motion.angular_rate) if "angular_acceleration" in used else None
        direction = self.direction if motion.direction is None else motion.direction[-1]
        return LogEnd(force or self.force, rate or self.rate, direction)


def _last_known(time: NDArray[np.float64], values: NDArray[np.float64]) -> Known | None:
    known = np.flatnonzero(np.isfinite(values).all(axis=1))
    return (float(time[known[-1]]), values[known[-1]]) if len(known) else None


def log_motion(
    time: NDArray[np.float64],
    *,
    specific_force: NDArray[np.float64],
    angular_rate: NDArray[np.float64],
    temperature: NDArray[np.float64] | None,
    used: set[str],
    end: LogEnd,
) -> Motion:
    """Return the motion of a block; ``temperature`` is smoothed, ``end`` is of the block before.

    Of the fields that are not ``used``, only those that cost nothing are filled.
    """
    zeros = np.zeros_like(specific_force)
    rate = _difference(time, specific_force, end.force) if "specific_force_rate" in used else zeros
    turn = _difference(time, angular_rate, end.rate) if "angular_acceleration" in used else zeros
    motion = Motion(
        time=time,
        specific_force=specific_force,
        angular_rate=angular_rate,
        angular_acceleration=turn,
        specific_force_rate=rate,
        temperature=temperature,
        angle=None,
        rate=None,
        axis=None,
        still=np.zeros(len(time), bool),
    )
    if "direction" not in used:
        return motion
    direction = turning_direction(motion)
    turned = np.any(direction != 0.0, axis=1, keepdims=True)
    direction = np.where(turned, direction, end.direction)
    return replace(motion, direction=direction)


def fields_used(sensor: str, effects: Iterable[FittedEffect]) -> set[str]:
    """Return the fields of a motion that effects look at.

    Raises
    ------
    ConfigurationError
        If one needs what no log of a sensor holds, such as a table's angle.
    """
    seen: set[str] = set()
    for fitted in effects:
        looked_at = effect_of(fitted).fields(sensor, fitted.values)
        seen |= looked_at
        strange = sorted(looked_at - set(SIGNALS))
        if strange:
            raise ConfigurationError(
                f"effect {fitted.name} needs {', '.join(strange)}, which a field log does not hold"
            )
    return seen


def _difference(time: NDArray[np.float64], values: NDArray[np.float64], before: Known | None) -> NDArray[np.float64]:
    """Return the backward difference quotient: (n, 3) array; 0 at a first sample."""
    first = before is None
    t_before, v_before = (time[0], values[0]) if before is None else before
    t = np.concatenate([[t_before], time])
    v = np.concatenate([v_before[None], values])
    known = np.where(np.isfinite(v).all(axis=1), np.arange(len(v)), 0)
    last = np.maximum.accumulate(known)[:-1]  # a missing sample is stepped over
    step = t[1:] - t[last]
    back = np.flatnonzero(step[1 if first else 0 :] <= 0) + (1 if first else 0)
    if len(back):
        raise InputError(
            f"time does not increase at {time[back[0]]:.6f} s; an effect of this calibration needs rates of change: "
            "sort the log and drop repeated samples"
        )
    if first:
        step[0] = 1.0
    quotient: NDArray[np.float64] = (v[1:] - v[last]) / step[:, None]
    quotient[np.isnan(v[last]).any(axis=1)] = 0.0  # nothing is known before
    return quotient
