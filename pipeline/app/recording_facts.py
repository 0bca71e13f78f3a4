"""Describe a recording in lines for the terminal: time, channels, rests, clipping, units, notes and topics.

Propose the sheet ``recordings.csv`` for the files of a unit, from what their readings show; the user corrects it.

| readings | kind |
|---|---|
| no time column, or of an accelerometer alone, 5 deg and more from row to row | ``attitudes`` |
| a table's angle or rate that changes with the rate about one axis | ``table`` |
| at rest in one attitude; the temperature changes by 10 degC or more | ``soak``, else ``rest`` |
| a rotation by 45 deg or more about one axis | ``turn``: whole turns where they fit, else the angle to 1 deg |
| three rests or more | ``moves`` |
| anything else | ``slow`` |

Axes of the gyroscope that contradict gravity are found from all motion: the direction u of the specific force in the
body changes by ``du/dt = -omega x u``. Of the 48 maps P of axes and signs, the one with the smallest
``sum |du/dt + P omega x u|^2`` is proposed where it is at most a quarter of that of the given axes.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Channel, Schema

from imu_logs.files import MESSAGE_FORMATS, SUFFIXES, TEXTS, kind_of
from imu_logs.guesses import BURST_INTERVAL_DIFFERENCE
from imu_logs.log import Values
from imu_logs.mcap_file import McapReader
from imu_logs.message_decoder import ARRAYS, KINDS, object_decoder, ros_layouts
from imu_logs.message_layout import short_name
from imu_logs.message_logs import open_reader
from imu_logs.message_read import LONGEST_ARRAY
from imu_logs.profile import checks_of, csv_formats
from imu_logs.units import DEGREES, TRIADS
from pipeline.app.unit_guesses import FEWEST_RESTS_FOR_A_SPHERE, sphere
from pipeline.checks.bench import nearest_axis, other_axes, signed_permutations
from pipeline.core.errors import IngestError, shortened
from pipeline.core.records import AXES, NOISE_OF_ROWS, SENSOR_UNITS, SENSORS, Note, Recording, median
from pipeline.core.settings import Ingest, RecordingFile, Sensor, Settings
from pipeline.estimation.multi_position.faces_and_turns import FACES, face_of
from pipeline.ingest.files import FILE, grouped, parts_of
from pipeline.ingest.quality_flags import (
    CLIPPED,
    FAILS_DEG,
    FITS_DEG,
    GAP,
    REST_LIMITS,
    STUCK,
    MoveByHand,
    equal_share,
    misfit_deg,
    moves_of,
    rests_of,
)
from pipeline.ingest.read import read_attitudes, read_table, to_recording, turn_between_rows
from pipeline.physics.signal.rests import SHORTEST_REST_S, Rest, find_rests, rests_from_table, runs
from pipeline.physics.signal.segments import MAX_AXIS_SINE, turns_by_hand
from pipeline.simulation.description import shipped_settings

MAX_SEARCHED_SAMPLES = 500_000  # searched for rests and moves
MIN_VARIANCE_SAMPLES = 3  # of a rest, for a variance
PLATEAU = 3  # samples at the largest value; noise repeats it less often
DECISIVE_RATIO = 2.0  # of the misfits of two units of the rates, from which the moves determine the unit
LABEL_WIDTH = 16  # width of the labels, characters
WIDTH = 118  # characters of a line
LISTED_NOTES = 20  # fit one screen; the others are counted
LONGEST_LIST = 4  # elements of an array that are listed
MAX_LISTED_FIELDS = 24  # of a message that are listed
MOST_TOPICS = 20  # with a line each
MOST_RESTS = 60  # whose times are listed

Line = tuple[str, str]
RESTING_SHARE = 0.8  # share of a recording that lies still
WHOLE_REST = 0.9  # share of a recording that is one rest, where the sensor did not move
SUITS_FERRARIS = "six faces and turns about x, y and z in one file: procedure=ferraris determines more (docs/record.md)"
SAME_ATTITUDE_DEG = 5.0  # as a mounting is allowed to differ (procedure.mounting_tolerance_deg)
SWEPT_DEGC = 10.0  # as of a sweep that validation shows
QUIET_DPS = 5.0  # range of a gyroscope at rest, of which bias over temperature is a part
SOAKED_PARTS = 20  # whose mean directions are compared
MIN_PROPOSED_TURN_DEG = 45.0  # half a quarter turn, the smallest that a sheet usually states
WHOLE, ROUND_DEG = 0.05, 1.0  # relative: a scale factor error of 3 %, and a hand; of an angle that is proposed
SMOOTHED_S = 0.2  # means in which the direction of gravity is differentiated: a turn by hand lasts seconds
CLEARER = 0.25  # of the sum of squares, below which another map of axes is proposed
NO_RATE = np.zeros(3)
GRAVITY_WITHIN = 0.2  # g, at rest: consumer sensors have biases of 0.1 g; another unit is wrong by more
OF_PARTS = "log"  # in a sheet, the name of the only recording, where the parts of the profile have fixed names


def facts(recording: Recording, sensor: Sensor | None = None) -> list[Line]:
    """Return the description of a recording as pairs of label and text; ``sensor`` has the full scales."""
    rests = _rests(recording)
    lines = [("time", _time(recording))]
    for name in SENSORS:
        readings = recording.reading(name)
        lines.append((name, "none" if readings is None else _sensor(name, readings, rests)))
    if recording.temperature is not None:
        low, high = float(recording.temperature.min()), float(recording.temperature.max())
        lines.append(("temperature", f"{low:.4g} to {high:.4g} degC" if high > low else f"{low:.4g} degC throughout"))
    lines += [*_table(recording), ("rests", _describe_rests(recording, rests))]
    lines += [("clipping", _clipping(recording, sensor)), *_units(recording, rests)]
    lines += [("notes" if i == 0 else "", text) for i, text in enumerate(_notes(recording.notes))]
    return lines


def shows_gravity(recording: Recording) -> bool:
    """Return whether the accelerometer's readings at rest have the size of gravity, as a fitting profile gives."""
    force, rests = recording.accelerometer, _rests(recording)
    sizes = [] if force is None else [np.linalg.norm(force[a:b].mean(axis=0)) for a, b in rests]
    return bool(sizes) and abs(float(np.median(sizes)) - 1.0) < GRAVITY_WITHIN


def as_text(lines: Sequence[Line]) -> str:
    """Return pairs of label and text as wrapped lines in two columns."""
    wrapped, rest = [], " " * (2 + LABEL_WIDTH)
    for label, text in lines:
        first = f"  {label:<{LABEL_WIDTH}}"
        wrapped += textwrap.wrap(
            text, WIDTH, initial_indent=first, subsequent_indent=rest, break_long_words=False, break_on_hyphens=False
        )
    return "\n".join(wrapped)


def _time(recording: Recording) -> str:
    interval, time = recording.interval, recording.time_ns
    span = float(time[-1] - time[0]) / 1e9
    jitter = float(np.std(np.diff(time) / 1e9)) / interval
    mean = span / max(recording.samples - 1, 1)
    rate, median = f"{1 / interval:.6g} Hz", f"{_number(interval * 1e3)} ms"
    bursty = abs(mean / interval - 1.0) > BURST_INTERVAL_DIFFERENCE
    rate = f"{1 / mean:.6g} Hz on average ({rate} by the median interval of " if bursty else f"{rate} (median interval "
    text = f"{recording.samples:,} rows over {_number(span)} s at {rate}{median}), from {_number(time[0] / 1e9)} s"
    gaps = 0 if recording.flags is None else int(np.count_nonzero(recording.flags & GAP))
    if gaps:
        return f"{text}; {gaps} gap{'s'[: gaps > 1]} (see the notes)"
    return text + ("; no gaps" + (f", intervals scatter by {jitter:.1%}" if jitter > 0.01 else ""))


def _rests(recording: Recording) -> list[tuple[int, int]]:
    turns = _turns(recording)
    by_table = rests_from_table(recording) if turns else []
    if by_table:
        return [(r.start, r.stop) for r in by_table if r.stop - r.start >= MIN_VARIANCE_SAMPLES]
    force = recording.accelerometer
    if force is None or recording.samples < 20 or (turns and recording.table_rate is not None):
        return []
    return rests_of(force[:MAX_SEARCHED_SAMPLES], recording.interval)


def _turns(recording: Recording) -> bool:
    """Return whether the log of the table changes; the log of an unconnected encoder does not."""
    return any(log is not None and np.ptp(log) > 0.0 for log in (recording.table_angle, recording.table_rate))


def _sensor(name: str, readings: Values, rests: Sequence[tuple[int, int]]) -> str:
    unit = SENSOR_UNITS[name]
    spans = [f"{a} {_number(v.min())} to {_number(v.max())}" for a, v in zip(AXES, readings.T, strict=True)]
    text = f"{', '.join(spans)} {unit}"
    if not rests:
        return text
    means = np.array([readings[a:b].mean(axis=0) for a, b in rests])
    noise = np.sqrt(np.median([np.var(np.diff(readings[a:b], axis=0), axis=0) / 2 for a, b in rests], axis=0))
    if name == "accelerometer":
        size = np.linalg.norm(means, axis=1)
        between = f" ({_number(size.min())} to {_number(size.max())})" if len(rests) > 1 else ""
        text += f"; at rest |a| = {_number(float(np.median(size)))} {unit}{between}"
    else:
        usual = np.median(means, axis=0)
        text += f"; at rest {', '.join(_number(v) for v in usual)}"
        if np.abs(usual).max() > REST_LIMITS[name]:
            text += f", more than the {REST_LIMITS[name]:g} {unit} of consumer sensors: check the unit"
    return f"{text}, noise {_number(float(np.median(noise)), 2)} a sample"


def _table(recording: Recording) -> list[Line]:
    texts = []
    if recording.table_angle is not None:
        low, high = float(recording.table_angle.min()), float(recording.table_angle.max())
        texts.append(f"angle {_number(low)}{f' to {_number(high)}' if high > low else ''} deg")
    if recording.table_rate is not None:
        rate = recording.table_rate
        text = f"rate {_number(float(rate.min()))} to {_number(float(rate.max()))} deg/s"
        if recording.gyroscope is not None and np.ptp(rate) > 1.0:
            correlations = [float(np.corrcoef(rate, w)[0, 1]) if np.ptp(w) else 0.0 for w in recording.gyroscope.T]
            axis = int(np.argmax(np.abs(correlations)))
            if abs(correlations[axis]) > 0.9:
                slope = float(np.polyfit(rate, recording.gyroscope[:, axis], 1)[0])
                text += f" (the gyroscope's {AXES[axis]} reads {slope:.3f} of it, correlation {correlations[axis]:.4f})"
        texts.append(text if np.any(rate) else "rate 0 deg/s")
    if recording.table_attitude is not None:
        texts.append("attitude")
    if clock := recording.source.get("table_clock"):
        texts.append(f"a separate clock, {clock['offset_s']:.6g} s ahead and gaining {clock['drift_ppm']:.3g} ppm")
    if texts and recording.table_attitude is None and not _turns(recording):
        texts.append("it does not change: the table did not turn, or its encoder is not connected")
    return [("table", "; ".join(texts))] if texts else []


def _describe_rests(recording: Recording, rests: Sequence[tuple[int, int]]) -> str:
    if not rests:
        return "none found"
    lengths = np.array([b - a for a, b in rests]) * recording.interval
    if len(rests) == 1:
        return f"1, of {_number(lengths[0], 3)} s" + ": the sensor did not move" * _did_not_move(recording, rests)
    text = f"{len(rests)}, {_number(lengths.min(), 2)} to {_number(lengths.max(), 3)} s long"
    if recording.role != "rests" or _turns(recording):
        return text
    if short := int(np.count_nonzero(lengths < SHORTEST_REST_S)):
        text += f"; {short} of them are shorter than {SHORTEST_REST_S:g} s, and a run does not use them"
    return f"{text}; s from the start: {', '.join(shortened(times_of(recording, rests), MOST_RESTS))}"


def times_of(recording: Recording, rests: Sequence[tuple[int, int]]) -> list[str]:
    """Return the times of rests from the start of a recording, s, as windows of a procedure state them."""
    time = recording.time - recording.time[0]
    return [f"{time[a]:.1f} to {time[b - 1]:.1f}" for a, b in rests]


def rests_in_short(recording: Recording) -> str:
    """Return the number of a recording's rests, and the times of the first and the last; empty for fewer than two."""
    times = times_of(recording, [(r.start, r.stop) for r in _accepted(recording)])
    if len(times) < 2:
        return ""
    return f"{recording.name}: {len(times)}, the first at {times[0]} s, the last at {times[-1]} s; check FILE lists all"


def _did_not_move(recording: Recording, rests: Sequence[tuple[int, int]]) -> bool:
    return len(rests) == 1 and rests[0][1] - rests[0][0] > WHOLE_REST * recording.samples


def suits_ferraris(recording: Recording) -> bool:
    """Return whether each face is up in a rest, and whole turns about each axis are between rests."""
    force, found = recording.accelerometer, find_rests(recording)
    means = [] if force is None else [force[r.start : r.stop].mean(axis=0) for r in found if r.accepted]
    turns = shipped_settings(procedure="ferraris").procedure.turns
    if len(means) < len(FACES) or turns is None:
        return False
    about = {turn.axis for turn in turns_by_hand(recording, found, turns)}
    return {*range(len(FACES))} <= {*face_of(np.array(means))[0].tolist()} and len(about) == len(AXES)


def _clipping(recording: Recording, sensor: Sensor | None) -> str:
    """Describe the readings at full scale or, if that is unknown, the readings that stay at their largest value."""
    full_scale = {s: sensor.of(s).full_scale if sensor else None for s in SENSORS}
    flags = recording.flags
    texts = []
    for name in SENSORS:
        readings = recording.reading(name)
        if readings is None:
            continue
        if full_scale[name] is not None:
            largest = float(np.abs(readings).max())
            texts.append(f"{name} up to {_number(largest)} of {full_scale[name]:g} {SENSOR_UNITS[name]}")
            continue
        for channel, values in zip(TRIADS[name], readings.T, strict=True):
            texts += [f"{channel} stays at {text}: clipped?" for text in _plateaus(values)]
    clipped, stuck = (0 if flags is None else int(np.count_nonzero(flags & flag)) for flag in (CLIPPED, STUCK))
    if all(full_scale.values()):
        texts.append(f"{clipped} rows at full scale" if clipped else "none at full scale")
    elif not texts:
        texts.append("no reading stays at its largest value (--sensor NAME compares with a full scale)")
    return "; ".join([*texts, *([f"{stuck} rows stuck"] if stuck else [])])


def _plateaus(values: Values) -> list[str]:
    """Describe the plateaus of a channel at its largest and smallest value, which indicate clipping."""
    same = values[1:] == values[:-1]
    if same.mean() > 0.5 or equal_share(same) > 0.5:
        return []  # too coarse or too quiet to decide
    texts = []
    for extreme in (values.max(), values.min()):
        equal = values == extreme
        longest = max((b - a for a, b in runs(equal)), default=0)
        if longest >= PLATEAU:
            texts.append(f"{_number(float(extreme))} for {longest} samples ({int(equal.sum())} in all)")
    return texts


def _units(recording: Recording, rests: Sequence[tuple[int, int]]) -> list[Line]:
    """State whether the integrated rates agree with the rotation of gravity between rests."""
    if recording.accelerometer is None or recording.gyroscope is None or recording.samples < 20:
        return []
    part = slice(0, MAX_SEARCHED_SAMPLES)
    force = recording.accelerometer[part]
    means = [force[a:b].mean(axis=0) for a, b in rests]
    centre = sphere(np.array(means))[0] if len(means) >= FEWEST_RESTS_FOR_A_SPHERE else np.zeros(3)
    moves = moves_of(force - centre, recording.gyroscope[part], recording.time[part])
    if moves:
        return [("units", _rates_and_gravity(moves))]
    if recording.table_rate is not None:
        return []
    return [("units", "no move between rests turns gravity, so the unit of the rates cannot be checked")]


def _rates_and_gravity(moves: Sequence[MoveByHand]) -> str:
    """State the misfit of the integrated rates to the rotation of gravity, also for other units and other axes."""
    scales = (1.0, DEGREES, 1 / DEGREES)
    declared, *others = misfit_deg(moves, scales)
    best = int(np.argmin(others))
    angle, way = np.median([(m.angle_deg, m.way) for m in moves], axis=0)
    over = f"{counted(len(moves), 'move')} that turn{'s' * (len(moves) == 1)} it by {angle:.0f} deg (medians)"
    if (axes := other_axes(moves)) is not None:
        return f"accelerometer and gyroscope contradict each other: {axes[0]}: check the order and signs of the axes"
    if declared <= FAILS_DEG and DECISIVE_RATIO * declared <= others[best]:
        return (
            f"the rates agree with the rotation of gravity to within {declared:.2g} deg in {over}; that is "
            f"{declared / way:.1%} of the {way:.0f} deg turned through, with uncalibrated scale factors and biases; "
            f"in another unit the rates miss by {others[best]:.0f} deg"
        )
    if others[best] <= FITS_DEG and DECISIVE_RATIO * others[best] <= declared:
        return (
            f"check the unit of the rates: multiplied by {scales[1 + best]:.4g} they turn gravity to within "
            f"{others[best]:.2g} deg in {over}, as declared to within {declared:.2g} deg"
        )
    return (
        f"the moves do not determine the unit of the rates: as declared they turn gravity to within {declared:.2g} deg "
        f"in {over}, in another unit to within {others[best]:.2g} deg"
    )


def _notes(notes: Sequence[Note]) -> list[str]:
    lines = []
    for note in notes[:LISTED_NOTES]:
        count = f" x {note.count}" if note.count > 1 else ""
        last = f" to {note.last}" if note.last != note.first else ""
        place = f", line {note.first}{last}" if note.first else ""
        detail = note.detail.rpartition("; ")[2] if note.settings else note.detail  # ``check`` prints them once
        lines.append(f"{note.code}{count}{place}: {detail}")
    return (lines + [f"and {len(notes) - LISTED_NOTES} more"] * (len(notes) > LISTED_NOTES)) or ["none"]


def _number(value: float, digits: int = 4) -> str:
    text = f"{value:.{digits}g}"
    return f"{value:.0f}" if "e" in text and 1 <= abs(value) < 1e7 else text


def topic_lines(path: Path, *, fields: bool) -> list[Line]:
    """Return the content of a message log as pairs of label and text; empty if it cannot be read.

    ``fields``: whether to list the fields of messages of unknown types.
    """
    first: dict[int, bytes] = {}
    try:
        with open_reader(path) as reader:
            for rows in reader.rows():
                if rows.channel not in first:
                    first[rows.channel] = rows.payload(0)
    except (IngestError, OSError):
        with suppress(OSError), path.open("rb") as stream:
            kind = kind_of(stream.read(18)).partition(":")[0]
            return [("kind", f"{kind}, by its first bytes")] if kind else []
        return []
    size, proof = counted(reader.count, "message"), "integrity: not_verifiable, without checksums"
    if isinstance(reader, McapReader):
        library = f", written by {reader.header.library}" if reader.header and reader.header.library else ""
        proof = "every checksum and count verified" if reader.verified else proof
        container = f"{size} in {counted(len(reader.chunks), 'chunk')}{library}; {proof}"
    else:
        container = f"{MESSAGE_FORMATS[path.suffix.lower()].kind} with {size}; {proof}"
    lines = [("container", container)]
    if len(reader.channels) > MOST_TOPICS:
        return [*lines, ("topics", ", ".join(f"{c.topic} ({reader.counts[n]})" for n, c in reader.channels.items()))]
    for number, channel in reader.channels.items():
        schema = reader.schemas.get(channel.schema_id)
        kind = f"{schema.name}, {channel.message_encoding}" if schema else channel.message_encoding or "no encoding"
        text = f"{channel.topic} ({kind}): {counted(reader.counts[number], 'message')}"
        if fields and number in first and not (schema and short_name(schema.name) in KINDS):
            text += _fields(channel, schema, first[number])
        lines.append(("topic", text))
    return lines


def counted(number: int, what: str) -> str:
    """Return a number with its noun, in the plural except for 1."""
    return f"{number:,} {what}{'s'[: number != 1]}"


def _fields(channel: Channel, schema: Schema | None, payload: bytes) -> str:
    """Return the paths of the numbers in a message, for the fields of a profile."""
    try:
        find_layout, decode = ros_layouts(channel, schema), object_decoder(channel, schema)
        longest = LONGEST_ARRAY if schema is not None and schema.encoding == ARRAYS else LONGEST_LIST
        names = find_layout(payload).elements(longest) if find_layout else _numbers(decode and decode(payload), "")
        paths = list(islice(names, MAX_LISTED_FIELDS + 1))
    except Exception:  # noqa: BLE001  (a decoder may raise anything for an unknown message: nothing is listed)
        return ""
    more = " .." if len(paths) > MAX_LISTED_FIELDS else ""
    return f", with {', '.join(paths[:MAX_LISTED_FIELDS])}{more}" if paths else ""


def _numbers(value: Any, path: str) -> Iterator[str]:  # noqa: ANN401  (a message of any decoder)
    """Yield the paths of the numbers in a decoded message."""
    if isinstance(value, bool | str | bytes):
        return
    if hasattr(value, "__float__"):
        yield path
        return
    if hasattr(value, "DESCRIPTOR"):
        children = {f.name: getattr(value, f.name) for f in value.DESCRIPTOR.fields}
    elif isinstance(value, dict):
        children = value
    elif hasattr(value, "__len__"):
        for index in range(min(len(value), LONGEST_LIST)):
            yield from _numbers(value[index], f"{path}[{index}]")
        return
    else:
        children = getattr(value, "__dict__", {})
    for name, child in children.items():
        yield from _numbers(child, f"{path}.{name}" if path else name)


def proposed_sheet(folder: Path, settings: Settings) -> str:
    """Return the proposed sheet of a folder, with remarks; empty without a file."""
    sheet, remarks, found, rows = settings.procedure.sheet or "", list[str](), list[Recording](), list[str]()
    groups = _logs_in(folder, settings.ingest, sheet)
    for name, paths in groups.items():
        entry = RecordingFile(file=name, role="rests", axis=None, optional=False)
        try:
            checks = checks_of(settings.ingest)
            table = read_table(paths, settings.ingest)
            found.append(to_recording(name, entry, table, settings.sensor, checks))
        except IngestError as error:
            if "time" in error.message and error.code == "missing_column":
                with suppress(IngestError):
                    read_attitudes(paths[0], csv_formats(settings.ingest), settings.sensor, checks)
                    rows.append(f"{name},attitudes")
                    continue
            remarks.append(f"# {name} cannot be read: {error.message.splitlines()[0]}")
    still = [r for r in found if _is_still(r) and r.gyroscope is not None]
    bias = median(np.array([np.asarray(r.gyroscope).mean(axis=0) for r in still])) if still else NO_RATE
    rows += [_of_table(recording, bias, settings.table.sense) or _row(recording, bias) for recording in found]
    remarks += [f"# {r.name}: {SUITS_FERRARIS}" for r in found if suits_ferraris(r)]
    if wrong := _other_axes(found, bias):
        remarks.append(
            f"# gravity and turns agree with sensor.gyroscope.axis_map=[{', '.join(wrong)}], not the given one"
        )
    lines = ["file,kind,axis,angle_deg,angle_accuracy_deg,held_out", *sorted(rows), *remarks]
    return "\n".join(lines) if groups else ""


def has_rows(sheet: str) -> bool:
    """Return whether a proposed sheet has a row."""
    return any(not line.startswith("#") for line in sheet.splitlines()[1:])


def _logs_in(folder: Path, ingest: Ingest, sheet: str) -> dict[str, list[Path]]:
    """Return the logs of a folder by what a sheet calls them: a file, or the name that the parts of a log share."""
    patterns = [re.compile(re.escape(p["file"]).replace(re.escape(FILE), ".+")) for p in parts_of(ingest)]
    files = [f for f in sorted(folder.glob("*")) if f.is_file() and f.name != sheet]
    parts = [f for f in files if any(pattern.fullmatch(f.name) for pattern in patterns)]
    logs = {f.name: [f] for f in files if f.suffix.lower() in (*SUFFIXES, *TEXTS) and f not in parts}
    for group in grouped(parts, ingest):
        fixed = parts_of(ingest)[0]["file"]
        logs[group[0].name.removesuffix(fixed.replace(FILE, "")) or OF_PARTS] = group
    return logs


def _accepted(recording: Recording) -> list[Rest]:
    return [rest for rest in find_rests(recording) if rest.accepted]


def _is_still(recording: Recording) -> bool:
    """Return whether a recording is at rest in one attitude."""
    force, rate = recording.accelerometer, recording.gyroscope
    quiet = rate is not None and float(np.ptp(rate, axis=0).max()) < QUIET_DPS
    if force is None:
        total = np.trapezoid(np.asarray(rate) - median(np.asarray(rate)), recording.time, axis=0)
        return quiet and (_is_swept(recording) or bool(np.abs(total).max() < SAME_ATTITUDE_DEG))
    if _did_not_move(recording, _rests(recording)):
        return True
    drifts = quiet and _is_swept(recording)  # temperature moves the readings by more than a rest allows
    parts = np.array_split(force, SOAKED_PARTS) if drifts else [force[r.start : r.stop] for r in _accepted(recording)]
    u = [part.mean(axis=0) / np.linalg.norm(part.mean(axis=0)) for part in parts]
    apart = [np.degrees(np.linalg.norm(v - u[0])) for v in u]
    return sum(map(len, parts)) > RESTING_SHARE * recording.samples and max(apart) < SAME_ATTITUDE_DEG


def _is_swept(recording: Recording) -> bool:
    warm = recording.temperature
    return warm is not None and float(np.ptp(warm[np.isfinite(warm)])) >= SWEPT_DEGC


def _of_table(recording: Recording, bias: Values, sense: float) -> str:
    """Return the row of a recording with the log of a table that turns about a body axis; empty for others."""
    logged = recording.logged_rate
    if recording.gyroscope is None or logged is None:
        return ""
    along = sense * logged @ (recording.gyroscope - bias)
    axis = int(np.argmax(np.abs(along)))
    if not np.linalg.norm(np.delete(along, axis)) < MAX_AXIS_SINE * abs(along[axis]):
        return ""
    return f"{recording.name},table,{'-' if along[axis] < 0.0 else ''}{AXES[axis]}"


def _row(recording: Recording, bias: Values) -> str:
    """Return the row of a recording; ``bias``: of the gyroscope at rest in other recordings."""
    if _is_still(recording):
        return f"{recording.name},{'soak' if _is_swept(recording) else 'rest'}"
    force, rate = recording.accelerometer, recording.gyroscope
    if rate is None and force is not None and np.degrees(turn_between_rows(force)) > SAME_ATTITUDE_DEG:
        return f"{recording.name},attitudes"
    rests = [] if force is None else _accepted(recording)
    if rate is not None:
        own = np.mean([rate[r.start : r.stop].mean(axis=0) for r in rests], axis=0) if rests else bias
        angle = np.asarray(np.trapezoid(rate - own, recording.time, axis=0), np.float64)
        axis = int(np.argmax(np.abs(angle)))
        size, across = abs(float(angle[axis])), float(np.linalg.norm(np.delete(angle, axis)))
        turned = np.abs(np.trapezoid(np.linalg.norm(rate - own, axis=1), recording.time))
        if size > MIN_PROPOSED_TURN_DEG and across < MAX_AXIS_SINE * size and turned < 2.0 * size:
            name = f"{'-' if angle[axis] < 0.0 else ''}{AXES[axis]}"
            whole = 360.0 * round(size / 360.0)
            stated = "" if whole and abs(size - whole) < WHOLE * whole else f"{ROUND_DEG * round(size / ROUND_DEG):g}"
            return f"{recording.name},turn,{name},{stated}"
    return f"{recording.name},{'moves' if len(rests) > 2 else 'slow'}"


def _other_axes(recordings: Sequence[Recording], bias: Values) -> list[str]:
    """Return the map of the gyroscope's axes that agrees with gravity, if the given one does not; else empty."""
    pairs = []
    for r in recordings:
        if r.accelerometer is None or r.gyroscope is None or NOISE_OF_ROWS in r.source or r.samples < 100:
            continue
        size = max(1, round(SMOOTHED_S / r.interval))
        count = r.samples // size
        force, rate = (v[: count * size].reshape(count, size, 3).mean(axis=1) for v in (r.accelerometer, r.gyroscope))
        u = force / np.linalg.norm(force, axis=1, keepdims=True)
        middle = 0.5 * (u[2:] + u[:-2])
        pairs.append(((u[2:] - u[:-2]) / (2.0 * size * r.interval), np.radians(rate[1:-1] - bias), middle))
    if not pairs:
        return []
    change, omega, u = (np.concatenate(parts) for parts in zip(*pairs, strict=True))

    def misfit(P: Values) -> float:
        return float(np.sum((change + np.cross(omega @ P.T, u)) ** 2))

    nearest = min(signed_permutations(), key=misfit)
    clearer = misfit(nearest) <= CLEARER * misfit(np.eye(3))
    return [nearest_axis(column) for column in nearest.T] if clearer else []
