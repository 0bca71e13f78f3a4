from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from unit_settings import settings_of

from pipeline.core.records import Recording
from pipeline.estimation.rest_means import held_out_rests, holdout_interval, rest_means, split_rests
from pipeline.physics.signal.rests import Rest

PROCEDURE = settings_of(procedure={"holdout_every": 3}).procedure


def _steps(rests: int, role: str = "rests", name: str = "recording") -> Recording:
    """Rests of 4 s with moves of 1 s at 50 Hz; rest k reads (k, 0, 1)."""
    rng = np.random.default_rng(rests)
    k = np.repeat(np.arange(rests), 250)
    moving = np.tile(np.arange(250) >= 200, rests)
    force = np.column_stack([k, np.zeros_like(k), np.ones_like(k)]).astype(float)
    force += np.where(moving[:, None], 0.3, 1e-3) * rng.normal(size=force.shape)
    return Recording(name, role, None, np.arange(len(k)) * 20_000_000, accelerometer=force)


def test_the_mean_of_a_rest_leaves_out_clipped_stuck_and_missing_samples() -> None:
    force = np.array([[1.0, 2, 3], [3, 4, 5], [99, 99, 99], [np.nan, 0, 0], [5, 6, 7], [99, 99, 99]])
    flags = np.array([0, 1, 2, 0, 8, 4], np.uint16)
    recording = Recording("r", "rests", None, np.arange(6), accelerometer=force, flags=flags)
    means, counts = rest_means(recording, [Rest(0, 2), Rest(1, 6), Rest(2, 4)])
    assert counts.tolist() == [2, 2, 0]
    assert means[:2] == pytest.approx(np.array([[2.0, 3, 4], [4, 5, 6]]))
    assert np.isnan(means[2]).all()


def test_means_of_the_gyroscope_can_be_asked_for() -> None:
    recording = Recording("r", "rests", None, np.arange(4), gyroscope=np.arange(12.0).reshape(4, 3))
    assert rest_means(recording, [Rest(0, 4)], "gyroscope")[0] == pytest.approx(np.array([[4.5, 5.5, 6.5]]))
    assert rest_means(recording, [Rest(0, 4)])[0].shape == (0, 3)


def test_the_middle_one_of_each_three_rests_is_held_out() -> None:
    recording = _steps(8)
    split = split_rests(recording, 3)
    means, _ = rest_means(recording, split.held_out)
    assert means[:, 0] == pytest.approx([1, 4, 7], abs=1e-3)
    means, _ = rest_means(recording, split.used)
    assert means[:, 0] == pytest.approx([0, 2, 3, 5, 6], abs=1e-3)
    assert [(r.start, r.stop) for r in held_out_rests([recording], PROCEDURE)["recording"]] == [
        (r.start, r.stop) for r in split.held_out
    ]


def test_nothing_is_held_out_where_a_recording_is_for_validation() -> None:
    recordings = [_steps(4), _steps(3, "validation", "validation")]
    assert holdout_interval(recordings, PROCEDURE) == 0
    assert held_out_rests(recordings, PROCEDURE) == {}
    assert split_rests(recordings[0], 0).held_out == ()


def test_nothing_is_held_out_where_the_procedure_says_so() -> None:
    assert held_out_rests([_steps(4)], settings_of().procedure) == {}


def test_of_few_rests_none_is_held_out() -> None:
    procedure = PROCEDURE.replaced(holdout_from=8)
    assert held_out_rests([_steps(7)], procedure) == {}
    assert len(held_out_rests([_steps(8)], procedure)["recording"]) == 3
    assert held_out_rests([_steps(5), _steps(3)], procedure)["recording"]


def test_rests_of_other_roles_are_not_held_out() -> None:
    assert held_out_rests([_steps(4, "static", "static")], PROCEDURE) == {}


def test_a_table_log_takes_the_place_of_the_search() -> None:
    rate = np.where(np.arange(100) % 25 < 20, 0.0, 3.0)
    recording = Recording("r", "rests", "x", np.arange(100) * 100_000_000, np.zeros((100, 3)), table_rate=rate)
    assert [(r.start, r.stop) for r in split_rests(recording, 0).used] == [(0, 20), (28, 45), (53, 70), (78, 95)]


def test_with_a_sheet_rests_of_moves_are_held_out_as_in_multi_position_and_those_of_other_kinds_are_not() -> None:
    procedure = settings_of(procedure="listed").procedure
    by_hand = settings_of(procedure="multi_position").procedure
    moves, turn = (replace(_steps(15), name=kind, kind=kind) for kind in ("moves", "turn"))
    held = held_out_rests([moves, turn], procedure)
    assert held["turn"] == []
    assert held["moves"] == held_out_rests([_steps(15)], by_hand)["recording"]
    assert len(held["moves"]) == 5
    assert held_out_rests([replace(_steps(14), kind="moves"), turn], procedure) == {}
    assert held_out_rests([moves, replace(turn, role="validation")], procedure) == {}
