"""The axes of charts: positions of values on a linear, logarithmic or symmetric logarithmic scale, and round ticks."""

from __future__ import annotations

import math
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.output.pages.numbers import MINUS, typeset

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from pipeline.core.records import Integers, Values


SUBDIVISION = 10  # drawing units in a pixel
ANGLE_STEPS = (10.0, 15.0, 30.0, 45.0, 90.0, 180.0, 360.0, 720.0, 1800.0, 3600.0)  # deg, parts and multiples of a turn
LINEAR_TO = 10.0  # value to which a symlog axis is linear: delta BIC of strong evidence

Tick = tuple[float, str]


def round_ticks(low: float, high: float, count: int = 5, kind: str = "") -> list[Tick]:
    """Return about ``count`` round values from ``low`` to ``high`` with their text.

    ``kind``: "angle" (deg) for parts of a turn, "count" for whole numbers.
    """
    coarse = max((high - low) / count, 1.0 if kind == "count" else 0.0)
    if kind == "angle" and coarse > 5.0:
        step = min(ANGLE_STEPS, key=lambda s: abs(math.log(s / coarse)))
    else:
        power = 10.0 ** math.floor(math.log10(coarse))
        steps = (1.0, 2.0, 5.0, 10.0) if kind == "count" else (1.0, 2.0, 2.5, 5.0, 10.0)
        step = power * next(s for s in steps if s * power >= coarse * 0.999)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [(n * step, tick_label(n * step, step)) for n in range(first, last + 1)]


def tick_label(value: float, step: float) -> str:
    """Return the text of a tick with the decimals that the step between two ticks needs."""
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
    return text.replace("-", MINUS)


def log_ticks(low: float, high: float) -> list[Tick]:
    """Return the powers of ten from ``low`` to ``high``; of fewer than two, also 2 and 5, or round values."""
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    for factors in ((1,), (1, 2, 5)):
        values = [s * 10.0**k for k in decades for s in factors if low * 0.999 <= s * 10.0**k <= high * 1.001]
        if len(values) >= 2:
            return [(v, tick_label(v, v)) for v in values]
    return round_ticks(low, high)


def scaled(values: Any, kind: str) -> Values:  # noqa: ANN401  (numbers or an array)
    """Return values on the scale of an axis.

    ``log``: log10, -inf where v <= 0. ``symlog``: v / 10 where |v| <= 10, else sign(v) (1 + log10(|v| / 10)).
    """
    v = np.asarray(values, np.float64)
    if kind == "log":
        return np.log10(v, out=np.full(v.shape, -np.inf), where=v > 0)
    if kind == "symlog":
        size = np.abs(v) / LINEAR_TO
        return np.where(size <= 1.0, v / LINEAR_TO, np.copysign(1.0 + np.log10(np.maximum(size, 1.0)), v))
    return v


@dataclass(frozen=True)
class Axis:
    """Maps values from ``low`` to ``high`` (on the scale of the axis) to pixels from ``start`` to ``stop``."""

    low: float
    high: float
    start: float
    stop: float
    kind: str = ""  # "", "angle" (deg), "count" (whole numbers), "log" or "symlog"

    @classmethod
    def over(cls, arrays: Iterable[Values], start: float, stop: float, kind: str = "", margin: float = 0.04) -> Axis:
        """Return an axis over the finite values, wider by ``margin`` on both sides; 0 to 1 without any value."""
        values = scaled(np.concatenate([np.zeros(0), *(a.ravel() for a in arrays)]), kind)
        finite = values[np.isfinite(values)]
        low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
        if high - low <= 1e-12 * max(abs(low), abs(high), 1e-300):
            half = 0.5 * abs(low) or 0.5
            return cls(low - half, high + half, start, stop, kind)
        wider = margin * (high - low) if finite.size else 0.0
        return cls(low - wider, high + wider, start, stop, kind)

    def pixels(self, value: float) -> float:
        """Return the position of a value, px; a value below the axis is drawn at its start."""
        v = float(scaled(value, self.kind)) if "log" in self.kind else value
        return self.start + (max(v, self.low) - self.low) / (self.high - self.low) * (self.stop - self.start)

    def units(self, values: Values) -> Integers:
        """Return the positions of values in whole drawing units; values beyond the axis are drawn at its end."""
        v = np.minimum(np.maximum(scaled(values, self.kind), self.low), self.high)
        slope = SUBDIVISION * (self.stop - self.start) / (self.high - self.low)
        return np.asarray(np.rint((v - self.low) * slope + SUBDIVISION * self.start).astype(np.int64))

    def ticks(self, count: int, names: Sequence[str] = ()) -> list[Tick]:
        """Return at least two ticks as position (px) and text; ``names``: texts of the values 1, 2, ..."""
        if names:
            ticks = [(float(i), name) for i, name in enumerate(names, 1)]
        elif self.kind == "log":
            ticks = log_ticks(10.0**self.low, 10.0**self.high)
        elif self.kind == "symlog":
            decades = [sign * 10.0**k for sign in (-1, 1) for k in range(1, 9)]
            values = [v for v in (0.0, *decades) if self.low <= scaled(v, self.kind) <= self.high]
            ticks = [(v, tick_label(v, LINEAR_TO)) for v in values]
        else:
            ticks = round_ticks(self.low, self.high, count, self.kind)
            if len(ticks) < 2:
                ticks = round_ticks(self.low, self.high, count + 2)
        return [(self.pixels(value), label) for value, label in ticks]

    def attribute(self, label: str, names: Sequence[str] = ()) -> str:
        """Return the attributes that describe the axis to the script of the page."""
        ticks = f' data-ticks="{escape("|".join(names))}"' if names else ""
        ends = f"{self.low:.9g},{self.high:.9g},{self.start:g},{self.stop:g}"
        return f' data-scale="{ends},{self.kind},{escape(typeset(label))}"{ticks}'
