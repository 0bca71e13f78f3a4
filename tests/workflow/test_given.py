"""method=given: an existing calibration is judged on new recordings, and nothing is fitted."""

from __future__ import annotations

import json
import shutil
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import yaml
from whole_run import run_campaign, settings_names

from pipeline.app.config import load_campaign
from pipeline.core.errors import ConfigurationError

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.workflow
SHIFT = 0.01  # rad/s, 0.573 deg/s


def campaign_with(directory: Path, recordings: Path, units: dict[str, str]) -> Path:
    directory.mkdir(exist_ok=True)
    for unit in units:
        shutil.copytree(recordings, directory / "raw" / unit, dirs_exist_ok=True)
    rows = [f"{unit},mpu6050,{settings}" for unit, settings in units.items()]
    (directory / "units.csv").write_text("\n".join(["unit,sensor,method,overrides", *rows]) + "\n")
    return directory


def results_of(campaign: Any, kind: str) -> dict[str, Any]:
    return {u: json.loads((campaign.results / kind / f"{u}.json").read_text()) for u in campaign.units}


@pytest.fixture(scope="module")
def known(simulated: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any]:
    """Return a folder with calibrations of a fit, and the results of that fit."""
    here = tmp_path_factory.mktemp("given")
    campaign, code = run_campaign(campaign_with(here / "first", simulated, {"U": ","}))
    assert code == 0
    exports = campaign.results / "exports" / "U"
    shutil.copytree(exports, here / "second" / "known")
    shutil.copy(campaign.results / "calibrations" / "U.json", here / "second" / "known" / "own.json")
    shifted = yaml.safe_load((exports / "kalibr.yaml").read_text())
    shifted["imu0"]["gyroscopes"]["b"][1] += SHIFT
    (here / "second" / "known" / "shifted.yaml").write_text(yaml.safe_dump(shifted))
    return here / "second", campaign


@pytest.fixture(scope="module")
def done(known: tuple[Path, Any], simulated: Path) -> Any:
    files = {"own": "own.json", "shifted": "shifted.yaml", "half": "imu_calib.yaml"}
    units = {name: f"given,method.file=known/{file}" for name, file in files.items()}
    campaign, code = run_campaign(campaign_with(known[0], simulated, units))
    assert code == 0
    return campaign


def test_the_calibration_of_the_file_is_judged_as_it_stands(done: Any, known: tuple[Path, Any]) -> None:
    first = results_of(known[1], "validations")["U"]
    found = results_of(done, "validations")
    for unit, sensor in (("own", "accelerometer"), ("own", "gyroscope"), ("shifted", "accelerometer")):
        steps = found[unit][sensor]["steps"]
        assert [s["name"] for s in steps] == ["raw", "calibrated"]
        assert steps[-1]["rms_error"] == pytest.approx(first[sensor]["steps"][-1]["rms_error"], rel=1e-9)


def test_an_uncertainty_is_the_stated_one_or_stated_as_unknown(done: Any, known: tuple[Path, Any]) -> None:
    first, found = results_of(known[1], "calibrations")["U"], results_of(done, "calibrations")
    for sensor in ("accelerometer", "gyroscope"):
        np.testing.assert_allclose(
            found["own"][sensor]["expanded_uncertainty"]["bias"],
            first[sensor]["expanded_uncertainty"]["bias"],
            rtol=1e-9,
        )
        budget = found["shifted"][sensor]["uncertainty_budget"]
        assert budget["contributions"] == []
        assert "shifted.yaml (kalibr.yaml) states no uncertainty" in budget["not_included"][0]["reason"]
        (stage,) = found["shifted"][sensor]["stages"]
        assert len(stage["details"]["sha256"]) == 64
        assert stage["name"] == "given"
    assert found["half"]["gyroscope"] is None
    assert "holds nothing of the gyroscope" in found["half"]["not_calibrated"]["gyroscope"]


def test_a_shifted_calibration_is_told_by_the_size_of_the_shift(done: Any) -> None:
    part = results_of(done, "diagnoses")["shifted"]["gyroscope"]
    assert part["verdict"] == "left_by_method"
    assert part["override"] == ""
    assert "the given calibration causes the rest" in part["reason"]
    bias = next(e for e in part["method_errors"] if e["name"] == "bias")
    assert bias["size"] == pytest.approx(np.degrees(SHIFT), rel=0.05)
    assert results_of(done, "diagnoses")["shifted"]["accelerometer"]["verdict"] != "left_by_method"


def test_another_content_of_the_file_is_another_setting_of_the_fit_alone(done: Any, known: tuple[Path, Any]) -> None:
    before = settings_names(done)
    file = known[0] / "known" / "shifted.yaml"
    text = file.read_text()
    file.write_text(text + "# the same\n")
    changed = load_campaign({"campaign": str(known[0]), "results": str(done.results.parent)})
    file.write_text(text)
    after = settings_names(changed)
    reruns = {job.split("/")[1] for job in before if before[job] != after[job]}
    assert {"fit", "diagnose"} <= reruns
    assert reruns.isdisjoint({"ingest", "filter", "export"})


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ("given,", "method.file is not set"),
        ("given,method.file=known/none.yaml", "there is no such calibration"),
        ("given,method.file=known/kalibr_imu.yaml", "noise only"),
        ('given,"method.file=known/kalibr.yaml;effects.gyroscope=[g_sensitivity]"', "takes the effects from its file"),
        ("given,method.file=known/kalibr.yaml;table.seat_deg=1", "table.seat_deg is set"),
    ],
)
def test_what_cannot_be_taken_is_refused_before_any_job(
    known: tuple[Path, Any], tmp_path: Path, settings: str, told: str
) -> None:
    shutil.copytree(known[0] / "known", tmp_path / "c" / "known")
    campaign_with(tmp_path / "c", known[0] / "raw" / "own", {"U": settings})
    with pytest.raises(ConfigurationError, match=told):
        load_campaign({"campaign": str(tmp_path / "c")})
