"""Faces and turns by hand, against the truth of a simulated unit, and the errors of recordings that lack one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ferraris_session import PROCEDURE, Session, held_out, in_parts, simulated
from scipy import stats
from unit_settings import settings_of, with_noise

from pipeline.core.errors import CannotCalibrateError, NotObservableError
from pipeline.estimation.gauss_markov import WHITE_SETTING
from pipeline.estimation.multi_position.fit import fit
from pipeline.estimation.multi_position.gyroscope import MIN_MOVES, GyroscopeModel, model_of
from pipeline.estimation.multi_position.model import NoiseHypothesis, State
from pipeline.estimation.noise import estimate_noise, noise_of
from pipeline.estimation.stages import fit_stage, last_fit
from pipeline.evaluation.held_out.attitude import gravity_direction
from pipeline.physics.signal.rests import find_rests
from pipeline.physics.signal.segments import multiples, turns_by_hand
from tests.published import diagnose

FACE = np.radians(PROCEDURE.faces.accuracy_deg)
OFF_DIAGONAL = [4, 5, 6, 8, 9, 10]


@pytest.fixture(scope="module")
def whole() -> Session:
    return held_out(simulated(2))


def without(session: Session, start_s: float, stop_s: float) -> Session:
    """Return the session without a part of its first recording."""
    first, *others = session.recordings
    time = first.time - first.time[0]
    return replace(session, recordings=[first.select((time < start_s) | (time > stop_s)), *others])


@pytest.mark.parametrize("sensor", ["accelerometer", "gyroscope"])
def test_both_matrices_are_full_and_within_their_uncertainty(whole: Session, sensor: str) -> None:
    error, u, freedom = whole.errors(sensor)
    assert not whole.calibrated(sensor).stages[-1].details.departures
    assert np.all(u > 0.0)
    assert np.all(np.abs(error) < stats.t.ppf(1.0 - 1e-3 / 24, freedom) * u)


def test_stages_after_the_faces_and_the_diagnosis_know_the_method_that_fitted_them(whole: Session) -> None:
    """The result ``faces`` of nonlinear_least_squares is no stage of a method: it has no declaration."""
    faces = whole.calibrated("accelerometer")
    assert [stage.name for stage in faces.stages] == ["nonlinear_least_squares", "faces"]
    assert last_fit(faces).free
    settings = settings_of(whole.settings, effects={"accelerometer": ["quadratic_nonlinearity"]})
    found = fit_stage("accelerometer", "effects", with_noise(whole.recordings, settings), faces, settings)
    assert [effect.name for effect in found.effects] == ["quadratic_nonlinearity"]
    assert last_fit(found).free


def test_a_face_is_known_to_the_hand_and_the_length_of_gravity_to_the_noise(whole: Session) -> None:
    _, u, _ = whole.errors("accelerometer")
    # Two faces up and down tell each of these elements: the mean of two angles.
    assert u[OFF_DIAGONAL] == pytest.approx(FACE / np.sqrt(2.0), rel=0.35)
    assert u[[3, 7, 11]].max() < 0.1 * FACE


def test_turns_alone_give_scale_and_direction_to_the_stated_accuracy() -> None:
    turns = PROCEDURE.turns
    session = in_parts(simulated(3))
    found = session.calibrated("gyroscope")
    _, u, _ = session.errors("gyroscope")
    assert np.all(u[[3, 7, 11]] < 1.3 * turns.accuracy_deg / 360.0)
    assert np.all(u[OFF_DIAGONAL] < 1.3 * np.radians(turns.axis_accuracy_deg))
    told = found.stages[-1].details.turns
    assert [(t.recording, t.axis, abs(t.stated_deg)) for t in told] == [(f"{axis}_rot", axis, 360.0) for axis in "xyz"]
    assert all(abs(t.angle_deg - t.stated_deg) < 4.0 * turns.accuracy_deg for t in told)


def test_an_accurate_stop_gives_an_accurate_scale() -> None:
    stated = {"turns": {"accuracy_deg": 0.3}}
    session = in_parts(simulated(4, procedure=stated, course={"turn_error_deg": 0.3}))
    error, u, freedom = session.errors("gyroscope")
    assert np.median(u[[3, 7, 11]]) < 1.25 * 0.3 / 360.0  # an axis askew in the chip adds what its other elements leave
    assert np.all(np.abs(error) < stats.t.ppf(1.0 - 1e-3 / 12, freedom) * u)


def test_a_hand_that_departs_from_what_is_stated_is_doubted() -> None:
    stated = {"turns": {"accuracy_deg": 0.3}, "faces": {"accuracy_deg": 0.1}}
    session = simulated(8, procedure=stated)
    found = {sensor: session.calibrated(sensor) for sensor in ("accelerometer", "gyroscope")}
    told = {sensor: fit.stages[-1].details.departures for sensor, fit in found.items()}
    assert any("times procedure.faces.accuracy_deg" in text for text in told["accelerometer"])
    assert any("times procedure.turns.accuracy_deg" in text for text in told["gyroscope"])
    noise = estimate_noise("gyroscope", session.recordings, session.settings.sensor.gyroscope)
    document = diagnose(found["gyroscope"], session.recordings, noise, session.settings)
    assert document["verdict"] == "reference_in_doubt"
    assert told["gyroscope"][0] in document["reason"]


def test_a_turn_of_other_angle_is_counted_in_multiples() -> None:
    assert multiples(np.array([3.0, -718.0, 20.0]), 360.0) == (1, -2)
    assert multiples(np.array([181.0, 5.0, -7.0]), 90.0) == (0, 2)
    assert multiples(np.array([90.0, 1.0, 0.0]), 360.0) == (0, 0)
    assert multiples(np.array([300.0, 1.0, 0.0]), 360.0)[1] == 0
    assert multiples(np.array([360.0, 120.0, 0.0]), 360.0)[1] == 0


def test_every_second_turn_is_held_out_and_judged(whole: Session) -> None:
    roles = [r.role for r in whole.recordings]
    assert roles.count("validation") == 3
    assert all(r.start_s is None or r.detail.endswith("found") for part in whole.recordings for r in part.notes)
    fits = {sensor: whole.calibrated(sensor) for sensor in ("accelerometer", "gyroscope")}
    noise = estimate_noise("gyroscope", whole.recordings, whole.settings.sensor.gyroscope)
    found = gravity_direction(
        fits["accelerometer"], fits["gyroscope"], whole.recordings, noise, whole.settings.procedure
    )
    assert found["moves"] == 3
    assert found["mean_deg"]["after"] < 3.0 * found["noise_floor_deg"] < 0.1 * found["mean_deg"]["before"]
    turns = found["turns"]
    assert [t["axis"] for t in turns] == ["x", "y", "z"]
    assert all(t["stated_deg"] == -360.0 for t in turns)
    assert all(abs(t["angle_deg"]["after"] + 360.0) < 12.0 for t in turns)


@pytest.mark.parametrize(("interval", "dwell", "held"), [(0.01, 4.0, 3), (0.1, 4.0, 3), (0.1, 2.0, 0)])
def test_rests_of_2_s_are_found_and_around_those_of_4_s_a_turn_is_held_out(
    interval: float, dwell: float, held: int
) -> None:
    session = simulated(3, interval_s=interval, course={"dwell_s": dwell})
    recording, stated = session.recordings[0], session.settings.procedure.turns
    rests = find_rests(recording)
    assert [rest.accepted for rest in rests] == 15 * [True]  # six faces, and three for each axis
    turns = turns_by_hand(recording, rests, stated)
    assert [turn.axis for turn in turns] == [0, 0, 1, 1, 2, 2]
    assert sum(turn.held_out for turn in turns) == held
    parts = held_out(session).recordings
    assert [r.role for r in parts].count("validation") == held
    if held:
        again = [find_rests(r) for r in parts if r.role == "validation"]
        assert all(len(found) == 2 and all(rest.accepted for rest in found) for found in again)


def test_a_rotation_of_the_case_changes_both_frames_and_no_move(whole: Session) -> None:
    """The moves tell nothing of the common frame: else the gyroscope would claim to know it better than the faces."""
    gyroscope = whole.calibrated("gyroscope")
    noise = noise_of("gyroscope", whole.recordings, whole.settings.sensor.gyroscope)
    model = model_of(whole.recordings, gyroscope, noise, whole.settings.procedure, whole.calibrated("accelerometer"))
    assert model is not None
    moves = model.equations_of_moves(State(gyroscope.bias, gyroscope.matrix))
    for x in range(3):
        R = np.zeros((3, 3))
        R[(x + 1) % 3, (x + 2) % 3], R[(x + 2) % 3, (x + 1) % 3] = -1.0, 1.0
        turned = moves.base @ np.append(np.zeros(3), (R @ gyroscope.matrix).ravel())
        by_accelerometer = moves.shared @ np.linalg.lstsq(moves.shared, turned)[0]
        assert np.linalg.norm(turned) * FACE > 20.0  # standard deviations of the moves' noise
        assert np.linalg.norm(turned - by_accelerometer) * FACE < 0.2


def test_a_part_with_too_few_moves_is_fitted_by_its_rests_and_turns_alone(whole: Session) -> None:
    """Cross-validation leaves out every third rest with the move before it: few moves may be left."""
    noise = noise_of("gyroscope", whole.recordings, whole.settings.sensor.gyroscope)
    model = model_of(whole.recordings, None, noise, whole.settings.procedure, whole.calibrated("accelerometer"))
    assert model is not None
    assert model.moves is not None
    used = np.arange(model.moves.count) < MIN_MOVES
    few = GyroscopeModel(model.every, model.moves.select(used), model.at_rests, noise, turns=model.turns)
    held = np.arange(len(few.rests.time)) == np.flatnonzero(~few.every.held_out).tolist().index(model.moves.after[0])
    part = few.without(held)
    alone = GyroscopeModel(part.every, None, part.at_rests, noise, turns=part.turns)
    assert (few.kinds, part.moves, alone.kinds) == (2, None, 1)
    start = State(np.average(part.rests.reading, axis=0), np.eye(3))
    levels = 0.0, 2.0, 6.0
    both = fit(part, start, [NoiseHypothesis(WHITE_SETTING, (a, b)) for a in levels for b in levels], {})
    one = fit(alone, start, [NoiseHypothesis(WHITE_SETTING, (a,)) for a in levels], {})
    assert both.state.matrix == pytest.approx(one.state.matrix, abs=1e-12)
    assert both.state.bias == pytest.approx(one.state.bias, abs=1e-12)
    assert both.log_likelihood == pytest.approx(one.log_likelihood, abs=1e-9)
    assert part.held_out_squares(both.state) == pytest.approx(alone.held_out_squares(one.state), abs=1e-12)


def test_a_missing_face_is_named() -> None:
    session = simulated(5)
    first = session.recordings[0]
    assert first.accelerometer is not None
    down = first.accelerometer[:, 1] < -0.8
    gone = replace(session, recordings=[first.select(~down), *session.recordings[1:]])
    with pytest.raises(NotObservableError, match=r"no rest with body -y up, within 15 deg: .*Nearest to up"):
        gone.calibrated("accelerometer")


def test_a_missing_turn_is_named_with_the_largest_about_its_axis() -> None:
    session = simulated(6, course={"turns": 1, "both_directions": False})
    first = session.recordings[0]
    assert first.gyroscope is not None
    fast = np.flatnonzero(np.abs(first.gyroscope[:, 2]) > 90.0)
    cut = without(session, *(first.time[[fast[0] - 50, len(first.time) - 1]] - first.time[0]))
    with pytest.raises(CannotCalibrateError, match=r"no turn about z by a multiple of 360 deg.* the largest about z"):
        cut.calibrated("gyroscope")


def test_an_implausible_angle_is_named_in_whole_and_in_parts() -> None:
    stated = {"turns": {"angle_deg": 500.0}}
    session = simulated(7, procedure=stated)
    with pytest.raises(CannotCalibrateError, match=r"no turn about x by a multiple of 500 deg.*is \((-)?3\d\d\.\d, "):
        session.calibrated("gyroscope")
    with pytest.raises(CannotCalibrateError, match=r"recording x_rot is no turn about x by a multiple of 500 deg"):
        in_parts(session).calibrated("gyroscope")
