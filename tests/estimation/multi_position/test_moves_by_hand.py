"""The gyroscope by hand: moves turn gravity as they should, and tell its matrix."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hand_session import hand_held
from scipy.special import stdtrit
from unit_settings import settings_of, with_noise

from imu_logs.log import Log
from imu_logs.profile import Checks
from imu_logs.units import TRIADS
from pipeline.core.errors import CannotCalibrateError
from pipeline.estimation.design import EffectColumns
from pipeline.estimation.effects import fit as fit_effects
from pipeline.estimation.gyroscope import rests_and_moves
from pipeline.estimation.multi_position.gyroscope import model_of
from pipeline.estimation.multi_position.model import State
from pipeline.estimation.multi_position.moves import to_the_end
from pipeline.estimation.stages import StageInput
from pipeline.ingest.quality_flags import examine
from pipeline.physics.effects import effect
from pipeline.simulation.trajectory import rotation_about

if TYPE_CHECKING:
    from pipeline.core.records import Recording


def test_a_steady_turn_is_integrated_exactly() -> None:
    axis = np.array([2.0, -1.0, 2.0]) / 3.0
    time = np.linspace(0.0, 2.0, 21)[None]
    A = to_the_end(np.broadcast_to(40.0 * axis, (1, 21, 3)), time)
    assert A[0, 0] == pytest.approx(rotation_about(axis, np.array([-80.0]))[0], abs=1e-12)
    assert A[0, 10] == pytest.approx(rotation_about(axis, np.array([-40.0]))[0], abs=1e-12)


def test_coning_motion_is_integrated_to_third_order() -> None:
    def end(samples: int) -> np.ndarray:
        t = np.linspace(0.0, 1.0, samples)
        rate = 90.0 * np.stack([np.cos(6.0 * t), np.sin(6.0 * t), 0.3 * t], axis=1)
        return to_the_end(rate[None], t[None])[0, 0]

    exact = end(3201)
    coarse, fine = (np.abs(end(n) - exact).max() for n in (26, 51))
    assert fine < 1e-3
    assert coarse / fine > 3.5


def test_bias_and_matrix_are_found_within_their_uncertainty() -> None:
    for model, seed in (("mpu6050", 1), ("stim300", 2)):
        unit = hand_held(model, seed, interval_s=0.02)
        found = unit.calibrated("gyroscope")
        true = np.concatenate([unit.truth["gyroscope"]["bias"], unit.true_matrix("gyroscope").ravel()])
        value = np.concatenate([found.bias, found.matrix.ravel()])
        assert found.covariance is not None
        off = np.abs(value - true) / np.sqrt(np.diag(found.covariance))
        assert found.converged
        assert off.max() < max(4.0, stdtrit(found.degrees_of_freedom, 1 - 0.5e-3 / 12)), off
        assert np.abs(value - true)[3:].max() < 1e-3


def test_derivatives_of_the_moves_are_those_of_their_residuals() -> None:
    unit = hand_held("mpu6050", 4)
    model = model_of(unit.recordings, None, None, unit.settings.procedure, unit.calibrated("accelerometer"))
    assert model is not None
    terms = (
        EffectColumns(effect("scale_factor_asymmetry"), np.array([2e-4, -1e-4, 1e-4])),
        EffectColumns(effect("g_sensitivity"), np.full(9, 0.002)),
    )
    near = unit.calibrated("gyroscope")
    state = State(near.bias, near.matrix, terms)
    columns, step = model.equations(state).columns, 1e-5
    scale = np.linalg.norm(columns, axis=0)
    for j in (0, 4, 11, 12, 15, 20):
        moved = []
        for sign in (1.0, -1.0):
            base, values = np.zeros(12), np.concatenate([t.values for t in terms])
            base[j if j < 12 else 0] = sign * step if j < 12 else 0.0
            values[max(j - 12, 0)] += sign * step if j >= 12 else 0.0
            there = State(
                state.bias + base[:3],
                state.matrix + base[3:].reshape(3, 3),
                tuple(replace(t, values=v) for t, v in zip(terms, np.split(values, [3]), strict=True)),
            )
            moved.append(-model.equations(there).residual)
        slope = (moved[0] - moved[1]) / (2.0 * step)
        assert np.linalg.norm(slope - columns[:, j]) < 0.03 * scale[j], j


def test_an_effect_of_moves_is_fitted_with_the_matrix() -> None:
    unit = hand_held("mpu6050", 5, {"gyroscope.scale_factor_asymmetry": None}, interval_s=0.02)
    settings = settings_of(unit.settings, effects={"gyroscope": ["scale_factor_asymmetry"]})
    found = fit_effects(
        StageInput("gyroscope", with_noise(unit.recordings, settings), unit.calibrated("gyroscope"), settings)
    )
    truth = np.array(list(unit.truth["gyroscope"]["effects"]["scale_factor_asymmetry"].values()))
    assert found.covariance is not None
    assert np.all(np.abs(found.effects[0].values - truth) < 4.0 * np.sqrt(np.diag(found.covariance))[12:])
    assert np.sqrt(np.diag(found.covariance))[12:].max() < 5e-4


def test_without_rests_by_hand_the_gyroscope_is_left_null_with_the_reason() -> None:
    unit = hand_held("mpu6050", 6)
    turns: list[Recording] = [replace(r, role="gyroscope", axis="x") for r in unit.recordings]
    with pytest.raises(CannotCalibrateError, match="24 rests"):
        rests_and_moves.fit(StageInput("gyroscope", with_noise(turns, unit.settings), None, unit.settings))


def test_too_few_moves_are_refused() -> None:
    unit = hand_held("mpu6050", 6, procedure="six_positions", holdout_every=0)
    with pytest.raises(CannotCalibrateError, match="at least 6 moves") as refused:
        rests_and_moves.fit(StageInput("gyroscope", with_noise(unit.recordings, unit.settings), None, unit.settings))
    assert "holdout_every" not in str(refused.value)
    unit = hand_held("mpu6050", 6, procedure="six_positions", holdout_every=3)
    with pytest.raises(
        CannotCalibrateError, match=r"2 are held out for validation \(procedure.holdout_every=0 uses them"
    ):
        rests_and_moves.fit(StageInput("gyroscope", with_noise(unit.recordings, unit.settings), None, unit.settings))
    unit = hand_held("mpu6050", 6)
    few = [
        replace(r.select(slice(int(0.5 * r.samples), int(0.7 * r.samples))), role="rests")
        for r in unit.recordings
        if r.role == "rests"
    ]
    with pytest.raises(
        CannotCalibrateError, match=r"so 3 rests, .* are held out .* use them by procedure.holdout_every=0"
    ):
        rests_and_moves.fit(StageInput("gyroscope", with_noise(few, unit.settings), None, unit.settings))


@pytest.mark.parametrize(("share", "left"), [(0.8, 14), (0.5, 0)])
def test_moves_that_are_clipped_below_the_stated_range_are_left_out_and_named(share: float, left: int) -> None:
    unit = hand_held("mpu6050", 5, interval_s=0.01)
    whole, *others = unit.recordings
    assert whole.gyroscope is not None
    end = share * np.abs(whole.gyroscope).max(axis=0)
    clipped = replace(whole, gyroscope=np.clip(whole.gyroscope, -end, end))
    channels = {sensor: clipped.reading(sensor) for sensor in TRIADS}
    values = {c: channels[s][:, k] for s, triad in TRIADS.items() for k, c in enumerate(triad)}
    table = Log("log.csv", whole.time_ns, values, {}, np.arange(whole.samples), {})
    flags, notes = examine(table, unit.settings.sensor, Checks())
    assert all(n.code == "N-CLIP" and n.detail.startswith("gyro_") for n in notes)
    assert flags is not None
    np.testing.assert_array_equal(flags > 0, np.any(np.abs(whole.gyroscope) >= end, axis=1))
    marked = replace(unit, recordings=[replace(clipped, flags=flags), *others])
    if not left:
        with pytest.raises(CannotCalibrateError, match=r"and \d\d of the 39 moves hold clipped or stuck readings"):
            marked.calibrated("gyroscope")
        return
    found = marked.calibrated("gyroscope")
    assert found.stages[-1].details.moves == left
    assert np.abs(found.matrix - unit.true_matrix("gyroscope")).max() < 3e-4  # 0.1 with the clipped moves
    assert marked.diagnosed("gyroscope", calibration=found)["verdict"] == "nothing_missing"


def test_rests_at_the_end_of_the_readings_of_a_coarse_log_are_not_clipped() -> None:
    rng = np.random.default_rng(1)
    rate = np.full((1000, 3), -2.4)
    for start in range(100, 1000, 100):  # moves in one direction alone
        rate[start : start + 30] += 60.0 * rng.uniform(size=3) * np.sin(np.linspace(0.0, np.pi, 30))[:, None]
    values = dict(zip(TRIADS["gyroscope"], (0.2 * np.round(rate / 0.2)).T, strict=True))
    table = Log("log.csv", 10_000_000 * np.arange(1000), values, {}, np.arange(1000), {})
    flags, notes = examine(table, hand_held("mpu6050", 5).settings.sensor, Checks())
    assert notes == []
    assert flags is None or not flags.any()
