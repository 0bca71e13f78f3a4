"""A figure of the evidence: a measured share or quantity with its interval and goal, and the file of such figures.

Every command that measures evidence (``benchmarks/evidence/measures.yaml``) writes its figures with ``write_figures``.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np
import scipy

from pipeline.core.files import JSON
from pipeline.core.records import Values

if TYPE_CHECKING:
    import pandas as pd


class MeasuredFigure(NamedTuple):
    """A share of ``total`` cases, or, with a ``unit``, another quantity, with an interval where there is one.

    ``goal``: ``>= 98 %``, ``<= 3`` or, of an interval, ``contains 95 %``. ``misses`` names the cases that do not belong
    to the share, in order.
    """

    name: str
    value: float
    total: int
    goal: str = ""
    interval: tuple[float, float] | None = None
    misses: tuple[str, ...] = ()
    unit: str | None = None

    @property
    def is_share(self) -> bool:
        """Whether the value is a share, from 0 to 1."""
        return self.unit is None and self.interval is not None

    @property
    def cells(self) -> list[Any]:
        """Name, n, value, interval and goal as a table shows them."""
        if self.is_share and self.interval is not None:
            low, high = (100.0 * end for end in self.interval)
            return [self.name, self.total, f"{100.0 * self.value:.1f} %", f"{low:.1f} to {high:.1f} %", self.goal]
        ends = "" if self.interval is None else f"{self.interval[0]:.3g} to {self.interval[1]:.3g}"
        digits = f"{self.value:.3g}" if self.unit else f"{self.value:.2g}"
        return [self.name, self.total, f"{digits} {self.unit or ''}".strip(), ends, self.goal]

    @property
    def missed(self) -> bool:
        """Whether the value misses the goal, or the interval does not contain it."""
        if not self.goal:
            return False
        words = self.goal.removesuffix("%").split()
        relation, bound = (words[0], float(words[-1])) if len(words) > 1 else (">=", float(words[0]))
        scale = 100.0 if self.is_share else 1.0
        if relation == "contains":
            low, high = self.interval or (self.value, self.value)
            return not scale * low <= bound <= scale * high
        return bool(scale * self.value < bound if relation == ">=" else scale * self.value > bound)

    def to_json(self) -> JSON:
        """Return the figure as a JSON document."""
        return self._asdict()

    @classmethod
    def from_json(cls, document: JSON) -> Self:
        """Return the figure of a document."""
        ends = document["interval"]
        return cls(**{**document, "interval": ends and tuple(ends), "misses": tuple(document["misses"])})


def wilson(hits: int, total: int, level: float = 0.95) -> tuple[float, float]:
    """Return the interval of a share by Wilson's method."""
    found = scipy.stats.binomtest(hits, total).proportion_ci(level, method="wilson")
    return float(found.low), float(found.high)


def clopper_pearson(hits: int, total: int) -> tuple[float, float]:
    """Return the exact 95 % interval of a share (Clopper and Pearson, Biometrika 26, 1934)."""
    found = scipy.stats.binomtest(hits, total).proportion_ci(0.95, method="exact")
    return float(found.low), float(found.high)


def share(name: str, right: pd.Series[bool], goal: str = "") -> list[MeasuredFigure]:
    """Return the share of the true values, with the labels of the others as misses; an empty list for no values."""
    hits, total = int(right.sum()), len(right)
    misses = tuple(map(str, right.index[~right]))
    return [MeasuredFigure(name, hits / total, total, goal, wilson(hits, total), misses)] if total else []


def clustered_share(name: str, inside: Sequence[Values], goal: str = "", level: float = 0.99) -> list[MeasuredFigure]:
    """Return the share of true values over all units: a ratio estimate with its interval clustered by unit.

        s = sum h_i / sum m_i,    u^2 = K / (K - 1) sum (h_i - s m_i)^2 / (sum m_i)^2

    with h_i of m_i values true in unit i of K, and Student's t with K - 1 degrees of freedom (Cochran, Sampling
    Techniques, 1977, 6.3). Where no unit or every unit is all true, the interval is Wilson's with n = K.
    """
    inside = [np.asarray(each, bool) for each in inside if len(each)]
    units = len(inside)
    if not units:
        return []
    hits, sizes = np.array([[each.sum(), len(each)] for each in inside], float).T
    s = float(hits.sum() / sizes.sum())
    if units < 2 or s in (0.0, 1.0):
        return [MeasuredFigure(name, s, int(sizes.sum()), goal, wilson(round(s * units), units, level))]
    u = float(np.sqrt(units / (units - 1.0) * np.sum((hits - s * sizes) ** 2)) / sizes.sum())
    half = u * float(scipy.stats.t.ppf(0.5 + 0.5 * level, units - 1))
    return [MeasuredFigure(name, s, int(sizes.sum()), goal, (max(0.0, s - half), min(1.0, s + half)))]


def write_figures(path: Path | None, figures: Iterable[MeasuredFigure]) -> None:
    """Write the figures of a command as JSON; without a path, do nothing."""
    if path:
        path.write_text(json.dumps([figure.to_json() for figure in figures], indent=1) + "\n", encoding="utf-8")
