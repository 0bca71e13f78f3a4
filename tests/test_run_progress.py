"""What a person is told of a run: units done, the unit at work, the time left, one run at a time."""

import csv
import io
import os
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from pipeline.app import run_progress
from pipeline.app.results_folder import BusyError, hold_as_job, jobs_running, release_locks, take_run
from pipeline.app.run_progress import Progress, _cause, duration


def test_the_line_names_the_unit_at_work_the_units_done_and_the_time_left(tmp_path: Path) -> None:
    progress = Progress({"a": 4, "b": 4})
    progress.wanted = Counter({"ingest": 2, "report": 2, "gather": 1})
    log = tmp_path / "report.log"
    for number, rule in ((1, "ingest"), (2, "ingest"), (3, "report")):
        progress.start(number, rule, {"batch": "a"}, log)
        progress.running[number].since -= 40.0  # as if it had been started 40 s ago
        progress.finish(number)
    progress.started -= 120.0
    progress.start(4, "report", {"batch": "b"}, log)
    log.write_text("report: U5 (1 of 4)\nreport: U6 (2 of 4)\n")
    progress.running[4].since -= 10.0
    # 3 units of 9 s are left, one job at a time; and gather, of which 42 s are assumed by the ratio to the others.
    assert progress.text() == "about 70 s left | 3 of 5 jobs | 4 of 8 units done | report: U6 (2 of 4)"


def test_the_units_are_those_of_the_batches_that_run_and_are_never_fewer_than_the_done_ones(tmp_path: Path) -> None:
    """An added effect runs one of two batches of unequal size."""
    progress = Progress({"staged": 4, "other": 6})
    progress.wanted, told = Counter({"diagnose": 1, "report": 1}), []
    for number, rule in ((1, "diagnose"), (2, "report")):
        progress.start(number, rule, {"batch": "other"}, tmp_path / "none")
        told.append(progress.text())
        progress.finish(number)
    assert all("0 of 6 units done" in text for text in told)
    assert "6 of 6 units done" in progress.text()


def test_a_fit_is_named_by_sensor_and_stage(tmp_path: Path) -> None:
    progress = Progress({"a": 1})
    progress.wanted = Counter({"fit": 1})
    progress.start(1, "fit", {"batch": "a", "sensor": "gyroscope", "stage": "scale_factor"}, tmp_path / "log")
    (tmp_path / "log").write_text("fit: U1 (1 of 1)\n")
    assert "fit gyroscope scale factor: U1 (1 of 1)" in progress.text()


def test_the_log_of_an_earlier_run_is_not_taken_for_this_one(tmp_path: Path) -> None:
    progress = Progress({"a": 1})
    (tmp_path / "log").write_text("ingest: U1 (1 of 1)\n")
    progress.start(1, "ingest", {"batch": "a"}, tmp_path / "log")
    progress.running[1].since = time.time() + 60.0
    assert "U1" not in progress.text()


@pytest.mark.parametrize(("seconds", "text"), [(3, "5 s"), (62, "60 s"), (600, "10 min"), (7200, "2.0 h")])
def test_durations_are_said_as_people_say_them(seconds: float, text: str) -> None:
    assert duration(seconds) == text


@pytest.mark.parametrize(
    ("log", "cause"),
    [
        ("", "killed, or could not be started"),
        ("report: U1 (1 of 2)\nreport: U2 (2 of 2)\n", "killed at unit U2"),
        ("report: U1 (1 of 2)\nOSError: [Errno 28] No space left\n", "OSError: [Errno 28] No space left"),
    ],
)
def test_the_cause_of_a_broken_job_is_the_end_of_its_log(tmp_path: Path, log: str, cause: str) -> None:
    (tmp_path / "log").write_text(log)
    assert _cause(tmp_path / "log") == cause


def test_results_are_held_by_one_run_and_jobs_are_seen(tmp_path: Path) -> None:
    take_run(tmp_path)
    with pytest.raises(BusyError, match=r"another run works on these results \(process [0-9]+ on"):
        take_run(tmp_path)
    assert not jobs_running(tmp_path)
    hold_as_job(tmp_path)
    assert jobs_running(tmp_path)
    release_locks()
    assert not jobs_running(tmp_path)
    take_run(tmp_path)
    release_locks()


def test_a_process_closes_its_locks_at_its_end(tmp_path: Path) -> None:
    holding = "import sys, pathlib, pipeline.app.results_folder as r; r.hold_as_job(pathlib.Path(sys.argv[1]))"
    command = [sys.executable, "-W", "always", "-c", holding, str(tmp_path)]
    done = subprocess.run(command, cwd=Path(__file__).parents[1], capture_output=True, text=True, check=True)
    assert not done.stderr


def test_a_command_tells_the_time_left_on_a_terminal_and_each_half_minute_elsewhere(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now, stream = [100.0], io.StringIO()
    monkeypatch.setattr(run_progress.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(run_progress.sys, "stderr", stream)
    for terminal, told in ((True, [0, 1, 2]), (False, [])):
        monkeypatch.setattr(stream, "isatty", lambda terminal=terminal: terminal, raising=False)
        countdown, lines = run_progress.Countdown(40), []
        for done in range(3):
            countdown(done, f"{done} of 40 cases")
            now[0] += 1.0
            lines += [done] * bool(stream.getvalue())
            text = stream.getvalue()
            stream.seek(0), stream.truncate()
        assert lines == told
        if terminal:
            assert text == "\r\x1b[K5 % | about 40 s left | 2 of 40 cases"  # two in two seconds
    now[0] += 40.0
    countdown(20, "20 of 40 cases")
    assert stream.getvalue() == "50 % | about 45 s left | 20 of 40 cases\n"  # 43 s since it began, to 5 s
    assert countdown.left(40) == ""


def test_a_job_that_takes_longer_than_earlier_ones_lengthens_the_time_left(tmp_path: Path) -> None:
    progress = Progress({"a": 3})
    progress.wanted = Counter({"fit": 4})
    for number in (1, 2):
        progress.start(number, "fit", {"batch": "a"}, tmp_path / "none")
        progress.finish(number)
    (tmp_path / "log").write_text("fit: U1 (1 of 3)\n")
    progress.start(3, "fit", {"batch": "a"}, tmp_path / "log")
    progress.running[3].since -= 290.0  # 290 s at the first unit, in place of a millisecond: a tenth of that is left
    os.utime(tmp_path / "log", (progress.running[3].since,) * 2)
    assert progress.text().startswith("about 30 s left")


def test_the_time_left_of_the_demo_does_not_rise(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with (Path(__file__).parent / "demo_jobs.csv").open(encoding="utf-8") as stream:
        jobs = list(csv.DictReader(stream))  # as a run of data/demo on two cores was recorded
    progress, clock, found = Progress({"reference_least_squares": 6, "staged": 4}), [0.0], {}
    monkeypatch.setattr(run_progress.time, "time", lambda: 1e9 + clock[0])
    monkeypatch.setattr(run_progress.time, "monotonic", lambda: 1.0 + clock[0])
    progress.wanted = Counter({**Counter(job["rule"] for job in jobs), "gather": 1, "verdict": 1})
    began = [[float(t) for t in job["units began s"].split()] for job in jobs]
    ended = [float(job["ended s"]) for job in jobs]
    events = [(t, 1, n, k) for n, times in enumerate(began) for k, t in enumerate(times)]
    events += [(t, 0, n, 0) for n, t in enumerate(ended)] + [(t, 2, -1, 0) for t in np.arange(0.5, max(ended))]
    for clock[0], what, n, k in sorted(events):
        log = tmp_path / str(n)
        if what == 0:
            progress.finish(n)
        elif what == 1:
            log.write_text(f"{jobs[n]['rule']}: U ({k + 1} of {len(began[n])})\n")
            os.utime(log, (1e9 + clock[0],) * 2)
            if k == 0:
                progress.start(n, jobs[n]["rule"], {w: jobs[n][w] for w in ("batch", "sensor", "stage")}, log)
        elif left := progress._seconds_left():
            found[clock[0]] = left
    assert len(found) > 50
    for at, left in found.items():
        assert left < 1.1 * min(earlier for t, earlier in found.items() if t <= at)
        assert 0.75 * (max(ended) - at) < left < 20.0 + max(ended) - at  # two of ten units take 65 of 81 s of diagnosis
