"""Turns of a table, from rest to rest, and the angles that readings and reference integrate to over each.

    Y = integral (y - b) dt,   U = integral u dt

by the trapezoidal rule on the time stamps, for both alike, so that neither noise nor a delay of one against the other
matters much. A turn lasts while the table's rate is above a threshold, in one direction, and as long as a filter's
output still follows it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import NotObservableError
from pipeline.records import AXES
from pipeline.signal.rests import runs

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from pipeline.estimation.turns import Part
    from pipeline.records import Motion, Recording

    Values = NDArray[np.float64]

MOTION_SHARE = 0.01  # of the largest rate, above which the table turns
SLOWEST_DPS = 0.02
DELAYS_TO_SETTLE = 5.0
SMALLEST_ANGLE_DEG = 1.0


@dataclass(frozen=True)
class Turns:
    """Samples at rest and in turns of all recordings, stacked, and what they integrate to."""

    reading: Values  # (n, 3), deg/s
    rate: Values  # (n, 3), deg/s; by the table, Earth's rotation included where it is known
    rest: NDArray[np.bool_]  # (n,)
    weight: Values  # (n,), s; of each sample in the integral of its turn; 0 at rest
    turn: NDArray[np.intp]  # (n,); turn of each sample, -1 at rest
    parts: tuple[tuple[Recording, NDArray[np.bool_]], ...]
    left_out: int  # turns with clipped or stuck readings
    motions: tuple[Motion, ...]  # by the table, at these samples

    def integral(self, values: Values) -> Values:
        """Return the integral of (n, 3) values over each turn: (t, 3) array, deg."""
        inside = self.turn >= 0
        size = int(self.turn.max(initial=-1)) + 1
        weighted = self.weight[inside, None] * values[inside]
        return np.stack([np.bincount(self.turn[inside], column, size) for column in weighted.T], axis=1)


def turns_of(parts: Sequence[Part]) -> Turns:
    """Stack the samples at rest and in turns of some recordings."""
    readings, rates, rests, weights, turns, chosen, motions = [], [], [], [], [], [], []
    found = left_out = 0
    for part in parts:
        weight, turn = np.zeros(part.recording.samples), np.full(part.recording.samples, -1, np.intp)
        for start, stop in _moves(part):
            if not part.keep[start:stop].all():
                left_out += 1
                continue
            step = np.diff(part.motion.time[start:stop])
            weight[start : stop - 1] += 0.5 * step
            weight[start + 1 : stop] += 0.5 * step
            turn[start:stop] = found
            found += 1
        rest = part.motion.still & part.keep & (turn < 0)
        keep = rest | (turn >= 0)
        readings.append(np.asarray(part.recording.gyroscope)[keep])
        rates.append(part.motion.angular_rate[keep])
        rests.append(rest[keep])
        weights.append(weight[keep])
        turns.append(turn[keep])
        chosen.append((part.recording, keep))
        motions.append(part.motion.select(keep))
    return Turns(
        np.concatenate(readings),
        np.concatenate(rates),
        np.concatenate(rests),
        np.concatenate(weights),
        np.concatenate(turns),
        tuple(chosen),
        left_out,
        tuple(motions),
    )


def _moves(part: Part) -> list[tuple[int, int]]:
    """Return the stretches in which the table turns in one direction, and the filtered reading follows it."""
    motion = part.motion
    rate = motion.rate if motion.rate is not None else np.linalg.norm(motion.angular_rate, axis=1)
    threshold = max(SLOWEST_DPS, MOTION_SHARE * float(np.max(np.abs(rate))))
    lag = int(np.ceil(DELAYS_TO_SETTLE * float(part.recording.filter.get("delay_s", 0.0)) / part.recording.interval))
    moving = sorted(runs(rate > threshold) + runs(rate < -threshold))
    out, end = [], 0
    for k, (first, last) in enumerate(moving):
        after = moving[k + 1][0] if k + 1 < len(moving) else len(rate)
        start, stop = max(first - 1, end), min(last + 1 + lag, after, len(rate))
        angle = abs(float(np.trapezoid(rate[start:stop], motion.time[start:stop]))) if stop - start > 1 else 0.0
        if angle >= SMALLEST_ANGLE_DEG:
            out.append((start, stop))
            end = stop
    return out


def require_turns(U: Values) -> None:
    """Raise where the turns do not span all three axes.

    ``U``: (t, 3), deg, angle of each turn about each axis. Raises ``NotObservableError``.
    """
    total = np.sqrt(np.sum(U**2, axis=0))
    largest = float(total.max(initial=0.0))
    missing = [axis for axis, angle in zip(AXES, total, strict=True) if angle <= 1e-3 * largest or largest == 0.0]
    if missing or np.linalg.matrix_rank(U, tol=1e-3 * largest) < 3:
        about = f"about {' and '.join(missing)}" if missing else "about three independent axes"
        raise NotObservableError(
            f"the gyroscope was not turned {about}: record a turn about each of x, y and z, from rest to rest, at "
            "20 deg/s or more"
        )
