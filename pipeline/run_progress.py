"""What the terminal shows of a run in addition to Snakemake's log: progress, failed jobs, the command that recovers.

    time left = max(sum over jobs of seconds left / jobs at a time, longest running job + one of each later kind)

where

    seconds left   : of a job, units left * seconds a unit, less what the unit at work has taken
    seconds a unit : geometric mean over the jobs of this kind in this run, weighted by their units, also of what
                     running ones have done; and over ``PRIOR`` units of ``COST`` times the usual ratio to ``COST``
    jobs at a time : seconds that jobs have worked / seconds since the first was started

A job handles a batch of units and writes to its log which one it is at: ``stage: unit (3 of 50)``.

The line stands instead of Snakemake's blocks for each job (``--printshellcmds`` and ``--verbose`` keep those, and
Snakemake's log file always has them). On a terminal it is redrawn each second; elsewhere it is printed each half
minute, with ``--quiet`` not at all.
"""

from __future__ import annotations

import atexit
import logging
import math
import os
import re
import shlex
import sys
import threading
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from pipeline.errors import first
from pipeline.results_folder import jobs_at_work, take_run

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

# Relative seconds a unit, of gather a run: data/demo on two cores (``tests/demo_jobs.csv``); "fit effects": the stage
# of this name, in a bench of three units. Diagnoses of one run differ by a factor of 40: their logarithms are averaged.
COST = {
    "ingest": 1.0, "filter": 0.3, "fit": 0.4, "fit effects": 5.0, "validate": 0.35, "diagnose": 15.0,
    "calibration": 0.85, "export": 0.2, "report": 0.85, "summary": 0.5, "gather": 4.0, "verdict": 0.0, "all": 0.0,
}  # fmt: skip
PRIOR = 40.0  # units that ``COST`` counts as
PER_BATCH = (
    "collect", "ingest", "filter", "fit", "fit effects", "validate", "diagnose", "calibration", "export", "report",
    "summary", "prior",
)  # fmt: skip
AT_UNIT = re.compile(r"^[\w-]+: (\S+) \((\d+) of (\d+)\)$", re.MULTILINE)
EFFECTS = "fit effects"
SOON = 0.1  # of the usual time of a unit, or of what it has taken: what is left at least of one at work
LAST_STAGE = "report"  # its units are counted as done
NAMED_JOBS, NAMED = 2, 10
INTERVAL = {True: 1.0, False: 30.0}  # s between lines, by whether it is a terminal
CLEAR_LINE = "\r\x1b[K"
BLOCKS = ("JOB_INFO", "JOB_STARTED", "JOB_FINISHED", "PROGRESS", "SHELLCMD", "RUN_INFO", "RESOURCES_INFO", "GROUP_INFO")
SCHEDULER_MESSAGES = ("Select jobs to execute", "Execute ")
REFUSALS = ("LockException", "ProtectedOutputException")  # of Snakemake, before any job
INTERRUPTED = ("Terminating processes on user request", "Shutting down, this might take")  # Ctrl-C; SIGTERM


@dataclass
class Job:
    """A job of Snakemake: rule, displayed name, number of units, log, start time in s, and how long it took in s."""

    rule: str
    name: str
    units: int
    log: Path
    since: float
    seconds: float = 0.0

    @property
    def kind(self) -> str:
        """Key of ``COST``."""
        return EFFECTS if self.rule == "fit" and self.name.endswith("effects") else self.rule

    def at(self) -> tuple[str, int, float] | None:
        """Return the unit that the job is at, its number, and when it began with it; None before the first."""
        try:
            with self.log.open("rb") as stream:
                stream.seek(max(os.fstat(stream.fileno()).st_size - 2000, 0))
                found = AT_UNIT.findall(stream.read().decode(errors="replace"))
            began = self.log.stat().st_mtime
        except OSError:
            return None
        return (found[-1][0], int(found[-1][1]), began) if found and began >= self.since - 1.0 else None


@dataclass
class Progress:
    """The jobs of a run: units of each batch, jobs wanted of each kind, running, done, and s that failed ones took."""

    batches: Mapping[str, int]
    wanted: Counter[str] = field(default_factory=Counter)
    running: dict[int, Job] = field(default_factory=dict)
    done: list[Job] = field(default_factory=list)
    lost: float = 0.0
    started: float = 0.0

    def start(self, number: int, rule: str, wildcards: Mapping[str, str], log: Path) -> None:
        """Note that a job has been started."""
        self.started = self.started or time.monotonic()
        name = " ".join([rule, *(wildcards[w] for w in ("sensor", "stage") if w in wildcards)]).replace("_", " ")
        self.running[number] = Job(rule, name, self.batches.get(wildcards.get("batch", ""), 1), log, time.time())

    def finish(self, number: int, *, failed: bool = False) -> None:
        """Note that a job has ended."""
        job = self.running.pop(number, None)
        if job is None:
            return
        job.seconds = time.time() - job.since
        if failed:
            self.lost += job.seconds
        else:
            self.done.append(job)

    def text(self) -> str:
        """Return the state of the run in one line."""
        units_done = sum(job.units for job in self.done if job.rule == LAST_STAGE)
        units = round(self.wanted.get(LAST_STAGE, 0) * self._mean_batch())
        parts = [f"{len(self.done)} of {sum(self.wanted.values())} jobs"]
        parts += [f"{units_done} of {units} units done"] * bool(units)
        at = [(job, where) for job in self.running.values() if (where := job.at())]
        for job, (unit, number, _) in sorted(at, key=lambda a: -a[0].since)[:NAMED_JOBS]:
            parts.append(f"{job.name}: {unit} ({number} of {job.units})")
        left = self._seconds_left()
        return " | ".join([*parts, *([f"about {duration(left)} left"] if left else [])])

    def _seconds_left(self) -> float | None:
        """Return the time that the rest will take, s; None until two jobs are done."""
        if len(self.done) < 2:
            return None
        now, measured = time.time(), [(job.kind, job.units, job.seconds) for job in self.done]
        scale = sum(seconds for *_, seconds in measured) / sum(COST.get(kind, 1.0) * n for kind, n, _ in measured)
        at_work, worked = [], self.lost + sum(job.seconds for job in self.done)
        for job in self.running.values():
            _, number, began = job.at() or ("", 1, job.since)
            at_work.append((job.kind, job.units - number, now - began))
            measured.append((job.kind, number - 1, began - job.since))
            worked += now - job.since
        usual = {kind: _usual(kind, scale, measured) for kind in {*self.wanted, *(kind for kind, *_ in at_work)}}
        measured += [(kind, 1, seconds) for kind, _, seconds in at_work if seconds > usual[kind]]
        usual = {kind: _usual(kind, scale, measured) for kind in usual}
        running = [
            after * usual[k] + max(usual[k] - seconds, SOON * max(usual[k], seconds)) for k, after, seconds in at_work
        ]
        to_come = self.wanted - Counter(job.kind for job in (*self.done, *self.running.values()))
        a_job = {kind: usual[kind] * (self._mean_batch() if kind in PER_BATCH else 1.0) for kind in to_come}
        whole = sum(running) + sum(a_job[kind] * count for kind, count in to_come.items())
        jobs_at_a_time = max(worked / max(time.monotonic() - self.started, 1e-3), 1.0)
        beside = {kind for kind, *_ in at_work}  # what other batches are at
        in_turn = sum(a_job[kind] * self._in_turn(kind, count) for kind, count in to_come.items() if kind not in beside)
        return max(whole / jobs_at_a_time, max(running, default=0.0) + in_turn)

    def _in_turn(self, kind: str, count: int) -> int:
        """Return how many of so many jobs come one after the other in a batch."""
        return math.ceil(count / (len(self.batches) * (2 if kind.startswith("fit") else 1)))

    def _mean_batch(self) -> float:
        return sum(self.batches.values()) / max(len(self.batches), 1)


def _usual(kind: str, scale: float, measured: Sequence[tuple[str, int, float]]) -> float:
    """Return the seconds a unit of a kind of jobs, by units and seconds of some jobs."""
    own = [(n, seconds / n) for of, n, seconds in measured if of == kind and n]
    known = [(PRIOR, scale * COST.get(kind, 1.0)), *own]
    logarithm = sum(n * math.log(max(seconds, 1e-3)) for n, seconds in known)
    return math.exp(logarithm / sum(n for n, _ in known))


def duration(seconds: float) -> str:
    """Return a duration, rounded as it is read."""
    if seconds < 90:
        return f"{max(5 * round(seconds / 5), 5)} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"


class Countdown:
    """How far a command of one process is, and how long it will take: a line that is redrawn on a terminal.

    Elsewhere a line is printed each half minute. ``total``: of what is counted, such as units, or bytes of a log.
    """

    def __init__(self, total: float) -> None:
        self.total = total
        self.began = time.monotonic()
        self.told = float("-inf") if sys.stderr.isatty() else self.began
        self.drawn = False

    def left(self, done: float) -> str:
        """Return the time left in words; empty in the first second and at the end."""
        elapsed = time.monotonic() - self.began
        if not 0.0 < done < self.total or elapsed < 1.0:
            return ""
        return f"about {duration(elapsed * (self.total / done - 1.0))} left"

    def __call__(self, done: float, words: str) -> None:
        """Tell how much is done, in words, and how long the rest will take."""
        now, terminal = time.monotonic(), sys.stderr.isatty()
        if now - self.told < INTERVAL[terminal]:
            return
        self.told, self.drawn = now, terminal
        text = " | ".join(filter(None, [f"{100.0 * done / max(self.total, 1):.0f} %", words, self.left(done)]))
        sys.stderr.write(f"{CLEAR_LINE}{text}" if terminal else f"{text}\n")
        sys.stderr.flush()

    def end(self) -> None:
        """Clear the line."""
        if self.drawn:
            sys.stderr.write(CLEAR_LINE)
            sys.stderr.flush()
            self.drawn = False


class Monitor(logging.Handler):
    """Follows the log records of Snakemake and prints the progress of a run in ``results``.

    Snakemake's interface for logger plugins is not used: it needs a top-level package of its own, which Snakemake does
    not find in an editable installation.
    """

    def __init__(self, results: Path, batches: Mapping[str, int], effects: int, logger: logging.Logger) -> None:
        super().__init__()
        self.results = results
        self.effects = effects  # stages ``effects`` of all batches and sensors
        self.progress = Progress(batches)
        self.logger = logger
        self.failed: list[tuple[str, Path]] = []
        self.refused = ""
        self.interrupted = False
        self.ended = threading.Event()
        self.nothing_to_do: Callable[[], None] = lambda: None
        self.stream: TextIO = sys.stderr
        logger.addHandler(self)
        atexit.register(self.print_recovery)

    def emit(self, record: logging.LogRecord) -> None:
        """Note a record of Snakemake."""
        event, fields = _event(record), vars(record)
        if event == "RUN_INFO":
            wanted = Counter({k: v for k, v in fields["stats"].items() if k != "total"})
            effects = min(self.effects, wanted["fit"])  # the last stage of its chain, so again where any is
            self.progress.wanted = wanted + Counter({EFFECTS: effects}) - Counter({"fit": effects})
        elif event == "JOB_INFO":
            log = Path((fields["log"] or [os.devnull])[0])
            self.progress.start(fields["jobid"], fields["rule_name"], dict(fields["wildcards"] or {}), log)
        elif event == "JOB_FINISHED":
            self.progress.finish(fields["job_id"])
        elif event == "JOB_ERROR":
            self.progress.finish(fields.get("jobid", -1), failed=True)
            if fields.get("rule_name") != "verdict":
                self.failed.append((str(fields.get("rule_name")), Path((fields.get("log") or [os.devnull])[0])))
        elif str(record.msg).startswith("Nothing to be done"):
            self.nothing_to_do()
        elif str(record.msg).startswith(INTERRUPTED):
            self.interrupted = True
        elif record.levelno >= logging.ERROR:
            self.refused = next((name for name in REFUSALS if name in str(record.msg)), self.refused)

    def begin(self, *, quiet: bool, plain: bool) -> None:
        """Hold the results, wait for jobs that a killed run has left, and start to print the progress.

        Raises ``BusyError`` if another run holds the results.
        """
        take_run(self.results)
        while jobs_at_work(self.results):
            print("Waiting for jobs of a killed run that are still running ...", file=self.stream, flush=True)
            time.sleep(2)
        terminal = self.stream.isatty() and not plain
        if quiet or not plain:
            self._filter_job_blocks(CLEAR_LINE if terminal and not quiet else "")
        if not quiet:
            threading.Thread(target=self._print_progress, kwargs={"terminal": terminal}, daemon=True).start()

    def print_edited(self, edited: Sequence[str]) -> None:
        """Print which files were edited or deleted since they were made, and are made again."""
        if edited:
            lines = [
                "Changed or deleted since the last run, computed again:",
                *(f"  {line}" for line in first(edited, NAMED)),
            ]
            print("\n".join(lines), file=self.stream, flush=True)

    def print_recovery(self) -> None:
        """Print, after Snakemake's last message, what failed and the command that recovers."""
        self.ended.set()
        command = shlex.join(["snakemake", *sys.argv[1:]])
        lines = []
        if self.refused == "ProtectedOutputException":
            lines += [f"\n{self.results} cannot be written; make it writable, then:", f"  {command}"]
        if self.refused == "LockException":
            unlock = shlex.join(["snakemake", "--unlock", *sys.argv[1:]])
            lines += [
                "\nAnother run uses this directory, or one was killed here. Wait until it has ended, then:",
                f"  {command}",
                "If no run is active:",
                f"  {unlock} && {command}",
            ]
        if self.interrupted or getattr(sys, "last_type", None) is KeyboardInterrupt:
            lines += ["\nThe run was interrupted. Finished jobs are kept, the others start again. To continue:"]
            lines += [f"  {command}"]
        elif self.failed:
            count = f"{len(self.failed)} job{'s' * (len(self.failed) > 1)}"
            lines += [f"\n{count} failed; incomplete output is removed, all other jobs are done:"]
            causes = [f"{rule}: {_cause(log)} (all of it: {log})" for rule, log in self.failed]
            lines += [f"  {line}" for line in first(causes, NAMED)]
            lines += ["Correct the cause, then run the same command again:", f"  {command}"]
        if lines:
            print("\n".join(lines), file=self.stream)

    def _filter_job_blocks(self, clear: str) -> None:
        """Suppress Snakemake's block for each job on the terminal, and clear our line before its other messages."""

        def passes(record: logging.LogRecord) -> bool:
            if _event(record) in BLOCKS or str(record.msg).startswith(SCHEDULER_MESSAGES):
                return False
            self.stream.write(clear)
            return True

        for handler in self.logger.handlers:
            if getattr(handler, "stream", None) in (sys.stdout, sys.stderr) and handler is not self:
                handler.addFilter(passes)

    def _print_progress(self, *, terminal: bool) -> None:
        start = time.monotonic()
        while not self.ended.wait(INTERVAL[terminal]):
            minutes, seconds = divmod(round(time.monotonic() - start), 60)
            line = f"[{minutes}:{seconds:02d}] {self.progress.text()}"
            if terminal:
                line = CLEAR_LINE + line[: (os.get_terminal_size(self.stream.fileno()).columns or 80) - 1]
            self.stream.write(line + "\n" * (not terminal))
            self.stream.flush()
        if terminal:
            self.stream.write(CLEAR_LINE)
            self.stream.flush()


def _event(record: logging.LogRecord) -> str:
    return str(getattr(getattr(record, "event", None), "name", ""))


def _cause(log: Path) -> str:
    try:
        lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    except OSError as error:
        return f"its log cannot be read ({error.strerror})"
    last = next((line for line in reversed(lines) if line.strip()), "")
    at = AT_UNIT.findall(last)
    return f"killed at unit {at[-1][0]}" if at else last or "killed, or could not be started"
