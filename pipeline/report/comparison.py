"""Comparison of groups of units: means and differences with their uncertainties.

Errors are positive and differ by factors, so their logarithms are compared: the mean of a group is the geometric mean,
a difference is a ratio. Of n units with values v_i, the mean and its standard uncertainty are

    m = sum(v_i) / n,    u^2 = sum((v_i - m)^2) / (n (n - 1)),    n - 1 degrees of freedom,

and of one unit its own value and uncertainty. The difference of two groups is

    d = m_1 - m_2,    u^2 = u_1^2 + u_2^2,    (u_1^4 / (n_1 - 1) + u_2^4 / (n_2 - 1)) / u^4 = 1 / degrees of freedom,

or, where units come in pairs (one device, calibrated in two ways), the mean of the differences within the pairs. Where
a group has one unit only, or there is one pair, the units' own uncertainties replace the scatter. The p-value is that
of Student's t = d / u, multiplied as Holm asks for where several groups are compared with one.

Sources: B. L. Welch, Biometrika 34 (1947) 28-35 (degrees of freedom); S. Holm, Scandinavian Journal of Statistics 6
(1979) 65-70; JCGM 100:2008, 4.2.3 (mean of repeated observations).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from pipeline.report.numbers import number

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import ArrayLike

LEVEL = 0.05  # of a test, and 1 minus the coverage of an interval (JCGM 100:2008, 6.2.2: about 95 %)


@dataclass(frozen=True)
class Estimate:
    """A mean or a difference with its standard uncertainty; NaN where it is not known.

    The degrees of freedom are infinite where the units' own uncertainties were used instead of their scatter.
    """

    value: float
    standard_uncertainty: float
    degrees_of_freedom: float
    count: int

    @property
    def expanded_uncertainty(self) -> float:
        """Half the interval that covers 95 %."""
        from scipy.special import stdtrit  # noqa: PLC0415  (only where a campaign compares)

        return self.standard_uncertainty * float(stdtrit(self.degrees_of_freedom, 1.0 - LEVEL / 2.0))

    @property
    def interval(self) -> tuple[float, float]:
        """The interval that covers 95 %; without an uncertainty the value alone."""
        half = float(np.nan_to_num(self.expanded_uncertainty))
        return self.value - half, self.value + half

    @property
    def significance(self) -> float:
        """The value over its standard uncertainty."""
        return self.value / (self.standard_uncertainty or math.nan)

    @property
    def p_value(self) -> float:
        """The probability of so large a value where the truth is zero."""
        from scipy.special import stdtr  # noqa: PLC0415  (as above)

        return 2.0 * float(stdtr(self.degrees_of_freedom, -abs(self.significance)))


def mean_of(values: ArrayLike, uncertainties: ArrayLike = math.nan) -> Estimate:
    """Return the mean of (n,) values from their scatter, or the only one with its own standard uncertainty.

    An unknown uncertainty is NaN, as is the mean of no values.
    """
    v = np.asarray(values, float)
    if v.size < 2:
        alone, u = (float(np.append(a, math.nan)[0]) for a in (v, uncertainties))
        return Estimate(alone, u, math.inf, v.size)
    return Estimate(float(v.mean()), float(v.std(ddof=1) / math.sqrt(v.size)), v.size - 1.0, v.size)


def difference(first: pd.DataFrame, second: pd.DataFrame, pairs: Mapping[str, str] | None = None) -> Estimate:
    """Return the mean of ``first`` minus that of ``second``: columns ``value`` and ``u`` (NaN: unknown) by unit.

    ``pairs``: unit to what it shares with its pair; differences are then taken within the pairs.
    """
    if pairs is not None:
        a, b = (_averages(group, pairs) for group in (first, second))
        devices = a.index.intersection(b.index, sort=False)
        return mean_of((a["value"] - b["value"])[devices], np.hypot(a["u"], b["u"])[devices])
    means = [mean_of(group["value"], group["u"]) for group in (first, second)]
    value, count = means[0].value - means[1].value, means[0].count + means[1].count
    if min(m.count for m in means) > 1:
        squares = [m.standard_uncertainty**2 for m in means]
        total = sum(squares)
        terms = sum(square**2 / m.degrees_of_freedom for square, m in zip(squares, means, strict=True))
        return Estimate(value, math.sqrt(total), total**2 / terms if total else math.inf, count)
    own = math.hypot(*(_of_mean(group["u"]) for group in (first, second)))
    return Estimate(value, own, math.inf, count)


def _averages(values: pd.DataFrame, pairs: Mapping[str, str]) -> pd.DataFrame:
    """Return the mean of the units of each device, with what their own uncertainties make of it."""
    devices = values.groupby(values.index.map(pairs), sort=False)
    return pd.DataFrame({"value": devices["value"].mean(), "u": devices["u"].agg(_of_mean)})


def _of_mean(uncertainties: pd.Series[float]) -> float:
    """Return the standard uncertainty of the mean of independent values."""
    return float(np.linalg.norm(uncertainties)) / max(len(uncertainties), 1)


def adjusted(p_values: Sequence[float]) -> list[float]:
    """Return the p-values of several comparisons, adjusted by Holm's step-down method; NaN does not count."""
    known = pd.Series(p_values, dtype=float).dropna().sort_values()
    holm = (known * np.arange(len(known), 0, -1)).clip(upper=1.0).cummax()
    adjusted_values: list[float] = holm.reindex(range(len(p_values))).tolist()
    return adjusted_values


@dataclass(frozen=True)
class Compared:
    """The mean logarithm of a group, and its difference from the reference group with the adjusted p-value."""

    logarithm: Estimate
    difference: Estimate | None
    p_value: float

    @property
    def mean(self) -> float:
        """The geometric mean, g or deg/s."""
        return math.exp(self.logarithm.value)

    @property
    def interval(self) -> tuple[float, float]:
        """The interval of the mean that covers 95 %, g or deg/s."""
        low, high = self.logarithm.interval
        return math.exp(low), math.exp(high)

    @property
    def result(self) -> str:
        """What the difference shows; empty where its uncertainty is not known."""
        if self.difference is None or math.isnan(self.p_value):
            return ""
        if self.p_value > LEVEL:
            return "not told apart"
        return "smaller" if self.difference.value < 0 else "larger"


def logarithms(figures: pd.DataFrame, measure: str) -> pd.DataFrame:
    """Return ``value`` and ``u`` of ln(measure) for each unit that has it; ``figures``: a row a unit."""
    value, u = (pd.to_numeric(figures[name]) for name in (measure, f"u_{measure}"))
    known = value > 0.0
    return pd.DataFrame({"value": np.log(value[known]), "u": u[known] / value[known]})


def compare(
    groups: Mapping[str, pd.DataFrame], against: str, pairs: Mapping[str, str] | None = None
) -> dict[str, Compared]:
    """Compare the logarithms of each group, as of ``logarithms``, with those of the group ``against``.

    Groups without values are left out; without a group of that name there are no differences.
    """
    known = {name: values for name, values in groups.items() if len(values)}
    changes = {
        name: difference(values, known[against], pairs) if against in known and name != against else None
        for name, values in known.items()
    }
    p_values = adjusted([change.p_value if change else math.nan for change in changes.values()])
    return {
        name: Compared(mean_of(values["value"], values["u"]), changes[name], p)
        for (name, values), p in zip(known.items(), p_values, strict=True)
    }


def finding(groups: Mapping[str, pd.DataFrame], pairs: Mapping[str, str] | None) -> str:
    """Return which group has the smallest mean, and which are not told apart from it."""
    compared = compare(groups, "")
    best = min(compared, key=lambda name: compared[name].mean)
    low, high = compared[best].interval
    said = f"Smallest with {best}: {number(compared[best].mean)}"
    said += f" ({number(low)} to {number(high)})" if low < high else ""
    others = {name: c for name, c in compare(groups, best, pairs).items() if c.result}
    near = [name for name, c in others.items() if c.p_value > LEVEL]
    if not others:
        return said
    if not near:
        return f"{said}; all others are larger"
    named = ", ".join(near) if len(near) <= 4 else f"{len(near)} of {len(others)} others"
    return f"{said}; not told apart from it: {named}"
