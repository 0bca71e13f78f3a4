"""What it costs to resolve a large campaign: ``python benchmarks/parse_fleet.py [UNITS]``; CPU seconds.

Each unit of the campaign has overrides of its own, and seven files of recordings. Two figures: the configuration alone
(``load_campaign``), and the whole of ``snakemake --dry-run``, which is what every call of Snakemake costs before a job.
"""

import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from pipeline.app.config import load_campaign

ROOT = Path(__file__).parents[1]
FILES = ("accel_x", "accel_y", "accel_z", "gyro_x", "gyro_y", "gyro_z", "validation")


def lay_out(directory: Path, count: int) -> None:
    rows = ["unit,serial,lot,date,sensor,overrides"]
    for i in range(count):
        own = f"table.gravity_g={0.99 + i * 1e-6:.6f};filter=rc_low_pass;filter.cutoff_hz={1 + i * 1e-4:.4f}"
        rows.append(f"U{i:05d},S{i:05d},L{i // 500},2026-01-02,mpu6050,{own}")
        folder = directory / "raw" / f"U{i:05d}"
        folder.mkdir(parents=True)
        for name in FILES:
            (folder / f"{name}.csv").touch()
    (directory / "units.csv").write_text("\n".join(rows) + "\n")
    (directory / "campaign.yaml").write_text("overrides: [batch_size=200]\n")


def main() -> None:
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 10_000
    with tempfile.TemporaryDirectory() as folder:
        campaign = Path(folder) / "fleet"
        lay_out(campaign, count)
        start = time.process_time()
        load_campaign({"campaign": str(campaign)})
        print(f"{count} units: configuration {time.process_time() - start:.1f} s")
        command = [sys.executable, "-m", "snakemake", "-s", str(ROOT / "Snakefile"), "--cores", "2", "--dry-run"]
        command += ["--quiet", "--config", f"campaign={campaign}"]
        subprocess.run(command, cwd=folder, check=True, capture_output=True, env=os.environ | {"PYTHONPATH": str(ROOT)})
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        print(f"snakemake --dry-run: {used.ru_utime + used.ru_stime:.1f} s, {used.ru_maxrss / 1024:.0f} MB")


if __name__ == "__main__":
    main()
