from __future__ import annotations

import numpy as np
import pytest
from unit_settings import settings_of

from pipeline.app.steps.calibration import frame_uncertainty
from pipeline.core.records import Coefficient, FittedEffect, Recording, SensorCalibration
from pipeline.physics.kinematics import turn_by_vector
from pipeline.physics.statements import OF_FRAME, beyond_uncertainty, frame_words

NORMAL = 1.959964


def turn(axis: str, setup: str = "") -> Recording:
    return Recording(f"accel_{axis}", "accelerometer", axis, np.arange(10), np.zeros((10, 3)), setup=setup)


TURNS = [turn(axis) for axis in "xyz"]
ACCELEROMETER = SensorCalibration("accelerometer")


def on_table(**table: float) -> list[float] | None:
    settings = settings_of(**{f"table.{key}": value for key, value in table.items()})
    return frame_uncertainty(ACCELEROMETER, TURNS, settings)


def test_without_a_stated_seat_or_face_the_frame_is_unknown() -> None:
    assert on_table() is None
    assert on_table(levelling_deg=0.01) is None
    by_hand = settings_of(table="hand", procedure="multi_position")
    assert frame_uncertainty(ACCELEROMETER, [], by_hand) is None


def test_the_frame_on_a_table_is_that_of_the_mean_mounting() -> None:
    expected = NORMAL * np.hypot(0.6 / np.sqrt(3.0), 0.1)
    assert on_table(seat_deg=0.6, levelling_deg=0.1) == pytest.approx([expected] * 3)


def test_fitted_mountings_that_differ_by_more_than_is_stated_widen_the_frame() -> None:
    values = {f"m_{i}": Coefficient(v, "deg") for i, v in enumerate([3.0, 0.0, 0.1, 0.0, 0.0, 0.0, -3.0, 0, -0.1])}
    fitted = SensorCalibration("accelerometer", effects=(FittedEffect("mounting", values),))
    found = frame_uncertainty(fitted, TURNS, settings_of(**{"table.seat_deg": 1.0}))
    assert found == pytest.approx([NORMAL * 3.0 / np.sqrt(3.0), NORMAL / np.sqrt(3.0), NORMAL / np.sqrt(3.0)])


def test_the_frame_by_faces_is_that_of_the_rotation_which_they_show() -> None:
    settings = settings_of(table="hand", procedure="ferraris")
    s = settings.procedure.faces.accuracy_deg
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    # 4000 times the mean rotation of six directions, each off by s about both axes across it
    off = s * np.random.default_rng(3).standard_normal((4000, 6, 3))
    off -= np.einsum("nfi,fi->nf", off, axes)[..., None] * axes
    up = np.einsum("nfij,fj->nfi", turn_by_vector(np.radians(off)), axes)
    design = np.concatenate([np.stack([np.cross(e, a) for e in np.eye(3)], axis=1) for a in axes])
    rotations = np.degrees(np.linalg.lstsq(design, (up - axes).reshape(4000, -1).T, rcond=None)[0].T)
    found = frame_uncertainty(ACCELEROMETER, [], settings)
    assert found == pytest.approx(list(NORMAL * np.std(rotations, axis=0)), rel=0.05)


def test_an_unknown_frame_is_said_and_a_known_one_is_stated() -> None:
    assert [source for source, _ in beyond_uncertainty({"frame_deg": None})] == [OF_FRAME]
    assert beyond_uncertainty({"frame_deg": [0.5, 0.5, 0.5]}) == []
    assert beyond_uncertainty({}) == []  # of an older version
    assert "0.5, 0.5, 0.6 deg" in frame_words({"frame_deg": [0.5, 0.5, 0.6]})
