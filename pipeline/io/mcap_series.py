"""The messages of one topic, gathered over a file and brought into the order of their times."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import IngestError
from pipeline.io.mcap_decode import ChannelDecoder, Wanted
from pipeline.io.mcap_kinds import ABSENT
from pipeline.io.timestamps import check_fine, check_plausible, in_order
from pipeline.records import Note

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mcap.records import Channel, Schema
    from numpy.typing import NDArray

    from pipeline.io.mcap_chunk import Rows
    from pipeline.io.mcap_decode import Batch
    from pipeline.io.mcap_settings import McapFormat


@dataclass(frozen=True)
class Series:
    """The messages of one topic.

    Attributes
    ----------
    topic : str
    time_ns : (n,) array of int64, ns
        Increasing.
    values : dict of str to (n,) array
    """

    topic: str
    time_ns: NDArray[np.int64]
    values: dict[str, NDArray[Any]]


@dataclass
class Gatherer:
    """The messages of one topic, as they come.

    Attributes
    ----------
    topic, kind : str
        Kind: type of the messages, or ``map`` where the profile names the fields.
    wanted : Wanted
    path : str
        File, for messages.
    """

    topic: str
    kind: str
    wanted: Wanted
    path: str
    decoders: dict[int, ChannelDecoder] = field(default_factory=dict)
    _fault: IngestError | None = None
    _times: list[NDArray[np.int64]] = field(default_factory=list)
    _log_times: list[NDArray[np.uint64]] = field(default_factory=list)
    _values: dict[str, list[NDArray[Any]]] = field(default_factory=dict)
    _missing: dict[str, int] = field(default_factory=dict)

    def read(self, rows: Rows, channel: Channel, schema: Schema | None) -> None:
        """Take in the messages of a run; what is wrong with them matters only if their topic is used."""
        self._log_times.append(rows.heads["log_time"].copy())
        if self._fault is not None:
            return
        try:
            if channel.id not in self.decoders:
                self.decoders[channel.id] = ChannelDecoder(channel, schema, self.wanted, self.path)
            self._take_in(self.decoders[channel.id].read(rows))
        except IngestError as error:
            self._fault = error

    def _take_in(self, batch: Batch) -> None:
        if batch.time_ns is not None:
            self._times.append(batch.time_ns)
        for name, column in batch.values.items():
            kept = column == -1.0 if name.endswith(ABSENT) else column
            self._values.setdefault(name, []).append(kept)
        for name, where in batch.absent.items():
            self._missing[name] = self._missing.get(name, 0) + int(where.sum())

    @property
    def count(self) -> int:
        """Number of messages."""
        return sum(map(len, self._log_times))

    def series(self, settings: McapFormat, notes: list[Note]) -> Series:
        """Return all messages in the order of their times.

        Raises
        ------
        IngestError
            If a message is no such thing, a number is absent in some of them, or the times cannot be.
        """
        if self._fault is not None:
            raise self._fault
        for name, missing in self._missing.items():
            if 0 < missing < self.count:
                raise IngestError(
                    f"{self.wanted.values[name].text} is empty in some messages on {self.topic} ({missing} of "
                    f"{self.count})",
                    self.path,
                    fault="bad_message",
                )
        columns = {n: np.concatenate(self._values.pop(n)) for n in list(self._values)}
        values = {n: column for n, column in columns.items() if not self._missing.get(n)}
        log_time = np.concatenate(self._log_times)
        time = self._times_of(log_time, settings)
        order, found = in_order(self.topic, time, list(values.values()), settings.reorder_s, self.path)
        notes += found
        if order is not None:
            time, values = time[order], {n: column[order] for n, column in values.items()}
        if self.wanted.time is not None and any(d.coarse_time for d in self.decoders.values()):
            check_fine(self.topic, time, self.path)
        one_by_one = sum(d.one_by_one for d in self.decoders.values())
        if one_by_one:
            detail = f"messages on {self.topic} vary in length or texts and were decoded one by one"
            notes.append(Note("N-FALLBACK", one_by_one, 0, 0, detail))
        return Series(self.topic, time, values)

    def _times_of(self, log_time: NDArray[np.uint64], settings: McapFormat) -> NDArray[np.int64]:
        if (log_time > np.iinfo(np.int64).max).any():
            raise IngestError(
                f"message {int(np.argmax(log_time > np.iinfo(np.int64).max)) + 1} on {self.topic}: the recorder's time "
                f"of {log_time.max()} ns is none",
                self.path,
                fault="bad_time",
            )
        recorded = log_time.astype(np.int64)
        if self.wanted.time is None:
            return recorded
        time = np.concatenate(self._times)
        self._times.clear()
        if not time.any() and len(time) > 1:
            raise IngestError(
                f"topic {self.topic}: all header stamps are 0; the sensor's own times are needed",
                self.path,
                fault="bad_time",
                hint="if the recorder's times are good enough, set ingest.mcap.time_source=log_time",
            )
        check_plausible(self.topic, time, recorded, settings.clock_difference_s, self.path)
        return time


def check_finite(values: Mapping[str, NDArray[np.float64]], base: Series, path: str) -> None:
    """Refuse values that are no numbers."""
    for channel, numbers in values.items():
        wrong = np.flatnonzero(~np.isfinite(numbers))
        if wrong.size:
            row = int(wrong[0])
            raise IngestError(
                f"{channel} is {numbers[row]} at {base.time_ns[row] / 1e9:.9g} s ({wrong.size} such samples); finite "
                "numbers are expected",
                path,
                fault="bad_message",
            )
