"""Whether held-out motion contradicts a matrix by less than shows in the rms error: simulated units, changed there."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from unit_settings import settings_of, with_noise

from pipeline.core.records import Recording, SensorCalibration
from pipeline.estimation import effects, reference_least_squares
from pipeline.estimation.noise import estimate_noise
from pipeline.estimation.stages import StageInput
from pipeline.evaluation.diagnosis.verdict import DISAGREES
from pipeline.evaluation.held_out.validation import validate
from pipeline.simulation.campaign import simulate_unit
from pipeline.simulation.description import UnitDescription
from tests.published import diagnose

SETTINGS = settings_of(sensor="mpu6050", table="acutronic", procedure={"holdout_every": 3})
TURN = np.array([[0.0, -5e-4, 0.0], [5e-4, 0.0, 0.0], [0.0, 0.0, 0.0]])


@cache
def unit(hidden: str = "") -> tuple[Recording, ...]:
    course = {"rates_dps": (30.0, 60.0), "both_directions": True}
    recordings, _ = simulate_unit(UnitDescription("U", course=course, effects=dict.fromkeys(hidden.split())), 8, 0)
    return tuple(recordings)


def held_out(sensor: str, change: np.ndarray, configured: tuple[str, ...] = (), hidden: str = "") -> tuple[Any, Any]:
    """Return validation and fit of a unit whose readings are multiplied by 1 + ``change`` in held-out motion alone."""
    recordings = [
        replace(r, **{sensor: r.reading(sensor) @ (np.eye(3) + change).T}) if r.role == "validation" else r
        for r in unit(hidden)
    ]
    settings = settings_of(SETTINGS, effects={sensor: list(configured)})
    noise = estimate_noise(sensor, recordings, settings.sensor.of(sensor))
    found = reference_least_squares.fit(StageInput(sensor, with_noise(recordings, settings), None, settings))
    found = effects.fit(StageInput(sensor, with_noise(recordings, settings), found, settings)) if configured else found
    return validate(found, recordings, noise, settings), (found, recordings, noise, settings)


@pytest.mark.parametrize("sensor", ["accelerometer", "gyroscope"])
def test_held_out_motion_of_the_same_unit_agrees(sensor: str) -> None:
    part, _ = held_out(sensor, np.zeros((3, 3)))
    assert part.agreement.p_value > 1e-3


@pytest.mark.parametrize(
    ("change", "size"), [(6e-4 * np.diag([0.0, 1.0, 0.0]), 6e-4), (TURN, 5e-4)], ids=["scale of y", "turned about z"]
)
def test_a_matrix_that_changed_between_fit_and_held_out_motion_is_doubted(change: np.ndarray, size: float) -> None:
    part, (found, recordings, noise, settings) = held_out("gyroscope", change)
    low, high = part.expected_rms_error
    assert low < part.steps[-1].rms_error < high  # the size of the error does not show it
    told = part.agreement
    assert told.p_value < DISAGREES
    assert abs(told.error) == pytest.approx(size, abs=2.0 * told.expanded_uncertainty)
    assert change["xyz".index(told.reads), "xyz".index(told.of)] == pytest.approx(
        told.error, abs=2.0 * told.expanded_uncertainty
    )
    said = diagnose(found, recordings, noise, settings, None, validation=part)
    assert said["verdict"] == "reference_in_doubt"
    assert f"the calibrated {told.reads} reads" in said["reason"]
    assert diagnose(found, recordings, noise, settings, None, validation=replace(part, agreement=None))["verdict"] == (
        "nothing_missing"
    )


def test_held_out_motion_that_does_not_move_says_nothing_of_the_matrix() -> None:
    recordings = [r for r in unit() if r.role != "validation"]
    still = next(r for r in recordings if r.role == "static")
    attitude = np.tile([1.0, 0.0, 0.0, 0.0], (still.samples, 1))
    held = replace(still, name="validation", role="validation", table_attitude=attitude, table_rate=attitude[:, 1])
    noise = estimate_noise("gyroscope", recordings, SETTINGS.sensor.gyroscope)
    found = reference_least_squares.fit(StageInput("gyroscope", with_noise(recordings, SETTINGS), None, SETTINGS))
    assert validate(found, [*recordings, held], noise, SETTINGS).agreement is None


def test_effects_of_the_calibration_are_no_disagreement() -> None:
    hidden = ("gyroscope.g_sensitivity", "g_sensitivity")
    part, (found, *_) = held_out("gyroscope", np.zeros((3, 3)), hidden[1:], hidden[0])
    assert isinstance(found, SensorCalibration)
    assert [e.name for e in found.effects] == ["g_sensitivity"]
    assert part.agreement.p_value > 1e-3
