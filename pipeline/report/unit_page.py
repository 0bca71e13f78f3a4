"""The page of one unit: verdict and held-out error first, then what they rest on.

One file that opens offline: style, script and charts are inline, and its content security policy forbids every request.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.files import json_text
from pipeline.model.effects import effect_of
from pipeline.model.inversion import compensate, linear_truth, sensor_effects
from pipeline.model.kinematics import reference_motion
from pipeline.model.plausible import sentences
from pipeline.outcome import commands_of, place, run_command
from pipeline.records import SENSORS, SensorCalibration
from pipeline.report import figures, tables
from pipeline.report.attitude_figure import attitude_over_time
from pipeline.report.budget_table import budget_of, convergence_of
from pipeline.report.evidence_figures import added_variable, unexplained
from pipeline.report.figure import UNITS, Figure
from pipeline.report.limits import checks, final_step, verdict
from pipeline.report.noise_figure import allan
from pipeline.report.ranking_chart import ranking
from pipeline.report.residual_figures import residual_figures
from pipeline.report.residuals import Residual, residuals
from pipeline.report.session import environment, recording_rows, rests_logged, segments
from pipeline.report.templating import template

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.records import Recording

JSON = dict[str, Any]
VERDICTS = {
    "nothing_missing": "Nothing significant is missing from the model.",
    "missing_effect": "A physical effect is missing from the model.",
    "unexplained": "Something is missing that no known effect explains.",
    "not_enough_data": "The recording is too short to say what is missing.",
    "left_by_method": "The sensor is explained; approximations of its method or filter leave more than noise.",
    "reference_in_doubt": "The reference is in doubt: recordings contradict each other.",
    "floor_in_doubt": "The noise is in doubt: it may be taken for too large and hide an effect.",
}


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

    Parameters
    ----------
    calibration, validation, diagnosis : dict
        As in their files; the last two may be None where their stage failed.
    recordings : list of Recording
        After the filter; may be empty.
    settings : dict
        The unit's part of the resolved configuration.
    words : dict of str to list of str, optional
        The diagnosis of each sensor in sentences.

    Returns
    -------
    str
    """
    pointed = (validation or {}).get("attitude") or {}
    ok, rests = calibration.get("status") == "ok", rests_logged(recordings)
    sensors = [
        _sensor(sensor, calibration, validation, diagnosis, recordings, settings, words or {}) for sensor in SENSORS
    ]
    page: str = template("unit.html").render(
        calibration=calibration,
        ok=ok,
        passed=verdict(calibration, validation),
        checks=checks(validation),
        sensors=sorted(sensors, key=_order) if ok else [],
        attitude=pointed if pointed.get("curve") else None,
        attitude_figure=attitude_over_time(pointed),
        moves=turned if (turned := (validation or {}).get("gravity_direction") or {}).get("moves") else None,
        recordings=recording_rows(recordings, rests),
        segments=segments(recordings, rests, calibration),
        rests=tables.rest_rows(calibration),
        environment=environment(recordings, settings) if recordings else [],
        row={k: v for k, v in (settings.get("row") or {}).items() if v},
        command=run_command(settings["run"]) if settings.get("run") else None,
        settings_text=json_text(
            {k: v for k, v in settings.items() if k not in ("row", "run", "certificate")},
        ),
    )
    return page


def _sensor(  # noqa: PLR0917  (the inputs of the page, passed on)
    sensor: str,
    calibration: JSON,
    validation: JSON | None,
    diagnosis: JSON | None,
    recordings: list[Recording],
    settings: JSON,
    words: dict[str, list[str]],
) -> JSON:
    part, unit = calibration.get(sensor), UNITS[sensor]
    if part is None:
        reason = (calibration.get("not_calibrated") or {}).get(sensor) or "the procedure does not calibrate it"
        return {"name": sensor, "unit": unit, "part": None, "reason": reason}
    held_out, found = (validation or {}).get(sensor) or {}, (diagnosis or {}).get(sensor) or {}
    sheet = (settings.get("sensor") or {}).get(sensor) or {}
    table = settings.get("table") or {}
    traces = residuals(sensor, part, recordings, table)
    noise = found.get("noise") or held_out.get("noise")
    sigma = _sigma(noise, traces)
    steps = held_out.get("steps") or [{}]
    return {
        "name": sensor,
        "unit": unit,
        "part": part,
        "held_out": held_out,
        "before": steps[0].get("rms_error"),
        "after": final_step(held_out).get("rms_error"),
        "floor": held_out.get("noise_floor"),
        "steps": tables.step_rows(held_out),
        "staircases": [f for v in (False, True) if (f := figures.staircase(sensor, held_out, found, vector=v))],
        "model_figures": [figures.measurement_and_model(sensor, r, sigma) for r in traces],
        "held_out_figures": _held_out(sensor, part, held_out, recordings, table),
        "residual_figures": residual_figures(sensor, traces, noise),
        "noise_figure": allan(sensor, recordings, noise, sheet, found.get("wander")),
        "matrix": tables.matrix_rows(part),
        "parameters": tables.parameter_rows(part, sheet) + tables.effect_rows(part, sheet),
        "budget": budget_of(part),
        "convergence": convergence_of(part),
        "stages": tables.stage_rows(part),
        "rests": tables.rest_rows(part),
        "diagnosis": found,
        "ranking": tables.ranking_rows(found),
        "evidence_figures": [f for f in (ranking(sensor, found), added_variable(sensor, found)) if f]
        + unexplained(sensor, found),
        "implausible": sentences(sensor, part),
        "verdict": VERDICTS.get(found.get("verdict", ""), "There is no diagnosis."),
        "words": words.get(sensor) or [],
        "commands": commands_of(found, sensor, str(calibration.get("unit")), settings.get("run") or {}),
    }


def _order(sensor: JSON) -> int:
    """Return the place of a sensor: what is missing or in doubt before what is explained, one without a fit last."""
    return 99 if sensor["part"] is None else place(sensor["diagnosis"].get("verdict"))


def _sigma(noise: JSON | None, traces: list[Residual]) -> NDArray[np.float64] | None:
    if not noise or not noise.get("white") or not traces:
        return None
    gain = float(traces[0].recording.filter.get("noise_gain", 1.0))
    wander = np.array(noise.get("wander") or [0.0] * 3, float)
    sigma: NDArray[np.float64] = np.hypot(gain * np.array(noise["white"], float), wander)
    return sigma


def _held_out(sensor: str, part: JSON, held_out: JSON, recordings: list[Recording], table: JSON) -> list[Figure]:
    out = []
    calibration = SensorCalibration.from_json(sensor, part)
    for recording in recordings:
        reading = recording.reading(sensor)
        rate = recording.table_rate
        if recording.role != "validation" or reading is None or (sensor == "gyroscope" and rate is None):
            continue
        if rate is None or sensor == "accelerometer":
            reference = table.get("gravity_g") or 1.0
        else:
            late = recording.time - float(recording.filter.get("delay_s", 0.0))
            reference = np.interp(late, recording.time, np.abs(rate))
        raw = np.linalg.norm(reading, axis=1) - reference
        calibrated = np.linalg.norm(_calibrated(calibration, reading, recording, table), axis=1) - reference
        out.append(figures.held_out_over_time(sensor, recording, raw, calibrated, held_out.get("noise_floor")))
    return out


def _calibrated(
    calibration: SensorCalibration, reading: NDArray[np.float64], recording: Recording, table: JSON
) -> NDArray[np.float64]:
    """Return calibrated held-out readings, without the sensor's own effects where the reference tells the motion."""
    effects = sensor_effects(calibration)
    motion = reference_motion(recording, table.get("gravity_g") or 1.0) if effects else None
    own = [e for e in effects if motion is not None and effect_of(e).available(motion)]
    if motion is None or not own:
        return linear_truth(calibration, reading)
    return compensate(calibration, reading, motion, own)
