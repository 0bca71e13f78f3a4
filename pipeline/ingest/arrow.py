"""Write and read recordings as Parquet, by pyarrow.

One file for each unit, with its recordings one after the other. ``time_ns`` is int64, ``flags`` uint16, every channel a
double, null in the rows of recordings without it. The file is a member of a pack, which has a checksum
(``pipeline.core.pack``). The same recordings give the same bytes.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyarrow import parquet

import imu_logs
from imu_logs.log import Log
from imu_logs.text_write import to_numpy
from imu_logs.units import ACCELEROMETER, ATTITUDE, CHANNELS, GYROSCOPE
from pipeline.core.errors import InputError
from pipeline.core.records import Note, Recording

BLOCKS = {"accelerometer": ACCELEROMETER, "gyroscope": GYROSCOPE, "table_attitude": ATTITUDE}
SINGLES = ("temperature", "table_angle", "table_rate", "flags")
PARQUET_VERSION = 4
# Samples. Recordings of fewer samples are stored, and decoded, with the next ones: a group takes 0.3 ms (8 recordings).
ROW_GROUP, MIN_ROW_GROUP = 1_000_000, 100_000
METADATA_KEY = b"recordings"
COPIED_FIELDS = ("name", "role", "axis", "setup", "kind", "up", "sense", "source", "filter", "clock_shared")  # as JSON
TYPES = {"time_ns": "int64", **dict.fromkeys(CHANNELS, "float64"), "flags": "uint16"}
PAGE_ENCODINGS = {"int64": "DELTA_BINARY_PACKED", "float64": "PLAIN", "uint16": "PLAIN"}


def columns_of(recording: Recording) -> dict[str, NDArray[Any]]:
    """Return the times, channels and flags of a recording, by name."""
    columns: dict[str, NDArray[Any]] = {"time_ns": recording.time_ns}
    for name, channels in BLOCKS.items():
        block = getattr(recording, name)
        if block is not None:
            columns |= {c: block[:, i] for i, c in enumerate(channels)}
    return columns | {n: getattr(recording, n) for n in SINGLES if getattr(recording, n) is not None}


def to_parquet(recordings: Sequence[Recording]) -> bytes:
    """Return the recordings of a unit as a Parquet file."""
    stored = [columns_of(r) for r in recordings]
    names = [n for n in TYPES if n == "time_ns" or any(n in columns for columns in stored)]
    entries = [
        {
            **{name: getattr(r, name) for name in COPIED_FIELDS},
            "rows": r.samples,
            "columns": list(columns),
            "notes": [n.to_json() for n in r.notes],
        }
        for r, columns in zip(recordings, stored, strict=True)
    ]
    description = {"schema_version": PARQUET_VERSION, "recordings": entries}
    text = json.dumps(description, separators=(",", ":"), default=_plain)
    schema = pa.schema([(n, pa.type_for_alias(TYPES[n])) for n in names], metadata={METADATA_KEY: text.encode()})
    options = {"compression": "lz4", "use_dictionary": False, "write_statistics": False}
    options |= {"column_encoding": {n: PAGE_ENCODINGS[TYPES[n]] for n in names}}
    sink = pa.BufferOutputStream()
    with parquet.ParquetWriter(sink, schema, **options) as writer:
        first, rows = 0, 0
        for end, recording in enumerate(recordings, start=1):
            rows += recording.samples
            if rows >= MIN_ROW_GROUP or end == len(recordings):
                writer.write_table(_table(stored[first:end], schema), row_group_size=ROW_GROUP)
                first, rows = end, 0
    return sink.getvalue().to_pybytes()  # type: ignore[no-any-return]


def _table(stored: Sequence[Mapping[str, NDArray[Any]]], schema: pa.Schema) -> pa.Table:
    """Return successive recordings as one table."""
    samples, arrays = [len(columns["time_ns"]) for columns in stored], []
    for name in schema.names:
        found = [columns.get(name) for columns in stored]
        absent = np.repeat([values is None for values in found], samples)
        filled = [np.zeros(n, TYPES[name]) if v is None else v for n, v in zip(samples, found, strict=True)]
        arrays.append(_array(np.concatenate(filled, dtype=TYPES[name]), absent))
    return pa.Table.from_arrays(arrays, schema=schema)


def _array(values: NDArray[Any], absent: NDArray[np.bool_]) -> pa.Array:
    """Return an array, null where ``absent``; of buffers, because ``pa.array`` imports pandas in each job, 0.4 s."""
    valid = pa.py_buffer(np.packbits(~absent, bitorder="little")) if absent.any() else None
    return pa.Array.from_buffers(pa.from_numpy_dtype(values.dtype), len(values), [valid, pa.py_buffer(values)])


def _numbers(column: pa.ChunkedArray) -> NDArray[Any]:
    """Return the numbers of a column; where it is null, which no recording reads, they are arbitrary.

    (``fill_null`` imports pandas in each job, 0.2 s.)
    """
    array = column.combine_chunks()
    return to_numpy(pa.Array.from_buffers(array.type, len(array), [None, array.buffers()[1]], offset=array.offset))


def from_parquet(content: bytes, name: str) -> list[Recording]:
    """Return the recordings of a unit, identical to the saved ones; ``name``: of the file, for errors.

    The times are read at once, every other channel when it is first used: a stage decodes only the channels it uses.
    """
    # a file of some MB is read fastest by a single thread
    file = parquet.ParquetFile(pa.BufferReader(content), pre_buffer=False)
    text = (file.schema_arrow.metadata or {}).get(METADATA_KEY)
    if text is None:
        raise InputError("holds no recordings: it was not written by ingest or filter", name)
    description = json.loads(text)
    if description["schema_version"] != PARQUET_VERSION:
        found = f"schema_version {description['schema_version']} is not known to this version ({PARQUET_VERSION})"
        raise InputError(f"{found}; delete the results and run again", name)
    ends = np.cumsum([file.metadata.row_group(k).num_rows for k in range(file.num_row_groups)])
    decoded: dict[tuple[int, int, tuple[str, ...]], NDArray[Any]] = {}

    def read(start: int, rows: int, names: tuple[str, ...]) -> NDArray[Any]:
        """Return rows of columns, of which whole groups of rows are decoded once."""
        first, last = np.searchsorted(ends, [start, start + rows - 1], side="right").tolist() if rows else (0, -1)
        key = first, last, names
        if key not in decoded:
            columns = file.read_row_groups([*range(first, last + 1)], [*names], use_threads=False).columns
            values = map(_numbers, columns)
            decoded[key] = next(values) if len(names) == 1 else _side_by_side(values, len(columns[0]), len(names))
        start -= int(ends[first - 1]) if first else 0
        return decoded[key][start : start + rows]

    recordings: list[Recording] = []
    start = 0
    for entry in description["recordings"]:
        recordings.append(_StoredRecording.of(entry, partial(read, start, entry["rows"])))
        start += entry["rows"]
    return recordings


def _side_by_side(columns: Iterable[NDArray[Any]], rows: int, count: int) -> NDArray[Any]:
    """Return columns as one array; unlike ``numpy.column_stack``, it holds one of them at a time."""
    block = np.empty((rows, count))
    for place, column in enumerate(columns):
        block[:, place] = column
    return block


class _StoredRecording(Recording):
    """A recording whose channels, below, are decoded when they are first used."""

    @classmethod
    def of(cls, entry: dict[str, Any], read: Callable[[tuple[str, ...]], NDArray[Any]]) -> Recording:
        """Return the recording of an entry of the file's description; ``read`` returns a channel or a block."""
        recording = cls.__new__(cls)
        vars(recording).update(
            {n: entry[n] for n in COPIED_FIELDS},
            time_ns=read(("time_ns",)),
            notes=tuple(map(Note.of, entry["notes"])),
            stored=lambda names: read(names) if names[0] in entry["columns"] else None,
        )
        return recording

    def channels(self, names: tuple[str, ...]) -> NDArray[Any] | None:
        """Return a channel, or a block of three or four; None if the file does not have it."""
        found: NDArray[Any] | None = vars(self)["stored"](names)
        return found


for _name, _channels in {**BLOCKS, **{name: (name,) for name in SINGLES}}.items():
    _property = cached_property(partial(_StoredRecording.channels, names=_channels))
    _property.__set_name__(_StoredRecording, _name)
    setattr(_StoredRecording, _name, _property)


def _plain(value: object) -> object:
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} cannot be stored in a recording's metadata")


def write_recording(path: Path, recording: Recording, decimals: Mapping[str, int] = MappingProxyType({})) -> None:
    """Write a recording as a log, along the body axes: MCAP or canonical CSV by the suffix (``imu_logs.write``)."""
    columns = columns_of(recording)
    time_ns, flags = columns.pop("time_ns"), columns.pop("flags", None)
    imu_logs.write(Log(str(path), time_ns, columns, {}, flags=flags), path, decimals)
