"""Read the calibration of a unit, and compensate arrays, logs and streams by it.

    truth = matrix @ (reading - bias - sum of effects(truth))

The computation is causal: a log in one piece, in blocks, or sample by sample gives the same numbers to the last bit.
The effects are subtracted in three steps:

1. Effects that depend on time and temperature only are subtracted once.
2. Sensors whose effects depend on the truth that they change are solved by fixed point
   (``pipeline.physics.measurement``). Where a sample needs the sample before it, as for an angular acceleration, it
   takes that sample's value of the same iteration.
3. Effects that depend on the truth of the other sensor only are subtracted once.

The file ``calibrations/<unit>.json`` may have been edited, truncated, or written by another version. Every fault is an
``InputError`` that names the file, the key, its value and what was expected.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, NoReturn, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imu_logs.files import not_regular
from pipeline.core.errors import ConfigurationError, InputError, MissingInputError
from pipeline.core.files import (
    Check,
    WrongValueError,
    each,
    fields,
    flag,
    items,
    mapping,
    number,
    one_of,
    or_none,
    text,
)
from pipeline.core.pack import read_published
from pipeline.core.records import (
    AXES,
    READABLE_VERSIONS,
    SENSOR_UNITS,
    SENSORS,
    FittedEffect,
    Motion,
    SensorCalibration,
    Values,
)
from pipeline.physics import measurement
from pipeline.physics.effects import effect_of, load_python_effect, register
from pipeline.physics.effects.base import OF_THE_ROOM
from pipeline.physics.measurement import Truths

# Readings in another unit or range are calibrated by a matrix of that factor: 16 between the ranges of an accelerometer
# (2 to 32 g), 32 between those of a gyroscope (125 to 4000 deg/s), 57 for rad/s, 1000 for mg and mdps.
LARGEST_FACTOR = 1000.0
# Two axes 1 deg apart have a condition of 2 / sin(1 deg) = 115; a sensor's axes are 90 deg apart within some degrees.
LARGEST_CONDITION = 100.0

# estimators average over longer times, between two images or scans: a faster process counts as white
MIN_EXPORTED_TIME_S = 0.1
WHAT_TO_DO = "take the file as the run published it, or calibrate the unit anew"

_VECTOR = items(number, 3)
_PARAMETERS = each(fields({"value": number, "unit": or_none(text)}, ("value",), others=True))
_OF_EFFECT = {"name": text, "parameters": _PARAMETERS, "definition": or_none(mapping)}
_EFFECT = fields(_OF_EFFECT, ("name", "parameters"))
_COVARIANCE = fields(
    {"parameters": items(text), "values": items(items(or_none(number)))}, ("parameters", "values"), others=True
)
_OF_STAGE = {"name": text, "parameters": mapping, "details": mapping}
_STAGE = fields(_OF_STAGE | {"residual_rms": or_none(number), "correction": or_none(mapping)}, ("name", "parameters"))
_TEMPERATURES = dict.fromkeys(("temperature_degc", "soaked_degc"), items(number, 2))
_RANGE = fields({"specific_force_g": number, "angular_rate_dps": number, **_TEMPERATURES}, ())
SMOOTHING_S = 3.0  # 30 samples of a thermometer at 10 Hz; a package warms up in minutes
RATE_SMOOTHING_S = 10.0  # of the temperature's rate: the largest bandwidth in a fit (``smooth_temperature``)
BLOCK = 8192  # samples that are computed at once: their arrays stay in the processor's cache
OF_THE_PAST = {"specific_force_rate", "angular_acceleration", "direction"}


def _sensor(unit: str) -> Check:
    required = {"unit": one_of(unit), "bias": _VECTOR, "matrix": items(_VECTOR, 3), "covariance": _COVARIANCE}
    required |= {"effects": items(_EFFECT), "stages": items(_STAGE), "converged": flag}
    required |= {"degrees_of_freedom": or_none(number)}
    optional = {"effective_degrees_of_freedom": or_none(items(or_none(number)))}
    return fields({**required, **optional}, required, others=True)


_PARTS = {sensor: or_none(_sensor(unit)) for sensor, unit in SENSOR_UNITS.items()}
_DOCUMENT = fields({"status": one_of("ok"), "calibrated_range": _RANGE, **_PARTS}, ("status", *SENSORS), others=True)


def read_calibration(file: Path) -> dict[str, Any]:
    """Return the document of a calibrated unit.

    Raises ``MissingInputError`` if the file does not exist, ``InputError`` if it cannot be read, belongs to another
    schema version or to a failed unit, holds no calibrated sensor, or a value is not what is expected.
    """
    try:
        if file.exists() and (other := not_regular(file)):
            _refuse(file, f"this {other}")
        text = read_published(file).decode()
        document = json.loads(text, object_pairs_hook=_without_repeats, parse_constant=_not_finite)
    except FileNotFoundError:
        raise MissingInputError("there is no such calibration", str(file)) from None
    except (OSError, RecursionError, ValueError) as error:  # ValueError: no UTF-8, no JSON, or refused below
        if file.suffix.lower() != ".json":
            _refuse(file, f"this is no calibration of a unit: make one of it by convert {file} calibration.json")
        _refuse(file, f"this is no calibration of a unit: {error}; {WHAT_TO_DO}")
    if not isinstance(document, dict) or "status" not in document:
        _refuse(file, "this is no calibration of a unit: it has no status; expected calibrations/<unit>.json")
    version = document.get("schema_version")
    if version not in READABLE_VERSIONS or isinstance(version, bool):
        shown = "missing" if version is None else repr(version)
        readable = " and ".join(map(str, READABLE_VERSIONS))
        _refuse(file, f"schema_version is {shown}; this version reads {readable}: calibrate the unit anew")
    if document["status"] == "failed":
        error_entry = document.get("error")
        cause = error_entry.get("message", "unknown") if isinstance(error_entry, dict) else "unknown"
        _refuse(file, f"unit {document.get('unit')} failed and has no calibration; cause: {cause}")
    try:
        _DOCUMENT(document)
    except WrongValueError as wrong:
        _refuse(file, f"{wrong}; {WHAT_TO_DO}")
    if all(document[sensor] is None for sensor in SENSORS):
        reasons = document.get("not_calibrated")
        cause = "; ".join(map(str, reasons.values())) if isinstance(reasons, dict) and reasons else "not stated"
        _refuse(file, f"accelerometer and gyroscope are null: there is nothing to apply; reason: {cause}")
    return document


def sensor_of(document: dict[str, Any], sensor: str, file: Path) -> SensorCalibration | None:
    """Return the calibration of one sensor of ``read_calibration``; None where it is not calibrated.

    Raises ``InputError`` if matrix, covariance or an effect is invalid, ``ConfigurationError`` if an effect is unknown.
    """
    part = document[sensor]
    if part is None:
        return None
    _check_matrix(file, f"{sensor}.matrix", np.array(part["matrix"], float))
    size, rows = len(part["covariance"]["parameters"]), part["covariance"]["values"]
    if [len(row) for row in rows] != [size] * size:
        _refuse(file, f"{sensor}.covariance.values is not {size} x {size}, as its parameters say")
    names = [entry["name"] for entry in part["effects"]]
    for i, entry in enumerate(part["effects"]):
        if entry["name"] in names[:i]:
            _refuse(file, f"{sensor}.effects[{i}] is {entry['name']} a second time; expected each effect once")
        _check_effect(file, f"{sensor}.effects[{i}]", sensor, entry)
    return SensorCalibration.from_json(sensor, part)


def sample_covariance(document: Mapping[str, Any], sensor: str) -> Values | None:
    """Return the covariance of a calibrated sample: (3, 3) array, g^2 or (deg/s)^2.

        cov = M diag(N^2 / dt + 2 Q^2 / dt^2 + sum_i G_i^2) M^T

    with the white and quantisation noise N and Q of an axis at rest, identified at the sampling interval dt, and the
    standard deviation G_i of its Gauss-Markov processes with a correlation time of less than ``MIN_EXPORTED_TIME_S``. A
    slower bias wander is not noise of a single sample. None where the sensor is not calibrated, or the noise of an axis
    is unknown.
    """
    noise, part = (document.get("noise") or {}).get(sensor) or {}, document.get(sensor)
    axes = noise.get("axes") or {}
    if not part or any((axes.get(axis) or {}).get("terms") is None for axis in AXES):
        return None
    dt, variances = float(noise["sampling_interval_s"]), []
    for axis in AXES:
        terms = axes[axis]["terms"]
        white, quantisation = (terms[name]["value"] or 0.0 for name in ("white", "quantisation"))
        fast = [g["value"] for g in terms["gauss_markov"] if g["correlation_time_s"]["value"] < MIN_EXPORTED_TIME_S]
        variances.append(white**2 / dt + 2.0 * quantisation**2 / dt**2 + sum(g**2 for g in fast))
    spread = np.array(part["matrix"], np.float64) * np.sqrt(variances)
    return np.asarray(spread @ spread.T)


def _check_matrix(file: Path, key: str, matrix: np.ndarray) -> None:
    sizes = np.linalg.svd(matrix, compute_uv=False)
    if sizes[2] * LARGEST_CONDITION < sizes[0]:
        _refuse(file, f"{key} is singular or nearly so: singular values {sizes[0]:.3g} to {sizes[2]:.3g}; expected "
                      f"a ratio below {LARGEST_CONDITION:g}")  # fmt: skip
    if sizes[0] > LARGEST_FACTOR or sizes[2] * LARGEST_FACTOR < 1.0:
        _refuse(
            file,
            f"{key} multiplies readings by {sizes[2]:.3g} to {sizes[0]:.3g}; expected about 1, and between "
            f"{1 / LARGEST_FACTOR:g} and {LARGEST_FACTOR:g} even for readings in another unit or range",
        )


def _check_effect(file: Path, where: str, sensor: str, entry: dict[str, Any]) -> None:
    name, parameters = entry["name"], entry["parameters"]
    try:
        effect = effect_of(FittedEffect(name, {}, entry.get("definition")))
    except ConfigurationError as error:
        raise ConfigurationError(f"{where}: {error.message}", str(file)) from None
    known = effect.parameters(sensor) if sensor in effect.sensors else ()
    if list(parameters) != [p.name for p in known]:
        listed = ", ".join(p.name for p in known) or f"none: it is no effect of the {sensor}"
        _refuse(file, f"{where}.parameters ({name}) are {', '.join(parameters) or 'none'}; expected {listed}")
    for p in known:
        stated = parameters[p.name].get("unit")
        if stated not in {"", p.unit}:  # empty: not stated
            _refuse(file, f"{where}.parameters.{p.name}.unit ({name}) is {stated!r}; expected {p.unit!r}")


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f'the key "{twice}" stands twice in one object; expected each key once')
    return found


def _not_finite(name: str) -> NoReturn:
    raise ValueError(f"it holds the number {name}; expected finite numbers")


def _refuse(file: Path, message: str) -> NoReturn:
    raise InputError(message, str(file))


class Compensated(NamedTuple):
    """Specific force, g, and angular rate, deg/s, of the body; None for a sensor that was not given."""

    accelerometer: Values | None
    gyroscope: Values | None


@dataclass(frozen=True)
class Steps:
    """The effects of one sensor, divided by the signals that they depend on, for Python and for ``calibration.h``.

    ``steady`` effects depend on time and temperature only, ``moving`` effects on the truth. ``fields``: effect to the
    fields of ``Motion`` that it reads.
    """

    steady: list[FittedEffect]
    moving: list[FittedEffect]
    fields: dict[str, set[str]]

    @classmethod
    def of(cls, sensor: str, effects: Sequence[FittedEffect]) -> Self:
        """Divide the given effects of a sensor."""
        fields = {e.name: measurement.fields_used(sensor, [e]) for e in effects}
        moving = [e for e in effects if fields[e.name] - OF_THE_ROOM]
        return cls([e for e in effects if e not in moving], moving, fields)

    @property
    def used(self) -> set[str]:
        """All fields that the effects read."""
        return set().union(*self.fields.values())

    def needs(self, effect: str) -> set[str]:
        """Return the signals of a log that an effect needs."""
        return set().union(*(measurement.FIELDS_OF_SIGNALS[field] for field in self.fields[effect]))


def circular(steps: Mapping[str, Steps]) -> set[str]:
    """Return the sensors whose effects depend on their own truth, directly or through the other sensor."""
    moving = {s for s, step in steps.items() if step.moving}
    looks_at = {s: set().union(*(steps[s].needs(e.name) for e in steps[s].moving)) & moving for s in moving}
    return {s for s, seen in looks_at.items() if any(other == s or s in looks_at[other] for other in seen)}


class CompensationStream:
    """Compensation of one log, block by block, by the calibrations of the calibrated sensors.

    ``smoothing``, s, is the memory of the temperature's smoothing (``pipeline.physics.measurement``); 0: none.
    """

    def __init__(self, unit: str, calibrations: dict[str, SensorCalibration], smoothing: float) -> None:
        self.unit, self.smoothing = unit, smoothing
        self.steps = {s: Steps.of(s, measurement.sensor_effects(c)) for s, c in calibrations.items()}
        self._steady = {s: measurement.SensorEffects.of(c, self.steps[s].steady) for s, c in calibrations.items()}
        self._moving = {s: measurement.SensorEffects.of(c, self.steps[s].moving) for s, c in calibrations.items()}
        self._linear = {s: measurement.SensorEffects.of(c, ()) for s, c in calibrations.items()}
        self._line = measurement.ExponentialRegression(smoothing or 1.0)
        self._slope = measurement.ExponentialRegression(max(smoothing, RATE_SMOOTHING_S))
        self._ends = [measurement.LogEnd()]  # of the last block, one for each iteration

    @property
    def needs(self) -> set[str]:
        """Signals that the effects need: ``accelerometer``, ``gyroscope``, ``temperature``, ``time``."""
        return set().union(*(step.needs(effect) for step in self.steps.values() for effect in step.fields))

    def apply(
        self,
        accelerometer: Any = None,  # noqa: ANN401
        gyroscope: Any = None,  # noqa: ANN401
        temperature: Any = None,  # noqa: ANN401
        time: Any = None,  # noqa: ANN401
    ) -> Compensated:
        """Return the calibrated readings of the next sample or block; parameters as of ``Compensation.apply``."""
        given = {"accelerometer": accelerometer, "gyroscope": gyroscope, "temperature": temperature, "time": time}
        arrays, single = _checked(given)
        for sensor in set(self.steps) & set(arrays):
            for effect in self.steps[sensor].fields:
                missing = sorted(self.steps[sensor].needs(effect) - set(arrays))
                if missing:
                    raise InputError(
                        f"the {sensor} of unit {self.unit} was calibrated with the effect {effect}, "
                        f"which needs {' and '.join(missing)}: give that too, or calibrate without the effect"
                    )
        sensors = [s for s in SENSORS if s in arrays]
        n = len(arrays[sensors[0]])
        found = {s: np.empty((n, 3)) if s in self.steps else arrays[s] for s in sensors}
        for start in range(0, n, BLOCK):
            block = slice(start, start + BLOCK)
            # doubles, contiguous axis by axis, the order in which they are processed
            cut = {name: np.asarray(a[block], np.float64, order="F") for name, a in arrays.items()}
            for s, truth in self._block(cut).items():
                if s in self.steps:
                    found[s][block] = truth
        shaped = {s: value[0] if single else value for s, value in found.items()}
        return Compensated(shaped.get("accelerometer"), shaped.get("gyroscope"))

    def _block(self, arrays: Mapping[str, Values]) -> Truths:
        readings = {s: arrays[s] for s in SENSORS if s in arrays}
        steps = {s: self.steps[s] for s in readings if s in self.steps}
        used = set().union(*(step.used for step in steps.values()))
        zeros = np.zeros_like(next(iter(readings.values()))) if used else np.zeros((0, 3))
        clock, warm = arrays.get("time", zeros[:, 0]), arrays.get("temperature")
        if warm is not None and "time" in arrays and used & {"temperature", "temperature_rate"} and self.smoothing > 0:
            warm = self._line.apply(clock, warm)
        warming = None
        if warm is not None and "temperature_rate" in used:
            warming = self._slope.apply(clock, warm, slope=True)
        motion_of = partial(measurement.log_motion, clock, temperature=warm, temperature_rate=warming)

        def true_motion(truths: Truths, number: int) -> Motion:
            force, rate = truths.get("accelerometer", zeros), truths.get("gyroscope", zeros)
            end = self._ends[min(number, len(self._ends) - 1)]
            return motion_of(specific_force=force, angular_rate=rate, used=used, end=end)

        if any(step.steady for step in steps.values()):
            room = motion_of(specific_force=zeros, angular_rate=zeros, used=set(), end=measurement.LogEnd())
            readings |= {s: self._steady[s].take_off(readings[s], room) for s in steps}
        return self._solved(steps, readings, true_motion, used & OF_THE_PAST)

    def _solved(
        self, steps: dict[str, Steps], readings: Truths, true_motion: Callable[[Truths, int], Motion], past: set[str]
    ) -> Truths:
        """Subtract the effects that depend on the truth; store the end of the block for each iteration."""
        turns = circular(steps)
        once = {s: self._moving[s] for s, step in steps.items() if step.moving and s not in turns}
        ends: list[measurement.LogEnd] = []

        def motion_of(truths: Truths, number: int) -> Motion:
            motion = true_motion(truths, number)
            if past:
                ends.append(self._ends[min(number, len(self._ends) - 1)].after(motion, past))
            return motion

        steps_of = {s: self._moving[s] if s in turns else self._linear[s] for s in steps}
        truths = measurement.solve(steps_of, readings, motion_of)
        settled = len(ends)
        for iteration in range(settled, max(settled + 1, len(self._ends)) if turns and past else settled):
            motion_of(truths, iteration)
        if once:
            motion = true_motion(truths, len(self._ends)) if turns else motion_of(truths, 0)
            truths |= measurement.without_effects(once, readings, motion)
        self._ends = ends or self._ends
        return truths


def _checked(given: Mapping[str, ArrayLike | None]) -> tuple[dict[str, NDArray[Any]], bool]:
    """Return the signals that are given as arrays of one length, and whether it was a single sample."""
    if given["accelerometer"] is None and given["gyroscope"] is None:
        raise InputError("give accelerometer, gyroscope or both: there is nothing to compensate")
    arrays = {name: np.asarray(value) for name, value in given.items() if value is not None}
    sensor = next(s for s in SENSORS if s in arrays)
    single = arrays[sensor].ndim == 1
    if single:
        arrays = {s: a[None] if s in SENSORS else np.atleast_1d(a) for s, a in arrays.items()}
    n = len(arrays[sensor])
    for name, array in arrays.items():
        expected = (n, 3) if name in SENSORS else (n,)
        if array.shape != expected:
            raise InputError(f"{name} has the shape {array.shape}; expected {expected}, as of the {sensor}")
    return arrays, single


@dataclass(frozen=True)
class Compensation:
    """The calibration of a unit, ready to be applied to arrays; readings of a sensor without one pass unchanged.

    ``covariances``: sensor to the covariance of a calibrated sample, (3, 3) array in g^2 or (deg/s)^2, where known.
    ``calibrated_range``: of that name in ``calibrations/<unit>.json``; empty where it is not known.
    """

    accelerometer: SensorCalibration | None
    gyroscope: SensorCalibration | None
    unit: str = ""
    covariances: Mapping[str, Values] = field(default_factory=dict)
    calibrated_range: Mapping[str, float | list[float]] = field(default_factory=dict)

    def apply(
        self,
        accelerometer: Any = None,  # noqa: ANN401  (what numpy takes for an array)
        gyroscope: Any = None,  # noqa: ANN401
        temperature: Any = None,  # noqa: ANN401
        time: Any = None,  # noqa: ANN401
        *,
        smoothing: float = SMOOTHING_S,
    ) -> Compensated:
        """Return the calibrated readings of a log, or of a single sample, in the shapes that were given.

        ``accelerometer``: (n, 3) or (3,), g; ``gyroscope``: the same, deg/s. ``temperature``: (n,) or a float, degC, if
        a fitted effect needs it. ``time``: (n,) or a float, s since power-on, likewise; with it the temperature is
        smoothed, causally, with the memory ``smoothing``, s (``pipeline.physics.measurement``); 0: none. Raises
        ``InputError`` if neither sensor is given, shapes do not match, or an effect needs a signal that is not given.
        """
        return self.stream(smoothing).apply(accelerometer, gyroscope, temperature, time)

    def stream(self, smoothing: float = SMOOTHING_S) -> CompensationStream:
        """Return an object whose ``apply`` takes a log block by block, with the same result as in one piece."""
        known = {s: c for s in SENSORS if (c := self.calibration(s)) is not None}
        return CompensationStream(self.unit, known, smoothing)

    def calibration(self, sensor: str) -> SensorCalibration | None:
        """Return the calibration of ``accelerometer`` or ``gyroscope``."""
        return self.accelerometer if sensor == "accelerometer" else self.gyroscope


def load(path: str | Path, python_effects: Sequence[str | Path] = ()) -> Compensation:
    """Read ``calibrations/<unit>.json``; parameters and errors as of ``pipeline.load_calibration``."""
    for python_file in python_effects:
        register(load_python_effect(python_file))
    file = Path(path)
    return compensation_of(read_calibration(file), file)


def compensation_of(document: dict[str, Any], file: Path | None = None) -> Compensation:
    """Return the calibration of a document (``calibrations/<unit>.json``); ``file`` names it in errors."""
    accelerometer, gyroscope = (sensor_of(document, sensor, file or Path()) for sensor in SENSORS)
    covariances = {s: c for s in SENSORS if (c := sample_covariance(document, s)) is not None}
    known = document.get("calibrated_range", {})
    return Compensation(accelerometer, gyroscope, str(document.get("unit", "")), covariances, known)
