"""Temperature and repeatability in a budget, as far as they are stated."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from stage_files import documents, write_pack
from table_turns import Bench, settings
from unit_settings import settings_of, with_noise

from pipeline.app.steps import batch
from pipeline.app.steps.ingest import filter_recordings
from pipeline.app.steps.unit_files import FILES
from pipeline.checks.reference_scale import rate_error
from pipeline.core.records import Coefficient, FittedEffect, Noise, Note, UnitRecordings
from pipeline.core.settings import Settings
from pipeline.estimation import reference_least_squares
from pipeline.estimation.stages import StageInput
from pipeline.estimation.stated_lines import with_stated
from pipeline.estimation.uncertainty_budget import covariance_without_reference
from pipeline.ingest.arrow import to_parquet
from pipeline.physics.statements import beyond_uncertainty
from pipeline.unit import STEPS

if TYPE_CHECKING:
    from pathlib import Path

    from pipeline.core.records import Recording, SensorCalibration
    from pipeline.core.settings import Settings

K = np.diag([1.02, 0.99, 1.01])
WARM = (20.0, 26.0)  # degC, from the first sample to the last of each recording


@pytest.fixture(scope="module")
def fitted() -> tuple[SensorCalibration, UnitRecordings]:
    turns = Bench("gyroscope", [0.3, -0.2, 0.5], K, white=0.01).turns_at([60.0, -60.0])
    warm = [replace(r, temperature=np.linspace(*WARM, r.samples)) for r in turns]
    return reference_least_squares.fit(StageInput("gyroscope", with_noise(warm, settings()), None, settings())), known(
        warm
    )


def known(recordings: list[Recording], noise: Noise | None = None) -> UnitRecordings:
    return UnitRecordings(recordings, {"gyroscope": noise})


def sheet(**stated: Any) -> Settings:
    accuracy = stated.pop("accuracy", None)
    limits = {"bias_temperature": 0.05, "scale_factor_temperature": 1e-3}
    return settings_of(
        table={"rate_accuracy": 1e-3},  # above the error of the trapezoidal rule, which gives the angle of the turns
        sensor={"temperature_accuracy_degc": accuracy, "gyroscope": {"effects": limits, **stated}},
    )


def line(found: SensorCalibration, source: str) -> dict[str, Any]:
    lines = found.to_json()["uncertainty_budget"]["contributions"]
    return next(entry for entry in lines if entry["source"] == source)


def test_what_is_not_stated_is_named_with_the_key_that_states_it(fitted: Any) -> None:
    found = with_stated(*fitted, sheet())
    left = {entry["source"]: entry["reason"] for entry in found.to_json()["uncertainty_budget"]["not_included"]}
    assert "sensor.gyroscope.repeatability_bias" in left["repeatability"]
    assert "no accuracy of the thermometer" in left["temperature"]
    assert np.array_equal(found.covariance, fitted[0].covariance)


def test_no_bias_of_a_coarse_log_is_better_than_its_rounding(fitted: Any) -> None:
    calibration, warm = fitted[0], fitted[1].filtered
    step = np.array([0.5, 0.0, 1.0])
    noise = Noise(np.full(3, 0.3), np.zeros(3), 100.0, "static", step=step, rounding=step / np.sqrt(12.0))
    found = with_stated(calibration, known(warm, noise), sheet())
    was, u = (np.sqrt(np.diag(c.covariance))[:3] for c in (calibration, found))
    assert u == pytest.approx(np.hypot(was, step / np.sqrt(12.0)))
    budget = found.to_json()["uncertainty_budget"]
    assert "quantisation" in [line["source"] for line in budget["contributions"]]
    assert "quantisation" not in [entry["source"] for entry in budget["not_included"]]
    fine = with_stated(calibration, known(warm, replace(noise, step=None)), sheet())
    assert np.sqrt(np.diag(fine.covariance))[:3] == pytest.approx(was)


def test_repeatability_adds_in_quadrature_and_has_infinite_degrees_of_freedom(fitted: Any) -> None:
    before = fitted[0]
    found = with_stated(*fitted, sheet(repeatability_bias=0.02, repeatability_scale_factor=3e-4))
    u, was = (np.sqrt(np.diag(c.covariance)) for c in (found, before))
    assert u[:3] == pytest.approx(np.hypot(was[:3], 0.02))
    diagonal = [3, 7, 11]
    assert u[diagonal] == pytest.approx(np.hypot(was[diagonal], 3e-4 * np.diag(before.matrix)), rel=1e-9)
    assert "repeatability" not in {e["source"] for e in found.to_json()["uncertainty_budget"]["not_included"]}
    nu = 0.02**4 / was[0] ** 4 * before.freedom[0]
    assert found.freedom is not None
    assert found.freedom[0] > nu  # Welch and Satterthwaite: (u / u_A)^4 nu_A
    assert found.freedom[0] == pytest.approx((u[0] / was[0]) ** 4 * before.freedom[0])
    assert found.to_json()["expanded_uncertainty"]["bias"][0] == pytest.approx(1.96 * u[0], rel=1e-2)


def test_without_a_model_of_temperature_its_range_counts_with_the_data_sheets_limit(fitted: Any) -> None:
    found = with_stated(*fitted, sheet(accuracy=0.5))
    u = np.hypot(0.5, (WARM[1] - WARM[0]) / np.sqrt(12.0))
    own = line(found, "temperature (bias)")
    assert own["standard_uncertainty"] == pytest.approx(u, rel=0.02)
    assert own["contribution"][0] == pytest.approx(u * 0.05 / np.sqrt(3.0), rel=0.02)
    assert line(found, "temperature (scale factor)")["contribution"][3] == pytest.approx(
        u * 1e-3 / np.sqrt(3.0) / 1.02, rel=0.02
    )


def test_with_a_fitted_effect_only_the_thermometer_counts_by_what_was_found(fitted: Any) -> None:
    values = {f"b_T_{a}": Coefficient(v, "deg/s/degC") for a, v in zip("xyz", (0.01, -0.02, 0.03), strict=True)}
    calibration, recordings = fitted
    size = 15
    covariance = np.zeros((size, size))
    covariance[:12, :12] = calibration.covariance
    warm = replace(
        calibration,
        covariance=covariance,
        freedom=np.full(size, np.inf),
        budget=replace(calibration.budget, lines=()),
        effects=(FittedEffect("bias_temperature", values),),
    )
    found = with_stated(warm, recordings, sheet(accuracy=0.5))
    assert line(found, "temperature (bias)")["contribution"][:3] == pytest.approx([0.005, 0.01, 0.015])


def test_without_a_thermometer_in_the_recordings_that_is_said(fitted: Any) -> None:
    cold = [replace(r, temperature=None) for r in fitted[1].filtered]
    found = with_stated(fitted[0], known(cold), sheet(accuracy=0.5))
    left = {entry["source"]: entry["reason"] for entry in found.to_json()["uncertainty_budget"]["not_included"]}
    assert left["temperature"] == "the recordings hold no temperature"


LIMIT_PPM = 10000.0


def by_angle(sensor: str, *, counted: bool, **table: float) -> tuple[SensorCalibration, dict[str, Any]]:
    """Return a calibration by a table that logs its angle alone, at rows that may be counted, and its budget."""
    bench = Bench(sensor, [0.03, -0.02, 0.05], K, white=0.001)
    turns = bench.turns_at([60.0, -60.0]) if sensor == "gyroscope" else bench.stop_and_go(45.0, 2.4)
    note = Note("N-SYNTHTIME", 1, 0, 0, "")
    turns = [replace(r, table_rate=None, notes=(note,) if counted else ()) for r in turns]
    config = settings_of(settings(**table), **{f"sensor.{sensor}.effects.clock_rate": LIMIT_PPM})
    found = with_stated(
        reference_least_squares.fit(StageInput(sensor, with_noise(turns, config), None, config)),
        with_noise(turns, config),
        config,
    )
    return found, {entry["source"]: entry for entry in found.to_json()["uncertainty_budget"]["not_included"]}


def test_rows_counted_at_a_stated_rate_have_the_error_of_the_sensors_clock() -> None:
    stamped, left = by_angle("gyroscope", counted=False)
    assert left["time base"]["up_to"] == {"matrix": 0.01}
    assert ("time base, up to 1 % of the matrix", left["time base"]["reason"]) in beyond_uncertainty(stamped.to_json())
    counted, left = by_angle("gyroscope", counted=True)
    own = line(counted, "time base")
    assert own["distribution"] == "rectangular"
    relative = np.abs(np.array(own["contribution"][3:12]) / counted.matrix.ravel())
    assert relative == pytest.approx(np.full(9, 0.01 / np.sqrt(3.0)), rel=1e-6)
    assert "time base" not in left
    added = counted.covariance - stamped.covariance  # all elements have one error
    m = counted.matrix.ravel()
    assert added[3:12, 3:12] == pytest.approx(0.01**2 / 3.0 * np.outer(m, m), rel=1e-3, abs=1e-10)
    stated, left = by_angle("gyroscope", counted=True, clock_accuracy_ppm=20.0)
    assert line(stated, "time base")["standard_uncertainty"] == 20.0
    assert "time base" not in {source.partition(",")[0] for source, _ in beyond_uncertainty(stated.to_json())}


def test_the_interval_of_samples_in_bursts_is_as_uncertain_as_their_number_leaves_it() -> None:
    bench = Bench("gyroscope", [0.03, -0.02, 0.05], K, white=0.001)
    plain = [replace(r, table_rate=None) for r in bench.turns_at([60.0, -60.0])]
    config = settings()
    fit = reference_least_squares.fit(StageInput("gyroscope", with_noise(plain, config), None, config))
    clocks = ({"interval_ns": 1e7, "uncertainty_ns": u} for u in (4e3, 6e3, 2e3))
    turns = [replace(r, source={**r.source, "bursts": clock}) for r, clock in zip(plain, clocks, strict=False)]
    found = with_stated(fit, with_noise(turns, config), config)
    own = line(found, "interval of bursts")
    assert own["standard_uncertainty"] == pytest.approx(300.0)  # ppm: half of 6 us in 10 ms
    added = found.covariance - with_stated(fit, with_noise(plain, config), config).covariance
    m = fit.matrix.ravel()
    assert added[3:12, 3:12] == pytest.approx(3e-4**2 * np.outer(m, m), rel=1e-6, abs=1e-12)
    assert any(entry["source"] == "time base" for entry in found.to_json()["uncertainty_budget"]["not_included"])
    stated = settings(clock_accuracy_ppm=20.0)
    both = with_stated(
        reference_least_squares.fit(StageInput("gyroscope", with_noise(turns, stated), None, stated)),
        with_noise(turns, stated),
        stated,
    )
    assert line(both, "interval of bursts")["standard_uncertainty"] == pytest.approx(300.0)
    rated = [replace(r, source=t.source) for r, t in zip(bench.turns_at([60.0, -60.0]), turns, strict=False)]
    by_rate = with_stated(
        reference_least_squares.fit(StageInput("gyroscope", with_noise(rated, config), None, config)),
        with_noise(rated, config),
        config,
    )
    assert "interval of bursts" not in {
        entry["source"] for entry in by_rate.to_json()["uncertainty_budget"]["contributions"]
    }


def test_a_rate_that_is_not_the_change_of_its_angle_is_in_the_uncertainty() -> None:
    turns, off = Bench("gyroscope", [0.3, -0.2, 0.5], K, white=0.001).turns_at([60.0, -60.0]), 1.5e-4
    turns = [replace(r, table_rate=(1.0 + off) * r.table_rate) for r in turns]
    config = settings(rate_accuracy=5e-6)
    fit = reference_least_squares.fit(StageInput("gyroscope", with_noise(turns, config), None, config))
    truth, different = np.linalg.inv(K), rate_error(turns, config.table)
    assert different == pytest.approx(off, rel=0.01)
    found = with_stated(fit, with_noise(turns, config), config, different).to_json()
    error = np.abs(np.diag(np.array(found["matrix"]) - truth))
    assert error == pytest.approx(off * np.diag(truth), rel=0.2)  # the rate was wrong; angle and time were right
    assert np.all(error > np.diag(fit.to_json()["expanded_uncertainty"]["matrix"]))
    assert np.all(error < np.diag(found["expanded_uncertainty"]["matrix"]))
    precise = settings_of(config, **{"table.rate_accuracy": 1e-4})
    assert rate_error(turns, precise.table) == 0.0  # the stated accuracy explains the difference
    assert np.array_equal(with_stated(fit, with_noise(turns, precise), precise).covariance, fit.covariance)


@pytest.mark.parametrize(
    ("table", "up_to"), [({}, 0.0044), ({"gravity_g": 0.9976}, None), ({"gravity_accuracy_g": 0.0}, None)]
)
def test_gravity_that_nobody_states_is_named_with_its_size_on_earth(table: dict[str, float], up_to: float) -> None:
    found, left = by_angle("accelerometer", counted=False, **table)
    assert ("local gravity" in left) == ("gravity_accuracy_g" not in table)
    assert left.get("local gravity", {}).get("up_to", {}).get("matrix") == up_to
    assert any("local gravity" in source for source, _ in beyond_uncertainty(found.to_json())) == (up_to is not None)
    for place in (9.7639, 9.8337):  # Huascaran, Arctic Ocean: m/s^2 (Hirt et al. 2013)
        assert abs(place / 9.80665 - 1.0) < 0.00445


@pytest.mark.parametrize(
    ("sensor", "key", "u"),
    [("accelerometer", "gravity_accuracy_g", 0.0025), ("gyroscope", "clock_accuracy_ppm", 5774.0)],
)
def test_a_scale_that_the_held_out_reference_shares_is_not_expected_in_its_error(
    sensor: str, key: str, u: float
) -> None:
    without, _ = by_angle(sensor, counted=False)
    stated, _ = by_angle(sensor, counted=False, **{key: u})
    assert stated.covariance[3, 3] > 4.0 * without.covariance[3, 3]
    beside = covariance_without_reference(stated)
    assert beside == pytest.approx(without.covariance, rel=1e-6, abs=1e-6 * np.max(np.abs(without.covariance)))


def test_a_chain_of_stages_counts_what_is_stated_once(tmp_path: Path) -> None:
    bench = Bench("gyroscope", [0.3, -0.2, 0.5], K, white=0.01)
    turns = [r.select(np.abs(r.table_rate) > 1.0) for r in bench.turns_at([60.0, -60.0])]  # without a rest in them
    still = replace(bench.turns_at([0.0])[0], name="static", role="static")
    part = sheet(repeatability_bias=0.02).only(STEPS["fit"].settings)
    (tmp_path / "part.json").write_text(json.dumps({"units": {"U": part}, "last": {"U": "cholesky_lu"}}))
    stages = [tmp_path / "bias", tmp_path / "cholesky_lu"]
    ingested = write_pack(tmp_path / "ingest.zip", {"U.parquet": to_parquet([*turns, still])})
    recordings = filter_recordings([*turns, still], settings())
    filtered = write_pack(tmp_path / "filter.zip", FILES["filter"]("U", recordings))
    for stage, previous in zip(stages, ["", str(stages[0])], strict=True):
        chosen = ["--sensor", "gyroscope", "--stage", stage.name, "--previous", previous]
        folders = ["--config", str(tmp_path / "part.json"), "--output", str(stage)]
        folders += ["--ingest", str(ingested), "--filter", str(filtered)]
        batch.main("fit", [*folders, *chosen])
    first, last_one = (documents(stage)["U.json"] for stage in stages)
    u = [np.sqrt(np.diag(np.array(found["covariance"]["values"])))[:3] for found in (first, last_one)]
    assert u[0].max() < 0.005  # the bias of the rest, without what is stated
    assert u[1] == pytest.approx(np.full(3, 0.02), rel=0.05)


def test_a_wide_misalignment_does_not_hide_what_the_scale_factors_do_not_include() -> None:
    document = by_angle("accelerometer", counted=False)[0].to_json()
    document["expanded_uncertainty"]["matrix"][1][0] = 0.03  # by the limit of the sensor file
    assert any("local gravity" in source for source, _ in beyond_uncertainty(document))
