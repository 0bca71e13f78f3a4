"""Samples and stretches in which one channel of a table's log contradicts all others.

One value c of a channel (at a sample, or over an interval) is contradicted by another channel w where

    c > w_max + m b + d   or   c < w_min - m b - d

where w_min and w_max are both the mean of the two nearest values of another channel of the table (m = 3), or of a
sensor the extremes within the largest plausible delay (m = 1), and b is the largest second difference of w there: a
short move may reach its rate between the samples that w shows. Stretches, of 16 samples and of a twelfth of the
recording, are contradicted where

    |sum (c - w) dt| > d_s + T range(w) + 3 sqrt(sum (dc dt / 2)^2 + sum (dw dt / 2)^2)

with T the largest delay, and the last term what a rate that bends between its samples leaves of a sum. d and d_s are
what noise and the limits of the catalogue's effects allow. What exceeds noise and the stated accuracy only is a doubt.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from pipeline.preprocessing.evidence import Channel, Limits

    Array = NDArray[np.float64]

BY_NOISE = 10.0  # standard deviations, as of disturbances (pipeline.io.disturbances)
BENDS = 3.0  # of a move as long as one interval, whose second difference shows a quarter of its rate
SHORT, LONG = 16, 12  # samples of a short stretch; long ones in a recording
RESOLVED_DEG = 1e-3  # of a logged angle: the tenth of a common encoder's 0.01 deg
CURVED = 0.02  # relative: what nonlinearities leave of a gyroscope's gain that is fitted to the same turn
OF_SENSOR = ("gyroscope", "gravity")
PHASE = 0.2  # relative error of gravity's phase over some degrees: twice 0.1 g of bias


@dataclass(frozen=True)
class Contradiction:
    """Samples in which a channel contradicts the others.

    Attributes
    ----------
    claim : Channel
    others : tuple of Channel
    first, last : int
        Samples.
    claimed, seen : float
        By the channel and by the nearest of the others: deg/s at a sample, deg over a stretch.
    gross : bool
        Whether it exceeds what an effect of the catalogue can explain.
    stretch : bool
        Whether a sum over the stretch shows it.
    count : int
        Samples or stretches concerned.
    """

    claim: Channel
    others: tuple[Channel, ...]
    first: int
    last: int
    claimed: float
    seen: float
    gross: bool
    stretch: bool
    count: int


class Comparison:
    """The channels of one recording, compared with each other.

    Parameters
    ----------
    channels : sequence of Channel
    dt : (n - 1,) array, s
    limits : Limits
    """

    def __init__(self, channels: Sequence[Channel], dt: Array, limits: Limits) -> None:
        self.channels, self.dt, self.limits = channels, dt, limits
        self.interval = float(np.median(dt))
        n = len(dt)
        self.sizes = sorted({SHORT, max(n // LONG, SHORT)})
        self.starts = {size: np.arange(0, max(n - size // 2, 1), size) for size in self.sizes}

    @cached_property
    def known(self) -> NDArray[np.bool_]:
        """Which intervals every channel knows: (n - 1,) array."""
        known = np.ones(len(self.dt), bool)
        for channel in self.channels:
            finite = np.isfinite(channel.low)
            known &= finite if channel.of_intervals else finite[1:] & finite[:-1]
        return known

    @cached_property
    def sums(self) -> dict[tuple[str, int], tuple[Array, Array, Array, Array]]:
        """Angle turned, its total, the square of what bends leave and the range of the rate, in each stretch."""
        out = {}
        for channel in self.channels:
            turned = np.where(self.known, channel.turned, 0.0)
            rate = channel.low if channel.of_intervals else channel.low[1:]
            rate = np.where(self.known, rate, 0.0)
            bend = np.zeros(len(self.dt))
            if not channel.of_intervals:
                bend = np.where(self.known, 0.5 * np.diff(np.where(np.isfinite(channel.low), channel.low, 0.0)), 0.0)
                bend = (bend * self.dt) ** 2
            for size in self.sizes:
                at = self.starts[size]
                swing = np.maximum.reduceat(rate, at) - np.minimum.reduceat(rate, at)
                out[channel.name, size] = (
                    np.add.reduceat(turned, at),
                    np.add.reduceat(np.abs(turned), at),
                    np.add.reduceat(bend, at),
                    swing,
                )
        return out

    def find(self, claim: Channel) -> Contradiction | None:
        """Return where a channel contradicts all others; None where it does nowhere."""
        others = [c for c in self.channels if c is not claim and (c.name != "gravity" or claim.name == "table_angle")]
        if not others or claim.name in OF_SENSOR:
            return None
        alone = all(w.name in OF_SENSOR for w in others)
        rows = [self._rows(claim, w, alone=alone) for w in others]
        gross = self._worst_row(claim, others, [r[0] for r in rows], gross=True)
        return (
            gross
            or self._worst_stretch(claim, others)
            or self._worst_row(claim, others, [r[1] for r in rows], gross=False)
        )

    def _rows(self, claim: Channel, other: Channel, *, alone: bool) -> tuple[Array, Array]:
        """Return by how much each value is beyond what another channel allows, grossly and by noise: (m,) arrays."""
        limits = self.limits
        of_sensor = other.name in OF_SENSOR
        reach = max(int(np.ceil(limits.late_s / self.interval)), 1) if of_sensor else 1
        low, high, bend = _near(other, claim, reach)
        if other.name == "gravity":  # a move between two samples of the angle may be shared by two of the sensor
            low, high, bend = np.minimum(2.0 * low, 0.0), np.maximum(2.0 * high, 0.0), np.zeros_like(bend)
        size = np.maximum(np.abs(low), np.abs(high))
        size[np.isinf(size)] = np.nan
        noise = BY_NOISE * (claim.noise + other.noise) + RESOLVED_DEG / self.interval
        gross, stated = limits.rate * size, limits.rate_stated * size
        if claim.of_intervals:
            gross = gross + limits.angle_deg / self.interval
            stated = stated + limits.angle_stated_deg / self.interval
        bend = bend if of_sensor else BENDS * bend
        if of_sensor:
            share = limits.rate + limits.gain
            sure = share if alone else CURVED
            gross, stated = gross + share * size + limits.offset_dps, stated + sure * size + limits.offset_dps
        with np.errstate(invalid="ignore"):
            off = np.maximum(claim.low - high, low - claim.high) - bend - noise
            gross, stated = off - gross, off - stated
        return np.where(np.isfinite(gross), gross, -np.inf), np.where(np.isfinite(stated), stated, -np.inf)

    def _worst_row(
        self, claim: Channel, others: list[Channel], excess: list[Array], *, gross: bool
    ) -> Contradiction | None:
        least = np.min(excess, axis=0)
        rows = np.flatnonzero(least > 0.0)
        if not rows.size:
            return None
        worst = int(np.argmax(least))
        group = rows[np.abs(rows - worst) <= SHORT]
        nearest = others[int(np.argmin([e[worst] for e in excess]))]
        seen = nearest.low[min(worst, len(nearest.low) - 1)]
        last = int(group[-1]) + (1 if claim.of_intervals else 0)
        return Contradiction(
            claim,
            tuple(others),
            int(group[0]),
            last,
            float(claim.low[worst]),
            float(seen),
            gross,
            stretch=False,
            count=int(rows.size),
        )

    def _worst_stretch(self, claim: Channel, others: list[Channel]) -> Contradiction | None:
        limits = self.limits
        for size in self.sizes:
            turned, total, bends, _ = self.sums[claim.name, size]
            length = np.add.reduceat(np.where(self.known, self.dt, 0.0), self.starts[size])
            excess = []
            for other in others:
                seen, seen_total, seen_bends, swing = self.sums[other.name, size]
                most = np.maximum(total, seen_total)
                allowed = limits.rate * most + BENDS * np.sqrt(bends + seen_bends) + RESOLVED_DEG
                if claim.of_intervals or other.of_intervals:
                    allowed = allowed + limits.angle_deg
                if other.name in OF_SENSOR:
                    share = PHASE if other.name == "gravity" else limits.gain
                    noise = BY_NOISE * other.noise * self.interval * (np.sqrt(size) if not other.of_intervals else 1.0)
                    allowed = allowed + share * most + limits.late_s * swing + limits.offset_dps * length + noise
                excess.append(np.abs(turned - seen) - allowed)
            off = np.min(excess, axis=0)
            rows = np.flatnonzero(off > 0.0)
            if rows.size:
                worst = int(np.argmax(off))
                nearest = others[int(np.argmin([e[worst] for e in excess]))]
                return Contradiction(
                    claim,
                    tuple(others),
                    int(self.starts[size][rows[0]]),
                    min(int(self.starts[size][rows[-1]]) + size, len(self.dt)),
                    float(turned[worst]),
                    float(self.sums[nearest.name, size][0][worst]),
                    gross=True,
                    stretch=True,
                    count=int(rows.size),
                )
        return None


def _near(other: Channel, claim: Channel, reach: int) -> tuple[Array, Array, Array]:
    """Return smallest and largest value, and largest second difference, of a channel near each value of another."""
    m, n = len(other.low), len(claim.low)
    before, after = reach, reach
    if m < n:  # of intervals, about a sample: those on either side
        after -= 1
    elif m > n:  # samples about an interval: those at its ends
        after += 1
    bend = np.zeros(m)
    with np.errstate(invalid="ignore"):
        bend[1:-1] = np.abs(other.low[2:] - 2.0 * other.low[1:-1] + other.low[:-2])
    bend[np.isnan(bend)] = np.inf
    bend = _slide(bend, before, after, n, np.maximum)
    if m == n or other.name in OF_SENSOR:
        low = _slide(other.low, before, after, n, np.minimum)
        return low, _slide(other.high, before, after, n, np.maximum), bend
    middle = _middle(other, n)
    return middle, middle, bend


def _middle(other: Channel, count: int) -> Array:
    """Return the mean of the intervals about each sample, or of the samples at the ends of each interval."""
    with np.errstate(invalid="ignore"):
        mean = 0.5 * (other.low[1:] + other.low[:-1])
    return mean if len(mean) == count else np.concatenate([[np.inf], mean, [np.inf]])


def _slide(values: Array, before: int, after: int, count: int, better: np.ufunc) -> Array:
    """Return minimum or maximum of the values from ``k - before`` to ``k + after``, by doubling: (count,) array."""
    width, have = before + after + 1, 1
    beyond = np.inf if better is np.minimum else -np.inf
    out = np.concatenate([np.full(before, beyond), values, np.full(after + max(count - len(values), 0), beyond)])
    while have < width:
        step = min(have, width - have)
        out = better(out[:-step], out[step:])
        have += step
    return np.asarray(out[:count])
