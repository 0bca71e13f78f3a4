from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from pipeline.core.errors import ConfigurationError
from pipeline.core.records.calibration import CorrectionStep, TwoSided, corrected, published, steps_of


def read(correction: dict[str, Any]) -> tuple[CorrectionStep, ...]:
    steps = steps_of(correction)
    assert steps is not None
    return steps


READINGS = np.array([[1.0, -2.0, 0.5], [-1.0, 2.0, 0.1]])


def test_no_correction_leaves_readings_as_they_are() -> None:
    assert steps_of(None) is None
    assert np.array_equal(corrected(read({"steps": []}), READINGS), READINGS)


def test_steps_act_one_after_the_other() -> None:
    swap = [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 2.0]]
    steps = [{"subtract": [1.0, 0.0, 0.0]}, {"matrix": swap}]
    assert corrected(read({"steps": steps}), READINGS).tolist() == [[-2.0, 0.0, 1.0], [2.0, -2.0, 0.2]]
    steps.reverse()
    assert corrected(read({"steps": steps}), READINGS).tolist() == [[-3.0, 1.0, 1.0], [1.0, -1.0, 0.2]]


def test_a_matrix_step_acts_on_columns() -> None:
    M = np.arange(9.0).reshape(3, 3)
    out = corrected(read({"steps": [{"matrix": M.tolist()}]}), READINGS)
    assert np.allclose(out[0], M @ READINGS[0])


def test_a_two_sided_step_chooses_the_factor_by_its_own_threshold() -> None:
    step = TwoSided(np.array([2.0, 2.0, 2.0]), np.array([3.0, 3.0, 3.0]), np.array([0.0, 0.0, 0.3]))
    assert np.allclose(corrected(read(published([step])), READINGS), [[2.0, -6.0, 1.0], [-3.0, 4.0, 0.3]])


def test_the_readings_that_are_given_are_not_changed() -> None:
    given = READINGS.copy()
    corrected(read({"steps": [{"subtract": [1.0, 1.0, 1.0]}]}), given)
    assert np.array_equal(given, READINGS)


def test_an_unknown_step_is_refused_by_name() -> None:
    with pytest.raises(ConfigurationError, match=r"\['rotate'\]; known kinds are subtract, matrix, two_sided"):
        corrected(read({"steps": [{"rotate": 1}]}), READINGS)
