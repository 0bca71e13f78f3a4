"""The samples of a recording that a fit against a table's motion uses, and their means at rest."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.signal.rests import RATE_AT_REST_DPS

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from pipeline.records import Motion

MEAN_S = 1.0  # a mean hides no motion at rest, and keeps the readings' change with temperature
MEDIAN_OF_DIFFERENCES = 0.9099  # median of (w[n+1] - w[n])^2 of white noise of variance 1: 2 times that of chi-square
SCATTERED = 6.0  # standard deviations of a chi-square above its mean, and half its square for the tail of few samples
BEND_DPS, BEND_SHARE = 0.05, 1e-3
ARRAYS = (
    "time",
    "specific_force",
    "angular_rate",
    "angular_acceleration",
    "specific_force_rate",
    "temperature",
    "angle",
    "rate",
    "level",
    "direction",
)


@dataclass(frozen=True)
class Rows:
    """Groups of a recording's samples whose means are the rows of a fit."""

    kept: NDArray[np.intp]  # (k,); indices of the samples
    first: NDArray[np.intp]  # (m,); where in ``kept`` each group starts
    count: NDArray[np.float64]  # (m,); samples of each group
    total: int  # samples of the recording

    def settled(self, reading: NDArray[np.float64]) -> Rows:
        """Return rows in which groups that scatter too much are taken apart into their samples.

        By the table's log they are at rest; where the sensor's clock is off, it still moves at their edge.

        ``reading``: (n, 3), g or deg/s.
        """
        size = self.count.astype(int)
        if np.all(size < 2):
            return self
        kept = reading[self.kept]
        inside = np.ones(len(kept) - 1, bool)
        inside[self.first[1:] - 1] = False
        white = np.median(np.diff(kept, axis=0)[inside] ** 2, axis=0) / MEDIAN_OF_DIFFERENCES
        deviation = (kept - np.repeat(self.means(reading), size, axis=0)) ** 2
        scatter = np.add.reduceat(deviation, self.first, axis=0)
        freedom = np.maximum(self.count - 1.0, 0.0)
        most = freedom + SCATTERED * np.sqrt(2.0 * freedom) + SCATTERED**2 / 2.0
        apart = np.any((scatter > most[:, None] * white) & (white > 0), axis=1) & (size > 1)
        if not apart.any():
            return self
        new = np.repeat(apart, size)
        new[self.first] = True
        first = np.flatnonzero(new)
        return replace(self, first=first, count=np.diff(np.append(first, len(kept))).astype(float))

    def means(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the group means of (n, ...) values: (m, ...) array."""
        kept = values[self.kept]
        if len(self.first) == len(kept):
            return kept
        shape = (-1,) + (1,) * (values.ndim - 1)
        means: NDArray[np.float64] = np.add.reduceat(kept, self.first, axis=0) / self.count.reshape(shape)
        return means

    def motion(self, motion: Motion) -> Motion:
        """Return the motion at the rows."""
        means: dict[str, Any] = {name: self.means(v) for name in ARRAYS if (v := getattr(motion, name)) is not None}
        trajectory = motion.at_offset
        return replace(
            motion,
            **means,
            still=motion.still[self.kept[self.first]],
            reference_valid=None,
            at_offset=None if trajectory is None else partial(self._at, trajectory),
            at_lag=None if motion.at_lag is None else partial(self._at, motion.at_lag),
        )

    def _at(
        self, trajectory: Callable[..., Motion | None], offset: float | NDArray[np.float64] = 0.0, **lag: float
    ) -> Motion:
        """Return the motion at the rows' samples shifted in time; ``offset`` is that of the rows."""
        if isinstance(offset, np.ndarray):
            samples = np.zeros(self.total)
            samples[self.kept] = np.repeat(offset, self.count.astype(int))
            offset = samples
        motion = trajectory(offset=offset, **lag)
        assert motion is not None  # noqa: S101
        return self.motion(motion)


def rows_of(motion: Motion, sound: NDArray[np.bool_], *, together: bool = True) -> Rows:
    """Choose the samples of a fit and group those of a rest.

    ``sound``: (n,), samples whose readings can be used. ``together``: whether the samples of a rest are alike; after a
    filter they are not.
    """
    moving = np.linalg.norm(motion.angular_rate, axis=1) > RATE_AT_REST_DPS
    if motion.rate is not None:
        moving = np.abs(motion.rate) > RATE_AT_REST_DPS
    kept = np.flatnonzero(sound & (motion.still | moving) & followed(motion))
    if len(kept) == 0:
        return Rows(kept, kept, np.zeros(0), len(sound))
    still, time = motion.still[kept], motion.time[kept]
    alike = still[1:] & still[:-1] & (np.diff(kept) == 1) & together
    rest = np.concatenate([[0], np.cumsum(~alike)])
    begin = time[np.concatenate([[True], ~alike])]
    piece = np.floor((time - begin[rest]) / MEAN_S + 1e-9)
    new = np.concatenate([[True], ~alike | (np.diff(piece) != 0)])
    first = np.flatnonzero(new)
    return Rows(kept, first, np.diff(np.append(first, len(kept))).astype(float), len(sound))


def followed(motion: Motion) -> NDArray[np.bool_]:
    """Return at which samples the log follows the table: (n,) array of bool.

    Both intervals beside a sample of a turn must be explained; with an attitude log, the rate must be the cubic through
    its four neighbours, and theirs too, to 0.05 deg/s and 0.1 %.
    """
    if motion.reference_valid is not None:
        return motion.reference_valid
    rate, time = motion.angular_rate, motion.time
    bend = np.full(len(time), np.inf)
    if len(time) >= 5:
        t = [time[k : len(time) - 4 + k] for k in range(5)]
        guess = np.zeros((len(t[0]), rate.shape[1]))
        for j in (0, 1, 3, 4):  # Lagrange's cubic through the four neighbours, at the middle sample
            others = [k for k in (0, 1, 3, 4) if k != j]
            weight = np.prod([(t[2] - t[k]) / (t[j] - t[k]) for k in others], axis=0)
            guess += weight[:, None] * rate[j : len(time) - 4 + j]
        bend[2:-2] = np.abs(guess - rate[2:-2]).max(axis=1)
    bends = bend > np.maximum(BEND_DPS, BEND_SHARE * np.abs(rate).max(axis=1))
    near = np.convolve(bends, np.ones(3), "same") > 0.5
    sure: NDArray[np.bool_] = np.logical_not(near)
    return sure
