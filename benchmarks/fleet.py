"""What a fleet costs: ``python benchmarks/fleet.py --units 100``.

A campaign of simulated units (10,000 samples each in eight recordings) goes through ``snakemake --cores 2`` with every
stage, diagnosis and page. CPU seconds are those of Snakemake and all its jobs, user and system; the memory is that of
the largest process. In the same run stands the floor, which is what no tool can save: one process reads the same files
with pyarrow and solves one linear least squares problem for each sensor of each unit. How fast the machine is at the
moment, by a loop of five million additions, stands beside it: CPU seconds of a shared machine vary twofold.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path

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
        print(name, used.ru_utime + used.ru_stime, used.ru_maxrss, file=stream)
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
        speed = _speed()
        floor = subprocess.run(
            [sys.executable, "-c", FLOOR, "fleet/raw"], cwd=folder, check=True, capture_output=True, text=True
        )
        least = float(floor.stdout) / arguments.units
        found = _run(folder, arguments.cores) / arguments.units
        print(f"floor: {1000 * least:.1f} ms a unit; ratio to it: {found / least:.1f}")
        print(f"five million additions: {speed:.2f} s before, {_speed():.2f} s after")
    return 0


def _run(folder: str, cores: int) -> float:
    told = Path(folder, "told")
    Path(folder, "sitecustomize.py").write_text(TELL, encoding="utf-8")
    paths = [folder, *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "FLEET_TOLD": str(told)}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # an installed package is not compiled at each start
    command = [sys.executable, "-m", "snakemake", "-s", str(ROOT / "Snakefile"), "--cores", str(cores)]
    before, start = _cpu(), time.perf_counter()
    done = subprocess.run(  # noqa: PLW1510  (its own words are shown below)
        [*command, "--config", "campaign=fleet"], cwd=folder, env=environment, capture_output=True, text=True
    )
    if done.returncode:
        raise SystemExit(done.stderr[-4000:])
    used, wall = _cpu() - before, time.perf_counter() - start
    spent: dict[str, float] = defaultdict(float)
    jobs: dict[str, int] = defaultdict(int)
    largest = 0.0
    for line in told.read_text(encoding="utf-8").splitlines():
        name, used_s, kilobytes = line.split()
        spent[name] += float(used_s)
        jobs[name] += 1
        largest = max(largest, float(kilobytes) / 1024)
    units = len(list(Path(folder, "results/fleet/reports").glob("*.html")))
    for name, seconds in spent.items():
        print(f"{name:12s} {jobs[name]:4d} processes {1000 * seconds / units:7.1f} ms a unit")
    print(f"all stages, {units} pages: {1000 * used / units:.0f} ms CPU a unit, {used:.0f} s in all")
    print(f"{wall:.0f} s on {cores} cores; {largest:.0f} MB in the largest process")
    return used


def _cpu() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _speed() -> float:
    start, total = time.process_time(), 0
    for i in range(5_000_000):
        total += i
    return time.process_time() - start


if __name__ == "__main__":
    raise SystemExit(main())
