"""Read logs of messages to channels: MCAP files, and the formats of ``imu_logs.message_logs``.

Times are the stamps in the messages' headers, integer ns: the sensor's clock, not the recorder's. Messages without
usable times are counted at a stated rate (``ingest.mcap.rate_hz``). The rows are the Imu messages, or the messages of
the first topic of ``ingest.mcap.topics`` with an accelerometer or a gyroscope. Table messages are matched by equal
stamps. A temperature with other stamps is interpolated. Several logs of one recording (``ingest.mcap.parts``) are
joined row by row.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from imu_logs.clocks import averaged, check_fine, check_plausible, counted, find_bursts, in_order, rows_covered
from imu_logs.columns import MAX_PARSED_ROWS, MIN_ROWS, UnknownLog, find_columns
from imu_logs.errors import IngestError
from imu_logs.files import unchanged
from imu_logs.log import Integers, Log, Note, joined
from imu_logs.mcap_file import ChannelMessages, MessageReader
from imu_logs.mcap_write import IMU, JOINT_STATE, QUATERNION_STAMPED, TEMPERATURE
from imu_logs.message_decoder import MAPPED, STATED, TopicDecoder, Topics, listed_topics, ros_layouts, topic_of
from imu_logs.message_layout import STAMPS
from imu_logs.message_logs import open_reader
from imu_logs.profile import HEADER, OWN, McapFormat, Profile, mcap_format, mcap_formats
from imu_logs.units import ACCELEROMETER, COUNTS, GYROSCOPE, TABLE_CHANNELS, TRIADS

Columns = dict[str, NDArray[Any]]

LONGEST_ARRAY = 16  # elements of a field that may be readings
OF_ARRAYS = ("HDF5", "MATLAB", "NumPy", "TDMS")  # formats whose arrays a user names


def read_logs(paths: Sequence[Path], profile: Profile) -> Log:
    """Read the log or, if the profile joins several, all logs of one recording; errors as of ``read_log``."""
    formats = mcap_formats(profile)
    if len(paths) != len(formats):  # in place of the parts, a log that is a whole recording
        formats = [mcap_format(profile)]
    return joined([read_log(path, settings) for path, settings in zip(paths, formats, strict=True)])


def read_log(path: Path, settings: McapFormat) -> Log:
    """Read a log of messages in any format.

    Raises ``IngestError`` for a damaged or incomplete log, for no Imu topic or several, and for impossible times.
    """
    with unchanged(path), open_reader(path, allow_truncated=settings.allow_truncated) as reader:
        return read_messages(reader, settings)


def read_messages(reader: MessageReader, settings: McapFormat) -> Log:
    """Read the messages of an open log; errors as of ``read_log``."""
    return _Log(reader, settings).table()


@dataclass
class _Topic:
    """The messages of one topic; an error in them is raised only if the topic is used."""

    decoder: TopicDecoder
    error: IngestError | None = None
    times: list[Integers] = field(default_factory=list)
    recorded: list[Integers] = field(default_factory=list)
    values: dict[str, list[NDArray[Any]]] = field(default_factory=dict)

    def read(self, rows: ChannelMessages, reader: MessageReader) -> None:
        if self.error is not None:
            return
        try:
            batch = self.decoder.read(rows, reader)
        except IngestError as error:
            self.error = error
            return
        self.recorded.append(rows.heads["log_time"].astype(np.int64))
        if batch.time_ns is not None:
            self.times.append(batch.time_ns)
        for name, column in batch.values.items():
            self.values.setdefault(name, []).append(column)

    def series(self, settings: McapFormat, notes: list[Note], *, recorder: bool) -> Log:
        """Return all messages in order of time; ``recorder``: whether the log has times of the recorder."""
        if self.error is not None:
            raise self.error
        topic, path = self.decoder.topic, self.decoder.path
        values = {n: np.concatenate(self.values.pop(n)) for n in list(self.values)}
        recorded = np.concatenate(self.recorded)
        time = np.concatenate(self.times) if self.times else recorded
        if settings.rate_hz is not None:
            time = counted(len(recorded), settings.rate_hz)
        elif not self.times and not recorder:
            message = f"topic {topic}: the format has no recorder's times, which ingest.mcap.time_source=log_time needs"
            hint = "name the field of the time, or state the sampling rate (ingest.mcap.rate_hz)"
            raise IngestError(message, path, code="bad_time", hint=hint)
        if self.times:
            if not time.any() and len(time) > 1:
                message = f"topic {topic}: all header stamps are 0; the sensor's own times are needed"
                hint = "if the recorder's times are good enough, set ingest.mcap.time_source=log_time"
                raise IngestError(message, path, code="bad_time", hint=hint)
            check_plausible(topic, time, recorded, settings.clock_difference_s if recorder else None, path)
        time, values, bursts, found = _ordered(topic, time, values, settings.reorder_s, path)
        notes += found
        if self.decoder.coarse_time:
            check_fine(topic, time, path)
        if self.decoder.varying:
            detail = f"messages on {topic} vary in length or texts, and those of one layout were decoded together"
            notes.append(Note("N-FALLBACK", self.decoder.varying, 0, 0, detail))
        counts = {c: 1.0 / abs(f.counts_per_unit) for c, f in self.decoder.fields.items() if f.unit == COUNTS}
        return Log(path, time, values, {"topic": topic, "rows": len(time), **bursts}, count_sizes=counts)


def _ordered(
    topic: str, time: Integers, values: Columns, reorder_s: float, path: str
) -> tuple[Integers, Columns, dict[str, Any], list[Note]]:
    """Return messages in order of time, each once; those that arrive in bursts by a regular clock, the third result."""
    bursts = find_bursts(time, values)
    if bursts is not None and bursts.times is not None:
        note = Note("N-BURSTS", bursts.untimed.size, 0, 0, f"{topic}: {bursts.described(len(time))}")
        return bursts.times, values, {"bursts": bursts.clock}, [note]
    try:
        order, notes = in_order(topic, time, list(values.values()), reorder_s, path)
    except IngestError as error:
        raise (bursts.error(path, path) if bursts else error) from None
    if order is None:
        return time, values, {}, notes
    return time[order], {name: column[order] for name, column in values.items()}, {}, notes


class _Log:
    """One file, whose topics are combined to a table of channels."""

    def __init__(self, reader: MessageReader, settings: McapFormat) -> None:
        self.reader, self.path, self.settings = reader, reader.path, settings
        self.topics: dict[str, _Topic] = {}
        self.notes: list[Note] = []
        self.table_logs: list[Log] = []  # of a table with a separate clock
        self.end_ns = np.iinfo(np.int64).max  # the topics of a truncated file end at different times

    def table(self) -> Log:
        decoders = Topics(self.settings, self.path)
        for rows in self.reader.rows():
            decoder = decoders.decoder_of(rows, self.reader)
            if decoder is not None:
                self.topics.setdefault(decoder.topic, _Topic(decoder)).read(rows, self.reader)
        self._note_container()
        recorder = self.reader.has_recorder
        base, *others = (t.series(self.settings, self.notes, recorder=recorder) for t in self._chosen())
        self._require_counted(base, others)
        if self.settings.sensor_clock == OWN:
            base, others = self._slower_first(base, others)
        values, counts = dict(base.values), dict(base.count_sizes)
        for series in others:
            values = self._at_rows(series, base) | values
            counts |= series.count_sizes
        for channel, numbers in values.items():
            wrong = np.flatnonzero(~np.isfinite(numbers))
            if wrong.size:
                row = int(wrong[0])
                message = (
                    f"{channel} is {numbers[row]} at {base.time_ns[row] / 1e9:.9g} s ({wrong.size} such samples); "
                    "finite numbers are expected"
                )
                raise IngestError(message, self.path, code="bad_message")
        ignored = [listed for name, listed in listed_topics(self.reader) if name not in self.topics]
        if ignored:
            self.notes.append(Note("N-IGNORED", len(ignored), 0, 0, f"topics not used: {', '.join(ignored)}"))
        time = base.time_ns[base.time_ns <= self.end_ns]
        values = {c: v[: len(time)] for c, v in values.items()}
        source = {"file": self.path, "sha256": self.reader.sha256, "rows": len(time)}
        source |= {key: base.source[key] for key in ("bursts",) if key in base.source}
        apart = tuple(replace(log, source=source) for log in self.table_logs)  # of the same file
        return Log(self.path, time, values, source, None, counts, tuple(self.notes), apart=apart)

    def _require_counted(self, base: Log, others: Sequence[Log]) -> None:
        """Refuse topics of different length whose messages are counted: which of them belong together is unknown."""
        rate_hz, count = self.settings.rate_hz, len(base.time_ns)
        if rate_hz is None:
            return
        for other in others:
            if len(other.time_ns) != count:
                message = (
                    f"{other.source['topic']} has {len(other.time_ns)} messages, and {base.source['topic']} {count}: "
                    "ingest.mcap.rate_hz counts the messages of topics of one length"
                )
                raise IngestError(message, self.path, code="bad_time", hint="name the field of the time of each topic")
        self.notes.append(Note("N-SYNTHTIME", count, 0, 0, f"no times are read: messages counted at {rate_hz:g} Hz"))

    def _only(self, kind: str, *, required: bool) -> list[_Topic]:
        """Return the named topic, or the only topic of a type; none if there is none and none is required."""
        found = [t for t in self.topics.values() if t.decoder.kind == kind]
        if len(found) > 1:
            listed = ", ".join(t.decoder.topic for t in found)
            message = f"{len(found)} topics are of type {kind}: {listed}; choose one in ingest.mcap"
            raise IngestError(message, self.path, code="ambiguous")
        if required and not found:
            named = topic_of(kind, self.settings)
            self._refuse_missing(f"no topic {named} of type {kind}" if named else f"no topic of type {kind}", kind)
        return found

    def _chosen(self) -> list[_Topic]:
        """Return the used topics, first the topic of the rows."""
        topics = self.settings.topics
        if topics:
            empty = [t for t in topics if t not in self.topics]
            if empty:
                self._refuse_missing(f"no messages on {', '.join(empty)}", MAPPED)
            first = next((t for t, f in topics.items() if {ACCELEROMETER[0], GYROSCOPE[0]} & set(f)), None)
            if first is None:
                self._refuse_missing("ingest.mcap.topics names no accelerometer and no gyroscope", MAPPED)
            chosen = [self.topics[t] for t in (first, *(t for t in topics if t != first))]
        else:
            chosen = self._only(IMU, required=True)
        for kind in (TEMPERATURE, JOINT_STATE, QUATERNION_STAMPED):
            chosen += self._only(kind, required=topic_of(kind, self.settings) is not None)
        return chosen

    def _refuse_missing(self, what: str, kind: str) -> NoReturn:
        listed = ", ".join(text for _, text in listed_topics(self.reader)) or "no topics"
        hint = "ingest.mcap.topics reads other types by their fields" if kind == IMU else ""
        raise IngestError(f"{what}; the file has {listed}", self.path, code="missing_topic", hint=hint)

    def _slower_first(self, base: Log, others: list[Log]) -> tuple[Log, list[Log]]:
        """Return the rows of the slower of two sensors with averages of the faster one, and the other topics."""
        sensors = {triad[0] for triad in TRIADS.values()}
        other = next((s for s in others if sensors & set(s.values)), None)
        if other is None:
            return base, others
        others = [s for s in others if s is not other]
        slow, fast = sorted((base, other), key=lambda series: -float(np.median(np.diff(series.time_ns))))
        topic = fast.source["topic"]
        rows = rows_covered(slow.time_ns, fast.time_ns, topic, self.path)
        values = {c: averaged(slow.time_ns, rows, fast.time_ns, v) for c, v in fast.values.items()}
        lost = len(slow.time_ns) - len(rows)
        detail = f"{len(fast.time_ns)} messages on {topic} averaged over the intervals of {slow.source['topic']}"
        detail += f", {lost} of whose messages they do not cover" if lost else ""
        self.notes.append(Note("N-AVERAGED", len(rows), 0, 0, detail))
        values |= {c: v[rows] for c, v in slow.values.items()}
        return replace(slow.select(rows), values=values), others  # an average of counts is no count

    def _at_rows(self, series: Log, base: Log) -> Columns:
        """Return the channels of a topic at the times of the rows; none for a table with a separate clock."""
        channels = set(series.values)
        if self.settings.table_clock == OWN and channels <= set(TABLE_CHANNELS):  # aligned with the rows later
            self.table_logs.append(series)
            return {}
        if channels == {"temperature"} and not np.array_equal(series.time_ns, base.time_ns):
            count = len(series.time_ns)
            detail = f"temperature of {count} messages with stamps of their own, interpolated, held at the ends"
            self.notes.append(Note("N-INTERPOLATED", len(base.time_ns), 0, 0, detail))
            times, own = base.time_ns - base.time_ns[0], series.time_ns - base.time_ns[0]
            return {n: np.interp(times, own, numbers) for n, numbers in series.values.items()}
        topic = series.source["topic"]
        index = np.minimum(np.searchsorted(series.time_ns, base.time_ns), len(series.time_ns) - 1)
        if self.reader.truncated:
            self.end_ns = min(self.end_ns, int(series.time_ns[-1]))
        unmatched = np.flatnonzero((series.time_ns[index] != base.time_ns) & (base.time_ns <= self.end_ns))
        if unmatched.size:
            sensor = next((n for n, triad in TRIADS.items() if triad[0] in series.values), "")
            what = f"both sensors need the same stamps, and the {sensor} has others"
            what = what if sensor else "the table has to be logged with the Imu's stamps"
            message = (
                f"{unmatched.size} of {len(index)} Imu messages have no message of equal stamp on {topic}, the first "
                f"at {base.time_ns[unmatched[0]] / 1e9:.9g} s; {what}"
            )
            hint = "or, where its clock is another one, set ingest.mcap.table_clock=own"
            if sensor:
                hint = "set ingest.mcap.sensor_clock=own: the faster sensor is averaged about the stamps of the slower"
            raise IngestError(message, self.path, code="bad_time", hint=hint)
        extra = len(series.time_ns) - len(index)
        if extra > 0:
            detail = f"messages on {topic} between the Imu's were not used"
            self.notes.append(Note("N-UNMATCHED", extra, 0, 0, detail))
        return {c: numbers[index] for c, numbers in series.values.items()}

    def _note_container(self) -> None:
        self.notes += self.reader.notes
        if not self.reader.verified:
            detail = "integrity: not_verifiable; written without checksums: damage cannot be detected"
            self.notes.append(Note("N-NOCRC", 1, 0, 0, detail))
        if self.reader.truncated:
            self.notes.append(Note("N-TRUNCATED", 1, 0, 0, f"{self.reader.truncated}, and were used"))
        if self.settings.time_source != HEADER:
            detail = "times are the recorder's (ingest.mcap.time_source), not the sensor's"
            self.notes.append(Note("N-LOGTIME", self.reader.count, 0, 0, detail))


def topics_of(path: Path) -> list[UnknownLog]:
    """Return the topics of a log as columns, most sensors first; raises ``IngestError`` if none may hold readings."""
    topics: dict[int, UnknownLog] = {}
    listed = []
    with open_reader(path) as reader:
        for rows in reader.rows():
            if rows.channel not in topics and (log := _topic(reader, rows)) is not None:
                topics[rows.channel] = log
        listed = [f"{c.topic} ({reader.counts[n]})" for n, c in reader.channels.items()]
    best = sorted(topics.values(), key=_worth, reverse=True)
    if not best or not find_columns(best[0]).triads:
        message = f"no topic holds the three axes of a sensor; the file has {', '.join(listed) or 'no topics'}"
        hint = "name the columns of its arrays in a copy of the profile array_file" if best and best[0].arrays else ""
        raise IngestError(message, str(path), code="no_table", hint=hint)
    return best


def _worth(topic: UnknownLog) -> tuple[int, bool, int]:
    """Return the sensors of a topic, whether it has a time, as the readings of a simulation have none, and its rows."""
    columns = find_columns(topic)
    return len(columns.triads), columns.time is not None, len(next(iter(topic.numbers.values())))


def _topic(reader: MessageReader, rows: ChannelMessages) -> UnknownLog | None:
    """Return the messages of a topic as columns; None if they are too few, vary in length or have no numbers."""
    channel = reader.channels[rows.channel]
    schema = reader.schemas.get(channel.schema_id)
    try:
        find = ros_layouts(channel, schema)
        layout = find(rows.payload(0)) if find is not None and len(rows.starts) >= MIN_ROWS else None
    except (ValueError, KeyError):  # an invalid definition, or a message that contradicts it
        return None
    if layout is None or not layout.places or len(layout.matching(rows)) < len(rows.starts):
        return None
    arrays = layout.columns(rows, layout.elements(LONGEST_ARRAY))
    columns: dict[str, Any] = {n: c[:MAX_PARSED_ROWS].astype(np.float64) for n, c in arrays.items()}
    for seconds, nanos in STAMPS:
        for base in [n.removesuffix(f".{seconds}") for n in columns if n.endswith(f".{seconds}")]:
            if f"{base}.{nanos}" in columns:
                columns[base] = columns.pop(f"{base}.{seconds}") + columns.pop(f"{base}.{nanos}") / 1e9
    fields = list(columns)
    stated = [channel.metadata.get(STATED + f.partition("[")[0], "") for f in fields]
    names = [f"{f} [{unit}]" if unit else f for f, unit in zip(fields, stated, strict=True)]
    numbers = {i: columns[f] for i, f in enumerate(fields) if np.isfinite(columns[f]).all()}
    section = {"header": True, "rate_hz": None}
    named_by_user = schema is not None and schema.name in OF_ARRAYS
    log = UnknownLog(reader.path, section, [*fields], names, numbers, topic=channel.topic, arrays=named_by_user)
    return log if numbers else None
