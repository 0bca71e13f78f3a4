"""Which jobs a changed setting concerns: those whose settings file has another name."""

import re
from fnmatch import fnmatch
from pathlib import Path

import pytest
from whole_run import settings_names

from pipeline.app.config import load_campaign, stage_settings
from pipeline.app.steps import MODULES
from pipeline.output.pages import unit_page
from pipeline.physics.effects import built_in

SHEET = """unit,method,overrides
A1,,
A2,,effects.gyroscope=[g_sensitivity]
B1,staged,filter=rc_low_pass
"""
REFERENCE, STAGED = "reference_least_squares-0001", "staged-0001"


def changed(directory: Path, **settings: object) -> set[str]:
    """Return the jobs whose settings differ from those of the sheet alone."""
    given = {"campaign": str(directory)}
    before, after = (settings_names(load_campaign(given | more)) for more in ({}, settings))
    return {job for job, name in after.items() if name != before[job]}


@pytest.fixture
def bench(tmp_path: Path) -> Path:
    (tmp_path / "units.csv").write_text(SHEET)
    return tmp_path


def of(batch: str, *stages: str) -> set[str]:
    return {f"{batch}/{stage}" for stage in stages}


# A job whose input is made again runs too: here are those that read the setting itself.
@pytest.mark.parametrize(
    ("unit", "override", "expected"),
    [
        ("A1", "limits.gyroscope.bias=20", of(REFERENCE, "validate", "calibration", "report")),
        ("A1", "diagnosis.depth=full", of(REFERENCE, "diagnose", "calibration", "report")),
        ("B1", "ingest.checks.missing_time=0.3", of(STAGED, "ingest", "calibration", "report")),
        (
            "B1",
            "procedure.mounting_tolerance_deg=9",
            of(STAGED, "ingest", "fit/*", "validate", "diagnose", "calibration", "report"),
        ),
        (
            "A1",
            "uncertainty.monte_carlo=2000",
            of(REFERENCE, "calibration", "report")
            | {f"{REFERENCE}/fit/{s}/reference_least_squares" for s in ("accelerometer", "gyroscope")}
            | {f"{REFERENCE}/fit/gyroscope/effects"},
        ),
        ("B1", "filter.zero_phase=true", of(STAGED, "filter", "calibration", "report")),
        (
            "A2",
            "effects.gyroscope=[bias_temperature]",
            of(REFERENCE, "diagnose", "calibration", "report") | {f"{REFERENCE}/fit/gyroscope/effects"},
        ),
        (
            "A1",
            "sensor.gyroscope.effects.quadratic_nonlinearity=2e-4",
            of(REFERENCE, "ingest", "filter", "fit/*", "validate", "diagnose", "calibration", "export", "report"),
        ),
    ],
)
def test_a_setting_of_a_unit_concerns_the_jobs_of_its_batch_that_read_it(
    bench: Path, unit: str, override: str, expected: set[str]
) -> None:
    batch = REFERENCE if unit.startswith("A") else STAGED
    jobs = settings_names(load_campaign({"campaign": str(bench)}))
    wanted = {
        job for pattern in expected | {f"{batch}/summary", "campaign/gather"} for job in jobs if fnmatch(job, pattern)
    }
    assert changed(bench, unit_overrides={unit: [override]}) == wanted


def test_a_setting_of_the_run_concerns_every_batch(bench: Path) -> None:
    stages = ("validate", "calibration", "report", "summary")
    assert changed(bench, overrides="limits.gyroscope.bias=20") == of(REFERENCE, *stages) | of(STAGED, *stages) | {
        "campaign/gather"
    }


def test_a_change_of_sheet_or_device_concerns_the_batch_of_the_unit(tmp_path: Path) -> None:
    sheet, device = tmp_path / "units.csv", tmp_path / "devices" / "U7.yaml"
    plain = "unit,overrides\n" + "".join(f"U{i},\n" for i in range(10))

    def settings() -> dict[str, str]:
        return settings_names(load_campaign({"campaign": str(tmp_path), "overrides": "batch_size=6"}))

    def batches() -> set[str]:
        jobs = {job for job, name in settings().items() if before.get(job) != name}
        return {found[1] for job in jobs if (found := re.search(r"-(\d{4})", job))}

    sheet.write_text(plain)
    before = settings()
    sheet.write_text(plain.replace("U2,", "U2,limits.gyroscope.bias=9"))
    assert batches() == {"0001"}
    sheet.write_text(plain)
    device.parent.mkdir()
    device.write_text("overrides: [limits.gyroscope.bias=9]")
    assert batches() == {"0002"}
    device.unlink()
    sheet.write_text(plain + "".join(f"V{i},\n" for i in range(10)))
    assert batches() == {"0002", "0003", "0004"}


@pytest.mark.parametrize("stage", ["validate", "diagnose", "calibration", "export", "report"])
def test_the_digest_of_a_stage_contains_the_files_of_the_built_in_effects(stage: str) -> None:
    read = {file.name for file in stage_settings._closure(f"pipeline.app.steps.{MODULES[stage]}")}
    assert {f"{name}.yaml" for name in built_in()} <= read


def test_a_change_of_a_page_repeats_no_stage_before_the_pages() -> None:
    page = Path(unit_page.__file__)
    of = {stage: stage_settings._closure(f"pipeline.app.steps.{module}") for stage, module in MODULES.items()}
    assert {stage for stage, files in of.items() if page in files} == {"report"}


@pytest.mark.parametrize(
    ("module", "file"),
    [
        ("pipeline.app.steps.ingest", "imu_logs/names.json"),
        ("pipeline.app.steps.report", "pipeline/output/pages/templates/unit.html"),
        ("imu_research.study.cases", "imu_research/study/sizes.yaml"),
    ],
)
def test_the_digest_of_code_holds_the_files_of_data_that_it_reads(module: str, file: str) -> None:
    files = stage_settings._closure(module)
    assert Path(stage_settings.PACKAGE.parent, file) in files
