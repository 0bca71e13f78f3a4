"""Layouts of public logs, with numbers of our own: what each file of ``imu_logs/README.md`` showed."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

import imu_logs
from imu_logs.columns import find_columns, find_layout

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from imu_logs.proposal import Proposal

ROWS = 200
RNG = np.random.default_rng(1)
TIME = 0.01 * np.arange(ROWS)
TILT = 0.5 * np.sin(3.0 * TIME)
FORCE = np.column_stack([np.sin(TILT), 0.01 * RNG.normal(size=ROWS), np.cos(TILT)])  # g
RATE = np.column_stack([0.1 * RNG.normal(size=ROWS), 1.5 * np.cos(3.0 * TIME), 0.1 * RNG.normal(size=ROWS)])  # rad/s


def proposed(file: Path, content: str | bytes) -> Proposal:
    file.write_bytes(content.encode() if isinstance(content, str) else content)
    (proposal,) = imu_logs.propose(file)
    return proposal


def rows(*columns: np.ndarray | Sequence[Any], separator: str = ",", end: str = "\n") -> str:
    table = np.column_stack([np.asarray(c, dtype=object) for c in columns])
    return "".join(separator.join(f"{v:.10g}" if isinstance(v, float) else str(v) for v in row) + end for row in table)


def assert_reads(file: Path, proposal: Proposal, rate_hz: float | None = None) -> None:
    """Check that the proposal, with the rate that it leaves open, reads the file to the force and rates of the log."""
    if rate_hz is not None:
        assert "rate_hz" in proposal.unknown()
        proposal.csv["rate_hz"] = rate_hz
    assert proposal.complete, (proposal.unknown(), proposal.evidence)
    log = imu_logs.read(file, proposal.profile("mine"))
    for i, channel in enumerate(("accel_x", "accel_y", "accel_z")):
        np.testing.assert_allclose(log.values[channel], FORCE[: len(log.time_ns), i], atol=1e-6)
    assert log.time_ns[-1] - log.time_ns[0] == pytest.approx((len(log.time_ns) - 1) * 1e7)


def test_lines_of_blanks_between_rows_are_no_rows(tmp_path: Path) -> None:
    text = "\n" + rows(TIME, FORCE, separator=", ", end=" \n  \n")
    assert_reads(tmp_path / "log.csv", proposed(tmp_path / "log.csv", text))


def test_rows_of_units_and_of_sensors_below_the_names(tmp_path: Path) -> None:
    """As APDM and Shimmer export: the units are a row of their own, and a profile names the columns by index."""
    names = ",".join(f"Up/{what}/{axis}" for what in ("Acceleration", "Gyro") for axis in "XYZ")
    head = f"Test Name:,Pendulum,,,,,\nTime,{names}\n"
    text = f"{head}s,m/s^2,m/s^2,m/s^2,rad/s,rad/s,rad/s\n{rows(TIME, 9.80665 * FORCE, RATE)}"
    proposal = proposed(tmp_path / "log.csv", text)
    assert [proposal.columns[0][c]["column"] for c in ("time", "accel_z", "gyro_x")] == [0, 3, 4]
    assert_reads(tmp_path / "log.csv", proposal)


def test_two_sensors_in_rows_of_names(tmp_path: Path) -> None:
    """As pandas writes columns of several levels."""
    head = "sensor,left,right,left,right,left,right\naxis,acc_x,acc_x,acc_y,acc_y,acc_z,acc_z\n"
    others = 0.5 * FORCE
    pairs = np.column_stack([FORCE[:, 0], others[:, 0], FORCE[:, 1], others[:, 1], FORCE[:, 2], others[:, 2]])
    proposal = proposed(tmp_path / "log.csv", head + rows(np.arange(ROWS), pairs))
    assert [proposal.columns[0][f"accel_{a}"]["column"] for a in "xyz"] == [1, 3, 5]
    assert any("the others are right acc_x, right acc_y, right acc_z" in remark for remark in proposal.remarks)


def test_an_index_without_a_name_is_a_column_by_index(tmp_path: Path) -> None:
    proposal = proposed(tmp_path / "log.csv", f",ax,ay,az\n{rows(np.arange(ROWS), FORCE)}")
    proposal.columns[0]["time"]["counts_per_unit"] = 100.0
    assert_reads(tmp_path / "log.csv", proposal)


def test_a_byte_order_mark_is_no_part_of_a_name(tmp_path: Path) -> None:
    text = f"ax,ay,az,label\n{rows(FORCE, np.zeros(ROWS, int))}"
    assert_reads(tmp_path / "log.csv", proposed(tmp_path / "log.csv", b"\xef\xbb\xbf" + text.encode()), rate_hz=100.0)


def test_the_export_of_empatica_starts_with_time_and_rate(tmp_path: Path) -> None:
    start = "1642471872.000000, 1642471872.000000, 1642471872.000000\n32.000000, 32.000000, 32.000000\n"
    proposal = proposed(tmp_path / "ACC.csv", start + rows(np.rint(64.0 * FORCE).astype(int)))
    assert (proposal.csv["rate_hz"], proposal.csv["skip_lines"]) == (32.0, 2)


@pytest.mark.parametrize("repeat", [1, 2])
def test_a_time_without_name_that_repeats_is_no_reading(tmp_path: Path, repeat: int) -> None:
    stamps = 1_586_082_999_157 + 10 * (np.arange(ROWS) // repeat * repeat)
    proposal = proposed(tmp_path / "acc.csv", rows(stamps, FORCE))
    assert proposal.columns[0]["time"] == {"column": 0, "unit": "ms"}
    assert [proposal.columns[0][f"accel_{a}"]["column"] for a in "xyz"] == [1, 2, 3]


def test_a_reading_that_rises_is_no_time_of_arrival() -> None:
    slow = np.column_stack([-1.98 + 1e-5 * np.arange(ROWS) ** 1.5, -1.1 - 1e-6 * np.arange(ROWS), np.full(ROWS, 9.6)])
    slow[:, 2] += 0.01 * RNG.normal(size=ROWS)
    columns = find_columns(find_layout(rows(np.arange(ROWS), 1e-3 * RATE, slow).encode(), "imu.txt"))
    assert (columns.counter, columns.arrival, columns.triads["accelerometer"]) == (0, None, (4, 5, 6))


def test_angles_without_names_are_no_rates_in_degrees(tmp_path: Path) -> None:
    """A file of a heading, a pitch and a roll: no name says that they are rates."""
    angles = np.column_stack([180.0 * np.sin(TIME), 40.0 * TILT, 30.0 * TILT])
    for columns in (angles, np.column_stack([angles, 9.8 * FORCE])):
        assert proposed(tmp_path / "imu.csv", rows(columns)).columns[0]["gyro_x"]["unit"] == "???"


def test_a_pressure_is_no_force_in_mg(tmp_path: Path) -> None:
    readings = np.column_stack([967.5372 + 1e-4 * RNG.normal(size=ROWS), 0.1 * RATE[:, :2], RATE])
    assert proposed(tmp_path / "log.csv", rows(readings)).columns[0]["accel_x"]["unit"] == "???"


def test_columns_without_names_and_without_gravity_are_left_open(tmp_path: Path) -> None:
    proposal = proposed(tmp_path / "log.csv", rows(RNG.integers(-9000, 9000, (ROWS, 9))))
    assert proposal.columns[0]["accel_x"]["column"] == "???"


def test_forces_in_g_are_no_rates() -> None:
    columns = find_columns(find_layout(f"xg,yg,zg\n{rows(FORCE)}".encode(), "log.csv"))
    assert set(columns.triads) == {"accelerometer"}
    columns = find_columns(find_layout(f"xg,yg,zg\n{rows(RATE)}".encode(), "log.csv"))
    assert set(columns.triads) == {"gyroscope"}


@pytest.mark.parametrize(
    ("times", "unit"),
    [
        (1_543_621_842 + np.arange(ROWS) // 60, "s"),  # many rows share a second
        (1_600_000_000_000_000_000 + 258_999_000 * np.arange(ROWS), "ns"),  # 3.9 Hz
        (1_279_034_942 + 2 * np.arange(ROWS), "ms"),  # since power-on: 500 Hz, and no date
    ],
)
def test_units_of_times_since_1970_and_of_slow_logs(tmp_path: Path, times: np.ndarray, unit: str) -> None:
    proposal = proposed(tmp_path / "log.csv", f"timestamp,ax,ay,az\n{rows(times, FORCE)}")
    assert proposal.columns[0]["time"]["unit"] == unit


def test_millimetres_per_second_squared(tmp_path: Path) -> None:
    """As Klipper logs the accelerometer of a printer."""
    proposal = proposed(tmp_path / "log.csv", f"#time,accel_x,accel_y,accel_z\n{rows(TIME, 9806.65 * FORCE)}")
    assert proposal.columns[0]["accel_x"]["unit"] == "mm/s^2"
    assert_reads(tmp_path / "log.csv", proposal)


def test_a_name_in_whole_mg_is_not_doubted(tmp_path: Path) -> None:
    text = f"t [s],ax [mg],ay [mg],az [mg]\n{rows(TIME, np.rint(1000.0 * FORCE).astype(int))}"
    assert not any("and yet" in remark for remark in proposed(tmp_path / "log.csv", text).remarks)
    text = f"t [s],ax [mg],ay [mg],az [mg]\n{rows(TIME, np.rint(9.8 * FORCE) + 0.25)}"
    assert any("and yet" in remark for remark in proposed(tmp_path / "log.csv", text).remarks)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("log.bin", b"$VNYMR,+170.786,-005.153,+009.880,-00.1957,+00.2218,+00.6401*68\r\n" * 20, "VectorNav"),
        ("log.BIN", b"\x02@\x10\x08@" + bytes(range(200)), "no DataFlash log"),
        ("log.dat", bytes(range(1, 250)) * 700 + bytes(5000), "a binary file of a kind that is not known"),
        ("log.npy", b"", "Python objects"),
        ("log.cwa", b"MD\xfc\x03" + bytes(range(200)), "Axivity"),
        ("log.bin", b"Device Identity\r\nDevice Type:GENEActiv\r\n" * 9, "GENEActiv"),
        ("log.txt", b'{"sensor": "accelerometer", "x": "-0.85"}\n' * 9, "JSON"),
        ("log.mcap", b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n", "git lfs pull"),
    ],
)
def test_other_kinds_are_named(tmp_path: Path, name: str, content: bytes, words: str) -> None:
    file = tmp_path / name
    if content:
        file.write_bytes(content)
    else:
        np.save(file, np.array([{"ax": 1.0}], object), allow_pickle=True)
    for use in (imu_logs.read, imu_logs.propose):
        with pytest.raises(imu_logs.IngestError, match=words):
            use(file)


def test_times_in_ms_of_an_old_dataflash_log(tmp_path: Path) -> None:
    """As ArduPilot wrote until 2015: TimeMS instead of TimeUS."""
    head = b"\xa3\x95"

    def described(kind: int, length: int, name: bytes, fields: bytes, columns: bytes) -> bytes:
        return head + struct.pack("<BBB4s16s64s", 128, kind, length, name, fields, columns)

    messages = [described(128, 89, b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns")]
    messages.append(described(131, 31, b"IMU", b"Iffffff", b"TimeMS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"))
    values = np.column_stack([RATE, 9.80665 * FORCE])
    messages += [head + struct.pack("<BIffffff", 131, 10 * i, *row) for i, row in enumerate(values)]
    proposal = proposed(tmp_path / "log.bin", b"".join(messages))
    for axis in "xyz":
        proposal.columns[0][f"gyro_{axis}"]["unit"] = "rad/s"
    assert proposal.columns[0]["time"] == {"column": "TimeMS", "unit": "ms"}
    assert_reads(tmp_path / "log.bin", proposal)


def test_names_above_rows_with_empty_cells(tmp_path: Path) -> None:
    """As loggers write that give each message a row of one table."""
    readings = "".join(f"{i},,,,\n" + 2 * f"{i},{x:.4f},{y:.4f},{z:.4f},\n" for i, (x, y, z) in enumerate(FORCE))
    proposal = proposed(tmp_path / "log.csv", f"Index,Accel X,Accel Y,Accel Z,Baro\n0,,,,\n{readings}")
    assert any("Accel X, Accel Y, Accel Z hold no number in some rows" in remark for remark in proposal.remarks)


def test_times_of_day_tell_the_mean_rate(tmp_path: Path) -> None:
    """As WitMotion exports: the rate stays open, with what decides it."""
    clock = [f"08:58:{6 + t:09.6f}" for t in TIME]
    proposal = proposed(tmp_path / "log.txt", f"Time(s)\tax(g)\tay(g)\taz(g)\n{rows(clock, FORCE, separator=chr(9))}")
    assert "100 Hz on average" in proposal.evidence["rate_hz"]
    assert_reads(tmp_path / "log.txt", proposal, rate_hz=100.0)


def test_gravity_and_user_acceleration_are_to_be_added(tmp_path: Path) -> None:
    names = ",".join(f"{what}.{a}" for what in ("gravity", "userAcceleration", "rotationRate") for a in "xyz")
    proposal = proposed(tmp_path / "log.csv", f"t_ms,{names}\n{rows(1000.0 * TIME, FORCE, 0.01 * RATE, RATE)}")
    assert "gyro_x" in proposal.columns[0]
    assert any("sum of gravity and user acceleration" in remark for remark in proposal.remarks)


@pytest.mark.parametrize("order", [1, -1])
def test_files_of_one_layout_hold_several_sensors(tmp_path: Path, order: int) -> None:
    """As Sensor Logger exports: a gyroscope belongs to the file with gravity, never to the columns of another file."""
    linear = 9.80665 * (FORCE - [0.0, 0.0, 1.0])
    contents = {"Accelerometer": linear, "Gyroscope": RATE, "TotalAcceleration": 9.80665 * FORCE}
    for name, values in contents.items():
        (tmp_path / f"{name}.csv").write_text(f"time,seconds_elapsed,z,y,x\n{rows(TIME, TIME, values[:, ::-1])}")
    paths = [tmp_path / f"{name}.csv" for name in [*contents][::order]]
    pair, other = imu_logs.propose(paths)
    assert sorted(pair.parts) == ["Gyroscope.csv", "TotalAcceleration.csv"]
    assert any("without gravity" in remark for remark in other.remarks)
    assert other.columns[0]["accel_x"]["unit"] == "???"


def test_units_in_words(tmp_path: Path) -> None:
    names = "timestamp,ax (in G's),ay (in G's),az (in G's)" + "".join(f",g{a} (in radians/s)" for a in "xyz")
    assert_reads(tmp_path / "log.csv", proposed(tmp_path / "log.csv", f"{names}\n{rows(TIME, FORCE, RATE)}"))


def test_a_time_that_may_be_a_date_is_left_open(tmp_path: Path) -> None:
    batches = 1_723_696_180_000 + 380 * (np.arange(ROWS) // 2)
    proposal = proposed(tmp_path / "accelerometer.csv", rows(batches, 9.8 * FORCE))
    assert proposal.columns[0]["time"]["unit"] == "???"
    assert "ms since 1970" in proposal.evidence["time"]


@pytest.mark.parametrize("suffix", [".bag", ".bin", ".h5"])
def test_a_text_with_the_suffix_of_another_format_is_a_text(tmp_path: Path, suffix: str) -> None:
    file = tmp_path / f"imu_data{suffix}"
    assert_reads(file, proposed(file, rows(TIME, FORCE, separator=" ")))
