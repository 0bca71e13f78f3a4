"""Which axis the table turned about, at rates that the gyroscope's bias reaches."""

import numpy as np
import pytest

from pipeline.formats.channel_table import ChannelTable
from pipeline.formats.ingest_error import IngestError
from pipeline.formats.plausibility import check_axis

BIAS = (-1.292, -1.973, -0.348)  # deg/s, MPU6050 (2) of Sudsanguan 2019, table 5.16


def slow_turn(rate_dps: float) -> ChannelTable:
    """A turn about y with 3 s of rest before and after it."""
    rng = np.random.default_rng(7)
    rests = np.zeros(25)
    rate = np.concatenate([rests, np.full(round(360.0 / rate_dps / 0.12), rate_dps), rests])
    matrix = np.linalg.solve([[0.997, -0.004, 0.024], [0.004, 0.994, 0.003], [0.003, -0.009, 1.007]], np.eye(3))
    reading = BIAS + np.outer(rate, matrix[:, 1]) + 0.01 * rng.standard_normal((len(rate), 3))
    values = {f"gyro_{a}": reading[:, i] for i, a in enumerate("xyz")} | {"table_rate": rate}
    return ChannelTable("accel_y.csv", np.arange(len(rate)) * 120_000_000, values, {}, lambda row: row + 2)


@pytest.mark.parametrize("rate_dps", [0.5, 1.0, 2.0, 5.0])
def test_a_slow_turn_is_taken_although_the_bias_is_as_large_as_its_rate(rate_dps: float) -> None:
    check_axis(slow_turn(rate_dps), "y")


@pytest.mark.parametrize("rate_dps", [2.0, 5.0])
def test_a_slow_turn_about_another_axis_is_refused(rate_dps: float) -> None:
    with pytest.raises(IngestError, match="said to turn about z, and y turns with it"):
        check_axis(slow_turn(rate_dps), "z")
