"""One run of a campaign's results at a time, from whatever directory, machine or account it is started.

A run holds ``<results>/.run.lock`` while it lasts; each of its jobs holds a share of ``<results>/.jobs.lock``. The
kernel takes a lock away with its process, however that ends: so a lock that is held is no left-over. Where the file
system has no locks, nothing is held and nothing is refused.
"""

from __future__ import annotations

import fcntl
import os
import socket
from typing import IO, TYPE_CHECKING

from pipeline.errors import PipelineError

if TYPE_CHECKING:
    from pathlib import Path

RUN, JOBS = ".run.lock", ".jobs.lock"
HELD: list[IO[str]] = []  # open until the process ends


class BusyError(PipelineError):
    """Another run works on the same results."""

    code = "busy"


def take_run(results: Path) -> None:
    """Hold the results of a campaign for this run.

    Raises
    ------
    BusyError
        Naming the process that holds them.
    """
    stream = _open(results / RUN)
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
    with _open(results / JOBS) as stream:
        return not _locked(stream, fcntl.LOCK_EX)


def hold_as_job(results: Path) -> None:
    """Show, while this process lives, that a job works on a campaign's results."""
    if results.is_dir():
        stream = _open(results / JOBS)
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
