"""The page of one unit: verdict and held-out error first, then the evidence.

One file that works offline: style, script and charts are inline, and its content security policy forbids requests.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.files import json_text
from pipeline.model.calibration_file import beyond_uncertainty, left_out, sentences
from pipeline.outcome import VERDICTS, commands_of, place, run_command
from pipeline.records import SENSOR_UNITS, SENSORS, Recording
from pipeline.report.diagnosis_section import evidence_figures, limit_rows, ranking_rows, upper_limits
from pipeline.report.held_out_section import (
    FAR,
    attitude_over_time,
    checks,
    error_steps,
    first_and_last_step,
    held_out_figures,
    passes,
    step_label,
)
from pipeline.report.noise_section import allan, remarks, term_rows
from pipeline.report.pages import template
from pipeline.report.parameters import beyond_limits, fitted_parameters, parameter_rows
from pipeline.report.recording_section import (
    environment,
    files_read,
    recording_rows,
    rest_rows,
    rests_logged,
    segments,
)
from pipeline.report.residual_section import measurement_and_model, residual_figures, residuals

JSON = dict[str, Any]


def render(
    calibration: JSON,
    validation: JSON | None,
    diagnosis: JSON | None,
    recordings: list[Recording],
    settings: JSON,
    *,
    words: dict[str, list[str]] | None = None,
) -> str:
    """Return the page of one unit as HTML.

    ``calibration, validation, diagnosis``: as in their files, the last two None where their stage failed;
    ``recordings``: after the filter, may be empty; ``settings``: the unit's resolved configuration; ``words``: the
    diagnosis of each sensor in sentences.
    """
    validation, diagnosis, words = validation or {}, diagnosis or {}, words or {}
    attitude, moves = validation.get("attitude") or {}, validation.get("gravity_direction") or {}
    ok, rests = calibration.get("status") == "ok", rests_logged(recordings)
    sensors = []
    for sensor in SENSORS if ok else ():
        shown = {"name": sensor, "unit": SENSOR_UNITS[sensor], "part": calibration.get(sensor)}
        if shown["part"] is None:
            shown["reason"] = calibration.get("not_calibrated", {}).get(sensor, "the procedure does not calibrate it")
        else:
            held_out, found = validation.get(sensor) or {}, diagnosis.get(sensor) or {}
            shown |= _sensor(sensor, calibration, held_out, found, recordings=recordings, settings=settings)
            shown["words"] = words.get(sensor) or []
        sensors.append(shown)
    page: str = template("unit.html").render(
        calibration=calibration,
        ok=ok,
        passed=passes(calibration, validation),
        checks=checks(validation),
        left_out=left_out(calibration.get("inputs")),
        files_read=files_read(calibration.get("inputs")),
        sensors=sorted(sensors, key=lambda s: 99 if s["part"] is None else place(s["diagnosis"].get("verdict"))),
        attitude=attitude if attitude.get("curve") else None,
        attitude_figure=attitude_over_time(attitude),
        moves=moves if moves.get("moves") else None,
        recordings=recording_rows(recordings, rests),
        segments=segments(recordings, rests, calibration),
        rests=rest_rows(calibration),
        environment=environment(recordings, settings) if recordings else None,
        row={k: v for k, v in (settings.get("row") or {}).items() if v},
        command=run_command(settings["run"]) if settings.get("run") else None,
        settings_text=json_text({k: v for k, v in settings.items() if k not in ("row", "run", "certificate")}),
    )
    return page


def _sensor(
    sensor: str, calibration: JSON, held_out: JSON, found: JSON, *, recordings: list[Recording], settings: JSON
) -> JSON:
    """Return what the template shows of a calibrated sensor, from its parts of validation and diagnosis."""
    part, sensor_config, table = (
        calibration[sensor],
        (settings.get("sensor") or {}).get(sensor) or {},
        settings["table"],
    )
    noise, traces = found.get("noise") or held_out.get("noise"), residuals(sensor, part, recordings, table)
    first, last = first_and_last_step(held_out)
    at_rest = (calibration.get("noise") or {}).get(sensor)
    limits, kind = limit_rows(sensor, found, sensor_config), VERDICTS.get(found.get("verdict", ""), "")
    held, likely = held_out.get("held_out", True), (found.get("answer_set") or [{}])[0].get("effects")
    logged = any(v is not None for r in recordings for v in (r.table_attitude, r.table_rate, r.table_angle))
    far = (last.get("rms_error") or 0.0) > FAR * (held_out.get("noise_floor") or np.inf)
    parameters = parameter_rows(part, sensor_config)
    return {
        "held_out": held_out,
        "before": first.get("rms_error"),
        "after": last.get("rms_error"),
        "floor": held_out.get("noise_floor"),
        "steps": [{**step, "label": step_label(step["name"])} for step in held_out.get("steps", [])],
        "step_figures": [error_steps(sensor, held_out, found, vector=vector) for vector in (False, True)],
        "model_figures": [measurement_and_model(sensor, r, noise) for r in traces],
        "held_out_figures": held_out_figures(sensor, calibration, held_out, recordings, table),
        "residual_figures": residual_figures(sensor, traces, noise),
        "noise_figure": allan(sensor, at_rest, sensor_config, found.get("wander")),
        "noise_terms": term_rows(at_rest),
        "noise_remarks": remarks(at_rest),
        "matrix": fitted_parameters(part)[3:12],
        "parameters": parameters,
        "beyond_limits": beyond_limits(parameters, mounted=table.get("motion", "none") != "none"),
        "rests": rest_rows(part),
        "diagnosis": found,
        "ranking": ranking_rows(found),
        "evidence_figures": [*evidence_figures(sensor, found), upper_limits(sensor, limits)],
        "limits": limits,
        "implausible": sentences(sensor, part),
        "beyond": beyond_uncertainty(part),
        "kind": "warn" if not held else "" if (far or likely) and kind == "good" else kind,
        "of_rests": table.get("motion") == "none" and not logged,
        "far": far,
        "commands": commands_of(found, sensor, str(calibration.get("unit")), settings.get("run") or {}),
    }
