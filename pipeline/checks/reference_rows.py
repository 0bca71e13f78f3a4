"""Find samples and stretches in which one channel of a table's log contradicts all others.

A channel w contradicts a value c of another one (at a sample, or over an interval) where

    c > w_max + m b + d   or   c < w_min - m b - d

where b is the largest second difference of w near c: a short move may reach its rate between two samples of w. If w is
a channel of the table, w_min and w_max are both the mean of its two nearest values, and m = 3. If w is a sensor, they
are its extremes within the largest plausible delay, and m = 1. Stretches of 16 samples and of a twelfth of the
recording contradict each other where

    |sum (c - w) dt| > d_s + T range(w) + 3 sqrt(sum (dc dt / 2)^2 + sum (dw dt / 2)^2)

with the largest delay T. The last term is the error of a sum over a rate that changes between its samples. Noise and
the limits of the catalogue's effects allow d and d_s. A difference that exceeds only noise and the stated accuracy is
a doubt.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.checks.evidence import place
from pipeline.core.records import Note, median

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.checks.evidence import Channel, ChannelLimits
    from pipeline.core.records import Index, Recording, Values

    Found = tuple[str, int, int, int]  # text with the places {name} and {names}; number of rows, first and last sample

BY_NOISE = 10.0  # standard deviations, as of disturbances (pipeline.ingest.disturbances)
BENDS = 3.0  # times the second difference: in a move as long as one interval, it is a quarter of the rate
SHORT_STRETCH_SAMPLES, LONG_STRETCHES = 16, 12  # samples of a short stretch; long ones in a recording
MANY_SAMPLES = 20  # samples, more than a spike or a jump changes
RESOLVED_DEG = 1e-3  # of a logged angle: the tenth of a common encoder's 0.01 deg
CURVED = 0.02  # relative error by nonlinearities of a gyroscope's gain that is fitted to the same turn
OF_SENSOR = ("gyroscope", "gravity")
PHASE = 0.2  # relative error of gravity's phase over some degrees: twice 0.1 g of bias


class ChannelComparison:
    """The channels of one recording, compared with each other."""

    def __init__(self, recording: Recording, channels: Sequence[Channel], limits: ChannelLimits) -> None:
        self.recording, self.channels, self.limits = recording, channels, limits
        self.dt = np.diff(recording.time)
        self.interval = float(median(self.dt))
        self._summed: dict[tuple[str, int], tuple[Values, Values, Values, Values]] = {}  # by channel and size
        self.known = np.ones(len(self.dt), bool)  # intervals in which every channel is known
        for channel in channels:
            finite = np.isfinite(channel.low)
            self.known &= finite if channel.of_intervals else finite[1:] & finite[:-1]

    def find(self, claim: Channel) -> tuple[bool, Note] | None:
        """Return whether no effect of the catalogue explains a contradiction, and the note on it; None without one."""
        others = [c for c in self.channels if c is not claim and (c.name != "gravity" or claim.name == "table_angle")]
        if not others or claim.name in OF_SENSOR:
            return None
        alone = all(w.name in OF_SENSOR for w in others)
        gross, doubt = zip(*(self._rows(claim, w, alone=alone) for w in others), strict=True)
        contradiction = self._worst_row(claim, others, gross) or self._worst_stretch(claim, others)
        found = contradiction or self._worst_row(claim, others, doubt)
        if not found:
            return None
        name, *names = (self.limits.column(self.recording, c.name) for c in (claim, *others))
        text, count, first, last = found
        t, detail = self.recording.time, text.format(name=name, names=" and ".join(names))
        return contradiction is not None, Note("N-REFERENCE", count, 0, 0, detail, float(t[first]), float(t[last]))

    def _rows(self, claim: Channel, other: Channel, *, alone: bool) -> tuple[Values, Values]:
        """Return the excess of each value over what another channel allows: by effects, by accuracy: (m,) arrays."""
        limits, of_sensor = self.limits, other.name in OF_SENSOR
        reach = max(int(np.ceil(limits.late_s / self.interval)), 1) if of_sensor else 1
        low, high, bend = _near(other, claim, reach)
        if other.name == "gravity":  # a move between two samples of the angle may be split between two of the sensor
            low, high, bend = np.minimum(2.0 * low, 0.0), np.maximum(2.0 * high, 0.0), np.zeros_like(bend)
        size = np.maximum(np.abs(low), np.abs(high))
        size[np.isinf(size)] = np.nan
        noise = BY_NOISE * (claim.noise + other.noise) + RESOLVED_DEG / self.interval
        gross, stated = limits.rate * size, limits.rate_stated * size
        if claim.of_intervals:
            gross += limits.angle_deg / self.interval
            stated += limits.angle_stated_deg / self.interval
        if of_sensor:
            share = limits.rate + limits.gain
            gross += share * size + limits.offset_dps
            stated += (share if alone else CURVED) * size + limits.offset_dps
        with np.errstate(invalid="ignore"):
            off = np.maximum(claim.low - high, low - claim.high) - (bend if of_sensor else BENDS * bend) - noise
            gross, stated = off - gross, off - stated
        return np.where(np.isfinite(gross), gross, -np.inf), np.where(np.isfinite(stated), stated, -np.inf)

    def _worst_row(self, claim: Channel, others: list[Channel], excess: Sequence[Values]) -> Found | None:
        least = np.min(excess, axis=0)
        rows = np.flatnonzero(least > 0.0)
        if not rows.size:
            return None
        worst = int(np.argmax(least))
        group = rows[np.abs(rows - worst) <= SHORT_STRETCH_SAMPLES]
        low = others[int(np.argmin([e[worst] for e in excess]))].low
        first, last = int(group[0]), int(group[-1]) + (1 if claim.of_intervals else 0)
        looks = "it looks like a spike or a jump"
        if rows.size > MANY_SAMPLES:
            looks = "does it follow this motion, or is it frozen, reversed in time, or of another recording?"
        text = (
            f"{{name}} {'turns at' if claim.of_intervals else 'is'} {claim.low[worst]:.4g} deg/s in "
            f"{place(self.recording, first, last)}, while {{names}} show {low[min(worst, len(low) - 1)]:.4g} deg/s "
            f"({rows.size} such {'place' if rows.size == 1 else 'places'}): {looks}"
        )
        return text, rows.size, first, last

    def _worst_stretch(self, claim: Channel, others: list[Channel]) -> Found | None:
        limits, n = self.limits, len(self.dt)
        for size in sorted({SHORT_STRETCH_SAMPLES, max(n // LONG_STRETCHES, SHORT_STRETCH_SAMPLES)}):
            starts = np.arange(0, max(n - size // 2, 1), size)
            turned, total, bends, _ = self._sums(claim, size, starts)
            length = np.add.reduceat(np.where(self.known, self.dt, 0.0), starts)
            excess, sums = [], []
            for other in others:
                shown, shown_total, shown_bends, swing = self._sums(other, size, starts)
                most = np.maximum(total, shown_total)
                allowed = limits.rate * most + BENDS * np.sqrt(bends + shown_bends) + RESOLVED_DEG
                if claim.of_intervals or other.of_intervals:
                    allowed += limits.angle_deg
                if other.name in OF_SENSOR:
                    share = PHASE if other.name == "gravity" else limits.gain
                    noise = BY_NOISE * other.noise * self.interval * (1.0 if other.of_intervals else np.sqrt(size))
                    allowed += share * most + limits.late_s * swing + limits.offset_dps * length + noise
                excess.append(np.abs(turned - shown) - allowed)
                sums.append(shown)
            off = np.min(excess, axis=0)
            rows = np.flatnonzero(off > 0.0)
            if rows.size:
                worst = int(np.argmax(off))
                shown = sums[int(np.argmin([e[worst] for e in excess]))]
                first, last = int(starts[rows[0]]), min(int(starts[rows[-1]]) + size, n)
                part = getattr(self.recording, claim.name)[first : last + 1]
                text = (
                    f"{{name}}{' stays the same and' if np.all(part == part[0]) else ''} contradicts {{names}} in "
                    f"{place(self.recording, first, last)}: it turns by {turned[worst]:.4g} deg and they by "
                    f"{shown[worst]:.4g} deg in one of {rows.size} such stretches"
                )
                return text, rows.size, first, last
        return None

    def _sums(self, channel: Channel, size: int, starts: Index) -> tuple[Values, Values, Values, Values]:
        """Return for each stretch: angle, sum of its magnitudes, squared error by bends, and range of the rate."""
        if (channel.name, size) in self._summed:
            return self._summed[channel.name, size]
        turned, bend = np.where(self.known, channel.turned, 0.0), np.zeros(len(self.dt))
        rate = np.where(self.known, channel.low if channel.of_intervals else channel.low[1:], 0.0)
        if not channel.of_intervals:
            steps = np.diff(np.where(np.isfinite(channel.low), channel.low, 0.0))
            bend = (np.where(self.known, 0.5 * steps, 0.0) * self.dt) ** 2
        swing = np.maximum.reduceat(rate, starts) - np.minimum.reduceat(rate, starts)
        angle, total, bends = (np.add.reduceat(v, starts) for v in (turned, np.abs(turned), bend))
        self._summed[channel.name, size] = angle, total, bends, swing
        return angle, total, bends, swing


def _near(other: Channel, claim: Channel, reach: int) -> tuple[Values, Values, Values]:
    """Return smallest and largest value, and largest second difference, of a channel near each value of another."""
    m, n = len(other.low), len(claim.low)
    before, after = reach, reach + m - n  # n - 1 intervals next to n samples, or the reverse
    bend = np.zeros(m)
    with np.errstate(invalid="ignore"):
        bend[1:-1] = np.abs(other.low[2:] - 2.0 * other.low[1:-1] + other.low[:-2])
        mean = 0.5 * (other.low[1:] + other.low[:-1])
    bend[np.isnan(bend)] = np.inf
    bend = _slide(bend, before, after, n, np.maximum)
    if m == n or other.name in OF_SENSOR:
        low = _slide(other.low, before, after, n, np.minimum)
        return low, _slide(other.high, before, after, n, np.maximum), bend
    middle = mean if len(mean) == n else np.concatenate([[np.inf], mean, [np.inf]])
    return middle, middle, bend


def _slide(values: Values, before: int, after: int, count: int, better: np.ufunc) -> Values:
    """Return minimum or maximum of the values from ``k - before`` to ``k + after``, by doubling: (count,) array."""
    width, have = before + after + 1, 1
    beyond = np.inf if better is np.minimum else -np.inf
    out = np.concatenate([np.full(before, beyond), values, np.full(after + max(count - len(values), 0), beyond)])
    while have < width:
        step = min(have, width - have)
        out = better(out[:-step], out[step:])
        have += step
    return np.asarray(out[:count])
