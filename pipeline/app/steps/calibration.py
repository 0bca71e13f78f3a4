"""Steps calibration and export: compose the published calibration of a unit, and write it for other programs.

A sensor whose fit has a significantly larger held-out error than the raw readings is null in it, with the reason. A
unit without any calibrated sensor has failed.

Turn axes, faces and zeros define the frame in which bias, matrix and U hold. Its uncertainty against the case of the
unit, about each axis of the body, is

    on a table  U^2 = k^2 (s^2 / m + l^2),    s^2 = max(s_stated^2, sum_j (r_j - r)^2 / (m - 1))
    by faces    U^2 = k^2 / (4 / s_f^2 + 2 / s_a^2)

where s is the standard deviation of the unit's rotation in its seat and r_j the fitted rotation in mounting j of m, of
which the frame is the mean; l the levelling of the table, with which its zero is set; s_f that of a face, four of which
show a rotation about one axis, and s_a that of the axis of stated turns, two of which do. k is that of a normal
distribution for 95 %. Without a stated seat, and without fitted mountings, nothing shows how the case lies on a table.
"""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.app.steps.unit_files import StoredUnit
from pipeline.core import VERSION
from pipeline.core.errors import CannotCalibrateError, NotObservableError, PipelineError
from pipeline.core.pack import FAILED_SUFFIX
from pipeline.core.records import (
    AXES,
    SCHEMA_VERSION,
    SENSORS,
    Fit,
    NotCalibrated,
    Recording,
    SensorCalibration,
    Validation,
    Values,
    axis_maps,
    calibrated,
    coverage_factor,
)
from pipeline.core.settings import Board, DataSheet, Settings
from pipeline.estimation.candidates import MOUNTING
from pipeline.estimation.chips import Chip, chip_document
from pipeline.estimation.noise_identification import identify_noise
from pipeline.ingest.quality_flags import GAP
from pipeline.output.exports import exports
from pipeline.physics.statements import beyond_limits, implausible, limited, not_determined, with_open

if TYPE_CHECKING:
    from pipeline.app.steps.batch import Job


NORMAL_FACTOR = float(coverage_factor(np.inf))
FACES_ABOUT, TURNS_ABOUT = 4, 2  # faces, and axes of turns, that show a rotation about one axis
MOVE = "record turns of 100 deg/s and more about all axes"
LIBRARIES = ("numpy", "scipy", "pyarrow", "mcap")


def frame_uncertainty(
    calibration: SensorCalibration, recordings: Sequence[Recording], settings: Settings
) -> list[float] | None:
    """Return the expanded uncertainty of the frame about x, y and z of the body, deg; None where nothing is stated."""
    table, procedure = settings.table, settings.procedure
    if table.motion == "none":
        if procedure.faces is None:
            return None
        precision = FACES_ABOUT / procedure.faces.accuracy_deg**2
        if procedure.turns is not None and calibration.sensor == "gyroscope":
            precision += TURNS_ABOUT / procedure.turns.axis_accuracy_deg**2
        return [NORMAL_FACTOR / float(np.sqrt(precision))] * len(AXES)
    fitted = next((e.values.reshape(-1, 3) for e in calibration.effects if e.name == MOUNTING), np.zeros((0, 3)))
    if table.seat_deg is None and len(fitted) < 2:
        return None
    turns = {r.setup or r.name for r in recordings if r.role == calibration.sensor and r.axis is not None}
    count = len(fitted) or max(len(turns), 1)  # mountings: setups, or recordings without one
    seats: Values = np.full(3, table.seat_deg or 0.0)
    if len(fitted) > 1:
        seats = np.maximum(seats, np.std(fitted, axis=0, ddof=1))
    return [float(u) for u in NORMAL_FACTOR * np.hypot(seats / np.sqrt(count), table.levelling_deg or 0.0)]


def calibration_document(  # noqa: PLR0917  (what a calibration is composed of)
    unit: str,
    checked: list[Recording],
    fits: Mapping[str, Fit],
    validated: Validation,
    diagnosis: Mapping[str, Any],
    settings: Settings,
) -> dict[str, Any]:
    """Return ``calibrations/<unit>.json``: the fits, noise at rest, inputs and software.

    ``diagnosis``: ``diagnoses/<unit>.json``, for the effects that are not observable.

    Raises ``CannotCalibrateError`` if no sensor is calibrated.
    """
    reasons = not_calibrated(fits, validated, settings)
    if len(reasons) == len(SENSORS):
        told = "; ".join(f"{sensor}: {reason}" for sensor, reason in reasons.items())
        raise CannotCalibrateError(f"no sensor could be calibrated. {told}")
    axes = {s: list(m) for s, m in axis_maps(settings.sensor).items()}
    log = {"ingest": {"csv": settings.ingest.csv, "mcap": settings.ingest.mcap}, "axis_map": axes}
    document = header(unit, settings) | {"status": "ok", "error": None, "log": log, "inputs": inputs(checked)}
    document |= {"calibrated_range": calibrated_range(checked), "not_calibrated": reasons}
    document |= {"noise": _noise(checked, settings)}
    hidden = {sensor: _hidden(diagnosis.get(sensor)) for sensor in SENSORS}
    for sensor, fit in fits.items():
        document[sensor] = None
        if sensor not in reasons and isinstance(fit, SensorCalibration):
            part = {k: v for k, v in fit.to_json().items() if k != "at_limits"} | with_open(sensor, fit, hidden)
            part["frame_deg"] = frame_uncertainty(fit, checked, settings)
            document[sensor] = judged(sensor, part, settings.sensor.of(sensor))
    return document


def _noise(checked: Sequence[Recording], settings: Settings) -> dict[str, Any]:
    """Return the noise at rest; with ``diagnosis.depth=standard`` without intervals, and with what gives them."""
    full = settings.diagnosis.depth == "full"
    noise = identify_noise(checked, full=full)
    for part in noise.values():
        if part["axes"] and not full:
            part["intervals_by"] = "a run with diagnosis.depth=full"
            if part["source"] == "static":
                file = next(r.source.get("file") for r in checked if r.name == part["recordings"][0])
                chosen = {"ingest": settings.ingest.name, "sensor": settings.sensor.name}
                options = "".join(f" --{key} {name}" for key, name in chosen.items())
                file = file if Path(str(file)).is_absolute() else f"CAMPAIGN/{file}"
                part["intervals_by"] = f"python -m pipeline noise {file}{options}, or {part['intervals_by']}"
    return noise


def _hidden(part: Mapping[str, Any] | None) -> dict[str, str] | None:
    """Return the effects that are not observable with their reasons; None where the diagnosis failed."""
    if part is None or part.get("failed"):
        return None
    return {**part.get("open_if_slow", {}), **{entry["effect"]: entry["reason"] for entry in part["not_observable"]}}


def not_calibrated(fits: Mapping[str, Fit], validated: Validation, settings: Settings) -> dict[str, str]:
    """Return the sensors that are not calibrated, each with the reason."""
    reasons = {sensor: fit.reason for sensor, fit in fits.items() if isinstance(fit, NotCalibrated)}
    if not settings.method.as_printed:  # printed errata are shown as they are; the verdict is left_by_method
        fitted = {sensor: part for sensor, part in validated.sensors.items() if sensor not in reasons}
        reasons |= {s: part.worse_than_raw for s, part in fitted.items() if part and part.worse_than_raw}
    return reasons


def calibration_reads(job: Job, unit: str, settings: Settings) -> list[Any]:
    """Return the settings of the other chips of a board, and the state of their files, for its reference chip."""
    board = settings.stated.board
    chips = board.chips if board and board.chips[0] == unit else ()
    return [[chip, job.content[chip], job.state_of_members(chip)] for chip in chips if chip in job.units]


def calibration_in_batch(job: Job, unit: str, settings: Settings, document: dict[str, Any]) -> dict[str, Any]:
    """Return the document with what the other units of the batch tell: the chips of a board."""
    board = settings.stated.board
    return document | {"board": _on_board(job, unit, board)} if board else document


def _on_board(job: Job, unit: str, board: Board) -> dict[str, Any]:
    """Return the board of a unit; for its reference chip, with the mounting of all other chips relative to it."""
    reference, *others = board.chips
    chips: dict[str, Any] = {}
    for other in others if unit == reference else ():
        try:
            if f"{other}{FAILED_SUFFIX}" in job.inputs["validate"]:
                raise NotObservableError(f"{other} could not be calibrated")
            chips[other] = chip_document(_chip(job, reference), _chip(job, other))
        except PipelineError as error:
            chips[other] = {"refused": error.message}
        except np.linalg.LinAlgError:
            chips[other] = {"refused": f"the readings do not determine how {other} sits: {MOVE}"}
    return {"name": board.name, "reference": reference, "chips": chips}


def _chip(job: Job, unit: str) -> Chip:
    """Return a chip of a board, with the recordings and calibrations of its unit."""
    stored, settings = StoredUnit(job, unit), job.units[unit]
    fits = stored.fits
    reasons = not_calibrated(fits, stored.validated, settings)
    found = {s: None if s in reasons else c for s, c in calibrated(fits).items()}
    return Chip(unit, stored.checked, found, settings.sensor)


def calibrated_range(recordings: Sequence[Recording]) -> dict[str, Any]:
    """Return the range of the recordings in the fits: largest magnitude of a reading (g, deg/s), temperatures (degC).

    Magnitudes are of the readings as logged. ``soaked_degc``: the temperatures of soaks alone. A quantity that no
    recording contains is absent.
    """
    found: dict[str, Any] = {}
    for sensor, key in (("accelerometer", "specific_force_g"), ("gyroscope", "angular_rate_dps")):
        own = [(r.reading(sensor), r.valid) for r in recordings if r.role in {sensor, "rests"}]
        squares = [np.einsum("ij,ij->i", v, v)[ok].max() for v, ok in own if v is not None and ok.any()]
        found |= {key: round(float(np.sqrt(max(squares))), 6)} if squares else {}
    warm = [r for r in recordings if r.role in {*SENSORS, "rests"} and r.temperature is not None and r.samples]
    for key, chosen in (("temperature_degc", warm), ("soaked_degc", [r for r in warm if r.kind == "soak"])):
        if chosen:
            known = np.concatenate([np.asarray(r.temperature) for r in chosen])
            found[key] = [round(float(v), 3) for v in (np.nanmin(known), np.nanmax(known))]
    return found


def judged(sensor: str, fit: dict[str, Any], data_sheet: DataSheet) -> dict[str, Any]:
    """Add to a fit the parameters beyond the sensor file's limits, and those that only the limits determine.

    Which of those beyond are implausible depends on their uncertainty, and on what the configuration accepts.
    """
    rows = limited(sensor, fit, data_sheet)
    found = implausible(rows)
    accepted = data_sheet.accept_implausible
    lists = {"implausible": [] if accepted else found, "implausible_accepted": found if accepted else []}
    lists |= {"beyond_limits": beyond_limits(rows)}
    return fit | lists | {"not_determined": not_determined(fit)}


def header(unit: str, settings: Settings) -> dict[str, Any]:
    """Return the part of a calibration document that does not depend on the fit."""
    names = {group: getattr(settings, group).name for group in ("sensor", "table", "procedure", "method")}
    methods = {sensor: settings.method.of(sensor) for sensor in SENSORS}
    found = {"schema_version": SCHEMA_VERSION, "unit": unit, "status": None, "error": None, **names, "methods": methods}
    return found | {"config_sha256": settings.stated.config_sha256, "software": dict(_software())}


@cache
def _software() -> dict[str, str]:
    """Return the versions of the software; cached, because each lookup reads files."""
    libraries = {library: version(library) for library in LIBRARIES}
    return {"imu-calibration": VERSION, "python": platform.python_version(), **libraries}


def _missing_s(recording: Recording) -> float:
    rows = np.flatnonzero(recording.flags & GAP) if recording.flags is not None else np.zeros(0, int)
    rows = rows[rows > 0]
    return round(float(np.sum(recording.time[rows] - recording.time[rows - 1] - recording.interval)), 6)


def inputs(recordings: Sequence[Recording]) -> list[dict[str, Any]]:
    """Return file, hash, rows and notes of each recording of a unit.

    ``joined``: the files that were joined with it. ``program``: the table's program, if it is the reference.
    """
    return [
        {
            "recording": r.name,
            "role": r.role,
            "file": r.source.get("file"),
            "sha256": r.source.get("sha256"),
            "rows": r.source.get("rows"),
            "rate_hz": round(1.0 / r.interval, 6) if r.interval > 0 else None,
            "duration_s": round(float(r.time[-1] - r.time[0]), 6) if r.samples else 0.0,
            "missing_s": _missing_s(r),
            "notes": [n.to_json() for n in r.notes],
            **{key: r.source[key] for key in ("joined", "program") if key in r.source},
        }
        for r in recordings
    ]


def export(
    calibration: dict[str, Any], validation: dict[str, Any], diagnosis: dict[str, Any], settings: Settings
) -> dict[str, str]:
    """Return the files of ``exports/<unit>/`` by name."""
    return exports(calibration, settings, validation, diagnosis)
