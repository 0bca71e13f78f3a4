"""How far a run is: which unit and stage is at work, how many units are done, how long it will take.

    time left = sum over stages of (units left * seconds a unit) / jobs at a time

where

    seconds a unit : of the stage's own jobs in this run so far; for a stage that has not run yet ``COST``, scaled by
                     what the stages seen so far took against their ``COST``
    jobs at a time : seconds that jobs have worked / seconds since the first was started

A job handles a batch of units and says in its log which one it is at: ``stage: unit (3 of 50)``.
"""

from __future__ import annotations

import os
import re
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

COST = {"ingest": 2.0, "diagnose": 4.0, "report": 2.0}  # of a unit, relative to a stage of 1
AT_UNIT = re.compile(r"^[\w-]+: (\S+) \((\d+) of (\d+)\)$", re.MULTILINE)
LAST_STAGE = "report"  # whose units are counted as done
SHOWN = 2  # jobs at work that are named


@dataclass
class Job:
    """One job at work, or done.

    Attributes
    ----------
    rule : str
    name : str
        What a reader is told: the stage, with the sensor where it has one.
    units : int
    log : Path
    since : float
        When it was started, s.
    """

    rule: str
    name: str
    units: int
    log: Path
    since: float

    def at(self) -> tuple[str, int] | None:
        """Return the unit that the job is at, and its number; None before the first."""
        try:
            with self.log.open("rb") as stream:
                stream.seek(max(os.fstat(stream.fileno()).st_size - 2000, 0))
                found = AT_UNIT.findall(stream.read().decode(errors="replace"))
            fresh = self.log.stat().st_mtime >= self.since - 1.0
        except OSError:
            return None
        return (found[-1][0], int(found[-1][1])) if found and fresh else None


@dataclass
class Progress:
    """What is known of a run's jobs.

    Attributes
    ----------
    batches : mapping of str to int
        Batch to its number of units.
    wanted : dict of str to int
        Rule to the number of its jobs in this run.
    running, done : dict of int to Job, list of Job
    spent : dict of str to list of float
        Rule to seconds a unit of each job that is done.
    """

    batches: Mapping[str, int]
    wanted: dict[str, int] = field(default_factory=dict)
    running: dict[int, Job] = field(default_factory=dict)
    done: list[Job] = field(default_factory=list)
    spent: dict[str, list[float]] = field(default_factory=dict)
    worked: float = 0.0
    started: float = 0.0

    def start(self, number: int, rule: str, wildcards: Mapping[str, str], log: Path) -> None:
        """Note that a job has been started."""
        now = time.monotonic()
        self.started = self.started or now
        name = " ".join([rule, *(wildcards[w] for w in ("sensor", "stage") if w in wildcards)]).replace("_", " ")
        self.running[number] = Job(rule, name, self.batches.get(wildcards.get("batch", ""), 1), log, time.time())

    def finish(self, number: int, *, failed: bool = False) -> None:
        """Note that a job has ended."""
        job = self.running.pop(number, None)
        if job is None:
            return
        seconds = time.time() - job.since
        self.worked += seconds
        if not failed:
            self.done.append(job)
            self.spent.setdefault(job.rule, []).append(seconds / job.units)

    def text(self) -> str:
        """Return the state of the run in one line."""
        at = {number: job.at() for number, job in list(self.running.items())}
        counted = sum(job.units for job in self.done if job.rule == LAST_STAGE)
        of = round(self.wanted.get(LAST_STAGE, 0) * self._mean_batch())
        total = sum(self.wanted.values())
        parts = [f"{len(self.done)} of {total} jobs"]
        parts += [f"{counted} of {of} units done"] * bool(of)
        known = [(self.running[n], where) for n, where in at.items() if where and n in self.running]
        for job, (unit, number) in sorted(known, key=lambda k: -k[0].since)[:SHOWN]:
            parts.append(f"{job.name}: {unit} ({number} of {job.units})")
        left = self.seconds_left(at)
        return " | ".join([*parts, *([f"about {duration(left)} left"] if left else [])])

    def seconds_left(self, at: Mapping[int, tuple[str, int] | None]) -> float | None:
        """Return the time that the rest will take; None where too little has run to tell."""
        mean = {rule: sum(values) / len(values) for rule, values in self.spent.items() if rule in self.wanted}
        if sum(len(v) for v in self.spent.values()) < 2:
            return None
        scale = sum(mean.values()) / sum(COST.get(rule, 1.0) for rule in mean)
        left = 0.0
        for rule, jobs in self.wanted.items():
            done = sum(job.units for job in self.done if job.rule == rule)
            part = sum(w[1] - 1 for n, w in at.items() if w and n in self.running and self.running[n].rule == rule)
            each = mean.get(rule, scale * COST.get(rule, 1.0))
            size = self._mean_batch() if rule in _PER_BATCH or jobs > 1 else 1.0
            left += max(jobs * size - done - part, 0.0) * each
        working = sum(time.time() - job.since for job in self.running.values())
        together = (self.worked + working) / max(time.monotonic() - self.started, 1e-3)
        return left / max(together, 1.0)

    def _mean_batch(self) -> float:
        return sum(self.batches.values()) / max(len(self.batches), 1)


_PER_BATCH = ("ingest", "filter", "fit", "validate", "diagnose", "calibration", "export", "report")


def duration(seconds: float) -> str:
    """Return a duration as people say it."""
    if seconds < 90:
        return f"{max(5 * round(seconds / 5), 5)} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"
