"""The turns of a table: which samples a fit uses, and the sinusoid that a channel draws while the table turns.

While the table turns about body axis i by the angle A, gravity G draws in a channel whose axis lies across

    y = z + a cos(A - phi) + c |cos(A - phi)|

where

    z    : reading where the axis is level, g
    phi  : angle at which the axis points up, deg
    a, c : half sum and half difference of the two sides, g: the largest reading is ``z + a + c``, the smallest
           ``z - a + c``; c is zero where a sensor has one scale factor for both sides

and in the channel whose axis is turned about ``y = z + h cos(A - phi)`` with a small h, the misalignment. Given phi the
rest is linear; phi is the phase of the linear fit's own first harmonic, found by a few rounds since |cos| has even
harmonics only. So all samples of a turn say where its extremes are, not the few at its flat peaks.

A filter turns phi by rate x delay and shrinks a, but only while the table turns: a rest at either end is read as it is,
and no one sinusoid holds both.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import CannotCalibrateError, NotObservableError
from pipeline.estimation.gauss_markov import Blocks
from pipeline.estimation.least_squares import ScaledColumns
from pipeline.model.kinematics import table_motion
from pipeline.signal.rests import runs

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from pipeline.records import Motion, Recording

BLOCKS = 100  # of a fit's samples: enough to resolve correlation times down to a hundredth of the recordings
DISTINCT_DIRECTION_G = 0.01
ROUNDS = 12
SAME_PHASE = 1e-12  # rad
SLOWEST_SHARE = 0.02  # of the largest rate, below which a turn is not called one
CHANGE_PER_SECOND = 0.25  # of the rate, above which a turn is not steady
EDGE_S = 0.15
LONGEST_TAIL = 0.4  # of a steady turn
DELAYS_TO_FOLLOW = 5.0  # after which an RC filter holds less than 1 % of a change of rate
WEAKEST_DIRECTION = 1e-3  # smallest singular value of unit columns that still counts as determined


@dataclass(frozen=True)
class Part:
    """The samples of one recording that a fit uses."""

    recording: Recording
    motion: Motion
    keep: NDArray[np.bool_]  # (n,)

    def reading(self, sensor: str) -> NDArray[np.float64]:
        """Return the readings that are used: (k, 3) array."""
        reading = self.recording.reading(sensor)
        assert reading is not None  # noqa: S101
        return reading[self.keep]


def parts_of(recordings: Sequence[Recording], sensor: str, table: Mapping[str, Any], method: str) -> list[Part]:
    """Return the recordings made for a sensor that hold its readings and the table's motion, without bad samples.

    ``method``: name of the method, for the message. Raises ``CannotCalibrateError`` if there is none.
    """
    own = [r for r in recordings if r.role == sensor and r.reading(sensor) is not None]
    parts = []
    for recording in own:
        motion = table_motion(replace(recording, temperature=None), table)  # bias and matrix do not ask for it
        if motion is not None:
            parts.append(Part(recording, motion, recording.valid))
    if not parts:
        lack = "none of them logs the table's angle" if own else f"no recording of role {sensor} holds its readings"
        raise CannotCalibrateError(
            f"{method} needs the table's motion for the {sensor}, and {lack}: record turns about x, y and z with "
            "table_angle_deg, or choose a method that needs no table"
        )
    return parts


def stop_and_go(motion: Motion) -> bool:
    """Return whether a motion rests at four or more attitudes, so that its rests say it all."""
    rests = runs(motion.still)
    if len(rests) < 4:
        return False
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(motion.specific_force, axis=0)])
    start, stop = np.array(rests).T
    means = (total[stop] - total[start]) / (stop - start)[:, None]
    return len(np.unique(np.round(means / DISTINCT_DIRECTION_G), axis=0)) >= 4


def settled(part: Part) -> NDArray[np.bool_]:
    """Return the samples of a part that an accelerometer's fit uses: its rests if it stops and goes, else all."""
    return part.keep & part.motion.still if stop_and_go(part.motion) else part.keep


def steady_turns(part: Part, memory: float) -> NDArray[np.bool_]:
    """Return the samples in the steady parts of a turn about one axis, less a filter's memory of what was before.

    A turn that is shorter than the memory (s) keeps its middle: what the filter still lacks there is a small share of
    the turn, where the rest beside it would lack all.
    """
    motion = part.motion
    if motion.axis is None or motion.rate is None:
        return np.zeros(len(motion.time), bool)
    rate, change = np.abs(motion.rate), np.abs(motion.angular_acceleration[:, motion.axis])
    steady: NDArray[np.bool_] = (rate > SLOWEST_SHARE * np.max(rate)) & (change <= CHANGE_PER_SECOND * rate)
    steady &= ~motion.still
    both_ways = bool(part.recording.filter.get("zero_phase"))
    for start, stop in runs(steady):
        time = motion.time[start:stop]
        tail = min(memory, LONGEST_TAIL * (time[-1] - time[0]))
        since, until = (EDGE_S + tail if start else 0.0), EDGE_S + both_ways * tail
        steady[start:stop] = (time >= time[0] + since) & (time <= time[-1] - until)
    return steady


def filtered_alike(part: Part) -> NDArray[np.bool_]:
    """Return the samples of ``settled`` that a filter changes alike.

    Without a filter, and of rests, these are all. In a continuous turn behind a filter they are those in which the
    table turns steadily and the filter follows.
    """
    keep, applied = settled(part), part.recording.filter
    if applied["name"] == "none" or part.motion.rate is None or stop_and_go(part.motion):
        return keep
    return keep & steady_turns(part, DELAYS_TO_FOLLOW * float(applied["delay_s"]))


@dataclass(frozen=True)
class Sinusoid:
    """The sinusoid of one channel in one turn."""

    # (3,) or (4,), g; z, then the cosine's and the sine's coefficient, then c where both sides were fitted
    coefficients: NDArray[np.float64]
    columns: NDArray[np.float64]  # (n, p)
    weights: NDArray[np.float64]  # (p, n); ``coefficients = weights @ readings``
    residuals: NDArray[np.float64]  # (n,), g
    condition: float  # of the columns, scaled


def fit_sinusoid(angle_deg: NDArray[np.float64], reading: NDArray[np.float64], *, sides: bool, where: str) -> Sinusoid:
    """Fit a sinusoid of the table angle.

    ``angle_deg``: (n,), deg. ``reading``: (n,), g. ``sides``: whether the two sides may differ. ``where``: channel and
    turn, for the message. Raises ``NotObservableError`` if the angles do not determine it.
    """
    angle = np.radians(angle_deg)
    columns = harmonic = np.column_stack([np.ones_like(angle), np.cos(angle), np.sin(angle)])
    factors = _factors(columns, where)
    coefficients = factors.solve(reading)
    for _ in range(ROUNDS if sides else 0):
        phase = np.arctan2(coefficients[2], coefficients[1])
        columns = np.column_stack([harmonic, np.abs(np.cos(angle - phase))])
        factors = _factors(columns, where)
        coefficients = factors.solve(reading)
        if abs(np.arctan2(coefficients[2], coefficients[1]) - phase) < SAME_PHASE:
            break
    return Sinusoid(coefficients, columns, factors.weights(), reading - columns @ coefficients, factors.condition)


def wrap(angle_deg: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return angles in [-180, 180) deg."""
    return (angle_deg + 180.0) % 360.0 - 180.0


def _factors(columns: NDArray[np.float64], where: str) -> ScaledColumns:
    n, p = columns.shape
    if n >= p:
        factors = ScaledColumns.of(columns)
        if factors.singular[-1] > WEAKEST_DIRECTION:
            return factors
    raise NotObservableError(
        f"{where} does not show a sinusoid: {n} samples over too few angles; turn the table once around, stopping at "
        "four angles or more, so that the axis points up and down and is level in between"
    )


def blocks_of_samples(parts: Sequence[tuple[Recording, NDArray[np.bool_]]]) -> Blocks:
    """Cut the chosen samples of recordings, stacked in their order, into about ``BLOCKS`` blocks of equal size.

    ``parts``: each recording and which of its samples are used.
    """
    used = [int(keep.sum()) for _, keep in parts]
    size = max(1, -(-sum(used) // BLOCKS))
    first, start, length, clock, row = [], [], [], [], 0
    known: dict[str, tuple[int, float]] = {}
    for number, ((recording, keep), samples) in enumerate(zip(parts, used, strict=True), start=1):
        if samples == 0:
            continue
        time = recording.time[keep]
        begin = np.arange(0, samples, size)
        first.append(begin + row)
        start.append(time[begin])
        length.append(time[np.minimum(begin + size, samples) - 1] - time[begin] + recording.interval)
        clock.append(np.full(len(begin), 0 if recording.clock_shared else _clock(recording, number, known)))
        row += samples
    firsts = np.concatenate(first)
    weight = np.diff(np.append(firsts, row)).astype(float)
    return Blocks(firsts, weight, np.concatenate(start), np.concatenate(length), np.concatenate(clock))


def _clock(recording: Recording, number: int, known: dict[str, tuple[int, float]]) -> int:
    """Return the clock of a recording: its own, or that of its session's recording before; ``known`` holds those."""
    before, end = known.get(recording.setup, (number, np.inf))
    clock = before if recording.setup and recording.time[0] > end else number
    known[recording.setup] = clock, float(recording.time[-1])
    return clock
