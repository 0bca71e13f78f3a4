"""What ``gather`` costs beyond the run that could be made: ``python benchmarks/gather.py --units 10000``.

The packs of a few simulated units, made by a run of all stages, are written again under the names of N units in their
batches, the biases of each scattered, in lots of 500 with dates. The jobs after ``report`` are then run as a run does,
each in a process of its own, which tells its CPU time (user and system) and its largest memory.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.app.config import load_campaign, settings_of_jobs
from pipeline.core.pack import PACKED_STEPS, Pack, new_pack

ROOT = Path(__file__).resolve().parents[1]
SCATTER_G = 1e-3
# ``ru_maxrss`` would count the memory of this process, too, from which the other is started.
TELL = """
import resource, sys
from pipeline.app.steps.batch import main
sys.stderr = open("/dev/null", "w")
main(sys.argv[1], sys.argv[2:])
used = resource.getrusage(resource.RUSAGE_SELF)
largest = next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM"))
print(used.ru_utime + used.ru_stime, int(largest) / 1024)
"""


def small(folder: Path, units: int) -> Path:
    """Run a campaign of some units and return its batches."""
    made = ["simulate", "small", "--units", str(units), "--samples", "10000", "--quiet"]
    subprocess.run([sys.executable, "-m", "pipeline", *made], cwd=folder, check=True, stderr=subprocess.DEVNULL)
    command = [sys.executable, "-m", "snakemake", "-s", str(ROOT / "Snakefile"), "-c2", "-q", "all"]
    subprocess.run([*command, "--config", "campaign=small"], cwd=folder, check=True)
    return next((folder / "results/small/batches").glob("*-0001"))


def replicate(source: Path, names: list[str], target: Path, rng: np.random.Generator) -> None:
    """Write the packs of a batch of these names from those of other units."""
    packs = {stage: Pack(source / f"{stage}.zip") for stage in PACKED_STEPS}
    known = [n.removesuffix(".json") for n in packs["calibration"].names() if n.endswith(".json")]
    members = {
        (stage, unit): [n for n in pack.names() if n.partition("/")[0].startswith(unit) or f"/{unit}." in n]
        for stage, pack in packs.items()
        for unit in known
    }
    for stage, pack in packs.items():
        with new_pack(target / f"{stage}.zip") as add:
            for i, name in enumerate(names):
                unit, files = known[i % len(known)], {}
                for member in members[stage, unit]:
                    text = pack.read(member).decode().replace(unit, name)
                    scattered = stage == "calibration" and member.endswith(".json")
                    content = _scattered(text, rng) if scattered else text.encode()
                    files[member.replace(unit, name)] = content
                add(files)


def _scattered(text: str, rng: np.random.Generator) -> bytes:
    document = json.loads(text)
    for sensor in ("accelerometer", "gyroscope"):
        document[sensor]["bias"] = (np.array(document[sensor]["bias"]) + SCATTER_G * rng.standard_normal(3)).tolist()
    for file in document["inputs"]:
        file["sha256"] = rng.bytes(32).hex()
    return json.dumps(document).encode()


def spent(arguments: list[str]) -> tuple[float, float]:
    """Run a job; return its CPU time in s and its largest memory in MB."""
    job = subprocess.run([sys.executable, "-c", TELL, *arguments], check=True, stdout=subprocess.PIPE, text=True)
    seconds, megabytes = map(float, job.stdout.split())
    return seconds, megabytes


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--units", type=int, nargs="+", default=[10_000])
    parser.add_argument("--folder", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.folder or Path(temporary)
        folder.mkdir(exist_ok=True)
        source = next((folder / "results/small/batches").glob("*-0001"), None) or small(folder, 20)
        for units in arguments.units:
            _measure(folder, source, units)
    return 0


def _measure(folder: Path, source: Path, units: int) -> None:
    fleet = folder / f"fleet{units}"
    shutil.rmtree(fleet, ignore_errors=True)
    fleet.mkdir()
    shutil.copyfile(folder / "small/campaign.yaml", fleet / "campaign.yaml")
    lines = [
        f"U{i:05d},S{i},L{i // 500},2026-{1 + i % 12:02d}-{1 + i % 28:02d},mpu6050,acutronic,three_axis_turns"
        for i in range(units)
    ]
    (fleet / "units.csv").write_text("\n".join(["unit,serial,lot,date,sensor,table,procedure", *lines]) + "\n")
    campaign = load_campaign({"campaign": str(fleet), "results": str(folder / "results")})
    jobs, results, rng = settings_of_jobs(campaign), campaign.results, np.random.default_rng(1)
    for name, own in campaign.batches.items():
        if not (results / "batches" / name).is_dir():
            replicate(source, own, results / "batches" / name, rng)
    stages: dict[str, list[tuple[float, float]]] = {}
    for batch, files in jobs.items():
        for stage in [s for s in ("summary", "gather") if s in files]:
            config = results / "configs" / files[stage].name
            config.parent.mkdir(exist_ok=True)
            config.write_bytes(files[stage].content)
            name = "gathered.json" if stage == "gather" else f"{batch}/{stage}.zip"
            inputs: list[Any] = []
            if stage == "summary":
                for of in ("calibration", "validate", "diagnose", "report"):
                    inputs += [f"--{of}", results / "batches" / batch / f"{of}.zip"]
            given = ["--config", config, *inputs, "--output", results / "batches" / name]
            stages.setdefault(stage, []).append(spent([stage, *map(str, given)]))
    for stage, found in stages.items():
        cpu, memory = sum(f[0] for f in found), max(f[1] for f in found)
        costs = f"{1000 * cpu / units:.2f} ms a unit, {cpu:.1f} s; {memory:.0f} MB"
        print(f"{units} units, {stage}: {len(found)} jobs, {costs}", flush=True)


if __name__ == "__main__":
    raise SystemExit(main())
