"""A gyroscope whose mountings the accelerometer determines, where the accelerometer hides an effect of its own."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "study"))
from bench_units import judged


def test_an_effect_of_the_accelerometer_is_not_taken_for_mountings() -> None:
    found = judged("seats", 62, 0, 1.0)
    assert found["hidden"] == "accelerometer.scale_factor_asymmetry"
    gyroscope = found["sensors"]["gyroscope"]
    assert gyroscope["verdict"] == "nothing_missing"
    assert np.abs(gyroscope["error_over_U"]).max() < 1.3  # of 12 parameters; 1.47 where the effect is in the mountings


def test_mountings_are_in_doubt_where_the_accelerometer_shows_an_error_of_the_table() -> None:
    found = judged("seats", 62, 19, 1.0)
    assert found["hidden"] == "accelerometer.table_rate_ripple"
    gyroscope = found["sensors"]["gyroscope"]
    assert gyroscope["verdict"] == "reference_in_doubt"
    assert "the accelerometer, which determines the mountings, misses" in gyroscope["reason"]
