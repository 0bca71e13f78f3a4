"""The SHA-256 of the recordings of a unit: of its files, as a published document states it, and as ingest stored it.

All three are sorted lists of hexadecimal digests, one for each different file, so that they can be compared.
"""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING, Any

from imu_logs.files import not_regular
from pipeline.ingest.files import recording_files

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

    from pipeline.core.pack import Pack
    from pipeline.core.settings import Ingest, Procedure


def digests_of_files(procedure: Procedure, ingest: Ingest, folder: Path) -> list[str]:
    """Return the digests of the existing files of a unit's recordings; a file that cannot be read is left out."""
    digests = set()
    for path in {path for paths in recording_files(procedure, ingest, folder).values() for path in paths}:
        try:
            if not not_regular(path):
                with path.open("rb") as stream:
                    digests.add(hashlib.file_digest(stream, "sha256").hexdigest())
        except OSError:
            continue
    return sorted(digests)


def digests_of_entries(entries: Iterable[Mapping[str, Any]]) -> list[str]:
    """Return the digests in ``inputs`` of a calibration document, or in the sources of recordings."""
    digests = set()
    for entry in entries:
        digests |= {str(entry["sha256"])} if entry.get("sha256") else set()
        digests |= set(digests_of_entries(entry.get("joined") or ()))
    return sorted(digests)


def digests_in_pack(ingested: Pack, unit: str) -> list[str] | None:
    """Return the digests of a unit in the output of ingest; None if the unit failed there."""
    if f"{unit}.parquet" not in ingested:
        return None
    from pipeline.ingest.arrow import from_parquet  # noqa: PLC0415  (pyarrow, where a unit has failed)

    recordings = from_parquet(ingested.read(f"{unit}.parquet"), str(ingested.path))
    return digests_of_entries(recording.source for recording in recordings)
