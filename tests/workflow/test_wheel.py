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
BUILT_FROM = ("pipeline", "imu_calibration", "imu_logs", "imu_research", "configs", "workflow", "profiles", "data/demo")
OF_THE_TOP = (
    "pyproject.toml", "setup.py", "MANIFEST.in", "README.md", "LICENSE", "Snakefile", "CHANGELOG.md",
    "requirements.lock",
)  # fmt: skip
PACKAGES, SHIPPED = BUILT_FROM[:4], BUILT_FROM[4:]
PIPELINE = ("-m", "pipeline")
BUILD = "import sys; from setuptools import build_meta as b; to = sys.argv[1]; b.build_wheel(to); b.build_sdist(to)"


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The content of the wheel."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    for name in (*BUILT_FROM, "docs"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in OF_THE_TOP:
        shutil.copyfile(ROOT / name, source / name)
    (source / "tests").mkdir()
    shutil.copyfile(__file__, source / "tests" / "test_wheel.py")
    environment = os.environ | {"PYTHONWARNINGS": ""}
    command = [sys.executable, "-c", BUILD, str(folder)]
    built = subprocess.run(command, cwd=source, env=environment, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    (wheel,) = folder.glob("imu_calibration-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "installed")
    (sdist,) = folder.glob("imu_calibration-*.tar.gz")
    shutil.unpack_archive(sdist, folder / "sdist")
    return folder / "installed"


def test_the_source_distribution_holds_the_documents_and_no_test(installed: Path) -> None:
    (source,) = (installed.parent / "sdist").iterdir()
    found = {f.name for f in source.iterdir()}
    assert {"docs", "CHANGELOG.md", "requirements.lock", "pipeline", "configs", "workflow", "Snakefile"} <= found
    assert not {"tests", "benchmarks", "results"} & found


def test_the_wheel_holds_the_package_the_rules_the_configurations_and_the_demo(installed: Path) -> None:
    def files(root: Path, *folders: str) -> set[str]:
        return {
            str(f.relative_to(root))
            for folder in folders
            for f in (root / folder).rglob("*")
            if f.is_file() and "__pycache__" not in f.parts
        }

    assert files(installed, *PACKAGES) >= files(ROOT, *PACKAGES)
    shipped = installed / "pipeline" / "shipped"
    assert files(shipped, *SHIPPED) == files(ROOT, *SHIPPED)
    profiles = {f.name for f in (ROOT / "configs" / "ingest").glob("*.yaml")}
    assert {f.name for f in (installed / "imu_logs" / "profiles").glob("*.yaml")} == profiles
    (entry_points,) = installed.glob("*.dist-info/entry_points.txt")
    assert "imu-calibration = pipeline.__main__:main" in entry_points.read_text()
    assert not (installed / "tests").exists()


def run(installed: Path, folder: Path, *words: str) -> str:
    environment = os.environ | {"PYTHONPATH": str(installed), "PYTHONWARNINGS": "", "NO_COLOR": "1"}
    command = [sys.executable, *words]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


def test_the_installed_package_has_two_names(installed: Path, tmp_path: Path) -> None:
    for first, second in (("imu_calibration", "pipeline"), ("pipeline", "imu_calibration")):
        code = (
            f"import {first}, {second}, {second}.core.errors; from {first}.core.errors import PipelineError as error; "
        )
        code += f"print({first} is {second}, error is {second}.core.errors.PipelineError, {first}.__file__)"
        assert run(installed, tmp_path, "-c", code).split() == ["True", "True", f"{installed}/pipeline/__init__.py"]
    by_one, by_other = (run(installed, tmp_path, "-m", name, "--version") for name in ("imu_calibration", "pipeline"))
    assert by_one == by_other


def test_the_installed_command_plans_a_run_of_the_shipped_demo(installed: Path, tmp_path: Path) -> None:
    (metadata,) = installed.glob("*.dist-info")
    assert run(installed, tmp_path, *PIPELINE, "--version").split()[1] == metadata.name.split("-")[1].removesuffix(
        ".dist"
    )
    planned = run(
        installed, tmp_path, *PIPELINE, "run", "demo", "filter=rc_low_pass", "--results", "elsewhere", "--", "--dry-run"
    )
    assert "elsewhere/demo/batches" in planned
    assert not (tmp_path / "elsewhere").exists()  # a dry run writes nothing
    assert "imu-calibration run bench" in run(installed, tmp_path, *PIPELINE, "new", "bench")
