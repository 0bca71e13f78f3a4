"""The Monte Carlo run beside a budget: against known distributions, against exact refits, and in the calibration."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from scipy.optimize import least_squares
from unit_settings import settings_of, with_noise

from pipeline.core.records import LIMIT, Budget, SensorCalibration
from pipeline.estimation import reference_least_squares
from pipeline.estimation.accelerometer import nonlinear_least_squares
from pipeline.estimation.engine import ErrorMixture, quadratic_results, through, with_trials
from pipeline.estimation.gyroscope import rests_and_moves
from pipeline.estimation.stages import StageInput
from pipeline.output.pages.pages import monte_carlo_of
from pipeline.simulation.campaign import simulate_unit
from pipeline.simulation.description import UnitDescription
from tests.hand_session import hand_held

if TYPE_CHECKING:
    from pipeline.core.settings import Settings

PARAMETERS = 12


def stated(u: float, value: float = 0.0) -> SensorCalibration:
    """A calibration of which only bias x is uncertain, with a budget that says so."""
    covariance = np.zeros((PARAMETERS, PARAMETERS))
    covariance[0, 0] = u**2
    bias = np.array([value, 0.0, 0.0])
    return SensorCalibration("accelerometer", bias=bias, covariance=covariance, budget=Budget((), ()))


def drawn(function: Any, u: float) -> Any:
    errors = ErrorMixture(np.ones(1), np.array([[[u**2]]]), np.inf)

    def results(e: np.ndarray) -> np.ndarray:
        out = np.tile(np.concatenate([np.zeros(3), np.eye(3).ravel()]), (len(e), 1))
        out[:, 0] = function(e[:, 0])
        return out

    return through(errors, [], results)


def test_a_linear_model_is_validated() -> None:
    run = with_trials(stated(0.02), drawn(lambda e: e, 0.02), 40_000).to_json()["uncertainty_budget"]["monte_carlo"]
    assert run["all_validated"]
    assert run["standard_uncertainty"][0] == pytest.approx(0.02, rel=0.02)
    assert run["high"][0] == pytest.approx(1.96 * 0.02, rel=0.02)


def test_a_square_is_not_validated_and_its_interval_is_that_of_chi_squared() -> None:
    found = with_trials(stated(0.02), drawn(lambda e: 10.0 * e**2, 0.02), 40_000)
    run = found.to_json()["uncertainty_budget"]["monte_carlo"]
    assert not run["validated"][0]
    assert run["high"][0] == pytest.approx(10.0 * 0.02**2 * 5.0239, rel=0.05)  # 97.5 % of chi squared, one degree
    assert run["low"][0] < 1e-5


def test_the_same_run_gives_the_same_numbers() -> None:
    first, second = (with_trials(stated(0.02), drawn(np.sinh, 0.02), 2000).to_json() for _ in range(2))
    assert first == second


def test_noise_that_is_a_mixture_keeps_its_long_tails() -> None:
    errors = ErrorMixture(np.array([0.9, 0.1]), np.array([[[1.0]], [[100.0]]]), np.inf)
    values = errors.draw(np.random.default_rng(1), 40_000)[:, 0]
    assert values.var() == pytest.approx(0.9 + 10.0, rel=0.05)
    assert np.mean(np.abs(values) > 5.0) == pytest.approx(0.1 * 0.6171, rel=0.1)


def test_second_order_steps_are_those_of_exact_refits() -> None:
    rng = np.random.default_rng(5)
    x, true = np.linspace(0.0, 2.0, 12), np.array([1.0, -0.8])
    slope = np.column_stack([np.exp(true[1] * x), true[0] * x * np.exp(true[1] * x)])
    bend = np.zeros((12, 2, 2))
    bend[:, 0, 1] = bend[:, 1, 0] = x * np.exp(true[1] * x)
    bend[:, 1, 1] = true[0] * x**2 * np.exp(true[1] * x)
    steps = quadratic_results(slope, bend, np.eye(12))
    e = 0.03 * rng.standard_normal((200, 12))
    data = true[0] * np.exp(true[1] * x) + e
    exact = np.array([least_squares(lambda p, y=y: p[0] * np.exp(p[1] * x) - y, true).x for y in data]) - true
    linear = e @ np.linalg.pinv(slope).T
    assert np.abs(steps(e) - exact).max() < 0.15 * np.abs(linear - exact).max()


def asked(settings: Settings) -> Settings:
    return settings_of(settings, uncertainty={"monte_carlo": 3000})


def test_methods_by_hand_and_on_a_table_run_it_beside_their_budget() -> None:
    unit = hand_held("mpu6050", 3)
    course = {"step_deg": 30.0, "dwell_s": 1.2, "rates_dps": [60.0], "static_s": 0.0, "validation_s": 0.0}
    turns, _ = simulate_unit(UnitDescription("U", course=course), 3, 0)
    settings = settings_of(unit.settings, table="acutronic")
    found = [
        nonlinear_least_squares.fit(
            StageInput("accelerometer", with_noise(unit.recordings, unit.settings), None, asked(unit.settings))
        ),
        rests_and_moves.fit(
            StageInput("gyroscope", with_noise(unit.recordings, unit.settings), None, asked(unit.settings))
        ),
        reference_least_squares.fit(StageInput("accelerometer", with_noise(turns, settings), None, asked(settings))),
    ]
    for calibration in found:
        budget = calibration.to_json()["uncertainty_budget"]
        run, U = budget["monte_carlo"], np.array(budget["expanded_uncertainty"])
        half = 0.5 * (np.array(run["high"]) - np.array(run["low"]))
        known = U > 0.0
        ratio = (half[known] / U[known]) / np.median(half[known] / U[known])
        assert np.abs(np.log(ratio)).max() < 0.5
        document = calibration.to_json()
        assert SensorCalibration.from_json(calibration.sensor, json.loads(json.dumps(document))).to_json() == document
        page = monte_carlo_of(document["uncertainty_budget"])
        assert page is not None
        assert page["rows"] == np.flatnonzero(known).tolist()


def test_in_six_positions_the_squares_of_the_misalignments_are_in_both() -> None:
    unit = hand_held("mpu6050", 3, procedure="six_positions", holdout_every=0)
    recordings = with_noise(unit.recordings, unit.settings)
    budget = nonlinear_least_squares.fit(StageInput("accelerometer", recordings, None, asked(unit.settings))).to_json()[
        "uncertainty_budget"
    ]
    run, u = budget["monte_carlo"], np.array(budget["standard_uncertainty"])
    known = u > 0.0
    shift = np.array(run["mean"]) - run["estimate"]  # half the variance of a misalignment, which is not corrected
    assert np.hypot(run["standard_uncertainty"], shift)[known] == pytest.approx(u[known], rel=0.12)
    (limit,) = (line for line in budget["contributions"] if line["source"] == LIMIT)
    assert limit["contribution"][3] > 0.5 * u[3]  # of the scale factor of x


def test_without_the_switch_there_is_no_run() -> None:
    unit = hand_held("mpu6050", 3)
    recordings = with_noise(unit.recordings, unit.settings)
    assert (
        "monte_carlo"
        not in nonlinear_least_squares.fit(StageInput("accelerometer", recordings, None, unit.settings)).to_json()[
            "uncertainty_budget"
        ]
    )
