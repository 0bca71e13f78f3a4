"""The real Snakefile on tiny campaigns: what it makes, what it reruns, and what one bad unit does to the others."""

import csv
import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from pipeline.app.config import code_digest

from .conftest import ROOT, Bench, Run
from .schemas import validator, violations

pytestmark = pytest.mark.workflow

SHEET = """unit,serial,lot,date,method,overrides,colour
A1,S1,L1,2026-01-02,,,red
A2,S2,L1,2026-01-03,,effects.gyroscope=[g_sensitivity],
B1,S1,L1,2026-01-02,staged,filter=rc_low_pass,blue
"""
REFERENCE, STAGED = "reference_least_squares-0001", "staged-0001"
END = {"gather", "verdict", "all"}


def lay_out(directory: Path, sheet: str, simulated: Path, units: list[str]) -> Bench:
    campaign = directory / "bench-7"
    for unit in units:
        shutil.copytree(simulated, campaign / "raw" / unit)
    (campaign / "units.csv").write_text(sheet)
    return Bench(directory, campaign)


def summary(bench: Bench) -> list[dict[str, str]]:
    return list(csv.DictReader((bench.results / "summary.csv").read_text().splitlines()))


@dataclass(frozen=True)
class Mended:
    """Runs of a campaign with one bad unit: as it is, once more, and when its recording is replaced by a good one."""

    bench: Bench
    first: Run
    rows: list[dict[str, str]]  # of the first run, as what follows
    failed: dict[str, Any]
    page: str
    unlike_schema: list[str]
    again: Run
    mended: Run


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory, simulated: Path) -> Mended:
    bench = lay_out(tmp_path_factory.mktemp("bench"), SHEET, simulated, ["A1", "A2", "B1"])
    bad = bench.campaign / "raw" / "A1" / "gyro_y.csv"
    lines = bad.read_text().splitlines()
    cells = lines[40].split(",")
    lines[40] = ",".join([*cells[:2], "broken", *cells[3:]])
    bad.write_text("\n".join(lines) + "\n")
    first = bench.snakemake()
    rows, unlike_schema = summary(bench), violations(bench.results)
    failed = json.loads((bench.results / "calibrations" / "A1.json").read_text())
    page = (bench.results / "index.html").read_text()
    assert (bench.results / "reports" / "A1.html").is_file()
    again = bench.snakemake()
    shutil.copy(simulated / "gyro_y.csv", bad)
    return Mended(bench, first, rows, failed, page, unlike_schema, again, bench.snakemake())


@pytest.fixture(scope="module")
def bench(runs: Mended) -> Bench:
    assert runs.mended.code == 0, runs.mended.output
    return runs.bench


def test_one_bad_unit_leaves_the_others_calibrated_and_is_named_at_the_end(runs: Mended) -> None:
    assert runs.first.code != 0
    assert [(r["unit"], r["status"]) for r in runs.rows] == [("A1", "failed"), ("A2", "ok"), ("B1", "ok")]
    assert runs.unlike_schema == []
    assert runs.failed["status"] == "failed"
    assert runs.failed["error"]["file"].endswith("gyro_y.csv:41")
    assert "broken" in runs.failed["error"]["message"]
    assert "A1" in runs.page
    last = runs.first.output.strip().splitlines()[-3:]
    assert any("A1: " in line and "gyro_y.csv:41" in line and "broken" in line for line in last), last


def test_a_second_run_with_a_bad_unit_names_it_again_and_computes_nothing(runs: Mended) -> None:
    assert runs.again.code != 0
    assert runs.again.jobs == {"verdict"}
    assert any("A1: " in line and "gyro_y.csv:41" in line for line in runs.again.output.strip().splitlines()[-3:])


def test_a_mended_unit_reruns_its_batch_only(runs: Mended) -> None:
    assert runs.mended.code == 0
    assert any(REFERENCE in job for job in runs.mended.jobs)
    assert not [job for job in runs.mended.jobs if STAGED in job]


def test_a_change_in_the_code_of_a_method_makes_its_fits_again(runs: Mended) -> None:
    """Snakemake runs a job again where its settings file has another name: the file holds a digest of the code."""
    found = re.findall(r" fit --config (\S+) --sensor (\S+) --stage (\S+) ", runs.first.output)
    settings = {(sensor, stage): runs.bench.directory / file for file, sensor, stage in found}
    codes = {fit: json.loads(file.read_text())["code"] for fit, file in settings.items()}
    modules = {
        ("accelerometer", "reference_least_squares"): "reference_least_squares",
        ("gyroscope", "reference_least_squares"): "reference_least_squares",
        ("accelerometer", "misalignment"): "accelerometer.staged",
        ("gyroscope", "bias"): "gyroscope.staged",
    }
    for job, module in modules.items():
        assert codes[job].endswith(code_digest(f"pipeline.estimation.{module}"))
        assert code_digest("pipeline.app.steps.fit") in codes[job]


def test_every_file_of_a_unit_is_published_under_its_stable_path(bench: Bench) -> None:
    for unit in ("A1", "A2", "B1"):
        for path in (
            f"calibrations/{unit}.json",
            f"validations/{unit}.json",
            f"diagnoses/{unit}.json",
            f"reports/{unit}.html",
            f"exports/{unit}/kalibr.yaml",
            f"exports/{unit}/calibration.h",
        ):
            assert (bench.results / path).stat().st_size > 100
    assert json.loads((bench.results / "calibrations" / "A2.json").read_text())["gyroscope"]["effects"]
    rows = summary(bench)
    assert [(r["unit"], r["status"], r["colour"]) for r in rows] == [
        ("A1", "ok", "red"),
        ("A2", "ok", ""),
        ("B1", "ok", "blue"),
    ]


def test_a_report_of_snakemake_holds_every_page(bench: Bench) -> None:
    run = bench.snakemake("--report", "report.zip")
    assert run.code == 0, run.output
    with zipfile.ZipFile(bench.directory / "report.zip") as report:
        names = {Path(name).name for name in report.namelist()}
        (index,) = (name for name in report.namelist() if name.endswith("/report.html"))
        text = report.read(index).decode()
    assert {"index.html", "summary.csv", "A1.html", "A2.html", "B1.html"} <= names
    assert all(re.search(rf'"unit": ?"{unit}"', text) for unit in ("A1", "A2", "B1"))


def test_the_published_files_are_as_their_schemas_say_and_others_are_not(bench: Bench) -> None:
    assert violations(bench.results) == []
    calibration = json.loads((bench.results / "calibrations" / "A1.json").read_text())
    for key, wrong in (("bias", [0.0, 0.0]), ("matrix", [[1.0]]), ("unit", "mg"), ("covariance", None)):
        assert not validator("calibration").is_valid(
            calibration | {"gyroscope": calibration["gyroscope"] | {key: wrong}}
        )


def test_lint_finds_nothing_but_what_the_workflows_readme_justifies(bench: Bench) -> None:
    found = set(re.findall(r"^    \* (.+?):?(?: in line .*)?$", bench.snakemake("--lint").output, re.MULTILINE))
    readme = (ROOT / "workflow" / "README.md").read_text()
    assert found
    assert not [finding for finding in found if finding.rstrip(".:") not in readme]


def after(batch: str) -> set[str]:
    return {f"{stage}/{batch}" for stage in ("validate", "diagnose", "calibration", "export", "report", "summary")}


def test_changing_settings_reruns_the_stages_that_read_them(bench: Bench) -> None:
    change = '{A2: ["effects.gyroscope=[bias_temperature]"], B1: [filter.zero_phase=true]}'
    chains = {
        "accelerometer": ("orthogonality", "misalignment", "bias", "scale_factor"),
        "gyroscope": ("bias", "orthogonality_and_misalignment", "scale_factor"),
    }
    fits = {f"fit/{STAGED}/{sensor}/{stage}" for sensor, chain in chains.items() for stage in chain}
    rerun = {f"fit/{REFERENCE}/gyroscope/effects", f"filter/{STAGED}"} | fits | after(REFERENCE) | after(STAGED)
    assert bench.snakemake(f"unit_overrides={change}", dry=True).jobs == rerun | END


def test_a_refused_configuration_stops_the_run_before_any_job_with_one_message(bench: Bench) -> None:
    run = bench.snakemake("overrides=filter.cutof_hz=5")
    assert run.code != 0
    assert run.output.count("filter.cutof_hz=5: unknown key; nearest: cutoff_hz") == 1
    assert "unit A1, A2, B1" in run.output
    assert not run.jobs
    assert "Traceback" not in run.output


def test_campaign_results_and_environment_may_lie_anywhere(tmp_path: Path, simulated: Path) -> None:
    name = "it's {mine}, all"
    bench = lay_out(tmp_path / "a b,{c}", "unit,procedure,overrides\nA1,own,method.gyroscope=null\n", simulated, ["A1"])
    campaign = bench.campaign.rename(bench.directory / name)
    own = campaign / "configs" / "procedure" / "own.yaml"
    own.parent.mkdir(parents=True)
    own.write_bytes((ROOT / "configs" / "procedure" / "three_axis_turns.yaml").read_bytes())
    python = tmp_path / "the environment's" / "python"
    python.parent.mkdir()
    python.write_text(f'#!/bin/sh\nexec {sys.executable} "$@"\n')
    python.chmod(0o755)
    (bench.directory / "sitecustomize.py").write_text(
        f"import sys\nsys.executable = {str(python)!r}\nprint(*sys.orig_argv, file=open('started', 'a'))\n"
    )
    command = [sys.executable, "-m", "snakemake", "--cores", "2", "-s", str(ROOT / "Snakefile"), "--config"]
    command += [f"campaign={name}/", "results=r {batch}, 's"]
    environment = os.environ | {"PYTHONPATH": str(bench.directory), "PYTHONWARNINGS": ""}
    done = subprocess.run(
        command, cwd=bench.directory, env=environment, capture_output=True, text=True, check=False, timeout=600
    )
    assert done.returncode == 0, done.stderr
    results = bench.directory / "r {batch}, 's" / name
    assert json.loads((results / "calibrations" / "A1.json").read_text())["status"] == "ok"
    assert f"r {{batch}}, 's/{name}/index.html" in done.stderr
    # Jobs find what the user's own PYTHONPATH holds.
    assert "-m pipeline job-server" in (bench.directory / "started").read_text()
