"""The next turn by hand: how an error of the gyroscope moves the vertical, and the turn that tells most of it."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.planning.guide import TURNS_DEG, Turn, most_informative_turn
from pipeline.records import SensorCalibration


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
            expected = Turn(axis, up, angle).sensitivity() @ error
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
