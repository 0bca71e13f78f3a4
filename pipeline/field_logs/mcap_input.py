"""What compensating an MCAP log reads of it: readings and temperatures, run by run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import IngestError
from pipeline.io.mcap_container import Container
from pipeline.io.mcap_decode import ChannelDecoder
from pipeline.io.mcap_kinds import ABSENT, SHORT, VECTORS, topic_of, wanted_by_map, wanted_of
from pipeline.io.mcap_settings import TIME
from pipeline.io.mcap_walk import Walk
from pipeline.io.message_definition import short_name
from pipeline.io.ros2 import IMU, TEMPERATURE
from pipeline.io.units import COUNTS, TRIADS, decode, to_house_unit
from pipeline.model.fading_line import FadingLine
from pipeline.records import Encoding

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from pipeline.io.mcap_chunk import Rows
    from pipeline.io.mcap_settings import MappedField, McapFormat


@dataclass(frozen=True)
class Batch:
    """Readings of the messages of one channel in one run.

    Attributes
    ----------
    time_ns : (n,) array of int64, ns
    values : dict of str to (n, 3) array, g or deg/s
        Of the sensors that the messages hold.
    temperature : (n,) array, degC, or None
        Where it stands in the same messages.
    """

    time_ns: NDArray[np.int64]
    values: dict[str, NDArray[np.float64]]
    temperature: NDArray[np.float64] | None


class Readings:
    """The readings of a log, from its Imu topic or from the fields that the profile maps."""

    def __init__(self, settings: McapFormat, path: str) -> None:
        self.settings, self.path = settings, path
        self.mapped = bool(settings.topics)
        self.decoders: dict[int, ChannelDecoder] = {}
        self.topic = settings.imu_topic
        sensors = {c for triad in TRIADS.values() for c in triad}
        with_sensors = [t for t, f in settings.topics.items() if sensors & set(f)]
        if len(with_sensors) > 1:
            raise IngestError(
                f"the profile takes the readings from {len(with_sensors)} topics ({', '.join(with_sensors)}); apply "
                "needs both sensors in the same messages",
                path,
                fault="unsupported",
            )
        if with_sensors:
            self.topic = with_sensors[0]

    def read(self, rows: Rows, found: Container) -> Batch | None:
        """Return the readings of some messages; None if they are of another topic."""
        channel = found.channels[rows.channel]
        schema = found.schemas.get(channel.schema_id)
        is_imu = schema is not None and short_name(schema.name) in SHORT and SHORT[short_name(schema.name)] == IMU
        if self.topic is None and is_imu:
            self.topic = channel.topic
        if channel.topic != self.topic:
            if is_imu and not self.mapped and self.settings.imu_topic is None:
                raise IngestError(
                    f"2 topics are of type {IMU}: {self.topic}, {channel.topic}; choose one in ingest.mcap.imu_topic",
                    self.path,
                    fault="ambiguous",
                )
            return None
        if rows.channel not in self.decoders:
            wanted = wanted_by_map(channel.topic, self.settings) if self.mapped else wanted_of(IMU, self.settings)
            self.decoders[rows.channel] = ChannelDecoder(channel, schema, wanted, self.path)
        batch = self.decoders[rows.channel].read(rows)
        time = rows.heads["log_time"].astype(np.int64) if batch.time_ns is None else batch.time_ns
        if self.mapped:
            fields = self.settings.topics[channel.topic]
            columns = {c: _in_unit(c, batch.values[c], f) for c, f in fields.items() if c != TIME}
        else:
            columns = self._imu_columns(batch.values)
        values = {s: np.column_stack([columns[c] for c in triad]) for s, triad in TRIADS.items() if triad[0] in columns}
        return Batch(time, values, columns.get("temperature"))

    def _imu_columns(self, values: dict[str, NDArray[np.float64]]) -> dict[str, NDArray[np.float64]]:
        columns: dict[str, NDArray[np.float64]] = {}
        for vector, (channels, unit) in VECTORS.items():
            absent = values[vector + ABSENT] == -1.0
            if absent.all():
                continue
            if absent.any():
                raise IngestError(
                    f"{vector} is absent (covariance -1) in some messages on {self.topic} and not in others",
                    self.path,
                    fault="absent",
                )
            columns |= {c: to_house_unit(c, values[c], unit) for c in channels}
        if not columns:
            raise IngestError(
                f"topic {self.topic} says that both quantities are absent (covariance -1)", self.path, fault="absent"
            )
        return columns

    def require_messages(self, found: Container) -> None:
        """Refuse a log in which no readings were met."""
        if not self.decoders:
            listed = sorted({f"{c.topic} ({_kind(c.schema_id, found)})" for c in found.channels.values()})
            raise IngestError(
                f"no messages on {self.topic or f'a topic of type {IMU}'}; the file has {', '.join(listed) or 'none'}",
                self.path,
                fault="missing_topic",
                hint="ingest.mcap.topics of a profile (--ingest) reads other types by their fields",
            )


def _kind(schema_id: int, found: Container) -> str:
    return found.schemas[schema_id].name if schema_id in found.schemas else "no type"


def _in_unit(channel: str, numbers: NDArray[np.float64], mapped: MappedField) -> NDArray[np.float64]:
    if mapped.unit == COUNTS:
        return decode(numbers, Encoding(1.0 / mapped.counts_per_unit, mapped.offset))
    return to_house_unit(channel, numbers, mapped.unit)


class Temperatures:
    """The temperature of a log at its readings, from what stands before them in the file."""

    def __init__(self, settings: McapFormat, path: Path, smoothing: float) -> None:
        self.settings, self.path, self.smoothing = settings, path, smoothing
        self.line = FadingLine(smoothing or 1.0)
        own = [t for t, f in settings.topics.items() if "temperature" in f]
        self.topic = own[0] if own else topic_of(TEMPERATURE, settings)
        self.decoders: dict[int, ChannelDecoder] = {}
        self.first = float("nan") if self._beside_the_readings() else self._first()
        self.last = float("nan")
        self.early = self.count = 0
        self.span = [np.inf, -np.inf]
        self.take([], Container())

    def _first(self) -> float:
        """Return the first temperature of the file, for the messages that stand before it."""
        with self.path.open("rb") as stream:
            walk = Walk(stream, str(self.path), allow_truncated=self.settings.allow_truncated)
            for rows in walk.rows():
                part = self._read(rows, walk.found)
                if part is not None and np.isfinite(part[1]).any():
                    return float(part[1][np.isfinite(part[1])][0])
        raise IngestError(
            f"the calibration has effects of temperature, but the log holds no messages of {self.topic or TEMPERATURE}",
            str(self.path),
            fault="missing_topic",
            hint="name the topic in ingest.mcap.temperature_topic of a profile (--ingest)",
        )

    def _beside_the_readings(self) -> bool:
        """Return whether the readings' own messages hold the temperature."""
        fields = self.settings.topics.get(self.topic or "", {})
        return "temperature" in fields and len(fields) > 2

    def take(self, run: list[Rows], found: Container) -> None:
        """Take in the temperatures of a run."""
        parts = [(r.starts, *part) for r in run if (part := self._read(r, found)) is not None]
        empty = (np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))
        self.places, self.times, self.values = (np.concatenate(c) for c in zip(empty, *parts, strict=True))

    def _read(self, rows: Rows, found: Container) -> tuple[NDArray[np.int64], NDArray[np.float64]] | None:
        channel = found.channels[rows.channel]
        schema = found.schemas.get(channel.schema_id)
        kind = SHORT.get(short_name(schema.name)) if schema else None
        mapped = self.topic in self.settings.topics
        if channel.topic != self.topic and not (self.topic is None and kind == TEMPERATURE):
            return None
        if rows.channel not in self.decoders:
            wanted = wanted_by_map(channel.topic, self.settings) if mapped else wanted_of(TEMPERATURE, self.settings)
            self.decoders[rows.channel] = ChannelDecoder(channel, schema, wanted, str(self.path))
        self.topic = channel.topic
        batch = self.decoders[rows.channel].read(rows)
        values = batch.values["temperature"]
        if mapped:
            values = _in_unit("temperature", values, self.settings.topics[channel.topic]["temperature"])
        return rows.heads["log_time"].astype(np.int64) if batch.time_ns is None else batch.time_ns, values

    def at(self, rows: Rows, time: NDArray[np.float64], batch: Batch, origin_ns: int) -> NDArray[np.float64]:
        """Return the temperature at the messages of a run: (n,) array, degC.

        Parameters
        ----------
        rows : Rows
        time : (n,) array, s, from ``origin_ns``
        batch : Batch
        origin_ns : int
        """
        if batch.temperature is not None:
            return self.line.follow(time, batch.temperature) if self.smoothing > 0 else batch.temperature
        own = (self.times - origin_ns) / 1e9
        self.count += len(own)
        if len(own):
            self.span = [min(self.span[0], own.min()), max(self.span[1], own.max())]
        order = np.argsort(np.concatenate([self.places, rows.starts]), kind="stable")
        every_time = np.concatenate([own, time])[order]
        every_value = np.concatenate([self.values, np.full(len(time), np.nan)])[order]
        of_readings = order >= len(own)
        if self.smoothing > 0:
            found = self.line.follow(every_time, every_value)
        else:
            known = np.maximum.accumulate(np.where(of_readings, 0, np.arange(1, len(order) + 1)))
            found = np.concatenate([[self.last], every_value])[known]
            self.last = float(found[-1])
        warmth = found[of_readings]
        early = np.isnan(warmth)
        self.early += int(early.sum())
        return np.where(early, self.first, warmth)

    def notes(self) -> list[str]:
        """Return what is to be said of the temperature."""
        notes = []
        if self.early:
            notes.append(f"{self.early} messages stand before the first temperature; they were given that one")
        interval = (self.span[1] - self.span[0]) / max(self.count - 1, 1)
        if self.count > 1 and 0 < self.smoothing < interval:
            notes.append(
                f"the temperature comes every {interval:.3g} s, which --temperature-smoothing {self.smoothing:g} does "
                "not smooth; give some intervals"
            )
        return notes
