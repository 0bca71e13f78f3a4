"""What one unit costs: ``python benchmarks/unit_cost.py --minutes 60 --rate 1000``.

A unit of the demo, one by hand (faces and turns) and one that is mounted anew for each turn of a table are calibrated
by ``pipeline.calibrate_unit`` in a warm process. The demo is run, and the CPU time of ``explain``, ``guide --help``
and ``add`` of one effect, with all of its processes, is divided by that of importing numpy, scipy, pydantic and
pyarrow with the parts that calibrations use. Then three units on a table with long recordings are simulated, and each
goes through every stage, page included, in a process of its own: with nothing hidden, with two hidden effects, and on
a home-made table whose ripple leaves the sensors unexplained. Printed are CPU seconds, of a long unit for each stage,
rows of the diagnosis, the largest memory and the verdicts. A long unit that needs more than ``--limit`` CPU seconds
is ended.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

from measuring import least

from imu_research.figures import MeasuredFigure, write_figures

ROOT = Path(__file__).resolve().parents[1]
CASES = {  # with the largest CPU time that is wanted, s
    "nothing hidden": ([], 20.0),
    "two effects": (["--effect", "accelerometer.cubic_nonlinearity", "--effect", "gyroscope.g_sensitivity"], 20.0),
    "unexplained": (["--table", "mark2"], 40.0),
}
MOST_MB = 1200.0
SHORT = {  # how the unit is simulated, and the CPU s that are wanted
    "demo": ([], "<= 0.25"),
    "by hand": (["--procedure", "ferraris", "--interval", "0.01"], "<= 1"),
    "remounted": (["--table", "single_axis", "--samples", "10000"], ""),
}
IMPORTS = "import numpy, scipy.optimize, scipy.stats, pyarrow.parquet; from pydantic import BaseModel"
COMMANDS = {  # of a copy of the demo, with the largest ratio to importing libraries that is wanted
    "explain": (["explain", "bench", "mpu6050-2-hidden"], 1.2),
    "guide --help": (["guide", "--help"], 0.4),
    "add": (["add", "bench", "mpu6050-2-hidden", "gyroscope.g_sensitivity"], 8.0),
}
TIMES = 3  # of which the least is taken


def main() -> None:
    """Measure the short units, simulate the long ones, and run each of these in a process of its own."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0, help="of all recordings of a long unit together")
    parser.add_argument("--rate", type=float, default=1000.0, help="samples a second")
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--limit", type=int, default=120, help="CPU s of a long unit")
    parser.add_argument("--figures", type=Path, help="file for CPU times and memory")
    parser.add_argument("--calibrate", type=Path, help=argparse.SUPPRESS)  # a campaign: in the process of a case
    options = parser.parse_args()
    if options.calibrate:
        resource.setrlimit(resource.RLIMIT_CPU, (options.limit, options.limit))
        _calibrate(options.calibrate)
        return
    figures = [*_short(), *_commands()]
    samples = ["--samples", str(int(60.0 * options.minutes * options.rate)), "--interval", str(1.0 / options.rate)]
    for name, (more, wanted) in CASES.items():
        with tempfile.TemporaryDirectory() as folder:
            made = ["simulate", "unit", *samples, "--seed", str(options.seed), "--quiet", *more]
            subprocess.run([sys.executable, "-m", "pipeline", *made], cwd=folder, check=True, stderr=subprocess.DEVNULL)
            title = f"{options.minutes:g} min at {options.rate:g} Hz, {name}"
            print(f"\n{title}", flush=True)
            run = [sys.executable, __file__, "--calibrate", f"{folder}/unit", "--limit", str(options.limit)]
            if subprocess.run(run, check=False).returncode:
                print(f"  not finished after {options.limit} CPU s")
                continue
            found = json.loads(Path(folder, "unit", "cost.json").read_text(encoding="utf-8"))
        figures.append(MeasuredFigure(f"{title}: CPU", found["cpu_s"], 1, f"<= {wanted:g}", unit="s"))
        figures.append(MeasuredFigure(f"{title}: largest memory", found["memory_mb"], 1, f"<= {MOST_MB:g}", unit="MB"))
    write_figures(options.figures, figures)


def _short() -> list[MeasuredFigure]:
    """Return the CPU time of ``SHORT``, after a first calibration that imports what it needs."""
    import pipeline  # noqa: PLC0415  (not in the process of a case)

    figures = []
    with tempfile.TemporaryDirectory() as folder:
        for name, (options, wanted) in SHORT.items():
            campaign, unit = (Path(folder, name), "U001") if options else (ROOT / "data" / "demo", "mpu6050-1")
            if options:
                made = ["simulate", str(campaign), *options, "--seed", "3", "--quiet"]
                subprocess.run([sys.executable, "-m", "pipeline", *made], check=True, stderr=subprocess.DEVNULL)
            spent, _ = least(1 + TIMES, partial(pipeline.calibrate_unit, campaign, unit))
            print(f"{name}, warm: {spent:.3f} CPU s")
            figures.append(MeasuredFigure(f"{name}, warm: CPU", spent, TIMES, wanted, unit="s"))
    return figures


def _commands() -> list[MeasuredFigure]:
    """Return the CPU time of commands on the demo over that of importing libraries."""
    figures = []
    with tempfile.TemporaryDirectory() as folder:
        shutil.copytree(ROOT / "data" / "demo", Path(folder, "bench"))

        def least_of_command(words: list[str], times: int = TIMES) -> float:
            spent = []
            for _ in range(times):
                before = resource.getrusage(resource.RUSAGE_CHILDREN)
                subprocess.run([sys.executable, *words], cwd=folder, check=True, capture_output=True)
                after = resource.getrusage(resource.RUSAGE_CHILDREN)
                spent.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
            return min(spent)

        run = ["-m", "snakemake", "--cores", "2", "--snakefile", str(ROOT / "Snakefile"), "--config", "campaign=bench"]
        least_of_command(run, 1)
        imports = least_of_command(["-c", IMPORTS])
        for name, (words, wanted) in COMMANDS.items():
            ratio = least_of_command(["-m", "pipeline", *words], 1 if name == "add" else TIMES) / imports
            title = f"{name}: CPU over importing libraries"
            print(f"{title}: {ratio:.2f}", flush=True)
            figures.append(MeasuredFigure(title, ratio, 1, f"<= {wanted:g}", unit="times"))
    return figures


def _calibrate(directory: Path) -> None:
    """Take the unit of a campaign through every stage, and print and write what it costs."""
    from pipeline.app.config import load_campaign  # noqa: PLC0415  (in the process of a case alone)
    from pipeline.app.one_unit import unit_of_campaign  # noqa: PLC0415
    from pipeline.estimation.observations import observe  # noqa: PLC0415
    from pipeline.unit import run_steps, tasks_of  # noqa: PLC0415

    campaign = load_campaign({"campaign": str(directory)})
    (name,) = campaign.units
    unit = unit_of_campaign(campaign, name)
    state, total = unit.state(), 0.0
    with unit.environment():
        for task in tasks_of(unit.stages, "report"):
            before = time.process_time()
            run_steps(state, iter([task]), unit.settings)
            spent = time.process_time() - before
            total += spent
            print(f"  {task.name:44s}{spent:7.2f} CPU s", flush=True)
    largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"  all stages: {total:.1f} CPU s; largest memory {largest:.0f} MB")
    for sensor in ("accelerometer", "gyroscope"):
        rows = observe(sensor, state.recordings.filtered, campaign.units[name].config.table)
        found = state.diagnosis[sensor]
        print(
            f"  {sensor}: {len(rows.weight)} rows of {rows.samples:.0f} samples; {found['verdict']} {found['selected']}"
        )
    (directory / "cost.json").write_text(json.dumps({"cpu_s": total, "memory_mb": largest}), encoding="utf-8")


if __name__ == "__main__":
    main()
