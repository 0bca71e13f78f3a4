"""Packs: ZIP archives, each with the files that one stage writes for all units of a batch.

The CRC-32 of a member is checked at each reading. Members have no time, so equal files give equal bytes.

Up to ``publish_limit`` units, the files of each unit are published one by one, and packs hold them as they are. Above
it the packs of each batch are published (``packs/<batch>/``), and ``unpack`` publishes the files of a unit on request.
Text is then compressed by Zstandard (member ``NAME.zst``): a page of 513 kB to 195 kB in 1.2 ms, where deflation takes
5.6 ms to 216 kB; it is decompressed in 0.4 ms.
"""

from __future__ import annotations

import hashlib
import os
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, cast

from imu_logs.units import SENSORS
from pipeline.core.errors import DamagedFileError
from pipeline.core.files import WRITE_AGAIN, json_text

Files = dict[str, Any]  # name to bytes, text, or a value that is written as JSON
COMPRESSED = ".zst"
COMPRESSION_LEVEL = 1  # of Zstandard; level 3 takes 1.7 ms a page and saves 6 %
PACKS, WITH_PRIOR = "packs", "prior"
PACKED_STEPS = ("calibration", "validate", "diagnose", "export", "report", "summary")
FAILED_SUFFIX = ".failed.json"
INCOMPLETE_SUFFIX = ".incomplete.json"  # what stages after the fit could not make: a list of records as of a failure
STAGE_OF = {  # folder of the results: the stage whose packs contain its files
    "calibrations": "calibration", "validations": "validate", "diagnoses": "diagnose", "exports": "export",
    "reports": "report", "certificates": "report",
}  # fmt: skip
DOCUMENT_FOLDERS = ("calibrations", "validations", "diagnoses")


class Pack:
    """A file that ``new_pack`` wrote; it is opened at the first access."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @cached_property
    def _archive(self) -> zipfile.ZipFile:
        return cast("zipfile.ZipFile", self._checked(lambda: zipfile.ZipFile(self.path)))

    @cached_property
    def state(self) -> str:
        """Digest of names, sizes and checksums of the members."""
        return directory_of(str(self.path))

    def __contains__(self, name: str) -> bool:
        return bool({name, name + COMPRESSED} & self._archive.NameToInfo.keys())

    def names(self) -> list[str]:
        """Return the names of the members, in the order in which they were written."""
        return [name.removesuffix(COMPRESSED) for name in self._archive.namelist()]

    def read(self, name: str) -> bytes:
        """Return the content of a member; ``DamagedFileError`` if it is missing or its checksum differs."""
        archive, compressed = self._archive, name + COMPRESSED
        if compressed not in archive.NameToInfo:
            return cast("bytes", self._checked(lambda: archive.read(name), name))
        return cast("bytes", self._checked(lambda: _decompressed(archive.read(compressed)), name))

    def digest(self, name: str) -> str:
        """Return a digest of the content of a member, which ``new_pack`` wrote as its comment."""
        known = self._archive.NameToInfo
        return known[name if name in known else name + COMPRESSED].comment.decode() or _digest(self.read(name))

    def json(self, name: str) -> Any:  # noqa: ANN401  (any JSON value)
        """Return the value of a JSON member, read in a third of the time of ``json.loads``."""
        from pydantic_core import from_json  # noqa: PLC0415  (the jobs import it; a command that reads no pack need not)

        content = self.read(name)
        return self._checked(lambda: from_json(content), name)

    def _checked(self, read: Callable[[], Any], name: str = "") -> Any:  # noqa: ANN401
        try:
            return read()
        except (OSError, KeyError, ValueError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
            what = f"{name or 'it'} cannot be read, it is missing or damaged ({error})"
            raise DamagedFileError(f"{what}; {WRITE_AGAIN}", str(self.path)) from None


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:32]


def _decompressed(content: bytes) -> bytes:
    import pyarrow as pa  # noqa: PLC0415  (the jobs import it; a command that reads no pack need not)

    with pa.input_stream(pa.py_buffer(content), compression="zstd") as stream:
        return cast("bytes", stream.read())


@contextmanager
def new_pack(path: Path, *, compressed: bool = True) -> Iterator[Callable[[Mapping[str, bytes]], None]]:
    """Write a pack; yields the function that adds files. The pack gets its name after the block, when it is flushed.

    ``compressed``: whether files are compressed, except Parquet, which is.
    """
    import pyarrow as pa  # noqa: PLC0415  (as above)

    codec = pa.Codec("zstd", compression_level=COMPRESSION_LEVEL)
    temporary = path.with_name(f".{path.name}.tmp")  # overwrites the file of a killed job; only one job writes it
    path.parent.mkdir(parents=True, exist_ok=True)
    with temporary.open("wb") as stream, zipfile.ZipFile(stream, "w") as archive:

        def add(files: Mapping[str, bytes]) -> None:
            for name, content in files.items():
                smaller = compressed and not name.endswith(".parquet")
                member = zipfile.ZipInfo(name + COMPRESSED * smaller)
                member.comment = _digest(content).encode()
                archive.writestr(member, codec.compress(content, asbytes=True) if smaller else content)

        yield add
        archive.close()
        stream.flush()
        os.fsync(stream.fileno())
    temporary.replace(path)


def directory_of(path: str) -> str:
    """Return a digest of the central directory of a pack, which holds names, sizes and checksums of its members."""
    with open(path, "rb") as stream:  # noqa: PTH123  (called for all packs of a campaign at each start)
        size = stream.seek(0, os.SEEK_END)
        stream.seek(max(size - 22, 0))  # end record: the size of the central directory is at byte 12
        length = int.from_bytes(stream.read()[12:16], "little")
        stream.seek(max(size - 22 - length, 0))
        return hashlib.sha256(stream.read()).hexdigest()


def as_bytes(content: Any, *, published: bool = True) -> bytes:  # noqa: ANN401
    """Return the content of a file: bytes unchanged, text as UTF-8, other values as JSON, if published with lines."""
    if isinstance(content, bytes):
        return content
    return (content if isinstance(content, str) else json_text(content, 3 * published) + "\n").encode()


class Batch:
    """The packs of a batch that contain the published files of its units."""

    def __init__(self, folder: Path) -> None:
        self.packs = {stage: Pack(folder / f"{stage}.zip") for stage in PACKED_STEPS}

    def _of_failed(self, unit: str) -> Pack | None:
        """Return the pack with the documents of a failed unit: of the stage report or a later one; else None."""
        packs = (self.packs["report"], self.packs["summary"], self.combined)
        return next((pack for pack in packs if pack and f"{unit}.calibration.json" in pack), None)

    def failure(self, unit: str) -> dict[str, Any] | None:
        """Return the failure record of a unit, None if it was calibrated."""
        pack = self._of_failed(unit)
        return cast("dict[str, Any]", pack.json(f"{unit}{FAILED_SUFFIX}")) if pack else None

    def incomplete(self, unit: str) -> list[dict[str, Any]]:
        """Return the records of what could not be made of a calibrated unit."""
        packs, name = [*self.packs.values(), self.combined], f"{unit}{INCOMPLETE_SUFFIX}"
        return [record for pack in packs if pack and name in pack for record in pack.json(name)]

    @cached_property
    def combined(self) -> Pack | None:
        """Return the pack of the files that the priors of lots add or replace, if the run has such priors."""
        path = self.packs["report"].path.with_name(f"{WITH_PRIOR}.zip")
        return Pack(path) if path.is_file() else None

    def member(self, path: str, unit: str) -> tuple[Pack, str]:
        """Return the pack and the member that are published for a unit as ``path``, relative to the results."""
        folder, _, name = path.partition("/")
        if (combined := self.combined) and f"{unit}/{path}" in combined:
            return combined, f"{unit}/{path}"
        if folder in ("calibrations", "reports") and (failed := self._of_failed(unit)):
            return failed, f"{unit}.calibration.json" if folder == "calibrations" else f"{unit}.html"
        return self.packs[STAGE_OF.get(folder, "report")], path if folder == "certificates" else name

    def units(self) -> list[str]:
        """Return the units of the batch: each has a page."""
        names = self.packs["report"].names()
        return [name.removesuffix(".html") for name in names if "/" not in name and name.endswith(".html")]

    def document(self, folder: str, unit: str) -> Any:  # noqa: ANN401  (a JSON document)
        """Return the published document ``<folder>/<unit>.json``."""
        pack, name = self.member(f"{folder}/{unit}.json", unit)
        return pack.json(name)

    def files(self, unit: str) -> Iterator[tuple[str, bytes]]:
        """Yield the path and the content of each published file of a unit."""
        for path in dict.fromkeys(self._paths(unit)):
            pack, name = self.member(path, unit)
            yield path, pack.read(name)

    @cached_property
    def _exports(self) -> dict[str, list[str]]:
        found: dict[str, list[str]] = {}
        for name in self.packs["export"].names():
            found.setdefault(name.partition("/")[0], []).append(name)
        return found

    def _paths(self, unit: str) -> Iterator[str]:
        """Yield the paths of the published files of a unit, relative to the results; those of its lot's prior last."""
        yield f"reports/{unit}.html"
        if self._of_failed(unit):
            yield f"calibrations/{unit}.json"
            return
        yield from (f"{folder}/{unit}.json" for folder in DOCUMENT_FOLDERS)
        suggested = (f"{unit}_{sensor}_unknown.yaml" for sensor in SENSORS)
        yield from (f"diagnoses/{name}" for name in suggested if name in self.packs["diagnose"])
        certificates = (f"certificates/{unit}.{kind}" for kind in ("json", "html", "xml"))
        yield from (path for path in certificates if path in self.packs["report"])  # .xml is not always written
        yield from (f"exports/{name}" for name in self._exports.get(unit, ()))
        names = self.combined.names() if self.combined else ()
        yield from (name.removeprefix(f"{unit}/") for name in names if name.startswith(f"{unit}/"))


def batches_of(results: Path) -> dict[str, Batch]:
    """Return the batch of each unit whose files are published in packs; empty if files are published one by one."""
    packs = results / PACKS
    return _batches(packs, packs.stat().st_mtime_ns, packs.stat().st_ino) if packs.is_dir() else {}


def read_published(path: Path) -> bytes:
    """Return the content of a published file of a unit, from the file itself or from the packs of the campaign.

    Raises ``FileNotFoundError`` if neither exists, ``DamagedFileError`` if a pack is damaged.
    """
    results = next((folder for folder in path.parents[1:3] if (folder / PACKS).is_dir()), None)
    if results is None or path.exists():
        return path.read_bytes()
    below = path.relative_to(results)
    batches, name = batches_of(results), below.parts[1]
    while name not in batches and (end := max(name.rfind("."), name.rfind("_"))) > 0:
        name = name[:end]  # <unit>.json, <unit>_<sensor>_unknown.yaml
    if name in batches:
        pack, member = batches[name].member(below.as_posix(), name)
        if member in pack:
            return pack.read(member)
    return path.read_bytes()  # raises FileNotFoundError


def is_published(path: Path) -> bool:
    """Return whether ``read_published`` finds a file."""
    try:
        return path.is_file() or bool(read_published(path))
    except OSError:
        return False


@lru_cache(maxsize=4)
def _batches(packs: Path, *_: int) -> dict[str, Batch]:
    """Return ``batches_of``, cached; the other arguments change if the folder is replaced."""
    batches: dict[str, Batch] = {}
    for file in sorted(packs.glob("*/report.zip")):
        batch = Batch(file.parent)
        batches |= dict.fromkeys(batch.units(), batch)
    return batches
