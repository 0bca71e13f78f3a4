"""What rests and steady turns say of a gyroscope, for the staged method (Sudsanguan 2019, eqs 3.47-3.49).

By the table's log, the samples of the recordings made for the gyroscope are at rest, in the steady part of a turn about
one axis, or neither. The first two give, for each channel c,

    b_c = mean of y_c at rest
    R_ic = sum rate (y_c - b_c) / sum rate^2   over the steady parts of the turns about axis i

where y is the reading, deg/s, and the rate is signed, so that turns at several rates and in both directions count as
one regression; Earth's rotation is taken off y first where the table's place and azimuth are set. Without a rest in
these recordings the bias is that of the static recording. As printed, row i is the mean reading over the mean rate.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import ConfigurationError, NotObservableError
from pipeline.estimation.turns import blocks_of_samples, steady_turns
from pipeline.records import AXES, motion_at_rest
from pipeline.signal.rests import runs

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from pipeline.estimation.gauss_markov import Blocks
    from pipeline.estimation.turns import Part
    from pipeline.records import Motion, Recording

FORGOTTEN = 1e-5  # of a change of rate, that a filter's output may still hold where a rest or a steady turn begins
DELAYS_TO_SETTLE = 12.0  # the same for a filter that is known by its delay alone


@dataclass(frozen=True)
class Response:
    """What the readings of rests and steady turns say."""

    rest: NDArray[np.float64]  # (3,), deg/s; mean reading at rest
    slope: NDArray[np.float64]  # (3, 3); row i: reading of x, y, z per deg/s about axis i
    rate: NDArray[np.float64]  # (3,), deg/s; I: mean magnitude of the rate about each axis; 0 where none was recorded

    def corrected(self, step: Mapping[str, Any]) -> Response:
        """Return the response of readings after a step of a correction."""
        if "subtract" in step:
            return Response(self.rest - np.asarray(step["subtract"]), self.slope, self.rate)
        matrix = np.asarray(step["matrix"])
        return Response(matrix @ self.rest, self.slope @ matrix.T, self.rate)

    def require_turns(self) -> None:
        """Raise ``NotObservableError`` where there is no turn about one of the axes."""
        missing = [axis for axis, rate in zip(AXES, self.rate, strict=True) if rate == 0.0]
        if missing:
            raise NotObservableError(
                f"the gyroscope was not turned steadily about {' and '.join(missing)}: record a turn at a constant "
                "rate about each of x, y and z"
            )


@dataclass(frozen=True)
class Samples:
    """The samples that are used, stacked."""

    reading: NDArray[np.float64]  # (n, 3), deg/s; less Earth's rotation where it is known
    # (n, 3), deg/s; signed rate of the table about its turn axis, in that axis's column; 0 at rest
    rate: NDArray[np.float64]
    blocks: Blocks
    total: int  # samples of the recordings
    motions: tuple[Motion, ...]  # by the table, at these samples; at rest in a static recording

    @property
    def speed(self) -> NDArray[np.float64]:
        """I: mean magnitude of the rate about each axis, 0 where there is no steady turn: (3,) array, deg/s."""
        moving = np.count_nonzero(self.rate, axis=0)
        mean: NDArray[np.float64] = np.abs(self.rate).sum(axis=0) / np.maximum(moving, 1)
        return mean


def samples_of(parts: Sequence[Part], recordings: Sequence[Recording]) -> Samples:
    """Return the samples at rest and in steady turns, and a static recording's where there is no other rest."""
    chosen, readings, rates, motions = [], [], [], []
    for part in parts:
        memory = _memory(part.recording)
        steady, still = steady_turns(part, memory), _without_tails(part, memory)
        rate = np.zeros((part.recording.samples, 3))
        if part.motion.axis is not None:
            rate[steady, part.motion.axis] = np.asarray(part.motion.rate)[steady]
        keep = (still | steady) & part.keep
        earth = part.motion.angular_rate[keep] - rate[keep]
        readings.append(np.asarray(part.recording.gyroscope)[keep] - earth)
        rates.append(rate[keep])
        chosen.append((part.recording, keep))
        motions.append(part.motion.select(keep))
    if all(np.any(rate, axis=1).all() for rate in rates):
        for recording in recordings:
            if recording.role == "static" and recording.gyroscope is not None:
                keep = recording.valid
                readings.append(recording.gyroscope[keep])
                rates.append(np.zeros((int(keep.sum()), 3)))
                chosen.append((recording, keep))
                motions.append(motion_at_rest(recording.time[keep]))
    total = sum(recording.samples for recording, _ in chosen)
    return Samples(np.concatenate(readings), np.concatenate(rates), blocks_of_samples(chosen), total, tuple(motions))


def _memory(recording: Recording) -> float:
    """Return for how long the recording's filter remembers a change, s."""
    applied = recording.filter
    if applied["name"] == "none":
        return 0.0
    try:
        from pipeline.signal.filters import filter_autocovariance  # noqa: PLC0415  (only filtered recordings pay for it)

        covariance = np.abs(filter_autocovariance(recording))
    except (ConfigurationError, KeyError):
        return DELAYS_TO_SETTLE * float(applied["delay_s"])
    return float(np.flatnonzero(covariance > FORGOTTEN * covariance[0])[-1] + 1) * recording.interval


def _without_tails(part: Part, memory: float) -> NDArray[np.bool_]:
    """Return the settled samples of the rests, without what a filter still holds of the turns before or after."""
    still, time = part.motion.still.copy(), part.motion.time
    before = memory if part.recording.filter.get("zero_phase") else 0.0
    for start, stop in runs(part.motion.still) if memory > 0 else []:
        if start > 0:
            still[start:stop] &= time[start:stop] >= time[start] + memory
        if stop < len(time):
            still[start:stop] &= time[start:stop] <= time[stop - 1] - before
    return still


def weights_of(rate: NDArray[np.float64], *, as_printed: bool) -> NDArray[np.float64]:
    """Return the weights of the samples in (b, R_x, R_y, R_z): (4, n) array."""
    rest = np.all(rate == 0, axis=1)
    if not np.any(rest):
        raise NotObservableError(
            "the gyroscope's recordings hold no rest, or none longer than the filter's memory, and there is no static "
            "recording: let the table rest for some seconds before a turn"
        )
    weights = np.zeros((4, len(rate)))
    weights[0] = rest / rest.sum()
    for axis in range(3):
        by = np.sign(rate[:, axis]) if as_printed else rate[:, axis]
        if np.any(by):
            own = by / (by @ rate[:, axis])
            weights[axis + 1] = own - own.sum() * weights[0]
    return weights
