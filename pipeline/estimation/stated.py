"""What is stated of a sensor and its thermometer, as lines of an uncertainty budget (type B).

    temperature   : u_T = sqrt(a^2 + R^2 / 12);  db = c_b u_T / sqrt(3),  dM = M c_k u_T / sqrt(3) by columns
    repeatability : db = r_b,  dM = M r_k by columns, each axis by itself

where

    a        : standard uncertainty of the thermometer, degC (``sensor.temperature_accuracy_degc``)
    R        : range of the temperatures recorded, degC: the parameters hold somewhere in it
    c_b, c_k : the data sheet's limits of the change of bias and scale factor per degC, of which the sensor's own is not
               known. Where an effect of temperature is fitted, c is what was found (without the root), and R is 0
    r_b, r_k : standard deviations from one switching-on to the next (``sensor.<sensor>.repeatability_bias``,
               ``repeatability_scale_factor``)

Both are added after the last stage of a fit, as they depend on no method. What is not stated is named.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.estimation.budget import type_b, with_uncertainty
from pipeline.records import NORMAL, RECTANGULAR, SENSOR_UNITS
from pipeline.signal.temperature import temperature_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from pipeline.records import Contribution, Recording, SensorCalibration

    Values = NDArray[np.float64]

FITTED = {"bias": ("bias_temperature", "bias_temperature_quadratic"), "scale_factor": ("scale_factor_temperature",)}
ACCURACY = "temperature_accuracy_degc"
NOT_STATED = (
    "one calibration does not tell it: calibrate the unit again after switching it off, compare, and state it as"
)


def with_stated(
    calibration: SensorCalibration, recordings: Sequence[Recording], settings: Mapping[str, Any]
) -> SensorCalibration:
    """Return a calibration whose budget holds temperature and repeatability, as far as they are stated.

    Parameters
    ----------
    calibration : SensorCalibration
    recordings : sequence of Recording
        Of the fit; only their temperature is looked at.
    settings : mapping
        Section ``sensor``.
    """
    if calibration.covariance is None or calibration.budget is None:
        return calibration
    sheet = settings["sensor"].get(calibration.sensor) or {}
    lines, missing = _repeatability(calibration, sheet)
    accuracy = settings["sensor"].get(ACCURACY)
    if accuracy is not None:
        warm = _temperature(calibration, float(accuracy), recordings, sheet.get("effects") or {})
        if isinstance(warm, str):
            missing["temperature"] = warm
        else:
            lines += warm
    known = {line.source.partition(" (")[0] for line in lines} | set(missing)
    kept = [entry for entry in calibration.budget["not_included"] if entry["source"] not in known]
    left = [*kept, *({"source": source, "reason": reason} for source, reason in missing.items())]
    return _with_lines(calibration, lines, left)


def _repeatability(
    calibration: SensorCalibration, sheet: Mapping[str, Any]
) -> tuple[list[Contribution], dict[str, str]]:
    lines, lacking, size = [], [], len(calibration.parameter_names())
    for name, effect in (("bias", _of_bias(size)), ("scale_factor", _of_scale(calibration.matrix, size))):
        u, key = sheet.get(f"repeatability_{name}"), f"repeatability_{name}"
        if u is None:
            lacking.append(f"sensor.{calibration.sensor}.{key}")
        elif u:
            unit = SENSOR_UNITS[calibration.sensor] if name == "bias" else "1"
            lines.append(type_b(f"repeatability ({name.replace('_', ' ')})", NORMAL, float(u), unit, effect))
    return lines, {"repeatability": f"{NOT_STATED} {' and '.join(lacking)}"} if lacking else {}


def _temperature(
    calibration: SensorCalibration, accuracy: float, recordings: Sequence[Recording], limits: Mapping[str, float]
) -> list[Contribution] | str:
    """Return what the temperature contributes to bias and scale factor, or why that is not known."""
    own = [r for r in recordings if r.role in (calibration.sensor, "rests") and r.temperature is not None]
    if not own:
        return "the recordings hold no temperature"
    warmth = np.concatenate([temperature_of(r) for r in own])
    spread = float(np.ptp(warmth)) / np.sqrt(12.0)
    lines, size = [], len(calibration.parameter_names())
    unit = SENSOR_UNITS[calibration.sensor]
    for name, effect in (("bias", _of_bias(size)), ("scale_factor", _of_scale(calibration.matrix, size))):
        fitted = next((e for e in calibration.effects if e.name in FITTED[name]), None)
        limit = limits.get(f"{name}_temperature")
        if fitted is not None:
            slope, u, how = fitted.values.reshape(3, -1)[:, 0], accuracy, f"by the fitted {fitted.name}"
        elif limit is None:
            return f"the sensor's data sheet states no effects.{name}_temperature"
        else:
            slope, u = np.full(3, limit / np.sqrt(3.0)), float(np.hypot(accuracy, spread))
            how = f"by the data sheet's limit of {limit:g} {unit if name == 'bias' else '1'}/degC"
        kind = NORMAL if fitted is not None else RECTANGULAR
        lines.append(type_b(f"temperature ({name.replace('_', ' ')})", kind, u, "degC", effect * slope, how))
    return lines


def _of_bias(size: int) -> Values:
    return np.eye(size)[:, :3]


def _of_scale(matrix: Values, size: int) -> Values:
    """Return what a relative change of the sensitivity of each reading axis does: ``dM = -M_i e_i`` by columns."""
    effect = np.zeros((size, 3))
    for axis in range(3):
        change = np.zeros((3, 3))
        change[:, axis] = -matrix[:, axis]
        effect[3:12, axis] = change.ravel()
    return effect


def _with_lines(
    calibration: SensorCalibration, lines: Sequence[Contribution], not_included: Sequence[Mapping[str, str]]
) -> SensorCalibration:
    """Return a calibration with further contributions of infinite degrees of freedom."""
    before, budget = calibration.covariance, calibration.budget
    assert before is not None  # noqa: S101
    assert budget is not None  # noqa: S101
    covariance = before + np.sum([line.covariance for line in lines], axis=0) if lines else before
    old = np.array([np.inf if v is None else v for v in budget["effective_degrees_of_freedom"]])
    share = np.divide(np.diag(covariance), np.diag(before), out=np.ones(len(before)), where=np.diag(before) > 0.0)
    freedom = np.where(np.diag(before) > 0.0, old * share**2, np.inf)
    contributions = [*budget["contributions"], *(line.to_json() for line in lines)]
    return with_uncertainty(calibration, covariance, freedom, {**budget, "contributions": contributions}, not_included)
