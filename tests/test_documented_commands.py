"""Every command that a document shows: its options exist and, behind the marker ``documents``, it runs.

``python -m pytest -m documents tests/test_documented_commands.py`` takes some minutes. It runs the commands of the code
blocks, document by document, in a copy of the repository where the files that a reader would have are laid out. The
tutorial has a test of its own (``tests/workflow/test_tutorial.py``). ``.ci/run`` runs the second block of the README.
"""

import argparse
import ast
import os
import re
import shlex
import shutil
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from pipeline.__main__ import COMMANDS

ROOT = Path(__file__).parents[1]
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), ROOT / "CONTRIBUTING.md"]
FENCED = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)  # language, text
INDENTED = re.compile(r"(?:^ {4}.*\n)+", re.MULTILINE)
INLINE = re.compile(r"`((?:nice )?(?:python|snakemake|imu-calibration) [^`]*)`")
PROGRAMS = ("python ", "snakemake ", "imu-calibration ", "pip ", "cp ")
TO_FILL_IN = re.compile(r"\.\.\.|\bCOMMAND\b|\w\|\w")  # by the reader; the rest of such a line is no command
CONFIG = {"campaign", "results", "overrides", "unit_overrides", "take_over", "python_effects"}

NEEDED = ("Snakefile", "configs", "data", "pipeline", "imu_calibration", "profiles", "workflow", "tests", "README.md")
U1 = "cp data/demo/raw/mpu6050-1/*.csv {0}/raw/U1/"
BEFORE = {  # what a reader would have at that command
    "README.md": "cp data/demo/raw/mpu6050-1/validation.csv log.csv; snakemake --cores 2; "
    "python -m pipeline simulate my_fleet --units 3",
    "python -m pipeline check --campaign my_bench": U1.format("my_bench"),
    "apply.md": "cp data/demo/raw/mpu6050-1/static.csv drive.csv; "
    "cp data/demo/raw/mpu6050-1-mcap/validation.mcap drive.mcap; "
    "cd results/demo/exports/mpu6050-1; cp kalibr.yaml ../../../../my_kalibr.yaml; "
    "cp imu_tk_acc.calib ../../../../rig_acc.calib; cp imu_tk_gyro.calib ../../../../rig_gyro.calib; "
    "cp inav.txt ../../../..",
    "effects_of_your_own.md": "cp log.csv LOG.csv; python -m pipeline new data/bench --sensor mpu6050; "
    + U1.format("data/bench"),
    "fleet.md": "printf 'unit,sensor\\nU0123,mpu6050\\n' > my_fleet/units.csv; "
    "python -m pipeline simulate other/my_fleet --units 1",
    "record.md": "rm -rf my_bench",
    "your_bench.md": "sed '1s/time_s/Time (s)/; 1s/accel_\\(.\\)_g/A\\1 (g)/g; 1s/gyro_\\(.\\)_dps/G\\1 (deg\\/s)/g' "
    "log.csv > my_log.csv; mkdir my_logs; cp my_log.csv my_logs; rm -rf my_bench; "
    "python -m pipeline new my_bench --sensor mpu6050; " + U1.format("my_bench"),
}
FILES = {
    "boards.md": {"yaml": "two_chips/simulation.yaml"},
    "effects_of_your_own.md": {"yaml": "data/bench/effects/gear_mesh.yaml", "python": "path/to/loose_part.py"},
}
MAY_END_WITH = {
    "python -m pipeline check my_log": 2,  # logs that need a profile
    "python -m pipeline add bench U1 --suggested": 2,  # these recordings hide nothing
    "python -m pipeline unpack my_fleet": 2,  # so few units have their files already
}
NOT_RUN = {  # by the start of the command, and why
    "pip ": "no package is installed by a test",
    "snakemake --profile profiles/slurm": "python -m pytest -m slurm runs it",
    "snakemake --profile profiles/kubernetes": "needs its executor: docs/fleet.md states the dry run",
    "snakemake --profile profiles/aws": "needs its executor: docs/fleet.md states the dry run",
    "python -m pipeline.app.field_logs.ros2_node": "needs ROS 2; tests/commands play a log to it",
    "python -m pipeline guide": "waits for a growing log; tests/commands run it",
    "python -m pipeline thesis seeds": "some minutes; tests/thesis makes some of its rows",
    "python -m pytest": "the tests themselves",
    "python benchmarks/peers.py": "needs other programs, which it compiles",
}
NOT_RUN_IN = {
    "find_the_missing_effect.md": "test_tutorial.py",
    "formats.md": "needs a log of a PX4 board; tests/imu_logs read such",
}
LONG = ("snakemake --cores 2 --config campaign=thesis",)  # planned, as it simulates and fits for minutes


class Parsed(Exception):  # noqa: N818  (no error)
    """The arguments of a command are accepted."""


def commands(document: Path, *, inline: bool) -> list[str]:
    """Return the commands of the blocks of a document, and of its sentences, each in one line without comment."""
    text = document.read_text(encoding="utf-8")
    blocks = [block for language, block in FENCED.findall(text) if language in {"", "bash"}]
    blocks += [block.replace("\n    ", "\n")[4:] for block in INDENTED.findall(FENCED.sub("", text))]
    lines = [line.removeprefix("$ ") for block in blocks for line in re.sub(r" *\\\n *", " ", block).splitlines()]
    found = [re.sub(r" {2,}#.*", "", line).strip() for line in lines if line.startswith(PROGRAMS)]
    if inline:
        found += [" ".join(one.split()) for one in INLINE.findall(text)]
    return [one for one in found if not one.endswith("&&") and not TO_FILL_IN.search(one)]


def script_of(words: list[str]) -> Path:
    return ROOT / next(word for word in words if word.endswith(".py"))


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda file: file.name)
def test_the_options_of_commands_exist(document: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def accepting(parse: Any) -> Any:
        def parsed(*arguments: Any, **keywords: Any) -> None:
            parse(*arguments, **keywords)
            raise Parsed

        return parsed

    for name in ("parse_args", "parse_intermixed_args"):
        monkeypatch.setattr(argparse.ArgumentParser, name, accepting(getattr(argparse.ArgumentParser, name)))
    for command in commands(document, inline=True):
        words = ["3" if word == "N" else word for word in shlex.split(command.removeprefix("nice "))]
        if words[:3] == ["python", "-m", "pipeline"] or words[0] == "imu-calibration":
            name, *rest = words[3 if words[0] == "python" else 1 :]
            if rest:
                module, function = COMMANDS[name]
                with pytest.raises(Parsed):
                    getattr(import_module(module), function)(rest)
            else:
                assert name in COMMANDS
        elif words[0] == "snakemake" and "--config" in words:
            settings = words[words.index("--config") + 1 :]
            assert {word.partition("=")[0] for word in settings if not word.startswith("-")} <= CONFIG, command
        elif words[0] == "python" and words[1] != "-m":
            source = script_of(words).read_text()
            assert all(f'"{word}"' in source for word in words if word.startswith("--")), command


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("copy")
    for name in NEEDED:
        (shutil.copytree if (ROOT / name).is_dir() else shutil.copy2)(ROOT / name, directory / name)
    (directory / "tmp").mkdir()
    return directory


def run(command: str, directory: Path) -> subprocess.CompletedProcess[str]:
    python = Path(sys.executable).parent
    paths = {"PATH": f"{python}{os.pathsep}{os.environ['PATH']}", "PYTHONPATH": str(directory)}
    command = re.sub(r"(?<![\w.])/(tmp|data)/", f"{directory}/\\1/", command)
    command = command.replace("SENSOR.NAME", "accelerometer.NAME").replace("NAME", "quadratic_nonlinearity")
    environment = os.environ | paths | {"PYTHONWARNINGS": "", "NO_COLOR": "1"}
    return subprocess.run(
        ["bash", "-e", "-c", command],
        cwd=directory,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
        timeout=1800,
    )


@pytest.mark.documents
@pytest.mark.parametrize(
    "document",
    [d for d in DOCUMENTS if d.name not in NOT_RUN_IN and commands(d, inline=False)],
    ids=lambda file: file.name,
)
def test_the_commands_run(document: Path, copy: Path) -> None:
    if document.name in BEFORE:
        laid_out = run(BEFORE[document.name], copy)
        assert laid_out.returncode == 0, laid_out.stdout
    for language, file in FILES.get(document.name, {}).items():
        block = re.search(rf"^```{language}\n(.*?)^```", document.read_text(), re.MULTILINE | re.DOTALL)
        assert block
        (copy / file).parent.mkdir(parents=True, exist_ok=True)
        (copy / file).write_text(block[1])
    for command in commands(document, inline=False):
        if command.startswith(tuple(NOT_RUN)):
            continue
        if document.name == "README.md" and command in BEFORE:
            assert run(BEFORE[command], copy).returncode == 0
        done = run(command + " --dry-run" * command.startswith(LONG), copy)
        allowed = {0, *(code for start, code in MAY_END_WITH.items() if command.startswith(start))}
        assert done.returncode in allowed, f"{command}\n{done.stdout}"


SCRIPTS = [*sorted((ROOT / "benchmarks").glob("*.py")), *sorted((ROOT / "tests" / "study").glob("*.py"))]


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_what_a_benchmark_or_a_study_imports_from_the_package_exists(script: Path) -> None:
    tree = ast.parse(script.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and str(node.module).split(".")[0] == "pipeline":
            module = import_module(str(node.module))
            for name in node.names:
                assert hasattr(module, name.name) or import_module(f"{node.module}.{name.name}")


def test_the_shipped_demo_has_no_effect_that_a_user_is_to_add() -> None:
    assert not (ROOT / "data" / "demo" / "devices").exists()
