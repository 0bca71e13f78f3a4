import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from pipeline.app.commands import simulate

ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class Run:
    """A run of the real Snakefile, from a working directory of its own."""

    code: int
    output: str

    @property
    def jobs(self) -> set[str]:
        """Jobs that were run or, in a dry run, would be: rule, and batch, sensor and stage where it has them."""
        found = set()
        for rule, body in re.findall(r"^(?:local)?rule (\w+):\n((?:    .*\n)*)", self.output, re.MULTILINE):
            wildcards = re.search(r"wildcards: (.*)", body)
            values = re.findall(r"=([^,\n]+)", wildcards.group(1)) if wildcards else []
            found.add("/".join([rule, *values]))
        return found


@dataclass(frozen=True)
class Bench:
    """A working directory with a campaign in it."""

    directory: Path
    campaign: Path

    @property
    def results(self) -> Path:
        return self.directory / "results" / self.campaign.name

    def snakemake(self, *config: str, dry: bool = False) -> Run:
        command = [sys.executable, "-m", "snakemake", "--cores", "2", "-p", "-s", str(ROOT / "Snakefile")]
        command += ["--dry-run"] * dry + ["--config", f"campaign={self.campaign}", *config]
        environment = os.environ | {"PYTHONWARNINGS": "", "NO_COLOR": "1"}
        done = subprocess.run(
            command, cwd=self.directory, env=environment, capture_output=True, text=True, check=False, timeout=600
        )
        return Run(done.returncode, done.stdout + done.stderr)


@pytest.fixture(scope="session")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Raw recordings of one small unit."""
    directory = tmp_path_factory.mktemp("simulated") / "tiny"
    course = ["--step", "15", "--dwell", "1", "--rates", "60", "--validation", "60", "--seed", "4"]
    assert simulate.main([str(directory), "--units", "1", "--sensor", "mpu6050", "--quiet", *course]) == 0
    return next((directory / "raw").iterdir())
