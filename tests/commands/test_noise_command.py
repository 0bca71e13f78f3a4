"""The noise of one log at rest, from the command line."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
import pytest
import yaml

from pipeline.app.commands.noise import main
from pipeline.core.errors import ConfigurationError

if TYPE_CHECKING:
    from pathlib import Path

RATE, SAMPLES = 20.0, 12_000


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """Return a log of a gyroscope alone: N = 0.01 deg/s/sqrt(Hz), and a walk about z of 0.003 deg/s/sqrt(s)."""
    rng, file = np.random.default_rng(1), tmp_path / "night.csv"
    values = 0.01 * np.sqrt(RATE) * rng.standard_normal((SAMPLES, 3)) + [0.1, -0.2, 0.3]
    values[:, 2] += np.cumsum(0.003 / np.sqrt(RATE) * rng.standard_normal(SAMPLES))
    table = np.column_stack([np.arange(SAMPLES) / RATE, values])
    np.savetxt(file, table, "%.6f", ",", header="time_s,gyro_x_dps,gyro_y_dps,gyro_z_dps", comments="")
    return file


def test_terms_are_printed_and_written(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(log), "-o", str(tmp_path / "noise.json")]) == 0
    told = capsys.readouterr().out
    assert "accelerometer\n  Not identified: the recordings hold no readings of the accelerometer." in told
    assert "gyroscope: 12000 samples, 600 s without a gap" in told
    axes = json.loads((tmp_path / "noise.json").read_text())["gyroscope"]["axes"]
    low, high = axes["x"]["terms"]["white"]["interval"]
    assert low < 0.01 < high
    low, high = axes["z"]["terms"]["random_walk"]["interval"]
    assert low < 0.003 < high
    (line,) = (line for line in told.splitlines() if line.startswith("  white N"))
    assert f"({axes['x']['terms']['white']['interval'][0]:.5f} to " in line


def test_axes_that_never_change_keep_their_columns(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = np.loadtxt(log, delimiter=",", skiprows=1)
    table[:, 1:3] = 0.1, -0.2
    np.savetxt(log, table, "%.6f", ",", header="time_s,gyro_x_dps,gyro_y_dps,gyro_z_dps", comments="")
    assert main([str(log)]) == 0
    told = capsys.readouterr().out
    (white,) = (line.split() for line in told.splitlines() if line.startswith("  white N"))
    assert white[2:4] == ["\N{EN DASH}"] * 2
    assert float(white[4]) == pytest.approx(0.01, rel=0.02)
    assert "x, y: not identified: the readings do not change" in told


def test_a_file_for_kalibr_needs_what_the_log_does_not_hold(log: Path, tmp_path: Path) -> None:
    target = tmp_path / "kalibr_imu.yaml"
    with pytest.raises(ConfigurationError, match="no noise of the accelerometer: state --sensor"):
        main([str(log), "-o", str(target)])
    assert not target.exists()
    assert main([str(log), "--sensor", "mpu6050", "-o", str(target)]) == 0
    imu = yaml.safe_load(target.read_text())
    assert imu["gyroscope_noise_density"] == pytest.approx(np.radians(0.01), rel=0.02)
    assert imu["accelerometer_noise_density"] == pytest.approx(4e-4 / np.sqrt(2.0) * 9.80665)
    assert imu["update_rate"] == RATE
    with pytest.raises(ConfigurationError, match=r"x.txt, which is no format of noise; expected kalibr_imu.yaml"):
        main([str(log), "-o", str(tmp_path / "x.txt")])


def test_a_file_for_kalibr_needs_the_sensor_where_no_axis_changes(log: Path, tmp_path: Path) -> None:
    table = np.loadtxt(log, delimiter=",", skiprows=1)
    table[:, 1:] = 0.1, -0.2, 0.3
    table = np.column_stack([table, 0.001 * np.random.default_rng(2).standard_normal((SAMPLES, 3)) + [0.0, 0.0, 1.0]])
    names = "time_s,gyro_x_dps,gyro_y_dps,gyro_z_dps,accel_x_g,accel_y_g,accel_z_g"
    np.savetxt(log, table, "%.6f", ",", header=names, comments="")
    with pytest.raises(ConfigurationError, match="no noise of the gyroscope: state --sensor"):
        main([str(log), "-o", str(tmp_path / "kalibr_imu.yaml")])
