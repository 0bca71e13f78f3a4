"""Groups of units against each other: what each leaves of the error, and how surely two of them differ.

Errors are above zero and differ by factors, between devices more than between procedures; so their logarithms are
compared. The mean of a group is the geometric mean, a difference is a ratio:

    ln m = sum(ln e_i) / n,    100 (m_1 / m_2 - 1) %

where e_i is the error of unit i. The figures of each unit are those of ``comparison_units``, the statistics those of
``comparison_statistics``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import geometric_mean
from typing import TYPE_CHECKING

from pipeline.report.comparison_statistics import LEVEL, Estimate, Quantity, adjusted, difference, mean_of
from pipeline.report.numbers import number

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.report.comparison_units import SensorFigures


@dataclass(frozen=True)
class Group:
    """A group and what is known of its units' figures of one sensor.

    Attributes
    ----------
    name, series, label : str
        Its name; its curve and its name on that curve.
    units : dict of str to SensorFigures
        Those that were calibrated.
    asked : int
        Units that it has, failed ones included.
    """

    name: str
    series: str
    label: str
    units: dict[str, SensorFigures]
    asked: int

    def quantities(self, measure: str) -> dict[str, Quantity]:
        """Return a measure (``before``, ``after``, ``truth``) of each unit that has it."""
        return {u: q for u, f in self.units.items() if (q := getattr(f, measure)) is not None and q.value > 0.0}

    def logarithms(self, measure: str) -> dict[str, Quantity]:
        """Return the measure's natural logarithms."""
        return {u: _logarithm(q) for u, q in self.quantities(measure).items()}

    def mean(self, name: str) -> float | None:
        """Return the geometric mean of ``noise_floor`` or ``table_time``."""
        known = [v for f in self.units.values() if (v := getattr(f, name))]
        return geometric_mean(known) if known else None


@dataclass(frozen=True)
class Compared:
    """One group against the one that it is compared with.

    Attributes
    ----------
    group : Group
    logarithm : Estimate
        Of the measure's mean.
    difference : Estimate or None
        Of its logarithm from the other group's; None for that group itself.
    p_value : float or None
        Of the difference, adjusted for the number of groups.
    """

    group: Group
    logarithm: Estimate
    difference: Estimate | None = None
    p_value: float | None = None

    @property
    def mean(self) -> float:
        """Return the geometric mean, g or deg/s."""
        return math.exp(self.logarithm.value)

    @property
    def interval(self) -> tuple[float, float]:
        """Return the interval of the mean that covers 95 %, g or deg/s; the mean alone where nothing is known of it."""
        low, high = self.logarithm.interval
        return math.exp(low), math.exp(high)

    @property
    def text(self) -> str:
        """Return mean and interval as people read them."""
        low, high = self.interval
        return number(self.mean) + (f" ({number(low)} to {number(high)})" if low < high else "")


def compare(groups: Sequence[Group], measure: str, against: str, pairs: Mapping[str, str] | None) -> list[Compared]:
    """Compare each group's measure with that of the group ``against``; groups without it are left out.

    Parameters
    ----------
    groups : sequence of Group
    measure : str
        ``before``, ``after`` or ``truth``.
    against : str
        Name of a group; of none, and there are no differences.
    pairs : mapping of str to str, optional
        Unit to what it shares with its pair.
    """
    own = {g.name: g.logarithms(measure) for g in groups}
    reference = own.get(against) or {}
    differences = {
        g.name: difference(own[g.name], reference, pairs) if g.name != against and own[g.name] and reference else None
        for g in groups
    }
    p_values = adjusted([d.p_value if d else None for d in differences.values()])
    out = []
    for group, change, p in zip(groups, differences.values(), p_values, strict=True):
        estimate = mean_of(own[group.name].values())
        if estimate is not None:
            out.append(Compared(group, estimate, change, p))
    return out


def result(change: Estimate, p_value: float | None) -> str:
    """Return in a word what a difference says; nothing where its uncertainty is not known."""
    if p_value is None:
        return ""
    if p_value > LEVEL:
        return "not told apart"
    return "smaller" if change.value < 0 else "larger"


def finding(groups: Sequence[Group], measure: str, pairs: Mapping[str, str] | None) -> str:
    """Return in a sentence which group has the smallest mean, and which are not told apart from it.

    Parameters
    ----------
    groups, measure, pairs
        As of ``compare``; at least one group has the measure.
    """
    best = min(compare(groups, measure, "", None), key=lambda c: c.mean)
    text = f"Smallest with {best.group.name}: {best.text}"
    others = [c for c in compare(groups, measure, best.group.name, pairs) if c.p_value is not None]
    near = [c.group.name for c in others if (c.p_value or 0.0) > LEVEL]
    if not others:
        return text
    if not near:
        return f"{text}; all others are larger"
    named = ", ".join(near) if len(near) <= 4 else f"{len(near)} of {len(others)} others"
    return f"{text}; not told apart from it: {named}"


def _logarithm(quantity: Quantity) -> Quantity:
    relative = quantity.standard_uncertainty
    return Quantity(math.log(quantity.value), None if relative is None else relative / quantity.value)
