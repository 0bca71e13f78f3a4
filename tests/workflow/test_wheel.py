"""A wheel, built without network, runs the demo outside a clone."""

import os
import shutil
import subprocess
import sys
import zipfile
from importlib.metadata import version
from pathlib import Path

import pytest

from .conftest import ROOT

pytestmark = [
    pytest.mark.workflow,
    pytest.mark.skipif(int(version("setuptools").split(".")[0]) < 77, reason="setuptools>=77 builds the wheel"),
]
BUILT_FROM = ("pipeline", "configs", "workflow", "profiles", "data/demo")
BUILD = "import sys; from setuptools import build_meta; build_meta.build_wheel(sys.argv[1])"


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The content of the wheel."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    for name in BUILT_FROM:
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "setup.py", "MANIFEST.in", "README.md", "LICENSE", "Snakefile"):
        shutil.copyfile(ROOT / name, source / name)
    environment = os.environ | {"PYTHONWARNINGS": ""}
    command = [sys.executable, "-c", BUILD, str(folder)]
    built = subprocess.run(command, cwd=source, env=environment, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    (wheel,) = folder.glob("imu_calibration-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "installed")
    return folder / "installed"


def test_the_wheel_holds_the_package_the_rules_the_configurations_and_the_demo(installed: Path) -> None:
    def files(root: Path, *folders: str) -> set[str]:
        return {
            str(f.relative_to(root))
            for folder in folders
            for f in (root / folder).rglob("*")
            if f.is_file() and "__pycache__" not in f.parts
        }

    assert files(installed, "pipeline") >= files(ROOT, "pipeline")
    shipped = installed / "pipeline" / "shipped"
    assert files(shipped, *BUILT_FROM[1:]) == files(ROOT, *BUILT_FROM[1:])
    (entry_points,) = installed.glob("*.dist-info/entry_points.txt")
    assert "imu-calibration = pipeline.__main__:main" in entry_points.read_text()
    assert not (installed / "tests").exists()


def test_the_installed_command_plans_a_run_of_the_shipped_demo(installed: Path, tmp_path: Path) -> None:
    def run(*words: str) -> str:
        environment = os.environ | {"PYTHONPATH": str(installed), "PYTHONWARNINGS": "", "NO_COLOR": "1"}
        command = [sys.executable, "-m", "pipeline", *words]
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout + done.stderr

    (metadata,) = installed.glob("*.dist-info")
    assert run("--version").split()[1] == metadata.name.split("-")[1].removesuffix(".dist")
    planned = run("run", "demo", "filter=rc_low_pass", "--results", "elsewhere", "--", "--dry-run")
    assert "elsewhere/demo/batches" in planned
    assert not (tmp_path / "elsewhere").exists()  # a dry run writes nothing
    assert "imu-calibration run bench" in run("new", "bench")
