"""Differences of groups of units, with their uncertainties.

Of a group with n units, the mean and its standard uncertainty are

    m = sum(v_i) / n,    u^2 = sum((v_i - m)^2) / (n (n - 1)),    n - 1 degrees of freedom,

and of one unit alone, its own value and uncertainty. The difference of two groups is

    d = m_1 - m_2,    u^2 = u_1^2 + u_2^2,    (u_1^4 / (n_1 - 1) + u_2^4 / (n_2 - 1)) / u^4 = 1 / degrees of freedom,

or, where units come in pairs (one device, calibrated in two ways), the mean of the differences within the pairs, which
what the devices have in common does not disturb. Where a group has one unit only, or there is one pair, the units' own
uncertainties stand in for the scatter. The p-value is that of Student's t = d / u; where several groups are compared
with one, each is multiplied as Holm asks for.

where

v_i : value of unit i
u   : standard uncertainty

Sources: B. L. Welch, Biometrika 34 (1947) 28-35 (degrees of freedom); S. Holm, Scandinavian Journal of Statistics 6
(1979) 65-70; JCGM 100:2008, 4.2.3 (mean of repeated observations).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

LEVEL = 0.05


@dataclass(frozen=True)
class Quantity:
    """A value of one unit, with its own standard uncertainty where that is known."""

    value: float
    standard_uncertainty: float | None = None


@dataclass(frozen=True)
class Estimate:
    """A mean or a difference.

    Attributes
    ----------
    value : float
    standard_uncertainty : float or None
        None where nothing is known of it.
    degrees_of_freedom : float
        Infinite where the units' own uncertainties were taken.
    count : int
        Units, or pairs of them.
    scatter : bool
        Whether the uncertainty is from the scatter of several units.
    """

    value: float
    standard_uncertainty: float | None
    degrees_of_freedom: float
    count: int
    scatter: bool

    @property
    def expanded_uncertainty(self) -> float | None:
        """Return half the interval that covers 95 %."""
        if self.standard_uncertainty is None:
            return None
        from scipy.special import ndtri, stdtrit  # noqa: PLC0415  (only where a campaign compares)

        share = 1.0 - LEVEL / 2.0
        finite = math.isfinite(self.degrees_of_freedom)
        return self.standard_uncertainty * float(stdtrit(self.degrees_of_freedom, share) if finite else ndtri(share))

    @property
    def interval(self) -> tuple[float, float]:
        """Return the interval that covers 95 %; without an uncertainty the value alone."""
        half = self.expanded_uncertainty or 0.0
        return self.value - half, self.value + half

    @property
    def significance(self) -> float | None:
        """Return the value over its standard uncertainty."""
        return self.value / self.standard_uncertainty if self.standard_uncertainty else None

    @property
    def p_value(self) -> float | None:
        """Return how probable so large a value is where the truth is zero."""
        if self.significance is None:
            return None
        from scipy.special import ndtr, stdtr  # noqa: PLC0415  (only where a campaign compares)

        t, dof = -abs(self.significance), self.degrees_of_freedom
        return 2.0 * float(stdtr(dof, t) if math.isfinite(dof) else ndtr(t))


def mean_of(values: Iterable[Quantity]) -> Estimate | None:
    """Return the mean of a group; None where it has no unit with a value."""
    values = list(values)
    n = len(values)
    if n == 0:
        return None
    if n == 1:
        return Estimate(values[0].value, values[0].standard_uncertainty, math.inf, 1, scatter=False)
    mean = sum(v.value for v in values) / n
    variance = sum((v.value - mean) ** 2 for v in values) / (n * (n - 1))
    return Estimate(mean, math.sqrt(variance), n - 1.0, n, scatter=True)


def difference(
    first: Mapping[str, Quantity], second: Mapping[str, Quantity], pairs: Mapping[str, str] | None = None
) -> Estimate | None:
    """Return the mean of ``first`` minus that of ``second``; None where it cannot be had.

    Parameters
    ----------
    first, second : mapping of str to Quantity
        Values by unit.
    pairs : mapping of str to str, optional
        Unit to what it shares with its pair; differences are then taken within the pairs.
    """
    if pairs is not None:
        of_first, of_second = _means_by_key(first, pairs), _means_by_key(second, pairs)
        return mean_of(_minus(of_first[key], of_second[key]) for key in of_first if key in of_second)
    one, other = mean_of(first.values()), mean_of(second.values())
    if one is None or other is None:
        return None
    if one.scatter and other.scatter:
        u, v = one.standard_uncertainty or 0.0, other.standard_uncertainty or 0.0
        total = math.hypot(u, v)
        freedom = total**4 / (u**4 / one.degrees_of_freedom + v**4 / other.degrees_of_freedom) if total else math.inf
        return Estimate(one.value - other.value, total, freedom, one.count + other.count, scatter=True)
    own = _minus(_own(first.values()), _own(second.values()))
    return Estimate(own.value, own.standard_uncertainty, math.inf, one.count + other.count, scatter=False)


def adjusted(p_values: Sequence[float | None]) -> list[float | None]:
    """Return the p-values of several comparisons, adjusted by Holm's step-down method.

    Parameters
    ----------
    p_values : sequence of float or None
        None stays None and does not count.
    """
    order = sorted((i for i, p in enumerate(p_values) if p is not None), key=lambda i: p_values[i] or 0.0)
    out: list[float | None] = [None] * len(p_values)
    largest = 0.0
    for place, i in enumerate(order):
        largest = max(largest, min(1.0, (len(order) - place) * (p_values[i] or 0.0)))
        out[i] = largest
    return out


def _means_by_key(values: Mapping[str, Quantity], pairs: Mapping[str, str]) -> dict[str, Quantity]:
    by_key: dict[str, list[Quantity]] = {}
    for unit, value in values.items():
        by_key.setdefault(pairs[unit], []).append(value)
    return {key: _own(members) for key, members in by_key.items()}


def _own(values: Iterable[Quantity]) -> Quantity:
    """Return the mean with what the units' own uncertainties make of it."""
    values = list(values)
    own = [v.standard_uncertainty for v in values]
    known = [u for u in own if u is not None]
    uncertainty = math.hypot(*known) / len(values) if len(known) == len(values) else None
    return Quantity(sum(v.value for v in values) / len(values), uncertainty)


def _minus(first: Quantity, second: Quantity) -> Quantity:
    u, v = first.standard_uncertainty, second.standard_uncertainty
    return Quantity(first.value - second.value, None if u is None or v is None else math.hypot(u, v))
