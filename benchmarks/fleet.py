"""What a fleet costs: ``python benchmarks/fleet.py --units 100``.

A campaign of simulated units (10,000 samples each in eight recordings) goes through ``snakemake --cores 2`` with every
stage, diagnosis and page. Beyond ``--simulated`` units, units use recordings of others, and each goes through every
stage. CPU seconds are those of Snakemake and all its jobs, user and system; the memory is that of the largest process.
The floor is what no tool can save: one process reads the files of 100 units with pyarrow and solves one linear least
squares problem for each sensor of each. CPU seconds of a shared machine vary twofold, so the floor is measured before,
during and after the run, and so is a loop of five million additions.

With ``--mixed`` a tenth of the units has a sensor whose noise the stated accuracies of the table exceed, and a tenth is
on a table whose errors no effect explains.

With ``--folder DIR`` everything stays in that folder. The same command continues a run that was interrupted, and adds
up what all of its parts have used. 10,000 units need 9 GB.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import re
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

from imu_research.figures import MeasuredFigure, write_figures
from pipeline.app.steps.batch import CPU_TIME
from pipeline.unit import STEPS

PAUSE_S = 15.0, 120.0  # between two measurements of the floor: at first, and in a long run
ROOT = Path(__file__).resolve().parents[1]
MEASURED = 100  # units of the floor
MANY = 1000  # units, of which each has a lower goal: what a run costs once counts less
MIXED = {"S": ["--sensor", "stim300"], "M": ["--table", "mark2"]}  # a tenth each: first letter, options of ``simulate``
FLOOR = """
import sys, time
from pathlib import Path
import numpy as np
import pyarrow.csv as csv
start = time.process_time()
for unit in sorted(Path(sys.argv[1]).iterdir())[:int(sys.argv[2])]:
    tables = [csv.read_csv(file) for file in sorted(unit.glob("*.csv"))]
    for sensor in ("accel_{}_g", "gyro_{}_dps"):
        y = np.concatenate([np.column_stack([t[sensor.format(a)] for a in "xyz"]) for t in tables])
        A = np.column_stack([np.ones(len(y)), np.roll(y, 1, axis=0)])
        np.linalg.lstsq(A, y, rcond=None)
print(time.process_time() - start)
"""

# Every process of the run tells on its way out what it ran last, and what it has used; the process of a batch runs most
# of its stages. The commands that start the jobs do not import this. The largest memory that ``getrusage`` gives may be
# that of the process from which one was started.
TELL = """
import atexit, os, resource, sys
def _tell():
    used = resource.getrusage(resource.RUSAGE_SELF)
    words = sys.argv
    name = words[1] if words[0].endswith("pipeline/__main__.py") else "snakemake"
    largest = next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM"))
    with open(os.environ["FLEET_TOLD"], "a") as stream:
        print(os.getpid(), name, used.ru_utime + used.ru_stime, largest, file=stream)
    os._exit = leave
def _leave(code):
    _tell()
    leave(code)
leave, os._exit = os._exit, _leave
atexit.register(_tell)
"""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--units", type=int, default=100)
    parser.add_argument("--simulated", type=int, default=1000, help="most units with recordings of their own")
    parser.add_argument("--mixed", action="store_true", help="with units that cost more, a tenth each of two kinds")
    parser.add_argument("--cores", type=int, default=2)
    parser.add_argument("--figures", type=Path, help="file for cost and ratio")
    parser.add_argument("--folder", type=Path, help="where everything stays, for a run that may be interrupted")
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        if not (folder / "fleet/ready").is_file():
            mixed = MIXED if arguments.mixed else {}
            _lay_out(folder, arguments.units, min(arguments.units, arguments.simulated), mixed)
        _run(folder, arguments.cores)
        figures = _report(folder, arguments.cores, ", mixed" * arguments.mixed)
    write_figures(arguments.figures, figures)
    return 0


def _lay_out(folder: Path, units: int, simulated: int, mixed: dict[str, list[str]]) -> None:
    """Simulate some units; the others use their recordings in turn."""
    rows: list[str] = []
    for prefix, options in {**mixed, "U": []}.items():
        name, count = ("fleet", simulated - len(rows)) if prefix == "U" else (prefix, simulated // 10)
        made = ["simulate", name, "--prefix", prefix, "--units", str(count), "--samples", "10000", "--quiet", *options]
        command = [sys.executable, "-m", "pipeline", *made, "--seed", "1"]
        subprocess.run(command, cwd=folder, check=True, stderr=subprocess.DEVNULL)
        header, *found = (folder / name / "units.csv").read_text(encoding="utf-8").splitlines()
        rows += found
    for prefix in mixed:
        for unit in (folder / prefix / "raw").iterdir():
            unit.rename(folder / "fleet/raw" / unit.name)
    lines = [f"{header},overrides", *(f"{row}," for row in rows)]
    for i in range(simulated, units):
        own, _, *same = rows[i % simulated].split(",")
        lines.append(",".join([f"V{i:05d}", f"V{i:05d}", *same, f"procedure.folder=raw/{own}"]))
    (folder / "fleet/units.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (folder / "fleet/ready").touch()


def _floor(folder: Path) -> float:
    """Return the CPU seconds of a unit."""
    measured = min(MEASURED, len(list((folder / "fleet/raw").iterdir())))
    command = [sys.executable, "-c", FLOOR, "fleet/raw", str(measured)]
    return float(subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True).stdout) / measured


def _run(folder: Path, cores: int) -> None:
    """Run the campaign, or the rest of it, and append to ``runs`` what it has used, also where it is interrupted."""
    (folder / "sitecustomize.py").write_text(TELL, encoding="utf-8")
    paths = [str(folder.absolute()), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "FLEET_TOLD": str((folder / "told").absolute())}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # an installed package is not compiled at each start
    command = [sys.executable, "-m", "snakemake", "-s", str(ROOT / "Snakefile"), "--cores", str(cores)]
    if any(folder.glob(".snakemake/locks/*")):  # of a run that was killed
        unlock = [*command, "--unlock", "--config", "campaign=fleet"]
        subprocess.run(unlock, cwd=folder, check=True, capture_output=True)
    floors, speeds, start = [_floor(folder)], [_speed()], time.perf_counter()
    with (folder / "log").open("a", encoding="utf-8") as log:
        command += ["--config", "campaign=fleet"]
        run = subprocess.Popen(command, cwd=folder, env=environment, stdout=log, stderr=log, start_new_session=True)
        process, stopped, pause = 0, False, PAUSE_S[0]
        while not process:
            try:
                end = time.perf_counter() + pause
                while not process and time.perf_counter() < end:
                    time.sleep(0.2)
                    process, failed, used = os.wait4(run.pid, os.WNOHANG)
                floors.append(_floor(folder))
                speeds.append(_speed())
                pause = min(2.0 * pause, PAUSE_S[1])
            except KeyboardInterrupt:
                stopped = True
                run.terminate()  # jobs that run are finished
    with (folder / "runs").open("a", encoding="utf-8") as stream:
        cpu, wall = used.ru_utime + used.ru_stime, time.perf_counter() - start
        print(json.dumps({"cpu": cpu, "wall": wall, "floors": floors, "speeds": speeds}), file=stream)
    if failed or stopped:
        raise SystemExit((folder / "log").read_text(encoding="utf-8")[-2000:] + "\nThe same command continues.")


def _report(folder: Path, cores: int, kind: str) -> list[MeasuredFigure]:
    """Print what all runs of the campaign have used; returns cost, ratio to the floor, and the largest process."""
    runs: list[dict[str, Any]] = [json.loads(line) for line in (folder / "runs").read_text().splitlines()]
    used, wall = sum(run["cpu"] for run in runs), sum(run["wall"] for run in runs)
    floors, speeds = ([value for run in runs for value in run[key]] for key in ("floors", "speeds"))
    results = folder / "results/fleet"  # beyond publish_limit, pages are in packs
    with (results / "summary.csv").open(encoding="utf-8") as stream:
        states = [row["status"] for row in csv.DictReader(stream)]
    units, ok = len(states), states.count("ok")
    files = sum(file.is_file() for file in results.rglob("*"))
    packs = {(s := file.lstat()).st_ino: s.st_size for file in (results / "batches").rglob("*") if file.is_file()}
    size = sum(packs.values())  # the last output of each job has two names
    spent: dict[str, float] = defaultdict(float)
    jobs: dict[str, int] = defaultdict(int)
    memory: dict[str, float] = defaultdict(float)
    processes = 0.0
    told = (folder / "told").read_text(encoding="utf-8").splitlines()
    for (_, name), (used_s, kilobytes) in {tuple((w := line.split())[:2]): w[2:] for line in told}.items():
        processes += float(used_s)
        memory[name] = max(memory[name], float(kilobytes) / 1024)
        if name not in STEPS:
            spent[name] += float(used_s)
            jobs[name] += 1
    for log in (results / "logs").rglob("*.log"):
        if found := re.search(rf"^(\w+): ([\d.]+) {CPU_TIME}$", log.read_text(encoding="utf-8"), re.MULTILINE):
            spent[found[1]] += float(found[2])
            jobs[found[1]] += 1
    for name, seconds in spent.items():
        print(f"{name:12s} {jobs[name]:5d} jobs {1000 * seconds / units:7.2f} ms a unit")
    start = 1000 * (processes - sum(spent.values())) / units
    print(f"start and end of the processes of jobs: {start:.2f} ms a unit")
    rest = 1000 * (used - processes) / units
    print(f"commands that start the jobs, and jobs that were killed: {rest:.2f} ms a unit")
    print(f"all stages, {units} units, {ok} calibrated, in {len(runs)} runs: {1000 * used / units:.0f} ms CPU a unit")
    print(f"{used:.0f} s CPU, {wall:.0f} s on {cores} cores; {files} files, {size / 1e9:.2f} GB of packs")
    largest = max(memory, key=lambda name: memory[name])
    print(f"largest process: {memory[largest]:.0f} MB ({largest})")
    print(f"load average {os.getloadavg()[0]:.1f}; five million additions: {_range(speeds)} s")
    least = statistics.median(floors)
    milliseconds = _range([1000 * floor for floor in floors])
    print(f"floor: {1000 * least:.1f} ms a unit, median of {len(floors)} measurements of {milliseconds} ms")
    print(f"ratio to the floor: {used / units / least:.1f}")
    stages, goal = sorted(spent, key=lambda name: -spent[name]), "<= 22" if units < MANY else "<= 18"
    return [
        *(MeasuredFigure(f"of {name}", 1000.0 * spent[name] / units, units, unit="ms") for name in stages),
        MeasuredFigure(f"CPU a unit, {units} units{kind}", 1000.0 * used / units, units, unit="ms"),
        MeasuredFigure(f"... over the floor, {units} units{kind}", used / units / least, units, goal, unit="times"),
        MeasuredFigure(f"largest process, {units} units{kind}", memory[largest], units, unit="MB"),
    ]


def _range(values: list[float]) -> str:
    return f"{min(values):.2f} to {max(values):.2f}"


def _speed() -> float:
    start, total = time.process_time(), 0
    for i in range(5_000_000):
        total += i
    return time.process_time() - start


if __name__ == "__main__":
    raise SystemExit(main())
