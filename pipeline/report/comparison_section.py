"""A comparison on the campaign's page: for each sensor, charts and tables of errors, and the parameters.

The groups are those that the configuration resolves (``pipeline.config.comparisons``). Errors are compared on held-out
motion, and where the recordings are simulated also against their truth, without the noise of the held-out samples.
The noise sigma of N held-out samples makes their rms error e uncertain by

    u(e)^2 = sigma^2 (2 e^2 - sigma^2) / (2 N e^2),

since the mean of (d_k + n_k)^2 has the variance (4 mean(d^2) sigma^2 + 2 sigma^4) / N, with mean(d^2) = e^2 - sigma^2.
How far another recording would differ is not in it. The error against the truth is

    e^2 = a^2 |M K - 1|_F^2 / 3 + |M (b - b_hat)|^2

with the calibration M, b_hat, the truth K, b of ``reading = b + K truth`` and the rms motion a (g or deg/s).
"""

from __future__ import annotations

import math
from dataclasses import replace
from statistics import fmean
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from pipeline.records import SENSOR_UNITS, SENSORS
from pipeline.report.chart import Figure
from pipeline.report.comparison import LEVEL, Compared, compare, difference, finding, logarithms, mean_of
from pipeline.report.group_charts import COLOURS, Point, bars, curves
from pipeline.report.held_out_section import first_and_last_step
from pipeline.report.numbers import measured, number
from pipeline.report.parameters import fitted_parameters

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

JSON = dict[str, Any]
MEASURES = {"after": "rms error, held out", "truth": "rms error against the truth"}
FIGURES = (
    "unit", "sensor", "before", "u_before", "after", "u_after", "truth", "u_truth", "noise_floor", "table_time",
    "verdict", "parameters",
)  # fmt: skip


def unit_figures(calibration: JSON, validation: JSON, diagnosis: JSON | None) -> list[JSON]:
    """Return what is compared of a unit, a dict for each calibrated sensor; None becomes missing.

    ``unit, sensor``; rms errors ``before`` and ``after`` with the standard uncertainty ``u_<name>`` (g or deg/s);
    ``truth`` is that of ``against_truth``; ``noise_floor``; ``reference_rms``; ``table_time``, the length of the
    recordings of the fit (s); ``verdict``; ``parameters``: name to Parameter.
    """
    rows = []
    for sensor in SENSORS:
        part, held_out = calibration.get(sensor), validation.get(sensor)
        if part and held_out:
            before, after = (step.get("rms_error") for step in first_and_last_step(held_out))
            inputs = [i for i in calibration.get("inputs") or [] if i.get("role") in (sensor, "rests")]
            rows.append({
                "unit": calibration["unit"],
                "sensor": sensor,
                "before": before,
                "u_before": _noise_of_error(before, held_out),
                "after": after,
                "u_after": _noise_of_error(after, held_out),
                "truth": None,
                "u_truth": None,
                "noise_floor": held_out.get("noise_floor"),
                "reference_rms": held_out.get("reference_rms"),
                "table_time": sum(i.get("duration_s") or 0.0 for i in inputs) or None,
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


def against_truth(figures: JSON, truth: JSON) -> float | None:
    """Return the rms error against the truth of simulated recordings, ``truth/<unit>.json`` of the sensor."""
    if figures["reference_rms"] is None:
        return None
    values = np.array([p.value for p in figures["parameters"].values()][:12])
    matrix = values[3:].reshape(3, 3)
    left = matrix @ np.linalg.inv(np.array(truth["matrix"], float)) - np.eye(3)
    bias = matrix @ (np.array(truth["bias"], float) - values[:3])
    return float(np.sqrt(figures["reference_rms"] ** 2 * np.sum(left**2) / 3.0 + np.sum(bias**2)))


def section(comparison: JSON, figures: Sequence[JSON], name: str) -> JSON:
    """Return what the page shows of a comparison, as ``pipeline.config.comparisons`` resolves it.

    ``figures``: ``unit_figures`` of all units, failed units have none; ``name``: an identifier, unique on the page.
    """
    frame = pd.DataFrame(list(figures), columns=list(FIGURES)).set_index("unit")
    against, pairs, sensors = comparison["against"], comparison["pairs"], []
    for sensor in comparison["sensors"]:
        known, unit = frame[frame["sensor"] == sensor], SENSOR_UNITS[sensor]
        units = {g["name"]: known.loc[[u for u in g["units"] if u in known.index]] for g in comparison["groups"]}
        measures = []
        for m, title in MEASURES.items():
            groups = {name: logarithms(own, m) for name, own in units.items()}
            compared = compare(groups, against, pairs)
            rows = [_row(g, units[g["name"]], c, m) for g in comparison["groups"] if (c := compared.get(g["name"]))]
            if rows:
                told = finding(groups, pairs)
                figure = _figure(rows, told, comparison, f"{title}, {unit}", f"{name}-{sensor}-{m}")
                measures.append({"name": m, "title": title, "figure": figure, "rows": rows})
        if measures:
            parameters = _parameters(units, against, pairs)
            sensors.append({"sensor": sensor, "unit": unit, "measures": measures, "parameters": parameters})
    return {
        "title": comparison["title"],
        "against": against,
        "paired": pairs is not None,
        "sensors": sensors,
        "groups": [(g["name"], g["units"]) for g in comparison["groups"]],
        "single": all(len(g["units"]) == 1 for g in comparison["groups"]),
    }


def _row(group: JSON, units: pd.DataFrame, compared: Compared, measure: str) -> JSON:
    """Return what the page shows of a group and a measure; ``units``: the figures of its calibrated units."""
    verdicts = units["verdict"]
    return {
        "name": group["name"],
        "measure": measure,
        "group": group,
        "units": units,
        "compared": compared,
        "verdicts": verdicts[verdicts != ""].value_counts(sort=False),
        "floor": _mean(units["noise_floor"]) if measure == "after" else None,
        **{name: _mean(units[name]) for name in ("before", "table_time")},
    }


def _mean(values: pd.Series[float]) -> float | None:
    """Return the geometric mean of the positive values."""
    values = pd.to_numeric(values)
    values = values[values > 0.0]
    return float(np.exp(np.log(values).mean())) if len(values) else None


def _figure(rows: Sequence[JSON], told: str, comparison: JSON, title: str, name: str) -> Figure:
    """Draw a measure: along the axis that the comparison names, or in rows."""
    x = comparison["x"]
    points = [p for row in rows if (p := _point(row, x)) is not None]
    words = ["Mean of each group with its 95 % interval; faint, its units."] * any(len(p.units) > 1 for p in points)
    words += ["Dashed: the error that noise alone gives."] * any(p.floor for p in points)
    figure = Figure(name, told, " ".join(words))
    if x is None:
        return bars(figure, points, title)
    series = list(dict.fromkeys(p.series for p in points))
    legend = tuple((f"c{i % COLOURS}", s) for i, s in enumerate(series)) if len(series) > 1 else ()
    return curves(replace(figure, legend=legend), points, title, x["label"], named=x["named"])


def _point(row: JSON, x: JSON | None) -> Point | None:
    """Return the point of a group; None where its place on the axis is not known."""
    units, compared, at = row["units"], row["compared"], 0.0
    if x is not None:
        at = row["table_time"] if x["values"] is None else fmean(x["values"][u] for u in units.index)
    if at is None:
        return None
    each, group = tuple(v for v in units[row["measure"]] if v and v > 0.0), row["group"]
    return Point(group["label"], compared.mean, 0, compared.interval, each, row["floor"], at, group["series"])


def _parameters(units: Mapping[str, pd.DataFrame], against: str, pairs: Mapping[str, str] | None) -> JSON:
    """Return each group's mean parameters, and their differences over the standard uncertainty.

    ``names`` of the parameters, and ``rows`` of ``name`` and ``cells``: value, difference over its standard
    uncertainty, and whether equal parameters would exceed it in less than 5 % of cases.
    """
    names = list(dict.fromkeys(n for own in units.values() for each in own["parameters"] for n in each))
    rows = []
    for group, own in units.items():
        cells = []
        for name in names:
            values = _of_units(own, name)
            mean, change = (
                mean_of(values["value"], values["u"]),
                difference(values, _of_units(units[against], name), pairs),
            )
            U = mean.expanded_uncertainty
            if group == against:
                change = replace(change, standard_uncertainty=math.nan)
            cells.append({
                "value": measured(mean.value, U) if U > 0.0 else number(mean.value),
                "significance": "" if math.isnan(change.significance) else number(change.significance, 2),
                "beyond": change.p_value < LEVEL,
            })  # fmt: skip
        rows.append({"name": group, "cells": cells})
    return {"names": names, "rows": rows}


def _of_units(figures: pd.DataFrame, name: str) -> pd.DataFrame:
    """Return ``value`` and ``u`` of a fitted parameter for each unit that has it."""
    found = {unit: each[name] for unit, each in figures["parameters"].items() if name in each}
    rows = [(p.value, p.standard_uncertainty) for p in found.values()]
    return pd.DataFrame(rows, list(found), ["value", "u"], dtype=float)
