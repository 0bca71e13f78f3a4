"""Comparison of groups of units on the campaign's page: means and differences with uncertainties, charts and tables.

The groups are those that the configuration resolves (``pipeline.app.config.campaign``). Errors are positive and differ
by factors, so their logarithms are compared: the mean of a group is the geometric mean, a difference is a ratio. Of n
units with values v_i, the mean and its standard uncertainty are

    m = sum(v_i) / n,    u^2 = sum((v_i - m)^2) / (n (n - 1)),    n - 1 degrees of freedom,

and of one unit its value and uncertainty. The difference of two groups is

    d = m_1 - m_2,    u^2 = u_1^2 + u_2^2,    (u_1^4 / (n_1 - 1) + u_2^4 / (n_2 - 1)) / u^4 = 1 / degrees of freedom,

or, for pairs of units (one device, calibrated in two ways), the mean of the differences within the pairs. Where a group
has one unit only, or there is one pair, the stated uncertainties replace the scatter. The p-value is that of Student's
t = d / u, adjusted by Holm's method where several groups are compared with one.

Errors are compared on held-out motion, and for simulated recordings also against the true parameters, without the noise
of the held-out samples. The noise sigma of N held-out samples makes their rms error e uncertain by

    u(e)^2 = sigma^2 (2 e^2 - sigma^2) / (2 N e^2),

because the mean of (d_k + n_k)^2 has the variance (4 mean(d^2) sigma^2 + 2 sigma^4) / N, where mean(d^2) is
e^2 - sigma^2. For the error of the vector, whose noise has the variance sigma^2 / 3 along each axis, N is three times
the number of samples. It does not contain the variation between recordings. The error against the truth is

    e^2 = a^2 |M K - 1|_F^2 / 3 + |M (b - b_hat)|^2

with the calibration M, b_hat, the truth K, b of ``reading = b + K truth`` and the rms motion a (g or deg/s).

Sources: B. L. Welch, Biometrika 34 (1947) 28-35 (degrees of freedom); S. Holm, Scandinavian Journal of Statistics 6
(1979) 65-70; JCGM 100:2008, 4.2.3 (mean of repeated observations).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import fmean

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from pipeline.core.files import JSON
from pipeline.core.records import BASE, BIAS, SENSOR_UNITS, SENSORS, matrix_of
from pipeline.core.verdicts import Error, error_of
from pipeline.output.pages.chart import Figure
from pipeline.output.pages.group_charts import COLOURS, Point, bars, curves
from pipeline.output.pages.pages import measured, number
from pipeline.output.pages.parameters import fitted_parameters

TEST_LEVEL = 0.05  # of a test, and 1 minus the coverage of an interval (JCGM 100:2008, 6.2.2: about 95 %)
MEASURES = {"after": "rms error, held out", "truth": "rms error against the truth"}
FIGURE_COLUMNS = (
    "unit", "sensor", "before", "after", "u_after", "truth", "u_truth", "noise_floor", "table_time", "verdict",
    "parameters",
)  # fmt: skip


@dataclass(frozen=True)
class MeanWithUncertainty:
    """A mean or a difference with its standard uncertainty; NaN where it is unknown.

    The degrees of freedom are infinite where the stated uncertainties were used instead of the scatter.
    """

    value: float
    standard_uncertainty: float
    degrees_of_freedom: float
    count: int

    @property
    def expanded_uncertainty(self) -> float:
        """Half the width of the 95 % interval."""
        from scipy.special import stdtrit  # noqa: PLC0415  (only where a campaign compares)

        return self.standard_uncertainty * float(stdtrit(self.degrees_of_freedom, 1.0 - TEST_LEVEL / 2.0))

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % interval; without an uncertainty both ends are the value."""
        half = float(np.nan_to_num(self.expanded_uncertainty))
        return self.value - half, self.value + half

    @property
    def significance(self) -> float:
        """The value over its standard uncertainty."""
        return self.value / (self.standard_uncertainty or math.nan)

    @property
    def p_value(self) -> float:
        """The probability of a value of this size or larger where the truth is zero."""
        from scipy.special import stdtr  # noqa: PLC0415  (as above)

        return 2.0 * float(stdtr(self.degrees_of_freedom, -abs(self.significance)))


def mean_of(values: ArrayLike, uncertainties: ArrayLike = math.nan) -> MeanWithUncertainty:
    """Return the mean of (n,) values with the uncertainty by their scatter; a single value keeps its uncertainty.

    An unknown uncertainty and the mean of no values are NaN.
    """
    v = np.asarray(values, float)
    if v.size < 2:
        alone, u = (float(np.append(a, math.nan)[0]) for a in (v, uncertainties))
        return MeanWithUncertainty(alone, u, math.inf, v.size)
    return MeanWithUncertainty(float(v.mean()), float(v.std(ddof=1) / math.sqrt(v.size)), v.size - 1.0, v.size)


def difference(
    first: pd.DataFrame, second: pd.DataFrame, pairs: Mapping[str, str] | None = None
) -> MeanWithUncertainty:
    """Return the mean of ``first`` minus the mean of ``second``: columns ``value`` and ``u`` (NaN: unknown) by unit.

    ``pairs``: unit to device; with it the differences are those within the devices, each by the mean of its units.
    """
    if pairs is not None:
        a, b = (_by_device(group, pairs) for group in (first, second))
        devices = [device for device in a if device in b]
        changes = np.array([[a[d][0] - b[d][0], math.hypot(a[d][1], b[d][1])] for d in devices]).reshape(-1, 2)
        return mean_of(*changes.T)
    means = [mean_of(group["value"], group["u"]) for group in (first, second)]
    value, count = means[0].value - means[1].value, means[0].count + means[1].count
    if min(m.count for m in means) > 1:
        squares = [m.standard_uncertainty**2 for m in means]
        total = sum(squares)
        terms = sum(square**2 / m.degrees_of_freedom for square, m in zip(squares, means, strict=True))
        return MeanWithUncertainty(value, math.sqrt(total), total**2 / terms if total else math.inf, count)
    stated = math.hypot(*(_of_mean(group["u"]) for group in (first, second)))
    return MeanWithUncertainty(value, stated, math.inf, count)


def _by_device(group: pd.DataFrame, pairs: Mapping[str, str]) -> dict[str, tuple[float, float]]:
    """Return the mean of the units of each device, with its standard uncertainty."""
    rows: dict[str, list[tuple[float, float]]] = {}
    for unit, value, u in zip(group.index, group["value"].tolist(), group["u"].tolist(), strict=True):
        if unit in pairs:
            rows.setdefault(pairs[unit], []).append((value, u))
    return {d: (fmean(v for v, _ in units), _of_mean([u for _, u in units])) for d, units in rows.items()}


def _of_mean(uncertainties: ArrayLike) -> float:
    """Return the standard uncertainty of the mean of independent values."""
    return float(np.linalg.norm(u := np.asarray(uncertainties))) / max(u.size, 1)


def adjusted(p_values: Sequence[float]) -> list[float]:
    """Return the p-values of several comparisons, adjusted by Holm's step-down method; NaN is ignored."""
    known = pd.Series(p_values, dtype=float).dropna().sort_values()
    holm = (known * np.arange(len(known), 0, -1)).clip(upper=1.0).cummax()
    adjusted_values: list[float] = holm.reindex(range(len(p_values))).tolist()
    return adjusted_values


@dataclass(frozen=True)
class Compared:
    """The mean logarithm of a group, and its difference from the reference group with the adjusted p-value."""

    logarithm: MeanWithUncertainty
    difference: MeanWithUncertainty | None
    p_value: float

    @property
    def mean(self) -> float:
        """The geometric mean, g or deg/s."""
        return math.exp(self.logarithm.value)

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % interval of the mean, g or deg/s."""
        low, high = self.logarithm.interval
        return math.exp(low), math.exp(high)

    @property
    def result(self) -> str:
        """The result of the test of the difference; empty where its uncertainty is unknown."""
        if self.difference is None or math.isnan(self.p_value):
            return ""
        if self.p_value > TEST_LEVEL:
            return "not told apart"
        return "smaller" if self.difference.value < 0 else "larger"


def logarithms(figures: pd.DataFrame, measure: str) -> pd.DataFrame:
    """Return ``value`` and ``u`` of ln(measure) for each unit with this measure; ``figures``: one row a unit."""
    value, u = (pd.to_numeric(figures[name]) for name in (measure, f"u_{measure}"))
    known = value > 0.0
    return pd.DataFrame({"value": np.log(value[known]), "u": u[known] / value[known]})


def compare(
    groups: Mapping[str, pd.DataFrame], against: str, pairs: Mapping[str, str] | None = None
) -> dict[str, Compared]:
    """Compare the logarithms of each group (``logarithms``) with those of the group ``against``.

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
    """Return a sentence: the group with the smallest mean, and the groups that are not significantly larger."""
    compared = compare(groups, "")
    best = min(compared, key=lambda name: compared[name].mean)
    low, high = compared[best].interval
    text = f"Smallest with {best}: {number(compared[best].mean)}"
    text += f" ({number(low)} to {number(high)})" if low < high else ""
    others = {name: c for name, c in compare(groups, best, pairs).items() if c.result}
    near = [name for name, c in others.items() if c.p_value > TEST_LEVEL]
    if not others:
        return text
    if not near:
        return f"{text}; all others are larger"
    named = ", ".join(near) if len(near) <= 4 else f"{len(near)} of {len(others)} others"
    return f"{text}; not told apart from it: {named}"


def unit_figures(calibration: JSON, validation: JSON, diagnosis: JSON | None) -> list[JSON]:
    """Return the figures of a unit for comparisons, a dict for each calibrated sensor.

    It has ``unit, sensor``; rms errors ``before`` and ``after`` and standard uncertainty ``u_after``, g or deg/s;
    ``noise_floor``; ``reference_rms``; ``table_time``, the length of the recordings of the fit (s); ``verdict``;
    ``parameters``: name to Parameter. For simulated recordings ``truth`` is added (``against_truth``).
    """
    rows = []
    for sensor in SENSORS:
        part, held_out = calibration.get(sensor), validation.get(sensor)
        if part and held_out:
            error = error_of(held_out)
            inputs = [i for i in calibration.get("inputs") or [] if i.get("role") in (sensor, "rests")]
            rows.append({
                "unit": calibration["unit"],
                "sensor": sensor,
                "before": error.before,
                "after": error.after,
                "u_after": _noise_of_error(error, held_out),
                "noise_floor": error.floor,
                "reference_rms": held_out.get("reference_rms"),
                "table_time": sum(i.get("duration_s") or 0.0 for i in inputs) or None,
                "verdict": ((diagnosis or {}).get(sensor) or {}).get("verdict") or "",
                "parameters": {p.words: p for p in fitted_parameters(part)},
            })  # fmt: skip
    return rows


def _noise_of_error(error: Error, held_out: JSON) -> float | None:
    """Return the standard uncertainty of a held-out error by the noise of its samples."""
    rms, samples = error.after, (held_out.get("samples") or 0) * (3 if error.kind == "vector" else 1)
    if not rms or not error.floor or not samples:
        return None
    noise = min(error.floor, rms) ** 2
    return math.sqrt(noise * (2.0 * rms**2 - noise) / (2.0 * samples)) / rms


def against_truth(figures: JSON, truth: JSON) -> float | None:
    """Return the rms error against the true parameters of a simulated sensor (its part of ``truth/<unit>.json``)."""
    if figures["reference_rms"] is None:
        return None
    values = np.array([p.value for p in figures["parameters"].values()][BASE])
    matrix = matrix_of(values)
    error = matrix @ np.linalg.inv(np.array(truth["matrix"], float)) - np.eye(3)
    bias = matrix @ (np.array(truth["bias"], float) - values[BIAS])
    return float(np.sqrt(figures["reference_rms"] ** 2 * np.sum(error**2) / 3.0 + np.sum(bias**2)))


def section(comparison: JSON, figures: Sequence[JSON], name: str) -> JSON:
    """Return the data of a comparison, as ``pipeline.app.config.campaign`` resolves it, for the page.

    ``figures``: ``unit_figures`` of all units, none of failed ones; ``name``: an identifier, unique on the page.
    """
    frame = pd.DataFrame(list(figures), columns=list(FIGURE_COLUMNS)).set_index("unit")
    against, pairs, sensors = comparison["against"], comparison["pairs"], []
    for sensor in comparison["sensors"]:
        known, unit = frame[frame["sensor"] == sensor], SENSOR_UNITS[sensor]
        units = {g["name"]: known.loc[[u for u in g["units"] if u in known.index]] for g in comparison["groups"]}
        measures = []
        for m, title in MEASURES.items():
            groups = {group: logarithms(members, m) for group, members in units.items()}
            compared = compare(groups, against, pairs)
            rows = [_row(g, units[g["name"]], c, m) for g in comparison["groups"] if (c := compared.get(g["name"]))]
            if rows:
                sentence = finding(groups, pairs)
                figure = _figure(rows, sentence, comparison, f"{title}, {unit}", f"{name}-{sensor}-{m}")
                measures.append({"name": m, "title": title, "figure": figure, "rows": rows})
        if measures:
            parameters = _parameters(units, against, pairs)
            sensors.append({"sensor": sensor, "unit": unit, "measures": measures, "parameters": parameters})
    members = [(g["name"], g["units"]) for g in comparison["groups"]]
    found = {"title": comparison["title"], "against": against, "paired": pairs is not None, "sensors": sensors}
    return found | {"groups": members, "single": all(len(of) == 1 for _, of in members)}


def _row(group: JSON, units: pd.DataFrame, compared: Compared, measure: str) -> JSON:
    """Return the row of a group and a measure on the page; ``units``: the figures of its calibrated units."""
    verdicts = units["verdict"]
    about = {"name": group["name"], "measure": measure, "group": group, "units": units, "compared": compared}
    floor = _mean(units["noise_floor"]) if measure == "after" else None
    about |= {"verdicts": verdicts[verdicts != ""].value_counts(sort=False), "floor": floor}
    return about | {name: _mean(units[name]) for name in ("before", "table_time")}


def _mean(values: pd.Series[float]) -> float | None:
    """Return the geometric mean of the positive values."""
    values = pd.to_numeric(values)
    values = values[values > 0.0]
    return float(np.exp(np.log(values).mean())) if len(values) else None


def _figure(rows: Sequence[JSON], sentence: str, comparison: JSON, title: str, name: str) -> Figure:
    """Draw a measure: along the axis of the comparison, where the position of a group on it is known, or in rows."""
    x, points = comparison["x"], []
    for row in rows:
        units, at, group = row["units"], 0.0, row["group"]
        if x is not None:
            at = row["table_time"] if x["values"] is None else fmean(x["values"][u] for u in units.index)
        each, compared = tuple(v for v in units[row["measure"]] if v and v > 0.0), row["compared"]
        point = (group["label"], compared.mean, 0, compared.interval, each, row["floor"], at, group["series"])
        points += [Point(*point)] if at is not None else []
    words = ["Mean of each group with its 95 % interval; faint, its units."] * any(len(p.units) > 1 for p in points)
    words += ["Dashed: the error that noise alone gives."] * any(p.floor for p in points)
    figure = Figure(name, sentence, " ".join(words))
    if x is None:
        return bars(figure, points, title)
    series = list(dict.fromkeys(p.series for p in points))
    legend = tuple((f"c{i % COLOURS}", s) for i, s in enumerate(series)) if len(series) > 1 else ()
    return curves(figure._replace(legend=legend), points, title, x["label"], named=x["named"])


def _parameters(units: Mapping[str, pd.DataFrame], against: str, pairs: Mapping[str, str] | None) -> JSON:
    """Return the mean parameters of each group, and their differences over the standard uncertainty.

    The result has ``names`` of the parameters, and ``rows`` of ``name`` and ``cells``: value, difference over its
    standard uncertainty, and whether equal parameters would exceed it in less than 5 % of cases.
    """
    names = list(dict.fromkeys(n for members in units.values() for each in members["parameters"] for n in each))
    rows = []
    for group, members in units.items():
        cells = []
        for name in names:
            values = _of_units(members, name)
            mean = mean_of(values["value"], values["u"])
            change, U = difference(values, _of_units(units[against], name), pairs), mean.expanded_uncertainty
            if group == against:
                change = replace(change, standard_uncertainty=math.nan)
            cells.append({
                "value": measured(mean.value, U) if U > 0.0 else number(mean.value),
                "significance": "" if math.isnan(change.significance) else number(change.significance, 2),
                "beyond": change.p_value < TEST_LEVEL,
            })  # fmt: skip
        rows.append({"name": group, "cells": cells})
    return {"names": names, "rows": rows}


def _of_units(figures: pd.DataFrame, name: str) -> pd.DataFrame:
    """Return ``value`` and ``u`` of a fitted parameter for each unit with this parameter."""
    found = {unit: each[name] for unit, each in figures["parameters"].items() if name in each}
    rows = [(p.value, p.standard_uncertainty) for p in found.values()]
    return pd.DataFrame(rows, list(found), ["value", "u"], dtype=float)
