"""How far a hidden effect stands out of the noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from imu_research.study.bench import signals_left
from imu_research.study.cases import StudyCase, draw


def test_twice_the_effect_leaves_four_times_the_signal() -> None:
    case = StudyCase("single", 0, 3, "mpu6050", "accelerometer", "stop_and_go", {"cubic_nonlinearity": [5e-3] * 3})
    (once,), (twice,) = (
        signals_left(replace(case, hidden={name: (factor * np.array(values)).tolist()})).values()
        for factor in (1.0, 2.0)
        for name, values in case.hidden.items()
    )
    assert twice / once == pytest.approx(4.0, rel=0.03)


def test_an_effect_is_left_with_less_beside_its_look_alike() -> None:
    hidden = {"bias_temperature": [0.16] * 3, "warm_up": [0.3, 0.3, 0.3, 180.0]}
    case = StudyCase("pairs", 1, 3, "mpu6050", "gyroscope", "stop_and_go", hidden)
    beside = signals_left(case)
    for name, values in hidden.items():
        alone = signals_left(replace(case, hidden={name: values}))[name]
        assert beside[name] < 0.25 * alone


def test_what_cannot_be_seen_leaves_nothing() -> None:
    cases = [case for k in range(40) if (case := draw("unseen", k, 2)).procedure != "at_rest"]
    for case in cases[:3]:
        assert max(signals_left(case).values()) < 30.0


def test_noise_of_other_families_and_empty_units_are_not_judged() -> None:
    assert signals_left(draw("null_normal", 0, 2)) == {}
    assert signals_left(draw("cold", 0, 2)) == {}
