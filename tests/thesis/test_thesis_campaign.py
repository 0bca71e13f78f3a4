"""The campaign of the thesis: printed figures as published, recordings with the printed truth, methods on them."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from unit_settings import settings_of, with_noise

from imu_research.thesis.findings import TRUE_SCALE
from imu_research.thesis.seeds import FOUND, study_of
from imu_research.thesis.tables import DEVICES, SILENT, read_printed
from pipeline.app.config import load_campaign
from pipeline.core.records import Recording, SensorCalibration, coverage_factor
from pipeline.estimation.accelerometer.staged import STAGE_EQUATIONS as OF_ACCELEROMETER
from pipeline.estimation.gyroscope.staged import STAGE_EQUATIONS as OF_GYROSCOPE
from pipeline.estimation.stages import fit_stage
from pipeline.evaluation.held_out.samples import samples_of_motion
from pipeline.physics.measurement import linear_truth
from pipeline.physics.signal.filters import apply_filter
from pipeline.simulation.campaign import simulate_unit
from pipeline.simulation.description import read_description

CAMPAIGN = Path(__file__).parents[2] / "data" / "thesis"
PRINTED = CAMPAIGN / "printed"


@cache
def loaded() -> Any:
    return load_campaign({"campaign": "thesis"})


def printed_row(file: str, device: str, procedure: str) -> dict[str, Any]:
    rows = read_printed(PRINTED, file).to_dict("records")
    return next(r for r in rows if r["set"] == f"{device}-{procedure}")


@cache
def filtered(name: str) -> tuple[Recording, ...]:
    """Return a set of recordings behind the campaign's filter."""
    description = read_description(CAMPAIGN / "simulation.yaml")
    number = [u.unit for u in description.units].index(name)
    settings = loaded().units["mpu6050-1-stop-1s-printed"].config.filter
    recordings = simulate_unit(description.units[number], description.seed, number)[0]
    return tuple(apply_filter(r, settings) for r in recordings)


def fitted(name: str, sensor: str, stages: tuple[str, ...], method: str) -> SensorCalibration:
    settings = loaded().units[f"{name}-{method}"].config
    calibration = None
    for stage in stages:
        calibration = fit_stage(sensor, stage, with_noise(filtered(name), settings), calibration, settings)
    assert isinstance(calibration, SensorCalibration)
    return calibration


def mean_error(device: str, calibration: SensorCalibration | None) -> float:
    """Return the mean |e| of the gyroscope's held-out motion."""
    held_out = samples_of_motion("gyroscope", filtered(f"{device}-held-out-gyroscope")[0], SILENT, settings_of().table)
    assert held_out is not None
    rate = held_out.reading if calibration is None else linear_truth(calibration, held_out.reading)
    return float(np.mean(np.abs(np.linalg.norm(rate, axis=1) - held_out.magnitude)))


def test_the_printed_figures_are_those_of_the_thesis() -> None:
    errors = read_printed(PRINTED, "errors")
    means = errors[errors["metric"] == "mean_abs_error"]
    assert means[means["table"] == "5.8"]["after"].tolist() == [0.006, 0.007, 0.005]
    assert means[means["table"] == "5.14"][["before", "after"]].drop_duplicates().to_numpy().tolist() == [
        [0.069, 0.032]
    ]
    files = ("accel_parameters", "gyro_parameters", "errors")
    assert len({table for file in files for table in read_printed(PRINTED, file).table}) == 22
    methods = read_printed(PRINTED, "method_comparison")
    assert methods[methods["method"] == "cholesky_lu"]["change_percent"].tolist() == [83.615, 78.859, 5.276]


def test_every_printed_row_has_a_unit_for_every_method() -> None:
    units = loaded().units
    for file, methods in (
        ("accel_parameters", ("printed", "staged", "least-squares", "reference")),
        ("gyro_parameters", ("printed", "staged", "cholesky-printed", "cholesky", "reference")),
    ):
        for name in read_printed(PRINTED, file)["set"]:
            assert {f"{name}-{m}" for m in methods} <= set(units)


@pytest.mark.parametrize("device", DEVICES)
def test_the_accelerometer_s_stages_find_bias_and_scale_factor_of_the_truth(device: str) -> None:
    found = fitted(f"{device}-continuous-1dps", "accelerometer", list(OF_ACCELEROMETER), "staged")
    row = printed_row("accel_parameters", device, "continuous-1dps")
    told = [row[f"b_{a}_g"] for a in "xyz"]
    assert np.abs(found.bias - told).max() < 0.002
    assert np.abs(np.diag(found.matrix) - TRUE_SCALE[device]).max() < 0.005


@pytest.mark.parametrize("rate", [20, 200])
@pytest.mark.parametrize("device", DEVICES)
def test_the_gyroscope_s_stages_find_the_printed_bias_and_matrix(device: str, rate: int) -> None:
    found = fitted(f"{device}-gyro-{rate}dps", "gyroscope", list(OF_GYROSCOPE), "staged")
    row = printed_row("gyro_parameters", device, f"gyro-{rate}dps")
    assert np.abs(found.bias - [row[f"b_{a}_dps"] for a in "xyz"]).max() < 0.02
    told = np.array([[row[f"M{i}{j}"] for j in (1, 2, 3)] for i in (1, 2, 3)])
    assert np.abs(found.matrix.T - told).max() < 0.002


@pytest.mark.parametrize(("device", "change"), [("mpu6050-1", 83.615), ("mpu6050-2", 78.859), ("stim300", 5.276)])
def test_the_printed_advantage_over_cholesky_and_lu_is_the_missing_inversion(device: str, change: float) -> None:
    name = f"{device}-gyro-20dps"
    staged = fitted(name, "gyroscope", list(OF_GYROSCOPE), "staged")
    forward, inverted = (
        fitted(name, "gyroscope", ("bias", "cholesky_lu"), m) for m in ("cholesky-printed", "cholesky")
    )
    before, with_forward = mean_error(device, None), mean_error(device, forward)
    assert abs(100.0 * (before - with_forward) / before - change) < 10.0
    expanded = [
        coverage_factor(c.degrees_of_freedom) * np.sqrt(np.diag(c.covariance)[3:]).reshape(3, 3)
        for c in (staged, inverted)
        if c.covariance is not None
    ]
    assert np.all(np.abs(staged.matrix - inverted.matrix) < np.hypot(*expanded))
    assert mean_error(device, inverted) < 0.8 * with_forward


@pytest.mark.parametrize("name", ["mpu6050-2-continuous-30dps", "stim300-gyro-200dps"])
def test_the_study_over_seeds_comes_out_as_it_is_kept(name: str) -> None:
    rows = pd.read_csv(CAMPAIGN / "seeds.csv")
    kept = rows[(rows["set"] == name) & (rows["seed"] == 7)].to_dict("records")
    again = study_of(CAMPAIGN, [7], name)
    assert len(kept) == len(again) > 0
    for one, other in zip(kept, again, strict=True):
        assert one["method"] == other["method"]
        found = {name: other[name] for name in (*FOUND, "error") if name in other}
        assert found
        assert {name: one[name] for name in found} == pytest.approx(found, rel=1e-4)
