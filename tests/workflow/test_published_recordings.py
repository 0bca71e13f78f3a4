"""Recordings that others have published, calibrated by every stage, against what is known of their sensors."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from whole_run import run_campaign

from .conftest import ROOT, Bench

pytestmark = pytest.mark.workflow
DATA = ROOT.parent / "shared" / "data"
GRAVITY = 9.81744 / 9.80665  # Padova, as the data's authors use it

SHEET = f"""unit,procedure,sensor,ingest,overrides
xsens,multi_position,generic,xsens_mti_multi_position,procedure.folder={DATA}/xsens_mti_multi_position
xsens-all,multi_position,generic,xsens_mti_multi_position,\
procedure.folder={DATA}/xsens_mti_multi_position;procedure.holdout_every=0
xsens-moves,multi_position,generic,xsens_mti_multi_position,\
procedure.folder={DATA}/xsens_mti_multi_position;method.gyroscope=rests_and_moves
mpu6050,multi_position,mpu6050,mpu6050_multi_position,procedure.folder={DATA}/mpu6050_multi_position;\
procedure.recordings.recording.file=example_data_calibration.csv;procedure.holdout_every=0
"""


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    if not DATA.is_dir():
        pytest.skip("reference data not beside the repository")
    directory = tmp_path_factory.mktemp("published")
    (directory / "published").mkdir()
    (directory / "published" / "units.csv").write_text(SHEET)
    gravity = {unit: [f"table.gravity_g={GRAVITY}"] for unit in ("xsens", "xsens-all", "xsens-moves")}
    assert run_campaign(directory / "published", unit_overrides=gravity)[1] == 0
    return Bench(directory, directory / "published")


def document(bench: Bench, kind: str, unit: str) -> dict[str, Any]:
    read: dict[str, Any] = json.loads((bench.results / kind / f"{unit}.json").read_text())
    return read


@pytest.mark.parametrize("unit", ["xsens", "xsens-all"])
def test_bias_and_scale_agree_with_the_factory_certificate(published: Bench, unit: str) -> None:
    found = document(published, "calibrations", unit)["accelerometer"]
    bias = 32768 + 4070.0 * np.array(found["bias"])
    scale = 4070.0 / 9.80665 / np.diag(found["matrix"])
    assert np.abs(bias - [33123, 33276, 32360]).max() < 6.0
    assert np.abs(scale / [415, 413, 415] - 1).max() < 0.003


def test_the_residual_over_all_rests_is_a_tenth_of_a_milligee(published: Bench) -> None:
    stage = document(published, "calibrations", "xsens-all")["accelerometer"]["stages"][-1]
    assert stage["details"]["orientations_used"] == 38
    assert stage["residual_rms"] < 0.12e-3


def test_a_third_of_the_rests_is_held_out_and_predicted(published: Bench) -> None:
    part = document(published, "validations", "xsens")["accelerometer"]
    assert part["samples"] == 13
    assert part["held_out"]
    assert part["steps"][-1]["rms_error"] < 0.18e-3


@pytest.mark.parametrize("unit", ["xsens", "xsens-all", "mpu6050"])
def test_the_gyroscope_that_hand_held_rests_do_not_give_is_null_with_the_reason(published: Bench, unit: str) -> None:
    found = document(published, "calibrations", unit)
    assert found["gyroscope"] is None
    assert "record turns about x, y and z" in found["not_calibrated"]["gyroscope"]
    assert document(published, "validations", unit)["gyroscope"] is None


def test_the_gyroscope_by_rests_and_moves_agrees_with_the_factory_certificate(published: Bench) -> None:
    found = document(published, "calibrations", "xsens-moves")["gyroscope"]
    scale = np.degrees(83.2) * np.linalg.norm(np.linalg.inv(found["matrix"]), axis=1)  # counts per rad/s
    assert np.abs(scale / [4778, 4758, 4766] - 1).max() < 0.003
    assert np.max(found["expanded_uncertainty"]["matrix"]) < 0.01


def test_nothing_is_claimed_of_an_accelerometer_whose_rests_are_at_the_noise(published: Bench) -> None:
    for unit in ("xsens", "xsens-all"):
        part = document(published, "diagnoses", unit)["accelerometer"]
        assert part["verdict"] == "nothing_missing"
        assert part["residual_over_noise"] < 1.5


def test_ten_rests_are_not_enough_to_tell_an_effect(published: Bench) -> None:
    part = document(published, "diagnoses", "mpu6050")["accelerometer"]
    assert part["verdict"] == "not_enough_data"
    assert "10 rests are too few" in " ".join(entry["reason"] for entry in part["not_observable"])


def test_the_g_sensitivity_of_a_vibrating_gyroscope_is_named_and_mends_held_out_rests(published: Bench) -> None:
    part = document(published, "diagnoses", "xsens-moves")["gyroscope"]
    assert part["selected"] == ["g_sensitivity"]
    best = part["ranking"][0]
    assert best["held_out_error_after"] < 0.4 * best["held_out_error_before"]
    assert 0.02 < np.max([abs(p["value"]) for p in best["parameters"].values()]) < 0.3  # deg/s/g, as such sensors have


def test_no_moving_sample_is_averaged_into_a_rest(published: Bench) -> None:
    stage = document(published, "calibrations", "mpu6050")["accelerometer"]["stages"][-1]
    rests = stage["details"]["rests_used"]
    assert len(rests) == 10
    counts = np.loadtxt(DATA / "mpu6050_multi_position" / "example_data_calibration.csv", delimiter=",", skiprows=5)
    for rest in rests:
        first = round(rest["time_s"] * 100)
        inside = counts[first : first + round(rest["duration_s"] * 100) + 1, 3:] / 131
        halves = np.abs(inside[: len(inside) // 2].mean(axis=0) - inside[len(inside) // 2 :].mean(axis=0))
        assert halves.max() < 1.0  # deg/s; the moves between the rests reach 60


def test_a_file_that_is_shared_is_named_with_its_hash(published: Bench) -> None:
    inputs = document(published, "calibrations", "mpu6050")["inputs"]
    assert [Path(i["file"]).name for i in inputs] == ["example_data_calibration.csv"]
    assert inputs[0]["rows"] == 10245
    assert len(inputs[0]["sha256"]) == 64
