"""The temperature at the readings of an MCAP log.

A temperature on a topic of its own is taken as it comes: a message knows those that stand before it in the file
(``pipeline.model.exponential_regression``), as in a running system. Messages before the first temperature get that one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import IngestError
from pipeline.io.mcap_channels import TopicDecoder, kind_of, topic_of
from pipeline.io.mcap_reader import McapReader
from pipeline.io.ros2_messages import TEMPERATURE
from pipeline.model.exponential_regression import ExponentialRegression

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from pipeline.io.mcap_chunk import Rows
    from pipeline.io.mcap_settings import McapFormat

    Values = NDArray[np.float64]


class Temperatures:
    """Temperatures of a log, run by run; the log is read first up to its first temperature.

    ``readings`` is the topic of the readings, ``smoothing`` the memory, s, of the line through the temperature's past;
    0 takes the last temperature. A log without temperature is refused.
    """

    def __init__(self, settings: McapFormat, path: Path, readings: str | None, smoothing: float) -> None:
        self.settings, self.path, self.smoothing = settings, path, smoothing
        self.line = ExponentialRegression(smoothing or 1.0)
        mapped = [t for t, f in settings.topics.items() if "temperature" in f]
        self.topic = mapped[0] if mapped else topic_of(TEMPERATURE, settings)
        self.decoder: TopicDecoder | None = None
        self.early = self.count = 0
        self.span = [np.inf, -np.inf]
        self.last = self.first = float("nan")
        self.beside_readings = bool(mapped) and self.topic == readings
        if not self.beside_readings:
            self.first = self._first()
        self.decoder = None

    def _first(self) -> float:
        """Return the first temperature of the file, for the messages that stand before it."""
        with self.path.open("rb") as stream:
            reader = McapReader(stream, str(self.path), allow_truncated=self.settings.allow_truncated)
            for rows in reader.rows():
                self.take([rows], reader)
                known = self.values[np.isfinite(self.values)]
                if known.size:
                    return float(known[0])
        message = (
            f"the calibration has effects of temperature, but the log holds no messages of {self.topic or TEMPERATURE}"
        )
        hint = "name the topic in ingest.mcap.temperature_topic of a profile (--ingest)"
        raise IngestError(message, str(self.path), code="missing_topic", hint=hint)

    def take(self, run: list[Rows], reader: McapReader) -> None:
        """Decode the temperatures of a run."""
        places: list[NDArray[np.int64]] = [np.zeros(0, np.int64)]
        times: list[NDArray[np.int64]] = [np.zeros(0, np.int64)]
        values: list[Values] = [np.zeros(0)]
        for rows in run if not self.beside_readings else []:
            channel = reader.channels[rows.channel]
            if self.decoder is None:
                kind = kind_of(channel.topic, reader.schemas.get(channel.schema_id), self.settings)
                if channel.topic != self.topic and (self.topic is not None or kind != TEMPERATURE):
                    continue
                self.topic = channel.topic
                kind = kind if channel.topic in self.settings.topics else TEMPERATURE
                self.decoder = TopicDecoder(channel.topic, kind, self.settings, str(self.path))
            if channel.topic != self.topic:
                continue
            batch = self.decoder.read(rows, reader)
            places.append(rows.starts)
            times.append(rows.heads["log_time"].astype(np.int64) if batch.time_ns is None else batch.time_ns)
            values.append(batch.values["temperature"])
        self.places, self.times = np.concatenate(places), np.concatenate(times)
        self.values = np.concatenate(values)

    def at(self, starts: NDArray[np.int64], time: Values, beside: Values | None, origin_ns: int) -> Values:
        """Return the temperature at the readings of a run: (n,) array, degC.

        ``starts`` are the places of the readings in the run, ``time`` their times, s, from ``origin_ns``, ``beside``
        the temperatures in the readings' own messages.
        """
        if beside is not None:
            return self.line.apply(time, beside) if self.smoothing > 0 else beside
        own = (self.times - origin_ns) / 1e9
        self.count += len(own)
        if len(own):
            self.span = [min(self.span[0], own.min()), max(self.span[1], own.max())]
        order = np.argsort(np.concatenate([self.places, starts]), kind="stable")
        every_time = np.concatenate([own, time])[order]
        every_value = np.concatenate([self.values, np.full(len(time), np.nan)])[order]
        of_readings = order >= len(own)
        if self.smoothing > 0:
            found = self.line.apply(every_time, every_value)
        else:
            known = np.maximum.accumulate(np.where(of_readings, 0, np.arange(1, len(order) + 1)))
            found = np.concatenate([[self.last], every_value])[known]
            self.last = float(found[-1])
        warmth = found[of_readings]
        early = np.isnan(warmth)
        self.early += int(early.sum())
        return np.where(early, self.first, warmth)

    def notes(self) -> list[str]:
        """Return remarks on the temperature."""
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
