"""Recordings to Parquet and back, one file a unit, its recordings one after the other.

Columns that came as counts stay integers, ``value = (count - offset) * scale`` on loading; those that would not come
back to the last bit are stored as doubles. ``time_ns`` is int64, ``flags`` uint16; a channel is null in the rows of
recordings without it. Page checksums guard the data. A CRC-32 of each recording's columns and one of the metadata guard
what page checksums do not cover (lengths, offsets, types, scales). Writing the same recordings again gives the same
bytes.
"""

from __future__ import annotations

import json
import zlib
from contextlib import contextmanager
from dataclasses import asdict
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
from pyarrow import parquet

from pipeline.errors import DamagedFileError, InputError
from pipeline.files import WRITE_AGAIN
from pipeline.io.arrow import BLOCKS, SINGLES, columns_of, to_arrow, to_numpy
from pipeline.io.units import CHANNELS
from pipeline.records import Encoding, Note, Recording

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

SCHEMA_VERSION = 2
ROW_GROUP = 1_000_000  # samples
KEY, KEY_CRC = b"recordings", b"recordings_crc32"
PLAIN = ("name", "role", "axis", "setup", "up", "sense", "source", "filter", "clock_shared")  # fields stored as JSON
COLUMNS = ("time_ns", *CHANNELS, "flags")
PAGE_ENCODINGS = {"f": "BYTE_STREAM_SPLIT", "i": "DELTA_BINARY_PACKED", "u": "PLAIN"}


def to_parquet(recordings: Sequence[Recording]) -> bytes:
    """Return the recordings of a unit as a Parquet file."""
    stored = [columns_of(r) for r in recordings]
    counts = _encode_counts(recordings, stored)
    names = [c for c in COLUMNS if any(c in s for s in stored)] or ["time_ns"]
    types = {n: _type(n, [s[n] for s in stored if n in s]) for n in names}
    stored = [{n: np.ascontiguousarray(v, types[n]) for n, v in s.items()} for s in stored]
    schema = pa.schema(
        [(n, pa.from_numpy_dtype(types[n])) for n in names], metadata=_metadata(recordings, stored, counts)
    )
    sink = pa.BufferOutputStream()
    with parquet.ParquetWriter(
        sink,
        schema,
        compression="lz4",
        use_dictionary=False,
        column_encoding={n: PAGE_ENCODINGS[types[n].kind] for n in names},
        write_statistics=False,
        write_page_checksum=True,
    ) as writer:
        tables = [
            pa.Table.from_arrays(
                [to_arrow(columns[n]) if n in columns else pa.nulls(r.samples, schema.field(n).type) for n in names],
                schema=schema,
            )
            for r, columns in zip(recordings, stored, strict=True)
        ]
        writer.write_table(pa.concat_tables(tables) if tables else schema.empty_table(), row_group_size=ROW_GROUP)
    return sink.getvalue().to_pybytes()  # type: ignore[no-any-return]


def from_parquet(content: bytes, name: str) -> list[Recording]:
    """Return the recordings of a unit, each bit as it was saved; errors have the name.

    The times are read at once, every other channel when it is used first: a stage decodes what it needs, once. Damage
    raises ``InputError``, here or then.
    """
    stored = _StoredColumns(content, name)
    recordings: list[Recording] = []
    start = 0
    for entry in stored.entries:
        recordings.append(_StoredRecording.of(entry, stored, start))
        start += entry["rows"]
    if start != stored.rows:
        raise stored.damaged(f"{stored.rows} rows where {start} are expected")
    return recordings


class _StoredColumns:
    """The columns of a file, each decoded once for all recordings."""

    def __init__(self, content: bytes, path: str) -> None:
        self.path = path
        with self._guarded():
            # a file of some MB is read fastest by the thread that needs it
            self._file = parquet.ParquetFile(
                pa.BufferReader(content), page_checksum_verification=True, pre_buffer=False
            )
            metadata, self.rows = self._file.schema_arrow.metadata or {}, self._file.metadata.num_rows
        self._columns: dict[str, Any] = {}
        text = metadata.get(KEY)
        if text is None:
            raise InputError("holds no recordings: it was not written by ingest or filter", self.path)
        if metadata.get(KEY_CRC) != str(zlib.crc32(text)).encode():
            raise self.damaged("its description does not match its checksum")
        data: dict[str, Any] = json.loads(text)
        if data["schema_version"] != SCHEMA_VERSION:
            raise InputError(
                f"schema_version {data['schema_version']} is not known to this version ({SCHEMA_VERSION}); "
                "delete the results and run again",
                self.path,
            )
        self.entries: list[dict[str, Any]] = data["recordings"]

    def read(self, entry: dict[str, Any], names: Sequence[str], start: int) -> list[NDArray[Any]]:
        """Return columns of the recording whose rows begin at ``start``."""
        new = [name for name in names if name not in self._columns]
        if new:
            with self._guarded():
                table = self._file.read(new, use_threads=False)
                for name in new:
                    column = table.column(name)
                    self._columns[name] = column if column.null_count else to_numpy(column)
        return [self._part(entry, name, start) for name in names]

    def _part(self, entry: dict[str, Any], name: str, start: int) -> NDArray[Any]:
        rows, column = entry["rows"], self._columns[name]
        if not isinstance(column, np.ndarray):  # other recordings lack it: their rows are null
            column, start = to_numpy(column.slice(start, rows)), 0
        part: NDArray[Any] = column[start : start + rows]
        if len(part) != rows or zlib.crc32(part.view(np.uint8).data) != entry["crc32"][name]:
            raise self.damaged(f"{name} of the recording {entry['name']} does not match its checksum")
        if name in entry["encodings"]:
            return Encoding(**entry["encodings"][name]).decode(part.astype(np.float64))
        return part

    def damaged(self, reason: str) -> DamagedFileError:
        """Return the error of a damaged file."""
        return DamagedFileError(f"the file is damaged: {reason}; {WRITE_AGAIN}", self.path)

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        """Name the file where pyarrow fails: damaged lengths and names surface as errors of many kinds."""
        try:
            yield
        except Exception as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            what = f"cannot be read, it is missing or damaged ({reason}); {WRITE_AGAIN}"
            raise DamagedFileError(what, self.path) from error


class _StoredRecording(Recording):
    """A recording whose channels, below, are decoded when they are used first."""

    @classmethod
    def of(cls, entry: dict[str, Any], stored: _StoredColumns, start: int) -> Recording:
        """Return the recording that an entry of the file's description describes."""
        recording = cls.__new__(cls)
        vars(recording).update(
            {n: entry[n] for n in PLAIN},
            time_ns=stored.read(entry, ["time_ns"], start)[0],
            notes=tuple(Note(**n) for n in entry["notes"]),
            encodings={n: Encoding(**e) for n, e in entry["encodings"].items()},
            stored=lambda names: stored.read(entry, names, start) if names[0] in entry["crc32"] else None,
        )
        return recording

    def channels(self, names: Sequence[str]) -> NDArray[Any] | None:
        """Return a channel, or a block of three or four; None if the file does not hold it."""
        columns = vars(self)["stored"](names)
        return None if columns is None else columns[0] if len(names) == 1 else np.column_stack(columns)


for _name, _channels in {**BLOCKS, **{name: (name,) for name in SINGLES}}.items():
    _property = cached_property(partial(_StoredRecording.channels, names=_channels))
    _property.__set_name__(_StoredRecording, _name)
    setattr(_StoredRecording, _name, _property)


def _encode_counts(recordings: Sequence[Recording], stored: list[dict[str, NDArray[Any]]]) -> set[str]:
    """Replace values by counts in those columns that every recording can encode, and return their names."""
    encoded = set()
    for channel in CHANNELS:
        holders = [(r, s) for r, s in zip(recordings, stored, strict=True) if channel in s]
        if not holders or any(channel not in r.encodings for r, _ in holders):
            continue
        counts = [r.encodings[channel].encode(s[channel]) for r, s in holders]
        if all(c is not None for c in counts):
            encoded.add(channel)
            for (_, columns), values in zip(holders, counts, strict=True):
                assert values is not None  # noqa: S101  (checked for all of them above)
                columns[channel] = values
    return encoded


def _type(name: str, columns: Sequence[NDArray[Any]]) -> np.dtype[Any]:
    """Return the type that a column is stored in: counts in 32 bits where they fit."""
    kind = columns[0].dtype if columns else np.dtype(np.int64)
    if name == "time_ns" or kind.kind != "i":
        return kind
    largest = max((int(np.abs(c).max()) for c in columns if c.size), default=0)
    return np.dtype(np.int32 if largest < 2**31 else np.int64)


def _metadata(
    recordings: Sequence[Recording], stored: Sequence[dict[str, NDArray[Any]]], counts: set[str]
) -> dict[bytes, bytes]:
    entries = [
        {
            **{name: getattr(recording, name) for name in PLAIN},
            "rows": recording.samples,
            "crc32": {n: zlib.crc32(column.view(np.uint8).data) for n, column in columns.items()},
            "encodings": {n: asdict(e) for n, e in sorted(recording.encodings.items()) if n in counts},
            "notes": [asdict(n) for n in recording.notes],
        }
        for recording, columns in zip(recordings, stored, strict=True)
    ]
    data = {"schema_version": SCHEMA_VERSION, "recordings": entries}
    text = json.dumps(data, separators=(",", ":"), default=_plain).encode()
    return {KEY: text, KEY_CRC: str(zlib.crc32(text)).encode()}


def _plain(value: object) -> object:
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} cannot be stored in a recording's metadata")
