"""Recordings by hand with the faults of real ones: are held-out errors as expected, and uncertainties the errors?

    python -m pytest -m study tests/study/test_hand_held_study.py -s        (500 recordings, a quarter of an hour)

Every recording is drawn anew: the unit, its motion, turns about the vertical, ends of moves, creeping rests, stamps
that come late in bursts, errors that neighbouring moves share, logs of one sensor. Nothing is hidden in them.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest
from hand_simulator import Hand, draw, one_sensor

from pipeline.estimation.accelerometer import nonlinear_least_squares
from pipeline.estimation.gyroscope import rests_and_moves
from pipeline.estimation.noise import estimate_noise
from pipeline.validation.heldout import validate

CASES: dict[str, tuple[Hand, int]] = {  # and how many of each
    "all": (Hand(vertical=0.25, tail_dps=(0.7, 3.0), creep_dps=0.1, settle_deg=0.2, jitter=0.2), 200),
    "plain": (Hand(), 100),
    "vertical": (Hand(vertical=0.3), 40),
    "tail": (Hand(tail_dps=(0.7, 3.0)), 40),
    "creep": (Hand(creep_dps=0.1), 40),
    "shared": (Hand(settle_deg=0.3), 40),
    "bursts": (Hand(jitter=0.3), 40),
}
FITS = {"accelerometer": nonlinear_least_squares, "gyroscope": rests_and_moves}
ALONE = 5  # every fifth log holds the accelerometer alone
Z3 = 3.0  # standard deviations, of the mean of n squared errors of variance 2


def judged(hand: Hand, seed: int) -> dict[str, Any]:
    """Return each sensor's squared errors over squared uncertainties, and whether its held-out error is as expected."""
    drawn, found = draw(hand, seed), {}
    if seed % ALONE == 0:
        drawn = one_sensor(drawn, "accelerometer")
    for sensor, method in FITS.items():
        if drawn.recording.reading(sensor) is None:
            continue
        calibration = method.fit([drawn.recording], None, drawn.settings)
        assert calibration.covariance is not None
        variance = np.diag(calibration.covariance)
        error = np.concatenate(
            [calibration.bias - drawn.bias[sensor], (calibration.matrix - drawn.matrix[sensor]).ravel()]
        )
        noise = estimate_noise(sensor, [drawn.recording], drawn.settings["sensor"][sensor])
        part = validate(calibration, [drawn.recording], noise, drawn.settings)
        low, high = part["expected_rms_error"]
        chi = np.divide(error**2, variance, out=np.zeros(12), where=variance > 0.0)
        found[sensor] = {"chi": chi, "inside": low <= part["steps"][-1]["rms_error"] <= high}
    return found


def study(case: str, count: int) -> dict[str, list[dict[str, Any]]]:
    """Return what was judged of so many recordings, by sensor."""
    every = [judged(CASES[case][0], 10_000 + i) for i in range(count)]
    found = {sensor: [one[sensor] for one in every if sensor in one] for sensor in FITS}
    for sensor, ones in found.items():
        chi = np.mean([one["chi"] for one in ones], axis=0)
        inside = np.mean([one["inside"] for one in ones])
        line = f"{case} {sensor} n = {len(ones)}: inside {inside:.3f}; squared errors {np.round(chi, 2).tolist()}"
        sys.stderr.write(f"{line} mean {chi[chi > 0].mean():.2f}\n")
    return found


@pytest.mark.study
def test_held_out_errors_and_uncertainties_of_500_recordings() -> None:
    found = {case: study(case, count) for case, (_, count) in CASES.items()}
    for sensor in FITS:
        ones = [one for case in found.values() for one in case[sensor]]
        assert np.mean([one["inside"] for one in ones]) >= 0.98
        chi = np.mean([one["chi"] for one in ones], axis=0)[3:]
        assert np.all(chi[chi > 0.0] < 1.0 + Z3 * np.sqrt(2.0 / len(ones)) + 0.15)
        assert np.all(chi[chi > 0.0] > 1.0 - Z3 * np.sqrt(2.0 / len(ones)) - 0.15)


@pytest.mark.parametrize("case", ["all", "plain"])
def test_held_out_errors_of_a_few_recordings_are_as_expected(case: str) -> None:
    found = study(case, 2)
    assert all(one["inside"] for ones in found.values() for one in ones)
    assert all(one["chi"].mean() < 3.0 for ones in found.values() for one in ones)
