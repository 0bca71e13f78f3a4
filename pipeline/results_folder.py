"""The results folder of a campaign: one run at a time, published files replaced as one set, edited files detected.

Locks
    A run holds an exclusive lock on ``.run.lock`` and each of its jobs a shared lock on ``.jobs.lock``. The kernel
    releases a lock when its process ends, so no stale lock can remain. A file system without locks refuses nothing.
Publishing
    A new set of files is written to a separate folder, which is renamed to ``.published`` when it is complete. Each of
    its files and folders is then exchanged with the published one of the same name. The next run completes an
    interrupted exchange.
Edited files
    Snakemake does not repeat a job whose output was edited. Each job therefore records in ``logs/written/`` a digest of
    its output and the number of repetitions because the output was edited:
    ``{"again": 0, "files": {"": "5f70bf18..."}}``. ``again`` is part of the settings of the job, so a larger number
    makes Snakemake repeat it. A folder without a record is accepted.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import shutil
import signal
import socket
from typing import IO, TYPE_CHECKING

from pipeline.errors import PipelineError
from pipeline.files import exchange, flush_file_system, write_atomically
from pipeline.pack import directory_of

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

PUBLISHED = (
    "calibrations", "validations", "diagnoses", "reports", "certificates", "exports", "combined", "packs",
    "index.html", "summary.csv", "failures.json", "parameters.parquet", "fleet.json",
)  # fmt: skip
RUN_LOCK, JOBS_LOCK = ".run.lock", ".jobs.lock"
COMPLETE, PLAN = ".published", ".plan.json"
DELAYED_SIGNALS = {signal.SIGINT, signal.SIGTERM}  # blocked during the exchange, which takes milliseconds
SNAKEMAKE_TIMESTAMP = ".snakemake_timestamp"  # Snakemake writes it into every output folder
HELD: list[IO[str]] = []  # locks, open until the process ends


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
    HELD.append(stream)


def jobs_running(results: Path) -> bool:
    """Return whether jobs of a killed run are still running."""
    with _open(results / JOBS_LOCK) as stream:
        return not _locked(stream, fcntl.LOCK_EX)


def hold_as_job(results: Path) -> None:
    """Mark the results of a campaign as used by a job until this process ends."""
    if results.is_dir():
        stream = _open(results / JOBS_LOCK)
        _locked(stream, fcntl.LOCK_SH)
        HELD.append(stream)


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


def publish_all(new: Path, results: Path) -> None:
    """Replace the published files by the complete set in ``new``, a folder below ``results``; remove ``new``."""
    inodes = {item.name: item.lstat().st_ino for item in new.iterdir()}
    write_atomically(new / PLAN, json.dumps(inodes))
    flush_file_system(results)
    new.rename(results / COMPLETE)
    finish_publishing(results)


def finish_publishing(results: Path) -> None:
    """Complete an interrupted exchange, if there is one."""
    complete = results / COMPLETE
    if not (complete / PLAN).is_file():
        shutil.rmtree(complete, ignore_errors=True)
        return
    inodes = json.loads((complete / PLAN).read_text(encoding="utf-8"))
    before = signal.pthread_sigmask(signal.SIG_BLOCK, DELAYED_SIGNALS)
    try:
        for name, inode in inodes.items():
            published = results / name
            if not os.path.lexists(published):
                (complete / name).rename(published)
            elif published.lstat().st_ino != inode:
                exchange(complete / name, published)
        (complete / PLAN).unlink()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    shutil.rmtree(complete)


def record_written(results: Path, output: str, again: int, names: Sequence[str] = ("",)) -> None:
    """Record the digests of the files that a job wrote to ``output``, below ``results``.

    ``again``: the number that ``repetitions`` returned at the start of the run; ``names``: files and folders below
    ``output``, or ``""`` for the whole output.
    """
    files = {name: _digest(results / output / name) for name in names}
    write_atomically(_record(results, output), json.dumps({"again": again, "files": files}, sort_keys=True))


def repetitions(results: Path, output: str) -> tuple[int, list[str]]:
    """Return the number of repetitions of an output because of edits, and its files that are edited now."""
    try:
        record = json.loads(_record(results, output).read_text(encoding="utf-8"))
        again, files = int(record["again"]), dict(record["files"])
    except (OSError, ValueError, KeyError, TypeError):
        return 0, []
    if not (results / output).exists():
        return again, []  # Snakemake writes a missing output in any case
    paths = {results / output / name: digest for name, digest in files.items()}
    edited = [os.path.normpath(path) for path, digest in paths.items() if _digest(path) != digest]
    return again + bool(edited), edited


def _record(results: Path, output: str) -> Path:
    return results / "logs" / "written" / f"{output.replace('/', '+') or 'published'}.json"


def _digest(path: Path) -> str:
    """Return a digest of the names, sizes and times of a file, or of all files below a folder.

    Snakemake sets the time of a pack after its job, so the checksums of its members replace the time.
    """
    files = [f"{folder}/{name}" for folder, _, names in os.walk(path) for name in names]
    lines = []
    for file in files if path.is_dir() else [str(path)]:
        if not file.endswith(SNAKEMAKE_TIMESTAMP):
            try:
                status = os.lstat(file)
                version = directory_of(file) if file.endswith(".zip") else status.st_mtime_ns
                state = f"{status.st_size}\0{version}"
            except FileNotFoundError:
                state = "absent"
            lines.append(f"{file}\0{state}")
    text = "\n".join(sorted(lines)).replace(str(path), "")  # results may be moved
    return hashlib.sha256(text.encode(errors="surrogateescape")).hexdigest()[:32]
