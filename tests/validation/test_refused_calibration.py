"""Stage calibration: a sensor whose calibration does harm is null with the reason; a unit without any has failed."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from bench_session import Session, record
from stage_files import documents, write_pack

from pipeline.app.config.compose import Composer
from pipeline.app.steps import batch
from pipeline.core.records import SENSORS, SensorCalibration
from pipeline.ingest.arrow import to_parquet
from pipeline.unit import STEPS
from tests.published import TESTED, validation_document

HARM = "the calibration makes held-out motion worse"


def run_stage(folder: Path, harmed: list[str], absent: list[str], *, as_printed: bool = False) -> dict[str, Any]:
    """Run the stage on one unit and return its files by name."""
    settings = [f"method.as_printed={str(as_printed).lower()}"]
    part = Composer(folder).unit("U1", settings).only(STEPS["calibration"].settings)
    (folder / "part.json").write_text(json.dumps({"units": {"U1": part}}))
    parts = {s: None if s in absent else replace(TESTED, worse_than_raw=HARM if s in harmed else None) for s in SENSORS}
    files: dict[str, Any] = {
        "ingest": {"U1.parquet": to_parquet(record(Session(1))[:1])},
        "validate": {"U1.json": validation_document("U1", parts)},
        "diagnose": {"U1.json": dict.fromkeys(SENSORS)},
    }
    for sensor in SENSORS:
        fit = {"not_calibrated": "no angle is logged"} if sensor in absent else SensorCalibration(sensor).to_json()
        files[sensor] = {"U1.json": fit}
    packs = {name: write_pack(folder / f"{name}.zip", each) for name, each in files.items()}
    given = [word for name, each in packs.items() for word in (f"--{name}", str(each))]
    assert (
        batch.main("calibration", ["--config", str(folder / "part.json"), *given, "--output", str(folder / "out")]) == 0
    )
    return documents(folder / "out")


def test_a_sensor_that_does_harm_is_null_and_the_other_is_not(tmp_path: Path) -> None:
    found = run_stage(tmp_path, ["gyroscope"], [])["U1.json"]
    assert (found["status"], found["gyroscope"], found["not_calibrated"]) == ("ok", None, {"gyroscope": HARM})
    assert found["accelerometer"]["unit"] == "g"


def test_printed_errata_are_published_as_they_are(tmp_path: Path) -> None:
    found = run_stage(tmp_path, ["gyroscope"], [], as_printed=True)["U1.json"]
    assert found["not_calibrated"] == {}
    assert found["gyroscope"]["unit"] == "deg/s"


@pytest.mark.parametrize(("harmed", "absent"), [(["gyroscope"], ["accelerometer"]), ([], list(SENSORS))])
def test_a_unit_without_a_calibrated_sensor_has_failed(tmp_path: Path, harmed: list[str], absent: list[str]) -> None:
    found = run_stage(tmp_path, harmed, absent)
    assert set(found) == {"U1.failed.json"}
    failure = found["U1.failed.json"]
    assert failure["code"] == "cannot_calibrate"
    assert "no angle is logged" in failure["message"]
    assert (HARM in failure["message"]) == bool(harmed)
