"""A calibration from one format into another, and what is lost on the way.

What is lost is not a list by heart: the written file is read back by the reader of its format, and compared.
"""

from __future__ import annotations

from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import ConfigurationError
from pipeline.exports import Subject, export, formats
from pipeline.exports.reading import CALIBRATION, FoundCalibration, counts_of, read_any
from pipeline.exports.sensors import FACTORS, ExportedSensor
from pipeline.files import json_text, write_atomically
from pipeline.records import SENSOR_UNITS, SENSORS

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from pipeline.records import SensorCalibration

JSON = dict[str, Any]
KEPT = 1e-9  # relative to 1 and in g or deg/s: what differs less is kept
WALK_S = 100.0  # correlation time of the wander that stands for a random walk: K = s sqrt(2 / T), any T serves


def document_of(found: FoundCalibration) -> JSON:
    """Return ``calibrations/<unit>.json`` of what a file holds; what no file tells is null."""
    if found.document is not None:
        return found.document
    missing = {s: f"{found.name} holds no calibration of it" for s in SENSORS if s not in found.sensors}
    return {
        "schema_version": 1,
        "unit": found.unit,
        "status": "ok",
        "error": None,
        **dict.fromkeys(("sensor", "table", "procedure", "method", "config_sha256")),
        "software": {"imu-calibration": version("imu-calibration")},
        "inputs": [],
        "not_calibrated": missing,
        **{s: found.sensors[s].to_json() if s in found.sensors else None for s in SENSORS},
    }


def settings_of(found: FoundCalibration, sheets: Mapping[str, Any]) -> JSON:
    """Return the settings that exports read: the sensor's configuration, with the noise that the file states."""
    sensor: JSON = {s: dict(sheets.get(s) or {}) for s in SENSORS}
    for s, unit in (("accelerometer", "m/s^2"), ("gyroscope", "rad/s")):
        density, walk = (found.noise.get(f"{s}_{what}") for what in ("noise_density", "random_walk"))
        if density is not None and walk is not None:
            sensor[s] |= {"noise_density": np.sqrt(2.0) * density / FACTORS[unit], "wander_time_s": WALK_S}  # one-sided
            sensor[s]["noise_origin"] = f"as {found.name} states it"
            sensor[s]["bias_wander"] = walk / FACTORS[unit] * np.sqrt(WALK_S / 2.0)
    return {"sensor": sensor, "table": {"gravity_g": 1.0}}


def convert(
    found: FoundCalibration, name: str, target: Path, sheets: Mapping[str, Any]
) -> tuple[list[Path], list[str]]:
    """Write a calibration in the format ``name``; return the files and what is lost, in sentences.

    ``target``: the file, or where the format has a file for each sensor, the beginning of their names; ``sheets``:
    sensor to its part of the sensor's configuration, for counts and noise, may be empty.
    """
    document, settings = document_of(found), settings_of(found, sheets)
    if name == CALIBRATION:
        write_atomically(target, json_text(document))
        return [target], ["the noise densities and random walks"] if found.noise else []
    try:
        texts = export(name, Subject(document, settings))
    except KeyError as missing:
        raise ConfigurationError(
            f"{name} holds {missing.args[0]} of a sensor, which the input does not: state the sensor (--sensor NAME)"
        ) from None
    if not texts:
        needed = [*formats()[name][0].needs, *(f"the counts of the {s}" for s in formats()[name][0].needs_counts)]
        raise ConfigurationError(f"{name} needs {', '.join(needed)}, which the input does not hold (see --sensor)")
    first = name.partition(".")[0]
    files = []
    for file, text in texts.items():
        path = target if len(texts) == 1 and file == name else target.with_name(file.replace(first, target.stem, 1))
        write_atomically(path, text)
        files.append(path)
    return files, lost(found, name, files[0], sheets)


def lost(found: FoundCalibration, name: str, file: Path, sheets: Mapping[str, Any]) -> list[str]:
    """Return what a written file does not hold, in sentences, by reading it back."""
    declared = formats()[name][0]
    if not declared.reads:
        return [f"bias and matrix: {name} is for {declared.equation}"]
    back = read_any(file, name, counts_of(sheets))
    lines = []
    for s, calibration in found.sensors.items():
        if s not in back.sensors:
            lines.append(f"{s}: all of it; {name} holds no {s}")
            continue
        lines += [
            f"{s}: {line}" for line in _differences(calibration, back.sensors[s], any_effect=declared.holds == ["any"])
        ]
        exported = ExportedSensor(calibration, declared.units[s], {})
        lines += [f"{s}: {line}" for line in exported.left_by_matrix(declared.matrix.get(s, "full"))]
    if found.noise and not back.noise:
        lines.append("the noise densities and random walks")
    if any(c.covariance is not None for c in found.sensors.values()):
        lines.append("expanded uncertainties, covariances and uncertainty budgets")
    if found.document is not None:
        lines.append("the stages of the fit, the input files with their digests, and the diagnosis")
    return lines


def _differences(before: SensorCalibration, after: SensorCalibration, *, any_effect: bool) -> list[str]:
    """Return what of a sensor's calibration did not arrive."""
    unit = SENSOR_UNITS[before.sensor]
    bias, matrix = (np.abs(getattr(after, key) - getattr(before, key)).max() for key in ("bias", "matrix"))
    lines = []
    if bias > KEPT:
        gone = np.any(before.bias) and not np.any(after.bias)
        lines.append("the bias" if gone else f"the bias is rounded, by up to {bias:.2g} {unit}")
    if matrix > KEPT:
        lines.append(f"elements of the matrix change by up to {matrix:.2g}")
    kept = {e.name: e.values for e in after.effects}
    for effect in () if any_effect else before.effects:
        if effect.name not in kept:
            lines.append(f"the effect {effect.name}")
        elif (change := np.abs(kept[effect.name] - effect.values).max()) > KEPT:
            lines.append(f"the effect {effect.name} changes by up to {change:.2g}")
    return lines
