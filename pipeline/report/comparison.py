"""Comparison of groups of units: means and differences with their uncertainties.

Errors are positive and differ by factors, so their logarithms are compared: the mean of a group is the geometric mean,
a difference is a ratio. Of n units with values v_i, the mean and its standard uncertainty are

    m = sum(v_i) / n,    u^2 = sum((v_i - m)^2) / (n (n - 1)),    n - 1 degrees of freedom,

and of one unit its own value and uncertainty. The difference of two groups is

    d = m_1 - m_2,    u^2 = u_1^2 + u_2^2,    (u_1^4 / (n_1 - 1) + u_2^4 / (n_2 - 1)) / u^4 = 1 / degrees of freedom,

or, where units come in pairs (one device, calibrated in two ways), the mean of the differences within the pairs. Where
a group has one unit only, or there is one pair, the units' own uncertainties replace the scatter. The p-value is that
of Student's t = d / u, multiplied as Holm asks for where several groups are compared with one.

The noise sigma of N held-out samples makes their rms error e uncertain by

    u(e)^2 = sigma^2 (2 e^2 - sigma^2) / (2 N e^2),

since the mean of (d_k + n_k)^2 has the variance (4 mean(d^2) sigma^2 + 2 sigma^4) / N, with mean(d^2) = e^2 - sigma^2.
How far another recording would differ is not in it. Where recordings are simulated, the error against their truth is

    e^2 = a^2 |M K - 1|_F^2 / 3 + |M (b - b_hat)|^2

with the calibration M, b_hat, the truth K, b of ``reading = b + K truth`` and the rms motion a (g or deg/s).

Sources: B. L. Welch, Biometrika 34 (1947) 28-35 (degrees of freedom); S. Holm, Scandinavian Journal of Statistics 6
(1979) 65-70; JCGM 100:2008, 4.2.3 (mean of repeated observations).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from pipeline.records import SENSORS
from pipeline.report.held_out_section import first_and_last_step
from pipeline.report.numbers import number
from pipeline.report.parameters import fitted_parameters

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from numpy.typing import ArrayLike

JSON = dict[str, Any]
LEVEL = 0.05  # of a test, and 1 minus the coverage of an interval


@dataclass(frozen=True)
class Estimate:
    """A mean or a difference with its standard uncertainty; None where it is not known.

    The degrees of freedom are infinite where the units' own uncertainties were used instead of their scatter.
    """

    value: float
    standard_uncertainty: float | None
    degrees_of_freedom: float
    count: int

    @property
    def expanded_uncertainty(self) -> float | None:
        """Half the interval that covers 95 %."""
        if self.standard_uncertainty is None:
            return None
        from scipy.special import stdtrit  # noqa: PLC0415  (only where a campaign compares)

        return self.standard_uncertainty * float(stdtrit(self.degrees_of_freedom, 1.0 - LEVEL / 2.0))

    @property
    def interval(self) -> tuple[float, float]:
        """The interval that covers 95 %; without an uncertainty the value alone."""
        half = self.expanded_uncertainty or 0.0
        return self.value - half, self.value + half

    @property
    def significance(self) -> float | None:
        """The value over its standard uncertainty."""
        return self.value / self.standard_uncertainty if self.standard_uncertainty else None

    @property
    def p_value(self) -> float | None:
        """The probability of so large a value where the truth is zero."""
        if self.significance is None:
            return None
        from scipy.special import stdtr  # noqa: PLC0415  (as above)

        return 2.0 * float(stdtr(self.degrees_of_freedom, -abs(self.significance)))


def mean_of(values: ArrayLike, uncertainties: ArrayLike = np.nan) -> Estimate | None:
    """Return the mean of (n,) values from their scatter, or the only one with its own standard uncertainty.

    None where there is no value; an unknown uncertainty is NaN.
    """
    v = np.asarray(values, float)
    if v.size == 0:
        return None
    if v.size == 1:
        u = float(np.ravel(uncertainties)[0])
        return Estimate(float(v[0]), None if math.isnan(u) else u, math.inf, 1)
    return Estimate(float(v.mean()), float(v.std(ddof=1) / math.sqrt(v.size)), v.size - 1.0, v.size)


def difference(first: pd.DataFrame, second: pd.DataFrame, pairs: Mapping[str, str] | None = None) -> Estimate | None:
    """Return the mean of ``first`` minus that of ``second``; None where it is not defined.

    Parameters
    ----------
    first, second : DataFrame
        Columns ``value`` and ``u`` (NaN: unknown) by unit.
    pairs : mapping of str to str, optional
        Unit to what it shares with its pair; differences are then taken within the pairs.
    """
    if pairs is not None:
        one_way, other_way = _averages(first, pairs), _averages(second, pairs)
        devices = one_way.index.intersection(other_way.index, sort=False)
        a, b = one_way.loc[devices], other_way.loc[devices]
        return mean_of(a["value"] - b["value"], np.hypot(a["u"], b["u"]))
    one, other = mean_of(first["value"], first["u"]), mean_of(second["value"], second["u"])
    if one is None or other is None:
        return None
    value, count = one.value - other.value, one.count + other.count
    if min(one.count, other.count) > 1:
        u, v = one.standard_uncertainty or 0.0, other.standard_uncertainty or 0.0
        total = math.hypot(u, v)
        freedom = total**4 / (u**4 / one.degrees_of_freedom + v**4 / other.degrees_of_freedom) if total else math.inf
        return Estimate(value, total, freedom, count)
    own = math.hypot(*(math.hypot(*group["u"]) / len(group) for group in (first, second)))
    return Estimate(value, None if math.isnan(own) else own, math.inf, count)


def _averages(values: pd.DataFrame, pairs: Mapping[str, str]) -> pd.DataFrame:
    """Return the mean of the units of each device, with what their own uncertainties make of it."""
    devices = values.groupby(values.index.map(pairs), sort=False)
    own = devices["u"].agg(lambda u: math.hypot(*u) / len(u))
    return pd.DataFrame({"value": devices["value"].mean(), "u": own})


def adjusted(p_values: Sequence[float | None]) -> list[float | None]:
    """Return the p-values of several comparisons, adjusted by Holm's step-down method; None does not count."""
    known = pd.Series(p_values, dtype=float).dropna().sort_values()
    holm = (known * np.arange(len(known), 0, -1)).clip(upper=1.0).cummax()
    return [holm.get(i) for i in range(len(p_values))]


def unit_figures(
    calibration: JSON, validation: JSON | None, diagnosis: JSON | None, truth: JSON | None = None
) -> list[JSON]:
    """Return what is compared of a unit, a dict for each calibrated sensor.

    Parameters
    ----------
    calibration, validation, diagnosis : dict or None
        As in their files.
    truth : dict, optional
        ``truth/<unit>.json`` of the recordings, where they are simulated.

    Returns
    -------
    list of dict
        ``unit, sensor``; rms errors ``before``, ``after`` and ``truth`` (against the truth) with the standard
        uncertainty ``u_<name>`` (g or deg/s); ``noise_floor``; ``table_time``, the length of the recordings of the
        fit (s); ``verdict``; ``parameters``: name to Parameter.
    """
    rows = []
    for sensor in SENSORS:
        part, held_out = calibration.get(sensor), (validation or {}).get(sensor)
        if part and held_out:
            before, after = (step.get("rms_error") for step in first_and_last_step(held_out))
            used = [i.get("duration_s") for i in calibration.get("inputs") or [] if i.get("role") in (sensor, "rests")]
            rows.append({
                "unit": calibration["unit"],
                "sensor": sensor,
                "before": before,
                "u_before": _noise_of_error(before, held_out),
                "after": after,
                "u_after": _noise_of_error(after, held_out),
                "truth": _against_truth(part, held_out, (truth or {}).get(sensor)),
                "u_truth": None,
                "noise_floor": held_out.get("noise_floor"),
                "table_time": sum(duration for duration in used if duration is not None) or None,
                "verdict": ((diagnosis or {}).get(sensor) or {}).get("verdict") or "",
                "parameters": {p.words: p for p in fitted_parameters(part)},
            })  # fmt: skip
    return rows


def _noise_of_error(error: float | None, held_out: JSON) -> float | None:
    """Return the standard uncertainty of a held-out error by the noise of its samples."""
    floor, samples = held_out.get("noise_floor"), held_out.get("samples")
    if not error or not floor or not samples:
        return None
    noise = min(floor, error) ** 2
    return math.sqrt(noise * (2.0 * error**2 - noise) / (2.0 * samples)) / error


def _against_truth(part: JSON, held_out: JSON, truth: JSON | None) -> float | None:
    size = held_out.get("reference_rms")
    if truth is None or size is None:
        return None
    matrix = np.array(part["matrix"], float)
    left = matrix @ np.linalg.inv(np.array(truth["matrix"], float)) - np.eye(3)
    bias = matrix @ (np.array(truth["bias"], float) - np.array(part["bias"], float))
    return float(np.sqrt(size**2 * np.sum(left**2) / 3.0 + np.sum(bias**2)))


@dataclass(frozen=True)
class Group:
    """A group of a comparison and the figures of its units for one sensor.

    Attributes
    ----------
    name, series, label : str
        Its name; its curve and its name on that curve.
    asked : int
        Units that it has, failed ones included.
    figures : DataFrame
        Rows of ``unit_figures`` by unit: those that were calibrated.
    """

    name: str
    series: str
    label: str
    asked: int
    figures: pd.DataFrame

    def logarithms(self, measure: str) -> pd.DataFrame:
        """Return ``value`` and ``u`` of ln(measure) for each unit that has it."""
        value, u = (pd.to_numeric(self.figures[name]) for name in (measure, f"u_{measure}"))
        known = value > 0.0
        return pd.DataFrame({"value": np.log(value[known]), "u": u[known] / value[known]})

    def mean(self, name: str) -> float | None:
        """Return the geometric mean of a figure."""
        values = pd.to_numeric(self.figures[name])
        values = values[values > 0.0]
        return float(np.exp(np.log(values).mean())) if len(values) else None

    def parameter(self, name: str) -> pd.DataFrame:
        """Return ``value`` and ``u`` of a fitted parameter for each unit that has it."""
        found = {unit: each[name] for unit, each in self.figures["parameters"].items() if name in each}
        u = [np.nan if p.standard_uncertainty is None else p.standard_uncertainty for p in found.values()]
        return pd.DataFrame({"value": [p.value for p in found.values()], "u": u}, index=list(found), dtype=float)


@dataclass(frozen=True)
class Compared:
    """The mean logarithm of a group, and its difference from the reference group with the adjusted p-value."""

    group: Group
    logarithm: Estimate
    difference: Estimate | None = None
    p_value: float | None = None

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
    def text(self) -> str:
        """Mean and interval for a sentence."""
        low, high = self.interval
        return number(self.mean) + (f" ({number(low)} to {number(high)})" if low < high else "")

    @property
    def result(self) -> str:
        """What the difference shows; empty where its uncertainty is not known."""
        if self.difference is None or self.p_value is None:
            return ""
        if self.p_value > LEVEL:
            return "not told apart"
        return "smaller" if self.difference.value < 0 else "larger"


def compare(
    groups: Iterable[Group], measure: str, against: str, pairs: Mapping[str, str] | None = None
) -> list[Compared]:
    """Compare each group's measure (``before``, ``after``, ``truth``) with that of the group ``against``.

    Groups without the measure are left out; without a group of that name there are no differences.
    """
    own = {g.name: (g, g.logarithms(measure)) for g in groups}
    means = {name: (group, mean) for name, (group, v) in own.items() if (mean := mean_of(v["value"], v["u"]))}
    reference = own[against][1] if against in means else None
    changes = [
        difference(own[name][1], reference, pairs) if reference is not None and name != against else None
        for name in means
    ]
    p_values = adjusted([change.p_value if change else None for change in changes])
    return [Compared(*found, change, p) for found, change, p in zip(means.values(), changes, p_values, strict=True)]


def finding(groups: Sequence[Group], measure: str, pairs: Mapping[str, str] | None) -> str:
    """Return which group has the smallest mean, and which are not told apart from it."""
    best = min(compare(groups, measure, ""), key=lambda c: c.mean)
    said = f"Smallest with {best.group.name}: {best.text}"
    others = [c for c in compare(groups, measure, best.group.name, pairs) if c.p_value is not None]
    near = [c.group.name for c in others if (c.p_value or 0.0) > LEVEL]
    if not others:
        return said
    if not near:
        return f"{said}; all others are larger"
    named = ", ".join(near) if len(near) <= 4 else f"{len(near)} of {len(others)} others"
    return f"{said}; not told apart from it: {named}"
