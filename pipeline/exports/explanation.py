"""A calibration in words and numbers: its equation, the order of its operations, its signs, and a worked sample."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.exports import formats
from pipeline.exports.sensors import before_use
from pipeline.model.compensation import Compensation
from pipeline.model.effects import effect_of
from pipeline.model.measurement import sensor_effects
from pipeline.records import SENSOR_UNITS, SENSORS, SensorCalibration, coverage_factor

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.exports.reading import FoundCalibration

    Values = NDArray[np.float64]

NUMBER = re.compile(r"\d+\.\d+(?:e[-+]?\d+)?")
# The worked sample: a body that stands a little off level, turns, and is warmer than the reference temperature.
SAMPLE: dict[str, Any] = {
    "accelerometer": np.array([0.1, -0.2, 0.97]),
    "gyroscope": np.array([10.0, -20.0, 30.0]),
    "temperature": 35.0,
    "time": 600.0,
}


def explain_calibration(found: FoundCalibration) -> str:
    """Return the explanation of a calibration in any format."""
    lines = [f"{found.unit} ({found.name})"]
    if found.document is None:
        declared = formats()[found.name][0]
        lines += [f"  {declared.consumer}: {declared.equation}", "  The same in g, deg/s and body axes:"]
    lines += [f"  {line}" for line in (before_use(found.document) if found.document else [])]
    lines += [f"  {note}" for note in found.notes]
    for sensor in SENSORS:
        calibration = found.sensors.get(sensor)
        lines += ["", f"  {sensor}"]
        lines += [f"    {line}" for line in _sensor(calibration, found)] if calibration else ["    not calibrated"]
    return "\n".join(lines) + "\n"


def _sensor(calibration: SensorCalibration, found: FoundCalibration) -> list[str]:
    unit, own = SENSOR_UNITS[calibration.sensor], sensor_effects(calibration)
    names = [e.name for e in own]
    bench = [e.name for e in calibration.effects if e not in own]
    minus = "".join(f" - {name}" for name in names)
    lines = [
        f"calibrated = matrix (reading - bias{minus}), {unit}; vectors are columns x, y, z",
        "signs: at rest the upward axis reads + local gravity"
        if calibration.sensor == "accelerometer"
        else "signs: a turn about +x, +y, +z by the right-hand rule reads +",
        "order: 1. readings to body axes  2. subtract the bias"
        + ("".join(f"  {i}. subtract {name}" for i, name in enumerate(names, 3)))
        + f"  {len(names) + 3}. multiply by the matrix",
        f"bias   = {_row(calibration.bias)} {unit}",
        *(f"{'matrix =' if i == 0 else '        '} {_row(row)}" for i, row in enumerate(calibration.matrix)),
        *_uncertainty(calibration, unit),
    ]
    for effect in own:
        expressions = effect_of(effect).in_c(effect.values) or ()
        terms = "" if expressions else ", ".join(f"{n} = {p['value']:.6g}" for n, p in effect.parameters.items())
        lines.append(f"{effect.name}, {unit}: {terms}".rstrip(": "))
        lines += [f"  {axis}: {_plain(term)}" for axis, term in zip("xyz", expressions, strict=False)]
    if own:
        lines.append(
            "  (f: specific force, g; w: angular rate, deg/s; u: that of this sensor, all calibrated; dt: T - 25 degC)"
        )
    lines += [f"of the bench, not taken off: {', '.join(bench)}"] * bool(bench)
    return lines + _worked(calibration, found)


def _uncertainty(calibration: SensorCalibration, unit: str) -> list[str]:
    """Return the expanded uncertainties (95 %) of bias and matrix, or that none is known."""
    if calibration.covariance is None:
        return ["uncertainty: none is known"]
    freedom = calibration.freedom if calibration.freedom is not None else np.array(calibration.degrees_of_freedom)
    U = coverage_factor(np.broadcast_to(freedom, len(calibration.covariance)))
    U = U * np.sqrt(np.clip(np.diag(calibration.covariance), 0.0, None))
    return [f"expanded uncertainty (95 %): bias {_row(U[:3], '.2g')} {unit}, matrix up to {U[3:12].max():.2g}"]


def _worked(calibration: SensorCalibration, found: FoundCalibration) -> list[str]:
    """Return one reading, calibrated step by step; the effects are what the compensation takes off."""
    sensor, unit = calibration.sensor, SENSOR_UNITS[calibration.sensor]
    compensation = Compensation(found.sensors.get("accelerometer"), found.sensors.get("gyroscope"), found.unit)
    truth = getattr(compensation.apply(**SAMPLE, smoothing=0.0), sensor)
    reading, centred = SAMPLE[sensor], SAMPLE[sensor] - calibration.bias
    taken = centred - np.linalg.solve(calibration.matrix, truth)
    lines = [f"worked sample: reading      {_row(reading)} {unit}", f"  - bias                    {_row(centred)}"]
    if sensor_effects(calibration):
        at = f"at {SAMPLE['temperature']:g} degC, {SAMPLE['time']:g} s"
        other = "gyroscope" if sensor == "accelerometer" else "accelerometer"
        lines.append(
            f"  - effects                 {_row(centred - taken)}  ({at}, {other} {_row(SAMPLE[other], '.4g')})"
        )
    return [*lines, f"  matrix times that         {_row(truth)} {unit}  calibrated"]


def _plain(expression: str) -> str:
    """Return a C expression of an effect without casts, its numbers to six digits."""
    bare = expression.replace("(imu_real)", "").replace("m->", "")
    return NUMBER.sub(lambda number: f"{float(number[0]):.6g}", bare)


def _row(values: Values, form: str = ".9g") -> str:
    return "[" + ", ".join(f"{value:{form}}" for value in values) + "]"
