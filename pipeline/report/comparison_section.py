"""A comparison on the campaign's page: for each sensor, charts and tables of errors, and the parameters.

The groups are those that the configuration resolves (``pipeline.config.comparisons``). Errors are compared on held-out
motion, and where the recordings are simulated also against their truth, without the noise of the held-out samples.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from statistics import fmean
from typing import TYPE_CHECKING, Any

import pandas as pd

from pipeline.records import SENSOR_UNITS
from pipeline.report.chart import Figure
from pipeline.report.comparison import LEVEL, Compared, Group, compare, difference, finding, mean_of
from pipeline.report.group_charts import COLOURS, Point, bars, curves
from pipeline.report.numbers import MINUS, NOTHING, measured, number, plain, probability

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

JSON = dict[str, Any]
MEASURES = {"after": "rms error, held out", "truth": "rms error against the truth"}
FIGURES = (
    "unit", "sensor", "before", "u_before", "after", "u_after", "truth", "u_truth", "noise_floor", "table_time",
    "verdict", "parameters",
)  # fmt: skip


def section(comparison: JSON, figures: Sequence[JSON], name: str) -> JSON:
    """Return what the page shows of a comparison.

    Parameters
    ----------
    comparison : dict
        As ``pipeline.config.comparisons`` resolves it.
    figures : sequence of dict
        Of ``comparison.unit_figures``, of all units; failed units have none.
    name : str
        Identifier that is unique on the page.
    """
    frame, sensors = pd.DataFrame(list(figures), columns=list(FIGURES)).set_index("unit"), []
    for sensor in comparison["sensors"]:
        known = frame[frame["sensor"] == sensor]
        groups = [
            Group(
                g["name"],
                g["series"],
                g["label"],
                len(g["units"]),
                known.reindex([u for u in g["units"] if u in known.index]),
            )
            for g in comparison["groups"]
        ]
        compared = {m: c for m in MEASURES if (c := compare(groups, m, comparison["against"], comparison["pairs"]))}
        if compared:
            sensors.append({
                "sensor": sensor,
                "unit": SENSOR_UNITS[sensor],
                "measures": [
                    {
                        "name": m,
                        "title": MEASURES[m],
                        "figure": _figure(c, comparison, m, SENSOR_UNITS[sensor], f"{name}-{sensor}"),
                        "rows": [_row(one, m) for one in c],
                    }
                    for m, c in compared.items()
                ],
                "parameters": _parameters(groups, comparison["against"], comparison["pairs"]),
            })  # fmt: skip
    return {
        "title": comparison["title"],
        "against": comparison["against"],
        "paired": comparison["pairs"] is not None,
        "sensors": sensors,
        "groups": [(g["name"], g["units"]) for g in comparison["groups"]],
        "single": all(len(g["units"]) == 1 for g in comparison["groups"]),
    }


def _row(c: Compared, measure: str) -> JSON:
    """Return the line of a group in the table of a measure, as text."""
    count, (low, high), held_out = len(c.group.figures), c.interval, measure == "after"
    before, floor = c.group.mean("before"), c.group.mean("noise_floor") if held_out else None
    verdicts = Counter(plain(v) for v in c.group.figures["verdict"] if v)
    row = {
        "name": c.group.name,
        "count": f"{count}" + (f" of {c.group.asked}" if count < c.group.asked else ""),
        "before": number(before),
        "value": number(c.mean),
        "interval": f"{number(low)} to {number(high)}" if low < high else NOTHING,
        "floor": number(floor),
        "ratio": number(c.mean / floor if floor else None),
        "time": number(c.group.mean("table_time")),
        "verdicts": [f"{n} {v}" for v, n in verdicts.items()],
        "result": c.result,
    }
    if c.difference is None:
        return row | dict.fromkeys(("difference", "interval_of_difference", "significance", "p"), "")
    low, high = c.difference.interval
    return row | {
        "difference": _percent(c.difference.value),
        "interval_of_difference": f"{_percent(low)} to {_percent(high)}" if low < high else NOTHING,
        "significance": number(c.difference.significance, 2),
        "p": probability(c.p_value),
    }


def _percent(logarithm: float) -> str:
    """Return a ratio, given by its logarithm, as a change in percent, or where it is more than twofold as a factor."""
    if logarithm > math.log(2.0):
        return f"× {number(math.exp(logarithm))}"
    return f"{100.0 * math.expm1(logarithm):+.1f} %".replace("-", MINUS)


def _figure(compared: list[Compared], comparison: JSON, measure: str, unit: str, name: str) -> Figure:
    """Draw a measure: along the axis that the comparison names, or in rows."""
    x = comparison["x"]
    points = [p for c in compared if (p := _point(c, measure, x)) is not None]
    title = f"{MEASURES[measure]}, {unit}"
    words = ["Mean of each group with its 95 % interval; faint, its units."] * any(len(p.units) > 1 for p in points)
    words += ["Dashed: the error that noise alone gives."] * any(p.floor for p in points)
    told = finding([c.group for c in compared], measure, comparison["pairs"])
    figure = Figure(f"{name}-{measure}", told, " ".join(words))
    if x is None:
        return bars(figure, points, title)
    series = list(dict.fromkeys(p.series for p in points))
    legend = tuple((f"c{i % COLOURS}", s) for i, s in enumerate(series)) if len(series) > 1 else ()
    return curves(replace(figure, legend=legend), points, title, x["label"], named=x["named"])


def _point(c: Compared, measure: str, x: JSON | None) -> Point | None:
    """Return the point of a group; None where its place on the axis is not known."""
    at: float | None = 0.0
    if x is not None and x["values"] is None:
        at = c.group.mean("table_time")
    elif x is not None:
        at = fmean(x["values"][u] for u in c.group.figures.index)
    if at is None:
        return None
    units = tuple(v for v in c.group.figures[measure] if v and v > 0.0)
    floor = c.group.mean("noise_floor") if measure == "after" else None
    return Point(c.group.label, c.mean, 0, c.interval, units, floor, at, c.group.series)


def _parameters(groups: Sequence[Group], against: str, pairs: Mapping[str, str] | None) -> JSON:
    """Return each group's mean parameters, and their differences over the standard uncertainty.

    ``names`` of the parameters, and ``rows`` of ``name`` and ``cells``: value, difference over its standard
    uncertainty, and whether equal parameters would exceed it in less than 5 % of cases.
    """
    names = list(dict.fromkeys(n for g in groups for each in g.figures["parameters"] for n in each))
    reference = next(g for g in groups if g.name == against)
    rows = []
    for group in groups:
        cells = []
        for name in names:
            own, other = group.parameter(name), reference.parameter(name)
            mean = mean_of(own["value"], own["u"])
            change = difference(own, other, pairs) if group is not reference and len(own) and len(other) else None
            value = NOTHING
            if mean is not None:
                U = mean.expanded_uncertainty
                value = measured(mean.value, U) if U else number(mean.value)
            significance = number(change.significance, 2) if change else ""
            p_value = change.p_value if change else None
            beyond = p_value is not None and p_value < LEVEL
            cells.append({"value": value, "significance": significance, "beyond": beyond})
        rows.append({"name": group.name, "cells": cells})
    return {"names": names, "rows": rows}
