"""Convert a calibration into another format, and explain a calibration in words and numbers.

The losses of a conversion are found by reading the written file back and comparing it. The explanation states the
equation, the order of its operations, its signs, and a worked example.
"""

from __future__ import annotations

import re
from dataclasses import replace
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.core.errors import ConfigurationError
from pipeline.core.files import JSON, json_text, write_atomically
from pipeline.core.records import BIAS, MATRIX, SCHEMA_VERSION, SENSOR_UNITS, SENSORS, SensorCalibration
from pipeline.output.exports import ExportedUnit, export, formats, text_of
from pipeline.output.exports.reading import CALIBRATION, ImportedCalibration, counts_of, read_any
from pipeline.output.exports.sensors import SI, UNIT_FACTORS, ExportedSensor, SensorFigures, before_use
from pipeline.physics.compensation import Compensation
from pipeline.physics.effects import effect_of
from pipeline.physics.measurement import sensor_effects

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path


CONVERSION_TOLERANCE = 1e-9  # g, deg/s or 1: smaller differences of a converted parameter are rounding
WALK_S = 100.0  # correlation time of the wander that represents a random walk: K = s sqrt(2 / T), for any T


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
        part[key] = {
            "bias": where(known[BIAS], part[key]["bias"]),
            "matrix": where(known[MATRIX].reshape(3, 3), part[key]["matrix"]),
        }
    part["covariance"]["values"] = where(np.outer(known, known), part["covariance"]["values"])
    return part


def with_noise(sheets: Mapping[str, SensorFigures], imported: ImportedCalibration) -> dict[str, SensorFigures]:
    """Return the figures of the sensors, with the noise that an imported file states."""
    found = dict(sheets)
    for s, unit in SI.items():
        density, walk = (imported.noise.get(f"{s}_{what}") for what in ("noise_density", "random_walk"))
        if density is not None and walk is not None:
            found[s] = replace(
                sheets.get(s, SensorFigures()),
                noise_density=np.sqrt(2.0) * density / UNIT_FACTORS[unit],  # one-sided
                bias_wander=walk / UNIT_FACTORS[unit] * np.sqrt(WALK_S / 2.0),
                wander_time_s=WALK_S,
                noise_origin=f"as {imported.format_name} states it",
            )
    return found


def convert(
    imported: ImportedCalibration, format_name: str, target: Path, sheets: Mapping[str, SensorFigures]
) -> tuple[list[Path], list[str]]:
    """Write a calibration in a format; return the files and the losses, in sentences.

    ``target``: the file; if the format has a file for each sensor, their endings are added to its stem.
    ``sheets``: figures of each sensor, for counts and noise.
    """
    document = document_of(imported)
    if format_name == CALIBRATION:
        write_atomically(target, json_text(document))
        return [target], ["the noise densities and random walks"] if imported.noise else []
    try:
        texts = export(format_name, ExportedUnit(document, with_noise(sheets, imported)), target.name)
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
    return files, lost(imported, format_name, files[0], sheets)


def lost(imported: ImportedCalibration, format_name: str, file: Path, sheets: Mapping[str, SensorFigures]) -> list[str]:
    """Read a written file back, and return the losses in sentences."""
    declared = formats()[format_name][0]
    if not declared.read_back:
        return [f"bias and matrix: {format_name} is for {declared.equation}"]
    back = read_any(file, format_name, counts_of(sheets))
    lines = []
    if back.axis_maps != imported.axis_maps:
        maps = ", ".join(f"{s} {' '.join(m)}" for s, m in imported.axis_maps.items())
        lines.append(f"the axes of the sensor along those of the body ({maps}): turn the readings to body axes first")
    for s, calibration in imported.sensors.items():
        if s not in back.sensors:
            lines.append(f"{s}: all of it; {format_name} holds no {s}")
            continue
        lines += [
            f"{s}: {line}"
            for line in _differences(calibration, back.sensors[s], all_effects=declared.effects == ["all"])
        ]
        exported = ExportedSensor(calibration, declared.units[s], None)
        lines += [f"{s}: {line}" for line in exported.left_by_matrix(declared.matrix.get(s, "full"))]
    if imported.noise and not back.noise:
        lines.append("the noise densities and random walks")
    if any(c.covariance is not None for c in imported.sensors.values()):
        lines.append("expanded uncertainties, covariances and uncertainty budgets")
    if imported.document is not None:
        lines.append("the stages of the fit, the input files with their digests, and the diagnosis")
    return lines


def _differences(before: SensorCalibration, after: SensorCalibration, *, all_effects: bool) -> list[str]:
    """Return the differences of bias, matrix and effects in sentences."""
    unit = SENSOR_UNITS[before.sensor]
    bias, matrix = (np.abs(getattr(after, key) - getattr(before, key)).max() for key in ("bias", "matrix"))
    lines = []
    if bias > CONVERSION_TOLERANCE:
        left_out = np.any(before.bias) and not np.any(after.bias)
        lines.append("the bias" if left_out else f"the bias is rounded, by up to {bias:.2g} {unit}")
    if matrix > CONVERSION_TOLERANCE:
        lines.append(f"elements of the matrix change by up to {matrix:.2g}")
    values = {e.name: e.values for e in after.effects}
    for effect in () if all_effects else before.effects:
        if effect.name not in values:
            lines.append(f"the effect {effect.name}")
        elif (change := np.abs(values[effect.name] - effect.values).max()) > CONVERSION_TOLERANCE:
            lines.append(f"the effect {effect.name} changes by up to {change:.2g}")
    return lines


NUMBER = re.compile(r"\d+\.\d+(?:e[-+]?\d+)?")
# The worked example: a tilted body that turns, above the reference temperature.
SAMPLE: dict[str, Any] = {
    "accelerometer": np.array([0.1, -0.2, 0.97]),
    "gyroscope": np.array([10.0, -20.0, 30.0]),
    "temperature": 35.0,
    "time": 600.0,
}


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
    return {
        "unit": SENSOR_UNITS[sensor],
        "calibration": calibration,
        "expanded": expanded,
        "effects": [
            {
                "name": e.name,
                "parameters": e.parameters,
                "terms": [_plain(t) for t in effect_of(e).in_c(e.values) or ()],
            }
            for e in effects
        ],
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
