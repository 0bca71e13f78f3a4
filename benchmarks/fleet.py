"""What a fleet costs: ``python benchmarks/fleet.py --units 100``.

A campaign of simulated units (10,000 samples each in eight recordings) goes through ``snakemake --cores 2`` with every
stage, diagnosis and page. CPU seconds are those of Snakemake and all its jobs, user and system; the memory is that of
the largest process. In the same run stands the floor, which is what no tool can save: one process reads the same files
with pyarrow and solves one linear least squares problem for each sensor of each unit. How fast the machine is at the
moment, by a loop of five million additions, stands beside it: CPU seconds of a shared machine vary twofold.

``--stages`` runs the jobs one after the other instead and prints the CPU seconds of each stage.
"""

from __future__ import annotations

import argparse
import re
import resource
import shlex
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


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--units", type=int, default=100)
    parser.add_argument("--cores", type=int, default=2)
    parser.add_argument("--stages", action="store_true", help="CPU seconds of each stage, its jobs one after the other")
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
        found = (_stages if arguments.stages else _run)(folder, arguments.cores) / arguments.units
        print(f"floor: {1000 * least:.1f} ms a unit; ratio to it: {found / least:.1f}")
        print(f"five million additions: {speed:.2f} s before, {_speed():.2f} s after")
    return 0


def _snakemake(*options: str) -> list[str]:
    return [
        sys.executable, "-m", "snakemake", "-s", str(ROOT / "Snakefile"), *options, "--config", "campaign=fleet"
    ]  # fmt: skip


def _run(folder: str, cores: int) -> float:
    before, start = _cpu(), time.perf_counter()
    subprocess.run(_snakemake("--cores", str(cores)), cwd=folder, check=True, capture_output=True)
    used, wall = _cpu() - before, time.perf_counter() - start
    print(f"all stages: {used:.1f} CPU s, {wall:.1f} s on {cores} cores; {_largest():.0f} MB at most")
    units = len(list(Path(folder, "results/fleet/reports").glob("*.html")))
    print(f"{units} pages; {1000 * used / units:.0f} ms CPU a unit")
    return used


def _stages(folder: str, cores: int) -> float:
    del cores
    dry = subprocess.run(_snakemake("--cores", "1", "-n", "-p"), cwd=folder, check=True, capture_output=True, text=True)
    jobs = dict.fromkeys(re.findall(r"\S+ -m pipeline .*", dry.stdout + dry.stderr))
    spent: dict[str, float] = defaultdict(float)
    for job in jobs:
        words = shlex.split(job)
        for name in re.findall(r"(?:--output|2?>) (\S+)", job):
            Path(folder, name.strip("'")).parent.mkdir(parents=True, exist_ok=True)
        before = _cpu()
        subprocess.run(job, cwd=folder, shell=True, check=True)  # noqa: S602  (Snakemake's own commands)
        spent[" ".join([words[3], *(words[i + 1] for i, w in enumerate(words) if w == "--sensor")])] += _cpu() - before
    units = len(list(Path(folder, "results/fleet/reports").glob("*.html")))
    for stage, seconds in spent.items():
        print(f"{stage:20s} {1000 * seconds / units:7.1f} ms a unit")
    print(f"{'all':20s} {1000 * sum(spent.values()) / units:7.1f} ms a unit, without Snakemake itself")
    return sum(spent.values())


def _cpu() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _largest() -> float:
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024


def _speed() -> float:
    start, total = time.process_time(), 0
    for i in range(5_000_000):
        total += i
    return time.process_time() - start


if __name__ == "__main__":
    raise SystemExit(main())
