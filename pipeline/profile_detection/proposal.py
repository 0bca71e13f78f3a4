"""Propose a profile for unknown logs, with the evidence for each guess; it is never applied without a request.

Channels follow from the names of columns. Units follow from names, else from physics (``unit_guesses``). Two files with
equal times, one with the accelerometer and one with the gyroscope, are parts of one recording. An entry that one file
does not determine is taken from another file of the same layout.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.io.bursts import find_bursts
from pipeline.io.csv_times import SHORTEST_PART
from pipeline.io.gravity_rotation import MoveByHand, interval_of, moves_of
from pipeline.io.ingest_settings import AUTO
from pipeline.io.units import COUNTS, GYROSCOPE, TRIADS, UNITS
from pipeline.profile_detection.columns import (
    TEMPERATURE_RANGE,
    Columns,
    find_columns,
    stated_unit,
    whole,
    words_of,
)
from pipeline.profile_detection.unit_guesses import (
    ASSUMED_HZ,
    CENTIDEGREES,
    OF_SENSOR,
    TO_DECIDE,
    Guess,
    counts_of_sensor,
    even_steps,
    find_encoder,
    force_unit,
    other_range,
    rate_unit,
    temperature_counts,
    time_unit,
    unit_by_table,
    unit_of_turn,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.profile_detection.columns import Log
    from pipeline.records import Values
    from pipeline.settings import Sensor

UNITS_OF = {"accelerometer": ("g", "mg", "m/s^2"), "gyroscope": ("deg/s", "rad/s")}
FEWEST_LABELS, MOST_LABELS = 3, 4  # two texts may be states of the logger; labels that a remark names
Entries = dict[str, dict[str, Any]]


@dataclass
class Proposal:
    """A proposed profile; ``???`` marks a value that the user must fill in."""

    files: list[str]  # of the recordings, or of the parts of one recording
    logs: list[Log]
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
        channels = {c for entries in self.columns for c in entries}
        return any(set(t) <= channels for t in TRIADS.values()) and not self.unknown()

    def unknown(self) -> list[str]:
        """Return the keys and channels with a value to fill in."""
        keys = [k for k, v in self.csv.items() if v == TO_DECIDE]
        return keys + [c for entries in self.columns for c, e in entries.items() if TO_DECIDE in e.values()]

    def ingest(self, name: str, sensor: Sensor | None) -> dict[str, Any]:
        """Return the proposal as the section ``ingest`` of a configuration, with the counts of the sensor's file."""
        figures = {OF_SENSOR.format(s): sensor.of(s).counts_per_unit for s in TRIADS} if sensor else {}
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


def propose(logs: Sequence[Log], sensor: Sensor | None = None) -> list[Proposal]:
    """Return a proposal for each layout among the logs.

    ``sensor``: the sensor model, if the user states one, for counts that the log does not determine.
    """
    recordings: list[list[Columns]] = []  # each of one file, or of two files with equal times and one sensor each
    for columns in map(find_columns, logs):
        other = next((parts for parts in recordings if len(parts) == 1 and _belong_together(parts[0], columns)), None)
        if other is None:
            recordings.append([columns])
        else:
            other.append(columns)
    proposals: list[Proposal] = []
    for parts in recordings:
        new = _proposal(parts, sensor)
        twin = next((p for p in proposals if _alike(p, new)), None)
        if twin is None:
            proposals.append(new)
        else:
            _fill_in(twin, new)
    return proposals


def _belong_together(one: Columns, two: Columns) -> bool:
    if len(one.triads) != 1 or len(two.triads) != 1 or set(one.triads) == set(two.triads):
        return False
    if one.log.csv | {"rate_hz": None} != two.log.csv | {"rate_hz": None} or one.time is None or two.time is None:
        return False
    return np.array_equal(one.log.numbers[one.time], two.log.numbers[two.time])


def _alike(one: Proposal, two: Proposal) -> bool:
    """Return whether one profile can read both: equal names, or different names only for optional channels."""
    if one.parts or two.parts:
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


def _proposal(parts: list[Columns], sensor: Sensor | None) -> Proposal:
    logs = [columns.log for columns in parts]
    seen = [{key: _described(log.numbers.get(i)) for i, key in enumerate(log.keys)} for log in logs]
    first = logs[0]
    proposal = Proposal([log.path for log in logs], logs, {**first.csv}, [{} for _ in parts], {**first.evidence}, seen)
    time_s = _time(parts, proposal)
    force = _readings("accelerometer", parts)
    if force is not None:
        interval = interval_of(np.diff(time_s)) if time_s is not None else 1 / ASSUMED_HZ
        guess = force_unit(force, interval)
        _add("accelerometer", parts, proposal, guess)
        proposal.remarks += other_range(guess, sensor)
        force = force - guess.centre
    find_encoder(parts, force, None, time_s)
    rate = _readings("gyroscope", parts)
    if rate is not None:
        _add("gyroscope", parts, proposal, _gyroscope(parts, force, rate, time_s, sensor))
        find_encoder(parts, None, _in_dps(rate, proposal), time_s)
    for columns, entries in zip(parts, proposal.columns, strict=True):
        _others(columns, entries, proposal, sensor.name if sensor else "")
        proposal.remarks += columns.remarks
        proposal.remarks += columns.log.remarks + _labels(columns.log)
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


def _labels(log: Log) -> list[str]:
    """Return remarks on columns whose text names a part of the recording: each text fills rows one after the other."""
    found = []
    for index, texts in log.texts.items():
        labels = [label for label, _ in groupby(texts)]
        if FEWEST_LABELS <= len(labels) == len(set(labels)) and len(texts) >= SHORTEST_PART * len(labels):
            named = ", ".join(labels[:MOST_LABELS]) + " .." * (len(labels) > MOST_LABELS)
            found.append(
                f"column {log.names[index]} labels {len(labels)} parts ({named}), which may not follow each other in "
                "time: give each rest and turn as a window or a separate file, see docs/record.md#parts"
            )
    return found


def _described(values: Values | None) -> str:
    if values is None:
        return "not all of it is numbers"
    low, high = float(values.min()), float(values.max())
    kind = "whole numbers " if whole(values) else ""
    even = ", grows evenly with the rows" if even_steps(values) else ""
    return f"{kind}{low:.6g} to {high:.6g}{even}" if high > low else f"{low:.6g} throughout"


def _gyroscope(
    parts: list[Columns], force: Values | None, rate: Values, time_s: Values | None, sensor: Sensor | None
) -> Guess:
    """Return the unit of the rates from the table, from gravity, or, for counts, from the configuration."""
    moves, why_none = list[MoveByHand](), "no accelerometer in the log that determines the unit"
    if force is not None and not parts[0].steady:
        why_none = "the rows are not one series in time, so the turns of gravity do not determine the unit"
    elif force is not None:
        moves = moves_of(force, rate, time_s if time_s is not None else np.arange(len(rate)) / ASSUMED_HZ)
        why_none = "" if moves else "no move between rests rotates gravity, which would show the unit"
    by_table = unit_by_table(next(c for c in parts if "gyroscope" in c.triads), rate, time_s)
    guess = by_table or rate_unit(rate, moves, why_none, timed=time_s is not None)
    if guess.entry["unit"] == COUNTS and guess.entry["counts_per_unit"] == TO_DECIDE:
        return counts_of_sensor(guess, "gyroscope", sensor)
    return guess


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
    proposal.evidence["rate_hz"] = "there is no time: the sampling rate in Hz"
    return None


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
    for channel, index in zip(TRIADS[sensor], triad, strict=True):
        stated, why = stated_unit(log.names[index], channel) if log.named else (None, "")
        entry = {"unit": stated} if stated in UNITS_OF[sensor] else guess.entry
        proposal.columns[place][channel] = {"column": log.keys[index], **entry}
        if entry is not guess.entry:
            proposal.evidence[sensor] = f"{why}; {guess.evidence}"
            if guess.entry["unit"] not in (stated, TO_DECIDE):
                proposal.remarks.append(f"{log.names[index]}: {why}, and yet {guess.evidence}")


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
