"""Sets of rests that do not determine an accelerometer are refused with the reason, not answered."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
import pytest
from unit_settings import settings_of, with_noise

from pipeline import calibrate
from pipeline.core.errors import CannotCalibrateError, NotObservableError
from pipeline.core.records import Recording
from pipeline.estimation.accelerometer.nonlinear_least_squares import fit
from pipeline.estimation.gyroscope import rests_and_moves
from pipeline.estimation.stages import StageInput

if TYPE_CHECKING:
    from pathlib import Path

SETTINGS = settings_of(sensor={"accelerometer": {"bias_wander": 1e-4, "cross_axis": 0.02}})
BOTH = settings_of(SETTINGS, **{"sensor.gyroscope.bias_wander": 3e-3})
BIAS = np.array([0.05, -0.03, 0.12])


def at_rest_in(directions: np.ndarray, seed: int = 1, noise: float = 1e-3) -> list[Recording]:
    """Rests of 4 s with shaken moves of 1.2 s between them, at 25 Hz."""
    rng, force = np.random.default_rng(seed), []
    for k, direction in enumerate(directions):
        following = directions[min(k + 1, len(directions) - 1)]
        blend = np.linspace(0.0, 1.0, 30)[:, None]
        shake = 0.15 * np.sin(np.arange(30))[:, None]
        force += [np.tile(direction, (100, 1)), direction * (1 - blend) + following * blend + shake]
    truth = np.concatenate(force)
    reading = BIAS + truth + noise * rng.standard_normal(truth.shape)
    return [Recording("recording", "rests", None, np.arange(len(truth)) * 40_000_000, accelerometer=reading)]


def in_a_plane(count: int = 16, out_of_it: float = 0.0) -> np.ndarray:
    """Directions across x, some of them so many deg out of the plane, to either side."""
    turn = 2.0 * np.pi * np.arange(count) / count
    lean = np.radians(out_of_it) * np.resize([1.0, -1.0, 0.0], count)
    across = np.cos(lean)[:, None] * np.column_stack([0 * turn, np.cos(turn), np.sin(turn)])
    return across + np.outer(np.sin(lean), [1.0, 0.0, 0.0])


def test_rests_that_all_lie_in_one_plane_leave_the_axis_across_it_open() -> None:
    with pytest.raises(NotObservableError, match=r"bias_x|scale_factor_x") as refused:
        fit(StageInput("accelerometer", with_noise(at_rest_in(in_a_plane()), SETTINGS), None, SETTINGS))
    assert "each axis up, down and level" in str(refused.value)


@pytest.mark.parametrize("lean", [0.5, 2.0])
def test_rests_that_nearly_lie_in_one_plane_are_refused_too(lean: float) -> None:
    with pytest.raises(NotObservableError, match=r"scale_factor_x"):
        fit(StageInput("accelerometer", with_noise(at_rest_in(in_a_plane(out_of_it=lean)), SETTINGS), None, SETTINGS))


def test_rests_well_out_of_the_plane_are_answered_within_their_uncertainty() -> None:
    found = fit(
        StageInput("accelerometer", with_noise(at_rest_in(in_a_plane(24, out_of_it=50.0)), SETTINGS), None, SETTINGS)
    )
    assert np.all(np.abs(found.bias - BIAS) < 4.0 * np.sqrt(np.diag(found.covariance)[:3]))
    assert found.convergence.rank == found.convergence.parameters
    assert 1.0 < found.convergence.condition < 100.0
    assert found.convergence.cosine <= found.convergence.cosine_at_minimum


def test_rests_in_one_direction_alone_are_refused() -> None:
    up = np.tile([0.0, 0.0, 1.0], (12, 1))
    with pytest.raises(
        NotObservableError, match=r"bias_z, .*scale_factor_z.*each axis up, down and level, spread evenly"
    ):
        fit(StageInput("accelerometer", with_noise(at_rest_in(up), SETTINGS), None, SETTINGS))


def test_a_recording_without_a_rest_says_so() -> None:
    time = np.arange(3000) * 0.04
    wave = np.column_stack([np.sin(3.1 * time), np.cos(2.3 * time), np.sin(1.7 * time + 1.0)])
    moving = Recording("recording", "rests", None, np.arange(3000) * 40_000_000, accelerometer=wave)
    with pytest.raises(NotObservableError, match="0 orientations determine neither bias nor scale factors") as refused:
        fit(StageInput("accelerometer", with_noise([moving], SETTINGS), None, SETTINGS))
    assert "better in 24 that are spread evenly" in str(refused.value)


def turned_by_hand(axes: str, lost: str = "", seed: int = 1) -> list[Recording]:
    """Rests of 4 s between moves of 72 deg about body axes in turn, at 25 Hz; readings of some moves are lost."""
    rng, step, rate, gone = np.random.default_rng(seed), 0.04, [], []
    for k in range(24):
        move = np.zeros((40, 3))
        move[:, "xyz".index(axes[k % len(axes)])] = 90.0 * np.sin(np.pi * np.arange(40) / 40) ** 2
        rate += [np.zeros((100, 3)), move]
        gone += [np.zeros(100, bool), np.full(40, axes[k % len(axes)] in lost)]
    omega, up = np.concatenate(rate), np.array([0.0, 0.6, 0.8])
    force = np.empty_like(omega)
    for n, turn in enumerate(np.radians(omega) * step):
        force[n] = up
        up = up - np.cross(turn, up)
        up /= np.linalg.norm(up)
    gyroscope = omega + 1.0 + 0.05 * rng.standard_normal(omega.shape)
    gyroscope[np.concatenate(gone)] = np.nan
    accelerometer = force + 1e-3 * rng.standard_normal(force.shape)
    time = np.arange(len(omega)) * 40_000_000
    return [Recording("recording", "rests", None, time, accelerometer=accelerometer, gyroscope=gyroscope)]


def test_moves_about_one_axis_alone_leave_the_gyroscope_without_a_vertical_that_is_known() -> None:
    with pytest.raises(CannotCalibrateError, match=r"direction of gravity.*nearly degenerate.*each axis up, down"):
        rests_and_moves.fit(StageInput("gyroscope", with_noise(turned_by_hand("x"), BOTH), None, BOTH))


def test_moves_of_which_only_those_about_one_axis_are_whole_are_refused() -> None:
    with pytest.raises(CannotCalibrateError, match=r"all were about one axis: record some 24 rests.*changing axes"):
        rests_and_moves.fit(StageInput("gyroscope", with_noise(turned_by_hand("xyz", lost="yz"), BOTH), None, BOTH))


@pytest.mark.parametrize(("axes", "reason"), [("xy", "nearly degenerate"), ("xxxxxxxxxxxy", "too much alike")])
def test_a_gyroscope_whose_moves_do_not_determine_it_is_null_beside_its_accelerometer(
    tmp_path: Path, axes: str, reason: str
) -> None:
    (recording,) = turned_by_hand(axes)
    readings = {"accel_{}_g": recording.accelerometer, "gyro_{}_dps": recording.gyroscope}
    columns = {"time_s": recording.time} | {
        name.format(axis): values[:, i]
        for name, values in readings.items()
        if values is not None
        for i, axis in enumerate("xyz")
    }
    by_hand = {"procedure": "multi_position", "method": "rests_and_moves"}
    result = calibrate({"recording": pd.DataFrame(columns)}, sensor="generic", **by_hand)
    assert result.calibration["status"] == "ok"
    assert result.calibration["gyroscope"] is None
    assert reason in result.calibration["not_calibrated"]["gyroscope"]
    assert result.accelerometer is not None
    assert np.abs(result.accelerometer.bias).max() < 0.005  # of 24 rests of 1 mg noise; the truth is 0
    result.report(tmp_path / "page.html")
    assert reason in (tmp_path / "page.html").read_text()


def test_moves_about_all_axes_are_answered() -> None:
    found = rests_and_moves.fit(StageInput("gyroscope", with_noise(turned_by_hand("xyz"), BOTH), None, BOTH))
    assert found.convergence.rank == found.convergence.parameters == 12
    assert np.abs(found.matrix - np.eye(3)).max() < 0.01
