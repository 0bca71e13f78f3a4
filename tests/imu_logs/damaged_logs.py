"""Logs of several recorders, damage done to them, and what our reader and the official one make of it."""

from __future__ import annotations

from collections import Counter, defaultdict
from dataclasses import dataclass, field
from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np
from mcap.reader import NonSeekingReader
from mcap.records import Message
from mcap.writer import CompressionType, Writer
from sample_logs import make_recording

from imu_logs import message_read as mcap
from imu_logs.mcap_file import McapReader
from imu_logs.profile import McapFormat
from pipeline.core.errors import IngestError
from pipeline.ingest.arrow import write_recording

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from imu_logs.log import Log

RECORDERS: dict[str, dict[str, Any]] = {
    "zstd, data checksum": {"enable_data_crcs": True, "chunk_size": 1500},
    "zstd": {"chunk_size": 1500},
    "lz4": {"compression": CompressionType.LZ4, "chunk_size": 1500},
    "uncompressed": {"compression": CompressionType.NONE, "chunk_size": 1500},
    "unchunked, data checksum": {"use_chunking": False, "enable_data_crcs": True},
}
Messages = list[tuple[str, int, int, bytes]]


def read_messages(data: bytes) -> tuple[McapReader, dict[int, list[Message]]]:
    """Return a file's definitions, and the messages of each channel in the order of the file."""
    reader, found = McapReader(BytesIO(data), "log"), defaultdict(list)
    for rows in reader.rows():
        columns = [rows.heads[n].tolist() for n in ("log_time", "publish_time", "sequence")]
        for row, (log_time, publish_time, sequence) in enumerate(zip(*columns, strict=True)):
            found[rows.channel].append(Message(rows.channel, log_time, rows.payload(row), publish_time, sequence))
    return reader, dict(found)


def copy_with(source: Path, target: Path, **options: Any) -> None:
    """Write the messages of a file once more, with other settings of the recorder."""
    container, by_channel = read_messages(source.read_bytes())
    with target.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start(profile="ros2")
        for schema in container.schemas.values():
            writer.register_schema(schema.name, schema.encoding, schema.data)
        for channel in container.channels.values():
            writer.register_channel(channel.topic, channel.message_encoding, channel.schema_id)
        for messages in zip(*by_channel.values(), strict=True):
            for m in messages:
                writer.add_message(m.channel_id, m.log_time, m.data, m.publish_time, m.sequence)
        writer.finish()


def log_of(recorder: str, folder: Path, samples: int = 12) -> bytes:
    """Return a log of four topics as a recorder writes it."""
    write_recording(folder / "source.mcap", make_recording(samples))
    copy_with(folder / "source.mcap", folder / "copy.mcap", **RECORDERS[recorder])
    return (folder / "copy.mcap").read_bytes()


def table_of(data: bytes, **settings: Any) -> Log:
    form = McapFormat(**settings)
    return mcap.read_messages(McapReader(BytesIO(data), "log", allow_truncated=form.allow_truncated), form)


def messages_of(data: bytes) -> Messages:
    container, by_channel = read_messages(data)
    found = [(container.channels[c].topic, m) for c, messages in by_channel.items() for m in messages]
    return sorted((topic, m.log_time, m.sequence, m.data) for topic, m in found)


def messages_of_oracle(data: bytes) -> Messages:
    reader = NonSeekingReader(BytesIO(data), validate_crcs=True)
    found = reader.iter_messages(log_time_order=False)
    return sorted((channel.topic, m.log_time, m.sequence, m.data) for _, channel, m in found)


def same_bits(one: Log, other: Log) -> bool:
    return (
        np.array_equal(one.time_ns, other.time_ns)
        and set(one.values) == set(other.values)
        and all(v.tobytes() == other.values[n].tobytes() for n, v in one.values.items())
    )


@dataclass
class Tally:
    """How often a damaged file was refused, read right, or read wrong in silence."""

    ours: Counter[str] = field(default_factory=Counter)  # ``refused``, ``unaffected`` or ``wrong``
    oracle: Counter[str] = field(default_factory=Counter)  # the same, of the official reader
    beside: Counter[tuple[str, str]] = field(default_factory=Counter)  # the two together
    strange: list[str] = field(default_factory=list)  # exceptions other than the ingest error

    def take(self, damaged: bytes, truth: Log, messages: Messages) -> None:
        """Read a damaged file with both."""
        try:
            right = same_bits(table_of(damaged), truth) and messages_of(damaged) == messages
            ours = "unaffected" if right else "wrong"
        except IngestError:
            ours = "refused"
        except Exception as error:  # noqa: BLE001  (that there are none is the claim)
            ours = "strange"
            self.strange.append(f"{type(error).__name__}: {error}")
        try:
            oracle = "unaffected" if messages_of_oracle(damaged) == messages else "wrong"
        except Exception:  # noqa: BLE001  (it raises whatever comes)
            oracle = "refused"
        self.ours[ours] += 1
        self.oracle[oracle] += 1
        self.beside[ours, oracle] += 1


def flips(data: bytes, count: int, seed: int) -> Iterable[bytes]:
    """Return copies of a file with one random bit flipped."""
    generator = np.random.default_rng(seed)
    places = zip(generator.integers(0, len(data), count), generator.integers(0, 8, count), strict=True)
    for position, bit in places:
        damaged = bytearray(data)
        damaged[position] ^= 1 << int(bit)
        yield bytes(damaged)


def cuts(data: bytes, count: int) -> Iterable[bytes]:
    """Return beginnings of a file, of lengths spread over it."""
    for length in np.unique(np.linspace(0, len(data) - 1, count).astype(int)).tolist():
        yield data[:length]
