"""What every format needs of a calibration document."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from pipeline.io.axes import STRAIGHT, maps_of_log
from pipeline.model.effects import owner_of
from pipeline.model.effects.base import Owner
from pipeline.model.plausible import sentences
from pipeline.records import SENSORS, SensorCalibration

if TYPE_CHECKING:
    from numpy.typing import NDArray

STANDARD_GRAVITY = 9.80665  # m/s^2
OF_THE_BIAS = ("bias_temperature", "bias_temperature_quadratic")
TEMPERATURES = (-40.0, 85.0)  # degC, the widest that parts of this kind are made for


def calibrations(document: dict[str, Any]) -> dict[str, SensorCalibration]:
    """Return the sensors that were calibrated."""
    return {s: SensorCalibration.from_json(s, document[s]) for s in SENSORS if document.get(s)}


def missing(document: dict[str, Any]) -> list[str]:
    """Return a sentence for each sensor that was not calibrated."""
    reasons = document.get("not_calibrated") or {}
    return [f"the {s} is not calibrated: {reasons.get(s, 'no reason given')}" for s in SENSORS if not document.get(s)]


def sensor_effects(calibration: SensorCalibration) -> dict[str, NDArray[np.float64]]:
    """Return the values of the effects that belong to the sensor itself, by name."""
    return {e.name: e.values for e in calibration.effects if owner_of(e) == Owner.SENSOR}


def bench_effects(calibration: SensorCalibration) -> list[str]:
    """Return the effects of mounting, place, recording, table and timing, which no export carries."""
    return [e.name for e in calibration.effects if owner_of(e) != Owner.SENSOR]


def axes_of_readings(document: dict[str, Any]) -> list[str]:
    """Return a sentence a sensor on how its axes become the body's, where they differ; one where both are alike."""
    maps = maps_of_log(document.get("log") or {})
    whose = dict.fromkeys(maps.values(), "sensor") if len(set(maps.values())) == 1 else {m: s for s, m in maps.items()}
    lines = []
    for axis_map, sensor in whose.items():
        if axis_map != STRAIGHT:
            pairs = ", ".join(f"{a} along body {b}" for a, b in zip("xyz", axis_map, strict=True))
            lines.append(f"Turn the readings to body axes first: the {sensor}'s {pairs}.")
    return lines


def before_use(document: dict[str, Any]) -> list[str]:
    """Return what to know before using an export: the sensor's axes, and what is implausible in the calibration."""
    return axes_of_readings(document) + [line for s in SENSORS for line in sentences(s, document.get(s))]


def forward(calibration: SensorCalibration) -> NDArray[np.float64]:
    """Return K, the inverse of the calibration matrix, with ``reading = bias + K @ truth``."""
    return np.asarray(np.linalg.solve(calibration.matrix, np.eye(3)))


def left_out(found: dict[str, SensorCalibration], carried: tuple[str, ...] = ()) -> list[str]:
    """Return a sentence a sensor on the effects that a format does not carry, and on those of the bench."""
    lines = []
    for sensor, c in found.items():
        lost = [name for name in sensor_effects(c) if name not in carried]
        lines += [f"Left out of this format, {sensor}: {', '.join(lost)}."] if lost else []
        lines += [f"Of the bench, not of the {sensor}: {', '.join(bench_effects(c))}."] if bench_effects(c) else []
    return lines


def bias_polynomial(calibration: SensorCalibration) -> NDArray[np.float64]:
    """Return the bias and how it changes per degC and per degC^2 from 25 degC: (3, 3) array, a row an axis."""
    effects = sensor_effects(calibration)
    found = np.zeros((3, 3))
    found[:, 0] = calibration.bias
    found[:, 1] += effects.get("bias_temperature", np.zeros(3))
    found[:, 1:] += effects.get("bias_temperature_quadratic", np.zeros(6)).reshape(3, 2)
    return found


def diagonal(calibration: SensorCalibration) -> tuple[NDArray[np.float64], float]:
    """Return the scale factors that stand best for the whole matrix, and the relative error that they leave.

    ``s_i = K_ii / |K_i|^2`` minimises ``E (t_i - s_i K_i t)^2`` over truths t of any direction, and leaves
    ``sqrt(sum_i (1 - K_ii^2 / |K_i|^2) / 3)`` of |t|, K_i the rows of K.

    Parameters
    ----------
    calibration : SensorCalibration

    Returns
    -------
    scale : (3,) array
    error : float
        Root mean square of the vector's error over directions, relative to its length.
    """
    K = forward(calibration)
    length = np.sum(K**2, axis=1)
    return np.diag(K) / length, float(np.sqrt(np.sum(1.0 - np.diag(K) ** 2 / length) / 3.0))


def axis_by_axis(
    document: dict[str, Any], carried: tuple[str, ...] = ()
) -> tuple[dict[str, NDArray[np.float64]], list[str]]:
    """Return what ``(raw - offset) * scale`` on each axis can hold, and remarks on what it cannot.

    Returns
    -------
    values : dict of str to (3,) array
        ``accelerometer_offset``, m/s^2, ``accelerometer_scale``, ``gyroscope_offset``, rad/s; of calibrated sensors.
    remarks : list of str
    """
    found = calibrations(document)
    values: dict[str, NDArray[np.float64]] = {}
    remarks = [*(f"Left out: {line}." for line in missing(document)), *left_out(found, carried)]
    if "accelerometer" in found:
        c = found["accelerometer"]
        scale, error = diagonal(c)
        values |= {"accelerometer_offset": c.bias * STANDARD_GRAVITY, "accelerometer_scale": scale}
        remarks.append(f"Cross-axis terms of the accelerometer are left out: that leaves about {error:.2g} g at 1 g.")
    if "gyroscope" in found:
        c = found["gyroscope"]
        values["gyroscope_offset"] = np.radians(c.bias)
        remarks.append(no_gyroscope_matrix(c))
    return values, remarks


def no_gyroscope_matrix(calibration: SensorCalibration) -> str:
    """Return a sentence on the error that taking off the bias alone leaves, over directions: ``|1 - K| / sqrt(3)``."""
    share = float(np.linalg.norm(np.eye(3) - forward(calibration))) / np.sqrt(3.0)
    return f"The matrix of the gyroscope is left out: that leaves about {100 * share:.2g} % of the rate."


def comment(lines: list[str], mark: str = "# ") -> str:
    """Return lines as comments; line ends that users wrote stay inside."""
    return "".join(f"{mark}{' '.join(line.splitlines())}\n" for line in lines)


def yaml_text(content: dict[str, Any]) -> str:
    """Return YAML, keys in their order and short lists on one line; by libyaml, which is faster, where there is one."""
    dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
    text: str = yaml.dump(content, Dumper=dumper, sort_keys=False, default_flow_style=None, width=120)
    return text


def final_errors(validation: dict[str, Any] | None) -> list[str]:
    """Return a sentence a sensor on the held-out error with and without effects."""
    lines = []
    for sensor in SENSORS:
        steps = ((validation or {}).get(sensor) or {}).get("steps") or []
        for step in steps:
            if step["name"] == "calibrated" or step["name"].startswith("+ "):
                unit = validation[sensor]["unit"] if validation else ""
                error = "unknown" if step["rms_error"] is None else f"{step['rms_error']:.4g} {unit}"
                lines.append(f"held-out rms error of the {sensor}, {step['name']}: {error}")
    return lines
