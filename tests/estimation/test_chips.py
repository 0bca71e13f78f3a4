"""How chips sit on a board, against boards whose positions are differentiated numerically."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from board_simulator import Chip, by_hand, draw_chip, felt, hand_board, table_board
from scipy.spatial.transform import Rotation
from unit_settings import settings_of

from pipeline.core.errors import NotObservableError
from pipeline.core.records import Recording, SensorCalibration
from pipeline.estimation.chips import chip_document

Q = Rotation.from_euler("zyx", [90, 3, -2], degrees=True).as_matrix()
PLACE = np.array([0.03, -0.02, 0.01])
DELAY = 0.004


@cache
def moved_by_hand(seed: int = 1) -> tuple[Chip, Chip]:
    rng = np.random.default_rng(seed)
    pair = draw_chip(rng, np.eye(3), np.zeros(3)), draw_chip(rng, Q, PLACE, DELAY)
    one, two = hand_board(rng, pair, by_hand(rng))
    return one, two


def ideal(axes: np.ndarray, place: np.ndarray, path, name: str = "recording", unit: str = "U") -> Chip:  # noqa: ANN001
    """Return a chip without errors of its own; only its readings have noise."""
    rng = np.random.default_rng([7, int(1e4 * place[0]) + 1000])
    noise = {"accelerometer": 5e-4, "gyroscope": 0.01}
    readings = {s: v @ axes.T + noise[s] * rng.standard_normal(v.shape) for s, v in felt(path, place).items()}
    recording = Recording(name, "rests", None, np.round(path.time * 1e9).astype(np.int64), **readings)
    return Chip(unit, [recording], {s: SensorCalibration(s) for s in noise}, settings_of().sensor)


def within(found: dict, kind: str, truth: np.ndarray, times: float = 1.5) -> bool:
    parts = [found["parameters"][f"{kind}_{axis}"] for axis in "xyz"]
    assert all(p["observable"] for p in parts)
    return all(abs(p["value"] - t) < times * p["expanded_uncertainty"] for p, t in zip(parts, truth, strict=True))


def test_boards_that_are_moved_by_hand() -> None:
    truth = {f"rotation_{a}": v for a, v in zip("xyz", np.degrees(Rotation.from_matrix(Q).as_rotvec()), strict=True)}
    truth |= {f"lever_arm_{a}": v for a, v in zip("xyz", PLACE, strict=True)}
    truth |= {f"time_offset_{sensor}": DELAY for sensor in ("accelerometer", "gyroscope")}
    inside = 0
    for seed in (1, 2, 3):
        found = chip_document(*moved_by_hand(seed))
        values = found["parameters"]
        inside += sum(abs(values[k]["value"] - v) < values[k]["expanded_uncertainty"] for k, v in truth.items())
        assert max(values[f"lever_arm_{a}"]["expanded_uncertainty"] for a in "xyz") < 5e-4
        assert max(values[f"time_offset_{s}"]["expanded_uncertainty"] for s in ("accelerometer", "gyroscope")) < 2e-4
        assert found["not_observable"] == found["doubts"] == []
    assert inside >= 19  # of 24, each with probability 0.95: 19 or more with 0.9997


def test_a_board_on_a_table() -> None:
    rng = np.random.default_rng(2)
    mounted = Rotation.from_rotvec([0.02, -0.01, 0.03]).as_matrix()
    pair = draw_chip(rng, mounted, np.zeros(3)), draw_chip(rng, Q @ mounted, PLACE)
    found = chip_document(*table_board(rng, pair, dict.fromkeys("xyz", (120.0, -120.0))))
    assert within(found, "rotation", np.zeros(3))  # calibrated readings of both are in the table's axes
    assert within(found, "axes_rotation", np.degrees(Rotation.from_matrix(Q).as_rotvec()))
    assert within(found, "lever_arm", PLACE)


def test_errors_of_the_table_cancel_between_chips_of_the_same_axes() -> None:
    contributions = []
    for turn in (np.eye(3), Q):
        rng = np.random.default_rng(3)
        pair = draw_chip(rng, np.eye(3), np.zeros(3)), draw_chip(rng, turn, PLACE)
        pair = pair[0], replace(pair[1], K=pair[0].K)
        chips = table_board(rng, pair, dict.fromkeys("xyz", (60.0,)), rate=20.0, orthogonality_deg=0.5)
        found = chip_document(*chips)
        source = "stated accuracies of the bench, accelerometers"
        line = next(b for b in found["uncertainty_budget"] if b["source"] == source)
        contributions.append(dict(zip(found["parameters"], line["contribution"], strict=True)))
    same, turned = contributions
    assert max(same[f"axes_rotation_{a}"] for a in "xyz") < 0.01  # of 0.5 deg between the table's axes
    assert max(turned[f"axes_rotation_{a}"] for a in "xyz") > 0.1
    assert max(c[f"rotation_{a}"] for c in contributions for a in "xyz") < 1e-3


def test_a_lever_arm_along_the_only_axis_of_turns_is_not_observable() -> None:
    path = by_hand(np.random.default_rng(4), axis=np.array([0.0, 0.0, 1.0]))
    found = chip_document(ideal(np.eye(3), np.zeros(3), path), ideal(Q, PLACE, path))
    values = found["parameters"]
    for i, a in enumerate("xy"):
        arm = values[f"lever_arm_{a}"]
        assert abs(arm["value"] - PLACE[i]) < 1.5 * arm["expanded_uncertainty"]
        assert arm["observable"]
    assert not values["lever_arm_z"]["observable"]
    assert values["lever_arm_z"]["expanded_uncertainty"] == pytest.approx(1.96 * 0.3, rel=0.05)
    (lost,) = found["not_observable"]
    assert lost["parameter"] == "lever_arm"
    np.testing.assert_allclose(lost["direction"], [0, 0, 1], atol=0.01)


def test_slow_moves_show_rotation_but_no_lever_arm() -> None:
    path = by_hand(np.random.default_rng(5), rests=10)
    slow = replace(path, time=path.time * 100.0, attitude=lambda t: path.attitude(t / 100.0),
                   linear=lambda t: np.zeros((len(t), 3)))  # fmt: skip
    slow = replace(slow, time=np.arange(1.0, slow.time[-1], 0.5))
    found = chip_document(ideal(np.eye(3), np.zeros(3), slow), ideal(Q, PLACE, slow))
    assert within(found, "rotation", np.degrees(Rotation.from_matrix(Q).as_rotvec()))
    assert not any(found["parameters"][f"lever_arm_{a}"]["observable"] for a in "xyz")


def test_one_attitude_shows_no_rotation() -> None:
    """A difference of the biases passes for a tilt, and gravity shows no turn about it."""
    path = by_hand(np.random.default_rng(6), rests=12, turn=(0.0, 1e-9))
    still = replace(path, linear=lambda t: np.zeros((len(t), 3)))
    found = chip_document(ideal(np.eye(3), np.zeros(3), still), ideal(Q, PLACE, still))
    lost = [n for n in found["not_observable"] if n["parameter"] == "rotation"]
    assert [n["unit"] for n in lost] == ["deg"] * 3
    assert min(n["expanded_uncertainty"] for n in lost) > 60.0


def test_stamps_of_their_own_and_half_a_turn() -> None:
    half = np.diag([1.0, -1.0, -1.0])
    path = by_hand(np.random.default_rng(8))
    other = replace(path, time=np.arange(0.0133, path.time[-1], 0.0083))
    found = chip_document(ideal(np.eye(3), np.zeros(3), path), ideal(half, PLACE, other))
    turn = Rotation.from_matrix(half.T @ np.array(found["rotation"])).magnitude()
    assert np.degrees(turn) < 0.05
    assert within(found, "lever_arm", PLACE, 2.0)


def test_chips_that_share_too_little_are_refused() -> None:
    one, two = moved_by_hand()
    short = replace(one, recordings=[one.recordings[0].select(slice(0, 500))])
    with pytest.raises(NotObservableError, match="5 s in common"):
        chip_document(short, two)
    with pytest.raises(NotObservableError, match="no sensor"):
        chip_document(one, replace(two, calibrations=dict.fromkeys(two.calibrations)))
    found = chip_document(one, replace(two, calibrations={**two.calibrations, "gyroscope": None}))
    assert "lever_arm_x" not in found["parameters"]
    assert found["not_observable"][-1]["reason"] == "it needs both sensors of both chips, calibrated"
