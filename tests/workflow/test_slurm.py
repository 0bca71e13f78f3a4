"""A campaign through a real Slurm on this machine: the results are those of a local run, byte for byte.

Needs slurmctld, slurmd and munged (Debian: slurm-wlm, munge), root, and ``pip install '.[slurm]'``.
"""

import hashlib
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from .loopback_slurm import slurm, why_not

ROOT = Path(__file__).parents[2]
PLUGIN = "snakemake_executor_plugin_slurm"
HERE = ["--slurm-no-account", "--slurm-status-command", "squeue", "--slurm-init-seconds-before-status-checks", "2"]
HERE += ["--default-resources", "slurm_partition=debug", "mem_mb=1000", "runtime=10"]
HERE += ["--resources", "mem_mb=2000", "--latency-wait", "5"]

pytestmark = [
    pytest.mark.slurm,
    pytest.mark.skipif(bool(why_not()), reason=f"no Slurm can be started: {why_not()}"),
    pytest.mark.skipif(find_spec(PLUGIN) is None, reason="the extra slurm is not installed"),
]


def published(results: Path) -> dict[str, str]:
    """Return the digest of every file that a run publishes, but for those that hold its time."""
    files = [f for f in sorted(results.rglob("*")) if f.is_file()]
    files = [f for f in files if f.relative_to(results).parts[0] not in {"logs", "history"}]
    named = {str(f.relative_to(results)): f for f in files if not f.name.endswith(".lock")}
    return {name: hashlib.sha256(f.read_bytes()).hexdigest() for name, f in named.items()}


def run(directory: Path, results: str, *options: str, environment: dict[str, str]) -> None:
    command = [sys.executable, "-m", "snakemake", "-s", str(ROOT / "Snakefile"), *options]
    command += ["--config", "campaign=demo", f"results={directory / results}"]
    done = subprocess.run(
        command, cwd=directory, env=environment, capture_output=True, text=True, check=False, timeout=1800
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_demo_through_slurm_has_the_bytes_of_a_local_run(tmp_path: Path) -> None:
    run(tmp_path, "local", "--cores", "2", environment=dict(os.environ))
    with slurm() as environment:
        run(tmp_path, "cluster", "--profile", str(ROOT / "profiles" / "slurm"), *HERE, environment=environment)
    local, cluster = (published(tmp_path / name / "demo") for name in ("local", "cluster"))
    assert len(local) > 300
    assert cluster == local
