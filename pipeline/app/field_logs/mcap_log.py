"""Add a topic of calibrated messages to an MCAP log, whose messages are copied byte for byte.

Readings in ``sensor_msgs/Imu`` (ROS 2 or ROS 1) give copies of the messages with calibrated readings. Readings that the
profile maps from the fields of other messages (protobuf, JSON, user types) give ROS 2 ``sensor_msgs/Imu``. If the
calibration states the noise of a sample, it gives the covariances of the calibrated sensors.

As in a running system, a message is compensated with the temperatures before it in the file
(``pipeline.physics.measurement``). Messages before the first temperature are compensated with the first temperature.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from mcap.records import Channel, McapRecord, Metadata, Schema

from imu_logs.clocks import counted
from imu_logs.mcap_file import ChannelMessages, McapReader
from imu_logs.mcap_write import DEFINITIONS, IMU, TEMPERATURE, McapCopy, new_imu, replaced
from imu_logs.message_decoder import MAPPED, TopicDecoder, Topics, listed_topics, topic_of
from imu_logs.profile import McapFormat, mcap_format
from imu_logs.units import ACCELEROMETER, GYROSCOPE, SECOND_NS, SINCE_1970_NS, TRIADS
from pipeline.core.errors import IngestError, InputError
from pipeline.core.records import Integers, Values
from pipeline.physics.measurement import ExponentialRegression

if TYPE_CHECKING:
    from pipeline.app.field_logs.stream import LogProfile, LogStream, Output, Result


LAST_ID = 0xFFFF  # ids of added definitions count down from here, because recorders count up from 0
SUFFIX = "_calibrated"
METADATA = "imu_calibration"
READING_CHANNELS = {*ACCELEROMETER, *GYROSCOPE}


class McapLog:
    """An MCAP log and its compensated copy."""

    def __init__(  # noqa: PLR0917  (of one call)
        self, source: Path, out: Output, profile: LogProfile, stream: LogStream, topic: str | None, smoothing: float
    ) -> None:
        self.source, self.profile, self.stream, self.topic, self.smoothing = source, profile, stream, topic, smoothing
        self.settings, self.copy = mcap_format(profile.ingest), McapCopy(out)
        self.topics = Topics(self.settings, str(source))
        self.covariances = stream.compensation.covariances
        self.temperatures: Temperatures | None = None
        self.readings: TopicDecoder | None = None
        self.channels: dict[int, Channel] = {}  # channel of readings to the channel of their calibrated messages
        self.schema: Schema | None = None  # of the calibrated messages, if it is added
        self.origin_ns: int | None = None
        self.first_ns = 0

    def compensate(self) -> Result:
        """Copy the log run by run, with the calibrated readings of each run after it."""
        topic, needed = self.settings.imu_topic, "temperature" in self.stream.stream.needs
        if self.settings.topics:
            topics = [t for t, fields in self.settings.topics.items() if READING_CHANNELS & set(fields)]
            if len(topics) != 1:
                message = f"the profile takes the readings from {len(topics)} topics ({', '.join(topics)});"
                message += " apply needs both sensors in the same messages"
                raise IngestError(message, str(self.source), code="unsupported")
            topic = topics[0]
        if needed:
            included = topic is not None and "temperature" in self.settings.topics.get(topic, ())
            self.temperatures = Temperatures(self.settings, self.source, self.smoothing, in_readings=included)
        with self.source.open("rb") as stream:
            self.reader = McapReader(stream, str(self.source), allow_truncated=self.settings.allow_truncated)
            for run in self.reader.runs():
                self.copy.copy(run)
                if self.temperatures is not None:
                    self.temperatures.take(run.rows, self.reader)
                for rows in run.rows:
                    decoder = self.topics.decoder_of(rows, self.reader)
                    if decoder is not None and READING_CHANNELS & set(decoder.fields):
                        self._add_calibrated(rows, decoder)
        if self.readings is None:
            listed = ", ".join(text for _, text in listed_topics(self.reader))
            message = f"no messages on {topic or f'a topic of type {IMU}'}; the file has {listed or 'none'}"
            hint = "ingest.mcap.topics of a profile (--ingest) reads other types by their fields"
            raise IngestError(message, str(self.source), code="missing_topic", hint=hint)
        return self._finish(self.readings.topic)

    def _add_calibrated(self, rows: ChannelMessages, decoder: TopicDecoder) -> None:
        self.readings = self.readings or decoder
        if decoder is not self.readings:
            both = f"{self.readings.topic}, {decoder.topic}"
            message = f"2 topics are of type {IMU}: {both}; choose one in ingest.mcap.imu_topic"
            raise IngestError(message, str(self.source), code="ambiguous")
        done, rate_hz = decoder.count, self.settings.rate_hz
        batch = decoder.read(rows, self.reader)
        time_ns = batch.times(rows)
        if rate_hz is not None:  # counted from the recorder's time of the first message
            self.first_ns = self.first_ns if done else int(time_ns[0])
            time_ns = self.first_ns + counted(len(time_ns), rate_hz, done)
        if self.origin_ns is None:
            self.origin_ns = int(time_ns[0]) if time_ns[0] > SINCE_1970_NS else 0
        since = time_ns - self.origin_ns
        signals = {"time": since // SECOND_NS + (since % SECOND_NS) / SECOND_NS}
        turned: set[str] = set()  # sensors whose axes differ from the body axes
        for sensor, triad in TRIADS.items():
            if triad[0] in batch.values:
                values = np.column_stack([batch.values[c] for c in triad])
                signals[sensor] = self.profile.to_body(sensor, values)
                turned |= {sensor} if signals[sensor] is not values else set()
        warmth = batch.values.get("temperature")
        if self.temperatures is not None:
            warmth = self.temperatures.at(rows.starts, signals["time"], warmth, self.origin_ns)
        if warmth is not None:
            signals["temperature"] = warmth
        readings = self.stream.apply(signals, self.reader.position, str(self.source), f" ({rows.place})")
        channel, before = self._channel(rows.channel)
        if decoder.kind == MAPPED:
            self.copy.add(new_imu(rows, readings, channel.id, time_ns, self.covariances), before, channel.id)
        else:
            truths = {s: v for s, v in readings.items() if s in self.stream.calibrated | turned}
            copies = replaced(rows, decoder.groups, truths, channel.id, self.covariances)
            self.copy.add(copies, before, channel.id)

    def _channel(self, source: int) -> tuple[Channel, list[McapRecord]]:
        """Return the channel of the calibrated messages, and its definitions if they are not written yet."""
        if source in self.channels:
            return self.channels[source], []
        of_readings = self.reader.channels[source]
        topic = self.topic or f"{of_readings.topic}{SUFFIX}"
        if any(c.topic == topic for c in self.reader.channels.values()):
            raise InputError(f"the log has a topic {topic} already; choose another by --topic", str(self.source))
        before: list[McapRecord] = []
        used = {*self.reader.channels, *(c.id for c in self.channels.values())}
        channel = Channel(
            id=next(i for i in range(LAST_ID, 0, -1) if i not in used), topic=topic, schema_id=of_readings.schema_id,
            message_encoding=of_readings.message_encoding, metadata=dict(of_readings.metadata),
        )  # fmt: skip
        if self.settings.topics:
            if self.schema is None:
                self.schema = Schema(id=LAST_ID, name=IMU, encoding="ros2msg", data=DEFINITIONS[IMU].encode())
                before.append(self.schema)
            channel.schema_id, channel.message_encoding, channel.metadata = self.schema.id, "cdr", {}
        self.channels[source] = channel
        return channel, [*before, channel]

    def _finish(self, topic: str) -> Result:
        """Write unit, topics and warnings as metadata, then the summary."""
        reader, added = self.reader, list(self.channels.values())
        made = {m.metadata.get("topic"): m.metadata.get("unit") for m in reader.metadata if m.name == METADATA}
        if topic in made:
            self.stream.checks.compensated = f"topic {topic} was made by this command with unit {made[topic]}"
        elif topic.endswith(SUFFIX):
            self.stream.checks.compensated = f"topic {topic} has the name of one that this command makes"
        schemas = [*reader.schemas.values(), *([self.schema] if self.schema else [])]
        taken = {c.id for c in added} & set(reader.channels)
        taken |= {self.schema.id} & set(reader.schemas) if self.schema else set()
        if taken:
            raise InputError(f"the log uses the id {min(taken)} itself, which the added topic needs", str(self.source))
        notes = [f"{reader.truncated}; the output holds these"] if reader.truncated else []
        notes += self.temperatures.notes() if self.temperatures is not None else []
        result = self.stream.finish(notes)
        result.topic = added[-1].topic
        entries = {"unit": result.unit, "topic": result.topic, "readings": topic}
        self.copy.add_record(Metadata(name=METADATA, metadata={**entries, "warnings": "\n".join(result.warnings)}))
        self.copy.finish(schemas, [*reader.channels.values(), *added])
        return result


class Temperatures:
    """Reads the temperatures of a log run by run, after a search for the first temperature.

    ``smoothing``: memory of the regression line through past temperatures, s; 0 uses the last temperature.
    ``in_readings``: whether the messages of the readings contain the temperature. A log without temperature is refused.
    """

    def __init__(self, settings: McapFormat, path: Path, smoothing: float, *, in_readings: bool) -> None:
        self.settings, self.path, self.smoothing, self.in_readings = settings, path, smoothing, in_readings
        self.line = ExponentialRegression(smoothing or 1.0)
        self.topics = Topics(settings, str(path))
        self.early = self.count = 0
        self.span = [np.inf, -np.inf]
        self.last = self.first = float("nan")
        if not in_readings:
            self.first = self._first()
            self.topics = Topics(settings, str(path))

    def _first(self) -> float:
        """Return the first temperature of the file, for the messages before it."""
        with self.path.open("rb") as stream:
            reader = McapReader(stream, str(self.path), allow_truncated=self.settings.allow_truncated)
            for rows in reader.rows():
                self.take([rows], reader)
                finite = self.values[np.isfinite(self.values)]
                if finite.size:
                    return float(finite[0])
        mapped = [t for t, fields in self.settings.topics.items() if "temperature" in fields]
        topic = mapped[0] if mapped else topic_of(TEMPERATURE, self.settings) or TEMPERATURE
        message = f"the calibration has effects of temperature, but the log holds no messages of {topic}"
        hint = "name the topic in ingest.mcap.temperature_topic of a profile (--ingest)"
        raise IngestError(message, str(self.path), code="missing_topic", hint=hint)

    def take(self, run: list[ChannelMessages], reader: McapReader) -> None:
        """Decode the temperatures of a run."""
        parts: list[tuple[Integers, Integers, Values]] = [(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))]
        for rows in run if not self.in_readings else []:
            decoder = self.topics.decoder_of(rows, reader)
            of_temperature = [d for d in self.topics.decoders.values() if "temperature" in d.fields]
            if decoder is not None and decoder in of_temperature[:1]:
                batch = decoder.read(rows, reader)
                parts.append((rows.starts, batch.times(rows), batch.values["temperature"]))
        self.places, self.times, self.values = map(np.concatenate, zip(*parts, strict=True))

    def at(self, starts: Integers, time: Values, included: Values | None, origin_ns: int) -> Values:
        """Return the temperature at the readings of a run: (n,) array, degC.

        ``starts``: positions of the readings in the run; ``time``: their times, s, from ``origin_ns``; ``included``:
        the temperatures in the messages of the readings.
        """
        if included is not None:
            return self.line.apply(time, included) if self.smoothing > 0 else included
        measured = (self.times - origin_ns) / 1e9  # times of the temperatures, s
        self.count += len(measured)
        if len(measured):
            self.span = [min(self.span[0], measured.min()), max(self.span[1], measured.max())]
        order = np.argsort(np.concatenate([self.places, starts]), kind="stable")
        times = np.concatenate([measured, time])[order]
        values = np.concatenate([self.values, np.full(len(time), np.nan)])[order]
        of_readings = order >= len(measured)
        if self.smoothing > 0:
            temperature = self.line.apply(times, values)
        else:
            latest = np.maximum.accumulate(np.where(of_readings, 0, np.arange(1, len(order) + 1)))
            temperature = np.concatenate([[self.last], values])[latest]
            self.last = float(temperature[-1])
        at_readings = temperature[of_readings]
        early = np.isnan(at_readings)
        self.early += int(early.sum())
        return np.where(early, self.first, at_readings)

    def notes(self) -> list[str]:
        """Return remarks on the temperature."""
        notes = []
        if self.early:
            notes.append(f"{self.early} messages come before the first temperature and are compensated with it")
        interval = (self.span[1] - self.span[0]) / max(self.count - 1, 1)
        if self.count > 1 and 0 < self.smoothing < interval:
            notes.append(
                f"the temperature comes every {interval:.3g} s, which --temperature-smoothing {self.smoothing:g} does "
                "not smooth; give some intervals"
            )
        return notes
