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

from pipeline.records import SENSORS
from pipeline.report.comparison_statistics import Quantity
from pipeline.report.limits import final_step
from pipeline.report.parameters import fitted_parameters

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
                parameters={p.words: Quantity(p.value, p.standard_uncertainty) for p in fitted_parameters(part)},
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
