"""Print the progress of a run, its failed jobs and the command that recovers, in addition to Snakemake's log.

    time left = max(sum over jobs of remaining time / parallel jobs, longest running job + one job of each later kind)

where

    remaining time : of a job, remaining units * time per unit - time spent on its current unit
    time per unit  : geometric mean over the jobs of this kind in this run, weighted by their units, with the finished
                     units of running jobs, and with ``PRIOR`` units of ``COST`` times the mean ratio time / ``COST``
    parallel jobs  : sum of the run times of all jobs / time since the first job was started

A job handles a batch of units and writes its current unit to its log: ``stage: unit (3 of 50)``.

The progress line replaces Snakemake's block for each job on the terminal (not with ``--printshellcmds`` or
``--verbose``; Snakemake's log file always has the blocks). A terminal shows a new line each second, other output each
half minute, and ``--quiet`` shows none.
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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TextIO

from pipeline.core.errors import shortened

# Relative time per unit (gather: per run), from data/demo on two cores (``tests/demo_jobs.csv``); "fit effects": from a
# bench of three units. The times of diagnoses in one run differ by a factor of 40, so logarithms are averaged.
COST = {
    "ingest": 1.0, "filter": 0.3, "fit": 0.4, "fit effects": 5.0, "validate": 0.35, "diagnose": 15.0,
    "calibration": 0.85, "export": 0.2, "report": 0.85, "summary": 0.5, "gather": 4.0, "verdict": 0.0, "all": 0.0,
}  # fmt: skip
PRIOR = 40.0  # weight of ``COST``, in units
PER_RUN = ("simulate", "lots", "gather", "thesis", "verdict", "all")  # jobs of every other kind are of a batch
AT_UNIT = re.compile(r"^[\w-]+: (\S+) \((\d+) of (\d+)\)$", re.MULTILINE)
EFFECTS_STAGE_TITLE = "fit effects"
MIN_REMAINING_SHARE = 0.1  # least remaining time of a current unit, as a share of its usual or its elapsed time
LAST_STAGE = "report"  # its units are counted as done
NAMED_JOBS, NAMED_UNITS_OF_RUN = 2, 10
INTERVAL = {True: 1.0, False: 30.0}  # s between lines, on a terminal and elsewhere
CLEAR_LINE = "\r\x1b[K"
EVENTS = ("JOB_INFO", "JOB_STARTED", "JOB_FINISHED", "PROGRESS", "SHELLCMD", "RUN_INFO", "RESOURCES_INFO", "GROUP_INFO")
SCHEDULER_MESSAGES = ("Select jobs to execute", "Execute ")
# Snakemake's reports of a failed job: the last lines of a run state the cause, Snakemake's log has the reports
JOB_FAILURES = ("RuleException", "Exiting because a job", "WorkflowError:\nAt least one job did not complete")
REFUSALS = ("LockException", "ProtectedOutputException")  # Snakemake's errors before any job
INTERRUPTED = ("Terminating processes on user request", "Shutting down, this might take")  # Ctrl-C; SIGTERM


@dataclass
class RunJob:
    """A job of Snakemake: rule, displayed name, batch, number of units, log, start time in s, and duration in s."""

    rule: str
    name: str
    batch: str
    units: int
    log: Path
    since: float
    seconds: float = 0.0

    @property
    def kind(self) -> str:
        """Key of ``COST``."""
        return EFFECTS_STAGE_TITLE if self.rule == "fit" and self.name.endswith("effects") else self.rule

    def current_unit(self) -> tuple[str, int, float] | None:
        """Return name, number and start time of the current unit of the job; None before the first unit."""
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
    """The jobs of a run: units per batch, wanted jobs per kind, running and done jobs, time of failed jobs in s."""

    batches: Mapping[str, int]
    wanted: Counter[str] = field(default_factory=Counter)
    running: dict[int, RunJob] = field(default_factory=dict)
    done: list[RunJob] = field(default_factory=list)
    lost: float = 0.0
    started: float = 0.0
    batches_at_work: list[str] = field(default_factory=list)  # in the order in which their first job was started

    def start(self, number: int, rule: str, wildcards: Mapping[str, str], log: Path) -> None:
        """Note that a job has been started."""
        self.started = self.started or time.monotonic()
        name = " ".join([rule, *(wildcards[w] for w in ("sensor", "stage") if w in wildcards)]).replace("_", " ")
        batch = wildcards.get("batch", "")
        if batch in self.batches and batch not in self.batches_at_work:
            self.batches_at_work.append(batch)
        self.running[number] = RunJob(rule, name, batch, self.batches.get(batch, 1), log, time.time())

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
        """Return the state of the run in one line; a narrow terminal cuts its end."""
        left, units = self._seconds_left(), self._units()
        parts = [f"about {duration(left)} left"] if left else []
        parts.append(f"{len(self.done)} of {sum(self.wanted.values())} jobs")
        units_done = sum(job.units for job in self.done if job.rule == LAST_STAGE)
        parts += [f"{units_done} of {units} units done"] * bool(units)
        current = [(job, position) for job in self.running.values() if (position := job.current_unit())]
        for job, (unit, number, _) in sorted(current, key=lambda entry: -entry[0].since)[:NAMED_JOBS]:
            parts.append(f"{job.name}: {unit} ({number} of {job.units})")
        return " | ".join(parts)

    def _units(self) -> int:
        """Return the number of units of the run: those of the batches whose last stage is wanted.

        Snakemake states how many batches these are. They are those whose last stage was started, then others at work.
        """
        last = [job.batch for job in (*self.done, *self.running.values()) if job.rule == LAST_STAGE]
        batches = list(dict.fromkeys([*last, *self.batches_at_work, *self.batches]))
        return sum(self.batches.get(batch, 1) for batch in batches[: self.wanted.get(LAST_STAGE, 0)])

    def _seconds_left(self) -> float | None:
        """Return the remaining time of the run, s; None until two jobs are done."""
        if len(self.done) < 2:
            return None
        now, measured = time.time(), [(job.kind, job.units, job.seconds) for job in self.done]
        scale = sum(seconds for *_, seconds in measured) / sum(COST.get(kind, 1.0) * n for kind, n, _ in measured)
        current, worked = [], self.lost + sum(job.seconds for job in self.done)
        for job in self.running.values():
            _, number, began = job.current_unit() or ("", 1, job.since)
            current.append((job.kind, job.units - number, now - began))
            measured.append((job.kind, number - 1, began - job.since))
            worked += now - job.since
        usual = {kind: _usual(kind, scale, measured) for kind in {*self.wanted, *(kind for kind, *_ in current)}}
        measured += [(kind, 1, seconds) for kind, _, seconds in current if seconds > usual[kind]]
        usual = {kind: _usual(kind, scale, measured) for kind in usual}
        running = [
            after * usual[kind] + max(usual[kind] - seconds, MIN_REMAINING_SHARE * max(usual[kind], seconds))
            for kind, after, seconds in current
        ]
        waiting = self.wanted - Counter(job.kind for job in (*self.done, *self.running.values()))
        mean_batch = sum(self.batches.values()) / max(len(self.batches), 1)
        per_job = {kind: usual[kind] * (1.0 if kind in PER_RUN else mean_batch) for kind in waiting}
        total = sum(running) + sum(per_job[kind] * count for kind, count in waiting.items())
        parallel_jobs = max(worked / max(time.monotonic() - self.started, 1e-3), 1.0)
        serial = 0.0  # of the jobs that follow each other in one batch
        for kind in waiting.keys() - {kind for kind, *_ in current}:
            at_once = len(self.batches) * (2 if kind.startswith("fit") else 1)
            serial += per_job[kind] * math.ceil(waiting[kind] / at_once)
        return max(total / parallel_jobs, max(running, default=0.0) + serial)


def _usual(kind: str, scale: float, measured: Sequence[tuple[str, int, float]]) -> float:
    """Return the time per unit of a kind of jobs, s, from ``measured``: kind, units and seconds of jobs."""
    of_kind = [(n, seconds / n) for measured_kind, n, seconds in measured if measured_kind == kind and n]
    weighted = [(PRIOR, scale * COST.get(kind, 1.0)), *of_kind]
    logarithm = sum(n * math.log(max(seconds, 1e-3)) for n, seconds in weighted)
    return math.exp(logarithm / sum(n for n, _ in weighted))


def duration(seconds: float) -> str:
    """Return a duration as rounded text."""
    if seconds < 90:
        return f"{max(5 * round(seconds / 5), 5)} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"


class Countdown:
    """Prints the progress and the remaining time of a command: each second on a terminal, elsewhere each half minute.

    ``total``: total amount of work, in units, bytes of a log ...
    """

    def __init__(self, total: float) -> None:
        self.total = total
        self.began = time.monotonic()
        self.printed = float("-inf") if sys.stderr.isatty() else self.began
        self.drawn = False

    def left(self, done: float) -> str:
        """Return the remaining time in words; empty in the first second and at the end."""
        elapsed = time.monotonic() - self.began
        if not 0.0 < done < self.total or elapsed < 1.0:
            return ""
        return f"about {duration(elapsed * (self.total / done - 1.0))} left"

    def __call__(self, done: float, words: str) -> None:
        """Print the amount of work that is done, ``words``, and the remaining time."""
        now, terminal = time.monotonic(), sys.stderr.isatty()
        if now - self.printed < INTERVAL[terminal]:
            return
        self.printed, self.drawn = now, terminal
        text = " | ".join(filter(None, [f"{100.0 * done / max(self.total, 1):.0f} %", self.left(done), words]))
        sys.stderr.write(f"{CLEAR_LINE}{text}" if terminal else f"{text}\n")
        sys.stderr.flush()

    def end(self) -> None:
        """Clear the line."""
        if self.drawn:
            sys.stderr.write(CLEAR_LINE)
            sys.stderr.flush()
            self.drawn = False


def wait_for_jobs(results: Path, stream: TextIO) -> None:
    """Wait until no job of a killed run is running."""
    from pipeline.app.results_folder import jobs_running  # noqa: PLC0415  (locks of POSIX, for runs only)

    while jobs_running(results):
        print("Waiting for jobs of a killed run that are still running ...", file=stream, flush=True)
        time.sleep(2)


class Monitor(logging.Handler):
    """Follows the log records of Snakemake and prints the progress of a run in ``results``.

    Snakemake's interface for logger plugins is not used: it needs a separate top-level package, which Snakemake does
    not find in an editable installation.
    """

    def __init__(self, results: Path, batches: Mapping[str, int], effects: int, logger: logging.Logger) -> None:
        super().__init__()
        self.results = results
        self.effects = effects  # number of stages ``effects`` of all batches and sensors
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
        """Update the progress from a log record of Snakemake."""
        event, fields = _event(record), vars(record)
        if event == "RUN_INFO":
            wanted = Counter({k: v for k, v in fields["stats"].items() if k != "total"})
            effects = min(self.effects, wanted["fit"])  # last stage of its chain: it runs if any stage does
            self.progress.wanted = wanted + Counter({EFFECTS_STAGE_TITLE: effects}) - Counter({"fit": effects})
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
        """Lock the results, wait for jobs of a killed run, and start to print the progress.

        Raises ``BusyError`` if another run has locked the results.
        """
        from pipeline.app.results_folder import take_run  # noqa: PLC0415  (locks of POSIX, for runs only)

        take_run(self.results)
        wait_for_jobs(self.results, self.stream)
        terminal = self.stream.isatty() and not plain
        if quiet or not plain:
            self._filter_job_blocks(CLEAR_LINE if terminal and not quiet else "")
        if not quiet:
            threading.Thread(target=self._print_progress, kwargs={"terminal": terminal}, daemon=True).start()

    def print_edited(self, edited: Sequence[str]) -> None:
        """Print the files that are computed again because they were edited or deleted."""
        if edited:
            lines = "".join(f"\n  {line}" for line in shortened(edited, NAMED_UNITS_OF_RUN))
            print(f"Changed or deleted since the last run, computed again:{lines}", file=self.stream, flush=True)

    def print_recovery(self) -> None:
        """Print the failed jobs and the command that recovers, after Snakemake's last message."""
        self.ended.set()
        command = shlex.join(["snakemake", *sys.argv[1:]])
        lines = []
        if self.refused == "ProtectedOutputException":
            lines += [f"\n{self.results} cannot be written; make it writable, then:", f"  {command}"]
        if self.refused == "LockException":
            unlock = shlex.join(["snakemake", "--unlock", *sys.argv[1:]])
            wait = "\nAnother run uses this directory, or one was killed here. Wait until it has ended, then:"
            lines += [wait, f"  {command}", "If no run is active:", f"  {unlock} && {command}"]
        if self.interrupted or getattr(sys, "last_type", None) is KeyboardInterrupt:
            lines += ["\nThe run was interrupted. Finished jobs are kept, the others start again. To continue:"]
            lines += [f"  {command}"]
        elif self.failed:
            count = f"{len(self.failed)} job{'s' * (len(self.failed) > 1)}"
            lines += [f"\n{count} failed; incomplete output is removed, all other jobs are done:"]
            causes = [f"{rule}: {_cause(log)} (all of it: {log})" for rule, log in self.failed]
            lines += [f"  {line}" for line in shortened(causes, NAMED_UNITS_OF_RUN)]
            lines += ["Correct the cause, then run the same command again:", f"  {command}"]
        if lines:
            print("\n".join(lines), file=self.stream)

    def _filter_job_blocks(self, clear: str) -> None:
        """Suppress Snakemake's block for each job, and clear the progress line before its other messages."""

        def passes(record: logging.LogRecord) -> bool:
            text = str(record.msg)
            if _event(record) in (*EVENTS, "JOB_ERROR") or text.startswith((*SCHEDULER_MESSAGES, *JOB_FAILURES)):
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
            line = f"{self.progress.text()} | {minutes}:{seconds:02d} since the start"
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
    units = AT_UNIT.findall(last)
    return f"killed at unit {units[-1][0]}" if units else last or "killed, or could not be started"
