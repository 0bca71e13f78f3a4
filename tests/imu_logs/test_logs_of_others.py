"""Units, headers, separators, bad rows and names in logs of others."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

import imu_logs
from imu_logs.columns import find_columns, find_layout

if TYPE_CHECKING:
    from pathlib import Path

ROWS = 300
MOTION = np.column_stack([
    0.01 * np.arange(ROWS), np.zeros(ROWS), np.zeros(ROWS), np.ones(ROWS),
    np.sin(0.1 * np.arange(ROWS)), np.cos(0.1 * np.arange(ROWS)), 0.5 * np.ones(ROWS),
])  # fmt: skip


def written(folder: Path, header: str, scale: tuple[float, ...] = (1, 1, 1, 1, 1, 1, 1), end: str = "") -> Path:
    file = folder / "log.csv"
    rows = "\n".join(",".join(f"{v:.9g}" for v in row) + end for row in MOTION * scale)
    file.write_text(f"{header}\n{rows}\n", encoding="utf-8")
    return file


def proposed(file: Path) -> imu_logs.proposal.Proposal:
    (proposal,) = imu_logs.propose(file)
    return proposal


def assert_reads_back(file: Path) -> None:
    proposal = proposed(file)
    assert proposal.complete, proposal.unknown()
    log = imu_logs.read(file, proposal.profile("mine"))
    for column, channel in enumerate(("accel_x", "accel_y", "accel_z", "gyro_x", "gyro_y", "gyro_z"), 1):
        np.testing.assert_allclose(log.values[channel], MOTION[: len(log.time_ns), column], atol=1e-6)


@pytest.mark.parametrize("unit", ["mdps", "mdeg/s"])
def test_thousandths_are_units(tmp_path: Path, unit: str) -> None:
    header = "t [s],A_X [ug],A_Y [ug],A_Z [ug]," + ",".join(f"G_{a} [{unit}]" for a in "XYZ")
    file = written(tmp_path, header, (1, 1e6, 1e6, 1e6, 1000, 1000, 1000))
    assert proposed(file).columns[0]["gyro_x"]["unit"] == "mdps"
    assert_reads_back(file)


def test_counts_are_stated_by_their_name(tmp_path: Path) -> None:
    file = written(
        tmp_path, "t [s],ax [LSB],ay [LSB],az [LSB],gx [LSB],gy [LSB],gz [LSB]", (1, 2000, 2000, 2048, 0, 0, 0)
    )
    assert proposed(file).columns[0]["accel_x"]["unit"] == "counts"


def test_the_unit_of_one_axis_is_that_of_all(tmp_path: Path) -> None:
    file = written(tmp_path, "t (s),ax(m/s2),ay,az,wx(rad/s),wy,wz", (1, *[9.80665] * 3, *[np.pi / 180] * 3))
    assert_reads_back(file)


def test_a_counter_of_packets_is_no_clock(tmp_path: Path) -> None:
    header = "Packet number,ax [g],ay [g],az [g],gx [deg/s],gy [deg/s],gz [deg/s]"
    file = written(tmp_path, header)
    lines = file.read_text().splitlines()
    numbered = [f"{int(i * 1.3)},{line.partition(',')[2]}" for i, line in enumerate(lines[1:])]  # packets are lost
    file.write_text("\n".join([lines[0], *numbered]) + "\n")
    time = proposed(file).columns[0]["time"]
    assert (time["unit"], time["counts_per_unit"]) == ("counts", "???")


NAMES = "t [s],ax [g],ay [g],az [g],gx [deg/s],gy [deg/s],gz [deg/s]"


@pytest.mark.parametrize(
    ("header", "end"),
    [
        (f"% {NAMES}", ""), (f"// {NAMES}", ""), (f"//{NAMES}", ""), (NAMES, ","), (f"{NAMES},", ""), (f"{NAMES},", ","),
    ],
)  # fmt: skip
def test_headers_behind_marks_and_separators_at_the_ends_of_lines(tmp_path: Path, header: str, end: str) -> None:
    assert_reads_back(written(tmp_path, header, end=end))


def test_a_transform_and_a_quaternion_are_no_sensor() -> None:
    names = (
        ",".join(f"transforms[0].transform.rotation.{a}" for a in "xyzw") + ",orientation.x,orientation.y,orientation.z"
    )
    text = names + "\n" + "\n".join("0.1,0.2,0.3,0.9,0.1,0.2,0.3" for _ in range(10))
    assert find_columns(find_layout(text.encode(), "log.csv")).triads == {}


def test_names_of_body_rates(tmp_path: Path) -> None:
    file = written(tmp_path, "t [s],ax [g],ay [g],az [g],p [deg/s],q [deg/s],r [deg/s]")
    assert_reads_back(file)


@pytest.mark.parametrize(
    ("row", "setting"),
    [
        ("9.99,0,0,oops,0,0,0", ("bad_rows", "drop")),
        ("9.99,0,0,NaN,0,0,0", ("nan", "gap")),
        ("9.99,0,0,,0,0,0", ("nan", "gap")),
    ],
)
def test_few_bad_rows_are_named_and_left_out(tmp_path: Path, row: str, setting: tuple[str, str]) -> None:
    file = written(tmp_path, NAMES)
    lines = file.read_text().splitlines()
    lines[200] = row
    file.write_text("\n".join(lines * 1) + "\n")
    proposal = proposed(file)
    assert proposal.csv[setting[0]] == setting[1]
    assert "1 of 300 rows" in proposal.evidence[setting[0]]
    profile = proposal.profile("mine").model_copy(update={"checks": {"repaired_rows": 0.01}})
    log = imu_logs.read(file, profile)
    assert len(log.time_ns) == ROWS - 1
    assert {"N-BADROW", "N-NAN"} & {n.code for n in log.notes}


def test_acceleration_without_gravity_is_named(tmp_path: Path) -> None:
    file = written(
        tmp_path, "time (s),ax (m/s^2),ay (m/s^2),az (m/s^2),gx (rad/s),gy (rad/s),gz (rad/s)", (1, 1, 1, 0.05, 1, 1, 1)
    )
    assert any("without gravity" in remark for remark in proposed(file).remarks)


def test_free_acceleration_is_no_accelerometer() -> None:
    header = "PacketCounter,FreeAcc_X,FreeAcc_Y,FreeAcc_Z,Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z"
    text = header + "\n" + "\n".join(f"{i},0,0,0,0.1,0.2,9.8,1,2,3" for i in range(20))
    assert find_columns(find_layout(text.encode(), "log.csv")).triads == {
        "accelerometer": (4, 5, 6),
        "gyroscope": (7, 8, 9),
    }
