"""Estimate the gyroscope's bias from a rest of the log, for ``apply --rest``.

    b' = b + K m,    K = matrix^-1

where m is the mean rate, calibrated with b, of the longest rest in an interval of the log. Rests are found as in
recordings by hand (``pipeline.signal.rests``). b' is the bias at the power-on of the log. It includes Earth's rotation,
at most 0.0042 deg/s.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import InputError
from pipeline.records import Recording
from pipeline.signal.rests import find_rests

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pipeline.model.compensation import Compensation
    from pipeline.records import Values

PARTS, K95 = 10, 2.262  # of a rest; Student's t for 95 %, two-sided, with 9 degrees of freedom


@dataclass
class Stretch:
    """The calibrated readings in an interval of a log, s from its first sample, collected block by block."""

    first: float
    last: float
    begin: float | None = None  # time of the first sample of the log, s
    blocks: list[tuple[Values, Values, Values]] = field(  # s from the first sample, specific force, rate
        default_factory=lambda: [(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)))]
    )

    def add(self, readings: Mapping[str, Values], time: Values | None, file: str) -> None:
        """Add a block: (n, 3) calibrated readings of each sensor, (n,) times in s."""
        if time is None or not {"accelerometer", "gyroscope"} <= set(readings):
            message = "--rest needs the time and the readings of both sensors; the log lacks some of these"
            raise InputError(f"{message}: leave out --rest", file)
        if self.begin is None:
            self.begin = float(time[0])
        since = time - self.begin
        inside = (since >= self.first) & (since <= self.last)
        if inside.any():
            self.blocks.append((since[inside], readings["accelerometer"][inside], readings["gyroscope"][inside]))

    def mean_rate(self, file: str) -> tuple[Values, str]:
        """Return the mean rate of the longest rest, deg/s, (3,) array, and a note that states it."""
        since, force, rate = (np.concatenate(column) for column in zip(*self.blocks, strict=True))
        log = Recording("log", "rests", None, np.round(since * 1e9).astype(np.int64), force, rate)
        rests = [r for r in find_rests(log) if r.accepted]
        if not rests:
            message = f"no rest of 1 s or more from {self.first:g} to {self.last:g} s of the log"
            raise InputError(
                f"{message}; --rest states an interval with a rest, in s from the first sample of the log", file
            )
        longest = max(rests, key=lambda r: r.stop - r.start)
        still = rate[longest.start : longest.stop]
        mean = still.mean(axis=0)
        parts = np.array([part.mean(axis=0) for part in np.array_split(still, PARTS)])
        error = parts.std(axis=0, ddof=1) / np.sqrt(PARTS)  # of the mean, also for noise correlated within a part
        words = ", ".join(f"{m:.4f} +- {K95 * e:.4f}" for m, e in zip(mean, error, strict=True))
        start, stop = since[[longest.start, longest.stop - 1]]
        return mean, (
            f"mean rate of the rest from {start:.1f} to {stop:.1f} s of the log, subtracted from all rates: {words} "
            f"deg/s (x, y, z; +- is the 95 % interval from the scatter of {PARTS} parts of the rest)"
        )


def with_bias_changed(compensation: Compensation, rate: Values) -> Compensation:
    """Return the compensation with a gyroscope bias that removes the calibrated ``rate`` at rest, (3,), deg/s."""
    gyroscope = compensation.gyroscope
    assert gyroscope is not None  # noqa: S101  (checked by ``compensate_log``)
    bias = gyroscope.bias + np.linalg.solve(gyroscope.matrix, rate)
    return replace(compensation, gyroscope=replace(gyroscope, bias=bias))
