"""What the page says of a recording's motion, by what the table logs."""

import numpy as np
import pytest

from pipeline.core.records import Recording
from pipeline.output.pages.unit_page import recording_rows


@pytest.mark.parametrize(
    ("speed", "expected"), [(30.0, "continuous, 0 rests, up to 30.0 deg/s, by its angle"), (0.0, "at rest")]
)
def test_a_turn_whose_angle_alone_is_logged_is_told_by_its_angle(speed: float, expected: str) -> None:
    """An encoder of 0.01 deg at 100 Hz."""
    time = np.arange(1000)
    angle = np.round(speed * time / 100.0, 2)
    turn = Recording("gyro_x", "gyroscope", "x", time * 10_000_000, table_angle=angle)
    (row,) = recording_rows([turn], {"gyro_x": []})
    assert row["motion"] == expected
