"""``calibrations/<unit>.json`` read and checked, so that what is applied to a log is what was fitted.

A file may have been changed by hand, cut, or written by another version. Every fault is an ``InputError`` that names
the file, the key and what was expected there.
"""

from __future__ import annotations

import json
import math
import stat
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from pipeline.errors import ConfigurationError, InputError, MissingInputError
from pipeline.model.effects import effect_of
from pipeline.records import SENSOR_UNITS, SENSORS, FittedEffect, SensorCalibration

if TYPE_CHECKING:
    from pathlib import Path

SCHEMA_VERSION = 1
# Readings in another unit or range are calibrated by a matrix of that factor: 16 between the ranges of an accelerometer
# (2 to 32 g), 32 between those of a gyroscope (125 to 4000 deg/s), 57 for rad/s, 1000 for mg and mdps.
LARGEST_FACTOR = 1000.0
# Two axes 1 deg apart have a condition of 2 / sin(1 deg) = 115; a sensor's axes are 90 deg apart within some degrees.
LARGEST_CONDITION = 100.0


def read_calibration(file: Path) -> dict[str, Any]:
    """Return the document of a calibrated unit.

    Parameters
    ----------
    file : Path

    Raises
    ------
    MissingInputError
        If the file does not exist.
    InputError
        If it is no file, no JSON, holds a key twice or a number that is not finite, is of another schema version, is
        the record of a failed unit, or holds no calibrated sensor.
    """
    try:
        mode = file.stat().st_mode
        if not stat.S_ISREG(mode):
            kind = "a directory" if stat.S_ISDIR(mode) else "a pipe or a device"
            _refuse(file, f"this is {kind}; expected a file calibrations/<unit>.json")
        document = json.loads(
            file.read_text(encoding="utf-8"), object_pairs_hook=_without_repeats, parse_constant=_not_finite
        )
    except FileNotFoundError:
        raise MissingInputError("there is no such calibration", str(file)) from None
    except (OSError, RecursionError, ValueError) as error:  # ValueError: no UTF-8, no JSON, or refused below
        _refuse(file, f"this is no calibration of a unit: {error}")
    if not isinstance(document, dict) or "status" not in document:
        _refuse(file, "this is no calibration of a unit: it has no status; expected calibrations/<unit>.json")
    version = document.get("schema_version")
    if version != SCHEMA_VERSION or isinstance(version, bool):
        shown = "missing" if version is None else repr(version)
        _refuse(file, f"schema_version is {shown}; this version reads {SCHEMA_VERSION}: calibrate the unit anew")
    if document["status"] == "failed":
        told = document.get("error")
        cause = told.get("message", "unknown") if isinstance(told, dict) else "unknown"
        _refuse(file, f"unit {document.get('unit')} failed and has no calibration; cause: {cause}")
    if document["status"] != "ok":
        _refuse(file, f'status is {document["status"]!r}; expected "ok" or "failed"')
    missing = [sensor for sensor in SENSORS if sensor not in document]
    if missing:
        _refuse(file, f"{missing[0]} is missing; expected an object, or null where it is not calibrated")
    if all(document[sensor] is None for sensor in SENSORS):
        reasons = document.get("not_calibrated")
        told = "; ".join(map(str, reasons.values())) if isinstance(reasons, dict) and reasons else "not stated"
        _refuse(file, f"accelerometer and gyroscope are null: there is nothing to apply; reason: {told}")
    return document


def sensor_of(document: dict[str, Any], sensor: str, file: Path) -> SensorCalibration | None:
    """Return the calibration of one sensor; None where it is not calibrated.

    Parameters
    ----------
    document : dict
        Of ``read_calibration``.
    sensor : str
    file : Path
        For messages.

    Raises
    ------
    InputError
        If unit, bias, matrix, covariance or an effect is not what it should be.
    ConfigurationError
        If an effect is not known.
    """
    part = document[sensor]
    if part is None:
        return None
    if not isinstance(part, dict):
        _refuse(file, f"{sensor} is {_shown(part)}; expected an object or null")
    if part.get("unit") != SENSOR_UNITS[sensor]:
        _refuse(file, f"{sensor}.unit is {_shown(part.get('unit'))}; expected {SENSOR_UNITS[sensor]!r}")
    _numbers(file, f"{sensor}.bias", part.get("bias"), (3,))
    matrix = _numbers(file, f"{sensor}.matrix", part.get("matrix"), (3, 3))
    _check_matrix(file, f"{sensor}.matrix", matrix)
    covariance = part.get("covariance")
    if not isinstance(covariance, dict) or not isinstance(covariance.get("parameters"), list):
        _refuse(file, f"{sensor}.covariance is {_shown(covariance)}; expected an object with parameters and values")
    size = len(covariance["parameters"])
    _numbers(file, f"{sensor}.covariance.values", covariance.get("values"), (size, size) if size else (0,))
    _check_effects(file, f"{sensor}.effects", sensor, part.get("effects"))
    try:
        return SensorCalibration.from_json(sensor, part)
    except KeyError as error:
        _refuse(file, f"{sensor}.{error.args[0]} is missing")
    except (TypeError, ValueError, AttributeError) as error:
        _refuse(file, f"{sensor}: this is no calibration of a unit: {error}")


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


def _check_effects(file: Path, key: str, sensor: str, effects: object) -> None:
    if not isinstance(effects, list):
        _refuse(file, f"{key} is {_shown(effects)}; expected a list")
    for i, entry in enumerate(effects):
        where = f"{key}[{i}]"
        if not isinstance(entry, dict) or not isinstance(entry.get("name"), str):
            _refuse(file, f"{where} is {_shown(entry)}; expected an object with name and parameters")
        if entry["name"] in [before["name"] for before in effects[:i]]:
            _refuse(file, f"{where} is {entry['name']} a second time; expected each effect once")
        _check_effect(file, where, sensor, entry)


def _check_effect(file: Path, where: str, sensor: str, entry: dict[str, Any]) -> None:
    name, parameters, definition = entry["name"], entry.get("parameters"), entry.get("definition")
    if set(entry) - {"name", "parameters", "definition"} or not isinstance(definition, dict | None):
        _refuse(file, f"{where} ({name}) has the keys {', '.join(entry)}; expected name, parameters, definition")
    if not isinstance(parameters, dict) or not all(isinstance(p, dict) for p in parameters.values()):
        _refuse(file, f"{where}.parameters ({name}) is {_shown(parameters)}; expected an object of objects")
    try:
        effect = effect_of(FittedEffect(name, parameters, definition))
    except ConfigurationError as error:
        raise ConfigurationError(f"{where}: {error.message}", str(file)) from None
    known = effect.parameters(sensor) if sensor in effect.sensors else ()
    if list(parameters) != [p.name for p in known]:
        listed = ", ".join(p.name for p in known) or f"none: it is no effect of the {sensor}"
        _refuse(file, f"{where}.parameters ({name}) are {', '.join(parameters) or 'none'}; expected {listed}")
    for symbol, unit in ((p.name, p.unit) for p in known):
        at = f"{where}.parameters.{symbol}"
        _numbers(file, f"{at}.value ({name})", parameters[symbol].get("value"), ())
        stated = parameters[symbol].get("unit")
        if stated not in ("", unit):  # empty: not stated
            _refuse(file, f"{at}.unit ({name}) is {_shown(stated)}; expected {unit!r}")


def _numbers(file: Path, key: str, value: object, shape: tuple[int, ...]) -> np.ndarray:
    """Return finite numbers of a shape; a bool or a text that reads as a number is none."""
    expected = "a finite number" if not shape else f"{' x '.join(map(str, shape))} finite numbers"
    if not _is_nested(value, shape):
        _refuse(file, f"{key} is {_shown(value)}; expected {expected}")
    return np.array(value, float)


def _is_nested(value: object, shape: tuple[int, ...]) -> bool:
    if not shape:
        return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    return isinstance(value, list) and len(value) == shape[0] and all(_is_nested(v, shape[1:]) for v in value)


def _shown(value: object) -> str:
    if value is None:
        return "missing or null"
    text = json.dumps(value, default=str)
    return text if len(text) <= 80 else f"{text[:77]}..."


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
