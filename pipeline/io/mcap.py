"""Logs in MCAP files to channels.

    specific force [g]   = linear_acceleration [m/s^2] / 9.80665
    angular rate [deg/s] = angular_velocity [rad/s] * 180/pi

Times are the stamps in the messages' headers, integer ns: the sensor's clock, not the recorder's. The rows are the Imu
messages; table messages belong to them by equal stamps, and a temperature with stamps of its own is interpolated. A
covariance whose first element is -1 says that the quantity is absent (sensor_msgs/Imu). Messages of other types are
read by the map of fields in the profile; their rows are the messages of the first topic with an accelerometer or a
gyroscope.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import IngestError
from pipeline.io.channel_table import ChannelTable
from pipeline.io.mcap_kinds import ABSENT, SHORT, TABLE_UNITS, VECTORS, topic_of, wanted_by_map, wanted_of
from pipeline.io.mcap_series import Gatherer, Series, check_finite
from pipeline.io.mcap_settings import OWN, TIME
from pipeline.io.mcap_walk import Walk
from pipeline.io.message_definition import short_name
from pipeline.io.record_stream import check_magic
from pipeline.io.ros2 import IMU, JOINT_STATE, QUATERNION_STAMPED, TEMPERATURE
from pipeline.io.text_file import unchanged
from pipeline.io.units import ACCELEROMETER, COUNTS, GYROSCOPE, TABLE_CHANNELS, decode, to_house_unit
from pipeline.records import Encoding, Note

if TYPE_CHECKING:
    from pathlib import Path
    from typing import BinaryIO

    from numpy.typing import NDArray

    from pipeline.io.mcap_container import Container
    from pipeline.io.mcap_settings import MappedField, McapFormat

MAP = "map"


def read_mcap(path: Path, settings: McapFormat) -> ChannelTable:
    """Read a log.

    Raises
    ------
    IngestError
        If the file is damaged or incomplete, has no or several Imu topics, or its times cannot be.
    """
    with unchanged(path), path.open("rb") as stream:
        return _Reader(stream, str(path), settings).table()


class _Reader:
    """One file on its way to channels."""

    def __init__(self, stream: BinaryIO, path: str, settings: McapFormat) -> None:
        check_magic(stream.read(64), path)
        self.path, self.settings = path, settings
        self.walk = Walk(stream, path, allow_truncated=settings.allow_truncated)
        self.gatherers: dict[str, Gatherer] = {}
        self.notes: list[Note] = []
        self.encodings: dict[str, Encoding] = {}
        self.logs: list[ChannelTable] = []  # of a table with a clock of its own
        self.end_ns = np.iinfo(np.int64).max  # the topics of a truncated file end at different times

    def table(self) -> ChannelTable:
        for rows in self.walk.rows():
            channel = self.walk.found.channels[rows.channel]
            schema = self.walk.found.schemas.get(channel.schema_id)
            gatherer = self._gatherer(channel.topic, schema.name if schema else "")
            if gatherer is not None:
                gatherer.read(rows, channel, schema)
        self._note_container(self.walk.found)
        base, values = self._mapped() if self.settings.topics else self._imu()
        for kind, read in (
            (TEMPERATURE, self._temperature),
            (JOINT_STATE, self._table_values),
            (QUATERNION_STAMPED, self._table_values),
        ):
            topic = topic_of(kind, self.settings)
            series = self._only(kind, topic, required=topic is not None)
            if series is not None:
                values |= {n: v for n, v in read(series, base).items() if n not in values}
        check_finite(values, base, self.path)
        self._note_ignored()
        time = base.time_ns[base.time_ns <= self.end_ns]
        values = {c: v[: len(time)] for c, v in values.items()}
        source = {"file": self.path, "sha256": self.walk.found.sha256, "rows": len(time)}
        table = ChannelTable(self.path, time, values, source, lambda _row: 0, self.encodings, notes=tuple(self.notes))
        if self.logs:
            from pipeline.io.encoder_log import align  # noqa: PLC0415  (few logs need it)

            for log in self.logs:
                table = align(table, log)
        return table

    def _gatherer(self, topic: str, schema: str) -> Gatherer | None:
        """Return what takes in the messages of a topic; None if none are wanted."""
        if topic not in self.gatherers:
            if topic in self.settings.topics:
                self.gatherers[topic] = Gatherer(topic, MAP, wanted_by_map(topic, self.settings), self.path)
            else:
                kind = SHORT.get(short_name(schema), "")
                if (
                    not kind
                    or topic_of(kind, self.settings) not in (None, topic)
                    or (kind == IMU and self.settings.topics)
                ):
                    return None
                self.gatherers[topic] = Gatherer(topic, kind, wanted_of(kind, self.settings), self.path)
        return self.gatherers[topic]

    def _only(self, kind: str, topic: str | None, *, required: bool) -> Series | None:
        """Return the messages of the named topic, or of the only topic of a type."""
        found = [g for g in self.gatherers.values() if g.kind == kind]
        named = [c.topic for c in self.walk.found.channels.values() if c.topic == topic]
        if not found and required and not (named and self._kind_of(named[0]) == kind):
            listed = ", ".join(self._topics()) or "no topics"
            raise IngestError(
                f"no topic {topic or ''} of type {kind}; the file has {listed}".replace("  ", " "),
                self.path,
                fault="missing_topic",
                hint="" if kind != IMU else "ingest.mcap.topics reads other types by their fields",
            )
        if len(found) > 1:
            raise IngestError(
                f"{len(found)} topics are of type {kind}: {', '.join(g.topic for g in found)}; choose one in "
                "ingest.mcap",
                self.path,
                fault="ambiguous",
            )
        if not found or not found[0].count:
            if required:
                raise IngestError(f"topic {topic} holds no messages", self.path, fault="missing_topic")
            return None
        return found[0].series(self.settings, self.notes)

    def _kind_of(self, topic: str) -> str:
        container = self.walk.found
        schemas = [container.schemas.get(c.schema_id) for c in container.channels.values() if c.topic == topic]
        return SHORT.get(short_name(schemas[0].name), "") if schemas and schemas[0] else ""

    def _topics(self) -> list[str]:
        """Return all topics with their types."""
        container = self.walk.found
        listed = []
        for channel in container.channels.values():
            schema = container.schemas.get(channel.schema_id)
            listed.append(f"{channel.topic} ({schema.name if schema else channel.message_encoding})")
        return sorted(set(listed))

    def _imu(self) -> tuple[Series, dict[str, NDArray[np.float64]]]:
        series = self._only(IMU, self.settings.imu_topic, required=True)
        assert series is not None  # noqa: S101  (required)
        values: dict[str, NDArray[np.float64]] = {}
        for vector, (channels, unit) in VECTORS.items():
            absent = series.values.pop(vector + ABSENT)
            numbers = [series.values.pop(c) for c in channels]
            if absent.all():
                continue
            if absent.any():
                row = int(np.argmax(absent != absent[0])) + 1
                raise IngestError(
                    f"{vector} is absent (covariance -1) in some messages on {series.topic}, see message {row}",
                    self.path,
                    fault="absent",
                )
            values |= {c: to_house_unit(c, column, unit) for c, column in zip(channels, numbers, strict=True)}
        if not values:
            raise IngestError(
                f"topic {series.topic} says that both quantities are absent (covariance -1)", self.path, fault="absent"
            )
        return series, values

    def _mapped(self) -> tuple[Series, dict[str, NDArray[np.float64]]]:
        """Return the rows and channels of the topics whose fields the profile names."""
        topics = self.settings.topics
        empty = [t for t in topics if t not in self.gatherers]
        if empty:
            raise IngestError(
                f"no messages on {', '.join(empty)}; the file has {', '.join(self._topics()) or 'no topics'}",
                self.path,
                fault="missing_topic",
            )
        first = next((t for t, f in topics.items() if {ACCELEROMETER[0], GYROSCOPE[0]} & set(f)), None)
        base = None if first is None else self.gatherers[first].series(self.settings, self.notes)
        if base is None:
            base = self._only(IMU, self.settings.imu_topic, required=True)
        assert base is not None  # noqa: S101  (required)
        values: dict[str, NDArray[np.float64]] = {}
        for topic, fields in topics.items():
            series = base if topic == first else self.gatherers[topic].series(self.settings, self.notes)
            numbers = {c: self._in_unit(c, series.values[c], f) for c, f in fields.items() if c != TIME}
            rows = Series(topic, series.time_ns, numbers)
            if topic != first and self.settings.table_clock == OWN and set(numbers) <= set(TABLE_CHANNELS):
                self._keep_log(rows)
                continue
            if topic != first:
                numbers = (
                    self._temperature(rows, base) if set(numbers) == {"temperature"} else self._matched(rows, base)
                )
            values |= numbers
        return base, values

    def _in_unit(self, channel: str, numbers: NDArray[np.float64], found: MappedField) -> NDArray[np.float64]:
        if found.unit != COUNTS:
            return to_house_unit(channel, numbers, found.unit)
        encoding = Encoding(1.0 / found.counts_per_unit, found.offset)
        self.encodings[channel] = encoding
        return decode(numbers, encoding)

    def _temperature(self, series: Series, base: Series) -> dict[str, NDArray[Any]]:
        if np.array_equal(series.time_ns, base.time_ns):
            return dict(series.values)
        detail = (
            f"temperature of {len(series.time_ns)} messages with stamps of their own, interpolated, held at the ends"
        )
        self.notes.append(Note("N-INTERPOLATED", len(base.time_ns), 0, 0, detail))
        origin = base.time_ns[0]
        self.encodings.pop("temperature", None)
        return {
            n: np.interp(base.time_ns - origin, series.time_ns - origin, numbers)
            for n, numbers in series.values.items()
        }

    def _table_values(self, series: Series, base: Series) -> dict[str, NDArray[Any]]:
        own = self.settings.table_clock == OWN
        values = series.values if own else self._matched(series, base)
        values = {c: to_house_unit(c, v, TABLE_UNITS[c]) if c in TABLE_UNITS else v for c, v in values.items()}
        if not own:
            return values
        self._keep_log(Series(series.topic, series.time_ns, values))
        return {}

    def _keep_log(self, rows: Series) -> None:
        """Keep the log of a table with a clock of its own until the sensor's is complete."""
        source = {"topic": rows.topic, "rows": len(rows.time_ns)}
        self.logs.append(ChannelTable(self.path, rows.time_ns, rows.values, source, lambda _row: 0))

    def _matched(self, series: Series, base: Series) -> dict[str, NDArray[Any]]:
        """Return the numbers of the messages with the stamps of the Imu messages."""
        index = np.minimum(np.searchsorted(series.time_ns, base.time_ns), len(series.time_ns) - 1)
        if self.walk.found.truncated:
            self.end_ns = min(self.end_ns, int(series.time_ns[-1]))
        unmatched = np.flatnonzero((series.time_ns[index] != base.time_ns) & (base.time_ns <= self.end_ns))
        if unmatched.size:
            raise IngestError(
                f"{unmatched.size} of {len(index)} Imu messages have no message of equal stamp on {series.topic}, the "
                f"first at {base.time_ns[unmatched[0]] / 1e9:.9g} s; the table has to be logged with the Imu's stamps",
                self.path,
                fault="bad_time",
                hint="or, where its clock is another one, set ingest.mcap.table_clock=own",
            )
        extra = len(series.time_ns) - len(index)
        if extra > 0:
            detail = f"messages on {series.topic} between the Imu's were not used"
            self.notes.append(Note("N-UNMATCHED", extra, 0, 0, detail))
        return {c: numbers[index] for c, numbers in series.values.items()}

    def _note_container(self, found: Container) -> None:
        if not found.verified:
            detail = "integrity: not_verifiable; written without checksums: damage cannot be told from data"
            self.notes.append(Note("N-NOCRC", 1, 0, 0, detail))
        if found.truncated:
            self.notes.append(Note("N-TRUNCATED", 1, 0, 0, f"{found.truncated}, and were used"))
        if self.settings.time_source != "header":
            detail = "times are the recorder's (ingest.mcap.time_source), not the sensor's"
            self.notes.append(Note("N-LOGTIME", found.count, 0, 0, detail))

    def _note_ignored(self) -> None:
        ignored = [t for t in self._topics() if t.rpartition(" (")[0] not in self.gatherers]
        if ignored:
            self.notes.append(Note("N-IGNORED", len(ignored), 0, 0, f"topics not used: {', '.join(ignored)}"))
