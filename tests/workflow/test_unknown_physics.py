"""Physics that no effect knows, through every stage: a file is suggested and, copied, leaves noise alone."""

import csv
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from whole_run import run_campaign

from .conftest import Bench

pytestmark = pytest.mark.workflow

SHEET = "unit,sensor\nbuzzing,mpu6050\nquiet,mpu6050\n"
FILE = "buzzing_gyroscope_unknown.yaml"


def with_gear(file: Path) -> None:
    """Let the gyroscope of a recording read a wave of seven cycles a turn beside what it read."""
    rows = list(csv.DictReader(file.read_text().splitlines()))
    if "table_angle_deg" not in rows[0]:
        return
    for row in rows:
        wave = 0.05 * np.cos(np.radians(7.0 * float(row["table_angle_deg"])) + 0.5)
        row["gyro_y_dps"] = f"{float(row['gyro_y_dps']) + wave:.7f}"
    with file.open("w", newline="") as out:
        writer = csv.DictWriter(out, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def diagnosis(bench: Bench, unit: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((bench.results / "diagnoses" / f"{unit}.json").read_text())
    return found


def published(bench: Bench) -> set[str]:
    return {file.name for file in (bench.results / "diagnoses").glob("[!.]*")}


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory, simulated: Path) -> Bench:
    directory = tmp_path_factory.mktemp("unknown")
    campaign = directory / "strange"
    for unit in ("buzzing", "quiet"):
        shutil.copytree(simulated, campaign / "raw" / unit)
    for file in (campaign / "raw" / "buzzing").glob("*.csv"):
        with_gear(file)
    (campaign / "units.csv").write_text(SHEET)
    return Bench(directory, campaign)


@pytest.fixture(scope="module")
def first(bench: Bench) -> None:
    assert run_campaign(bench.campaign)[1] == 0


@pytest.mark.usefixtures("first")
def test_the_unit_that_shows_it_gets_a_file_and_the_other_none(bench: Bench) -> None:
    part = diagnosis(bench, "buzzing")["gyroscope"]
    assert part["verdict"] == "unexplained"
    assert part["suggested_file"] == FILE
    assert part["unexplained"][0]["shape"].startswith("7 cycles per turn of the table, amplitude 0.")
    assert part["unexplained"][0]["axes"] == ["y"]
    assert part["unexplained"][0]["size"] == pytest.approx(0.05, rel=0.05)
    assert published(bench) == {"buzzing.json", FILE, "quiet.json"}
    assert diagnosis(bench, "quiet")["gyroscope"]["suggested_effect"] is None
    page = (bench.results / "reports" / "buzzing.html").read_text()
    assert f"copy diagnoses/{FILE}" in page


@pytest.mark.usefixtures("first")
def test_the_file_copied_as_it_is_told_runs_and_leaves_noise_alone(bench: Bench) -> None:
    before = diagnosis(bench, "buzzing")["gyroscope"]["residual_over_noise"]
    effects = bench.campaign / "effects"
    effects.mkdir()
    shutil.copyfile(bench.results / "diagnoses" / FILE, effects / "unknown_angle.yaml")
    assert run_campaign(bench.campaign, overrides="effects.gyroscope=[unknown_angle]")[1] == 0
    part = diagnosis(bench, "buzzing")["gyroscope"]
    assert (part["verdict"], part["selected"], part["unexplained"]) == ("nothing_missing", [], [])
    assert part["residual_over_noise"] < 1.1 < before
    assert published(bench) == {"buzzing.json", "quiet.json"}
