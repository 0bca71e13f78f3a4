"""How far each hidden effect stands out of the noise: what a perfect diagnosis could find.

    lambda = sum over axes of |W (1 - P) s|^2

where

    s : what the effect adds to an axis' readings: the unit with it less the same unit, and the same noise, without it
    W : the whitening filter of the true white noise and bias wander (Kalman's, for a first-order Gauss-Markov process)
    P : the projection onto bias, truth and what each other hidden effect adds, all whitened

A perfect test gains lambda in 2 log L on average, against the k log N + 10 (40 to 100) that a selection asks of k
parameters. The rounding to whole counts differs between the two units and adds c^2 / 6 a sample on average, where c is
one count; it is taken off.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.model.effects.base import truth
from pipeline.model.kinematics import reference_motion
from pipeline.simulation.description import read_config
from pipeline.study.bench import INTERVAL_S, recordings_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from pipeline.records import Recording
    from pipeline.study.cases import Case

USED = ("accelerometer", "gyroscope")
GAUSS_MARKOV = ("normal", "wander")


def signals_left(case: Case) -> dict[str, float]:
    """Return lambda of each hidden effect; nothing where the noise is of another family.

    Parameters
    ----------
    case : Case
    """
    if not case.hidden or case.noise not in GAUSS_MARKOV:
        return {}
    recordings = _used(recordings_of(case))
    signals = {}
    for name in case.hidden:
        rest = {other: values for other, values in case.hidden.items() if other != name}
        signals[name] = _readings(recordings, case) - _readings(_used(recordings_of(replace(case, hidden=rest))), case)
    sheet = read_config("sensor", case.model)[case.sensor]
    time = np.concatenate([r.time for r in recordings])
    white = sheet["noise_density"] * np.sqrt(0.5 / INTERVAL_S)
    columns = np.column_stack([np.ones(len(time)), _truth(recordings, case), *signals.values()])
    size = np.maximum(np.abs(columns).max(axis=0), 1e-300)
    whitened = size * whiten(columns / size, time, white, case.wander * sheet["bias_wander"], sheet["wander_time_s"])
    rounding = 3 * len(time) / (6.0 * sheet["counts_per_unit"] ** 2 * white**2)
    return {
        name: max(0.0, float(sum(_left(whitened, 4 + 3 * j, axis) for axis in range(3))) - rounding)
        for j, name in enumerate(signals)
    }


def _used(recordings: Sequence[Recording]) -> list[Recording]:
    return sorted((r for r in recordings if r.role in USED), key=lambda r: int(r.time_ns[0]))


def _readings(recordings: Sequence[Recording], case: Case) -> NDArray[np.float64]:
    return np.concatenate([r.accelerometer if case.sensor == "accelerometer" else r.gyroscope for r in recordings])


def _truth(recordings: Sequence[Recording], case: Case) -> NDArray[np.float64]:
    gravity = read_config("table", "acutronic")["gravity_g"]
    motions = [motion for r in recordings if (motion := reference_motion(r, gravity)) is not None]
    return np.concatenate([truth(case.sensor, motion) for motion in motions])


def _left(whitened: NDArray[np.float64], at: int, axis: int) -> float:
    """Return the square of an effect's whitened signal on one axis that base and other effects leave."""
    signal = whitened[:, at + axis]
    others = [k for k in range(4 + axis, whitened.shape[1], 3) if k != at + axis]
    beside = whitened[:, [*range(4), *others]]
    size = np.linalg.norm(beside, axis=0)
    basis, _ = np.linalg.qr(beside[:, size > 0] / size[size > 0])
    rest = signal - basis @ (basis.T @ signal)
    return float(rest @ rest)


def whiten(
    columns: NDArray[np.float64], time: NDArray[np.float64], white: float, wander: float, correlation_time: float
) -> NDArray[np.float64]:
    """Return columns after the filter that makes white noise plus a Gauss-Markov wander white, of variance 1.

    Parameters
    ----------
    columns : (n, k) array, unit of the sensor
    time : (n,) array, s
    white, wander : float, unit of the sensor
        Standard deviations.
    correlation_time : float, s
    """
    decay = np.exp(-np.diff(time, prepend=time[0]) / correlation_time).tolist()
    out = np.empty_like(columns)
    mean, variance = np.zeros(columns.shape[1]), wander**2
    for i, column in enumerate(columns):
        mean = decay[i] * mean
        variance = decay[i] ** 2 * variance + wander**2 * (1.0 - decay[i] ** 2)
        innovation = column - mean
        total = variance + white**2
        out[i] = innovation / np.sqrt(total)
        mean += variance / total * innovation
        variance *= white**2 / total
    return out
