"""A campaign without a shared disk: each job in a directory of its own, files by a storage plugin; the same bytes.

Needs ``pip install snakemake-storage-plugin-fs snakemake-executor-plugin-cluster-generic`` and rsync.
"""

import hashlib
import os
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from pipeline.app.results_folder import PUBLISHED_PATHS

ROOT = Path(__file__).parents[2]
PLUGINS = ("snakemake_storage_plugin_fs", "snakemake_executor_plugin_cluster_generic")
SENT = ("Snakefile", "workflow", "pipeline", "configs")  # what Snakemake takes from git and sends to a job
# Runs a job in the background, in an empty directory, as a node without the disk of this machine would.
SUBMIT = """\
#!/bin/bash
own=$(mktemp -d {nodes}/XXXXXX)
cp "$1" $own/job.sh
cp -r --parents {sent} .snakemake/imu-calibration $own
cd $own
(bash job.sh > out 2>&1 < /dev/null; echo $? > code) > /dev/null 2>&1 &
echo $own
"""
STATUS = """\
#!/bin/bash
[ -f $1/code ] || {{ echo running; exit; }}
[ "$(cat $1/code)" = 0 ] && echo success || echo failed
"""

pytestmark = [
    pytest.mark.storage,
    pytest.mark.skipif(not all(map(find_spec, PLUGINS)), reason=f"{' or '.join(PLUGINS)} is not installed"),
    pytest.mark.skipif(shutil.which("rsync") is None, reason="rsync is not installed"),
]


def published(results: Path) -> dict[str, str]:
    """Return the digest of every published file."""
    files = [f for name in PUBLISHED_PATHS for f in [results / name, *(results / name).rglob("*")] if f.is_file()]
    return {str(f.relative_to(results)): hashlib.sha256(f.read_bytes()).hexdigest() for f in files}


def damage(demo: Path) -> None:
    """Add a unit without recordings, and one with a recording without numbers."""
    damaged = demo / "raw" / "damaged"
    shutil.copytree(demo / "raw" / "mpu6050-1", damaged)
    (damaged / "accel_x.csv").write_text("time_s,accel_x_g\n0,none\n")
    with (demo / "units.csv").open("a") as sheet:
        sheet.writelines(f"{unit},,,,mpu6050,acutronic,three_axis_turns,,,\n" for unit in ("absent", "damaged"))


def test_the_demo_without_a_shared_disk_has_the_bytes_of_a_local_run(tmp_path: Path) -> None:
    clone, nodes, storage = (tmp_path / name for name in ("clone", "nodes", "storage"))
    for name in (*SENT, "profiles", "data/demo"):
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copyfile
        (clone / name).parent.mkdir(parents=True, exist_ok=True)
        copy(ROOT / name, clone / name)
    damage(clone / "data" / "demo")
    nodes.mkdir()
    storage.mkdir()
    subprocess.run(["git", "init", "-q"], cwd=clone, check=True)
    scripts = {"submit": SUBMIT.format(nodes=nodes, sent=" ".join(SENT)), "status": STATUS.format()}
    options = ["--executor", "cluster-generic", "--jobs", "2", "--shared-fs-usage", "none", "--latency-wait", "5"]
    for name, text in scripts.items():
        (tmp_path / name).write_text(text)
        (tmp_path / name).chmod(0o755)
        options += [f"--cluster-generic-{name}-cmd", str(tmp_path / name)]
    options += ["--default-storage-provider", "fs", "--default-storage-prefix", str(storage)]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{environment['PATH']}"
    for results, given in (("apart", options), ("local", ["--cores", "2"])):
        command = [sys.executable, "-m", "snakemake", *given, "--config", f"results={results}"]
        done = subprocess.run(
            command, cwd=clone, env=environment, capture_output=True, text=True, check=False, timeout=1800
        )
        assert done.returncode == 1, done.stdout + done.stderr
        assert "2 units failed" in done.stderr
    assert len(list(nodes.iterdir())) == 25  # every job but collect, gather and verdict
    local, apart = (published(clone / name / "demo") for name in ("local", "apart"))
    assert len(local) > 250
    assert apart == local
