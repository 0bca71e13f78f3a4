"""The results folder of a campaign: one run at a time, published files replaced as one set, edited files detected.

Locks
    A run holds an exclusive lock on ``.run.lock`` and each of its jobs a shared lock on ``.jobs.lock``. The kernel
    releases a lock when its process ends, so no stale lock can remain. A file system without locks refuses nothing.
Publishing
    A new set of files is written to a separate folder, which is renamed to ``.published`` when it is complete. Each of
    its files and folders is then exchanged with the published one of the same name. The next run completes an
    interrupted publication.
Files that are kept
    Of the former files, only those are deleted that the last publication wrote and nobody has changed since. A file
    that no run wrote stays in its place. A changed file moves to ``replaced-<date>/``, as do the files of units that
    have no new results.
Edited files
    Snakemake does not repeat a job whose output was edited. Each job therefore records in ``logs/written/`` a digest of
    its output and the number of repetitions because the output was edited:
    ``{"again": 0, "files": {"": "5f70bf18..."}}``; of the published files, the size and time of each:
    ``{"again": 0, "written": {"index.html": "1234 1700000000000000000"}}``. ``again`` is part of the settings of
    the job, so a larger number makes Snakemake repeat it. A folder without a record is accepted.
"""

from __future__ import annotations

import atexit
import fcntl
import filecmp
import hashlib
import json
import os
import re
import shutil
import signal
import socket
import stat
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from itertools import chain, count
from pathlib import Path
from types import MappingProxyType
from typing import IO, Any, NamedTuple

from pipeline.core.errors import DamagedFileError, PipelineError
from pipeline.core.files import exchange, flush_file_system, read_json, write_atomically
from pipeline.core.pack import PACKED_STEPS, PACKS, WITH_PRIOR, Batch, directory_of

PUBLISHED_PATHS = (
    "calibrations", "validations", "diagnoses", "reports", "certificates", "exports", "combined", "packs",
    "index.html", "summary.csv", "failures.json", "parameters.parquet", "fleet.json",
)  # fmt: skip
BESIDE = (  # not published as a set
    "batches", "configs", "history", "logs", "simulated", "complete.json", "thesis.html",
)  # fmt: skip
OF_A_RUN = ("calibrations/*.json", f"{PACKS}/*/*.zip", "batches/*/*.zip", "history/*.json", "simulated/truth/*.json")
RUN_LOCK, JOBS_LOCK, OWNER_FILE = ".run.lock", ".jobs.lock", ".owner.json"
PACK = re.compile(rf"{PACKS}/([^/]+)/(?:{'|'.join((*PACKED_STEPS, WITH_PRIOR))})\.zip")
NEW_FOLDER = ".new"  # folder of a new set of files, below the results
COMPLETE, PLAN_FILE, EXCHANGED = ".published", ".plan.json", ".exchanged.json"
REPLACED = "replaced-"  # and the date: folder of the results for what a run replaced and did not write anew
SUGGESTED_SUFFIX = "_unknown.yaml"  # end of the name of a suggested formula: <unit>_<sensor>_unknown.yaml
DELAYED_SIGNALS = {signal.SIGINT, signal.SIGTERM}  # blocked during the exchange, which takes milliseconds
SNAKEMAKE_TIMESTAMP = ".snakemake_timestamp"  # Snakemake writes it into every output folder
OPEN_LOCKS: list[IO[str]] = []  # locks of this process


class BusyError(PipelineError):
    """Another run uses the same results folder."""

    code = "busy"


def take_run(results: Path) -> None:
    """Lock the results of a campaign for this run; ``BusyError`` names the process that has locked them."""
    stream = _open(results / RUN_LOCK)
    if not _locked(stream, fcntl.LOCK_EX):
        other = stream.read().strip() or "a process that is not known"
        stream.close()
        raise BusyError(f"another run works on these results ({other}); wait until it has ended", str(results))
    stream.truncate(0)
    stream.write(f"process {os.getpid()} on {socket.gethostname()}")
    stream.flush()
    OPEN_LOCKS.append(stream)


def jobs_running(results: Path) -> bool:
    """Return whether jobs of a killed run are still running."""
    with _open(results / JOBS_LOCK) as stream:
        return not _locked(stream, fcntl.LOCK_EX)


def hold_as_job(results: Path) -> None:
    """Mark the results of a campaign as used by a job until this process ends."""
    if results.is_dir():
        stream = _open(results / JOBS_LOCK)
        _locked(stream, fcntl.LOCK_SH)
        OPEN_LOCKS.append(stream)


@atexit.register
def release_locks() -> None:
    """Release the locks of this process."""
    while OPEN_LOCKS:
        OPEN_LOCKS.pop().close()


def _open(path: Path) -> IO[str]:
    path.parent.mkdir(parents=True, exist_ok=True)
    stream = path.open("a+", encoding="utf-8")
    stream.seek(0)
    return stream


def _locked(stream: IO[str], kind: int) -> bool:
    try:
        fcntl.flock(stream, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return True  # a file system without locks
    return True


def publish(
    new: Path,
    results: Path,
    *,
    again: int = 0,
    keep: Collection[str] = (),
    paths: Sequence[str] | None = None,
    written: Mapping[str, str] = MappingProxyType({}),
) -> None:
    """Replace published files by those in ``new``, a folder below ``results``; remove ``new``.

    ``paths``: the files and folders of ``new`` to exchange; default: each of its items, which is the complete set.
    ``keep``: units whose former files move to ``replaced-<date>/``. ``again``: as for ``record_written``. ``written``:
    states of former files that a run wrote, beside those that are recorded.
    """
    finish_publishing(results)
    paths = [item.name for item in new.iterdir()] if paths is None else paths
    plan = {"inodes": {path: (new / path).lstat().st_ino for path in paths}, "again": again, "keep": sorted(keep)}
    plan |= {"before": {**_last_written(results), **written}, "written": _states(new)}
    plan |= {"every": "written" in _read_record(results, "")[1]}  # whether ``before`` has every file
    write_atomically(new / PLAN_FILE, json.dumps(plan))
    flush_file_system(results)
    new.rename(results / COMPLETE)
    finish_publishing(results)


def new_simulated(folder: Path) -> Path:
    """Return the empty folder for the recordings that ``publish_simulated`` exchanges with ``<results>/simulated``."""
    new = folder.parent / NEW_FOLDER
    shutil.rmtree(new, ignore_errors=True)
    (new / folder.name).mkdir(parents=True)
    return new / folder.name


def publish_simulated(folder: Path) -> None:
    """Replace the simulated recordings in the folder ``simulated`` of the results by new ones, as a whole."""
    results, stamp = folder.parent, folder / SNAKEMAKE_TIMESTAMP
    written: dict[str, str] = {}
    if stamp.exists():  # of the version before: Snakemake made this file after the recordings
        before = stamp.stat().st_mtime_ns
        states = _states(folder, folder.name)
        written = {path: s for path, s in states.items() if (results / path).lstat().st_mtime_ns <= before}
    publish(results / NEW_FOLDER, results, again=_read_record(results, "")[0], paths=[folder.name], written=written)


def finish_publishing(results: Path) -> None:
    """Complete an interrupted publication, if there is one."""
    complete = results / COMPLETE
    if (complete / PLAN_FILE).is_file():
        plan = json.loads((complete / PLAN_FILE).read_text(encoding="utf-8"))
        before = signal.pthread_sigmask(signal.SIG_BLOCK, DELAYED_SIGNALS)
        try:
            for path, inode in plan.get("inodes", plan).items():  # 0.1.0 before schema_version 2 wrote the inodes alone
                new, published = complete / path, results / path
                if not os.path.lexists(new) or new.lstat().st_ino != inode:
                    continue  # exchanged before the interruption; somebody may have changed it since
                if os.path.lexists(published):
                    exchange(new, published)
                else:
                    published.parent.mkdir(parents=True, exist_ok=True)
                    new.rename(published)
            (complete / PLAN_FILE).rename(complete / EXCHANGED)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
    if (complete / EXCHANGED).is_file():
        plan = json.loads((complete / EXCHANGED).read_text(encoding="utf-8"))
        _keep_others(complete, results, plan)
        if "written" in plan:
            _record_published(results, plan)
        (complete / EXCHANGED).unlink()
    shutil.rmtree(complete, ignore_errors=True)


def _keep_others(old: Path, results: Path, plan: Mapping[str, Any]) -> None:
    """Move what must not be deleted out of the former files in ``old``.

    A file that the last publication did not write moves back to its place, unless a new file is there. Changed files
    and those of the units ``keep`` move to ``replaced-<date>/``.
    """
    before, keep = plan.get("before", {}), set(plan.get("keep", ()))
    aside: dict[str, Path] = {}
    batches: dict[str, bool] = {}  # of the former packs: whether they are kept
    for path, state in _states(old).items():
        published, file = results / path, old / path
        if path in (PLAN_FILE, EXCHANGED):
            continue
        if pack := PACK.fullmatch(path):  # of a run in any state, as it is a link to the output of a job
            batch = pack[1]
            if batch not in batches:
                batches[batch] = _holds(old / PACKS / batch, keep)
            aside |= {path: file} if batches[batch] else {}
        elif before.get(path) == state:
            aside |= {path: file} if unit_of(path) in keep else {}
        elif not plan.get("every") and unit_of(path) in keep:
            aside[path] = file  # likely of a run: the version before recorded no names
        elif not (path not in before and _put_back(file, published)) and not _same_bytes(file, published):
            aside[path] = file
    set_aside(aside, results)


def _holds(packs: Path, units: set[str]) -> bool:
    """Return whether the packs of a batch hold some of the units, or cannot be read."""
    try:
        return bool(units) and not units.isdisjoint(Batch(packs).units())
    except DamagedFileError:
        return True


def _put_back(file: Path, place: Path) -> bool:
    """Move a file to its former place and return True; return False if something else is there."""
    if os.path.lexists(place):
        return False
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False  # a file has the name of the folder
    file.rename(place)
    return True


def set_aside(items: Mapping[str, Path], results: Path) -> Path | None:
    """Move files and folders to a new folder ``replaced-<date>`` of the results; return it, or None without items.

    ``items``: path below the new folder, and where the file or folder is now.
    """
    if not items:
        return None
    day = datetime.now(UTC).date().isoformat()
    names = chain([f"{REPLACED}{day}"], (f"{REPLACED}{day}-{k}" for k in count(2)))
    folder = next(folder for folder in map(results.joinpath, names) if not os.path.lexists(folder))
    for path, place in items.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        place.rename(folder / path)
    return folder


def replaced_folders(results: Path) -> list[Path]:
    """Return the folders of older files."""
    return sorted(results.glob(f"{REPLACED}*"))


def unit_of(path: str) -> str:
    """Return the unit, or the serial in ``combined``, to which a published file belongs; empty for other files."""
    folder, _, name = path.partition("/")
    if folder == "exports":
        return name.partition("/")[0]
    if folder == "diagnoses" and name.endswith(SUGGESTED_SUFFIX):
        return name.removesuffix(SUGGESTED_SUFFIX).rpartition("_")[0]
    return name.rpartition(".")[0]


def _same_bytes(one: Path, other: Path) -> bool:
    return all(p.is_file() and not p.is_symlink() for p in (one, other)) and filecmp.cmp(one, other, shallow=False)


class ResultsOwner(NamedTuple):
    """The campaign to which a results folder belongs, in ``.owner.json``."""

    campaign: str  # path
    simulation: str | None  # SHA-256 of the description, if the run simulates the recordings
    units: dict[str, list[str]]  # unit to the SHA-256 of its recordings


def read_owner(results: Path) -> ResultsOwner | None:
    """Return the owner of a results folder; None where the file is missing or damaged."""
    try:
        found = json.loads((results / OWNER_FILE).read_text(encoding="utf-8"))
        units = {str(unit): [str(digest) for digest in digests] for unit, digests in found["units"].items()}
        return ResultsOwner(str(found["campaign"]), found["simulation"], units)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


def is_owner(results: Path, directory: Path) -> bool:
    """Return whether the campaign in a directory owns the results by its path, or because no run has written any.

    Where no owner is recorded, the settings of all runs must name this directory alone.
    """
    owner = read_owner(results)
    if owner is None:
        written = any(any(results.glob(pattern)) for pattern in OF_A_RUN)
        return not written or recorded_directories(results) == {str(directory)}
    with suppress(OSError):
        return os.path.samefile(owner.campaign, directory)  # noqa: PTH121  (texts)
    return owner.campaign == str(directory)


def recorded_directories(results: Path) -> set[str]:
    """Return the folders of recordings that the settings of all runs name; a run deletes no settings."""
    found = set()
    for file in sorted((results / "configs").glob("ingest-*.json")):
        with suppress(PipelineError, KeyError, TypeError):
            found.add(str(read_json(file)["directory"]))
    return found


def write_owner(results: Path, owner: ResultsOwner) -> None:
    """Record the owner of a results folder, unless the record says so already."""
    if owner != read_owner(results):
        write_atomically(results / OWNER_FILE, json.dumps(owner._asdict()))


def record_units(results: Path, units: Mapping[str, list[str]]) -> None:
    """Record the SHA-256 of the recordings of each unit, where the owner is recorded."""
    if owner := read_owner(results):
        write_owner(results, owner._replace(units=dict(units)))


def record_written(results: Path, output: str, again: int) -> None:
    """Record the digest of an output of a job, a path below ``results``.

    ``again``: the number that ``repetitions`` returned at the start of the run.
    """
    record = {"again": again, "files": {"": _digest(_states(results / output))}}
    write_atomically(_record(results, output), json.dumps(record, sort_keys=True))


def _record_published(results: Path, plan: Mapping[str, Any]) -> None:
    """Record the published files and the number of repetitions after a publication, which may be of some files only."""
    exchanged = tuple(f"{path}/" for path in plan["inodes"])
    others = {path: state for path, state in plan["before"].items() if not f"{path}/".startswith(exchanged)}
    record = {"again": plan["again"], "written": others | plan["written"]}
    write_atomically(_record(results, ""), json.dumps(record, sort_keys=True))


def _last_written(results: Path) -> dict[str, str]:
    """Return the state of each file that the last publication wrote, by its path below the results.

    A record of the version before has a digest of each folder: its files count as written while the digest agrees.
    """
    _, record = _read_record(results, "")
    if "written" in record:
        return dict(record["written"])
    same = [name for name, digest in record.get("files", {}).items() if _digest(_states(results / name)) == digest]
    return {path: state for name in same for path, state in _states(results / name, name).items()}


def is_as_written(results: Path, path: str) -> bool:
    """Return whether a published file is as the last publication wrote it."""
    return _last_written(results).get(path) == _state(results / path)


def published_units(results: Path) -> set[str]:
    """Return the units with published files of their own, of which the calibration is always one."""
    _, record = _read_record(results, "")
    paths = record["written"] if "written" in record else _states(results / "calibrations", "calibrations")
    return {unit_of(path) for path in paths if path.startswith("calibrations/")}


def repetitions(results: Path, output: str) -> tuple[int, list[str]]:
    """Return the number of repetitions of an output because of edits, and its files that are edited now.

    ``output``: a path below the results; empty for the published files.
    """
    again, record = _read_record(results, output)
    if not (results / output).exists():
        return again, []  # Snakemake writes a missing output in any case
    digests = {name: _digest(_states(results / output / name)) for name in record.get("files", {})}
    changed = [name for name, digest in digests.items() if digest != record["files"][name]]
    published = {path: s for path, s in record.get("written", {}).items() if path.partition("/")[0] in PUBLISHED_PATHS}
    changed += [path.partition("/")[0] for path, state in published.items() if _state(results / path) != state]
    edited = [os.path.normpath(results / output / name) for name in dict.fromkeys(changed)]
    return again + bool(edited), edited


def _read_record(results: Path, output: str) -> tuple[int, dict[str, Any]]:
    """Return the number of repetitions of an output and its record; 0 and an empty record if it cannot be read."""
    try:
        record = json.loads(_record(results, output).read_text(encoding="utf-8"))
        return int(record["again"]), {key: dict(value) for key, value in record.items() if key != "again"}
    except (OSError, ValueError, KeyError, TypeError):
        return 0, {}


def _record(results: Path, output: str) -> Path:
    return results / "logs" / "written" / f"{output.replace('/', '+') or 'published'}.json"


def _state(file: Path | str) -> str:
    """Return size and time of a file.

    Snakemake sets the time of a pack after its job, so the checksums of its members replace the time.
    """
    try:
        status = os.lstat(file)
    except (FileNotFoundError, NotADirectoryError):
        return "absent"
    is_pack = str(file).endswith(".zip") and stat.S_ISREG(status.st_mode)
    return f"{status.st_size} {directory_of(str(file)) if is_pack else status.st_mtime_ns}"


def _states(path: Path, name: str = "") -> dict[str, str]:
    """Return the state of each file below a folder, or of a file; ``name`` stands for the path itself."""
    files = [str(path)] if path.is_symlink() or not path.is_dir() else []
    for folder, folders, names in [] if files else os.walk(path):
        links = [f for f in folders if os.path.islink(f"{folder}/{f}")]  # noqa: PTH114  (fast)
        files += [f"{folder}/{n}" for n in (*names, *links) if n != SNAKEMAKE_TIMESTAMP]
    start = len(str(path))
    return {f"{name}{file[start:]}".removeprefix("/"): _state(file) for file in files}


def _digest(states: Mapping[str, str]) -> str:
    lines = ["\0".join((f"/{name}" if name else "", *state.split())) for name, state in states.items()]
    return hashlib.sha256("\n".join(sorted(lines)).encode(errors="surrogateescape")).hexdigest()[:32]
