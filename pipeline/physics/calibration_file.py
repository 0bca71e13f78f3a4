"""Read and check ``calibrations/<unit>.json``.

The file may have been edited, truncated, or written by another version. Every fault is an ``InputError`` that names
the file, the key, its value and what was expected.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

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
    SensorCalibration,
    Values,
)
from pipeline.physics.effects import effect_of

# Readings in another unit or range are calibrated by a matrix of that factor: 16 between the ranges of an accelerometer
# (2 to 32 g), 32 between those of a gyroscope (125 to 4000 deg/s), 57 for rad/s, 1000 for mg and mdps.
LARGEST_FACTOR = 1000.0
# Two axes 1 deg apart have a condition of 2 / sin(1 deg) = 115; a sensor's axes are 90 deg apart within some degrees.
LARGEST_CONDITION = 100.0

# estimators average over longer times, between two images or scans: a faster process counts as white
MIN_EXPORTED_TIME_S = 0.1
WHAT_TO_DO = "take the file as the run published it, or calibrate the unit anew"

_VECTOR = items(number, 3)
_EFFECT = fields(
    {
        "name": text,
        "parameters": each(fields({"value": number, "unit": or_none(text)}, ("value",), others=True)),
        "definition": or_none(mapping),
    },
    ("name", "parameters"),
)
_COVARIANCE = fields(
    {"parameters": items(text), "values": items(items(or_none(number)))}, ("parameters", "values"), others=True
)
_STAGE = fields(
    {
        "name": text,
        "parameters": mapping,
        "residual_rms": or_none(number),
        "correction": or_none(mapping),
        "details": mapping,
    },
    ("name", "parameters"),
)
_TEMPERATURES = dict.fromkeys(("temperature_degc", "soaked_degc"), items(number, 2))
_RANGE = fields({"specific_force_g": number, "angular_rate_dps": number, **_TEMPERATURES}, ())


def _sensor(unit: str) -> Check:
    required = {
        "unit": one_of(unit),
        "bias": _VECTOR,
        "matrix": items(_VECTOR, 3),
        "covariance": _COVARIANCE,
        "effects": items(_EFFECT),
        "stages": items(_STAGE),
        "converged": flag,
        "degrees_of_freedom": or_none(number),
    }
    optional = {"effective_degrees_of_freedom": or_none(items(or_none(number)))}
    return fields({**required, **optional}, required, others=True)


_DOCUMENT = fields(
    {
        "status": one_of("ok"),
        "calibrated_range": _RANGE,
        **{sensor: or_none(_sensor(unit)) for sensor, unit in SENSOR_UNITS.items()},
    },
    ("status", *SENSORS),
    others=True,
)


def read_calibration(file: Path) -> dict[str, Any]:
    """Return the document of a calibrated unit.

    Raises ``MissingInputError`` if the file does not exist, ``InputError`` if it cannot be read, belongs to another
    schema version or to a failed unit, holds no calibrated sensor, or a value is not what is expected.
    """
    try:
        if file.exists() and (other := not_regular(file)):
            _refuse(file, f"this {other}")
        document = json.loads(
            read_published(file).decode(), object_pairs_hook=_without_repeats, parse_constant=_not_finite
        )
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
