"""The real Snakefile on tiny campaigns: what it makes, what it reruns, and what one bad unit does to the others."""

import csv
import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from .conftest import ROOT, Bench
from .schemas import validator, violations

pytestmark = pytest.mark.workflow

SHEET = """unit,serial,lot,date,method,overrides,colour
A1,S1,L1,2026-01-02,,,red
A2,S2,L1,2026-01-03,,effects.gyroscope=[g_sensitivity],
B1,S1,L1,2026-01-02,staged,filter=rc_low_pass,blue
"""


def lay_out(directory: Path, sheet: str, simulated: Path, units: list[str]) -> Bench:
    campaign = directory / "bench-7"
    for unit in units:
        shutil.copytree(simulated, campaign / "raw" / unit)
    (campaign / "units.csv").write_text(sheet)
    return Bench(directory, campaign)


def summary(bench: Bench) -> list[dict[str, str]]:
    return list(csv.DictReader((bench.results / "summary.csv").read_text().splitlines()))


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory, simulated: Path) -> Bench:
    made = lay_out(tmp_path_factory.mktemp("bench"), SHEET, simulated, ["A1", "A2", "B1"])
    run = made.snakemake()
    assert run.code == 0, run.output
    return made


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


def test_an_unchanged_second_run_does_nothing(bench: Bench) -> None:
    run = bench.snakemake()
    assert run.code == 0
    assert "Nothing to be done" in run.output


REFERENCE, STAGED = "reference_least_squares-0001", "staged-0001"
END = {"gather", "verdict", "all"}


def after(stage: str, batch: str) -> set[str]:
    order = ["validate", "diagnose", "calibration", "export", "report"]
    return {f"{s}/{batch}" for s in order if stage == "all" or s in stage.split()}


@pytest.mark.parametrize(
    ("config", "expected"),
    [
        ("overrides=limits.gyroscope.bias=20", after("all", REFERENCE)
            | after("all", STAGED)),
        ("unit_overrides={A1: [limits.gyroscope.bias=20]}", after("all", REFERENCE)),
        ("unit_overrides={B1: [filter.zero_phase=true]}", {f"filter/{STAGED}"}
            | {f"fit/{STAGED}/accelerometer/{s}" for s in ("orthogonality", "misalignment", "bias", "scale_factor")}
            | {f"fit/{STAGED}/gyroscope/{s}" for s in ("bias", "orthogonality_and_misalignment", "scale_factor")}
            | after("all", STAGED)),
        ('unit_overrides={A2: ["effects.gyroscope=[bias_temperature]"]}',
            {f"fit/{REFERENCE}/gyroscope/effects"} | after("all", REFERENCE)),
        ("unit_overrides={A1: [sensor.gyroscope.effects.quadratic_nonlinearity=2e-4]}",
            {f"fit/{REFERENCE}/gyroscope/effects"} | after("all", REFERENCE)),
    ],
)  # fmt: skip
def test_changing_a_setting_reruns_the_stages_that_read_it(bench: Bench, config: str, expected: set[str]) -> None:
    assert bench.snakemake(config, dry=True).jobs == expected | END


def test_a_refused_configuration_stops_the_run_before_any_job_with_one_message(bench: Bench) -> None:
    run = bench.snakemake("overrides=filter.cutof_hz=5")
    assert run.code != 0
    assert run.output.count("filter.cutof_hz=5: unknown key; nearest: cutoff_hz") == 1
    assert "unit A1, A2, B1" in run.output
    assert not run.jobs
    assert "Traceback" not in run.output


SIX = "overrides=batch_size=6"


@pytest.fixture(scope="module")
def ten(tmp_path_factory: pytest.TempPathFactory, simulated: Path) -> Bench:
    names = [f"U{i}" for i in range(10)]
    made = lay_out(tmp_path_factory.mktemp("ten"), "unit\n" + "\n".join(names) + "\n", simulated, names)
    lines = (made.campaign / "raw" / "U3" / "gyro_y.csv").read_text().splitlines()
    cells = lines[40].split(",")
    lines[40] = ",".join([*cells[:2], "broken", *cells[3:]])
    (made.campaign / "raw" / "U3" / "gyro_y.csv").write_text("\n".join(lines) + "\n")
    return made


def test_one_bad_unit_leaves_nine_calibrated_and_is_named_at_the_end(ten: Bench) -> None:
    run = ten.snakemake(SIX)
    assert run.code != 0
    rows = summary(ten)
    assert [r["unit"] for r in rows if r["status"] == "ok"] == [f"U{i}" for i in range(10) if i != 3]
    failed = json.loads((ten.results / "calibrations" / "U3.json").read_text())
    assert failed["status"] == "failed"
    assert violations(ten.results) == []
    assert failed["error"]["file"].endswith("gyro_y.csv:41")
    assert "broken" in failed["error"]["message"]
    assert "U3" in (ten.results / "index.html").read_text()
    assert (ten.results / "reports" / "U3.html").is_file()
    last = run.output.strip().splitlines()[-3:]
    assert any("U3: " in line and "gyro_y.csv:41" in line and "broken" in line for line in last), last

    again = ten.snakemake(SIX)
    assert again.code != 0
    assert again.jobs == {"verdict"}
    assert any("U3: " in line and "gyro_y.csv:41" in line for line in again.output.strip().splitlines()[-3:])


def test_a_mended_unit_reruns_its_batch_only(ten: Bench, simulated: Path) -> None:
    ten.snakemake(SIX)
    shutil.copy(simulated / "gyro_y.csv", ten.campaign / "raw" / "U3" / "gyro_y.csv")
    run = ten.snakemake(SIX)
    assert run.code == 0
    assert not [job for job in run.jobs if "-0002" in job]
    assert "Nothing to be done" in ten.snakemake(SIX).output


def test_a_change_to_one_unit_concerns_its_batch_and_new_units_the_last(ten: Bench, simulated: Path) -> None:
    shutil.copy(simulated / "gyro_y.csv", ten.campaign / "raw" / "U3" / "gyro_y.csv")
    ten.snakemake(SIX)
    sheet, device = ten.campaign / "units.csv", ten.campaign / "devices" / "U7.yaml"
    text = sheet.read_text()

    def batches() -> set[str]:
        jobs = ten.snakemake(SIX, dry=True).jobs
        return {found.group(1) for job in jobs if (found := re.search(r"-(\d{4})", job))}

    sheet.write_text(re.sub("$", ",", text.strip(), flags=re.MULTILINE).replace("unit,", "unit,overrides")
        .replace("U2,", "U2,limits.gyroscope.bias=9"))  # fmt: skip
    assert batches() == {"0001"}
    sheet.write_text(text)
    device.parent.mkdir()
    device.write_text("overrides: [limits.gyroscope.bias=9]")
    assert batches() == {"0002"}
    device.unlink()
    sheet.write_text(text + "".join(f"V{i}\n" for i in range(10)))
    assert batches() == {"0002", "0003", "0004"}
    sheet.write_text(text)


def keep_the_first_rest(file: Path) -> None:
    file.write_text("\n".join(file.read_text().splitlines()[:8]) + "\n")


@pytest.mark.parametrize(
    ("harm", "code", "cause"),
    [
        (lambda raw: (raw / "accel_z.csv").unlink(), "missing_file", "accel_z"),
        (lambda raw: [keep_the_first_rest(f) for f in raw.glob("accel_*.csv")], "not_observable", "accelerometer"),
    ],
    ids=["missing file", "unobservable fit"],
)
def test_other_failures_are_named_too(
    tmp_path: Path, simulated: Path, harm: Callable[[Path], object], code: str, cause: str
) -> None:
    bench = lay_out(tmp_path, "unit\nG1\nG2\n", simulated, ["G1", "G2"])
    harm(bench.campaign / "raw" / "G2")
    run = bench.snakemake()
    assert run.code != 0
    failures = json.loads((bench.results / "failures.json").read_text())
    assert [(f["unit"], f["code"]) for f in failures] == [("G2", code)]
    assert cause in failures[0]["message"]
    assert json.loads((bench.results / "calibrations" / "G1.json").read_text())["status"] == "ok"


def test_a_dry_run_writes_nothing(tmp_path: Path) -> None:
    (tmp_path / "bench-7").mkdir()
    bench = lay_out(tmp_path, "unit\nG1\n", tmp_path, [])
    assert len(bench.snakemake(dry=True).jobs) > 9
    assert not bench.results.exists()


def test_jobs_find_what_the_users_own_python_path_holds(
    tmp_path: Path, simulated: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = lay_out(tmp_path, "unit\nG1\n", simulated, ["G1"])
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "sitecustomize.py").write_text("import sys\nprint('own path', file=sys.stderr)\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "own"))
    bench.snakemake("--until", "ingest")
    (log,) = bench.results.glob("logs/*/ingest.log")
    assert "own path" in log.read_text()


def test_campaign_results_and_environment_may_lie_anywhere(tmp_path: Path, simulated: Path) -> None:
    name = "it's {mine}, all"
    bench = lay_out(tmp_path / "a b,{c}", "unit,procedure\nA1,own\n", simulated, ["A1"])
    campaign = bench.campaign.rename(bench.directory / name)
    own = campaign / "configs" / "procedure" / "own.yaml"
    own.parent.mkdir(parents=True)
    own.write_bytes((ROOT / "configs" / "procedure" / "three_axis_turns.yaml").read_bytes())
    python = tmp_path / "the environment's" / "python"
    python.parent.mkdir()
    python.write_text(f'#!/bin/sh\nexec {sys.executable} "$@"\n')
    python.chmod(0o755)
    (bench.directory / "sitecustomize.py").write_text(f"import sys\nsys.executable = {str(python)!r}\n")
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
