"""Propose a profile for unknown logs, with the evidence for each guess; it is never applied without a request.

Channels follow from the names of columns. Units follow from names, else from ``guesses.Evidence``. Two files with
equal times, one with the accelerometer and one with the gyroscope, are parts of one recording. An entry that one file
does not determine is taken from another file of the same layout. The profile is
written as YAML, with the evidence for each line and the columns that it does not use.
"""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from imu_logs.clocks import find_bursts
from imu_logs.columns import (
    TEMPERATURE_RANGE,
    Columns,
    UnknownLog,
    find_columns,
    find_layout,
    is_gravity,
    sensor_of,
    stated_unit,
    whole,
    words_of,
)
from imu_logs.errors import IngestError
from imu_logs.files import ZIP, is_message_log, member, refuse_foreign, text_members, unchanged
from imu_logs.guesses import (
    CENTIDEGREES,
    LARGEST_LINEAR,
    OF_SENSOR,
    TO_DECIDE,
    Evidence,
    Guess,
    even_steps,
    temperature_counts,
    time_unit,
    unit_of_turn,
)
from imu_logs.log import Values
from imu_logs.profile import AUTO, Profile
from imu_logs.text_read import SHORTEST_PART
from imu_logs.units import COUNTS, FORCE_UNITS, GYROSCOPE, TABLE_CHANNELS, TRIADS, UNITS

UNITS_OF = {"accelerometer": ("g", "mg", "ug", "m/s^2", "mm/s^2"), "gyroscope": ("deg/s", "mdps", "rad/s", "mrad/s")}
LEAST_GRAVITY = 0.3  # of gravity, for the median |a| of a log that holds gravity
MOST_NAMED = 6  # columns in a remark
FEWEST_LABELS, MOST_LABELS = 3, 4  # two texts may be states of the logger; labels that a remark names
SAME_UNIT = 0.2  # relative: a low-cost sensor in few positions, and moves by hand
CLOCK = re.compile(r"\b(\d{1,2}):(\d\d):(\d\d(?:\.\d+)?)")
SEARCHED_BYTES = 1 << 25  # of a text log, for its layout
# Topics of autopilots (PX4 uORB, ArduPilot log messages) to the shipped profiles.
SHIPPED = {
    "sensor_combined": "px4_ulog", "sensor_accel": "px4_raw", "sensor_gyro": "px4_raw", "IMU": "ardupilot",
}  # fmt: skip
Entries = dict[str, dict[str, Any]]
WIDTH = 116  # of comments in a proposed profile
WORD = re.compile(r"[A-Za-z_][\w.-]*(/[\w^]+)?")


@dataclass
class Proposal:
    """A proposed profile; ``???`` marks a value that the user must fill in."""

    files: list[str]  # of the recordings, or of the parts of one recording
    logs: list[UnknownLog]
    csv: dict[str, Any]  # the section ``csv`` without columns
    columns: list[Entries]  # for each part, channel to its entry
    evidence: dict[str, str]  # by key of ``csv``, ``time``, sensor or channel
    seen: list[dict[str | int, str]]  # for each part, column to a description of its content
    remarks: list[str] = field(default_factory=list)  # open decisions and irregularities

    @property
    def parts(self) -> list[str]:
        """Names of the files of the parts; empty if a recording is one file."""
        return [Path(log.path).name for log in self.logs] if len(self.logs) > 1 else []

    @property
    def topic(self) -> str | None:
        """The topic of a message log; None for a text log."""
        return self.logs[0].topic

    @property
    def complete(self) -> bool:
        """Whether it has a sensor and no value to fill in."""
        return bool(self.sensors()) and not self.unknown()

    def text(self, name: str = "my_logger") -> str:
        """Return the profile as YAML that Hydra reads, with the evidence for each line."""
        files = ", ".join(Path(f).name for f in self.files)
        lines = _comment(f"Proposed by python -m pipeline check for {files}. Check each line: no line is certain.")
        for remark in self.remarks:
            lines += _comment(f"To decide: {remark}.")
        topics, shown = self.topic is not None, self.csv
        if topics:
            lines += ["defaults:", "  - canonical_csv", "  - _self_", ""]
            shown = {key: shown[key] for key in ("rate_hz",) if shown[key] is not None}
        lines += [f"name: {_scalar(name)} # name of the profile, for the report", ""]
        lines += ["mcap: # logs of messages of every format" if topics else "csv:"]
        for key, value in shown.items():
            if key in self.evidence:
                lines += _comment(self.evidence[key], "  ")
            lines.append(f"  {key}: {_scalar(value)}")
        if not self.parts:
            what = "topics:" if topics else "columns: # channel: the column's name (or index from 0) and its unit"
            return "\n".join([*lines, f"  {what}", *_entries(self, 0, "    ")]) + "\n"
        lines += [] if topics else ["  columns: {} # described by part"]
        lines += ["  parts: # files of one recording, joined on equal time"]
        for part, file in enumerate(self.parts):
            lines += [f"    - file: {_scalar(file)}", f"      {'topics' if topics else 'columns'}:"]
            lines += _entries(self, part, "        ")
        return "\n".join(lines) + "\n"

    def sensors(self) -> set[str]:
        """Return the sensors whose three axes it has."""
        return {s for s, triad in TRIADS.items() if set(triad) <= {c for entries in self.columns for c in entries}}

    def unknown(self) -> list[str]:
        """Return the keys and channels with a value to fill in."""
        keys = [k for k, v in self.csv.items() if v == TO_DECIDE]
        return keys + [c for entries in self.columns for c, e in entries.items() if TO_DECIDE in e.values()]

    def profile(self, name: str, counts_per_unit: Mapping[str, float] = MappingProxyType({})) -> Profile:
        """Return the proposal as a profile; ``counts_per_unit``: of each sensor, where it refers to them."""
        return Profile.model_validate(self.sections(name, counts_per_unit))

    def sections(self, name: str, counts_per_unit: Mapping[str, float]) -> dict[str, Any]:
        """Return the sections of the profile."""
        figures: dict[Any, Any] = {OF_SENSOR.format(s): counts for s, counts in counts_per_unit.items()}
        columns = [
            {c: {k: figures.get(v, v) for k, v in entry.items()} for c, entry in entries.items()}
            for entries in self.columns
        ]
        if self.topic is not None:
            topics = [{log.topic: fields_of(entries)} for log, entries in zip(self.logs, columns, strict=True)]
            parts = [{"file": f, "topics": topic} for f, topic in zip(self.parts, topics, strict=False)]
            return {
                "name": name,
                "csv": {},
                "mcap": {"rate_hz": self.csv["rate_hz"], **({"parts": parts} if parts else {"topics": topics[0]})},
            }
        if not self.parts:
            return {"name": name, "csv": {**self.csv, "columns": columns[0]}, "mcap": {}}
        parts = [{"file": f, "columns": c} for f, c in zip(self.parts, columns, strict=True)]
        return {"name": name, "csv": {**self.csv, "parts": parts, "columns": {}}, "mcap": {}}


def layouts_of(path: Path) -> list[UnknownLog]:
    """Return the columns of a text log, of each log with readings in a zip file, or of the topic with most sensors.

    Raises ``IngestError`` for a file without a table of numbers.
    """
    with unchanged(path):
        if is_message_log(path):
            from imu_logs.message_read import topics_of  # noqa: PLC0415  (only where it is needed)

            return topics_of(path)[:1]  # the one with most sensors
        if path.suffix.lower() == ZIP:
            tables = [layout for file in text_members(path) for layout in _table_in(path, file)]
            found = [layout for layout in tables if find_columns(layout).triads]
            if not found:
                raise IngestError("no text log in it holds the three axes of a sensor", str(path), code="no_table")
            return found
        with path.open("rb") as stream:
            data = stream.read(SEARCHED_BYTES)
        refuse_foreign(data[:18], str(path))
        return [find_layout(data, str(path))]


def _table_in(archive: Path, file: Path) -> list[UnknownLog]:
    """Return the columns of a text log in a zip file; none for a text without a table of numbers."""
    try:
        return [find_layout(member(archive, file.name)[:SEARCHED_BYTES], str(file))]
    except IngestError:
        return []


def propose(logs: Sequence[UnknownLog], evidence: Evidence) -> list[Proposal]:
    """Return a proposal for each layout among the logs; ``evidence`` decides the units that names do not state."""
    recordings: list[list[Columns]] = []  # each of one file, or of two files with equal times and one sensor each
    for columns in sorted(map(find_columns, logs), key=_is_linear):  # a gyroscope belongs to the file with gravity
        other = next((parts for parts in recordings if len(parts) == 1 and _belong_together(parts[0], columns)), None)
        if other is None:
            recordings.append([columns])
        else:
            other.append(columns)
    proposals: list[Proposal] = []
    for parts in recordings:
        new = _proposal(parts, evidence)
        twin = next((p for p in proposals if _alike(p, new)), None)
        if twin is None:
            proposals.append(new)
        else:
            _fill_in(twin, new)
    return proposals


def _is_linear(columns: Columns) -> bool:
    """Return whether the accelerometer's readings, which are no counts, are smaller than gravity in each unit."""
    triad = columns.triads.get("accelerometer")
    if triad is None or whole(np.array([columns.log.numbers[i] for i in triad])):
        return False
    return not is_gravity(columns.log, triad)


def _belong_together(one: Columns, two: Columns) -> bool:
    if len(one.triads) != 1 or len(two.triads) != 1 or set(one.triads) == set(two.triads):
        return False
    if one.log.csv | {"rate_hz": None} != two.log.csv | {"rate_hz": None} or one.time is None or two.time is None:
        return False
    return np.array_equal(one.log.numbers[one.time], two.log.numbers[two.time])


def _alike(one: Proposal, two: Proposal) -> bool:
    """Return whether one profile can read both: equal names, or different names only for optional channels."""
    if one.parts or two.parts or one.sensors() != two.sensors():
        return False
    if [log.names for log in one.logs] == [log.names for log in two.logs] and one.csv == two.csv:
        return True
    if one.csv["header"] is not True or one.csv | {"delimiter": None} != two.csv | {"delimiter": None}:
        return False
    first, second = one.columns[0], two.columns[0]
    shared = first.keys() & second.keys()
    other = [entry for c, entry in {**first, **second}.items() if c not in shared]
    return all(first[c]["column"] == second[c]["column"] for c in shared) and all(e.get("optional") for e in other)


def _fill_in(proposal: Proposal, other: Proposal) -> None:
    """Add entries from another file of the same layout that this file does not determine or contain."""
    proposal.files += other.files
    if proposal.csv.get("delimiter") != other.csv.get("delimiter"):
        proposal.csv["delimiter"] = AUTO
        proposal.evidence["delimiter"] = "the files differ: by the header of each"
    proposal.seen[0] = other.seen[0] | proposal.seen[0]
    for channel in other.columns[0].keys() - proposal.columns[0].keys():
        proposal.columns[0][channel] = other.columns[0][channel]
        proposal.evidence[channel] = f"{other.evidence.get(channel, '')} ({Path(other.files[0]).name})"
    for channel, entry in proposal.columns[0].items():
        better = other.columns[0].get(channel, entry)
        by_turns = channel == "table_angle" and (better["unit"], entry["unit"]) == (COUNTS, "deg")
        if (TO_DECIDE in entry.values() and TO_DECIDE not in better.values()) or by_turns:
            proposal.columns[0][channel] = better
            key = next((s for s, triad in TRIADS.items() if channel in triad), channel)
            proposal.evidence[key] = f"{other.evidence[key]} ({Path(other.files[0]).name})"
        elif channel == "table_angle" and better != entry and better["unit"] == COUNTS:
            proposal.remarks.append(f"{Path(other.files[0]).name} differs: {other.evidence[channel]}")
    proposal.remarks += [r for r in other.remarks if r not in proposal.remarks]


def _proposal(parts: list[Columns], evidence: Evidence) -> Proposal:
    logs = [columns.log for columns in parts]
    seen = [
        {key: f"{name}: " * (log.named and isinstance(key, int)) + _described(log.numbers.get(i))
         for i, (key, name) in enumerate(zip(log.keys, log.names, strict=True))}
        for log in logs
    ]  # fmt: skip
    first = logs[0]
    proposal = Proposal([log.path for log in logs], logs, {**first.csv}, [{} for _ in parts], {**first.evidence}, seen)
    time_s = _time(parts, proposal)
    force = _readings("accelerometer", parts)
    if force is not None:
        guess = evidence.force_unit(force, time_s)
        if any(p.guessed for p in parts) and guess.entry["unit"] in ("mg", "ug", "mm/s^2"):
            guess = replace(guess, entry={"unit": TO_DECIDE}, evidence=f"{guess.evidence} if it is a specific force")
        _add("accelerometer", parts, proposal, guess)
        proposal.remarks += evidence.remarks(guess)
        force = force - guess.centre
    evidence.find_encoder(parts, force, None, time_s)
    rate = _readings("gyroscope", parts)
    if rate is not None:
        _add("gyroscope", parts, proposal, evidence.rate_unit(parts, force, rate, time_s))
        evidence.find_encoder(parts, None, _in_dps(rate, proposal), time_s)
    for columns, entries in zip(parts, proposal.columns, strict=True):
        _others(columns, entries, proposal, evidence.sensor)
        proposal.remarks += columns.remarks
        proposal.remarks += columns.log.remarks + _labels(columns.log) + _other_forms(columns)
    if shipped := SHIPPED.get((first.topic or "").partition("[")[0]):
        proposal.remarks.append(f"the profile {shipped} is shipped and reads such logs: name it instead")
    if force is not None or rate is not None:
        return proposal
    proposal.remarks.append("no three columns have the names or values of an accelerometer or a gyroscope")
    if proposal.topic is None and "table_rate" not in proposal.columns[0]:  # lines of both sensors to fill in
        for name, triad in TRIADS.items():
            proposal.columns[0] |= {c: {"column": TO_DECIDE, "unit": TO_DECIDE} for c in triad}
            proposal.evidence[name] = (
                f"the names of the {name}'s columns, and their unit: {', '.join(UNITS_OF[name])}, or counts with "
                f'counts_per_unit: "{OF_SENSOR.format(name)}"; leave the three lines out if it is not in the log'
            )
    return proposal


def _other_forms(columns: Columns) -> list[str]:
    """Return remarks on readings that a log holds in another form: as a sum, or in rows of several kinds."""
    log, remarks = columns.log, list[str]()
    if "accelerometer" not in columns.triads and {"user", "gravity"} <= {w for n in log.names for w in words_of(n)}:
        remarks.append("the specific force is the sum of gravity and user acceleration: add its three columns")
    partly = [log.names[i] for i in log.texts if sensor_of(words_of(log.names[i])) not in ("", "?")]
    if partly and not columns.triads:
        named = ", ".join(partly[:MOST_NAMED])
        remarks.append(f"{named} hold no number in some rows: write a file for each kind of row")
    return remarks


def _labels(log: UnknownLog) -> list[str]:
    """Return remarks on columns whose text names a part of the recording: each text fills rows one after the other."""
    found = []
    for index, texts in log.texts.items():
        labels = [label for label, _ in groupby(texts)]
        if FEWEST_LABELS <= len(labels) == len(set(labels)) and len(texts) >= SHORTEST_PART * len(labels):
            named = ", ".join(labels[:MOST_LABELS]) + " .." * (len(labels) > MOST_LABELS)
            found.append(
                f"column {log.names[index].removeprefix('column ')} labels {len(labels)} parts ({named}), which may "
                "not follow each other in time: give each rest and turn as a window or a separate file, see "
                "docs/record.md#parts"
            )
    return found


def _described(values: Values | None) -> str:
    if values is None:
        return "not all of it is numbers"
    low, high = float(values.min()), float(values.max())
    kind = "whole numbers " if whole(values) else ""
    even = ", grows evenly with the rows" if even_steps(values) else ""
    return f"{kind}{low:.6g} to {high:.6g}{even}" if high > low else f"{low:.6g} throughout"


def _time(parts: list[Columns], proposal: Proposal) -> Values | None:
    """Propose the source of the time, and return the time in s; None if it is unknown."""
    first = parts[0].log
    if parts[0].arrival is not None and parts[0].counter is not None:
        return _counted(parts[0], parts[0].counter, proposal)
    if parts[0].time is not None:
        values, name = first.numbers[parts[0].time], first.names[parts[0].time]
        guess = time_unit(values, *stated_unit(name, "time"))
        if "ticks" in words_of(name):
            text = f"{name}: counts_per_unit is the number of ticks per second"
            guess = Guess({"unit": COUNTS, "counts_per_unit": TO_DECIDE}, text)
        proposal.csv["rate_hz"] = None
        proposal.evidence.pop("rate_hz", None)
        proposal.evidence["time"] = guess.evidence
        for columns, entries in zip(parts, proposal.columns, strict=True):
            assert columns.time is not None  # noqa: S101  (parts are joined by their times)
            entries["time"] = {"column": columns.log.keys[columns.time], **guess.entry}
        return None if guess.second_s is None else _regular(values * guess.second_s, parts)
    if parts[0].counter is not None and first.csv["rate_hz"] is None:
        return _counted(parts[0], parts[0].counter, proposal)
    if first.csv["rate_hz"] is not None:
        return np.arange(len(next(iter(first.numbers.values())))) / float(first.csv["rate_hz"])
    proposal.csv["rate_hz"] = TO_DECIDE
    proposal.evidence["rate_hz"] = f"there is no time: the sampling rate in Hz{_rate_by_a_text(first)}"
    return None


def _rate_by_a_text(log: UnknownLog) -> str:
    """Return the mean rate by a column of times of day, which are no numbers; empty for none."""
    for index, texts in log.texts.items():
        matches = [CLOCK.search(text) for text in (texts[0], texts[-1])]
        first, last = (sum(float(n) * s for n, s in zip(m.groups(), (3600, 60, 1), strict=True)) if m else 0.0
                       for m in matches)  # fmt: skip
        if last > first and all(matches):
            rate = (len(texts) - 1) / (last - first)
            name, span = log.names[index], f"{len(texts)} rows in {last - first:.5g} s"
            return f"; {name} is no number: {span}, {rate:.4g} Hz on average"
    return ""


def _regular(time_s: Values, parts: list[Columns]) -> Values:
    """Return times, s; of samples that arrive in bursts those by their regular clock, as ingest reads them."""
    readings = {
        c: p.log.numbers[i]
        for p in parts
        for s, triad in p.triads.items()
        for c, i in zip(TRIADS[s], triad, strict=True)
    }
    bursts = find_bursts(np.rint((time_s - time_s[0]) * 1e9).astype(np.int64), readings)
    return time_s if bursts is None or bursts.times is None else bursts.times / 1e9


def _counted(columns: Columns, counter: int, proposal: Proposal) -> Values | None:
    """Propose a counter of samples as time, with the mean rate from the times of arrival."""
    log, rate = columns.log, None
    key, count = log.keys[counter], log.numbers[counter]
    evidence = f"{key} counts samples: counts_per_unit is the sampling rate in Hz"
    if columns.arrival is not None:
        arrival, name = log.numbers[columns.arrival], log.names[columns.arrival]
        second = time_unit(arrival, *stated_unit(name, "time")).second_s
        if second is not None:
            rate = float(f"{(count[-1] - count[0]) / ((arrival[-1] - arrival[0]) * second):.6g}")
        stated = "the sampling rate in Hz" if rate is None else f"{rate:g} Hz on average by {name}"
        evidence = f"{key} counts samples without a gap, and the intervals of {name} scatter; {stated}"
    proposal.csv["rate_hz"] = None
    proposal.columns[0]["time"] = {
        "column": key,
        "unit": COUNTS,
        "counts_per_unit": TO_DECIDE if rate is None else rate,
    }
    proposal.evidence["time"] = evidence
    return None if rate is None else (count - count[0]) / rate


def _in_dps(rate: Values, proposal: Proposal) -> Values | None:
    """Return rates in deg/s, without correction of their offset; None if their unit is unknown."""
    entry = next(e[GYROSCOPE[0]] for e in proposal.columns if GYROSCOPE[0] in e)
    counts = entry.get("counts_per_unit", 1.0)
    if entry["unit"] == TO_DECIDE or isinstance(counts, str):
        return None
    multiplier, divisor = UNITS[GYROSCOPE[0]][entry["unit"]]
    return np.asarray(rate * multiplier / divisor / counts, np.float64)


def _readings(sensor: str, parts: list[Columns]) -> Values | None:
    for columns in parts:
        if sensor in columns.triads:
            return np.column_stack([columns.log.numbers[i] for i in columns.triads[sensor]])
    return None


def _add(sensor: str, parts: list[Columns], proposal: Proposal, guess: Guess) -> None:
    """Add the channels of a sensor, with the unit that their names state, else the guess."""
    place = next(i for i, c in enumerate(parts) if sensor in c.triads)
    log, triad = parts[place].log, parts[place].triads[sensor]
    proposal.evidence[sensor] = guess.evidence
    axes = zip(TRIADS[sensor], triad, strict=True)
    said = [stated_unit(log.names[index], channel) if log.named else (None, "") for channel, index in axes]
    units = {unit for unit, _ in said if unit}
    if len(units) == 1:  # of one axis alone: wx(rad/s), wy, wz
        said = [next(entry for entry in said if entry[0])] * len(said)
    unit = said[0][0] or guess.entry["unit"]
    if sensor == "accelerometer" and (without := _without_gravity(log, triad, unit)):
        proposal.remarks.append(without)
    for channel, index, (stated, why) in zip(TRIADS[sensor], triad, said, strict=True):
        entry = {"unit": stated} if stated in UNITS_OF[sensor] else guess.entry
        proposal.columns[place][channel] = {"column": log.keys[index], **entry}
        if entry is not guess.entry:
            proposal.evidence[sensor] = f"{why}; {guess.evidence}"
            if _contradicts(guess.entry, channel, str(stated)):
                proposal.remarks.append(f"{log.names[index]}: {why}, and yet {guess.evidence}")


def _contradicts(entry: Mapping[str, Any], channel: str, stated: str) -> bool:
    """Return whether a guess is another unit than the name states; counts may be that unit in whole numbers."""
    if entry["unit"] != COUNTS:
        return entry["unit"] not in (stated, TO_DECIDE)
    counts, (multiplier, divisor) = entry["counts_per_unit"], UNITS[channel][stated]
    return isinstance(counts, float) and abs(counts * multiplier / divisor - 1.0) > SAME_UNIT


def _without_gravity(log: UnknownLog, triad: tuple[int, int, int], unit: str) -> str:
    """Return a remark if the accelerometer reads far less than gravity; empty for none."""
    size = float(np.median(np.linalg.norm([log.numbers[i] for i in triad], axis=0)))
    if size > LEAST_GRAVITY * FORCE_UNITS.get(unit, 0.0) and not (unit == TO_DECIDE and size < LARGEST_LINEAR):
        return ""
    return (
        f"|a| is {size:.3g} {unit.removeprefix(TO_DECIDE)}".rstrip()
        + " on the whole: acceleration without gravity, which "
        "calibrates nothing; take the columns or the file with gravity (TotalAcceleration beside Accelerometer, Acc "
        "beside FreeAcc)"
    )


def _others(columns: Columns, entries: Entries, proposal: Proposal, sensor: str) -> None:
    """Add the channels other than time and readings."""
    log, (low, high) = columns.log, TEMPERATURE_RANGE
    for channel, index in columns.others.items():
        values = log.numbers[index]
        usual = {"temperature": "degC", "table_angle": "deg", "table_rate": "deg/s"}.get(channel, "1")
        stated, why = stated_unit(log.names[index], channel)
        entries[channel] = {"column": log.keys[index], "unit": stated or usual, "optional": True}
        span = f"{values.min():.6g} to {values.max():.6g}"
        proposal.evidence[channel] = f"{why}: {span}" if stated else f"{span}, so {usual}"
        if channel == "table_angle" and stated is not None and columns.turn:
            turn, seen = columns.turn
            proposal.evidence[channel] += f"; {seen}"
            if unit_of_turn(turn) != stated:
                proposal.remarks.append(f"{log.names[index]}: {why}, and yet {seen}")
        if channel == "table_angle" and stated is None and columns.turn:
            turn, why = columns.turn
            unit = unit_of_turn(turn)
            of_counts = {"unit": COUNTS, "counts_per_unit": float(f"{turn / 360.0:.12g}")}
            entries[channel] |= {"unit": unit} if unit else of_counts
            proposal.evidence[channel] = f"{span}, and {why}" + (f": {turn} / 360 counts per degree" * (not unit))
        if channel == "table_angle" and CENTIDEGREES in words_of(log.names[index]):
            entries[channel] |= {"unit": COUNTS, "counts_per_unit": 100.0}
            proposal.evidence[channel] = f"the name says hundredths of a degree: {span}"
        if channel == "temperature" and not low < float(np.median(values)) < high:
            guess = temperature_counts(span, sensor)
            entries[channel] = {"column": log.keys[index], **guess.entry, "optional": True}
            proposal.evidence[channel] = guess.evidence
    if GYROSCOPE[0] not in entries and "table_rate" in entries and not proposal.parts:
        proposal.remarks.append("a table's log, without the sensor's readings")


def fields_of(columns: Entries) -> Entries:
    """Return the columns of a topic as the fields of a profile."""
    return {
        c: {"field": e["column"], **{k: v for k, v in e.items() if k not in ("column", "optional")}}
        for c, e in columns.items()
    }


def _entries(proposal: Proposal, part: int, indent: str) -> list[str]:
    """Return the entries of a part, the first of each sensor with its evidence, and the columns without an entry."""
    topic, explained = proposal.logs[part].topic, set[str]()
    lines = [] if topic is None else [f"{indent}{_scalar(topic)}:"]
    indent += "" if topic is None else "  "
    columns, evidence = proposal.columns[part], proposal.evidence
    for channel, entry in (columns if proposal.topic is None else fields_of(columns)).items():
        key = next((s for s, triad in TRIADS.items() if channel in triad), channel)
        if key in evidence and key not in explained:
            lines += _comment(evidence[key], indent)
            explained.add(key)
        inner = ", ".join(f"{k}: {_scalar(v)}" for k, v in entry.items())
        lines.append(f"{indent}{channel}: {{{inner}}}")
    used = {entry["column"] for entry in columns.values()}
    unused = [f"{c} ({content})" for c, content in proposal.seen[part].items() if c not in used]
    return lines + [f"{indent}# not used: {text}" for text in unused]


def not_found(proposal: Proposal) -> list[str]:
    """Return sentences about the sensors and references without a column, and the lines to add."""
    channels = {c for entries in proposal.columns for c, e in entries.items() if e["column"] != TO_DECIDE}
    missing = [
        f"the {s}, which such a log cannot calibrate. If the log holds it, add {', '.join(triad)}, each with its "
        f"column and unit ({', '.join(UNITS_OF[s])}, or counts with counts_per_unit)."
        for s, triad in TRIADS.items()
        if not set(triad) <= channels
    ]
    if not channels & set(TABLE_CHANNELS):
        missing.append(
            "the angle or rate of a table. If a column is its encoder, add table_angle with the column and its unit: "
            "deg, rad, or counts with counts_per_unit (counts per turn / 360). Without a table, add nothing."
        )
    if "temperature" not in channels:
        missing.append("the temperature. If a column holds it, add temperature with the column and unit: degC.")
    return [line for text in missing for line in textwrap.wrap(f"NOT FOUND: {text}", WIDTH, subsequent_indent="  ")]


def _comment(text: str, indent: str = "") -> list[str]:
    return textwrap.wrap(text, WIDTH, initial_indent=f"{indent}# ", subsequent_indent=f"{indent}# ")


def _scalar(value: Any) -> str:  # noqa: ANN401  (any scalar of YAML)
    """Return a scalar as YAML: plain words without quotes, else JSON."""
    if not isinstance(value, str):
        return json.dumps(value)
    keyword = value.lower() in ("true", "false", "yes", "no", "on", "off", "null", "y", "n")
    if WORD.fullmatch(value) and not keyword:
        return value
    if value in map(OF_SENSOR.format, TRIADS):
        return json.dumps(value)
    return json.dumps(value, ensure_ascii=False).replace("${", "\\\\${")
