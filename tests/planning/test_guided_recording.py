"""The next rest and the next turn by hand: attitudes in words, known optimal designs, and what the fit then states."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations, product
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from unit_settings import with_noise

from pipeline.app.guide import (
    TURNS_DEG,
    GuideProgress,
    ProposedTurn,
    attitudes,
    default_goal,
    fitted_by_hand,
    in_words,
    most_informative_turn,
    propose,
)
from pipeline.app.guide import progress_of as progress_of_unit
from pipeline.core.records import Recording, SensorCalibration
from pipeline.estimation.accelerometer import nonlinear_least_squares
from pipeline.estimation.stages import StageInput
from pipeline.simulation.description import shipped_settings

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.core.settings import Settings

SHIPPED = shipped_settings(sensor="mpu6050", table="hand", procedure="multi_position")
SETTINGS = SHIPPED.replaced(procedure=SHIPPED.procedure.replaced(holdout_every=0))
WHITE, RATE, DWELL = 8e-4, 20.0, 4.0
AXES = {f"{s}{a}": sign * np.eye(3)[i] for i, a in enumerate("xyz") for s, sign in (("+", 1.0), ("-", -1.0))}


def recorded(attitudes: Sequence[Any], rng: np.random.Generator, white: float = WHITE) -> Recording:
    """Return rests in the attitudes, of a sensor with a bias and scale factors, and quick moves between them."""
    force = []
    for up in attitudes:
        shaken = rng.standard_normal((10, 3))
        still = np.tile(np.asarray(up) / np.linalg.norm(up), (int((DWELL + 0.5) * RATE), 1))
        force.append(np.concatenate([shaken, still]))
    reading = np.array([0.03, -0.02, 0.01]) + np.concatenate(force) * [1.01, 0.99, 1.005]
    reading += white * rng.standard_normal(reading.shape)
    time = np.round(np.arange(len(reading)) / RATE * 1e9).astype(np.int64)
    return Recording("recording", "rests", None, time, accelerometer=reading)


def progress_of(recordings: list[Recording], settings: Settings, dwell: float) -> GuideProgress:
    return progress_of_unit(fitted_by_hand(recordings, settings), settings, dwell)


@pytest.mark.parametrize(("first", "side"), [("+z", "+x"), ("-z", "+y"), ("+x", "-z"), ("-y", "-x")])
def test_a_side_that_is_raised_is_named_with_its_angle(first: str, side: str) -> None:
    for angle in (12.0, 27.0, 40.0):
        axis = np.cross(AXES[side], AXES[first])  # by the right hand the side rises about this axis
        turned = Rotation.from_rotvec(np.radians(angle) * axis)
        assert (turned.apply(AXES[side]) @ AXES[first]) == pytest.approx(np.sin(np.radians(angle)))
        vertical = turned.inv().apply(AXES[first])  # the vertical as the body sees it
        assert in_words(vertical) == f"{first} up, then the {side} side raised by {angle:.0f} deg"


def test_faces_and_corners_have_names() -> None:
    assert in_words([0.01, -0.02, 0.98]) == "+z up"
    assert in_words([1, -1, 1]) == "+z up, then the corner between its +x and -y sides raised by 55 deg"
    assert len({in_words(up) for up in attitudes()}) == 26


def _largest(up: Any) -> float:
    """Return the largest standard uncertainty of the nine parameters by rests of unit noise, from first principles."""
    n = np.asarray(up) / np.linalg.norm(up, axis=1, keepdims=True)
    columns = [-n, *(n[:, [i]] * n[:, [j]] for i, j in zip(*np.tril_indices(3), strict=True))]
    J = np.concatenate(columns, axis=1)
    return float(np.sqrt(np.diag(np.linalg.inv(J.T @ J)).max()))


def test_a_plan_is_as_good_as_a_design_that_is_known_to_be_optimal() -> None:
    golden = (1 + 5**0.5) / 2  # the icosahedron is a spherical 5-design: moments up to order 4 as of the whole sphere
    icosahedron = [np.roll([0, a, b * golden], k) for k, a, b in product(range(3), (1, -1), (1, -1))]
    rng, start = np.random.default_rng(1), [np.array([0.0, 0.0, 1.0])]
    done: list[Any] = list(start)
    while len(done) < 12:
        progress = progress_of([recorded(done, rng)], SETTINGS, DWELL)
        done.append(propose(progress, 0.9e-3 * 0.35).up)
    assert _largest(done) < 1.3 * _largest(icosahedron)
    random = [_largest(rng.standard_normal((12, 3))) for _ in range(200)]
    assert _largest(done) < np.quantile(random, 0.02)


@pytest.mark.parametrize("sensor", ["mpu6050", "stim300", "bmi270"])
def test_the_default_goal_is_what_24_rests_45_deg_apart_give(sensor: str) -> None:
    model, angles = shipped_settings(sensor=sensor).sensor, np.radians(np.arange(8) * 45.0)
    sheet = model.accelerometer
    turns = [np.roll([0.0, np.cos(a), np.sin(a)], axis) for axis in range(3) for a in angles]
    found = []
    for seed in range(6):
        rng = np.random.default_rng([4, seed])
        quiet = recorded(turns, rng, white=sheet.noise_density * np.sqrt(RATE / 2))
        assert quiet.accelerometer is not None
        keep, wander = np.exp(-1 / RATE / sheet.wander_time_s), [rng.standard_normal(3)]
        for step in np.sqrt(1 - keep**2) * rng.standard_normal((quiet.samples - 1, 3)):
            wander.append(keep * wander[-1] + step)
        log = replace(quiet, accelerometer=quiet.accelerometer + sheet.bias_wander * np.array(wander))
        found.append(progress_of([log], SETTINGS.replaced(sensor=model), DWELL).expanded)
    assert default_goal(sheet, 1.0, DWELL) == pytest.approx(np.median(found), rel=0.25)


def test_the_number_of_rests_and_the_uncertainty_come_true() -> None:
    rng = np.random.default_rng(2)
    done = list(attitudes()[:10])
    goal = 0.25e-3
    progress = progress_of([recorded(done, rng)], SETTINGS, DWELL)
    assert progress.reason.startswith("10 orientations leave")
    promised = propose(progress, goal)
    while progress.expanded > goal and len(done) < 60:
        done.append(propose(progress, goal).up)
        progress = progress_of([recorded(done, rng)], SETTINGS, DWELL)
    assert progress.expanded <= goal
    assert abs(len(done) - 10 - promised.further) <= 4
    assert propose(progress, goal).further == 0


def test_the_plan_starts_from_the_covariance_of_the_fit_while_a_misalignment_is_known_by_its_limit() -> None:
    for seed in range(3):
        log = [recorded(attitudes()[:10], np.random.default_rng(seed))]
        progress, found = (
            progress_of(log, SETTINGS, DWELL),
            nonlinear_least_squares.fit(StageInput("accelerometer", with_noise(log, SETTINGS), None, SETTINGS)),
        )
        assert progress.reason == "10 orientations leave misalignment_zy open"
        assert found.covariance is not None
        published = np.sqrt(np.diag(found.covariance))[nonlinear_least_squares.PLACE]
        assert np.sqrt(np.diag(np.linalg.inv(progress.information))) == pytest.approx(published, rel=1e-6)


def test_the_rest_that_is_held_out_is_far_from_the_others() -> None:
    rng = np.random.default_rng(3)
    settings = SETTINGS.replaced(procedure=SETTINGS.procedure.replaced(holdout_every=3))
    for count in range(1, 8):
        progress = progress_of([recorded(attitudes()[:count], rng)], settings, DWELL)
        after = progress_of([recorded(attitudes()[: count + 1], rng)], settings, DWELL)
        assert progress.next_is_held_out == (after.used == progress.used)
        if progress.next_is_held_out:
            angle = np.degrees(np.arccos(np.clip(progress.up @ propose(progress, 5e-4).up, -1.0, 1.0)))
            assert angle.min() > 40.0


@pytest.mark.parametrize("angle", TURNS_DEG)
def test_an_error_of_the_matrix_moves_the_integrated_vertical(angle: float) -> None:
    rate, samples = 60.0, 4000
    step = angle / rate / samples
    for axis, up in permutations(range(3), 2):
        true = rate * np.eye(3)[axis]
        for error in 1e-4 * np.eye(3):
            ends = []
            for read in (true, true + rate * error):  # the column of the axis of the turn is off
                attitude = Rotation.identity()
                for _ in range(samples // 400):
                    attitude *= Rotation.from_rotvec(np.radians(read) * step * 400)
                ends.append(attitude.inv().apply(np.eye(3)[up]))
            expected = ProposedTurn(axis, up, angle).sensitivity() @ error
            assert ends[1] - ends[0] == pytest.approx(expected, abs=3e-7)


def test_the_turn_is_about_the_axis_that_is_known_least() -> None:
    for axis in range(3):
        variance = np.full(12, 1e-10)
        variance[3 + 3 * np.arange(3) + axis] = 1e-6
        gyroscope = SensorCalibration("gyroscope", covariance=np.diag(variance))
        turn = most_informative_turn(gyroscope, 2e-4)
        assert turn.axis == axis
        assert turn.up != axis
        assert f"about its {'xyz'[axis]} axis, which stays level" in turn.in_words(4.0)
        # only a turn by half a circle and less moves the vertical by errors across its axis
        across = np.full(12, 1e-10)
        across[[3 + 3 * i + axis for i in range(3) if i != axis]] = 1e-6
        turn = most_informative_turn(SensorCalibration("gyroscope", covariance=np.diag(across)), 2e-4)
        assert (turn.axis, turn.angle) == (axis, 180.0)
