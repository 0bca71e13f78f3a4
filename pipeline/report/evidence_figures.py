"""The evidence of a diagnosis in pictures, from its binned data: nothing is fitted here.

Added-variable plot: readings against the column of one coefficient, both less what everything else explains; the line
through the origin has the coefficient as its slope. Points that leave the line say that the effect has another shape.

Unexplained: the residual against the covariate on which it depends, with the suggested shape.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.report.figure import JSON, UNITS, Figure, plain
from pipeline.report.numbers import MINUS, measured, number
from pipeline.report.shapes import Layer, Line, Means
from pipeline.report.svg import Panel, chart

if TYPE_CHECKING:
    from numpy.typing import NDArray

ON_THE_LINE = 3.0  # mean square of the points about the line, in standard errors
MOST = 0.97  # share of what the points show that a line must explain, where they leave it by more
COVARIATES = {
    "temperature": "temperature, degC",
    "time": "time since power-on, s",
    "speed": "magnitude of the angular rate, deg/s",
    "rate": "rate of the table, deg/s",
    "angle": "table angle, deg",
    **{f"f{a}": f"specific force along {a}, g" for a in "xyz"},
    **{f"w{a}": f"angular rate about {a}, deg/s" for a in "xyz"},
}


def added_variable(sensor: str, diagnosis: JSON) -> Figure | None:
    """Draw the added-variable plot of the first selected effect; None where the diagnosis holds none."""
    shown = (diagnosis.get("pictures") or {}).get("added_variable")
    if not shown or not shown["panels"]:
        return None
    unit, effect, panels = shown["unit"], plain(shown["effect"]), []
    arrays = [_arrays(p) for p in shown["panels"]]
    ends = np.array([min(float(a[0].min()) for a in arrays), max(float(a[0].max()) for a in arrays)])
    scatter, squares = [], np.zeros(2)
    for panel, (x, mean, error) in zip(shown["panels"], arrays, strict=True):
        colour = "xyz".index(panel["axis"])
        own = np.array([x.min(), x.max()]) if panel["value"] else ends
        layers: list[Layer] = [Line(own, panel["value"] * own, 5, "model"), Means(x, mean, 2.0 * error, colour)]
        panels.append(Panel(layers, f"{panel['axis']}, {unit}", 92, {"": 0.0}))
        weight = np.maximum(error, 1e-300) ** -2
        scatter.append(float(np.mean(weight * (mean - panel["value"] * x) ** 2)))
        squares += weight @ (mean - panel["value"] * x) ** 2, weight @ mean**2
    share = 1.0 - squares[0] / max(squares[1], 1e-300)
    best = max(shown["panels"], key=lambda p: abs(p["value"]) / max(p["standard_uncertainty"], 1e-300))
    straight = max(scatter) < ON_THE_LINE or share > MOST
    finding = f"{effect.capitalize()} shows: {_coefficient(best)}" + (
        ", and the points follow the line" if straight else "; some points leave the line"
    )
    names = {p["parameter"] for p in shown["panels"]}
    what = best["parameter"] if len(names) == 1 else "each parameter"
    slopes = "; ".join(dict.fromkeys(_coefficient(p) for p in shown["panels"]))
    svg = chart(
        f"{sensor}-added-variable",
        f"{sensor}: {finding}",
        f"Added-variable plot of {effect}. Slopes: {slopes}. Mean square of the points about the line, in standard "
        f"errors: {', '.join(number(s, 2) for s in scatter)}.",
        panels,
        _with_unit(f"what {what} multiplies, less all other columns", best["unit"], unit),
    )
    caption = (
        f"Readings less all that base, other effects and bias wander explain, in bins with ±2 standard errors; the "
        f"line's slope is the parameter ({slopes}; ± covers 95 %)."
    )
    return Figure(svg, caption, (("c5", "slope = parameter"),), finding)


def _arrays(panel: JSON) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    x, mean, error = (np.array(panel[key], float) for key in ("x", "mean", "standard_error"))
    return x, mean, error


def _coefficient(panel: JSON) -> str:
    unit = "" if panel["unit"] == "1" else f" {panel['unit']}"
    return f"{panel['parameter']} = {measured(panel['value'], 2.0 * panel['standard_uncertainty'])}{unit}"


def _with_unit(words: str, parameter: str, unit: str) -> str:
    name = column_unit(parameter, unit)
    return f"{words}, {name}" if name else words


def column_unit(parameter: str, unit: str) -> str:
    """Return the unit of the column that a parameter multiplies: that of the sensor over the parameter's.

    Parameters
    ----------
    parameter, unit : str
        Units of the parameter and of the sensor.
    """
    if parameter == unit:
        return ""
    if parameter == "1":
        return unit
    if parameter.startswith(f"{unit}/"):
        return parameter.removeprefix(f"{unit}/").removeprefix("(").removesuffix(")")
    if parameter.startswith("1/"):
        base, _, power = parameter.removeprefix("1/").partition("^")
        if base.strip("()") == unit:
            return f"{base}^{int(power or 1) + 1}"
        return f"{unit} {parameter.removeprefix('1/')}"
    return f"{unit}/{parameter}"


def unexplained(sensor: str, diagnosis: JSON) -> list[Figure]:
    """Draw the residual against each covariate on which it depends beyond all effects."""
    pictures = (diagnosis.get("pictures") or {}).get("unexplained") or []
    entries = {u["covariate"]: u for u in diagnosis.get("unexplained") or []}
    return [_unexplained(sensor, shown, entries.get(shown["covariate"], {})) for shown in pictures]


def _unexplained(sensor: str, shown: JSON, entry: JSON) -> Figure:
    unit, covariate, panels = shown["unit"], plain(shown["covariate"]), []
    for panel in shown["panels"]:
        x, mean, error = _arrays(panel)
        layers: list[Layer] = [Means(x, mean, 2.0 * error, "xyz".index(panel["axis"]))]
        if "curve" in panel:
            layers.insert(0, Line(np.array(panel["curve_x"], float), np.array(panel["curve"], float), 5, "model"))
        panels.append(Panel(layers, f"{panel['axis']}, {unit}", 76, {"": 0.0}))
    drawn = any("curve" in p for p in shown["panels"])
    followed = all(_about_curve(p) < ON_THE_LINE for p in shown["panels"] if "curve" in p)
    finding = f"The residual depends on {covariate}" + (f": {entry['shape']}" if entry.get("shape") else "")
    finding = finding.replace(" -", f" {MINUS}")
    reaches = [f"{p['axis']} up to {number(float(np.abs(p['mean']).max()))} {unit}" for p in shown["panels"]]
    svg = chart(
        f"{sensor}-unexplained-{shown['covariate']}",
        f"{sensor}: {finding}",
        f"Binned means of the residual: {', '.join(reaches)}.",
        panels,
        COVARIATES.get(shown["signal"], f"what the axis should read, {UNITS[sensor]}"),
        angle=shown["signal"] == "angle",
    )
    caption = (
        "Residual in bins, with ±2 standard errors of white noise and the expected bias wander"
        + ("; the line is the suggested shape, beside which base and effects were fitted again" if drawn else "")
        + (f" (ΔBIC {number(entry['delta_bic'])})" if entry.get("delta_bic") else "")
        + (". No effect of the catalogue explains it." if followed else ". The points do not follow it well.")
    )
    return Figure(svg, caption, (("c5", "suggested shape"),) if drawn else (), finding)


def _about_curve(panel: JSON) -> float:
    """Return the mean square of the points about the suggested shape, in standard errors."""
    x, mean, error = _arrays(panel)
    shape = np.interp(x, panel["curve_x"], panel["curve"])
    return float(np.mean(((mean - shape) / np.maximum(error, 1e-300)) ** 2))
