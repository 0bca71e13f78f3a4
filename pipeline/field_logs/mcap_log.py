"""Compensation of an MCAP log, chunk by chunk: every message is kept, and a topic of calibrated ones is added.

Readings in ``sensor_msgs/Imu`` (ROS 2 or ROS 1) give messages of the same kind, each a copy of its original in which
six numbers are replaced: stamp, frame, orientation and covariances stay. Readings that the profile maps from the fields
of other messages (protobuf, JSON, own types) give ROS 2 ``sensor_msgs/Imu``. A temperature on a topic of its own is
taken as it comes: a message knows those that stand before it in the file (``pipeline.model.fading_line``).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from mcap.records import Channel, Metadata, Schema

from pipeline.errors import InputError, PipelineError
from pipeline.field_logs.doubts import Doubts
from pipeline.field_logs.mcap_input import Readings, Temperatures
from pipeline.field_logs.mcap_output import new_imu, replaced
from pipeline.field_logs.output import replacing, require_apart
from pipeline.field_logs.profile import EPOCH_AFTER_S, LogProfile
from pipeline.io.mcap_copy import CopyingWalk, McapCopy
from pipeline.io.mcap_settings import mcap_format
from pipeline.io.record_stream import check_magic
from pipeline.io.ros2 import DEFINITIONS, IMU
from pipeline.model.compensation import SMOOTHING_S
from pipeline.records import SENSORS

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from mcap.records import McapRecord

    from pipeline.field_logs.mcap_input import Batch
    from pipeline.io.mcap_chunk import Rows
    from pipeline.io.mcap_container import Container
    from pipeline.model.compensation import Compensation

LAST_ID = 0xFFFF  # ids of added definitions count down from here, those of recorders up from 0
SUFFIX = "_calibrated"
METADATA = "imu_calibration"
NANOSECONDS = 1e9


@dataclass
class Done:
    """What compensating a log has made: messages, the sensors in them, their topic, and what is to be said."""

    messages: int = 0
    sensors: list[str] = field(default_factory=list)
    topic: str = ""
    notes: list[str] = field(default_factory=list)


def compensate_mcap(
    compensation: Compensation,
    source: Path,
    target: Path,
    profile: LogProfile | None = None,
    *,
    topic: str | None = None,
    smoothing: float = SMOOTHING_S,
    progress: Callable[[int, int], None] | None = None,
    doubts: Doubts | None = None,
) -> Done:
    """Add calibrated messages to a log.

    Parameters
    ----------
    compensation : Compensation
    source, target : Path
    profile : LogProfile, optional
        Which topics and fields hold the readings; the only Imu topic by default.
    topic : str, optional
        Of the calibrated messages; that of the readings and ``_calibrated`` by default.
    smoothing : float, s
        Memory of the line through the temperature's past; 0 takes the last one as it is.
    progress : callable, optional
        Called with the messages done and the bytes read.
    doubts : Doubts, optional
        Takes in what speaks against compensating this log; the output's metadata ``imu_calibration`` says it.

    Raises
    ------
    InputError
        If the log is damaged, or does not hold what it should; then no output is left.
    """
    require_apart(source, target)
    profile = profile or LogProfile()
    with source.open("rb") as stream, replacing(target) as out:
        check_magic(stream.read(64), str(source))
        work = _Work(compensation, source, profile, smoothing, topic, doubts or Doubts())
        work.walk = CopyingWalk(
            stream, str(source), McapCopy(out), work.take, allow_truncated=mcap_format(profile.ingest).allow_truncated
        )
        for _ in work.walk.rows():
            if progress is not None:
                progress(work.done.messages, work.walk.position)
        work.finish()
    return work.done


class _Work:
    """One log on its way."""

    walk: CopyingWalk

    def __init__(  # noqa: PLR0917  (they are the task)
        self,
        compensation: Compensation,
        source: Path,
        profile: LogProfile,
        smoothing: float,
        topic: str | None,
        doubts: Doubts,
    ) -> None:
        self.doubts = doubts
        settings = mcap_format(profile.ingest)
        self.source, self.profile, self.topic = source, profile, topic
        self.compensation, self.stream = compensation, compensation.stream(0.0)
        self.readings = Readings(settings, str(source))
        warm = "temperature" in self.stream.needs
        self.temperatures = Temperatures(settings, source, smoothing) if warm else None
        self.channels: dict[int, Channel] = {}  # of the readings' channels, those of the calibrated messages
        self.schema: Schema | None = None
        self.origin_ns: int | None = None
        self.done = Done()

    def take(self, run: list[Rows]) -> None:
        """Compensate the messages of a run, and write them behind it."""
        found = self.walk.found
        if self.temperatures is not None:
            self.temperatures.take(run, found)
        for rows in run:
            batch = self.readings.read(rows, found)
            if batch is not None:
                self._compensate(rows, batch)

    def _compensate(self, rows: Rows, batch: Batch) -> None:
        if self.origin_ns is None:
            first = int(batch.time_ns[0])
            self.origin_ns = first if first > EPOCH_AFTER_S * NANOSECONDS else 0
        time_ns = batch.time_ns - self.origin_ns
        time = time_ns // 10**9 + (time_ns % 10**9) / NANOSECONDS
        given = {s: self.profile.to_body(s, v) for s, v in batch.values.items()}
        warmth = batch.temperature
        if self.temperatures is not None:
            warmth = self.temperatures.at(rows, time, batch, self.origin_ns)
        try:
            found = self.stream.apply(**given, time=time, temperature=warmth)
        except PipelineError as error:
            raise type(error)(f"{error.message} ({rows.run.name})", str(self.source)) from None
        truths = {s: v for s in SENSORS if (v := getattr(found, s)) is not None}
        self.doubts.take(given, truths, time, self.done.messages)
        channel, before = self._channel(rows.channel)
        changed = {s: v for s, v in truths.items() if self.compensation.calibration(s) or v is not batch.values[s]}
        decoder = self.readings.decoders[rows.channel]
        messages = (
            new_imu(rows, truths, channel.id, batch.time_ns)
            if self.readings.mapped
            else replaced(rows, decoder, changed, channel.id)
        )
        self.walk.copy.add(messages, before, channel.id)
        self.done.messages += len(rows.starts)
        self.done.sensors = sorted({*self.done.sensors, *truths})

    def _channel(self, source: int) -> tuple[Channel, list[McapRecord]]:
        """Return the channel of the calibrated messages, and the definitions that still have to be written."""
        if source in self.channels:
            return self.channels[source], []
        known = self.walk.found.channels[source]
        topic = self.topic or f"{known.topic}{SUFFIX}"
        if any(c.topic == topic for c in self.walk.found.channels.values()):
            raise InputError(f"the log has a topic {topic} already; choose another by --topic", str(self.source))
        before: list[McapRecord] = []
        schema_id, encoding = known.schema_id, known.message_encoding
        if self.readings.mapped:
            encoding = "cdr"
            if self.schema is None:
                self.schema = Schema(id=LAST_ID, name=IMU, encoding="ros2msg", data=DEFINITIONS[IMU].encode())
                before.append(self.schema)
            schema_id = self.schema.id
        used = {*self.walk.found.channels, *(c.id for c in self.channels.values())}
        channel = Channel(
            id=next(i for i in range(LAST_ID, 0, -1) if i not in used), topic=topic,
            message_encoding=encoding, schema_id=schema_id,
            metadata=dict(known.metadata) if not self.readings.mapped else {},
        )  # fmt: skip
        self.channels[source] = channel
        self.done.topic = topic
        return channel, [*before, channel]

    def finish(self) -> None:
        """Write the summary."""
        found = self.walk.found
        self.readings.require_messages(found)
        added = list(self.channels.values())
        schemas = [*found.schemas.values(), *([self.schema] if self.schema else [])]
        own = {self.schema.id} & set(found.schemas) if self.schema else set()
        taken = own | {c.id for c in added} & set(found.channels)
        if taken:
            raise InputError(f"the log uses the id {min(taken)} itself, which the added topic needs", str(self.source))
        self._say(found)
        self.walk.copy.finish(schemas, [*found.channels.values(), *added])
        if found.truncated:
            self.done.notes.append(f"{found.truncated}; the output holds these")
        if self.temperatures is not None:
            self.done.notes += self.temperatures.notes()

    def _say(self, found: Container) -> None:
        """Write what was compensated with what, and what speaks against it, into the output's metadata."""
        made = {m.metadata.get("topic"): m.metadata.get("unit") for m in found.metadata if m.name == METADATA}
        topic = self.readings.topic or ""
        if topic in made:
            self.doubts.compensated = f"topic {topic} was made by this command with unit {made[topic]}"
        elif topic.endswith(SUFFIX):
            self.doubts.compensated = f"topic {topic} has the name of one that this command makes"
        held = {s for s in SENSORS if self.compensation.calibration(s) is not None}
        said = "\n".join(self.doubts.said(held))
        entries = {"unit": self.compensation.unit, "topic": self.done.topic, "readings": topic, "warnings": said}
        self.walk.copy.note(Metadata(name=METADATA, metadata=entries))
