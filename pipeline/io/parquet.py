"""Recordings to Parquet and back, one file a unit, its recordings one after the other.

Columns that came as counts stay integers, ``value = (count - offset) * scale`` on loading; those that would not come
back to the last bit are stored as doubles. Page checksums guard the data; a CRC-32 of every recording's columns and one
of the metadata guard what page checksums do not cover (lengths, offsets, types, scales). Writing the same recordings
again gives the same bytes.

    +------------+---------------------------------------------------------------------------------+
    | time_ns    | int64                                                                           |
    | accel_x .. | double or int32/int64 counts; null in the rows of recordings without it         |
    | flags      | uint16                                                                          |
    +------------+---------------------------------------------------------------------------------+
"""

from __future__ import annotations

import json
import os
import zlib
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
from pyarrow import parquet

from pipeline.errors import DamagedFileError, InputError
from pipeline.io.units import ACCELEROMETER, ATTITUDE, CHANNELS, GYROSCOPE, decode, encode
from pipeline.records import Encoding, Note, Recording

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

SCHEMA_VERSION = 1
AGAIN = "the same command once more makes it again"
ROW_GROUP = 1_000_000  # samples
KEY, KEY_CRC = b"recordings", b"recordings_crc32"
BLOCKS = {"accelerometer": ACCELEROMETER, "gyroscope": GYROSCOPE, "table_attitude": ATTITUDE}
SINGLES = ("temperature", "table_angle", "table_rate", "flags")
COLUMNS = ("time_ns", *CHANNELS, "flags")
PAGE_ENCODINGS = {"f": "BYTE_STREAM_SPLIT", "i": "DELTA_BINARY_PACKED", "u": "PLAIN"}


def save_recordings(path: Path, recordings: Sequence[Recording]) -> None:
    """Write the recordings of a unit.

    Parameters
    ----------
    path : Path
        Replaced at once, never half written.
    recordings : sequence of Recording
    """
    stored = [_columns_of(r) for r in recordings]
    counts = _encode_counts(recordings, stored)
    names = [c for c in COLUMNS if any(c in s for s in stored)] or ["time_ns"]
    types = {n: _type(n, [s[n] for s in stored if n in s]) for n in names}
    stored = [{n: np.ascontiguousarray(v, types[n]) for n, v in s.items()} for s in stored]
    schema = pa.schema(
        [(n, pa.from_numpy_dtype(types[n])) for n in names], metadata=_metadata(recordings, stored, counts)
    )
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    with parquet.ParquetWriter(
        temporary,
        schema,
        compression="zstd",
        compression_level=3,
        use_dictionary=False,
        column_encoding={n: PAGE_ENCODINGS[types[n].kind] for n in names},
        write_statistics=False,
        write_page_checksum=True,
    ) as writer:
        tables = [
            pa.Table.from_arrays(
                [pa.array(columns[n]) if n in columns else pa.nulls(r.samples, schema.field(n).type) for n in names],
                schema=schema,
            )
            for r, columns in zip(recordings, stored, strict=True)
        ]
        writer.write_table(pa.concat_tables(tables) if tables else schema.empty_table(), row_group_size=ROW_GROUP)
    temporary.replace(path)


def load_recordings(path: Path, *, times_alone: bool = False) -> list[Recording]:
    """Read the recordings of a unit, each bit as it was saved.

    Parameters
    ----------
    path : Path
    times_alone : bool
        Leave out every column but the times, and with them the check of the whole: enough to say what was recorded.

    Raises
    ------
    InputError
        If the file does not exist, is damaged or of a schema that is not known.
    """
    try:
        with parquet.ParquetFile(path, page_checksum_verification=True) as file:
            metadata = file.schema_arrow.metadata or {}
            data = _checked_metadata(metadata, str(path))
            table = file.read(["time_ns"] if times_alone else None, use_threads=False)
    except InputError:
        raise
    except Exception as error:  # damaged lengths and names surface as errors of many kinds
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise DamagedFileError(f"cannot be read, it is missing or damaged ({reason}); {AGAIN}", str(path)) from error
    recordings, start = [], 0
    for entry in data["recordings"]:
        if times_alone:
            entry |= {"columns": ["time_ns"], "encodings": {}, "crc32": None}
        recordings.append(_recording(entry, table.slice(start, entry["rows"]), str(path)))
        start += entry["rows"]
    if start != table.num_rows:
        raise _damaged(f"{table.num_rows} rows where {start} are expected", str(path))
    return recordings


def _columns_of(recording: Recording) -> dict[str, NDArray[Any]]:
    """Return the columns that a recording holds."""
    columns: dict[str, NDArray[Any]] = {"time_ns": recording.time_ns}
    for name, channels in BLOCKS.items():
        block = getattr(recording, name)
        if block is not None:
            columns |= {c: np.ascontiguousarray(block[:, i]) for i, c in enumerate(channels)}
    return columns | {n: getattr(recording, n) for n in SINGLES if getattr(recording, n) is not None}


def _encode_counts(recordings: Sequence[Recording], stored: list[dict[str, NDArray[Any]]]) -> set[str]:
    """Put counts in place of values in those columns that every recording can encode, and return their names."""
    encoded = set()
    for channel in CHANNELS:
        holders = [(r, s) for r, s in zip(recordings, stored, strict=True) if channel in s]
        if not holders or any(channel not in r.encodings for r, _ in holders):
            continue
        counts = [encode(s[channel], r.encodings[channel]) for r, s in holders]
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
            "name": recording.name,
            "role": recording.role,
            "axis": recording.axis,
            "setup": recording.setup,
            "up": recording.up,
            "rows": recording.samples,
            "columns": list(columns),
            "crc32": _crc(columns.values()),
            "encodings": {n: asdict(e) for n, e in sorted(recording.encodings.items()) if n in counts},
            "source": recording.source,
            "notes": [asdict(n) for n in recording.notes],
            "filter": recording.filter,
            "clock_shared": recording.clock_shared,
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


def _crc(columns: Iterable[NDArray[Any]]) -> int:
    value = 0
    for column in columns:
        value = zlib.crc32(np.ascontiguousarray(column).view(np.uint8).data, value)
    return value


def _checked_metadata(metadata: dict[bytes, bytes], path: str) -> dict[str, Any]:
    text = metadata.get(KEY)
    if text is None:
        raise InputError("holds no recordings: it was not written by ingest or filter", path)
    if metadata.get(KEY_CRC) != str(zlib.crc32(text)).encode():
        raise _damaged("its description does not match its checksum", path)
    data: dict[str, Any] = json.loads(text)
    if data["schema_version"] != SCHEMA_VERSION:
        raise InputError(
            f"schema_version {data['schema_version']} is not known to this version ({SCHEMA_VERSION}); "
            "delete the results and run again",
            path,
        )
    return data


def _recording(entry: dict[str, Any], table: Any, path: str) -> Recording:  # noqa: ANN401  (pyarrow has no types)
    missing = sorted(set(entry["columns"]) - set(table.column_names))
    if missing or table.num_rows != entry["rows"]:
        raise _damaged(f"columns {missing} missing, or {table.num_rows} rows of {entry['rows']}", path)
    columns = {n: table.column(n).to_numpy() for n in entry["columns"]}
    if entry["crc32"] not in {None, _crc(columns.values())}:
        raise _damaged(f"recording {entry['name']} does not match its checksum", path)
    encodings = {n: Encoding(**e) for n, e in entry["encodings"].items()}
    for name, encoding in encodings.items():
        columns[name] = decode(columns[name].astype(np.float64), encoding)
    blocks = {
        name: np.column_stack([columns[c] for c in channels]) if channels[0] in columns else None
        for name, channels in BLOCKS.items()
    }
    return Recording(
        name=entry["name"],
        role=entry["role"],
        axis=entry["axis"],
        setup=entry.get("setup", ""),
        up=entry.get("up", ""),
        time_ns=columns["time_ns"],
        **blocks,
        **{n: columns.get(n) for n in SINGLES},
        source=entry["source"],
        notes=tuple(Note(**n) for n in entry["notes"]),
        filter=entry["filter"],
        encodings=encodings,
        clock_shared=entry["clock_shared"],
    )


def _damaged(reason: str, path: str) -> DamagedFileError:
    return DamagedFileError(f"the file is damaged: {reason}; {AGAIN}", path)
