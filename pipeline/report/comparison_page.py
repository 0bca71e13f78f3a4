"""A comparison on the page of its campaign: per sensor, figures and tables of errors, and the parameters.

The groups are those that the configuration resolves (``pipeline.config.comparisons``). Errors are compared on held-out
motion, and where the recordings are simulated also against the truth behind them, which the noise of the held-out
samples does not blur.
"""

from __future__ import annotations

import math
from collections import Counter
from statistics import fmean
from typing import TYPE_CHECKING, Any

from pipeline.report.comparison import Compared, Group, compare, finding, result
from pipeline.report.comparison_chart import COLOURS, Point, curve, rows
from pipeline.report.comparison_statistics import LEVEL, Estimate, difference, mean_of
from pipeline.report.figure import UNITS, Figure
from pipeline.report.numbers import NOTHING, measured, number, probability

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.report.comparison_units import SensorFigures

JSON = dict[str, Any]
MEASURES = {"after": "rms error, held out", "truth": "rms error against the truth"}


def section(comparison: JSON, figures: Mapping[str, Mapping[str, SensorFigures]], name: str) -> JSON:
    """Return what the page shows of a comparison.

    Parameters
    ----------
    comparison : dict
        As ``pipeline.config.comparisons`` resolves it.
    figures : mapping of str to mapping
        Unit to its figures per sensor; failed units have none.
    name : str
        Identifier that is unique on the page.
    """
    sensors = []
    for sensor in comparison["sensors"]:
        groups = [_group(g, sensor, figures) for g in comparison["groups"]]
        compared = {m: c for m in MEASURES if (c := compare(groups, m, comparison["against"], comparison["pairs"]))}
        if compared:
            sensors.append(_sensor(sensor, comparison, groups, compared, f"{name}-{sensor}"))
    return {
        "title": comparison["title"],
        "against": comparison["against"],
        "paired": comparison["pairs"] is not None,
        "sensors": sensors,
        "groups": [(g["name"], g["units"]) for g in comparison["groups"]],
        "single": all(len(g["units"]) == 1 for g in comparison["groups"]),
    }


def _group(group: JSON, sensor: str, figures: Mapping[str, Mapping[str, SensorFigures]]) -> Group:
    known = {u: figures[u][sensor] for u in group["units"] if sensor in figures.get(u, {})}
    return Group(group["name"], group["series"], group["label"], known, len(group["units"]))


def _sensor(sensor: str, comparison: JSON, groups: list[Group], compared: dict[str, list[Compared]], name: str) -> JSON:
    unit, pairs = UNITS[sensor], comparison["pairs"]
    return {
        "sensor": sensor,
        "unit": unit,
        "measures": [
            {"name": m, "title": MEASURES[m], "figure": _figure(c, comparison, m, unit, name), "rows": _rows(c, m)}
            for m, c in compared.items()
        ],
        "parameters": parameter_table(groups, comparison["against"], pairs),
    }


def _rows(compared: list[Compared], measure: str) -> list[JSON]:
    """Return the lines of a measure's table, as text."""
    return [
        {
            "name": c.group.name,
            "count": f"{len(c.group.units)}" + (f" of {c.group.asked}" if len(c.group.units) < c.group.asked else ""),
            "before": _mean_text(c.group, "before"),
            "value": number(c.mean),
            "interval": _interval(c),
            "floor": number(c.group.mean("noise_floor")) if measure == "after" else NOTHING,
            "ratio": _ratio(c.mean, c.group.mean("noise_floor")) if measure == "after" else NOTHING,
            "time": number(c.group.mean("table_time")),
            "verdicts": [f"{n} {v}" for v, n in Counter(_verdicts(c.group)).items()],
            **_difference(c),
        }
        for c in compared
    ]


def _interval(compared: Compared) -> str:
    low, high = compared.interval
    return f"{number(low)} to {number(high)}" if low < high else NOTHING


def _difference(compared: Compared) -> JSON:
    change = compared.difference
    if change is None:
        return {"difference": "", "interval_of_difference": "", "significance": "", "p": "", "result": ""}
    low, high = change.interval
    return {
        "difference": _percent(change.value),
        "interval_of_difference": f"{_percent(low)} to {_percent(high)}" if low < high else NOTHING,
        "significance": number(change.significance, 2),
        "p": probability(compared.p_value),
        "result": result(change, compared.p_value),
    }


def _percent(logarithm: float) -> str:
    """Return a ratio, given by its logarithm, as a change in percent, or where it is more than twofold as a factor."""
    if logarithm > math.log(2.0):
        return f"× {number(math.exp(logarithm))}"
    return f"{100.0 * math.expm1(logarithm):+.1f} %".replace("-", "\N{MINUS SIGN}")


def _mean_text(group: Group, measure: str) -> str:
    mean = mean_of(group.logarithms(measure).values())
    return number(math.exp(mean.value)) if mean else NOTHING


def _ratio(value: float, floor: float | None) -> str:
    return number(value / floor) if floor else NOTHING


def _verdicts(group: Group) -> list[str]:
    return [f.verdict.replace("_", " ") for f in group.units.values() if f.verdict]


def _figure(compared: list[Compared], comparison: JSON, measure: str, unit: str, name: str) -> Figure:
    """Draw a measure: along the axis that the comparison names, or in rows."""
    x = comparison["x"]
    points = [p for c in compared if (p := _point(c, measure, x)) is not None]
    title, several = f"{MEASURES[measure]}, {unit}", any(len(p.units) > 1 for p in points)
    words = ["Mean of each group with its 95 % interval; faint, its units."] * several
    words += ["Dashed: what noise alone would leave."] * any(p.floor for p in points)
    legend: tuple[tuple[str, str], ...] = ()
    told = finding([c.group for c in compared], measure, comparison["pairs"])
    if x is None:
        svg = rows(f"{name}-{measure}", title, points, title)
    else:
        svg = curve(f"{name}-{measure}", title, points, title, x["label"], labelled=x["named"])
        series = list(dict.fromkeys(p.series for p in points))
        legend = tuple((f"c{i % COLOURS}", s) for i, s in enumerate(series)) if len(series) > 1 else ()
    return Figure(svg, " ".join(words), legend, told)


def _point(compared: Compared, measure: str, x: JSON | None) -> Point | None:
    group = compared.group
    at: float | None = 0.0
    if x is not None:
        at = group.mean("table_time") if x["values"] is None else fmean(x["values"][u] for u in group.units)
    if at is None:
        return None
    return Point(
        group.label,
        compared.mean,
        compared.interval,
        tuple(q.value for q in group.quantities(measure).values()),
        group.mean("noise_floor") if measure == "after" else None,
        at,
        group.series,
    )


def parameter_table(groups: Sequence[Group], against: str, pairs: Mapping[str, str] | None) -> JSON:
    """Return each group's mean parameters, and their differences over the standard uncertainty.

    Parameters
    ----------
    groups : sequence of Group
    against : str
    pairs : mapping of str to str, optional

    Returns
    -------
    dict
        ``names`` of the parameters, and ``rows`` of ``name`` and ``cells``: value, difference over its standard
        uncertainty, and whether it is beyond what 5 % of equal parameters reach.
    """
    names = list(dict.fromkeys(n for g in groups for f in g.units.values() for n in f.parameters))
    values = {
        g.name: {n: {u: f.parameters[n] for u, f in g.units.items() if n in f.parameters} for n in names}
        for g in groups
    }
    reference = values[against]
    lines = []
    for group in groups:
        cells = []
        for n in names:
            own = values[group.name][n]
            mean = mean_of(own.values())
            change = difference(own, reference[n], pairs) if own and reference[n] and group.name != against else None
            cells.append(
                {
                    "value": _parameter(mean),
                    "significance": number(change.significance, 2) if change else "",
                    "beyond": change is not None and (change.p_value or 1.0) < LEVEL,
                }
            )
        lines.append({"name": group.name, "cells": cells})
    return {"names": names, "rows": lines}


def _parameter(mean: Estimate | None) -> str:
    if mean is None:
        return NOTHING
    return measured(mean.value, mean.expanded_uncertainty) if mean.expanded_uncertainty else number(mean.value)
