"""Read a calibration from a file in one of the formats.

The declaration of a template states under ``read_back`` how its file is read: the ``kind`` of text
(``pipeline.output.exports.text_kinds``), and for each sensor ``where``, the path of a value that exists only if the
file contains this sensor, and an expression for each quantity:

    bias | bias_after_matrix | bias_polynomial,   matrix | K,   g_sensitivity, scale_factor_temperature, bias_deviation

``truth = matrix (reading - bias - effects)`` in the unit of the format; ``K = matrix^-1``.

Convert a calibration into another format, and explain a calibration in words and numbers.

The losses of a conversion are found by reading the written file back and comparing it. The explanation states the
equation, the order of its operations, its signs, and a worked example.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import TemplateError

from imu_logs.files import read_text
from pipeline.core.errors import ConfigurationError, InputError, MissingInputError, shortened
from pipeline.core.files import JSON, json_text, write_atomically
from pipeline.core.pack import is_published, read_published
from pipeline.core.records import (
    BASE_COUNT,
    BIAS,
    MATRIX,
    SCHEMA_VERSION,
    SENSOR_UNITS,
    SENSORS,
    STRAIGHT,
    FittedEffect,
    SensorCalibration,
    Values,
    maps_of_log,
)
from pipeline.output.exports import ExportedUnit, Format, export, formats, text_of
from pipeline.output.exports.sensors import SI, TEMPLATE_FUNCTIONS, UNIT_FACTORS, SensorFigures, before_use
from pipeline.output.exports.text_kinds import Expressions, Node, parsed
from pipeline.physics.compensation import Compensation, read_calibration, sensor_of
from pipeline.physics.effects import effect_of, fitted_effect
from pipeline.physics.measurement import sensor_effects

Counts = Mapping[str, float | None]  # sensor to its counts per g or deg/s, None if not stated

CALIBRATION = "calibration.json"  # name of the format of ``calibrations/<unit>.json``
# of a file to read; a calibration has some kilobytes, the parameters of a vehicle 100
MAX_CALIBRATION_BYTES = 50_000_000
UNIT_SCALE = (0.5, 2.0)  # range of the singular values of a matrix if readings and truth have the same unit
EFFECT_IN_C = re.compile(r"r\[\d\] -= .*/\* (\w+) \*/")  # a line of calibration.h
TURNED_READINGS = re.compile(r"Turn\s+the\s+readings\s+to\s+body\s+axes\s+first:\s[^.]*\.")  # a remark in our exports
FRAME_REMARK = re.compile(r"the (\w+)'s x along")  # in such a remark: a sensor, or "sensor" for both
BODY_AXIS = re.compile(r"along body ([+-][xyz])")
NOISE_ALONE = re.compile(r"^\s*(accelerometer|gyroscope)_noise_density\s*:", re.MULTILINE)  # Kalibr's imu.yaml
FORMAT_ROUNDING = 1e-12  # rounding errors of the formats' arithmetic, relative to the largest number
CONVERSION_TOLERANCE = 1e-9  # g, deg/s or 1: smaller differences of a converted parameter are rounding
WALK_S = 100.0  # correlation time of the wander that represents a random walk: K = s sqrt(2 / T), for any T
NUMBER = re.compile(r"\d+\.\d+(?:e[-+]?\d+)?")
# The worked example: a tilted body that turns, above the reference temperature.
SAMPLE: dict[str, Any] = {"accelerometer": np.array([0.1, -0.2, 0.97]), "gyroscope": np.array([10.0, -20.0, 30.0])}
SAMPLE |= {"temperature": 35.0, "time": 600.0}


@dataclass(frozen=True)
class ImportedCalibration:
    """A calibration from a file."""

    format_name: str
    unit: str  # stem of the file if the format has no name of the unit
    sensors: dict[str, SensorCalibration]  # the covariance is None if the file states no uncertainty
    noise: dict[str, float] = field(default_factory=dict)  # the stated ones of Kalibr's four parameters
    notes: list[str] = field(default_factory=list)  # assumptions, and values that were not read
    document: dict[str, Any] | None = None  # ``calibrations/<unit>.json``, if the file is in this format
    validation: dict[str, Any] | None = None  # ``validations/<unit>.json`` beside it: what formats that hold less get
    stated_axes: dict[str, tuple[str, ...]] = field(default_factory=dict)  # axis map of each sensor; empty: not stated

    @property
    def axis_maps(self) -> dict[str, tuple[str, ...]]:
        """Sensor to the body axes along which its reading axes point."""
        log = {"axis_map": self.stated_axes} if self.document is None else self.document.get("log")
        return maps_of_log(log or {})


def read_any(file: Path, format_name: str | None = None, counts: Counts | None = None) -> ImportedCalibration:
    """Read a calibration in any format; if the format has a file for each sensor, ``file`` is one of them.

    ``format_name``: a name or its beginning (``format_of``), by default found from name and content of the file;
    ``counts``: sensor to its counts per g or deg/s, for formats in counts. Raises ``ConfigurationError`` if no format
    or several formats have this name, ``InputError`` if the file lacks values that the format needs.
    """
    name = None if format_name is None else format_of(format_name)
    if not is_published(file):
        raise MissingInputError("there is no such calibration", str(file))
    text = _text(file)
    name = name or _recognised(file, text)
    if name == CALIBRATION:
        document = read_calibration(file)
        sensors = {s: c for s in SENSORS if (c := sensor_of(document, s, file)) is not None}
        for s, c in sensors.items():  # a published calibration has zeros for an unknown uncertainty
            if c.covariance is None or not np.any(np.diag(c.covariance) > 0.0):
                sensors[s] = replace(c, covariance=None)
        beside = file.parent.parent / "validations" / file.name
        known = file.parent.name == "calibrations" and is_published(beside)
        validation = json.loads(_text(beside)) if known else None
        return ImportedCalibration(name, str(document["unit"]), sensors, document=document, validation=validation)
    declared = formats()[name][0]
    if not declared.read_back:
        raise InputError(f"the format {name} holds no calibration that can be read: {declared.equation}", str(file))
    files = _files_of(file, declared)
    parts = [_read_file(each, name, declared, counts or {}) for each in files]
    sensors = {s: c for part in parts for s, c in part.sensors.items()}
    notes = [f"read together with it: {each.name}" for each in files if each != file]
    return replace(parts[0], sensors=sensors, notes=[*notes, *(note for part in parts for note in part.notes)])


def _files_of(file: Path, declared: Format) -> list[Path]:
    """Return the file and, if each sensor has a separate file, the file of the other sensor in the same folder."""
    endings = declared.sensor_endings.values()
    ending = next((e for e in endings if file.stem.endswith(e)), None)
    if ending is None:
        return [file]
    files = [file.with_stem(file.stem.removesuffix(ending) + e) for e in endings]
    return [each for each in files if is_published(each)]


def _text(file: Path) -> str:
    return read_text(file, MAX_CALIBRATION_BYTES, "a calibration") if file.exists() else read_published(file).decode()


def _read_file(file: Path, format_name: str, declared: Format, counts: Counts) -> ImportedCalibration:
    text = _text(file)
    try:
        imported = _read(file, format_name, declared, parsed(declared.read_back["kind"], text), counts)
    except (TemplateError, KeyError, ValueError, TypeError, np.linalg.LinAlgError) as error:
        reason = error.args[0] if isinstance(error, KeyError) else error
        raise InputError(f"this is no {format_name} ({declared.consumer}): {reason}", str(file)) from error
    turned = [" ".join(remark.split()) for remark in TURNED_READINGS.findall(text)]
    imported.notes.extend(turned)
    if effects := dict.fromkeys(EFFECT_IN_C.findall(text)):
        imported.notes.append(f"effects in C expressions, which are not read: {', '.join(effects)}")
    return replace(imported, stated_axes=_stated_axes(turned))


def _stated_axes(remarks: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Return the axis map of each sensor from the remarks of a file; empty without a remark."""
    stated = {owner[1]: tuple(BODY_AXIS.findall(text)) for text in remarks if (owner := FRAME_REMARK.search(text))}
    return {s: stated.get(s) or stated.get("sensor") or STRAIGHT for s in SENSORS} if stated else {}


def counts_of(sheets: Mapping[str, SensorFigures]) -> dict[str, float | None]:
    """Return the counts per g or deg/s of each sensor; None if not stated."""
    return {s: sheets[s].counts_per_unit if s in sheets else None for s in SENSORS}


def format_of(words: str) -> str:
    """Return the only format with this name, beginning of its name, or file name."""
    names = [CALIBRATION, *formats()]
    fitting = (
        [name for name in names if words in (name, name.partition(".")[0])]
        or [name for name in names if name.startswith(words)]
        or [name for name, (d, _) in formats().items() if fnmatchcase(words, d.file.replace("{unit}", "*"))]
    )
    if len(fitting) == 1:
        return fitting[0]
    raise ConfigurationError(f"{words} is the name of {'several formats' if fitting else 'no format'}: "
                             f"{', '.join(fitting or names)}; choose one (convert --from, --to)")  # fmt: skip


def _recognised(file: Path, text: str) -> str:
    """Return the name of the only format whose keys are in the file."""
    declarations = {name: declared for name, (declared, _) in formats().items() if declared.read_back}
    if file.name in formats():
        return file.name
    fitting = []
    for name, declared in declarations.items():
        with suppress(ValueError):
            if _sensors_in(file, declared, parsed(declared.read_back["kind"], text)):
                fitting.append(name)
    with suppress(ValueError):
        document = json.loads(text)
        if isinstance(document, dict) and {"schema_version", "status", *SENSORS} <= set(document):
            fitting = [CALIBRATION]
    if len(fitting) == 1:
        return fitting[0]
    if NOISE_ALONE.search(text):
        message = "holds the noise of a sensor for a filter, and no calibration; name Kalibr's result in its place"
        raise InputError(message, str(file))
    names = ", ".join(fitting or [CALIBRATION, *declarations])
    reason = "the file fits several formats" if fitting else "the file has the keys of no format"
    raise InputError(f"{reason}: {names}; name it (convert --from, method.format)", str(file))


def _sensors_in(file: Path, declared: Format, content: Node) -> dict[str, dict[str, str]]:
    read_back, endings = declared.read_back, declared.sensor_endings
    expressions = {s: read_back["sensor"] for s in endings if file.stem.endswith(endings[s])} or read_back
    given = {s: expressions[s]["where"].split(" | ") for s in SENSORS if s in expressions}
    return {s: dict(expressions[s]) for s, where in given.items() if any(map(content.has, where))}


def _read(file: Path, format_name: str, declared: Format, content: Node, counts: Counts) -> ImportedCalibration:
    sensors = _sensors_in(file, declared, content)
    if not sensors:
        names = [f"a name that ends in {e}{Path(declared.file).suffix}" for e in declared.sensor_endings.values()]
        places = (str(declared.read_back[s]["where"]) for s in SENSORS if s in declared.read_back)
        wanted = " or ".join(names) or ", ".join(places)
        raise InputError(f"this is no {format_name} ({declared.consumer}): expected {wanted}", str(file))
    per_unit = {s: counts.get(s) for s in SENSORS}
    lacking = [s for s in declared.required_counts if s in sensors and not per_unit[s]]
    if lacking:
        raise InputError(f"{format_name} is in counts: state the sensor, whose config states the counts", str(file))
    omitted = {k: v for k, v in declared.read_back.get("defaults", {}).items() if k not in content}
    notes = [f"not in the file, by default:  {', '.join(f'{k} = {v:g}' for k, v in omitted.items())}"] * bool(omitted)
    tree = Expressions({**TEMPLATE_FUNCTIONS, "file": Node({**content, **omitted}), "counts": per_unit})
    calibrations = {}
    for s, expressions in sensors.items():
        tree.globals |= {key: tree.value(e) for key, e in declared.read_back.get("let", {}).items()}
        if "model" in expressions:
            tree.globals["model"] = tree.value(expressions["model"])
        values = {key: tree.value(e) for key, e in expressions.items() if key not in ("where", "model")}
        calibrations[s] = _calibration(s, declared, values, per_unit[s], notes)
    noise = {key: float(np.ravel(content.at(path))[0]) for key, path in declared.read_back.get("noise", {}).items()
             if content.has(path) and content.at(path) is not None}  # fmt: skip
    unread = content.unread()
    if unread:
        notes.append(f"not read: {', '.join(shortened(unread, 12))}")
    notes += [f"{s}: the file states no bias; it counts as 0" for s, c in calibrations.items() if not np.any(c.bias)]
    return ImportedCalibration(format_name, file.stem, calibrations, noise, notes)


def _calibration(
    sensor: str, declared: Format, values: Mapping[str, Any], counts: float | None, notes: list[str]
) -> SensorCalibration:
    """Return the calibration in g and deg/s from the values of the format's expressions."""
    factor = UNIT_FACTORS[declared.units[sensor]]
    arrays = {key: np.asarray(value, float) for key, value in values.items()}
    matrix = arrays["matrix"].reshape(3, 3) if "matrix" in arrays else np.linalg.inv(arrays["K"].reshape(3, 3))
    if "bias_polynomial" in arrays:
        polynomial = arrays["bias_polynomial"].reshape(3, -1)
    elif "bias_after_matrix" in arrays:
        polynomial = np.linalg.solve(matrix, arrays["bias_after_matrix"].ravel())[:, None]
    else:
        polynomial = arrays["bias"].reshape(3, 1)
    raw = factor  # units of the format per g or deg/s of a reading
    sizes, (low, high) = np.linalg.svd(matrix, compute_uv=False), UNIT_SCALE
    if not low < sizes[2] <= sizes[0] < high:
        if counts is None or not low < sizes[2] * counts / factor <= sizes[0] * counts / factor < high:
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
    if (largest := float(np.abs(arrays.get("left_out", 0.0)).max())) > FORMAT_ROUNDING:
        notes.append(f"{sensor}: cross-axis terms change by up to {largest:.2g} per degC, which is not read")
    effects = _thermal(sensor, polynomial, notes)
    for name, unit in (("g_sensitivity", raw), ("scale_factor_temperature", 1.0)):
        if np.any(values_of := arrays.get(name, np.zeros(1))):
            effects.append(fitted_effect(name, sensor, values_of.ravel() / unit))
    covariance = None
    if "bias_deviation" in arrays and np.any(arrays["bias_deviation"]):
        size = BASE_COUNT + sum(len(e.parameters) for e in effects)
        covariance = np.zeros((size, size))
        covariance[BIAS, BIAS] = np.diag((arrays["bias_deviation"].ravel() / raw) ** 2)
        notes.append(f"{sensor}: the file states an uncertainty of the bias, and none of the matrix")
    return SensorCalibration(sensor, polynomial[:, 0], matrix, effects=tuple(effects), covariance=covariance)


def _thermal(sensor: str, polynomial: Values, notes: list[str]) -> list[FittedEffect]:
    """Return the effect of a bias that is a polynomial in T - 25 degC: coefficients (3, k)."""
    polynomial = np.where(np.abs(polynomial) > FORMAT_ROUNDING * np.abs(polynomial).max(), polynomial, 0.0)
    if np.any(polynomial[:, 4:]):
        notes.append(f"{sensor}: the bias beyond the third order of the temperature is left out")
    for order, name in ((3, "bias_temperature_cubic"), (2, "bias_temperature_quadratic"), (1, "bias_temperature")):
        if np.any(polynomial[:, order : order + 1]):
            return [fitted_effect(name, sensor, polynomial[:, 1 : order + 1].ravel())]
    return []


def document_of(imported: ImportedCalibration) -> JSON:
    """Return an imported calibration as ``calibrations/<unit>.json``; values that its file does not state are null."""
    if imported.document is not None:
        return imported.document
    missing = {s: f"{imported.format_name} holds no calibration of it" for s in SENSORS if s not in imported.sensors}
    return {
        "schema_version": SCHEMA_VERSION,
        "unit": imported.unit,
        "status": "ok",
        "error": None,
        **dict.fromkeys(("sensor", "table", "procedure", "method", "config_sha256")),
        "software": {"imu-calibration": version("imu-calibration")},
        "inputs": [],
        "not_calibrated": missing,
        **{s: _part(imported.sensors[s]) if s in imported.sensors else None for s in SENSORS},
        **({"log": {"ingest": None, "axis_map": imported.axis_maps}} if imported.stated_axes else {}),
    }


def _part(calibration: SensorCalibration) -> JSON:
    """Return the part of ``calibrations/<unit>.json`` for a sensor; null: an uncertainty that is not known."""
    part, known = calibration.to_json(), np.diag(calibration.parameters.covariance) > 0.0

    def where(mask: Any, values: Any) -> Any:  # noqa: ANN401  (arrays of any shape)
        found = np.array(values, object)
        found[~np.asarray(mask)] = None
        return found.tolist()

    for key in ("standard_uncertainty", "expanded_uncertainty"):
        bias, matrix = part[key]["bias"], part[key]["matrix"]
        part[key] = {"bias": where(known[BIAS], bias), "matrix": where(known[MATRIX].reshape(3, 3), matrix)}
    part["covariance"]["values"] = where(np.outer(known, known), part["covariance"]["values"])
    return part


def with_noise(sheets: Mapping[str, SensorFigures], imported: ImportedCalibration) -> dict[str, SensorFigures]:
    """Return the figures of the sensors, with the noise that an imported file states."""
    found = dict(sheets)
    for s, unit in SI.items():
        density, walk = (imported.noise.get(f"{s}_{what}") for what in ("noise_density", "random_walk"))
        if density is not None and walk is not None:
            white = np.sqrt(2.0) * density / UNIT_FACTORS[unit]  # one-sided
            wander, origin = walk / UNIT_FACTORS[unit] * np.sqrt(WALK_S / 2.0), f"as {imported.format_name} states it"
            found[s] = SensorFigures(counts_of(sheets)[s], white, wander, WALK_S, origin)
    return found


def convert(
    imported: ImportedCalibration, format_name: str, target: Path, sheets: Mapping[str, SensorFigures]
) -> tuple[list[Path], list[str]]:
    """Write a calibration in a format; return the files and the losses, in sentences.

    ``target``: its stem gets the endings of a format with a file for each sensor. ``sheets``: for counts and noise.
    """
    document = document_of(imported)
    if format_name == CALIBRATION:
        write_atomically(target, json_text(document))
        return [target], ["the noise densities and random walks"] if imported.noise else []
    try:
        unit = ExportedUnit(document, with_noise(sheets, imported), validation=imported.validation)
        texts = export(format_name, unit, target.name)
    except KeyError as missing:
        quantity = str(missing.args[0]).replace("_", " ")
        raise ConfigurationError(
            f"{format_name} needs the {quantity}; IN does not state it: give --sensor NAME"
        ) from None
    if not texts:
        declared = formats()[format_name][0]
        needed = [*declared.required, *(f"the counts per unit of the {s}" for s in declared.required_counts)]
        raise ConfigurationError(
            f"{format_name} needs {', '.join(needed)}; IN does not hold it (--sensor NAME states counts)"
        )
    files = [target.with_name(name) for name in texts]
    for file, text in zip(files, texts.values(), strict=True):
        write_atomically(file, text)
    return files, lost(imported, format_name, files[0], unit)


def lost(imported: ImportedCalibration, format_name: str, file: Path, unit: ExportedUnit) -> list[str]:
    """Read a written file back, and return the losses in sentences."""
    declared = formats()[format_name][0]
    if not declared.read_back:
        return [f"bias and matrix: {format_name} is for {declared.equation}"]
    back, exported = read_any(file, format_name, counts_of(unit.sheets)), unit.sensors(declared)
    lines = []
    if back.axis_maps != imported.axis_maps:
        maps = ", ".join(f"{s} {' '.join(m)}" for s, m in imported.axis_maps.items())
        lines.append(f"the axes of the sensor along those of the body ({maps}): turn the readings to body axes first")
    for s, calibration in imported.sensors.items():
        if s not in back.sensors:
            lines.append(f"{s}: all of it; {format_name} holds no {s}")
            continue
        every, fitted = declared.effects == ["all"], exported[s].held is not None
        told = _differences(calibration, back.sensors[s], all_effects=every, fitted=fitted)
        lines += [f"{s}: {line}" for line in (*told, *exported[s].left_by_matrix(declared.matrix.get(s, "full")))]
    if imported.noise and not back.noise:
        lines.append("the noise densities and random walks")
    if any(c.covariance is not None for c in imported.sensors.values()):
        lines.append("expanded uncertainties, covariances and uncertainty budgets")
    if imported.document is not None:
        lines.append("the stages of the fit, the input files with their digests, and the diagnosis")
    return lines


def _differences(before: SensorCalibration, after: SensorCalibration, *, all_effects: bool, fitted: bool) -> list[str]:
    """Return the differences of bias, matrix and effects in sentences; ``fitted``: whether both are fitted anew."""
    unit = SENSOR_UNITS[before.sensor]
    bias, matrix = (np.abs(getattr(after, key) - getattr(before, key)).max() for key in ("bias", "matrix"))
    lines = []
    if bias > CONVERSION_TOLERANCE:
        left_out = np.any(before.bias) and not np.any(after.bias)
        by = "" if left_out else f" {'changes' if fitted else 'is rounded,'} by up to {bias:.2g} {unit}"
        lines.append(f"the bias{by}")
    if matrix > CONVERSION_TOLERANCE:
        lines.append(f"elements of the matrix change by up to {matrix:.2g}")
    values = {e.name: e.values for e in after.effects}
    for one in () if all_effects else before.effects:
        if one.name not in values:
            lines.append(f"the effect {one.name}")
        elif (change := np.abs(values[one.name] - one.values).max()) > CONVERSION_TOLERANCE:
            lines.append(f"the effect {one.name} changes by up to {change:.2g}")
    return lines


def explain_calibration(imported: ImportedCalibration) -> str:
    """Return the explanation of a calibration in any format."""
    document = imported.document or {}
    return text_of(
        "explanation.txt",
        imported=imported,
        declared=None if document else formats()[imported.format_name][0],
        notes=[*(before_use(document) if document else []), *imported.notes],
        sensors={s: _explained(imported.sensors[s], imported) if s in imported.sensors else None for s in SENSORS},
        sample=SAMPLE,
        board=document.get("board"),
    )


def explain_board(document: JSON) -> str:
    """Return the positions of the chips of the unit's board in words and numbers; empty without a board."""
    return text_of("board.txt", board=document["board"]) if document.get("board") else ""


def _explained(calibration: SensorCalibration, imported: ImportedCalibration) -> JSON:
    """Return the values in the explanation of a sensor; its effects are those that the compensation subtracts."""
    sensor, effects = calibration.sensor, sensor_effects(calibration)
    compensation = Compensation(imported.sensors.get("accelerometer"), imported.sensors.get("gyroscope"), imported.unit)
    truth = getattr(compensation.apply(**SAMPLE, smoothing=0.0), sensor)
    centred, expanded = SAMPLE[sensor] - calibration.bias, None  # expanded uncertainties (95 %); None: unknown
    if calibration.covariance is not None:
        U = calibration.parameters.expanded_uncertainty
        expanded = {"bias": U[BIAS], "matrix": U[MATRIX].max()}
    terms = {e.name: [_plain(t) for t in effect_of(e).in_c(e.values) or ()] for e in effects}
    return {
        "unit": SENSOR_UNITS[sensor],
        "calibration": calibration,
        "expanded": expanded,
        "effects": [{"name": e.name, "parameters": e.parameters, "terms": terms[e.name]} for e in effects],
        "bench": [e.name for e in calibration.effects if e not in effects],
        "centred": centred,
        "subtracted": centred - np.linalg.solve(calibration.matrix, truth),
        "truth": truth,
        "other": "gyroscope" if sensor == "accelerometer" else "accelerometer",
    }


def _plain(expression: str) -> str:
    """Return a C expression of an effect without casts and with six digits."""
    bare = expression.replace("(imu_real)", "").replace("m->", "")
    return NUMBER.sub(lambda number: f"{float(number[0]):.6g}", bare)
