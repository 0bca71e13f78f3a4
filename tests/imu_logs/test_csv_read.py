"""What a text log becomes, and that nothing is lost on the way."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from sample_logs import SENSOR, assert_same_bits, make_recording, procedure, profile
from unit_settings import ingest_of, sheet_of

from imu_logs.profile import csv_formats
from imu_logs.text_read import read_csv
from pipeline.core.errors import IngestError
from pipeline.core.records import Recording
from pipeline.ingest.arrow import write_recording
from pipeline.ingest.read import read_recordings

if TYPE_CHECKING:
    from pathlib import Path

HEADER = "time_s,accel_x_g,accel_y_g,accel_z_g,gyro_x_dps,gyro_y_dps,gyro_z_dps"


def read_back(folder: Path, ingest: dict[str, Any], name: str = "accel_x") -> Recording:
    return read_recordings(procedure(name), ingest_of(ingest), SENSOR, folder)[0]


def test_rows_that_are_counted_keep_the_rate_to_the_last(tmp_path: Path, canonical: dict[str, Any]) -> None:
    """An interval of 9.765625 us is no whole number of ns: rounded, it would lose 38 ppm."""
    canonical["csv"]["columns"]["time"] = None
    canonical["csv"]["rate_hz"] = 102_400.0
    write_recording(tmp_path / "accel_x.csv", make_recording(5000))
    read = read_back(tmp_path, canonical)
    assert read.time_ns.tolist() == [round(i * 10**9 / 102_400) for i in range(5000)]


def test_canonical_csv_comes_back_bit_for_bit(tmp_path: Path, canonical: dict[str, Any]) -> None:
    written = make_recording()
    write_recording(tmp_path / "accel_x.csv", written)
    assert_same_bits(read_back(tmp_path, canonical), written)


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)
@given(
    values=hnp.arrays(np.float64, (5, 6), elements=st.floats(-1.9, 1.9)),
    start=st.integers(0, 10**15),
    steps=st.lists(st.integers(1, 10**10), min_size=4, max_size=4),
)
def test_any_values_and_times_come_back_bit_for_bit(
    tmp_path: Path, canonical: dict[str, Any], values: np.ndarray, start: int, steps: list[int]
) -> None:
    force = values[:, :3]
    force[np.linalg.norm(force, axis=1) < 0.3] = [0.0, 0.0, 1.0]  # else refused as no log of gravity
    force[np.linalg.norm(force, axis=1) > 3.0] = [0.0, 0.0, 1.0]
    times = start + np.concatenate([[0], np.cumsum(steps)]).astype(np.int64)
    written = Recording("accel_x", "accelerometer", "x", times, accelerometer=force, gyroscope=values[:, 3:])
    canonical["checks"] = {"missing_time": 1.0}
    write_recording(tmp_path / "accel_x.csv", written)
    read = replace(read_back(tmp_path, canonical), flags=None)  # irregular steps are gaps
    assert_same_bits(read, written)


@pytest.mark.parametrize("digits", [0, 3, 7])
def test_fixed_decimals_are_the_nearest_decimals(tmp_path: Path, canonical: dict[str, Any], digits: int) -> None:
    written = make_recording()
    columns = dict.fromkeys(("gyro_x_dps", "gyro_y_dps", "gyro_z_dps"), digits)
    write_recording(tmp_path / "accel_x.csv", written, columns)
    read = read_back(tmp_path, canonical)
    assert read.gyroscope is not None
    assert written.gyroscope is not None
    nearest = [[float(f"{v:.{digits}f}") for v in row] for row in written.gyroscope.tolist()]
    np.testing.assert_array_equal(read.gyroscope, nearest)
    first = (tmp_path / "accel_x.csv").read_text().splitlines()[1].split(",")[4]
    assert len(first.partition(".")[2]) == digits


def test_channels_that_are_absent_leave_no_column(tmp_path: Path, canonical: dict[str, Any]) -> None:
    written = replace(make_recording(), temperature=None, table_angle=None, table_rate=None, table_attitude=None)
    write_recording(tmp_path / "accel_x.csv", written)
    assert (tmp_path / "accel_x.csv").read_text().splitlines()[0] == HEADER
    assert_same_bits(read_back(tmp_path, canonical), written)


@pytest.mark.parametrize(
    ("unit", "cells", "nanoseconds"),
    [
        (
            "s",
            ["1535632344.472815", "1535632344.482815001", "1535632344.5"],
            [1535632344472815000, 1535632344482815001, 0],
        ),
        (
            "ns",
            ["1700000000123456789", "1700000000123456790", "1700000000123456793"],
            [1700000000123456789, 1700000000123456790, 0],
        ),
        ("us", ["7", "8.001", "9"], [7000, 8001, 0]),
        ("ms", ["1.5e3", "1.6e3", "1.7e3"], [1500000000, 1600000000, 0]),
        ("s", ["2.9840000e-02", "3.9857000e-02", "0.05"], [29840000, 39857000, 0]),
        (
            "s",
            ["1700000000.0000000001", "1700000000.01", "1700000000.02"],
            [1700000000000000000, 1700000000010000000, 0],
        ),
        ("s", ["1.7e9", "1.7000001e9", "1.7000002e9"], [1700000000000000000, 1700000100000000000, 0]),
    ],
)
def test_times_are_exact_to_the_nanosecond(
    tmp_path: Path, canonical: dict[str, Any], unit: str, cells: list[str], nanoseconds: list[int]
) -> None:
    canonical["csv"]["columns"]["time"]["unit"] = unit
    file = tmp_path / "log.csv"
    file.write_text(HEADER + "\n" + "".join(f"{c},0,0,1,0,0,0\n" for c in cells))
    assert read_csv([file], csv_formats(ingest_of(canonical))).time_ns[:2].tolist() == nanoseconds[:2]


def test_a_counter_of_clock_ticks_is_a_time_and_is_counted_on_where_it_overflows(
    tmp_path: Path, canonical: dict[str, Any]
) -> None:
    """Ticks of 1/25600 s in 24 bits, as some sensors count them, start again at 0 every 10.9 minutes."""
    canonical["csv"]["columns"]["time"] |= {"unit": "counts", "counts_per_unit": 25600.0}
    ticks = [(2**24 - 512 + 256 * i) % 2**24 for i in range(5)]
    file = tmp_path / "log.csv"
    file.write_text(HEADER + "\n" + "".join(f"{t},0,0,1,0,0,0\n" for t in ticks))
    read = read_csv([file], csv_formats(ingest_of(canonical)))
    assert np.diff(read.time_ns).tolist() == [10_000_000] * 4
    assert [n.code for n in read.notes] == ["N-WRAP"]


def test_times_since_1970_count_from_the_first_sample(tmp_path: Path, canonical: dict[str, Any]) -> None:
    for name, start in (("a", 1_700_000_000), ("b", 1_700_000_100)):
        written = make_recording(start_ns=start * 10**9, seed=start, name=name)
        write_recording(tmp_path / f"{name}.csv", written)
    first, second = read_recordings(procedure("a", "b"), ingest_of(canonical), SENSOR, tmp_path)
    assert (first.time_ns[0], second.time_ns[0]) == (0, 100 * 10**9)
    assert [n.code for n in first.notes] == ["N-EPOCH"]
    assert first.clock_shared
    write_recording(tmp_path / "c.csv", make_recording(start_ns=2_000 * 10**9, seed=3, name="c"))
    *_, last = mixed = read_recordings(procedure("a", "b", "c"), ingest_of(canonical), SENSOR, tmp_path)
    assert [r.time_ns[0] for r in mixed] == [0, 100 * 10**9, 2_000 * 10**9]
    assert [len(r.notes) for r in mixed] == [1, 1, 0]
    assert not last.clock_shared  # 54 years lie between power-on and these files


def test_units_are_converted(tmp_path: Path, canonical: dict[str, Any]) -> None:
    columns = canonical["csv"]["columns"]
    columns["accel_x"]["unit"], columns["accel_y"]["unit"], columns["accel_z"]["unit"] = "mg", "m/s^2", "g"
    columns["gyro_x"]["unit"] = "rad/s"
    columns["table_angle"]["unit"] = "rad"
    (tmp_path / "accel_x.csv").write_text(
        HEADER + ",table_angle_deg\n0,1001.5,9.80665,0.5,3.141592653589793,1,2,6.283185307179586\n0.1,1,1,1,0,0,0,0\n"
    )
    read = read_back(tmp_path, canonical)
    assert read.accelerometer is not None
    assert read.gyroscope is not None
    assert read.table_angle is not None
    np.testing.assert_array_equal(read.accelerometer[0], [1.0015, 1.0, 0.5])
    np.testing.assert_array_equal(read.gyroscope[0], [180.0, 1.0, 2.0])
    assert read.table_angle[0] == 360.0


def test_columns_are_found_by_name_in_any_order_and_others_are_noted(tmp_path: Path, canonical: dict[str, Any]) -> None:
    (tmp_path / "accel_x.csv").write_text(
        '"gyro_z_dps", "gyro_y_dps","gyro_x_dps",comment,accel_z_g,accel_y_g,accel_x_g,time_s\n'
        "6,5,4,hello,1,0.2,0.1,0\n6,5,4,,1,0.2,0.1,0.01\n"
    )
    read = read_back(tmp_path, canonical)
    assert read.accelerometer is not None
    assert read.gyroscope is not None
    assert read.accelerometer[0].tolist() == [0.1, 0.2, 1.0]
    assert read.gyroscope[0].tolist() == [4.0, 5.0, 6.0]
    order = "gyro_z_dps, gyro_y_dps, gyro_x_dps, accel_z_g, accel_y_g, accel_x_g"
    assert [(n.code, n.count, n.detail) for n in read.notes] == [
        ("N-ORDER", 6, f"axes are in the order {order} and were assigned by their names"),
        ("N-IGNORED", 1, "columns not used: comment"),
    ]


@pytest.mark.parametrize(("name", "character"), [("semicolon", ";"), ("tab", "\t"), ("comma", ",")])
def test_a_delimiter_may_be_given_by_name(tmp_path: Path, canonical: dict[str, Any], name: str, character: str) -> None:
    write_recording(tmp_path / "accel_x.csv", make_recording())
    text = (tmp_path / "accel_x.csv").read_text()
    (tmp_path / "accel_x.csv").write_text(text.replace(",", character))
    canonical["csv"]["delimiter"] = name
    assert_same_bits(read_back(tmp_path, canonical), make_recording())


def test_axis_map_turns_readings_into_body_axes(tmp_path: Path) -> None:
    ingest = profile("mpu6050_multi_position")
    ingest["csv"]["skip_lines"] = 0
    (tmp_path / "accel_x.csv").write_text("ax,ay,az,gx,gy,gz\n1,2,16384,131,262,393\n1,2,16384,131,262,393\n")
    sensor = SENSOR.replaced(axis_map=["-y", "+x", "+z"])
    read = read_recordings(procedure("accel_x"), ingest_of(ingest), sensor, tmp_path)[0]
    assert read.accelerometer is not None
    assert read.gyroscope is not None
    assert read.accelerometer[0].tolist() == [2 / 16384, -1 / 16384, 1.0]
    np.testing.assert_allclose(read.gyroscope[0], [2.0, -1.0, 3.0], rtol=1e-15)


def test_a_sensor_may_have_an_axis_map_of_its_own(tmp_path: Path, canonical: dict[str, Any]) -> None:
    made = make_recording()
    write_recording(tmp_path / "accel_x.csv", made)
    sensor = SENSOR.replaced(accelerometer=SENSOR.accelerometer.replaced(axis_map=["+x", "+y", "-z"]))
    read = read_recordings(procedure("accel_x"), ingest_of(canonical), sensor, tmp_path)[0]
    np.testing.assert_allclose(read.accelerometer, made.accelerometer * [1.0, 1.0, -1.0], atol=1e-6)
    np.testing.assert_allclose(read.gyroscope, made.gyroscope, atol=1e-6)
    assert [n.detail for n in read.notes] == ["left-handed axis map: [+x, +y, -z] of the accelerometer"]


def test_left_handed_axis_map_is_noted(tmp_path: Path, canonical: dict[str, Any]) -> None:
    write_recording(tmp_path / "accel_x.csv", make_recording())
    sensor = SENSOR.replaced(axis_map=["+y", "+x", "+z"])
    read = read_recordings(procedure("accel_x"), ingest_of(canonical), sensor, tmp_path)[0]
    assert [n.code for n in read.notes] == ["N-LEFTHANDED"]


def test_gap_is_marked_and_measured(tmp_path: Path, canonical: dict[str, Any]) -> None:
    whole = make_recording(100)
    keep = np.ones(100, bool)
    keep[40:60] = False
    write_recording(tmp_path / "accel_x.csv", whole.select(keep))
    canonical["checks"] = {"missing_time": 0.25}
    read = read_back(tmp_path, canonical)
    assert read.flags is not None
    assert np.flatnonzero(read.flags).tolist() == [40]
    assert read.flags[40] == 1
    (note,) = read.notes
    assert (note.code, note.count, note.first, note.last) == ("N-GAP", 1, 42, 42)
    assert "the longest lasts 0.21 s, 20.202% of the time is missing" in note.detail


def test_clipped_readings_are_marked(tmp_path: Path, canonical: dict[str, Any]) -> None:
    recording = make_recording(50)
    assert recording.gyroscope is not None
    recording.gyroscope[[7, 8], 1] = [249.999, -250.0]
    write_recording(tmp_path / "accel_x.csv", recording)
    read = read_back(tmp_path, canonical)
    assert read.flags is not None
    assert np.flatnonzero(read.flags == 2).tolist() == [7, 8]
    assert [(n.code, n.count, n.first, n.last) for n in read.notes] == [("N-CLIP", 2, 9, 10)]


def test_readings_past_the_nominal_range_are_clipped_only_where_they_stay(
    tmp_path: Path, canonical: dict[str, Any]
) -> None:
    """A sensor of 250 deg/s that saturates at 290: a passing peak is none, a plateau is clipped."""
    recording = make_recording(50)
    assert recording.gyroscope is not None
    recording.gyroscope[10:14, 1] = [260.0, 270.0, 280.0, 265.0]
    recording.gyroscope[20:25, 2] = [-280.0, -290.0, -290.0, -290.0, -270.0]
    write_recording(tmp_path / "accel_x.csv", recording)
    read = read_back(tmp_path, canonical)
    assert read.flags is not None
    assert np.flatnonzero(read.flags == 2).tolist() == [21, 22, 23]


def test_files_that_overlap_in_time_share_no_clock(tmp_path: Path, canonical: dict[str, Any]) -> None:
    for index, start in enumerate((0, 2, 4)):
        written = make_recording(100, start_ns=start * 10**9, seed=index)
        write_recording(tmp_path / f"r{index}.csv", written)
    assert all(
        r.clock_shared for r in read_recordings(procedure("r0", "r1", "r2"), ingest_of(canonical), SENSOR, tmp_path)
    )
    write_recording(tmp_path / "r1.csv", make_recording(100, start_ns=10**9 // 2, seed=9))
    assert not any(
        r.clock_shared for r in read_recordings(procedure("r0", "r1", "r2"), ingest_of(canonical), SENSOR, tmp_path)
    )


def test_source_names_file_digest_and_rows(tmp_path: Path, canonical: dict[str, Any]) -> None:
    file = tmp_path / "accel_x.csv"
    file.write_text(HEADER + "\n0,0,0,1,0,0,0\n1,0,0,1,0,0,0\n")
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    assert read_back(tmp_path, canonical).source == {"file": str(file), "sha256": digest, "rows": 2}


def test_xsens_log_is_joined_from_its_two_files(reference: Path) -> None:
    sensor = SENSOR.replaced(accelerometer=sheet_of(full_scale=9.0), gyroscope=sheet_of(full_scale=450.0))
    wanted = procedure("recording", optional=("static", "validation"))
    (read,) = read_recordings(
        wanted, ingest_of(profile("xsens_mti_multi_position")), sensor, reference / "xsens_mti_multi_position"
    )
    assert read.accelerometer is not None
    assert read.gyroscope is not None
    assert read.samples == 51175
    assert read.time_ns[:3].tolist() == [29840000, 39857000, 49840000]
    assert int(read.time_ns[-1]) == 511718000000
    np.testing.assert_allclose(read.accelerometer[0], (np.array([33108, 33329, 36429]) - 32768) / 4070.0, rtol=1e-15)
    np.testing.assert_allclose(read.gyroscope[1], (np.array([32797, 32410, 32531]) - 32768) / 83.2, rtol=1e-15)
    # Means of the rows with time < 50 s, by awk from the text
    means = read.gyroscope[read.time_ns < 50 * 10**9].mean(axis=0) * 83.2 + 32768
    np.testing.assert_allclose(means, [32777.150460, 32459.816527, 32511.848940], rtol=0, atol=1e-6)
    assert [other["file"].rpartition("/")[2] for other in read.source["joined"]] == ["gyroscope.txt"]


def test_two_recordings_may_share_the_log_of_a_table_but_no_readings(tmp_path: Path, canonical: dict[str, Any]) -> None:
    columns = {"time": {"column": "t", "unit": "s"}}
    for of in "xyz":
        columns |= {
            f"accel_{of}": {"column": f"a{of}", "unit": "g"},
            f"gyro_{of}": {"column": f"g{of}", "unit": "deg/s"},
        }
    columns["table_angle"] = {"column": "angle", "unit": "deg"}
    parts = {"acc": ("accel_",), "gyr": ("gyro_",), "table": ("table",)}
    canonical["csv"] |= {
        "columns": {},
        "parts": [
            {
                "file": f"{{file}}_{name}.csv",
                "columns": {c: v for c, v in columns.items() if c.startswith(("time", *of))},
            }
            for name, of in parts.items()
        ],
    }
    for name in ("a", "b"):
        force, rate = make_recording(seed=ord(name)).accelerometer, make_recording(seed=ord(name)).gyroscope
        for file, values, names in (("acc", force, "ax,ay,az"), ("gyr", rate, "gx,gy,gz"), ("table", None, "angle")):
            rows = np.zeros((200, 1)) if values is None else values
            table = np.column_stack([0.01 * np.arange(200), rows])
            np.savetxt(tmp_path / f"{name}_{file}.csv", table, delimiter=",", header=f"t,{names}", comments="")
    read = read_recordings(procedure("a", "b"), ingest_of(canonical), SENSOR, tmp_path)
    assert [len({f["sha256"] for r in read for f in r.source["joined"][k:][:1]}) for k in (0, 1)] == [2, 1]
    (tmp_path / "b_gyr.csv").write_bytes((tmp_path / "a_gyr.csv").read_bytes())
    with pytest.raises(IngestError, match="recordings a and b are the same file") as refused:
        read_recordings(procedure("a", "b"), ingest_of(canonical), SENSOR, tmp_path)
    assert refused.value.file == str(tmp_path / "b_gyr.csv")


def test_mpu6050_log_has_its_preamble_skipped_and_its_time_counted(reference: Path, tmp_path: Path) -> None:
    lines = (reference / "mpu6050_multi_position" / "example_data_calibration.csv").read_text()
    (tmp_path / "recording.csv").write_text(lines)
    (read,) = read_recordings(procedure("recording"), ingest_of(profile("mpu6050_multi_position")), SENSOR, tmp_path)
    assert read.accelerometer is not None
    assert read.gyroscope is not None
    assert read.samples == 10245
    assert np.unique(np.diff(read.time_ns)).tolist() == [10_000_000]
    np.testing.assert_array_equal(read.accelerometer[0], np.array([-12, -812, 15032]) / 16384.0)
    np.testing.assert_allclose(read.gyroscope[0], np.array([-447, 156, -86]) / 131.0, rtol=1e-15)
    assert {n.code for n in read.notes} == {"N-SYNTHTIME", "N-CLIP"}
    clipped = {"gyro_x": 12, "gyro_z": 6}  # values of +-32767 or -32768 in the text
    found = {n.detail.split()[0]: n.count for n in read.notes if n.code == "N-CLIP"}
    assert found == clipped


def test_arduino_counts_are_scaled_by_the_sensor(tmp_path: Path) -> None:
    ingest = profile("arduino_counts")
    for channel, column in ingest["csv"]["columns"].items():
        if isinstance(column.get("counts_per_unit"), str):
            column["counts_per_unit"] = 16384.0 if channel.startswith("accel") else 131.0
    (tmp_path / "accel_x.csv").write_text(
        "time_ms,ax,ay,az,gx,gy,gz,temp\n10,0,0,16384,131,0,0,-3920\n20,0,0,16384,131,0,0,-3920\n"
    )
    read = read_back(tmp_path, ingest)
    assert read.accelerometer is not None
    assert read.temperature is not None
    assert read.time_ns.tolist() == [10_000_000, 20_000_000]
    assert read.accelerometer[0].tolist() == [0.0, 0.0, 1.0]
    assert read.temperature[0] == pytest.approx(25.0, abs=0.001)  # -3920/340 + 36.53 = 25.0006
