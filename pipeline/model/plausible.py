"""Fitted parameters that no sensor of the configured model has: nearly always another range, unit or column.

    reading = bias + K truth + ...,    K = matrix^-1 = P R

where

    P : (3, 3) symmetric, ``(K K^T)^(1/2)``: scale factors on its diagonal, cross-axis sensitivities beside it
    R : (3, 3) rotation, of the unit against the table or its case: no property of the sensor

A parameter p with the expanded uncertainty U and the data-sheet limit L is implausible where

    |p| - 2 U > max(4 L, F)

A data sheet states L as a bound, or as one standard deviation. Four of these are exceeded by a good sensor's 12
parameters in 12 * 6.3e-5 = 0.08 % of units; 2 U are four standard uncertainties. F is what a low-cost sensor is allowed
(MPU-6000/6050 product specification 3.4, relative to its range): the sheet of a better one holds for its own mounting
and its own bench, and the STIM300 of the founding thesis departs from its sheet by 17 L in bias and 10 L in scale
factor.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import ConfigurationError
from pipeline.model.effects import effect_of
from pipeline.model.effects.base import parameter_limits
from pipeline.records import AXES, SENSOR_UNITS, FittedEffect

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

MULTIPLE = 4.0  # see above
LOW_COST_BIAS = {"accelerometer": 0.08 / 2.0, "gyroscope": 20.0 / 250.0}  # share of the range, see above
LOW_COST_SCALE, LOW_COST_CROSS = 0.03, 0.02  # see above
EQUAL_SPREAD = 0.1  # relative spread of the three scale factors that have one cause
NEAR = 0.03  # relative distance from a factor by which it is recognised, as a low-cost scale factor's limit
FACTORS = {
    "accelerometer": {
        9.80665: "in m/s^2, and read as g",
        1000.0: "in mg, and read as g",
        1.0 / 9.80665: "in g, and read as m/s^2",
    },
    "gyroscope": {
        np.pi / 180.0: "in rad/s, and read as deg/s",
        180.0 / np.pi: "in deg/s, and read as rad/s",
        1000.0: "in mdeg/s, and read as deg/s",
        1.0 / 6.0: "in revolutions a minute, and read as deg/s",
    },
}
RANGES = [2.0**n for n in range(-6, 7) if n]  # ratios of the ranges of one sensor: neighbours differ by two
OF_BIAS = "an offset of raw counts that is not taken off, another column, or a damaged axis"
OF_CROSS_AXIS = "another column or axis map, or a unit that moved on the table between recordings"
OF_EFFECT = "another effect that looks alike, or an error of the table, its log or the time stamps"

Entry = dict[str, Any]
Row = tuple[str, float, float, str, float, float, str]  # name, value, uncertainty, unit, limit, floor, likely cause


def implausible(sensor: str, part: Mapping[str, Any], sheet: Mapping[str, Any]) -> list[Entry]:
    """Return the fitted parameters of a sensor that are beyond its data sheet, the largest ratio first.

    ``part`` is the sensor's part of ``calibrations/<unit>.json``, ``sheet`` its part of the configuration. An entry has
    ``parameter``, ``value``, ``unit``, ``limit`` of the data sheet, ``ratio`` of the two and ``likely_cause``.
    """
    entries = [
        {"parameter": name, "value": value, "unit": unit, "limit": limit, "ratio": abs(value) / limit,
         "likely_cause": cause}
        for name, value, uncertainty, unit, limit, floor, cause in (
            *_of_bias_and_matrix(sensor, part, sheet), *_of_effects(sensor, part, sheet["effects"])
        )
        if abs(value) - 2.0 * uncertainty > max(MULTIPLE * limit, floor)
    ]  # fmt: skip
    return sorted(entries, key=lambda entry: -entry["ratio"])


def _of_bias_and_matrix(sensor: str, part: Mapping[str, Any], sheet: Mapping[str, Any]) -> Iterator[Row]:
    """Yield the rows of biases, scale factors and cross-axis sensitivities."""
    K = np.linalg.inv(np.array(part["matrix"], float))
    squares, axes = np.linalg.eigh(K @ K.T)
    P = (axes * np.sqrt(squares)) @ axes.T
    spread = part["expanded_uncertainty"]
    of_matrix = np.abs(K) @ np.array(spread["matrix"], float) @ np.abs(K)  # dK = -K dM K
    floor, unit = LOW_COST_BIAS[sensor] * sheet["full_scale"], SENSOR_UNITS[sensor]
    for a, value, uncertainty in zip(AXES, part["bias"], spread["bias"], strict=True):
        yield f"bias_{a}", float(value), float(uncertainty), unit, sheet["bias"], floor, OF_BIAS
    scale, limit = _scale_cause(sensor, np.diag(P)), sheet["scale_factor"]
    for i, a in enumerate(AXES):
        yield f"scale_factor_{a}", float(P[i, i] - 1.0), float(of_matrix[i, i]), "1", limit, LOW_COST_SCALE, scale
    for i, j in ((0, 1), (0, 2), (1, 2)):
        name, limit = f"cross_axis_{AXES[i]}{AXES[j]}", sheet["cross_axis"]
        yield name, float(P[i, j]), float(of_matrix[i, j]), "1", limit, LOW_COST_CROSS, OF_CROSS_AXIS


def _of_effects(sensor: str, part: Mapping[str, Any], limits: Mapping[str, float]) -> Iterator[Row]:
    """Yield the rows of the effects' parameters that have an uncertainty and a limit."""
    for entry in part["effects"]:
        try:
            effect = effect_of(FittedEffect(entry["name"], entry["parameters"], entry.get("definition")))
        except ConfigurationError:
            continue  # in Python, and not loaded here: its limits are not known
        sizes = parameter_limits(effect, sensor, limits)
        for (symbol, p), limit in zip(entry["parameters"].items(), sizes, strict=True):
            spread = p.get("expanded_uncertainty")
            if np.isfinite(limit) and spread is not None:
                name, value = f"{entry['name']}.{symbol}", float(p["value"])
                yield name, value, float(spread), p["unit"], float(limit), 0.0, OF_EFFECT


def _scale_cause(sensor: str, factors: np.ndarray) -> str:
    """Return what scale factors far from 1 nearly always come from."""
    mean = float(np.mean(factors))
    if np.ptp(factors) > EQUAL_SPREAD * mean:
        return "another column, counts per unit or axis map of this axis, or a damaged axis"
    unit = next((u for f, u in FACTORS[sensor].items() if abs(mean / f - 1.0) < NEAR), None)
    if unit is not None:
        return f"readings {mean:.4g} times the truth: they are {unit}; set the unit of their columns in ingest"
    setting = f"set sensor.{sensor}.full_scale and counts_per_unit"
    if any(abs(mean / f - 1.0) < NEAR for f in RANGES):
        return f"readings {mean:.4g} times the truth: the sensor was set to another range; {setting}"
    return f"readings {mean:.4g} times the truth: the sensor was probably set to another range or unit; {setting}"


def sentences(sensor: str, part: Mapping[str, Any] | None) -> list[str]:
    """Return what is implausible in a sensor's part of ``calibrations/<unit>.json``, a sentence for each cause."""
    by_cause: dict[str, list[Entry]] = {}
    for entry in (part or {}).get("implausible") or []:
        by_cause.setdefault(entry["likely_cause"], []).append(entry)
    found = []
    for cause, entries in by_cause.items():
        worst = max(entries, key=lambda e: e["ratio"])
        names = ", ".join(e["parameter"] for e in entries)
        unit = "" if worst["unit"] == "1" else f" {worst['unit']}"
        found.append(
            f"Implausible for this model of {sensor}: {names}; {worst['parameter']} is {worst['value']:+.4g}{unit}, "
            f"{worst['ratio']:.3g} times the data sheet's limit of {worst['limit']:.4g}{unit}. Likely cause: {cause}. "
            f"Where it is meant so: sensor.{sensor}.accept_implausible=true."
        )
    return found
