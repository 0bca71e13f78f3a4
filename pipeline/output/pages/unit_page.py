"""The page of one unit: verdict and held-out error first, then the evidence.

One file that works offline: style, script and charts are inline, and its content security policy forbids requests.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from pipeline.core.files import JSON, json_text
from pipeline.core.records import AXES, BIAS, MATRIX, SENSOR_UNITS, SENSORS, Recording, SensorCalibration, Values
from pipeline.core.settings import Settings
from pipeline.core.verdicts import (
    KINDS,
    MARK_ABOVE_FLOORS,
    MARK_AFTER_MOVES,
    Verdict,
    css_class,
    error_of,
    moves_over_noise,
    state_of,
    turn_errors,
)
from pipeline.output.outcome import apply_command, as_overrides, commands_of, found_mountings, place, run_command
from pipeline.output.pages.chart import ChartLayer, Figure, LineMark, Panel, chart
from pipeline.output.pages.held_out_section import (
    allan,
    attitude_over_time,
    checks,
    error_steps,
    held_out_figures,
    over_temperature,
    passes,
    remarks,
    step_label,
    term_rows,
)
from pipeline.output.pages.pages import NOTHING, measured_row, number, scale_of, template
from pipeline.output.pages.parameters import fitted_parameters, parameter_rows, summary_row
from pipeline.output.pages.residual_section import (
    added_variable,
    limit_rows,
    measurement_and_model,
    ranking,
    ranking_rows,
    residual_figures,
    residuals,
    unexplained,
    upper_limits,
)
from pipeline.physics.signal.rests import Rest, rests_from_table
from pipeline.physics.statements import beyond_uncertainty, beyond_words, frame_words, left_out, sentences

LEFT, LANE, LETTERS = 86, 17, 13  # px of the names, px of a lane, letters of a name
USES = {"used": 1, "held out": 2, "left out": 0}  # of the rests that a fit found in the readings, with their colours
LOGGED = 4  # colour of rests from a table's log
MIN_REST_WIDTH = 0.002  # of the axis: the smallest width of a rest
MOST_REASONS = 3  # sentences that are shown without unfolding
KINDS_OF_ERROR = ("vector", "magnitude")
ANGLE_STEP_S = 0.2  # over which a rate is computed from an angle: an encoder of 0.01 deg gives it to 0.05 deg/s
STILL_ANGLE = 0.1  # deg/s, two steps of such an encoder
MAX_RATE_OF_STILL_LOG_DPS = 0.02  # deg/s, below which a table's log is noise of its rate
MARKS = ("after a gap", "clipped", "stuck", "repaired")  # of samples, by the bits of their flags


def render(
    calibration: JSON,
    validation: JSON | None,
    diagnosis: JSON | None,
    recordings: list[Recording],
    settings: Settings,
    *,
    words: dict[str, list[str]] | None = None,
    incomplete: Sequence[JSON] = (),
) -> str:
    """Return the page of one unit as HTML.

    ``validation, diagnosis``: None where their stage failed; ``recordings``: after the filter, may be empty; ``words``:
    the diagnosis of each sensor in sentences; ``incomplete``: ``stage`` and ``message`` of what could not be made.
    """
    row = summary_row(str(calibration.get("unit")), calibration, validation, diagnosis, {})
    validation, diagnosis, words = validation or {}, diagnosis or {}, words or {}
    attitude, moves = validation.get("attitude") or {}, validation.get("gravity_direction") or {}
    ok, rests = calibration.get("status") == "ok", {r.name: rests_from_table(r) for r in recordings}
    seconds = sum(_duration(r) for r in recordings if r.samples)
    environment = {"temperature": sensor_temperature(recordings), "recorded_s": seconds, "table": settings.table}
    environment |= {"filter": settings.filter.name}
    fits = {s: SensorCalibration.from_json(s, calibration[s]) for s in SENSORS if ok and calibration.get(s)}
    sensors = []
    for sensor in SENSORS if ok else ():
        shown = {"name": sensor, "unit": SENSOR_UNITS[sensor], "part": calibration.get(sensor)}
        if shown["part"] is None:
            shown["reason"] = calibration.get("not_calibrated", {}).get(sensor, "the procedure does not calibrate it")
        else:
            found = diagnosis.get(sensor) or {}
            shown |= _sensor(sensor, calibration, validation, found, fits, recordings=recordings, settings=settings)
            shown |= _sentences(words.get(sensor) or [], found)
        sensors.append(shown)
    determining = settings.only(settings.model_fields_set - {"stated", "certificate"})
    determining["config_sha256"] = settings.stated.config_sha256
    return template("unit.html").render(
        calibration=calibration,
        ok=ok,
        problems=state_of(row | {"incomplete": "; ".join(f"{r['stage']}: {r['message']}" for r in incomplete)}).kinds,
        kinds=KINDS,
        apply=apply_command(settings.stated.run, str(calibration.get("unit"))) if ok and settings.stated.run else None,
        passed=passes(calibration, validation),
        checks=checks(validation),
        left_out=left_out(calibration.get("inputs")),
        incomplete=incomplete,
        files_read=files_read(calibration.get("inputs")),
        mounting=found_mounting(calibration),
        sensors=sorted(sensors, key=lambda s: 99 if s["part"] is None else place(s["diagnosis"].get("verdict"))),
        attitude=attitude if attitude.get("curve") else None,
        attitude_figure=attitude_over_time(attitude),
        moves=moves if moves.get("moves") else None,
        turns=validation.get("turns"),
        recordings=recording_rows(recordings, rests),
        segments=segments(recordings, rests, calibration),
        rests=rest_rows(calibration),
        environment=environment if recordings else None,
        row={k: v for k, v in settings.stated.row.items() if v},
        command=run_command(settings.stated.run) if settings.stated.run else None,
        settings_text=json_text(dict(sorted(determining.items()))),
    )


def found_mounting(calibration: JSON) -> JSON | None:
    """Return the recordings that gravity shows mounted otherwise than stated, and the overrides that state it."""
    notes = ((i, n) for i in calibration.get("inputs") or [] for n in i.get("notes") or [] if isinstance(n, dict))
    noted = {i.get("recording", i.get("file")): n["settings"] for i, n in notes if n.get("settings")}
    groups = found_mountings([(calibration["unit"], noted)])
    return {"recordings": groups[0].recordings, "overrides": as_overrides(groups[0].ways)} if groups else None


def _sensor(
    sensor: str, calibration: JSON, validation: JSON, found: JSON, fits: Mapping[str, SensorCalibration],
    *, recordings: list[Recording], settings: Settings,
) -> JSON:  # fmt: skip
    """Return what the template shows of a calibrated sensor; ``found``: its part of the diagnosis."""
    part, held_out, table = calibration[sensor], validation.get(sensor) or {}, settings.table
    data_sheet = settings.sensor.of(sensor)
    noise, traces = found.get("noise") or held_out.get("noise"), residuals(fits[sensor], recordings, table)
    error = error_of(held_out)
    scale = scale_of(SENSOR_UNITS[sensor], error.after, error.floor)
    at_rest = (calibration.get("noise") or {}).get(sensor)
    limits, kind = limit_rows(sensor, found, data_sheet), css_class(found.get("verdict"))
    kind = "warn" if found.get("failed") else kind
    likely = (found.get("answer_set") or [{}])[0].get("effects")
    logged = any(v is not None for r in recordings for v in (r.table_attitude, r.table_rate, r.table_angle))
    moves = moves_over_noise(validation) if sensor == "gyroscope" else None
    far = (error.ratio or 0.0) > MARK_ABOVE_FLOORS or (moves or 0.0) > MARK_AFTER_MOVES
    steps = {kind: error_steps(sensor, held_out, found, scale, vector=kind == "vector") for kind in KINDS_OF_ERROR}
    evidence = [added_variable(sensor, found), *unexplained(sensor, found)]
    dependence = residual_figures(sensor, traces, noise)
    over = [ranking(sensor, found), upper_limits(sensor, limits)]
    cause = next((figure for figure in (*evidence, *dependence, *over) if figure), None)
    parameters, run = parameter_rows(sensor, part, data_sheet), settings.stated.run
    return {
        "held_out": held_out,
        "error": error,
        "scale": scale,
        "use_rows": use_rows(part, at_rest),
        "floor": held_out.get("noise_floor"),
        "steps": [{**step, "label": step_label(step["name"])} for step in held_out.get("steps", [])],
        "why_figures": [cause, steps[error.kind], over_temperature(fits[sensor], recordings)],
        "step_figures": [figure for kind, figure in steps.items() if kind != error.kind],
        "model_figures": [measurement_and_model(sensor, r, noise) for r in traces],
        "held_out_figures": held_out_figures(sensor, fits, held_out, recordings, table),
        "residual_figures": [figure for figure in dependence if figure is not cause],
        "noise_figure": allan(sensor, at_rest, data_sheet, found.get("wander")),
        "noise_terms": term_rows(at_rest),
        "noise_remarks": remarks(at_rest),
        "matrix": fitted_parameters(part)[MATRIX],
        "parameters": parameters,
        "beyond_limits": beyond_words(part),
        "rests": rest_rows(part),
        "diagnosis": found,
        "ranking": ranking_rows(found),
        "evidence_figures": [figure for figure in (*over, *evidence) if figure is not cause],
        "limits": limits,
        "implausible": sentences(sensor, part),
        "beyond": beyond_uncertainty(part),
        "frame": frame_words(part),
        "kind": "warn" if not held_out.get("held_out", True) else "" if (far or likely) and kind == "good" else kind,
        "of_rests": table.motion == "none" and not logged,
        "moves": {**validation["gravity_direction"], "over_noise": moves} if moves else None,
        "turned": turn_errors(validation) if sensor == "gyroscope" else None,
        "far": far,
        "commands": commands_of(found, sensor, str(calibration.get("unit")), run)
        if (run := settings.stated.run)
        else {},
    }


def use_rows(part: JSON, noise: JSON | None) -> list[JSON]:
    """Return what a user of the calibration needs by axis: bias and matrix with U, and the noise terms N, B and K.

    A row has ``name``, ``key`` of its definition, ``texts`` of x, y, z and U, and ``unit`` with an SI prefix.
    """
    bias, matrix = fitted_parameters(part)[BIAS], fitted_parameters(part)[MATRIX]
    rows: list[JSON] = []
    lines = [("bias", bias), *((f"matrix {axis}", matrix[3 * i : 3 * i + 3]) for i, axis in enumerate(AXES))]
    for name, line in lines:
        scale = scale_of(line[0].unit, *(v for p in line for v in (p.value, p.expanded_uncertainty)))
        U = [p.expanded_uncertainty and p.expanded_uncertainty / scale.factor for p in line]
        texts = measured_row([p.value / scale.factor for p in line], U)
        rows.append({"name": name, "key": "", "texts": texts, "unit": scale.unit})
    axes = [axis["terms"] or {} for axis in ((noise or {}).get("axes") or {}).values()]
    for term, symbol in (("white", "N"), ("bias_instability", "B"), ("random_walk", "K")):
        found = [terms.get(term) for terms in axes]
        if any(found):
            unit = next(each["unit"] for each in found if each)
            sizes = [(each or {}).get("value") or (each or {}).get("upper_limit") for each in found]
            scale = scale_of(unit, *sizes)
            limits = ["" if (each or {}).get("value") else "< " for each in found]
            texts = [f"{s}{number(v / scale.factor)}" if v else NOTHING for s, v in zip(limits, sizes, strict=True)]
            rows.append({"name": f"noise {symbol}", "key": symbol, "texts": [*texts, ""], "unit": scale.unit})
    return rows


def _sentences(words: Sequence[str], found: JSON) -> JSON:
    """Return the sentences of a diagnosis by the part of the page that has them: verdict, why, and further evidence."""
    verdict, *others = words or ["There is no diagnosis."]
    folded = ("Upper limits", "Not observable", "Next experiment", "+- ", "To distinguish", "What is missing")
    why = [line for line in others if not line.startswith(folded)][:MOST_REASONS]
    hidden = ("Upper limits", "Not observable", "Next experiment")  # in tables, and on the card
    further = [line for line in others if line not in why and not line.startswith(hidden)]
    step = str(found.get("next_experiment") or "")
    nothing = found.get("verdict") == Verdict.NOTHING_MISSING and step.startswith("none")
    return {"verdict_words": verdict, "why": why, "further": further, "next_step": "" if nothing else step}


def files_read(inputs: list[JSON] | None) -> list[JSON]:
    """Return name, hash and rows of each file in ``inputs`` of a calibration, including joined files."""
    files = [file for entry in inputs or [] for file in (entry, *entry.get("joined", []))]
    return [{key: file.get(key) for key in ("file", "sha256", "rows")} for file in files]


def rest_rows(part: JSON) -> list[JSON]:
    """Return the rests that were found in the readings, in order of time: used, held out or left out, and why."""
    found = [part.get("rests") or {}, *(stage.get("details") or {} for stage in part.get("stages") or [])]
    keys = {use: f"rests_{use.replace(' ', '_')}" for use in USES}
    rows = [{**r, "use": use} for rests in found for use, key in keys.items() for r in rests.get(key) or []]
    return sorted(rows, key=lambda row: (row["recording"], row["time_s"]))


def recording_rows(recordings: list[Recording], rests: dict[str, list[Rest]]) -> list[JSON]:
    """Return a row for each recording with its role, length, rate, motion, rests and temperature."""
    return [
        {
            "name": r.name,
            "role": r.role + (f", {r.axis} axis" if r.axis else ""),
            "samples": r.samples,
            "duration": number(_duration(r) if r.samples else None, 4),
            "rate": number(1.0 / r.interval if r.samples > 1 and r.interval > 0 else None, 4),
            "motion": _motion(r, len(rests[r.name])),
            "temperature": _range(r.temperature),
            "flagged": ", ".join(
                f"{count} {mark}"
                for bit, mark in enumerate(MARKS)
                if r.flags is not None and (count := np.count_nonzero(r.flags & (1 << bit)))
            ),
        }
        for r in recordings
    ]


def _duration(recording: Recording) -> float:
    return float(recording.time[-1] - recording.time[0])


def _motion(recording: Recording, rests: int) -> str:
    rate, by = recording.table_rate, ""
    if rate is None and recording.table_angle is not None and recording.samples > 1:
        every = max(1, round(ANGLE_STEP_S / recording.interval)) if recording.interval > 0 else 1
        angle, time = recording.table_angle[::every], recording.time[::every]
        rate, by = np.diff(angle) / np.maximum(np.diff(time), every * 1e-9), ", by its angle"
    if rate is None:
        logged = "the attitude is logged" if recording.table_attitude is not None else "by hand or not logged"
        return "at rest" if recording.role == "static" else logged
    fastest = float(np.max(np.abs(rate), initial=0.0))
    if fastest < (STILL_ANGLE if by else MAX_RATE_OF_STILL_LOG_DPS):
        return "at rest"
    kind = "stop-and-go" if rests > 2 else "continuous"
    return f"{kind}, {rests} rest{'s' if rests != 1 else ''}, up to {number(fastest)} deg/s{by}"


def _range(values: Values | None) -> str:
    if values is None or not np.isfinite(values).any():
        return NOTHING
    return f"{np.nanmin(values):.1f} to {np.nanmax(values):.1f}"


def sensor_temperature(recordings: list[Recording]) -> str | None:
    """Return the range of the sensor's temperature in all recordings, degC; None where it was not recorded."""
    known = [r.temperature for r in recordings if r.temperature is not None and np.isfinite(r.temperature).any()]
    return _range(np.concatenate(known)) if known else None


def segments(recordings: list[Recording], rests: dict[str, list[Rest]], calibration: JSON) -> Figure | None:
    """Draw the rests of each recording, by the calibration or the table's log; None where no rest is known."""
    drawn = [r for r in recordings if r.samples > 1]
    spans = {r.name: _spans(r, rests[r.name], calibration) for r in drawn}
    if not any(spans.values()):
        return None
    one_file = len({r.source.get("file") for r in drawn}) == 1 < len(drawn)
    first = min(float(r.time[0]) for r in drawn)
    begin = {r.name: float(r.time[0]) - first if one_file else 0.0 for r in drawn}
    narrowest = MIN_REST_WIDTH * max(begin[r.name] + _duration(r) for r in drawn)
    lanes = drawn[::-1]  # the first at the top
    layers: list[ChartLayer] = []
    for y, r in enumerate(lanes, 1):
        layers.append(LineMark(np.array([0.0, _duration(r)]) + begin[r.name], np.full(2, float(y)), 3))
        for colour in sorted({c for *_, c in spans[r.name]}):
            ends = [(a, max(b, a + narrowest), np.nan) for a, b, c in spans[r.name] if c == colour]
            x = np.ravel(ends) + begin[r.name]
            layers.append(LineMark(x, np.full(len(x), float(y)), colour, "thick"))
    count, colours = sum(map(len, spans.values())), {c for of in spans.values() for *_, c in of}
    finding = f"{count} rest{'s' if count != 1 else ''} in {len(drawn)} recording{'s' if len(drawn) != 1 else ''}"
    legend = tuple((f"c{c}", f"rest, {use}") for use, c in USES.items() if c in colours) or ((f"c{LOGGED}", "rest"),)
    names = [r.name if len(r.name) <= LETTERS else f"{r.name[: LETTERS - 1]}…" for r in lanes]
    figure = Figure("segments", finding, "Thick: rests that were found; thin: the remaining time.", legend)
    counts = "; ".join(f"{name}: {len(of)}" for name, of in spans.items())
    panel = Panel(layers, "", LANE * len(lanes), limits=(0.5, len(lanes) + 0.5), rows=names)
    axis = "time since the start of the recording, s"
    return chart(figure, f"Rests of each recording. {counts}.", [panel], axis, left=LEFT)


def _spans(recording: Recording, logged: list[Rest], calibration: JSON) -> list[tuple[float, float, int]]:
    """Return start, end (s since the recording's start) and colour of each rest."""
    start = float(recording.time[0])
    found = {
        (r["time_s"] - start, r["time_s"] - start + r["duration_s"], USES[r["use"]])
        for part in (calibration, *(calibration.get(s) or {} for s in SENSORS))
        for r in rest_rows(part)
        if r["recording"] == recording.name
    }
    time = recording.time - start
    return sorted(found) or [(float(time[r.start]), float(time[r.stop - 1]), LOGGED) for r in logged]
