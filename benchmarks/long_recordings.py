"""What long recordings cost: ``python benchmarks/long_recordings.py --minutes 60 --rate 1000``.

Three units on a table are simulated, and each goes through every stage, page included, in a process of its own: with
nothing hidden, with two hidden effects, and on a home-made table whose ripple leaves the sensors unexplained. Printed
are CPU seconds of each stage, rows of the diagnosis, the largest memory and the verdicts. A case that needs more
than ``--limit`` CPU seconds is ended.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

CASES = {
    "nothing hidden": [],
    "two effects": ["--effect", "accelerometer.cubic_nonlinearity", "--effect", "gyroscope.g_sensitivity"],
    "unexplained": ["--table", "mark2"],
}


def main() -> None:
    """Simulate the cases, and run each in a process of its own."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0, help="of all recordings of a unit together")
    parser.add_argument("--rate", type=float, default=1000.0, help="samples a second")
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--limit", type=int, default=120, help="CPU s of a case")
    parser.add_argument("--calibrate", type=Path, help=argparse.SUPPRESS)  # a campaign: in the process of a case
    options = parser.parse_args()
    if options.calibrate:
        resource.setrlimit(resource.RLIMIT_CPU, (options.limit, options.limit))
        _calibrate(options.calibrate)
        return
    samples = ["--samples", str(int(60.0 * options.minutes * options.rate)), "--interval", str(1.0 / options.rate)]
    for name, more in CASES.items():
        with tempfile.TemporaryDirectory() as folder:
            made = ["simulate", "unit", *samples, "--seed", str(options.seed), "--quiet", *more]
            subprocess.run([sys.executable, "-m", "pipeline", *made], cwd=folder, check=True, stderr=subprocess.DEVNULL)
            print(f"\n{name}: {options.minutes:g} min at {options.rate:g} Hz", flush=True)
            run = [sys.executable, __file__, "--calibrate", f"{folder}/unit", "--limit", str(options.limit)]
            if subprocess.run(run, check=False).returncode:
                print(f"  not finished after {options.limit} CPU s")


def _calibrate(directory: Path) -> None:
    """Take the unit of a campaign through every stage, and print what it costs."""
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


if __name__ == "__main__":
    main()
