"""Exports read back: the file of a format to the calibration that it holds.

The declaration of a template states under ``reads`` how its file is read, next to the text that writes it: the kind of
text, and for each sensor where it stands in the file and one expression for each quantity (``SensorRead``).

    bias | bias_after_matrix | bias_polynomial,   matrix | K,   g_sensitivity, scale_factor_temperature, bias_deviation

``truth = matrix (reading - bias - effects)`` in the unit of the format; ``K = matrix^-1``.
"""

from __future__ import annotations

import json
import re
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from jinja2 import TemplateError
from yaml import YAMLError

from pipeline.errors import ConfigurationError, InputError, MissingInputError
from pipeline.exports import formats, text_kinds
from pipeline.exports.sensors import FACTORS, FUNCTIONS
from pipeline.io.files import read_text
from pipeline.model.calibration_file import read_calibration, sensor_of
from pipeline.model.effects import effect
from pipeline.pack import is_published, read_published
from pipeline.records import SENSORS, FittedEffect, SensorCalibration

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from pipeline.exports import Format
    from pipeline.records import Values

CALIBRATION = "calibration.json"  # the name of the product's own format among the formats
LARGEST_BYTES = 50_000_000  # of a file to read; a calibration has some kilobytes, a vehicle's parameters 100
NEAR_ONE = (0.5, 2.0)  # what a matrix multiplies by where readings and truth have the same unit
C_EFFECT = re.compile(r"r\[\d\] -= .*/\* (\w+) \*/")  # a line of calibration.h
TURNED = re.compile(r"Turn the readings to body axes first: [^.]*\.")  # a remark of our own exports
SAME = 1e-12  # relative to the largest: what is smaller is rounding of the formats' own arithmetic


@dataclass(frozen=True)
class FoundCalibration:
    """A calibration as a file holds it.

    Attributes
    ----------
    sensors : dict of str to SensorCalibration
        Those that the file holds; the covariance is None where it states no uncertainty.
    noise : dict
        Kalibr's four noise parameters (``pipeline.exports.sensors``), as far as the file states them.
    notes : list of str
        What was taken for granted or not read.
    document : dict or None
        ``calibrations/<unit>.json``, where the file is one.
    """

    name: str
    unit: str
    sensors: dict[str, SensorCalibration]
    noise: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    document: dict[str, Any] | None = None


def read_any(file: Path, name: str | None = None, counts: Mapping[str, float | None] | None = None) -> FoundCalibration:
    """Read a calibration in any format; where a format has a file for each sensor, from either of them.

    ``name``: of the format, or its beginning (``format_of``), found from the file's name and content where not given;
    ``counts``: sensor to its counts per g or deg/s, for formats in counts. ``ConfigurationError``: no format, or
    several, have this name; ``InputError``: the file does not hold what the format needs.
    """
    stated = None if name is None else format_of(name)
    if not is_published(file):
        raise MissingInputError("there is no such calibration", str(file))
    text = _text(file)
    name = stated or _recognised(file, text)
    if name == CALIBRATION:
        document = read_calibration(file)
        own = {s: c for s in SENSORS if (c := sensor_of(document, s, file)) is not None}
        for sensor, c in own.items():  # a published one holds zeros where no uncertainty is known
            if c.covariance is None or not np.any(np.diag(c.covariance) > 0.0):
                own[sensor] = replace(c, covariance=None)
        return FoundCalibration(name, str(document["unit"]), own, document=document)
    declared = formats()[name][0]
    if not declared.reads:
        raise InputError(f"the format {name} holds no calibration that can be read: {declared.equation}", str(file))
    parts = [_read_text(each, name, declared, counts or {}) for each in _files_of(file, declared)]
    sensors = {s: c for part in parts for s, c in part.sensors.items()}
    notes = [f"read together with it: {each.name}" for each in _files_of(file, declared) if each != file]
    return replace(parts[0], sensors=sensors, notes=[*notes, *(note for part in parts for note in part.notes)])


def _files_of(file: Path, declared: Format) -> list[Path]:
    """Return the file, and that of the other sensor in the same folder, where each has its own."""
    ends = [name.rpartition("_")[2] for name in declared.files.values()]
    own = next((end for end in ends if file.name.endswith(end)), None)
    if own is None:
        return [file]
    found = [file.with_name(file.name.removesuffix(own) + end) for end in ends]
    return [each for each in found if is_published(each)]


def _text(file: Path) -> str:
    return read_text(file, LARGEST_BYTES, "a calibration") if file.exists() else read_published(file).decode()


def _read_text(file: Path, name: str, declared: Format, counts: Mapping[str, float | None]) -> FoundCalibration:
    text = _text(file)
    try:
        found = _read(file, name, declared, text_kinds.parsed(declared.reads["text"], text), counts)
    except (TemplateError, YAMLError, KeyError, ValueError, TypeError, np.linalg.LinAlgError) as error:
        told = error.args[0] if isinstance(error, KeyError) else error
        raise InputError(f"this is no {name} ({declared.consumer}): {told}", str(file)) from error
    found.notes.extend(TURNED.findall(text))
    if effects := dict.fromkeys(C_EFFECT.findall(text)):
        found.notes.append(f"effects in C expressions, which are not read: {', '.join(effects)}")
    return found


def counts_of(sheets: Mapping[str, Any]) -> dict[str, float | None]:
    """Return the counts per g or deg/s of each sensor, from its part of the sensor's configuration; None: not known."""
    return {s: (sheets.get(s) or {}).get("counts_per_unit") for s in SENSORS}


def format_of(given: str) -> str:
    """Return the format that a name or the beginning of a name stands for."""
    known = [CALIBRATION, *formats()]
    found = [name for name in known if given in (name, name.partition(".")[0])]
    found = found or [name for name in known if name.startswith(given)]
    if len(found) == 1:
        return found[0]
    raise ConfigurationError(f"{given} is the name of {'several formats' if found else 'no format'}: "
                             f"{', '.join(found or known)}; choose one (convert --from, --to)")  # fmt: skip


def _recognised(file: Path, text: str) -> str:
    """Return the name of the only format whose keys a file has."""
    known = {name: declared for name, (declared, _) in formats().items()}
    if file.name in known:
        return file.name
    found = []
    for name, declared in known.items():
        with suppress(ValueError, YAMLError):
            if declared.reads and _sensors_in(file, declared, text_kinds.parsed(declared.reads["text"], text)):
                found.append(name)
    with suppress(ValueError):
        document = json.loads(text)
        if isinstance(document, dict) and {"schema_version", "status", *SENSORS} <= set(document):
            found = [CALIBRATION]
    if len(found) == 1:
        return found[0]
    listed = ", ".join(found or [CALIBRATION, *(n for n, d in known.items() if d.reads)])
    reason = "the file fits several formats" if found else "the file has the keys of no format"
    raise InputError(f"{reason}: {listed}; name it (convert --from, method.format)", str(file))


def _sensors_in(file: Path, declared: Format, content: text_kinds.Node) -> dict[str, dict[str, str]]:
    """Return the expressions of the sensors that stand in a file."""
    reads = declared.reads
    if declared.files:  # the end of its name tells the sensor
        ends = {s: name.rpartition("_")[2] for s, name in declared.files.items()}
        chosen = [s for s in SENSORS if file.name.endswith(ends[s])] if content.has(reads["sensor"]["where"]) else []
        return {s: dict(reads["sensor"]) for s in chosen}
    return {s: reads[s] for s in SENSORS if s in reads and content.has(reads[s]["where"])}


def _read(
    file: Path, name: str, declared: Format, content: text_kinds.Node, counts: Mapping[str, float | None]
) -> FoundCalibration:
    sensors = _sensors_in(file, declared, content)
    if not sensors:
        wanted = ", ".join(declared.files.values()) or ", ".join(str(declared.reads[s]["where"]) for s in SENSORS
                                                                   if s in declared.reads)  # fmt: skip
        raise InputError(f"this is no {name} ({declared.consumer}): expected {wanted}", str(file))
    known = {s: counts.get(s) for s in SENSORS}
    lacking = [s for s in declared.needs_counts if s in sensors and not known[s]]
    if lacking:
        raise InputError(f"{name} is in counts: state the sensor, whose config knows the counts per unit", str(file))
    tree = text_kinds.Expressions({**FUNCTIONS, "file": content, "counts": known})
    notes: list[str] = []
    found = {}
    for s, expressions in sensors.items():
        tree.globals |= {key: tree.value(e) for key, e in declared.reads.get("let", {}).items()}
        if "model" in expressions:
            tree.globals["model"] = tree.value(expressions["model"])
        values = {key: tree.value(e) for key, e in expressions.items() if key not in ("where", "model")}
        found[s] = _calibration(s, declared, values, known[s], notes)
    noise = {key: float(np.ravel(content.at(path))[0]) for key, path in declared.reads.get("noise", {}).items()
             if content.has(path) and content.at(path) is not None}  # fmt: skip
    unread = content.unread()
    if unread:
        more = f" and {len(unread) - 12} more" if len(unread) > 12 else ""
        notes.append(f"not read: {', '.join(unread[:12])}{more}")
    notes += [f"{s}: the file states no bias; it counts as 0" for s, c in found.items() if not np.any(c.bias)]
    return FoundCalibration(name, file.stem, found, noise, notes)


def _calibration(
    sensor: str, declared: Format, values: Mapping[str, Any], counts: float | None, notes: list[str]
) -> SensorCalibration:
    """Return the calibration in g and deg/s that the values of a format's expressions are."""
    factor = FACTORS[declared.units[sensor]]
    held = {key: np.asarray(value, float) for key, value in values.items()}
    matrix = held["matrix"].reshape(3, 3) if "matrix" in held else np.linalg.inv(held["K"].reshape(3, 3))
    if "bias_polynomial" in held:
        polynomial = held["bias_polynomial"].reshape(3, -1)
    elif "bias_after_matrix" in held:
        polynomial = np.linalg.solve(matrix, held["bias_after_matrix"].ravel())[:, None]
    else:
        polynomial = held["bias"].reshape(3, 1)
    raw = factor  # units of the format per g or deg/s of a reading
    sizes = np.linalg.svd(matrix, compute_uv=False)
    if not NEAR_ONE[0] < sizes[2] <= sizes[0] < NEAR_ONE[1]:
        if counts is None or not NEAR_ONE[0] < sizes[2] * counts / factor <= sizes[0] * counts / factor < NEAR_ONE[1]:
            raise ValueError(
                f"the matrix of the {sensor} multiplies readings by {sizes[2]:.3g} to {sizes[0]:.3g}: they are not in "
                f"{declared.units[sensor]}, and not in the counts of the sensor that is stated "
                f"({counts or 'none; state it'})"
            )
        notes.append(f"{sensor}: readings in counts, {counts:g} per unit: its matrix multiplies by {sizes[0]:.3g}")
        matrix, raw = matrix * counts / factor, counts
    if not all(np.isfinite(array).all() for array in (polynomial, matrix)):
        raise ValueError(f"{sensor}: a number is not finite")
    polynomial = polynomial / raw
    if np.any(np.abs(held.get("left_out", 0.0)) > 0.0):
        most = float(np.abs(held["left_out"]).max())
        notes += [f"{sensor}: cross-axis terms change by up to {most:.2g} per degC, which is not read"] * (most > SAME)
    effects = _thermal(sensor, polynomial, notes)
    for name, unit in (("g_sensitivity", raw), ("scale_factor_temperature", 1.0)):
        if np.any(values_of := held.get(name, np.zeros(1))):
            effects.append(_fitted(name, sensor, values_of.ravel() / unit))
    covariance = None
    if "bias_deviation" in held and np.any(held["bias_deviation"]):
        size = 12 + sum(len(e.parameters) for e in effects)
        covariance = np.zeros((size, size))
        covariance[:3, :3] = np.diag((held["bias_deviation"].ravel() / raw) ** 2)
        notes.append(f"{sensor}: the file states an uncertainty of the bias, and none of the matrix")
    return SensorCalibration(sensor, polynomial[:, 0], matrix, effects=tuple(effects), covariance=covariance)


def _thermal(sensor: str, polynomial: Values, notes: list[str]) -> list[FittedEffect]:
    """Return the effect of a bias that follows the temperature: a polynomial in T - 25 degC, (3, k) array."""
    polynomial = np.where(np.abs(polynomial) > SAME * np.abs(polynomial).max(), polynomial, 0.0)
    if np.any(polynomial[:, 3:]):
        notes.append(f"{sensor}: the bias beyond the second order of the temperature is left out")
    if np.any(polynomial[:, 2:3]):
        return [_fitted("bias_temperature_quadratic", sensor, polynomial[:, 1:3].ravel())]
    return [_fitted("bias_temperature", sensor, polynomial[:, 1])] if np.any(polynomial[:, 1:2]) else []


def _fitted(name: str, sensor: str, values: Values) -> FittedEffect:
    """Return a built-in effect with its values, whose uncertainty is not known."""
    named = zip(effect(name).parameters(sensor), values.tolist(), strict=True)
    return FittedEffect(name, {p.name: {"value": v, "unit": p.unit, "expanded_uncertainty": None} for p, v in named})
