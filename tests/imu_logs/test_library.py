"""imu_logs alone: what a program that reads logs uses of it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from calls import imported_by

import imu_logs
from imu_logs.units import CANONICAL, CHANNELS

ROWS = 200


@pytest.fixture
def log() -> imu_logs.Log:
    """A log with every channel, of random numbers."""
    rng = np.random.default_rng(1)
    values = {c: rng.normal(size=ROWS) for c in CHANNELS}
    return imu_logs.Log("made", 10**9 + np.arange(ROWS) * 10_000_000, values, {"rows": ROWS})


def test_a_log_is_read_without_the_calibration(tmp_path: Path, log: imu_logs.Log) -> None:
    imu_logs.write(log, tmp_path / "a.csv")
    imu_logs.write(log, tmp_path / "a.mcap")
    code = (
        f"import imu_logs; [imu_logs.read(f'{tmp_path}/a.' + s).to_arrow() for s in ('csv', 'mcap')];"
        f"imu_logs.propose('{tmp_path}/a.csv')"
    )
    assert imported_by(code, "pipeline", "hydra", "omegaconf", "scipy", "snakemake") == []


@pytest.mark.parametrize("suffix", ["csv", "mcap"])
def test_what_is_written_is_read(tmp_path: Path, log: imu_logs.Log, suffix: str) -> None:
    imu_logs.write(log, tmp_path / f"a.{suffix}")
    found = imu_logs.read(tmp_path / f"a.{suffix}")
    np.testing.assert_array_equal(found.time_ns, log.time_ns)
    assert set(found.values) == set(log.values)
    tolerance = 0.0 if suffix == "csv" else 1e-15  # m/s^2 and rad/s, rounded to doubles
    for channel, values in log.values.items():
        np.testing.assert_allclose(found.values[channel], values, rtol=tolerance, atol=tolerance)


def test_frames_and_tables_state_their_units(tmp_path: Path, log: imu_logs.Log) -> None:
    frame, table = log.to_pandas(), log.to_arrow()
    assert list(frame) == ["time_s", *(CANONICAL[c] for c in CHANNELS)]
    assert frame.attrs["units"]["gyro_x_dps"] == "deg/s"
    assert table.schema.field("accel_x_g").metadata == {b"unit": b"g"}
    assert table.column("time_ns").to_pylist() == log.time_ns.tolist()
    imu_logs.write(log, tmp_path / "a.parquet")
    stored = pd.read_parquet(tmp_path / "a.parquet")
    np.testing.assert_array_equal(stored["gyro_z_dps"], log.values["gyro_z"])
    noted = imu_logs.read_frame(frame)
    np.testing.assert_array_equal(noted.values["table_qw"], log.values["table_qw"])
    assert json.loads(table.schema.metadata[b"source"]) == {"rows": ROWS}


def test_a_profile_extends_shipped_ones_and_refers_to_its_instance(tmp_path: Path) -> None:
    assert list(imu_logs.load_profile("px4_raw", instance=1).mcap["topics"]) == ["sensor_accel[1]", "sensor_gyro[1]"]
    profile = imu_logs.load_profile(
        {"defaults": ["canonical_csv", "_self_"], "name": "mine", "csv": {"delimiter": ";"}}
    )
    assert profile.csv["columns"]["accel_x"] == {"column": "accel_x_g", "unit": "g"}
    (tmp_path / "log.csv").write_text("time_s;accel_x_g;accel_y_g;accel_z_g\n0.0;0;0;1\n0.1;0;0;1\n")
    assert imu_logs.read(tmp_path / "log.csv", profile).values["accel_z"].tolist() == [1.0, 1.0]
    with pytest.raises(imu_logs.ConfigurationError, match=r"sensor\.accelerometer\.counts_per_unit"):
        imu_logs.load_profile("arduino_counts")
    with pytest.raises(imu_logs.ConfigurationError, match="shipped are ardu"):
        imu_logs.load_profile("nothing")


def test_a_proposal_reads_the_log_where_names_state_the_units(tmp_path: Path) -> None:
    rows = "\n".join(f"{0.01 * i:.2f},0.1,0.2,9.7,1,2,3" for i in range(50))
    file = tmp_path / "phone.csv"
    file.write_text(f"t [s],ax [m/s^2],ay [m/s^2],az [m/s^2],gx [deg/s],gy [deg/s],gz [deg/s]\n{rows}\n")
    (proposal,) = imu_logs.propose(file)
    assert proposal.complete
    found = imu_logs.read(file, proposal.profile("phone"))
    np.testing.assert_allclose(found.values["accel_z"], 9.7 / 9.80665)
    assert "name: phone" in proposal.text("phone")
    file.write_text("t [s],ax,ay,az,gx,gy,gz\n" + rows + "\n")
    assert imu_logs.propose(file)[0].unknown() == ["gyro_x", "gyro_y", "gyro_z"]


def test_a_log_that_does_not_exist_is_refused(tmp_path: Path) -> None:
    with pytest.raises(imu_logs.IngestError, match="No such file"):
        imu_logs.read(tmp_path / "none.csv")


def test_the_library_stays_small() -> None:
    modules = {f.name: len(f.read_text().splitlines()) for f in Path(imu_logs.__file__).parent.glob("*.py")}
    assert len(modules) <= 21  # 20, and __init__.py
    assert [name for name, lines in modules.items() if lines > 600] == []
