"""Read all recordings of one unit: find and read files, check them, rotate to body axes, and compare the clocks.

Times of a unit count from power-on. If the times of two files overlap, they are not of one clock (each file starts at
0), and the time between the recordings is unknown; likewise if some count from 1970 and others from power-on. Times
since 1970 are converted to times since the first sample, because a double resolves 1.7*10^9 s to 2*10^-7 s only, too
coarse to differentiate.

A file of attitudes has one row an attitude, or a block of rows with equal ``label``; times do not count. The rows
get times of their own, so that blocks are ``BETWEEN_ATTITUDES_S`` apart. A row that is an attitude by itself is a mean
over an unknown time. Its white noise is that of the sensor file over ``AVERAGED_S``; the scatter of the attitudes about
the fit adds to it.
"""

from __future__ import annotations

import csv
import glob
import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

import imu_logs
from imu_logs.files import is_message_log
from imu_logs.log import Log
from imu_logs.profile import TIME, Checks, CsvFormat, checks_of, csv_formats
from imu_logs.units import ATTITUDE, SCALARS, SINCE_1970_NS, TABLE_CHANNELS, TABLE_TIME, TRIADS
from pipeline.core.errors import IngestError, InputError, MissingInputError, shortened
from pipeline.core.records import (
    BETWEEN_ATTITUDES_S,
    NOISE_OF_ROWS,
    SENSORS,
    STRAIGHT,
    Integers,
    Mask,
    Note,
    Recording,
    Values,
    axis_maps,
    axis_matrix,
    files_of_readings,
    in_body_axes,
    map_of_orientation,
    rate_of_attitude,
)
from pipeline.core.settings import Ingest, Procedure, RecordingFile, Sensor
from pipeline.ingest.clock_alignment import align, follow_program, own_rows, unwrapped
from pipeline.ingest.disturbances import leave_out_disturbances, leave_out_shaken_rests
from pipeline.ingest.files import candidate_files
from pipeline.ingest.quality_flags import examine, without_gaps
from pipeline.ingest.recordings_sheet import require_recordings

MAX_NAMED_FILES = 5  # further files that an error lists
LEAST_TURN_OF_ROWS = 0.01  # rad: rows of attitudes differ by more, samples of a rest or of movement by less
IN_MEMORY = "(DataFrame)"  # after the name of a recording that has no file
LABEL = "label"
AVERAGED_S = 1.0  # shorter than anyone averages by hand: the noise is then rather too large
BETWEEN_ROWS_S = 1.0  # between the rows of a block


def read_recordings(
    procedure: Procedure,
    ingest: Ingest,
    sensor: Sensor,
    folder: Path,
    in_memory: Mapping[str, bytes] = MappingProxyType({}),
) -> list[Recording]:
    """Read all existing recordings of a unit, in the order of the procedure.

    ``in_memory``: canonical CSV by the name of its recording, read in place of files. Raises ``MissingInputError`` if
    files that are not optional do not exist, ``InputError`` if files cannot be used; one error lists all such files.
    """
    require_recordings(procedure, folder)
    checks, layouts = checks_of(ingest), csv_formats(ingest) if ingest.csv else None
    found, missing, left_out = set[str](), list[str](), list[str]()
    recordings: list[Recording] = []
    refused: list[InputError] = []
    for name, candidates in candidate_files(procedure, ingest).items():
        entry = procedure.recordings[name]
        files, wanted, unread = _existing(candidates, folder) if name not in in_memory else ([name], [name], [])
        if not files:
            other = _of_other_suffix(name, entry, folder)
            missing += [] if entry.optional else [f"{name} (tried {tried(candidates)}){other}"]
            left_out += [f"no {name}{other}"] if entry.optional and other else []
            continue
        found.add(name)
        if files != wanted:
            missing += [f"{name} ({file})" for file in wanted if file not in files]
            continue
        timeless = entry.kind == "attitudes"  # its rows have times of their own, which miss nothing
        try:
            if name in in_memory:
                table = imu_logs.read_canonical(f"{name} {IN_MEMORY}", in_memory[name], ingest)
            else:
                paths = [folder / f for f in files]
                table = (
                    read_attitudes(paths[0], layouts or (), sensor, checks)
                    if timeless
                    else read_table(paths, ingest, layouts, entry.session)
                )
            allowed = checks.model_copy(update={"missing_time": 1.0}) if timeless else checks
            recording = to_recording(name, entry, table, sensor, allowed)
            recording = without_gaps(recording) if timeless else recording
        except IngestError as error:
            refused.append(error)
            continue
        if unread:
            detail = f"{', '.join(unread)} exists too and was not read"
            recording = recording.noted(Note("N-NOTREAD", len(unread), 0, 0, detail))
        recordings.append(recording)
    if missing:
        reason = "" if found else _in_its_place(folder)
        message = f"missing recordings: {'; '.join(missing)}{reason}{of_one_sensor(procedure, found)}"
        refused.insert(0, MissingInputError(message, str(folder)))
    if refused:
        raise _together(refused)
    if left_out and recordings:
        recordings[0] = recordings[0].noted(Note("N-NOTREAD", len(left_out), 0, 0, "; ".join(left_out)))
    _check_different(recordings)
    return _compare_clocks(recordings)


def _together(refused: Sequence[InputError]) -> InputError:
    """Return the first of several errors, which names the files of the others."""
    first, *others = refused
    if others:
        listed = [f"{error.file} ({error.code})" for error in others]
        first.message += f". Also refused: {'; '.join(listed[:MAX_NAMED_FILES])}"
        first.message += f" and {len(others) - MAX_NAMED_FILES} more" if len(others) > MAX_NAMED_FILES else ""
    return first


def read_table(
    paths: Sequence[Path], ingest: Ingest, layouts: Sequence[CsvFormat] | None = None, session: int | None = None
) -> Log:
    """Read the file or files of one recording, by their suffix; ``layouts`` are ``csv_formats(ingest)``.

    ``session``: which part, from 1, of a text log that was restarted.
    """
    table = imu_logs.read(paths, ingest, session=session, layouts=layouts)
    if not table.apart and TABLE_TIME not in table.values:
        return table
    for log in table.apart or (own_rows(table),):
        table = align(table, log)
    return replace(table, apart=())


def _existing(candidates: Sequence[Sequence[str]], folder: Path) -> tuple[list[str], list[str], list[str]]:
    """Return the files of the first candidate of which any exists, all files of it, and further existing files."""
    here = str(folder)
    present = [[f for f in c if os.path.exists(os.path.join(here, f))] for c in candidates]  # noqa: PTH110, PTH118
    files, wanted = next(((f, list(c)) for f, c in zip(present, candidates, strict=True) if f), ([], []))
    return files, wanted, [f for existing in present for f in existing if f not in files]


def _of_other_suffix(name: str, entry: RecordingFile, folder: Path) -> str:
    """Return what names a file of a recording that has another suffix; empty for none."""
    others = sorted(f.name for f in folder.glob(f"{glob.escape(entry.file)}.*") if f.is_file())
    if not others:
        return ""
    return f": {', '.join(others)} lies there; rename it, or set procedure.recordings.{name}.file={others[0]}"


def _in_its_place(folder: Path) -> str:
    """Return what a folder holds that no recording was read from, and what reads it."""
    if not folder.is_dir():
        return "; the folder does not exist"
    names = sorted(f.name for f in folder.iterdir() if f.is_file() and not f.name.startswith("."))
    if not names:
        return "; the folder is empty"
    held = ", ".join(shortened(names, MAX_NAMED_FILES))
    return f"; the folder holds {held}: python -m pipeline check proposes a profile"


def tried(candidates: Sequence[Sequence[str]]) -> str:
    """List the possible file names of a recording; names that differ in the suffix only are shortened to it."""
    stems: set[str] = set()
    texts = []
    for names in candidates:
        stem, _, suffix = names[0].rpartition(".")
        texts.append(f".{suffix}" if len(names) == 1 and stem in stems else " with ".join(names))
        stems.add(stem)
    return ", ".join(texts)


def of_one_sensor(procedure: Procedure, files: Collection[str]) -> str:
    """Return advice for a unit with one sensor, if all recordings of one sensor are missing; else empty."""
    entries = procedure.recordings.items()
    there = {sensor: [n in files for n, e in entries if e.role == sensor] for sensor in TRIADS}
    lacking = [sensor for sensor, found in there.items() if found and not any(found)]
    others = any(any(found) for found in there.values())
    return f"; of a unit without {lacking[0]}, set method.{lacking[0]}=null" if len(lacking) == 1 and others else ""


def to_recording(name: str, entry: RecordingFile, table: Log, sensor: Sensor | None, checks: Checks) -> Recording:
    """Convert a table of channels to a recording in body axes, with quality flags; removes the channels from ``table``.

    ``entry``: of the procedure, with the ``program`` of a table without a log. ``sensor``: None if it is not known.
    """
    if entry.program and not set(TABLE_CHANNELS) & table.values.keys():
        table = follow_program(table, entry.program)
    table = unwrapped(table)
    flags, notes = examine(table, sensor, checks)
    maps, values = axis_maps(sensor), table.values
    stated = table.source.get("gcsv", {}).get("orientation", "XYZ")
    if stated != "XYZ":
        if other := [m for m in maps.values() if m != STRAIGHT]:
            message = f"the file states its orientation ({stated}) and sensor.axis_map is [{', '.join(other[0])}]"
            hint = "one of them has to go: write orientation,XYZ in the file, or set sensor.axis_map=[+x,+y,+z]"
            raise IngestError(message, table.path, code="gcsv", hint=hint)
        maps = dict.fromkeys(TRIADS, map_of_orientation(stated))
    turned = {s: axis_matrix(m) for s, m in maps.items() if m != STRAIGHT and TRIADS[s][0] in values}
    left_handed = [s for s, matrix in turned.items() if np.linalg.det(matrix) < 0]
    if left_handed:  # not a rotation: some sensors have left-handed axes, so that the map is used
        detail = ", ".join(f"[{', '.join(maps[s])}] of the {s}" for s in left_handed)
        notes.insert(0, Note("N-LEFTHANDED", len(left_handed), 0, 0, f"left-handed axis map: {detail}"))
    channels: dict[str, Any] = {}
    for which, triad in TRIADS.items():
        stacked = _stack(values, triad)
        if stacked is not None:
            channels[which] = in_body_axes(maps[which], stacked)
            continue
        detail = f"the file has no column that the profile assigns to the {which}: it cannot calibrate this sensor"
        notes.append(Note("N-ABSENT", len(table.time_ns), 0, 0, detail))
    # copies, which do not keep the other columns of the file in memory
    channels |= {channel: values[channel].copy() for channel in SCALARS if channel in values}
    recording = Recording(
        name=name,
        role=entry.role,
        axis=entry.axis,
        setup=entry.setup or "",
        kind=entry.kind or "",
        time_ns=table.time_ns,
        table_attitude=_stack(values, ATTITUDE),
        flags=flags,
        source=table.source,
        notes=(*table.notes, *notes),
        **channels,
    )
    if recording.axis is None and recording.table_attitude is not None and recording.table_rate is None:
        rate = rate_of_attitude(recording.time * recording.table_seconds, recording.table_attitude)
        recording = replace(recording, table_rate=rate)
    if checks.disturbed_rows:
        recording = leave_out_shaken_rests(recording, table.note)
    return leave_out_disturbances(recording, table.note, checks.disturbed_rows)


def _stack(values: dict[str, Values], channels: Sequence[str]) -> Values | None:
    return np.column_stack([values.pop(c) for c in channels]) if channels[0] in values else None


def _check_different(recordings: Sequence[Recording]) -> None:
    """Raise ``IngestError`` for one file under two names: held-out data would not be held out, or an axis be wrong.

    The parts of a restarted log differ in their ``session``. Recordings may share the log of a table.
    """
    seen: dict[tuple[str, int | None], tuple[str, str]] = {}
    for recording in recordings:
        for file in files_of_readings(recording.source):
            key = file["sha256"], recording.source.get("session")
            twin, first = seen.setdefault(key, (recording.name, file["file"]))
            if twin != recording.name:
                message = f"recordings {twin} and {recording.name} are the same file, byte for byte ({first});"
                message += " each needs its own"
                raise IngestError(message, file["file"], code="same_file")


def _compare_clocks(recordings: list[Recording]) -> list[Recording]:
    """Convert times since 1970 to times since the first sample, and set whether the recordings share a clock."""
    since_1970 = [r for r in recordings if r.time_ns[0] > SINCE_1970_NS]
    if since_1970:
        origin = min(int(r.time_ns[0]) for r in since_1970)
        all_of_unit = len(since_1970) == len(recordings)
        first = "the unit's first sample" if all_of_unit else "the first sample since 1970 (other files: another clock)"
        detail = f"times count from {first}, {origin} ns in the clock of the files"
        note = Note("N-EPOCH", len(since_1970), 0, 0, detail)
        moved = {r.name: replace(r.noted(note), time_ns=r.time_ns - origin) for r in since_1970}
        recordings = [moved.get(r.name, r) for r in recordings]
    spans = sorted((int(r.time_ns[0]), int(r.time_ns[-1])) for r in recordings)
    overlap = any(start <= end for (_, end), (start, _) in pairwise(spans))
    apart = overlap or 0 < len(since_1970) < len(recordings)
    return [replace(r, clock_shared=False) for r in recordings] if apart else recordings


def read_attitudes(path: Path, layouts: Sequence[CsvFormat], sensor: Sensor, checks: Checks) -> Log:
    """Read the channels of a file of attitudes; raises ``IngestError`` for a log that is no text."""
    if is_message_log(path) or len(layouts) != 1:
        raise IngestError("attitudes are read from one text log; export them as text", str(path), code="foreign")
    columns = tuple(c for c in layouts[0].columns if c.channel != TIME)
    from imu_logs.text_read import read_csv  # noqa: PLC0415  (pyarrow, for tables of means)

    layout = layouts[0].model_copy(update={"columns": columns, "rate_hz": 1.0 / BETWEEN_ROWS_S})
    table = read_csv([path], [layout], checks)
    assert table.lines is not None  # noqa: S101  (of text)
    starts = _starts(path, layouts[0], table.lines)
    number = np.cumsum(starts) - 1
    time = np.arange(len(starts)) * BETWEEN_ROWS_S + number * BETWEEN_ATTITUDES_S
    unused = f"columns not used: {LABEL}"  # which separates the attitudes
    notes = tuple(note for note in table.notes if note.code != "N-SYNTHTIME" and note.detail != unused)
    table = replace(table, time_ns=np.rint(time * 1e9).astype(np.int64), notes=notes)
    if not starts.all():
        return table
    if all(channel in table.values for channel in TRIADS["accelerometer"]):
        turned = turn_between_rows(np.column_stack([table.values[channel] for channel in TRIADS["accelerometer"]]))
        if turned < LEAST_TURN_OF_ROWS:
            message = (
                f"kind attitudes takes each row as another attitude, but gravity turns by "
                f"{np.degrees(turned):.2g} deg (median) from row to row: state in recordings.csv that it is "
                f"rest, moves or slow, or add a column {LABEL} with one text for all samples of an attitude"
            )
            raise IngestError(message, str(path), code="sheet")
    noise = {name: sensor.of(name).white(AVERAGED_S) for name in SENSORS}
    return replace(table, source={**table.source, NOISE_OF_ROWS: noise})


def turn_between_rows(force: Values) -> float:
    """Return the median angle, rad, between successive directions of (n, 3) readings; NaN for one row."""
    u = force / np.linalg.norm(force, axis=1, keepdims=True)
    return float(np.median(np.linalg.norm(np.diff(u, axis=0), axis=1))) if len(u) > 1 else float("nan")


def _starts(path: Path, layout: CsvFormat, lines: Integers) -> Mask:
    """Return at which rows an attitude begins: (n,) array of bool; every row without a column of labels."""
    with path.open(encoding="utf-8-sig", newline="") as stream:
        delimiter = layout.delimiter if len(layout.delimiter) == 1 else ","
        cells = list(csv.reader(stream, delimiter=delimiter))
    names = next(([cell.strip() for cell in row] for row in cells if LABEL in [cell.strip() for cell in row]), None)
    if names is None:
        return np.ones(len(lines), bool)
    labels = [cells[line - 1][names.index(LABEL)].strip() for line in lines.tolist()]
    return np.array([True, *(one != two for one, two in pairwise(labels))])
