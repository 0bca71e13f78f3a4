"""What is compared of a unit: errors, parameters and cost, each a quantity with its own uncertainty where it has one.

The root mean square error e over N held-out samples, of which sigma is noise, is uncertain by

    u(e)^2 = sigma^2 (2 e^2 - sigma^2) / (2 N e^2)

from the noise of those samples alone: with the error without noise d_k at sample k, the mean of (d_k + n_k)^2 has the
variance (4 mean(d^2) sigma^2 + 2 sigma^4) / N, and mean(d^2) = e^2 - sigma^2. What another recording for the fit would
give is not in it; only several units tell that.

Where the truth behind the recordings is known (they are simulated), the error against it is that of a reading without
noise, in any direction,

    e^2 = a^2 |M K - 1|_F^2 / 3 + |M (b - b_hat)|^2

where

M, b_hat : matrix and bias of the calibration
K, b     : of the truth, reading = b + K @ truth
a        : size of the motion: the root mean square of the held-out reference, g or deg/s
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pipeline.records import AXES, SENSORS
from pipeline.report.comparison_statistics import Quantity
from pipeline.report.limits import final_step

JSON = dict[str, Any]


@dataclass(frozen=True)
class SensorFigures:
    """What is compared of one sensor of one unit.

    Attributes
    ----------
    before, after, truth : Quantity or None
        Root mean square error on held-out motion before and after calibration, and against the truth, g or deg/s.
    noise_floor : float or None
    table_time : float or None
        Length of the recordings that the fit of this sensor rests on, s.
    verdict : str
        Of the diagnosis; empty where there is none.
    parameters : dict of str to Quantity
        Bias, matrix and effects.
    """

    before: Quantity | None = None
    after: Quantity | None = None
    truth: Quantity | None = None
    noise_floor: float | None = None
    table_time: float | None = None
    verdict: str = ""
    parameters: dict[str, Quantity] = field(default_factory=dict)


def unit_figures(
    calibration: JSON, validation: JSON | None, diagnosis: JSON | None, truth: JSON | None = None
) -> dict[str, SensorFigures]:
    """Return what is compared of a unit, per sensor; a failed unit has none.

    Parameters
    ----------
    calibration, validation, diagnosis : dict or None
        As in their files.
    truth : dict, optional
        ``truth/<unit>.json`` of the recordings, where they are simulated.
    """
    out = {}
    for sensor in SENSORS:
        part, held_out = calibration.get(sensor), (validation or {}).get(sensor)
        if part and held_out:
            out[sensor] = SensorFigures(
                before=_error(held_out, held_out["steps"][0]),
                after=_error(held_out, final_step(held_out)),
                truth=_against_truth(part, held_out, (truth or {}).get(sensor)),
                noise_floor=held_out.get("noise_floor"),
                table_time=table_time(sensor, calibration),
                verdict=((diagnosis or {}).get(sensor) or {}).get("verdict") or "",
                parameters=_parameters(part),
            )
    return out


def table_time(sensor: str, calibration: JSON) -> float | None:
    """Return how long the recordings are that a sensor's fit rests on, s; None where the document does not tell."""
    used = [i.get("duration_s") for i in calibration.get("inputs") or [] if i.get("role") in (sensor, "rests")]
    known = [d for d in used if d is not None]
    return sum(known) if known else None


def _error(held_out: JSON, step: JSON) -> Quantity | None:
    error, floor, samples = step.get("rms_error"), held_out.get("noise_floor"), held_out.get("samples")
    if error is None:
        return None
    if not floor or not samples or error <= 0.0:
        return Quantity(error)
    noise = min(floor, error) ** 2
    return Quantity(error, math.sqrt(noise * (2.0 * error**2 - noise) / (2.0 * samples)) / error)


def _against_truth(part: JSON, held_out: JSON, truth: JSON | None) -> Quantity | None:
    size = held_out.get("reference_rms")
    if truth is None or size is None:
        return None
    matrix = np.array(part["matrix"], float)
    left = matrix @ np.linalg.solve(np.array(truth["matrix"], float), np.eye(3)) - np.eye(3)
    bias = matrix @ (np.array(truth["bias"], float) - np.array(part["bias"], float))
    return Quantity(float(np.sqrt(size**2 * np.sum(left**2) / 3.0 + np.sum(bias**2))))


def _parameters(part: JSON) -> dict[str, Quantity]:
    """Return bias, matrix and effects with their standard uncertainties."""
    out = {}
    expanded, factor = part.get("expanded_uncertainty") or {}, part.get("coverage_factor") or {}
    for i, a in enumerate(AXES):
        out[f"bias {a}"] = _quantity(part["bias"][i], _at(expanded, "bias", i), _at(factor, "bias", i))
    for i, a in enumerate(AXES):
        for j, b in enumerate(AXES):
            uncertainty, coverage = _at(expanded, "matrix", i, j), _at(factor, "matrix", i, j)
            out[f"matrix {a}{b}"] = _quantity(part["matrix"][i][j], uncertainty, coverage)
    for effect in part.get("effects") or []:
        for name, p in effect["parameters"].items():
            coverage = _at(factor, "bias", 0)
            label = f"{effect['name'].replace('_', ' ')}: {name}"
            out[label] = _quantity(p["value"], p.get("expanded_uncertainty"), coverage)
    return out


def _at(values: JSON, key: str, *index: int) -> float | None:
    found: Any = values.get(key)
    for i in index:
        found = None if found is None else found[i]
    return None if found is None else float(found)


def _quantity(value: float, expanded: float | None, factor: float | None) -> Quantity:
    return Quantity(value, expanded / factor if expanded is not None and factor else None)
