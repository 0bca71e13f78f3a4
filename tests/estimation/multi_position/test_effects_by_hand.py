"""Base and effects fitted together to hand-held rests: values, uncertainties, frame, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hand_session import WARM, Unit, hand_held
from scipy.special import stdtrit
from unit_settings import settings_of, with_noise

from pipeline.core.errors import NotObservableError
from pipeline.estimation.effects import fit as fit_effects
from pipeline.estimation.multi_position.accelerometer import model_of
from pipeline.estimation.multi_position.fit import COMPARED_STEP
from pipeline.estimation.multi_position.model import selection_hypotheses
from pipeline.estimation.multi_position.selection import SelectionByHand, fit_configured, limits_of
from pipeline.estimation.noise import estimate_noise
from pipeline.estimation.stages import StageInput
from tests.published import validate

if TYPE_CHECKING:
    from pipeline.core.records import SensorCalibration

LOWER = [0, 1, 2, *(3 + 3 * np.tril_indices(3)[0] + np.tril_indices(3)[1]).tolist()]
CASES = [
    ("mpu6050", "quadratic_nonlinearity"),
    ("stim300", "scale_factor_asymmetry"),
    ("mpu6050", "cubic_nonlinearity"),
    ("mpu6050", "cross_axis_nonlinearity"),
    ("stim300", "bias_temperature"),
    ("mpu6050", "scale_factor_temperature"),
    ("stim300", "warm_up"),
]


def fitted(unit: Unit, wanted: Any, before: SensorCalibration | None = None) -> SensorCalibration:
    before = before or unit.calibrated("accelerometer")
    settings = settings_of(unit.settings, effects={"accelerometer": wanted})
    return fit_effects(StageInput("accelerometer", with_noise(unit.recordings, settings), before, settings))


def deviations(unit: Unit, found: SensorCalibration) -> np.ndarray:
    """Return how far bias, triangular matrix and effects are off the truth, in standard uncertainties."""
    truth = unit.truth["accelerometer"]
    effects = np.concatenate([list(truth["effects"][e.name].values()) for e in found.effects])
    true = np.concatenate([truth["bias"], unit.true_matrix("accelerometer").ravel(), effects])
    value = np.concatenate([found.bias, found.matrix.ravel(), *(e.values for e in found.effects)])
    assert found.covariance is not None
    index = [*LOWER, *range(12, len(true))]
    return (value - true)[index] / np.sqrt(np.diag(found.covariance))[index]


@pytest.mark.parametrize(("model", "name"), CASES)
def test_effects_and_base_are_found_within_their_uncertainty(model: str, name: str) -> None:
    temperature = WARM if "temperature" in name else None
    for seed in (1, 2):
        unit = hand_held(model, seed, {f"accelerometer.{name}": None}, temperature=temperature)
        found = fitted(unit, [name])
        off = np.abs(deviations(unit, found))
        assert found.converged
        assert off.max() < max(4.0, stdtrit(found.degrees_of_freedom, 1 - 0.5e-3 / len(off))), (seed, off)


def test_uncertainties_cover_what_they_say() -> None:
    within, squares = [], []
    for seed in range(10):
        unit = hand_held("stim300", 100 + seed, {"accelerometer.quadratic_nonlinearity": None})
        found = fitted(unit, ["quadratic_nonlinearity"])
        off = deviations(unit, found)
        squares.append(off**2)
        within.append(np.abs(off) < stdtrit(found.degrees_of_freedom, 0.975))
    assert 0.88 < np.mean(within) < 0.995
    assert 0.7 < np.sqrt(np.mean(squares)) < 1.3


def test_the_matrix_keeps_the_rotation_of_the_method_before() -> None:
    unit = hand_held("stim300", 3, {"accelerometer.quadratic_nonlinearity": None})
    before = unit.calibrated("accelerometer")
    plain = fitted(unit, ["quadratic_nonlinearity"], before)
    assert np.abs(np.triu(plain.matrix, 1)).max() == 0.0
    c, s = np.cos(0.1), np.sin(0.1)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    turned = fitted(unit, ["bias_drift"], replace(before, matrix=R @ before.matrix, covariance=None))
    straight = fitted(unit, ["bias_drift"], before)
    assert R.T @ turned.matrix == pytest.approx(straight.matrix, abs=1e-9)
    assert turned.bias == pytest.approx(straight.bias, abs=1e-9)


def test_of_three_cross_axis_terms_the_length_of_gravity_tells_only_the_sum() -> None:
    unit = hand_held("mpu6050", 4, {"accelerometer.cross_axis_nonlinearity": None})
    found = fitted(unit, ["cross_axis_nonlinearity"])
    assert found.covariance is not None
    names = found.parameters.names
    three = [names.index(f"cross_axis_nonlinearity.K_{term}") for term in ("x_yz", "y_zx", "z_xy")]
    own = found.covariance[np.ix_(three, three)]
    limit = unit.settings.sensor.accelerometer.effects["cross_axis_nonlinearity"]
    assert 0.25 * limit < np.sqrt(np.diag(own)).min() < np.sqrt(np.diag(own)).max() < 0.5 * limit
    assert np.sqrt(own.sum()) < 0.2 * limit
    truth = unit.truth["accelerometer"]["effects"]["cross_axis_nonlinearity"]
    total = sum(truth[f"K_{term}"] for term in ("x_yz", "y_zx", "z_xy"))
    assert abs(found.effects[0].values[np.array(three) - 12].sum() - total) < 4.0 * np.sqrt(own.sum())


def test_what_is_selected_brings_held_out_rests_to_the_noise_floor() -> None:
    unit = hand_held("mpu6050", 5, {"accelerometer.quadratic_nonlinearity": None})
    found = fitted(unit, "auto")
    assert [e.name for e in found.effects] == ["quadratic_nonlinearity"]
    noise = estimate_noise("accelerometer", unit.recordings, unit.settings.sensor.accelerometer)
    part = validate(found, unit.recordings, noise, unit.settings)
    error = {step["name"]: step["rms_error"] for step in part["steps"]}
    assert part["held_out"]
    assert error["+ quadratic_nonlinearity"] < 1.6 * part["noise_floor"]
    assert (
        validate(unit.calibrated("accelerometer"), unit.recordings, noise, unit.settings)["steps"][-1]["rms_error"]
        > 4.0 * (part["noise_floor"])
    )


def test_where_nothing_is_missing_auto_leaves_the_calibration_as_it_was() -> None:
    unit = hand_held("mpu6050", 6)
    before = unit.calibrated("accelerometer")
    assert fitted(unit, "auto", before) is before


@pytest.mark.parametrize(
    ("name", "reason"),
    [("table_tilt", "there is no table"), ("hysteresis", "do not determine"), ("lever_arm", "the heading of the unit")],
)
def test_an_effect_that_rests_cannot_show_is_refused_with_the_reason(name: str, reason: str) -> None:
    with pytest.raises(NotObservableError, match=reason):
        fitted(hand_held("mpu6050", 6), [name])


def test_an_effect_of_temperature_needs_a_temperature() -> None:
    unit = hand_held("mpu6050", 6)
    bare = replace(unit, recordings=[replace(r, temperature=None) for r in unit.recordings])
    with pytest.raises(NotObservableError, match="hold no temperature"):
        fitted(bare, ["bias_temperature"])


def test_six_rests_are_too_few_for_an_effect() -> None:
    unit = hand_held("mpu6050", 6, procedure="six_positions", holdout_every=0)
    with pytest.raises(NotObservableError, match=r"6 rests .* too few .* record at least"):
        fitted(unit, ["quadratic_nonlinearity"])


def test_derivatives_of_the_rests_are_those_of_their_residuals() -> None:
    names = ["quadratic_nonlinearity", "bias_temperature"]
    unit = hand_held("mpu6050", 7, {"accelerometer.quadratic_nonlinearity": None})
    before = unit.calibrated("accelerometer")
    model = model_of(unit.recordings, before, None, unit.settings)
    assert model is not None
    limits = limits_of("accelerometer", unit.settings.sensor.accelerometer)
    state = fit_configured(model, before, names, selection_hypotheses(None, 1), limits).state
    equations, step = model.equations(state), 1e-6
    for j in range(6):
        values = np.concatenate([t.values for t in state.terms])
        moved = []
        for sign in (1.0, -1.0):
            now = values.copy()
            now[j] += sign * step
            terms = tuple(replace(t, values=v) for t, v in zip(state.terms, np.split(now, [3]), strict=True))
            there = model.equations(replace(state, terms=terms))
            moved.append(-there.residual * there.error)
        slope = (moved[0] - moved[1]) / (2.0 * step)
        column = np.concatenate(equations.effects, axis=1)[:, j] * equations.error
        assert slope == pytest.approx(column, abs=0.02 * np.abs(column).max())  # an effect of first order: 1 % of it


def test_a_candidate_at_its_optimum_has_the_uncertainty_of_the_fit_with_it() -> None:
    unit = hand_held("stim300", 1, {"accelerometer.warm_up": None}, temperature=WARM)
    sheet = unit.settings.sensor.accelerometer
    noise, start = estimate_noise("accelerometer", unit.recordings, sheet), unit.calibrated("accelerometer")
    model = model_of(unit.recordings, start, noise, unit.settings)
    assert model is not None
    selection = SelectionByHand(model, start, [], noise, sheet)
    score = selection.first.scores["warm_up"]
    fit = fit_configured(model, start, ["warm_up"], selection.hypotheses, selection.bounds)
    assert score.uncertainty == pytest.approx(np.sqrt(np.diag(fit.covariance))[-len(score.values) :], rel=COMPARED_STEP)
