"""Earth's rotation where one level shaft turns the unit about each body axis: it stays in the room, not in the body."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.core.records import Recording
from pipeline.physics.kinematics import EARTH_RATE_DPS, earth_rate, reference_motion

LATITUDE, AZIMUTH = 48.0, 80.0
UP = {"x": "z", "y": "z", "z": "x"}  # the body axis that points up at angle 0 (docs/mounting.md)


@pytest.mark.parametrize("sense", [1, -1])
@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_earth_turns_as_seen_from_a_body_on_a_shaft(axis: str, sense: int) -> None:
    time = np.arange(400) * 0.05
    angle = 40.0 * np.sin(0.8 * time)
    recording = Recording("turn", "gyroscope", axis, np.arange(400) * 50_000_000, table_angle=angle, sense=sense)
    earth = earth_rate(LATITUDE, AZIMUTH)
    with_earth = reference_motion(recording, earth=tuple(earth.tolist()), one_shaft=True)
    without = reference_motion(recording)
    assert with_earth is not None
    assert without is not None
    # In a room with x east, y north, z up: the shaft's positive end by its encoder points to the azimuth.
    north = np.radians(LATITUDE)
    earth_in_room = EARTH_RATE_DPS * np.array([0.0, np.cos(north), np.sin(north)])
    shaft = np.array([np.sin(np.radians(AZIMUTH)), np.cos(np.radians(AZIMUTH)), 0.0])
    body_axis = sense * shaft
    columns = {axis: body_axis, UP[axis]: np.array([0.0, 0.0, 1.0])}
    missing = next(name for name in "xyz" if name not in columns)
    following = {"x": ("y", "z"), "y": ("z", "x"), "z": ("x", "y")}[missing]
    columns[missing] = np.cross(columns[following[0]], columns[following[1]])
    home = np.column_stack([columns[name] for name in "xyz"])  # body to room at angle 0
    turned = Rotation.from_rotvec(np.radians(angle)[:, None] * body_axis).as_matrix() @ home
    expected = np.einsum("nji,j->ni", turned, earth_in_room)
    np.testing.assert_allclose(with_earth.angular_rate - without.angular_rate, expected, atol=1e-12)
