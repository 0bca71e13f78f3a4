"""The files of a batch in one file, a ZIP archive, so that a stage of a batch is one file whatever its number of units.

Each member carries a CRC-32, which is compared whenever it is read. Text is deflated; Parquet, which is compressed, is
stored. Members have no time: the same files give the same bytes.

Up to ``publish_limit`` units each unit has published files of its own. Beyond it the packs of its batch are published
(``packs/<batch>/``), and ``unpack`` publishes the files of a unit on request.
"""

from __future__ import annotations

import hashlib
import json
import os
import zipfile
import zlib
from contextlib import contextmanager
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any, cast

from pipeline.errors import DamagedFileError
from pipeline.files import WRITE_AGAIN, json_text

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from pathlib import Path

Files = dict[str, Any]  # name to bytes, text, or a value that is written as JSON
LEVEL = 1  # of zlib: 7.5 ms a MB of pages; level 6 takes 22 and is 17 % smaller (pages of data/demo)


class Pack:
    """The members of a file that ``new_pack`` wrote; opened when it is read first."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @cached_property
    def _archive(self) -> zipfile.ZipFile:
        return cast("zipfile.ZipFile", self._checked(lambda: zipfile.ZipFile(self.path)))

    def __contains__(self, name: str) -> bool:
        return name in self._archive.NameToInfo

    def names(self) -> list[str]:
        """Return the names of the members, in the order in which they were written."""
        return self._archive.namelist()

    def read(self, name: str) -> bytes:
        """Return the content of a member; ``DamagedFileError`` if it is missing or not as it was written."""
        archive = self._archive
        return cast("bytes", self._checked(lambda: archive.read(name), name))

    def json(self, name: str) -> Any:  # noqa: ANN401  (any JSON value)
        """Return a member that is JSON."""
        content = self.read(name)
        return self._checked(lambda: json.loads(content), name)

    def _checked(self, read: Callable[[], Any], name: str = "") -> Any:  # noqa: ANN401
        try:
            return read()
        except (
            OSError,
            KeyError,
            ValueError,
            EOFError,
            NotImplementedError,
            RuntimeError,
            zipfile.BadZipFile,
            zlib.error,
        ) as error:
            what = f"{name or 'it'} cannot be read, it is missing or damaged ({error})"
            raise DamagedFileError(f"{what}; {WRITE_AGAIN}", str(self.path)) from None


@contextmanager
def new_pack(path: Path) -> Iterator[Callable[[Mapping[str, bytes]], None]]:
    """Write a pack: gives the function that adds files. It has its name after the block, when it is on the disk."""
    temporary = path.with_name(f".{path.name}.tmp")  # one job writes it: what a killed one left is written over
    path.parent.mkdir(parents=True, exist_ok=True)
    with temporary.open("wb") as stream, zipfile.ZipFile(stream, "w") as archive:

        def add(files: Mapping[str, bytes]) -> None:
            for name, content in files.items():
                method = zipfile.ZIP_STORED if name.endswith(".parquet") else zipfile.ZIP_DEFLATED
                archive.writestr(zipfile.ZipInfo(name), content, method, LEVEL)

        yield add
        archive.close()
        stream.flush()
        os.fsync(stream.fileno())
    temporary.replace(path)


def directory_of(path: str) -> str:
    """Return a digest of the list of members at the end of a pack, which holds their names, sizes and checksums."""
    with open(path, "rb") as stream:  # noqa: PTH123  (for all packs of a campaign at each start)
        size = stream.seek(0, os.SEEK_END)
        stream.seek(max(size - 22, 0))  # the end record; its size of the list stands at byte 12
        length = int.from_bytes(stream.read()[12:16], "little")
        stream.seek(max(size - 22 - length, 0))
        return hashlib.sha256(stream.read()).hexdigest()


def as_bytes(content: Any) -> bytes:  # noqa: ANN401
    """Return the content of a file: bytes as they are, text as UTF-8, other values as JSON."""
    if isinstance(content, bytes):
        return content
    return (content if isinstance(content, str) else json_text(content) + "\n").encode()


PACKS, WITH_PRIOR = "packs", "prior"
STAGES = ("calibration", "validate", "diagnose", "export", "report", "summary")
FAILED = ".failed.json"
STAGE_OF = {  # folder of the results: the stage whose packs hold its files
    "calibrations": "calibration", "validations": "validate", "diagnoses": "diagnose", "exports": "export",
    "reports": "report", "certificates": "report",
}  # fmt: skip
DOCUMENTS = ("calibrations", "validations", "diagnoses")


class Batch:
    """The packs of a batch that hold what is published of its units."""

    def __init__(self, folder: Path) -> None:
        self.packs = {stage: Pack(folder / f"{stage}.zip") for stage in STAGES}

    def _of_failed(self, unit: str) -> Pack | None:
        """Return the pack with the documents of a failed unit: of the report, or of a later stage that has failed."""
        known = (self.packs["report"], self.packs["summary"], self.combined)
        return next((pack for pack in known if pack and f"{unit}.calibration.json" in pack), None)

    def failure(self, unit: str) -> dict[str, Any] | None:
        """Return the record of the failure of a unit, None where it was calibrated."""
        pack = self._of_failed(unit)
        return cast("dict[str, Any]", pack.json(f"{unit}{FAILED}")) if pack else None

    @cached_property
    def combined(self) -> Pack | None:
        """Return the pack of what the priors of lots add or change, where there is one."""
        path = self.packs["report"].path.with_name(f"{WITH_PRIOR}.zip")
        return Pack(path) if path.is_file() else None

    def member(self, path: str, unit: str) -> tuple[Pack, str]:
        """Return the pack and the member that is published of a unit as ``path``, below the results."""
        folder, _, name = path.partition("/")
        if (combined := self.combined) and f"{unit}/{path}" in combined:
            return combined, f"{unit}/{path}"
        if folder in ("calibrations", "reports") and (failed := self._of_failed(unit)):
            return failed, f"{unit}.calibration.json" if folder == "calibrations" else f"{unit}.html"
        return self.packs[STAGE_OF.get(folder, "report")], path if folder == "certificates" else name

    def document(self, folder: str, unit: str) -> Any:  # noqa: ANN401  (a JSON document)
        """Return ``<folder>/<unit>.json`` as it is published."""
        pack, name = self.member(f"{folder}/{unit}.json", unit)
        return pack.json(name)

    def files(self, unit: str) -> Iterator[tuple[str, bytes]]:
        """Yield the path and the content of each file that is published of a unit."""
        for path in dict.fromkeys(self._paths(unit)):
            pack, name = self.member(path, unit)
            yield path, pack.read(name)

    def _paths(self, unit: str) -> Iterator[str]:
        """Yield the paths below the results of the files of a unit, those that the prior of its lot adds last."""
        yield f"reports/{unit}.html"
        if self._of_failed(unit):
            yield f"calibrations/{unit}.json"
            return
        yield from (f"{folder}/{unit}.json" for folder in DOCUMENTS)
        parts = self.packs["diagnose"].json(f"{unit}.json").values()
        yield from (
            f"diagnoses/{p['suggested_file']}" for p in parts if isinstance(p, dict) and p.get("suggested_file")
        )
        certificates = (f"certificates/{unit}.{kind}" for kind in ("json", "html", "xml"))
        yield from (path for path in certificates if path in self.packs["report"])  # no .xml where something lacks
        yield from (f"exports/{name}" for name in self.packs["export"].names() if name.startswith(f"{unit}/"))
        names = self.combined.names() if self.combined else ()
        yield from (name.removeprefix(f"{unit}/") for name in names if name.startswith(f"{unit}/"))


def batches_of(results: Path) -> dict[str, Batch]:
    """Return the batch of each unit whose files are in packs; none where every unit has files of its own."""
    packs = results / PACKS
    return _batches(packs, packs.stat().st_mtime_ns, packs.stat().st_ino) if packs.is_dir() else {}


def read_published(path: Path) -> bytes:
    """Return a published file of a unit by its path, from the packs of the campaign where it has no file of its own.

    Raises ``FileNotFoundError`` where there is neither, ``DamagedFileError`` where a pack is damaged.
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
    """Return whether ``read_published`` returns a file."""
    try:
        return path.is_file() or bool(read_published(path))
    except OSError:
        return False


@lru_cache(maxsize=4)
def _batches(packs: Path, *_: int) -> dict[str, Batch]:
    """Return ``batches_of``; the other arguments tell when the folder has been replaced."""
    found: dict[str, Batch] = {}
    for folder in sorted(packs.glob("*")):
        batch = Batch(folder)
        pages = [name for name in batch.packs["report"].names() if "/" not in name]
        found |= {name.removesuffix(".html"): batch for name in pages if name.endswith(".html")}
    return found
