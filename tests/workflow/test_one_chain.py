"""A run, commands, study and the thesis's seeds reach the same functions of the steps."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from calls import OF_STEPS, counted, names
from whole_run import run_campaign

import pipeline
from imu_research.study.cases import draw
from imu_research.study.run import judge
from imu_research.thesis.seeds import study_of
from pipeline.app.commands import add, check, guide, plan, simulate
from pipeline.unit import STEPS

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable

pytestmark = pytest.mark.workflow

ROOT = Path(__file__).parents[2]
ALL = {step.function.rpartition(".")[2]: name for name, step in STEPS.items()}
TO_CALIBRATION = {"ingest", "filter", "fit", "validate", "diagnose", "calibration"}
BY_HAND = "--sensor mpu6050 --procedure multi_position --table hand --positions 24 --static 0 --validation 0 --quiet"
# Functions of the library that a step calls, and what may call them beside the steps.
OF_A_STEP = {
    "check_recordings": {"pipeline/app/commands/readings.py"},  # of a log that belongs to no unit
    "apply_filter": {"imu_research/thesis/seeds.py"},  # of exact readings, which have no noise to estimate
    "fit_stage": set(),
    "with_stated": set(),
    "validate": set(),
    "diagnose": set(),
    "calibration_document": set(),
}


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A unit that was recorded by hand."""
    directory = tmp_path_factory.mktemp("chain") / "hand"
    assert simulate.main([str(directory), *BY_HAND.split()]) == 0
    return directory


def _add(campaign: Path, monkeypatch: pytest.MonkeyPatch) -> int:
    """Add an effect; the run of the command is one in this process."""

    def run(arguments: argparse.Namespace, _: list[str]) -> int:
        return run_campaign(Path(arguments.campaign), results=arguments.results)[1]

    monkeypatch.setattr(add, "run_snakemake", run)
    words = [str(campaign), "U001", "gyroscope.g_sensitivity", "--results", str(campaign.parent / "added")]
    return add.main(words)


CLIENTS: dict[str, tuple[Callable[[Path, pytest.MonkeyPatch], Any], set[str]]] = {
    "run": (lambda campaign, _: run_campaign(campaign), set(STEPS)),
    "calibrate_unit": (lambda campaign, _: pipeline.calibrate_unit(campaign, "U001"), TO_CALIBRATION),
    "check": (lambda campaign, _: check.main(["--campaign", str(campaign), "--unit", "U001"]), TO_CALIBRATION),
    "guide": (lambda campaign, _: guide.main([str(campaign / "raw/U001/recording.csv")]), {"ingest", "filter", "fit"}),
    "plan": (
        lambda *_: plan.main(["--sensor", "mpu6050", "--procedure", "multi_position", "--no-extra"]),
        {"filter", "fit"},
    ),
    "add": (_add, set(STEPS)),
    "study": (lambda *_: judge(draw("null_normal", 0, 2)), TO_CALIBRATION - {"calibration"}),
    "seeds": (lambda *_: study_of(ROOT / "data/thesis", [0], "mpu6050-1-stop-1s"), {"filter", "fit"}),
}


@pytest.mark.parametrize("client", CLIENTS)
def test_every_client_reaches_the_functions_of_the_steps(
    client: str, campaign: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    call, steps = CLIENTS[client]
    with counted(OF_STEPS) as calls:
        call(campaign, monkeypatch)
    assert {ALL[name] for name in names(calls)} == steps


def test_nothing_but_the_steps_calls_what_they_call_of_the_library() -> None:
    callers: dict[str, set[str]] = {name: set() for name in OF_A_STEP}
    for file in [*ROOT.glob("pipeline/**/*.py"), *ROOT.glob("imu_research/**/*.py"), *ROOT.glob("benchmarks/*.py")]:
        path = file.relative_to(ROOT).as_posix()
        if not path.startswith("pipeline/app/steps/"):
            for node in ast.walk(ast.parse(file.read_text())):
                if isinstance(node, ast.ImportFrom):
                    for name in OF_A_STEP.keys() & {alias.name for alias in node.names}:
                        callers[name].add(path)
    assert callers == OF_A_STEP
