"""Errors of moves beyond their noise: one far off is told and has no weight; those that moves share are budgeted."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hand_simulator import Drawn, Hand, draw
from unit_settings import with_noise

from pipeline.estimation.gyroscope import rests_and_moves
from pipeline.estimation.stages import StageInput
from pipeline.physics.signal.rests import find_rests

if TYPE_CHECKING:
    from pipeline.core.records import SensorCalibration


def squared_errors(found: SensorCalibration, drawn: Drawn) -> np.ndarray:
    """Return the squared errors of the matrix over their squared standard uncertainties: (9,) array."""
    assert found.covariance is not None
    return (found.matrix - drawn.matrix["gyroscope"]).ravel() ** 2 / np.diag(found.covariance)[3:]


def knocked(drawn: Drawn, moves: list[int]) -> tuple[Drawn, list[float]]:
    """Return a unit whose gyroscope misses 0.8 deg or so in some moves, and when these begin."""
    rate, begin = np.array(drawn.recording.gyroscope), []
    rests = find_rests(drawn.recording)
    for k in moves:
        start, stop = rests[k].stop, rests[k + 1].start
        middle = (start + stop) // 2
        rate[middle - 5 : middle + 5] += [6.0, -5.0, 4.0]  # deg/s over 0.1 s
        begin.append(float(drawn.recording.time[start - 1]))
    return replace(drawn, recording=replace(drawn.recording, gyroscope=rate)), begin


def test_moves_far_off_the_others_are_told_and_take_no_part() -> None:
    drawn = draw(Hand(), 21)
    off, begin = knocked(drawn, [8, 20])  # every third rest from the second is held out, with the move before it
    sound, found = (
        rests_and_moves.fit(StageInput("gyroscope", with_noise([d.recording], d.settings), None, d.settings))
        for d in (drawn, off)
    )
    assert sound.stages[-1].details.moves_outlying == []
    told = found.stages[-1].details.moves_outlying
    assert [move.time_s for move in told] == pytest.approx(begin, abs=0.02)
    assert all(move.over_noise > 10.0 and move.weight < 0.1 for move in told)
    assert sound.covariance is not None
    u = np.sqrt(np.diag(sound.covariance))[3:].reshape(3, 3)
    assert np.abs(found.matrix - sound.matrix).max() < u.max()
    assert found.covariance is not None
    assert np.sqrt(np.diag(found.covariance))[3:] == pytest.approx(u.ravel(), rel=0.5)


def test_errors_that_neighbouring_moves_share_are_in_the_uncertainty() -> None:
    """The direction of gravity at each rest is off by 0.3 deg: taken for independent, the ratio is 1.4 (n = 40)."""
    ratio = [
        squared_errors(
            rests_and_moves.fit(StageInput("gyroscope", with_noise([d.recording], d.settings), None, d.settings)), d
        ).mean()
        for d in (draw(Hand(rests=30, settle_deg=0.3), seed) for seed in range(5))
    ]
    assert 0.3 < np.mean(ratio) < 1.7
