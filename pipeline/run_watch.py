"""What a person is told of a run, beside Snakemake's own log: how far it is, what broke, and the command that recovers.

Snakemake tells of its jobs by log records; this handler listens to them. On a terminal one line is drawn again each
second in place of Snakemake's blocks for each job (``--printshellcmds`` or ``--verbose`` bring those back, and the file
that Snakemake names at the end always has them); in a log a line is printed each half minute; with ``--quiet`` none.
"""

from __future__ import annotations

import atexit
import logging
import os
import shlex
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from pipeline.locks import jobs_at_work, take_run
from pipeline.progress import AT_UNIT, Progress

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

EVERY = {True: 1.0, False: 30.0}  # s between lines, by whether it is a terminal
BLOCKS = ("JOB_INFO", "JOB_STARTED", "JOB_FINISHED", "PROGRESS", "SHELLCMD", "RUN_INFO", "RESOURCES_INFO", "GROUP_INFO")
REFUSALS = ("LockException", "ProtectedOutputException")  # of Snakemake, before any job
INTERRUPTED = ("Terminating processes on user request", "Shutting down, this might take")  # Ctrl-C; SIGTERM
CHATTER = ("Select jobs to execute", "Execute ")
CLEAR = "\r\x1b[K"


class Watch(logging.Handler):
    """Listens to Snakemake and tells how far a run is.

    Parameters
    ----------
    results : str
        Of the campaign.
    batches : mapping of str to int
        Batch to its number of units.
    """

    def __init__(self, results: str, batches: Mapping[str, int]) -> None:
        super().__init__()
        self.results = Path(results)
        self.progress = Progress(batches)
        self.broken: list[tuple[str, Path]] = []
        self.refused = ""
        self.interrupted = False
        self.ended = threading.Event()
        self.idle: Callable[[], None] = lambda: None  # called where there is nothing to be done
        self.stream: TextIO = sys.stderr
        logging.getLogger("snakemake.logging").addHandler(self)
        atexit.register(self.last_words)

    def emit(self, record: logging.LogRecord) -> None:
        """Note what Snakemake says."""
        event, told = _event(record), vars(record)
        if event == "RUN_INFO":
            self.progress.wanted = {k: v for k, v in told["stats"].items() if k != "total"}
        elif event == "JOB_INFO":
            log = Path((told["log"] or [os.devnull])[0])
            self.progress.start(told["jobid"], told["rule_name"], dict(told["wildcards"] or {}), log)
        elif event == "JOB_FINISHED":
            self.progress.finish(told["job_id"])
        elif event == "JOB_ERROR":
            self.progress.finish(told.get("jobid", -1), failed=True)
            if told.get("rule_name") != "verdict":
                self.broken.append((str(told.get("rule_name")), Path((told.get("log") or [os.devnull])[0])))
        elif str(record.msg).startswith("Nothing to be done"):
            self.idle()
        elif str(record.msg).startswith(INTERRUPTED):
            self.interrupted = True
        elif record.levelno >= logging.ERROR:
            self.refused = next((name for name in REFUSALS if name in str(record.msg)), self.refused)

    def begin(self, *, quiet: bool, plain: bool) -> None:
        """Hold the results, wait for jobs that a killed run has left behind, and begin to tell.

        Raises
        ------
        BusyError
            If another run holds the results.
        """
        take_run(self.results)
        while jobs_at_work(self.results):
            print("Waiting for jobs that a killed run has left at work ...", file=self.stream, flush=True)
            time.sleep(2)
        terminal = self.stream.isatty() and not plain
        if terminal or quiet:
            self._calm_snakemake(CLEAR if terminal and not quiet else "")
        if not quiet:
            threading.Thread(target=self._tell, kwargs={"terminal": terminal}, daemon=True).start()

    def tell_changed(self, changed: Sequence[str]) -> None:
        """Say which files were changed or deleted since they were made, and are made again."""
        if changed:
            more = [f"  and {len(changed) - 10} more"] * (len(changed) > 10)
            lines = ["Changed or deleted since the last run, made again:", *(f"  {c}" for c in changed[:10]), *more]
            print("\n".join(lines), file=self.stream, flush=True)

    def last_words(self) -> None:
        """Say what broke and which command recovers, after everything that Snakemake says."""
        self.ended.set()
        command = shlex.join(["snakemake", *sys.argv[1:]])
        if self.refused == "ProtectedOutputException":
            print(f"\n{self.results} cannot be written; make it writable, and then:\n  {command}", file=self.stream)
        if self.refused == "LockException":
            unlock = shlex.join(["snakemake", "--unlock", *sys.argv[1:]])
            print(
                f"\nAnother run works in this directory, or one was killed here. Wait until it has ended, and then:\n"
                f"  {command}\nIf none is at work:\n  {unlock} && {command}",
                file=self.stream,
            )
        if self.interrupted or getattr(sys, "last_type", None) is KeyboardInterrupt:
            print(
                f"\nThe run was interrupted. Finished jobs are kept, others begin anew. To continue:\n  {command}",
                file=self.stream,
            )
        elif self.broken:
            lines = [f"\n{len(self.broken)} jobs broke; what they had begun is removed, all others are done:"]
            lines += [f"  {rule}: {_cause(log)} (all of it: {log})" for rule, log in self.broken[:10]]
            lines += [f"  and {len(self.broken) - 10} more"] * (len(self.broken) > 10)
            lines += ["Mend the cause, then run the same command again:", f"  {command}"]
            print("\n".join(lines), file=self.stream)

    def _calm_snakemake(self, clear: str) -> None:
        """Leave out Snakemake's blocks on each job, and clear our line before what it prints else."""

        def pass_on(record: logging.LogRecord) -> bool:
            if _event(record) in BLOCKS or str(record.msg).startswith(CHATTER):
                return False
            self.stream.write(clear)
            return True

        for handler in logging.getLogger("snakemake.logging").handlers:
            if handler.name == "DefaultStreamHandler":
                handler.addFilter(pass_on)

    def _tell(self, *, terminal: bool) -> None:
        start = time.monotonic()
        while not self.ended.wait(EVERY[terminal]):
            minutes, seconds = divmod(round(time.monotonic() - start), 60)
            line = f"[{minutes}:{seconds:02d}] {self.progress.text()}"
            if terminal:
                line = CLEAR + line[: (os.get_terminal_size(self.stream.fileno()).columns or 80) - 1]
            self.stream.write(line + "\n" * (not terminal))
            self.stream.flush()
        if terminal:
            self.stream.write(CLEAR)
            self.stream.flush()


def _event(record: logging.LogRecord) -> str:
    event: Any = getattr(record, "event", None)
    return str(getattr(event, "name", ""))


def _cause(log: Path) -> str:
    """Return the last line of a job's log."""
    try:
        lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    except OSError as error:
        return f"its log cannot be read ({error.strerror})"
    said = [line for line in lines if line.strip()]
    at = AT_UNIT.findall(said[-1]) if said else []
    return f"killed at unit {at[-1][0]}" if at else said[-1] if said else "killed, or could not be started"
