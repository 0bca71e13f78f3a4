"""The results folder of a campaign: one run at a time, published files replaced as one set, edited files detected.

Locks
    A run holds ``.run.lock`` while it lasts; each of its jobs holds a share of ``.jobs.lock``. The kernel releases a
    lock when its process ends, so a held lock is never a left-over. A file system without locks refuses nothing.
Publishing
    A new set of files is written to a folder of its own, which is renamed to ``.published`` when it is complete. Each
    of its files and folders is then exchanged with the published one of the same name. The next run completes an
    exchange that was interrupted.
Edited files
    Snakemake does not repeat a job whose output was edited. So each job records in ``logs/written/`` a digest of what
    it wrote, and how often it was repeated because that differed:
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
DELAYED_SIGNALS = {signal.SIGINT, signal.SIGTERM}  # they wait until the exchange is complete: milliseconds
SNAKEMAKE_TIMESTAMP = ".snakemake_timestamp"  # Snakemake writes it into every output folder
HELD: list[IO[str]] = []  # locks, open until the process ends


class BusyError(PipelineError):
    """Another run works on the same results."""

    code = "busy"


def take_run(results: Path) -> None:
    """Hold the results of a campaign for this run; raises ``BusyError`` naming the process that holds them."""
    stream = _open(results / RUN_LOCK)
    if not _locked(stream, fcntl.LOCK_EX):
        other = stream.read().strip() or "a process that is not known"
        stream.close()
        raise BusyError(f"another run works on these results ({other}); wait until it has ended", str(results))
    stream.truncate(0)
    stream.write(f"process {os.getpid()} on {socket.gethostname()}")
    stream.flush()
    HELD.append(stream)


def jobs_at_work(results: Path) -> bool:
    """Return whether jobs of a run that was killed are still at work."""
    with _open(results / JOBS_LOCK) as stream:
        return not _locked(stream, fcntl.LOCK_EX)


def hold_as_job(results: Path) -> None:
    """Show, while this process lives, that a job works on a campaign's results."""
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
    """Replace the published files by the complete set in ``new``, a folder below ``results``, which is removed."""
    inodes = {item.name: item.lstat().st_ino for item in new.iterdir()}
    write_atomically(new / PLAN, json.dumps(inodes))
    flush_file_system(results)
    new.rename(results / COMPLETE)
    finish_publishing(results)


def finish_publishing(results: Path) -> None:
    """Complete an exchange that was begun, if there is one."""
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
    """Record the digests of what a job wrote to ``output``, below ``results``.

    ``again``: as ``repetitions`` returned when the run was started; ``names``: files and folders below the output, the
    output itself where all of it is the job's.
    """
    files = {name: _digest(results / output / name) for name in names}
    write_atomically(_record(results, output), json.dumps({"again": again, "files": files}, sort_keys=True))


def repetitions(results: Path, output: str) -> tuple[int, list[str]]:
    """Return how often an output has been repeated because it was edited, and which of its files are edited now."""
    try:
        record = json.loads(_record(results, output).read_text(encoding="utf-8"))
        again, files = int(record["again"]), dict(record["files"])
    except (OSError, ValueError, KeyError, TypeError):
        return 0, []
    if not (results / output).exists():
        return again, []  # Snakemake makes it in any case
    paths = {results / output / name: digest for name, digest in files.items()}
    edited = [os.path.normpath(path) for path, digest in paths.items() if _digest(path) != digest]
    return again + bool(edited), edited


def _record(results: Path, output: str) -> Path:
    return results / "logs" / "written" / f"{output.replace('/', '+') or 'published'}.json"


def _digest(path: Path) -> str:
    """Return a digest of the names, sizes and times of a file, or of all files below a folder.

    Snakemake sets the time of a pack after its job: the checksums of its members stand for it.
    """
    files = [f"{folder}/{name}" for folder, _, names in os.walk(path) for name in names]
    lines = []
    for file in files if path.is_dir() else [str(path)]:
        if not file.endswith(SNAKEMAKE_TIMESTAMP):
            try:
                found = os.lstat(file)
                last = directory_of(file) if file.endswith(".zip") else found.st_mtime_ns
                state = f"{found.st_size}\0{last}"
            except FileNotFoundError:
                state = "absent"
            lines.append(f"{file}\0{state}")
    text = "\n".join(sorted(lines)).replace(str(path), "")  # results may be moved
    return hashlib.sha256(text.encode(errors="surrogateescape")).hexdigest()[:32]
