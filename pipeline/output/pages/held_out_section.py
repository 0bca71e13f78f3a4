"""Errors on held-out motion: each step of the calibration, the error over time, the attitude, and the limits.

A unit without limits neither passes nor fails; a unit that failed does not pass.

Noise at rest: Allan deviation of each axis, the identified terms with their 95 % band, and the sensor file.

The terms and their conventions are those of ``pipeline.estimation.noise_terms``; the white noise of a data sheet is
one-sided, ``N = noise_density / sqrt(2)``. Source: IEEE Std 952-1997, annex C.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from pipeline.core.files import JSON
from pipeline.core.records import AXES, SENSOR_UNITS, SENSORS, Noise, Recording, SensorCalibration, Values
from pipeline.core.settings import DataSheet, Table
from pipeline.estimation.gauss_markov import DEFAULT_TIME_S
from pipeline.estimation.multi_position.model import motion_at_rests
from pipeline.estimation.noise_terms import TERM_UNITS, allan_variance
from pipeline.estimation.rest_means import SOAK, gathered, split_rests
from pipeline.evaluation.diagnosis.words import plain
from pipeline.evaluation.held_out.error_breakdown import vector_errors, with_known_effects
from pipeline.evaluation.held_out.samples import OTHER_SENSOR, samples_of_motion
from pipeline.output.pages.chart import (
    AXES_LEGEND,
    Area,
    ChartLayer,
    Dots,
    Figure,
    LineMark,
    Panel,
    SampleMarks,
    chart,
    worded,
)
from pipeline.output.pages.group_charts import Point, bars
from pipeline.output.pages.pages import Scale, number, percent
from pipeline.physics.measurement import predicted_reading

# held-out errors of diagnosis and validation that agree within this factor are shown as one series
EQUAL_ERROR_FACTOR = 1.2
SOURCES = {"static": "the static recording", "rests": "the rests", "residual": "short windows of turns"}
SOURCES |= {"data_sheet": "the sensor file"}
BEFORE_AFTER = (("c3", "before"), ("c2", "after"))
SILENT = Noise(np.zeros(3), np.zeros(3), 100.0, "none")  # errors are drawn, not weighted
# Factor between white noise and data sheet above which a cause is named: the digital filters of an MPU-6050 (5 to
# 260 Hz) change the white noise of a sample by sqrt(52) = 7 at one sampling rate, its ranges by 2 to 8.
MAX_TIMES_DATA_SHEET = 5.0
# factor between both below which they count as equal: data sheets state typical values to about 30 %
EQUAL_NOISE_FACTOR = 1.3
SURE_TERM_PROBABILITY = 0.9  # probability of a set of terms above which no other set is named
SYMBOLS = dict(zip(TERM_UNITS, "QNBKGRA", strict=True))


def over_temperature(calibration: SensorCalibration, recordings: list[Recording]) -> Figure | None:
    """Draw the change of a sensor's reading in soaks over the temperature, the model, and their difference.

    Dots are means of parts of a soak, where the temperature rises and where it falls; each soak counts from its mean,
    which its attitude determines. None without a soak that logs the temperature.
    """
    sensor, found = calibration.sensor, []
    for recording in recordings:
        parts = split_rests(recording, 0).used if recording.kind == SOAK and recording.temperature is not None else ()
        if parts and recording.reading(sensor) is not None:
            rests = gathered(sensor, [recording], {0: parts})
            force = np.tile(rests.reading.mean(axis=0) * (sensor == "accelerometer"), (len(rests.time), 1))
            model = predicted_reading(calibration, motion_at_rests(rests, force))
            change, predicted = (values - values.mean(axis=0) for values in (rests.reading, model))
            of_rests = np.column_stack([rests.temperature, rests.temperature_rate, change, predicted])
            found += [of_rests, np.full((1, 8), np.nan)]
    if not found:
        return None
    warmth, warming, *columns = np.concatenate(found).T  # lines end at the rows of NaN
    unit, panels = SENSOR_UNITS[sensor], list[Panel]()
    reading, model = np.array(columns[:3]), np.array(columns[3:])
    for values, height in ((reading, 72), (reading - model, 56)):
        for i, axis in enumerate(AXES):
            layers: list[ChartLayer] = [LineMark(warmth, model[i], 5, "model")] if values is reading else []
            layers += [Dots(warmth[way], values[i][way], c) for way, c in ((warming >= 0, 0), (warming < 0, 2))]
            panels.append(Panel(layers, f"{axis}, {unit}", height, {} if values is reading else {"": 0.0}))
    rms = [number(float(np.sqrt(np.nanmean(values**2))), 2) for values in (reading, reading - model)]
    finding = f"Over the temperature the reading changes by {rms[0]} {unit}, beyond the model by {rms[1]} {unit} (rms)"
    caption = "Soaks: change of the mean reading, and below it reading minus model."
    figure = Figure(f"{sensor}-temperature", finding, caption, (("c0", "warming"), ("c2", "cooling"), ("c5", "model")))
    span = f"Between {number(np.nanmin(warmth), 3)} and {number(np.nanmax(warmth), 3)} °C."
    return chart(figure, span, panels, "temperature, °C")


def checks(validation: JSON | None) -> list[JSON]:
    """Return each limit of the configuration and its result: ``sensor, name, value, limit, unit, pass``."""
    checks = ((s, check) for s in SENSORS for check in ((validation or {}).get(s) or {}).get("limits") or [])
    return [{**c, "sensor": s, "unit": "" if c["name"] == "scale_factor" else SENSOR_UNITS[s]} for s, c in checks]


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
    last = f"{'' if _exact(found) else 'about '}{number(added[-1].value, added[-1].digits)}" if added else ""
    about = {"kind": kind, "reached": reached, "floor": floor, "unit": unit, "added": last}
    about |= {"held_out": held_out.get("held_out", True), "sources": [SOURCES[held_out["noise"][key]] for key in keys]}
    figure, _ = worded("staircase", f"{sensor}-staircase-{kind}", **about)
    label = f"root mean square error, {unit} (logarithmic)"
    return bars(figure, rows + added, label, levels={f"noise floor {number(floor)}": floor or 0.0})


def _steps_if_added(found: JSON, reached: float | None, factor: float) -> list[Point]:
    """Return the errors over ``factor`` with each selected effect; empty if the diagnosis starts from another error.

    The diagnosis states the errors of its own fits. On a table they are those of a run with the effects (16 units
    agreed to 1e-12). By hand they are those of rests that its fits leave out: 20 units agreed to 31 %, half to 8 %.
    """
    entries = {r["effect"]: r for r in found.get("ranking") or []}
    chosen = [entries[name] for name in found.get("selected") or [] if name in entries]
    if not chosen or not reached or any(r.get("held_out_error_after") is None for r in chosen):
        return []
    start = chosen[0]["held_out_error_before"] / factor
    if not 1.0 / EQUAL_ERROR_FACTOR < start / reached < EQUAL_ERROR_FACTOR:
        return []
    words, exact = "if added with the suggested shape" if found.get("suggested_effect") else "if added", _exact(found)
    words += "" if exact else ", about"
    digits = 3 if exact else 1
    after = [(f"+ {plain(r['effect'])}, {words}", r["held_out_error_after"] / factor) for r in chosen]
    return [Point(name, value, 4, digits=digits) for name, value in after]


def _exact(found: JSON) -> bool:
    """Return whether the diagnosis states errors on held-out motion, which a run with its effects has too."""
    return bool(found.get("held_out"))


def held_out_figures(
    sensor: str, fits: Mapping[str, SensorCalibration], held_out: JSON, recordings: list[Recording], table: Table
) -> list[Figure]:
    """Draw the error of the magnitude in each held-out recording with a reference, as in the validation."""
    floor, by_hand, figures = held_out.get("noise_floor"), table.motion == "none", []
    for recording in (r for r in recordings if r.role == "validation"):
        logged = sensor == "accelerometer" or (recording.table_rate is not None and table.latitude_deg is None)
        needed = fits[sensor].effects or not logged  # otherwise the attitude, which costs time, changes no magnitude
        reference = recording if needed else replace(recording, table_attitude=None)
        samples = samples_of_motion(sensor, reference, SILENT, table, other=fits.get(OTHER_SENSOR[sensor]))
        if samples is not None:
            steps = (samples.reading, samples.magnitude, None), with_known_effects(fits[sensor], samples)
            raw, after = (vector_errors([step], directed=False)[:, 0] for step in steps)
            name = f"{sensor}-held-out-{recording.name}"
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
    about = {"name": recording.name, "sensor": sensor, "rms": rms, "unit": unit, "by_hand": by_hand}
    return chart(*worded("held_out", name, BEFORE_AFTER, **about), panels, "time, s")


def attitude_over_time(found: JSON) -> Figure | None:
    """Draw the attitude error of the integrated gyroscope and the tilt error of the fused attitude."""
    curve = found.get("curve")
    if not curve:
        return None
    panels = [_attitude_panel(curve, "drift", "gyroscope alone, deg")]
    if found.get("tilt_rms_deg"):
        panels.append(_attitude_panel(curve, "tilt", "fused tilt, deg"))
    return chart(*worded("attitude", "attitude-error", BEFORE_AFTER, found=found), panels, "time, s")


def _attitude_panel(curve: JSON, name: str, label: str) -> Panel:
    """Return the panel of the angles before and after; its limits ignore the start, where both are nearly zero."""
    time = np.array(curve["time_s"], float)
    angles = {colour: np.array(curve[f"{name}_{when}"], float) for when, colour in (("before", 3), ("after", 2))}
    later = np.concatenate([v[len(v) // 50 + 1 :] for v in angles.values()])
    later = later[later > 0]
    limits = (float(later.min()) / 1.2, float(later.max()) * 1.2) if later.size else (1e-3, 1.0)
    return Panel([LineMark(time, v, c) for c, v in angles.items()], label, 110, limits=limits, logarithmic=True)


def allan(sensor: str, noise: JSON | None, data_sheet: DataSheet, wander: JSON | None) -> Figure | None:
    """Draw the Allan deviation of each axis; None where no noise was identified; ``wander``: by the diagnosis."""
    axes = {a: part for a, part in ((noise or {}).get("axes") or {}).items() if part["terms"]}
    if not noise or not axes:
        return None
    unit, layers, density = SENSOR_UNITS[sensor], list[ChartLayer](), data_sheet.stated("noise_density")
    for axis, part in axes.items():
        curve, colour = {k: np.array(v) for k, v in part["allan"].items()}, AXES.index(axis)
        layers += [Area(curve["low"], curve["high"], colour, curve["tau_s"])] if part["allan"]["low"] else []
        at, deviation = curve["tau_s"], curve["deviation"]
        layers += [LineMark(at, curve["fit"], colour, "model"), Dots(at, deviation, colour)]
    legend, tau = list(AXES_LEGEND), np.array(next(iter(axes.values()))["allan"]["tau_s"])
    if density:
        legend.append(("c3", "sensor file"))
        size, time = data_sheet.stated("bias_wander") or 0.0, data_sheet.stated("wander_time_s") or DEFAULT_TIME_S
        white = allan_variance("white", density / np.sqrt(2.0), tau)
        deviation = np.sqrt(white + allan_variance("gauss_markov", size, tau, time))
        layers.append(LineMark(tau, deviation, 3, "dashed"))
    mean = np.mean([part["allan"]["deviation"] for part in axes.values()], axis=0)
    means = [(float(mean[k]), float(tau[k])) for k in (0, len(tau) // 2, -1)]
    about = {**_white(axes, density), "unit": unit, "noise": noise, "wander": wander, "mean": means}
    panel = Panel(layers, f"Allan deviation, {unit}", 190, logarithmic=True)
    texts = worded("allan", f"{sensor}-allan", tuple(legend), **about)
    return chart(*texts, [panel], "averaging time, s", kind="log")


def term_rows(noise: JSON | None) -> list[JSON]:
    """Return a row for each term: its name, unit, and a text with interval or upper limit for each axis."""
    axes = [part["terms"] for part in ((noise or {}).get("axes") or {}).values()]
    if not any(axes):
        return []
    rows = []
    for name, symbol in SYMBOLS.items():
        found = [terms[name] if terms else [] for terms in axes]
        lists = [each if isinstance(each, list) else [each] for each in found]
        for i in range(max(map(len, lists))):
            parts = [parts[i] if i < len(parts) else None for parts in lists]
            unit = next(part["unit"] for part in parts if part)
            if any(part and (part["value"] is not None or part.get("upper_limit")) for part in parts):
                rows.append({"name": f"{plain(name)} {symbol}", "unit": unit, "axes": [_text(part) for part in parts]})
    return rows


def remarks(noise: JSON | None) -> list[str]:
    """Return sentences on terms that are missing, on the second best set of terms, and on doubts."""
    if not noise:
        return []
    texts = [f"Not identified: {noise['reason']}."] if noise["reason"] else []
    texts += [f"Intervals and further terms: {noise['intervals_by']}."] if noise.get("intervals_by") else []
    texts += [f"In doubt: {doubt}." for doubt in noise.get("doubts") or []]
    by_axis: dict[str, list[str]] = {}
    for axis, part in (noise["axes"] or {}).items():
        lines = [f"not identified: {part['reason']}"] if part["reason"] else []
        lines += [f"in doubt: {doubt}" for doubt in part.get("doubts") or []]
        ranking = part.get("ranking") or []
        if ranking and ranking[0]["probability"] < SURE_TERM_PROBABILITY and len(ranking) > 1:
            second = ", ".join(map(plain, ranking[1]["terms"]))
            best, next_best = (percent(r["probability"]) for r in ranking[:2])
            lines.append(f"these terms have a probability of {best}, the next best set ({second}) {next_best}")
        terms = part["terms"] or {}
        reasons = {name: term["reason"] for name, term in terms.items() if isinstance(term, dict) and "reason" in term}
        for reason in dict.fromkeys(reasons.values()):
            if "short" in reason:
                lines.append(f"{' and '.join(plain(n) for n, r in reasons.items() if r == reason)}: {reason}")
        for line in lines:
            by_axis.setdefault(line, []).append(axis)
    return texts + [f"{', '.join(axes)}: {line}." for line, axes in by_axis.items()]


def _text(part: JSON | None) -> str:
    """Return a value with its interval if there is one, or the upper limit."""
    if part is None:
        return number(None)
    if part["value"] is None:
        return f"< {number(part['upper_limit'])}" if part.get("upper_limit") else number(None)
    text = number(part["value"])
    text += " ({} to {})".format(*map(number, part["interval"])) if part["interval"] else ""
    for key, unit in (("correlation_time_s", "s"), ("frequency_hz", "Hz")):
        text += f", {number(part[key]['value'])} {unit}" if key in part else ""
    return text


def _white(axes: JSON, density: float | None) -> JSON:
    """Return the white noise, its ratio to the sensor file's density with a likely cause, and the other terms."""
    terms = [part["terms"] for part in axes.values()]
    listed = ((name, p if isinstance(p, list) else [p]) for term in terms for name, p in term.items())
    names = {name for name, parts in listed for part in parts if part["value"] is not None}
    densities = [t["white"]["value"] for t in terms if t["white"]["value"]]
    white = float(np.sqrt(np.mean(np.square(densities)))) if densities else None
    stated = (density or 0.0) / np.sqrt(2.0)
    ratio, cause = white / stated if white and stated else None, ""
    if ratio and ratio > MAX_TIMES_DATA_SHEET:
        cause = ": vibration at rest, another range, or a column in another unit"
    elif ratio and ratio < 1.0 / MAX_TIMES_DATA_SHEET:
        cause = ": a filter in the sensor, smoothed or repeated samples, or a column in another unit"
    others = [name for name in SYMBOLS if name != "white" and name in names]
    as_stated = ratio is not None and 1.0 / EQUAL_NOISE_FACTOR < ratio < EQUAL_NOISE_FACTOR
    return {"white": white, "ratio": ratio, "as_stated": as_stated, "cause": cause, "others": others}
