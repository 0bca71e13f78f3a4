"""Recordings that others have published, calibrated by every stage, against what is known of their sensors."""

import hashlib
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from unit_settings import with_noise
from whole_run import run_campaign

from pipeline.app.config.campaign import load_campaign
from pipeline.estimation.gyroscope import rests_and_moves
from pipeline.estimation.noise import estimate_noise
from pipeline.estimation.stages import StageInput
from pipeline.ingest.read import read_recordings
from tests.published import validate

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
"""
SHIPPED = ROOT / "data" / "published"
# The results of its authors (github.com/tomisuarez2/ImuCalibration, optmization result data): counts, and relative to
# 16384 counts a g, 131 counts per deg/s
AUTHORS = {
    "bias": np.array([711.5, -358.5, -1840.1]),
    "accelerometer": np.array([6.0201e-4, 5.9684e-4, 5.8592e-4]) * 16384 / 9.80665,
    "gyroscope": np.array([1.3737e-4, 1.3292e-4, 1.3394e-4]) * np.degrees(131.0),
}


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


@pytest.fixture(scope="module")
def shipped(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    directory = tmp_path_factory.mktemp("shipped")
    assert run_campaign(SHIPPED, results=directory / "results")[1] == 0
    return Bench(directory, SHIPPED)


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


@pytest.mark.parametrize("unit", ["xsens", "xsens-all"])
def test_the_gyroscope_that_hand_held_rests_do_not_give_is_null_with_the_reason(published: Bench, unit: str) -> None:
    found = document(published, "calibrations", unit)
    assert found["gyroscope"] is None
    assert "method=rests_and_moves calibrates it" in found["not_calibrated"]["gyroscope"]
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


def test_the_g_sensitivity_of_a_vibrating_gyroscope_is_named_and_mends_held_out_rests(published: Bench) -> None:
    part = document(published, "diagnoses", "xsens-moves")["gyroscope"]
    assert part["selected"] == ["g_sensitivity"]
    best = part["ranking"][0]
    assert best["held_out_error_after"] < 0.4 * best["held_out_error_before"]
    assert 0.02 < np.max([abs(p["value"]) for p in best["parameters"].values()]) < 0.3  # deg/s/g, as such sensors have


def test_the_shipped_recordings_are_those_of_the_authors() -> None:
    text = (SHIPPED / "README.md").read_text()
    stated = dict(re.findall(r"^\| `([^`]*)` \| `[^`]*` \| `(\w{64})` \|$", text, re.MULTILINE))
    files = {str(f.relative_to(SHIPPED / "raw")): f for f in SHIPPED.glob("raw/*/*.csv")}
    assert stated == {name: hashlib.sha256(file.read_bytes()).hexdigest() for name, file in files.items()}
    for file in SHIPPED.glob("raw/*"):
        assert (file / "LICENSE").read_text().startswith("MIT License")


def test_the_gyroscope_of_a_drone_follows_the_temperature_as_least_squares_do(shipped: Bench) -> None:
    """Cooled and heated by 90 degC; judged on another cooling. Its authors fit polynomials by ``numpy.polyfit``."""
    rows, held = (
        np.loadtxt(SHIPPED / "raw" / "chamber" / f"{name}.csv", delimiter="\t", skiprows=1)
        for name in ("cool_heat", "cool")
    )
    found = document(shipped, "calibrations", "chamber")["gyroscope"]
    (effect,) = found["effects"]
    powers = [[effect["parameters"][f"b_T{k}_{axis}"]["value"] for axis in "xyz"] for k in (1, 2)]
    own = np.polynomial.polynomial.polyfit(rows[:, 8] - 25.0, rows[:, 1:4], 2)
    excess = np.arange(-17.0, 74.0) - 25.0
    curves = [np.polynomial.polynomial.polyval(excess, c) for c in (np.array([found["bias"], *powers]), own)]
    assert np.abs(curves[0] - curves[1]).max() < 0.05 * np.ptp(curves[1], axis=1).max()
    rest = held[:, 1:4] - np.polynomial.polynomial.polyval(held[:, 8] - 25.0, own).T
    validation = document(shipped, "validations", "chamber")["gyroscope"]
    raw, last = (validation["steps"][k]["rms_error"] for k in (0, -1))
    assert last < 1.1 * np.sqrt(np.mean(np.sum(rest**2, axis=1)))
    assert raw > 6.0 * last
    assert found["determined_by"]["bias"] == ["recordings"] * 3


def test_the_stored_evidence_is_what_the_shipped_campaign_gives(shipped: Bench) -> None:
    file = ROOT / "benchmarks" / "evidence" / "stored" / "real.json"
    stored = {figure["name"]: figure for figure in json.loads(file.read_text())["figures"]}
    for unit in ("mpu6050", "wearable"):
        validation = document(shipped, "validations", unit)
        for sensor, scale in (("accelerometer", 1000.0), ("gyroscope", 1.0)):
            found = validation[sensor]
            errors = [found["steps"][0]["rms_error"], found["steps"][-1]["rms_error"], found["noise_floor"]]
            for name, value in zip(("raw", "calibrated", "noise floor"), errors, strict=True):
                figure = stored[f"{unit} {sensor}, {name}"]
                assert figure["value"] == pytest.approx(scale * value, rel=0.02)
                assert figure["total"] == found["samples"]
            low, high = found["expected_rms_error"]  # the interval in which it is expected
            verdict = document(shipped, "diagnoses", unit)[sensor]["verdict"]
            assert (low < errors[1] < high) == (verdict in {"nothing_missing", "not_enough_data"})
        found = validation["gravity_direction"]
        assert stored[f"{unit} move, after"]["value"] == pytest.approx(found["rms_deg"]["after"], rel=0.02)


def test_ten_rests_are_not_enough_to_tell_an_effect(shipped: Bench) -> None:
    part = document(shipped, "diagnoses", "mpu6050")["accelerometer"]
    assert "10 rests are too few" in " ".join(entry["reason"] for entry in part["not_observable"])


def test_ten_rests_without_a_recording_for_validation_calibrate_both_sensors() -> None:
    campaign = load_campaign({"campaign": str(SHIPPED)})
    config = campaign.units["mpu6050"].config
    recordings = read_recordings(config.procedure, config.ingest, config.sensor, campaign.folder("mpu6050"))
    alone = [r for r in recordings if r.role != "validation"]
    found = rests_and_moves.fit(StageInput("gyroscope", with_noise(alone, config), None, config))
    assert found.stages[-1].details.rests == 10
    assert np.abs(np.diag(found.matrix) / AUTHORS["gyroscope"] - 1)[1:].max() < 9e-4
    part = validate(found, alone, estimate_noise("gyroscope", alone, config.sensor.gyroscope), config)
    assert not part["held_out"]
    assert "10 rests all go to the fit; of 15 and more, one of 3 is held out" in part["reason"]


def test_bias_and_scale_agree_with_those_that_the_authors_published(shipped: Bench) -> None:
    found = document(shipped, "calibrations", "mpu6050")
    assert np.abs(16384 * np.array(found["accelerometer"]["bias"]) - AUTHORS["bias"]).max() < 21
    force, rate = (np.diag(found[name]["matrix"]) / AUTHORS[name] - 1 for name in ("accelerometer", "gyroscope"))
    assert np.abs(force).max() < 6e-4
    assert np.abs(rate[1:]).max() < 9e-4
    assert rate[0] == pytest.approx(-0.017, abs=1e-3)  # their moves hold clipped readings of x


def test_no_moving_sample_is_averaged_into_a_rest(shipped: Bench) -> None:
    stage = document(shipped, "calibrations", "mpu6050")["accelerometer"]["stages"][-1]
    rests = stage["details"]["rests_used"]
    assert len(rests) == 10
    counts = np.loadtxt(SHIPPED / "raw" / "mpu6050" / "recording.csv", delimiter=",", skiprows=5)
    for rest in rests:
        first = round(rest["time_s"] * 100)
        inside = counts[first : first + round(rest["duration_s"] * 100) + 1, 3:] / 131
        halves = np.abs(inside[: len(inside) // 2].mean(axis=0) - inside[len(inside) // 2 :].mean(axis=0))
        assert halves.max() < 1.0  # deg/s; the moves between the rests reach 60


def test_a_file_that_is_shared_is_named_with_its_hash(published: Bench) -> None:
    inputs = document(published, "calibrations", "xsens")["inputs"]
    assert {Path(i["file"]).name for i in inputs} == {"accelerometer.txt"}
    assert inputs[0]["rows"] == 51175
    (joined,) = inputs[0]["joined"]
    for entry, name in ((inputs[0], "accelerometer.txt"), (joined, "gyroscope.txt")):
        content = (DATA / "xsens_mti_multi_position" / name).read_bytes()
        assert entry["sha256"] == hashlib.sha256(content).hexdigest()
