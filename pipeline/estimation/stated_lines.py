"""Add the lines of a budget that do not depend on the method of the fit: temperature, repeatability, counted time.

    quantisation  : db = d / sqrt(12) where the noise is below half a step d of the readings: no mean is better
    temperature   : u_T = sqrt(a^2 + R^2 / 12);  db = c_b u_T / sqrt(3),  dM = M c_k u_T / sqrt(3) by columns
    repeatability : db = r_b,  dM = M r_k by columns, each axis by itself
    bursts        : dM = M e of a gyroscope, e the relative uncertainty of the interval of samples that arrive in bursts
                    (``imu_logs.clocks``), where the time base is a source
    time base     : dM = M e of a gyroscope whose time is a count of rows at the sensor's stated rate (note
                    N-SYNTHTIME), or on a table whose rate is 1 + e times the change of its angle over the log's time

where a is the standard uncertainty of the thermometer, R the range of temperatures recorded, c the sensor file's limits
of the change per degC (or the fitted effect: then without the root, and R is 0), r standard deviations from one
switching-on to the next, and e the sensor file's limit of ``clock_rate`` or the difference in the table's log, of
rectangular distribution: the log does not show which of rate, angle and time is wrong. They are added after the last
stage of a fit. A source that is not included, and whose error has a known limit, has ``up_to``: relative for the
elements of the matrix, in the sensor's unit for the bias.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from pipeline.core.records import (
    BIAS,
    MATRIX,
    NORMAL,
    RECTANGULAR,
    SENSOR_UNITS,
    Contribution,
    Noise,
    NotIncluded,
    Recording,
    SensorCalibration,
    UnitRecordings,
    Values,
)
from pipeline.core.settings import DataSheet, Settings, Table
from pipeline.estimation.table_errors import TIME_BASE, BudgetLines, type_b
from pipeline.estimation.uncertainty_budget import (
    GRAVITY,
    NOT_STATED,
    QUANTISATION_SOURCE,
    clock_contribution,
    with_uncertainty,
)
from pipeline.physics.effects.base import OF_THE_BIAS
from pipeline.physics.kinematics import EARTH_RATE_DPS
from pipeline.physics.signal.filters import temperature_of

FITTED = {"bias": OF_THE_BIAS, "scale_factor": ("scale_factor_temperature",)}
BURSTS = "interval of bursts"
GRAVITY_ON_EARTH = 0.0044  # relative: 9.7639 to 9.8337 m/s^2 (Hirt et al. 2013, GRL 40, 4279) against 9.80665 m/s^2
IN_LOCAL_GRAVITY = (
    "table.gravity_g is 1 and table.gravity_accuracy_g is not stated, so that U holds in units of local gravity, which "
    "is 0.9956 to 1.0028 g on Earth; state both, or table.gravity_accuracy_g=0 where these units are meant"
)


def with_stated(
    calibration: SensorCalibration, recordings: UnitRecordings, settings: Settings, rate_error: float = 0.0
) -> SensorCalibration:
    """Add temperature, repeatability and a counted time to a calibration's budget, as far as they are known.

    ``recordings``: of the fit; their temperature and notes are used. ``rate_error``: e of the table's log, relative
    (``pipeline.checks.reference_scale.rate_error``).
    """
    filtered, noise = recordings.filtered, recordings.noises[calibration.sensor]
    before, budget = calibration.covariance, calibration.budget
    if before is None or budget is None:
        return calibration
    data_sheet = settings.sensor.of(calibration.sensor)
    lines, missing = _repeatability(calibration, data_sheet)
    accuracy, limits = settings.sensor.temperature_accuracy_degc, data_sheet.effects
    if accuracy is not None:
        warm = _temperature(calibration, accuracy, filtered, limits)
        if isinstance(warm, str):
            missing["temperature"] = warm
        else:
            lines += warm
    lines += _rounding(noise, calibration, filtered)
    lines += _counted_time(calibration, filtered, limits.get("clock_rate"))
    lines += _rate_off_angle(calibration, rate_error)
    lines += _of_bursts(calibration, filtered)
    known = {line.source.partition(" (")[0] for line in lines} | set(missing)
    entries = [entry for entry in budget.not_included if entry.source not in known]
    not_included = [_bounded(entry, settings.table, limits.get("clock_rate")) for entry in entries]
    not_included += [NotIncluded(source, reason) for source, reason in missing.items()]
    covariance = before + np.sum([line.covariance for line in lines], axis=0) if lines else before
    old = calibration.parameters.degrees_of_freedom
    share = np.divide(np.diag(covariance), np.diag(before), out=np.ones(len(before)), where=np.diag(before) > 0.0)
    freedom = np.where(np.diag(before) > 0.0, old * share**2, np.inf)
    every = (*budget.lines, *(line.line() for line in lines))
    budget = replace(budget, lines=every, not_included=tuple(not_included))
    return with_uncertainty(calibration, covariance, freedom, budget)


def _rounding(noise: Noise | None, calibration: SensorCalibration, filtered: Sequence[Recording]) -> list[Contribution]:
    """Return the line of readings in steps that hide the noise; the gyroscope's fit to rests and moves contains it."""
    by_moves = calibration.sensor == "gyroscope" and any(r.role == "rests" for r in filtered)
    known = by_moves or any(line.source == QUANTISATION_SOURCE for line in calibration.lines)
    if noise is None or noise.step is None or noise.rounding is None or known:
        return []
    largest, unit = float(noise.rounding.max()), SENSOR_UNITS[calibration.sensor]
    effect = np.eye(len(calibration.parameters))[:, BIAS] * noise.rounding / largest
    steps = f"steps of up to {float(noise.step.max()):.3g} {unit}"
    remark = f"readings in {steps} with less noise than half a step: log more digits"
    return [type_b(QUANTISATION_SOURCE, RECTANGULAR, largest, unit, effect, remark)]


def _counted_time(
    calibration: SensorCalibration, recordings: Sequence[Recording], limit_ppm: float | None
) -> list[Contribution]:
    """Return the line of an unstated time base, where times are a count of rows at the rate of the sensor's clock."""
    unstated = calibration.budget and any(map(_clock_unstated, calibration.budget.not_included))
    used = (r for r in recordings if r.role in (calibration.sensor, "rests"))
    if not limit_ppm or not unstated or not any(note.code == "N-SYNTHTIME" for r in used for note in r.notes):
        return []
    remark = f"rows counted at the stated rate, by the sensor file's limit of clock_rate, {limit_ppm:g} ppm"
    return [clock_contribution(calibration, limit_ppm / np.sqrt(3.0), RECTANGULAR, remark)]


def _of_bursts(calibration: SensorCalibration, recordings: Sequence[Recording]) -> list[Contribution]:
    """Return the line of samples in bursts, whose interval follows from their number and the duration."""
    timed = any(line.source == TIME_BASE for line in calibration.lines)
    timed |= calibration.budget is not None and any(map(_clock_unstated, calibration.budget.not_included))
    used = [r.source["bursts"] for r in recordings if r.role in (calibration.sensor, "rests") and "bursts" in r.source]
    if not used or not timed:
        return []
    ppm = max(1e6 * clock["uncertainty_ns"] / clock["interval_ns"] for clock in used) / 2.0
    remark = "the interval of samples in bursts, by their number and the duration (N-BURSTS)"
    return [replace(clock_contribution(calibration, ppm, NORMAL, remark), source=BURSTS)]


def _rate_off_angle(calibration: SensorCalibration, rate_error: float) -> list[Contribution]:
    """Return the line of a table whose rate is not the change of its angle, beyond the rate's stated accuracy."""
    if calibration.sensor != "gyroscope" or not rate_error:
        return []
    remark = f"the table's rate and the change of its angle differ by up to {1e6 * rate_error:.3g} ppm"
    return [clock_contribution(calibration, 1e6 * rate_error / np.sqrt(3.0), RECTANGULAR, remark)]


def _clock_unstated(entry: NotIncluded) -> bool:
    return entry.source == TIME_BASE and "clock_accuracy_ppm is not stated" in entry.reason


def _bounded(entry: NotIncluded, table: Table, limit_ppm: float | None) -> NotIncluded:
    """Return a source that is not included, with ``up_to`` where the size of its error has a known limit."""
    if entry.source == GRAVITY and table.gravity_g == 1.0:
        return NotIncluded(GRAVITY, IN_LOCAL_GRAVITY, {"matrix": GRAVITY_ON_EARTH})
    if _clock_unstated(entry) and limit_ppm:
        reason = f"{entry.reason}; the sensor file states {limit_ppm:g} ppm for times by the sensor's own clock"
        return NotIncluded(TIME_BASE, reason, {"matrix": 1e-6 * limit_ppm})
    if entry.reason.startswith("not in the model"):  # Earth's rotation
        return replace(entry, up_to={"bias": EARTH_RATE_DPS})
    return entry


def _effects_on(calibration: SensorCalibration) -> list[tuple[str, str, Values]]:
    """Return name, unit and effect, (p, 3), of errors of bias and of scale factor of each reading axis."""
    size = len(calibration.parameters)
    of_scale = np.zeros((size, 3))
    for axis in range(3):
        change = np.zeros((3, 3))
        change[:, axis] = -calibration.matrix[:, axis]
        of_scale[MATRIX, axis] = change.ravel()
    return [("bias", SENSOR_UNITS[calibration.sensor], np.eye(size)[:, BIAS]), ("scale_factor", "1", of_scale)]


def _repeatability(calibration: SensorCalibration, data_sheet: DataSheet) -> BudgetLines:
    """Return the contributions of the repeatability, and the reason if it is not stated."""
    lines, lacking = [], []
    for name, unit, effect in _effects_on(calibration):
        u: float | None = getattr(data_sheet, f"repeatability_{name}")
        if u is None:
            lacking.append(f"sensor.{calibration.sensor}.repeatability_{name}")
        elif u:
            lines.append(type_b(f"repeatability ({name.replace('_', ' ')})", NORMAL, u, unit, effect))
    reason = f"{NOT_STATED}, compare, and state it as {' and '.join(lacking)}"
    return lines, {"repeatability": reason} if lacking else {}


def _temperature(
    calibration: SensorCalibration, accuracy: float, recordings: Sequence[Recording], limits: Mapping[str, float]
) -> list[Contribution] | str:
    """Return the contributions of the temperature to bias and scale factor, or why they are not known."""
    used = [r for r in recordings if r.role in (calibration.sensor, "rests") and r.temperature is not None]
    if not used:
        return "the recordings hold no temperature"
    spread = float(np.ptp(np.concatenate([temperature_of(r) for r in used]))) / np.sqrt(12.0)
    lines = []
    for name, unit, effect in _effects_on(calibration):
        fitted = next((e for e in calibration.effects if e.name in FITTED[name]), None)
        limit = limits.get(f"{name}_temperature")
        if fitted is not None:
            slope, u, how = fitted.values.reshape(3, -1)[:, 0], accuracy, f"by the fitted {fitted.name}"
        elif limit is None:
            return f"the sensor file states no effects.{name}_temperature"
        else:
            slope, u = np.full(3, limit / np.sqrt(3.0)), float(np.hypot(accuracy, spread))
            how = f"by the sensor file's limit of {limit:g} {unit}/degC"
        kind = NORMAL if fitted is not None else RECTANGULAR
        lines.append(type_b(f"temperature ({name.replace('_', ' ')})", kind, u, "degC", effect * slope, how))
    return lines
