"""Errors on held-out motion: each step of the calibration, the error over time, the attitude, and the limits.

A unit without limits neither passes nor fails; a unit that failed does not pass.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core.records import SENSOR_UNITS, SENSORS, Noise, Recording, SensorCalibration, Values
from pipeline.evaluation.held_out.error_breakdown import with_known_effects
from pipeline.evaluation.held_out.samples import OTHER_SENSOR, samples_of_motion
from pipeline.output.pages.chart import Area, ChartLayer, Figure, LineMark, Panel, SampleMarks, chart, sentences
from pipeline.output.pages.group_charts import Point, bars
from pipeline.output.pages.numbers import number, plain

if TYPE_CHECKING:
    from pipeline.core.files import JSON
    from pipeline.core.settings import Table
    from pipeline.output.pages.numbers import Scale

# held-out errors of diagnosis and validation that agree within this factor are shown as one series
EQUAL_ERROR_FACTOR = 1.2
SOURCES = {
    "static": "the static recording",
    "rests": "the rests",
    "residual": "short windows of turns",
    "data_sheet": "the sensor file",
}
BEFORE_AFTER = (("c3", "before"), ("c2", "after"))
SILENT = Noise(np.zeros(3), np.zeros(3), 100.0, "none")  # errors are drawn, not weighted


def checks(validation: JSON | None) -> list[JSON]:
    """Return each limit of the configuration and its result: ``sensor, name, value, limit, unit, pass``."""
    return [
        {**check, "sensor": sensor, "unit": "" if check["name"] == "scale_factor" else SENSOR_UNITS[sensor]}
        for sensor in SENSORS
        for check in ((validation or {}).get(sensor) or {}).get("limits") or []
    ]


def passes(calibration: JSON, validation: JSON | None) -> bool | None:
    """Return whether a unit is within its limits; None without limits."""
    if calibration.get("status") != "ok":
        return False
    results = [bool(check["pass"]) for check in checks(validation)]
    return all(results) if results else None


def first_and_last_step(held_out: JSON | None) -> tuple[JSON, JSON]:
    """Return the errors of the raw readings and of the readings after everything that was fitted."""
    steps = (held_out or {}).get("steps") or [{}]
    return steps[0], steps[-1]


def step_label(name: str) -> str:
    """Return the name of a step for a page."""
    return plain(name.replace("stage:", "after ", 1))


def error_steps(sensor: str, held_out: JSON, found: JSON, scale: Scale, *, vector: bool) -> Figure | None:
    """Draw the held-out error after each step, with the noise floor, in a unit with prefix; None where it is unknown.

    ``held_out, found``: the sensor's parts of validation and diagnosis; effects that the diagnosis selected are further
    steps. ``vector``: the error of the vector instead of the magnitude.
    """
    prefix, unit = "vector_" if vector else "", scale.unit
    key, floor = f"{prefix}rms_error", held_out.get(f"{prefix}noise_floor")
    floor = floor / scale.factor if floor else floor
    steps = [{**s, key: s[key] / scale.factor if s.get(key) is not None else None} for s in held_out.get("steps", [])]
    if not steps or all(s.get(key) is None for s in steps):
        return None
    rows = [Point(step_label(s["name"]), s.get(key), 3 if s["name"] == "raw" else 2) for s in steps]
    reached, added = steps[-1].get(key), []
    if vector or all(s.get("vector_rms_error") is None for s in steps):
        added = _steps_if_added(found, reached, scale.factor)
    kind = "vector" if vector else "magnitude"
    keys = ("source", "wander_source", "correlation_time_source") if "noise" in held_out else ()
    finding, caption, _ = sentences(
        "staircase",
        kind=kind,
        reached=reached,
        floor=floor,
        unit=unit,
        added=added,
        held_out=held_out.get("held_out", True),
        sources=[SOURCES[held_out["noise"][key]] for key in keys],
    )
    figure = Figure(f"{sensor}-staircase-{kind}", finding, caption)
    label = f"root mean square error, {unit} (logarithmic)"
    return bars(figure, rows + added, label, levels={f"noise floor {number(floor)}": floor or 0.0})


def _steps_if_added(found: JSON, reached: float | None, factor: float) -> list[Point]:
    """Return the errors over ``factor`` with each selected effect; empty if the diagnosis starts from another error.

    The diagnosis states the errors of its own fits; the one that is reached is reduced in the same ratio.
    """
    entries = {r["effect"]: r for r in found.get("ranking") or []}
    chosen = [entries[name] for name in found.get("selected") or [] if name in entries]
    if not chosen or not reached or any(r.get("held_out_error_after") is None for r in chosen):
        return []
    start = chosen[0]["held_out_error_before"] / factor
    if not 1.0 / EQUAL_ERROR_FACTOR < start / reached < EQUAL_ERROR_FACTOR:
        return []
    words = "if added with the suggested shape" if found.get("suggested_effect") else "if added"
    return [
        Point(f"+ {plain(r['effect'])}, {words}", r["held_out_error_after"] / factor * reached / start, 4)
        for r in chosen
    ]


def held_out_figures(
    sensor: str, calibration: JSON, held_out: JSON, recordings: list[Recording], table: Table
) -> list[Figure]:
    """Draw the error of the magnitude in each held-out recording with a reference, as in the validation.

    ``held_out``: the sensor's part of the validation.
    """
    fits = {s: SensorCalibration.from_json(s, calibration[s]) for s in SENSORS if calibration.get(s)}
    floor, by_hand, figures = held_out.get("noise_floor"), table.motion == "none", []
    for recording in (r for r in recordings if r.role == "validation"):
        logged = sensor == "accelerometer" or (recording.table_rate is not None and table.latitude_deg is None)
        needed = fits[sensor].effects or not logged  # otherwise the attitude, which costs time, changes no magnitude
        reference = recording if needed else replace(recording, table_attitude=None)
        samples = samples_of_motion(sensor, reference, SILENT, table, other=fits.get(OTHER_SENSOR[sensor]))
        if samples is not None:
            vector, magnitude, _ = with_known_effects(fits[sensor], samples)
            raw = np.linalg.norm(samples.reading, axis=1) - samples.magnitude
            after, name = np.linalg.norm(vector, axis=1) - magnitude, f"{sensor}-held-out-{recording.name}"
            figures.append(held_out_over_time(name, sensor, recording, raw, after, floor=floor, by_hand=by_hand))
    return figures


def held_out_over_time(
    name: str,
    sensor: str,
    recording: Recording,
    raw: Values,
    calibrated: Values,
    *,
    floor: float | None = None,
    by_hand: bool = False,
) -> Figure:
    """Draw the error of the magnitude in held-out motion before and after calibration.

    ``raw, calibrated``: (n,) arrays of magnitude minus reference, g or deg/s; ``floor``: rms error by noise alone;
    ``by_hand``: the reference lacks the acceleration of the moving unit.
    """
    unit, x = SENSOR_UNITS[sensor], recording.time - recording.time[0]
    after: list[ChartLayer] = [SampleMarks(x, calibrated, 2, mean=True)]
    panels = [
        Panel([SampleMarks(x, raw, 3), SampleMarks(x, calibrated, 2)], f"error, {unit}", 120, {"": 0.0}),
        Panel([Area(-2 * floor, 2 * floor), *after] if floor else after, f"after, {unit}", 80),
    ]
    rms = [float(np.sqrt(np.nanmean(v**2))) for v in (raw, calibrated)]
    finding, caption, description = sentences(
        "held_out", name=recording.name, sensor=sensor, rms=rms, unit=unit, by_hand=by_hand
    )
    return chart(Figure(name, finding, caption, BEFORE_AFTER), description, panels, "time, s")


def attitude_over_time(found: JSON) -> Figure | None:
    """Draw the attitude error of the integrated gyroscope and the tilt error of the fused attitude."""
    curve = found.get("curve")
    if not curve:
        return None
    panels = [_attitude_panel(curve, "drift", "gyroscope alone, deg")]
    if found.get("tilt_rms_deg"):
        panels.append(_attitude_panel(curve, "tilt", "fused tilt, deg"))
    finding, caption, description = sentences("attitude", found=found)
    return chart(Figure("attitude-error", finding, caption, BEFORE_AFTER), description, panels, "time, s")


def _attitude_panel(curve: JSON, name: str, label: str) -> Panel:
    """Return the panel of the angles before and after; its limits ignore the start, where both are nearly zero."""
    time = np.array(curve["time_s"], float)
    angles = {colour: np.array(curve[f"{name}_{when}"], float) for when, colour in (("before", 3), ("after", 2))}
    later = np.concatenate([v[len(v) // 50 + 1 :] for v in angles.values()])
    later = later[later > 0]
    limits = (float(later.min()) / 1.2, float(later.max()) * 1.2) if later.size else (1e-3, 1.0)
    return Panel([LineMark(time, v, c) for c, v in angles.items()], label, 110, limits=limits, logarithmic=True)
