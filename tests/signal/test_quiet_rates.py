"""Rests in which the gyroscope turns although the specific force is quiet: vertical turns, and the ends of moves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hand_simulator import Drawn, Hand, draw

from pipeline.records import Recording
from pipeline.signal.rests import Rest, find_rests


def moving_rate(drawn: Drawn, rests: list[Rest]) -> float:
    """Return the largest true-rate error of a rest's mean, deg/s: what its moving samples add to it."""
    gyroscope = drawn.recording.gyroscope
    assert gyroscope is not None
    means = []
    for rest in rests:
        inside = np.arange(rest.start, rest.stop)
        resting = inside[drawn.still[inside]]
        means.append(gyroscope[inside].mean(axis=0) - gyroscope[resting].mean(axis=0))
    return float(np.abs(means).max())


@pytest.mark.parametrize(
    "hand",
    [Hand(vertical=0.4), Hand(tail_dps=(0.7, 3.0)), Hand(vertical=0.3, tail_dps=(0.7, 3.0), creep_dps=0.1, jitter=0.3)],
    ids=["vertical", "tails", "all"],
)
def test_no_rest_holds_a_vertical_turn_or_the_end_of_a_move(hand: Hand) -> None:
    for seed in range(3):
        drawn = draw(hand, seed)
        rests = [rest for rest in find_rests(drawn.recording) if rest.accepted]
        assert len(rests) == hand.rests
        noise = 0.035 / np.sqrt(400)
        assert moving_rate(drawn, rests) < 3.0 * noise
        without = replace(drawn.recording, gyroscope=None)  # by the accelerometer alone they do
        assert moving_rate(drawn, [r for r in find_rests(without) if r.accepted]) > 10.0 * noise


def test_stamps_in_bursts_do_not_shorten_the_windows() -> None:
    drawn = draw(Hand(rests=12), 2)
    time = drawn.recording.time_ns
    number = np.minimum(np.arange(len(time)) // 5 * 5 + 4, len(time) - 1)
    late = time[number] + (np.arange(len(time)) % 5) * 200_000  # five samples arrive together, 0.2 ms apart
    found, burst = (find_rests(replace(drawn.recording, time_ns=t)) for t in (time, late))
    assert [(r.start, r.stop) for r in burst] == [(r.start, r.stop) for r in found]


def test_a_lone_turn_about_the_vertical_has_a_rest_at_either_end() -> None:
    """Nothing but the turn is recorded: the accelerometer feels no change, and most of the samples turn."""
    rng = np.random.default_rng(5)
    still, turning = 250, 600
    rate = np.zeros((2 * still + turning, 3))
    rate[still:-still, 2] = 60.0
    rate += [1.5, -3.0, 0.4] + 0.03 * rng.standard_normal(rate.shape)
    force = [0.01, 0.0, 1.0] + 0.002 * rng.standard_normal(rate.shape)
    time = np.round(1e9 * np.arange(len(rate)) / 100.0).astype(np.int64)
    found = find_rests(Recording("z_rot", "rests", "z", time, accelerometer=force, gyroscope=rate))
    assert [r.accepted for r in found] == [True, True]
    assert found[0].stop == pytest.approx(still, abs=25)
    assert found[1].start == pytest.approx(still + turning, abs=25)
