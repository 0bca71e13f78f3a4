"""What a fleet costs: ``python benchmarks/fleet.py --units 100``.

A campaign of simulated units (10,000 samples each in eight recordings) goes through ``snakemake --cores 2`` with every
stage, diagnosis and page. CPU seconds are those of Snakemake and all its jobs, user and system; the memory is that of
the largest process. The floor is what no tool can save: one process reads the same files with pyarrow and solves one
linear least squares problem for each sensor of each unit. CPU seconds of a shared machine vary twofold, so the floor is
measured before, during and after the run, and so is a loop of five million additions.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path

PAUSE_S = 15.0  # between two measurements of the floor
ROOT = Path(__file__).resolve().parents[1]
FLOOR = """
import sys, time
from pathlib import Path
import numpy as np
import pyarrow.csv as csv
start = time.process_time()
for unit in sorted(Path(sys.argv[1]).iterdir()):
    tables = [csv.read_csv(file) for file in sorted(unit.glob("*.csv"))]
    for sensor in ("accel_{}_g", "gyro_{}_dps"):
        y = np.concatenate([np.column_stack([t[sensor.format(a)] for a in "xyz"]) for t in tables])
        A = np.column_stack([np.ones(len(y)), np.roll(y, 1, axis=0)])
        np.linalg.lstsq(A, y, rcond=None)
print(time.process_time() - start)
"""


# Every process of the run tells on its way out what it was, and what it has used.
TELL = """
import atexit, os, resource, sys
def _tell():
    used = resource.getrusage(resource.RUSAGE_SELF)
    words = sys.argv
    name = words[1] if words[0].endswith("pipeline/__main__.py") else "snakemake"
    with open(os.environ["FLEET_TOLD"], "a") as stream:
        print(os.getpid(), name, used.ru_utime + used.ru_stime, used.ru_maxrss, file=stream)
    os._exit = leave
def _leave(code):
    _tell()
    leave(code)
leave, os._exit = os._exit, _leave
atexit.register(_tell)
"""


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--units", type=int, default=100)
    parser.add_argument("--cores", type=int, default=2)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        made = ["simulate", "fleet", "--units", str(arguments.units), "--samples", "10000", "--quiet", "--seed", "1"]
        subprocess.run([sys.executable, "-m", "pipeline", *made], cwd=folder, check=True, stderr=subprocess.DEVNULL)
        rows = sum(file.read_bytes().count(b"\n") - 1 for file in Path(folder, "fleet/raw").rglob("*.csv"))
        print(f"{arguments.units} units, {rows / arguments.units:.0f} samples each", flush=True)
        found, floors, speeds = _run(folder, arguments.cores)
        least = statistics.median(floors)
        print(f"load average {os.getloadavg()[0]:.1f}; five million additions: {_range(speeds)} s")
        print(
            f"floor: {1000 * least / arguments.units:.1f} ms a unit, median of {len(floors)} runs of {_range(floors)} s"
        )
        print(f"ratio to the floor: {found / least:.1f}")
    return 0


def _range(seconds: list[float]) -> str:
    return f"{min(seconds):.2f} to {max(seconds):.2f}"


def _floor(folder: str) -> float:
    done = subprocess.run(
        [sys.executable, "-c", FLOOR, "fleet/raw"], cwd=folder, check=True, capture_output=True, text=True
    )
    return float(done.stdout)


def _run(folder: str, cores: int) -> tuple[float, list[float], list[float]]:
    """Return the CPU seconds of the run, of each floor and of each loop of additions."""
    told = Path(folder, "told")
    Path(folder, "sitecustomize.py").write_text(TELL, encoding="utf-8")
    paths = [folder, *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "FLEET_TOLD": str(told)}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # an installed package is not compiled at each start
    command = [sys.executable, "-m", "snakemake", "-s", str(ROOT / "Snakefile"), "--cores", str(cores)]
    floors, speeds, start = [_floor(folder)], [_speed()], time.perf_counter()
    with Path(folder, "log").open("w", encoding="utf-8") as log:
        run = subprocess.Popen(
            [*command, "--config", "campaign=fleet"], cwd=folder, env=environment, stdout=log, stderr=log
        )
        process = 0
        while not process:
            time.sleep(PAUSE_S)
            process, failed, spent_by_run = os.wait4(run.pid, os.WNOHANG)
            floors.append(_floor(folder))
            speeds.append(_speed())
    if failed:
        raise SystemExit(Path(folder, "log").read_text(encoding="utf-8")[-4000:])
    used, wall = spent_by_run.ru_utime + spent_by_run.ru_stime, time.perf_counter() - start
    spent: dict[str, float] = defaultdict(float)
    jobs: dict[str, int] = defaultdict(int)
    largest = 0.0
    lines = told.read_text(encoding="utf-8").splitlines()
    for line in dict(line.split(maxsplit=1) for line in lines).values():  # some tell twice
        name, used_s, kilobytes = line.split()
        spent[name] += float(used_s)
        jobs[name] += 1
        largest = max(largest, float(kilobytes) / 1024)
    results = Path(folder, "results/fleet")  # beyond publish_limit, pages are in packs
    units = len((results / "summary.csv").read_text(encoding="utf-8").splitlines()) - 1
    files = sum(file.is_file() for file in results.rglob("*"))
    for name, seconds in spent.items():
        print(f"{name:12s} {jobs[name]:4d} processes {1000 * seconds / units:7.1f} ms a unit")
    print(f"all stages, {units} units, {files} files: {1000 * used / units:.0f} ms CPU a unit, {used:.0f} s in all")
    print(f"{wall:.0f} s on {cores} cores; {largest:.0f} MB in the largest process")
    return used, floors, speeds


def _speed() -> float:
    start, total = time.process_time(), 0
    for i in range(5_000_000):
        total += i
    return time.process_time() - start


if __name__ == "__main__":
    raise SystemExit(main())
