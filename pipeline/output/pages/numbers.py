"""Format numbers for pages and terminals.

A measured value is written to two digits of its expanded uncertainty (JCGM 100:2008, 7.2.6).
"""

from __future__ import annotations

import math
import re
from functools import lru_cache
from textwrap import wrap
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Sequence

NOTHING = "\N{EN DASH}"
PREFIXES = ((1.0, ""), (1e-3, "m"), (1e-6, "µ"))
MINUS = "\N{MINUS SIGN}"
TYPOGRAPHIC = {
    "+-": "±",
    "delta BIC": "ΔBIC",
    "degC": "°C",
    "^2": "²",
    "^3": "³",
    "sqrt(Hz)": "√Hz",
    "sqrt(s)": "√s",
    "gauss markov": "Gauss-Markov",
}


def number(value: object, digits: int = 3) -> str:
    """Return a value to ``digits`` significant digits, with an exponent beyond 1e-4 to 1e5; a dash for no number."""
    if not isinstance(value, int | float) or not math.isfinite(value):
        return NOTHING
    if value == 0:
        return "0"
    if 1e-4 <= abs(value) < 1e5:
        decimals = max(0, digits - 1 - math.floor(math.log10(abs(value))))
        return f"{value:.{decimals}f}".replace("-", MINUS)
    return f"{value:.{digits - 1}e}".replace("-", MINUS).replace("e+", "e")


def measured(value: float | None, expanded: float | None) -> str:
    """Return ``value ± expanded uncertainty``, both to the decimals that two digits of the uncertainty need."""
    if value is None or not math.isfinite(value):
        return NOTHING
    if expanded is None or not math.isfinite(expanded) or expanded <= 0:
        return number(value, 5)
    decimals = 1 - math.floor(math.log10(expanded))
    if decimals > 9:
        return f"{number(value, 7)} ± {number(expanded, 2)}"
    decimals = max(0, decimals)
    return f"{value:z.{decimals}f} ± {expanded:.{decimals}f}".replace("-", MINUS)


def measured_row(values: Sequence[float], expanded: Sequence[float | None]) -> list[str]:
    """Return values of one row, and the largest of their expanded uncertainties as ``± U``, to two digits of it."""
    known = [U for U in expanded if U is not None and math.isfinite(U) and U > 0.0]
    if not known:
        return [*(number(value, 5) for value in values), ""]
    decimals = min(max(0, 1 - math.floor(math.log10(max(known)))), 9)
    texts = [f"{value:z.{decimals}f}".replace("-", MINUS) for value in values]
    return [*texts, f"± {max(known):.{decimals}f}"]


def span(low: float, high: float) -> str:
    """Return an interval of positive values to the decimals of its high end; "at most" where the low one is 0."""
    if not 1e-4 <= high < 1e5:
        return f"{number(low)} to {number(high)}"
    upper = number(high)
    lower = f"{low:.{len(upper.partition('.')[2])}f}"
    return f"{lower} to {upper}" if float(lower) else f"at most {upper}"


class Scale(NamedTuple):
    """An SI prefix for values of a column: value in ``unit`` = value / ``factor``."""

    factor: float
    unit: str


def scale_of(unit: str, *values: float | None) -> Scale:
    """Return the prefix (none, m, µ) with which the largest of the values, in g or deg/s, is at least 1."""
    largest = max((abs(v) for v in values if v is not None and math.isfinite(v)), default=0.0)
    if largest <= 0.0 or not unit.startswith(("g", "deg/s")):
        return Scale(1.0, unit_text(unit))
    factor, prefix = next((p for p in PREFIXES if largest >= p[0]), PREFIXES[-1])
    return Scale(factor, f"{prefix}{unit_text(unit)}")


def in_unit(value: object, scale: Scale) -> str:
    """Return a value of a column in the column's unit."""
    return number(value / scale.factor) if isinstance(value, int | float) else NOTHING


def percent(share: object) -> str:
    """Return a share as percent."""
    return f"{number(100.0 * share, 2)} %" if isinstance(share, int | float) else NOTHING


def percent_change(logarithm: float, largest: float) -> str:
    """Return a ratio, given by its logarithm, as a change in percent, or as a factor.

    All ratios of one cell have the same form: a factor where the logarithm of the largest is above log 2.
    """
    if largest > math.log(2.0):
        return f"× {number(math.exp(logarithm))}"
    return f"{100.0 * math.expm1(logarithm):+.1f} %".replace("-", MINUS)


def probability(value: object) -> str:
    """Return a p-value; below 1e-12 as a bound."""
    if not isinstance(value, int | float):
        return NOTHING
    return "< 1e\N{MINUS SIGN}12" if value < 1e-12 else number(value, 2)


@lru_cache(4096)  # ticks, units and names of effects are the same on many charts and pages
def typeset(sentence: str) -> str:
    """Return a sentence or a unit of the terminal with typographic signs: ``±``, ``−``, ``ΔBIC``, ``°C``."""
    for ascii_text, sign in TYPOGRAPHIC.items():
        sentence = sentence.replace(ascii_text, sign)
    return re.sub(r"(?<![\w.-])-(?=\d)|(?<=\de)-(?=\d)", MINUS, sentence)


def plain(name: str) -> str:
    """Return the name of an effect, a verdict or a setting with spaces."""
    return name.replace("_", " ")


def unit_text(unit: object) -> str:
    """Return a unit as text behind a number; empty for the unit 1."""
    return "" if unit in (None, "1") else typeset(str(unit))


def aligned(rows: Sequence[Sequence[str]], width: int | None = None) -> list[str]:
    """Return rows as lines of a terminal with aligned columns; the last column is wrapped to the width."""
    if not rows:
        return []
    *widths, _ = (max(map(len, column)) for column in zip(*rows, strict=True))
    lines, start = [], 2 + sum(widths) + 2 * len(widths)
    for *cells, last in rows:
        parts = wrap(last, width - start, break_long_words=False) if width and last else [last]
        head = "".join(f"{cell.ljust(size)}  " for cell, size in zip(cells, widths, strict=True))
        lines += [f"  {head}{parts[0]}".rstrip(), *(" " * start + part for part in parts[1:])]
    return lines
