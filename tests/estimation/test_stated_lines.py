"""Temperature and repeatability in a budget, as far as they are stated."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from stage_files import documents, write_pack
from table_turns import Bench, settings

from pipeline.estimation import reference_least_squares
from pipeline.estimation.uncertainty_budget import with_stated
from pipeline.io.parquet import to_parquet
from pipeline.records import FittedEffect
from pipeline.stages import batch
from pipeline.stages.unit_files import noise_file

if TYPE_CHECKING:
    from pathlib import Path

    from pipeline.records import Recording, SensorCalibration

K = np.diag([1.02, 0.99, 1.01])
WARM = (20.0, 26.0)  # degC, from the first sample to the last of each recording


@pytest.fixture(scope="module")
def fitted() -> tuple[SensorCalibration, list[Recording]]:
    turns = Bench("gyroscope", [0.3, -0.2, 0.5], K, white=0.01).turns_at([60.0, -60.0])
    warm = [replace(r, temperature=np.linspace(*WARM, r.samples)) for r in turns]
    return reference_least_squares.fit("gyroscope", warm, None, settings()), warm


def sheet(**stated: Any) -> dict[str, Any]:
    accuracy = stated.pop("accuracy", None)
    limits = {"bias_temperature": 0.05, "scale_factor_temperature": 1e-3}
    return {"sensor": {"temperature_accuracy_degc": accuracy, "gyroscope": {"effects": limits, **stated}}}


def line(found: SensorCalibration, source: str) -> dict[str, Any]:
    lines = (found.budget or {})["contributions"]
    return next(entry for entry in lines if entry["source"] == source)


def test_what_is_not_stated_is_named_with_the_key_that_states_it(fitted: Any) -> None:
    found = with_stated(*fitted, sheet())
    left = {entry["source"]: entry["reason"] for entry in (found.budget or {})["not_included"]}
    assert "sensor.gyroscope.repeatability_bias" in left["repeatability"]
    assert "no accuracy of the thermometer" in left["temperature"]
    assert np.array_equal(found.covariance, fitted[0].covariance)


def test_repeatability_adds_in_quadrature_and_has_infinite_degrees_of_freedom(fitted: Any) -> None:
    before = fitted[0]
    found = with_stated(*fitted, sheet(repeatability_bias=0.02, repeatability_scale_factor=3e-4))
    u, was = (np.sqrt(np.diag(c.covariance)) for c in (found, before))
    assert u[:3] == pytest.approx(np.hypot(was[:3], 0.02))
    diagonal = [3, 7, 11]
    assert u[diagonal] == pytest.approx(np.hypot(was[diagonal], 3e-4 * np.diag(before.matrix)), rel=1e-9)
    assert "repeatability" not in {e["source"] for e in (found.budget or {})["not_included"]}
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
    values = {f"b_T_{a}": {"value": v, "unit": "deg/s/degC"} for a, v in zip("xyz", (0.01, -0.02, 0.03), strict=True)}
    calibration, recordings = fitted
    size = 15
    budget = {**(calibration.budget or {}), "contributions": []}
    budget["effective_degrees_of_freedom"] = [None] * size
    covariance = np.zeros((size, size))
    covariance[:12, :12] = calibration.covariance
    warm = replace(
        calibration, covariance=covariance, budget=budget, effects=(FittedEffect("bias_temperature", values),)
    )
    found = with_stated(warm, recordings, sheet(accuracy=0.5))
    assert line(found, "temperature (bias)")["contribution"][:3] == pytest.approx([0.005, 0.01, 0.015])


def test_without_a_thermometer_in_the_recordings_that_is_said(fitted: Any) -> None:
    cold = [replace(r, temperature=None) for r in fitted[1]]
    found = with_stated(fitted[0], cold, sheet(accuracy=0.5))
    left = {entry["source"]: entry["reason"] for entry in (found.budget or {})["not_included"]}
    assert left["temperature"] == "the recordings hold no temperature"


def test_a_chain_of_stages_counts_what_is_stated_once(tmp_path: Path) -> None:
    bench = Bench("gyroscope", [0.3, -0.2, 0.5], K, white=0.01)
    turns = [r.select(np.abs(r.table_rate) > 1.0) for r in bench.turns_at([60.0, -60.0])]  # without a rest in them
    still = replace(bench.turns_at([0.0])[0], name="static", role="static")
    part = settings() | {"sensor": sheet(repeatability_bias=0.02)["sensor"] | {"accelerometer": {}}, "effects": {}}
    (tmp_path / "part.json").write_text(json.dumps({"units": {"U": part}}))
    stages = [tmp_path / "bias", tmp_path / "cholesky_lu"]
    ingested = write_pack(tmp_path / "ingest.zip", {"U.parquet": to_parquet([*turns, still])})
    filtered = write_pack(tmp_path / "filter.zip", noise_file("U", [*turns, still], settings()))
    for stage, previous, last in zip(stages, ["", str(stages[0])], ["no", "yes"], strict=True):
        chosen = ["--sensor", "gyroscope", "--stage", stage.name, "--previous", previous, "--last", last]
        folders = ["--config", str(tmp_path / "part.json"), "--output", str(stage)]
        folders += ["--ingest", str(ingested), "--filter", str(filtered)]
        batch.main("fit", [*folders, *chosen])
    first, last_one = (documents(stage)["U.json"] for stage in stages)
    u = [np.sqrt(np.diag(np.array(found["covariance"]["values"])))[:3] for found in (first, last_one)]
    assert u[0].max() < 0.005  # the bias of the rest, without what is stated
    assert u[1] == pytest.approx(np.full(3, 0.02), rel=0.05)
