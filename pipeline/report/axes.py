"""Axes of a chart: ticks at round values, scales from values to drawing units, and thinning of long series.

Ticks stand at multiples of ``s 10^k`` with s in {1, 2, 2.5, 5}, on an axis of angles at multiples of a divisor of
360 deg.

Thinning keeps what the eye would see: the samples are cut into equal buckets and of each bucket the smallest and the
largest sample are kept, in their order of time, so that no peak is lost. Source: S. Steinarsson, Downsampling Time
Series for Visual Representation, University of Iceland 2013, section 4.1 (min/max decimation).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

MAXIMUM_POINTS = 240
SUBDIVISION = 10  # drawing units per pixel: coordinates are integers, which are short and quick to write
ANGLE_STEPS = (1.0, 2.0, 5.0, 10.0, 15.0, 30.0, 45.0, 90.0, 180.0, 360.0, 720.0, 1800.0, 3600.0)


def ticks(low: float, high: float, count: int = 5, *, angle: bool = False) -> list[float]:
    """Return round values within ``low`` to ``high``, about ``count`` of them.

    Parameters
    ----------
    low, high : float
    count : int
    angle : bool
        Whether the values are angles in deg.
    """
    step = tick_step(low, high, count, angle=angle)
    first = math.ceil(low / step - 1e-9)
    last = math.floor(high / step + 1e-9)
    return [n * step for n in range(first, last + 1)]


@lru_cache(maxsize=16)
def tick_step(low: float, high: float, count: int = 5, *, angle: bool = False) -> float:
    """Return the distance of neighbouring ticks."""
    coarse = (high - low) / max(count, 1)
    if angle and coarse > ANGLE_STEPS[1]:
        return min(ANGLE_STEPS, key=lambda s: abs(math.log(s / coarse)))
    power = 10.0 ** math.floor(math.log10(coarse))
    return power * next(s for s in (1.0, 2.0, 2.5, 5.0, 10.0) if s * power >= coarse * 0.999)


def tick_label(value: float, step: float) -> str:
    """Return a tick's text, with the decimals that ``step`` needs."""
    if value == 0:
        return "0"
    if step < 2e-4 or abs(value) >= 1e6:
        mantissa, exponent = f"{value:.1e}".split("e")
        text = f"{mantissa.removesuffix('.0')}e{int(exponent)}"
    else:
        decimals = max(0, -math.floor(math.log10(step) + 1e-9))
        if not math.isclose(round(step, decimals), step, rel_tol=1e-6):
            decimals += 1
        text = f"{value:.{decimals}f}"
    return text.replace("-", "\N{MINUS SIGN}")


def log_ticks(low: float, high: float) -> list[float]:
    """Return the powers of ten within ``low`` to ``high``; fewer than two are filled up by 2 and 5."""
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    powers = [10.0**k for k in decades if low * 0.999 <= 10.0**k <= high * 1.001]
    if len(powers) >= 2:
        return powers
    return [s * 10.0**k for k in decades for s in (1, 2, 5) if low <= s * 10.0**k <= high]


@dataclass(frozen=True)
class Scale:
    """From values ``low .. high`` to pixels ``start .. stop``, linear or logarithmic."""

    low: float
    high: float
    start: float
    stop: float
    logarithmic: bool = False

    def pixels(self, value: float) -> float:
        """Return where one value stands, in pixels."""
        if self.logarithmic:
            share = math.log(max(value, self.low) / self.low) / math.log(self.high / self.low)
        else:
            share = (value - self.low) / (self.high - self.low)
        return self.start + share * (self.stop - self.start)

    def units(self, values: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return where values stand, in whole drawing units; values outside of the scale stay at its edge."""
        slope = SUBDIVISION * (self.stop - self.start) / (self.high - self.low)
        place = np.maximum(values, self.low)
        np.minimum(place, self.high, out=place)
        place -= self.low
        place *= slope
        place += SUBDIVISION * self.start
        units: NDArray[np.int64] = np.rint(place, out=place).astype(np.int64)
        return units


def span(arrays: list[NDArray[np.float64]], margin: float = 0.04) -> tuple[float, float]:
    """Return the range of all finite values, widened by ``margin`` of it on both sides; 0 to 1 where there is none."""
    ends = [e for a in arrays if a.size for e in (float(a.min()), float(a.max()))]
    if not all(map(math.isfinite, ends)):
        finite = [a[np.isfinite(a)] for a in arrays]
        ends = [e for a in finite if a.size for e in (float(a.min()), float(a.max()))]
    if not ends:
        return 0.0, 1.0
    low, high = min(ends), max(ends)
    if high - low <= 1e-12 * max(abs(low), abs(high), 1e-300):
        half = 0.5 * abs(low) or 0.5
        return low - half, high + half
    return low - margin * (high - low), high + margin * (high - low)


def thin(values: NDArray[np.float64], points: int = MAXIMUM_POINTS) -> NDArray[np.int64]:
    """Return the indices of at most ``points`` samples that keep every bucket's smallest and largest value.

    Parameters
    ----------
    values : (n,) array
        Finite.
    points : int

    Returns
    -------
    (m,) array of int, increasing
    """
    n = len(values)
    if n <= points:
        return np.arange(n)
    buckets = points // 2
    size = -(-n // buckets)
    whole = n // size
    cut = values[: whole * size].reshape(whole, size)
    first = np.arange(whole) * size
    index = np.stack([first + cut.argmin(1), first + cut.argmax(1)], 1)
    index.sort(axis=1)
    rest = np.array([], np.int64)
    if whole * size < n:
        tail = values[whole * size :]
        rest = whole * size + np.array(sorted({int(tail.argmin()), int(tail.argmax())}))
    kept = np.concatenate([index.ravel(), rest])
    single: NDArray[np.int64] = kept[np.concatenate([[True], np.diff(kept) > 0])]
    return single
