"""Every refusal says what is wrong, where, and what to do; nothing that cannot be true is read."""

from __future__ import annotations

import os
import re
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from sample_logs import SENSOR, make_recording, procedure, profile
from unit_settings import ingest_of

from imu_logs.files import SUFFIXES
from pipeline.app.config.compose import check_ingest
from pipeline.core.errors import ConfigurationError, InputError, MissingInputError
from pipeline.ingest.arrow import write_recording
from pipeline.ingest.files import recording_files
from pipeline.ingest.read import read_recordings

if TYPE_CHECKING:
    from pathlib import Path

    from pipeline.core.records import Recording
    from pipeline.core.settings import Sensor

HEADER = "time_s,accel_x_g,accel_y_g,accel_z_g,gyro_x_dps,gyro_y_dps,gyro_z_dps"
ROWS = [f"{i / 100:.2f},0.01,0.02,1.0{i},0.1,0.2,0.3" for i in range(8)]


def text(*rows: str, header: str = HEADER) -> str:
    return "\n".join([header, *rows]) + "\n"


def read(folder: Path, ingest: dict[str, Any], sensor: Sensor = SENSOR) -> Recording:
    return read_recordings(procedure("accel_x"), ingest_of(ingest), sensor, folder)[0]


def with_row(row: int, line: str) -> str:
    rows = list(ROWS)
    rows[row] = line
    return text(*rows)


REFUSED: dict[str, tuple[bytes | str, str, int]] = {
    # name: content, what the message says, line (0: none)
    "one row": (text(ROWS[0]), "1 data rows; at least 2", 0),
    "latin-1": (text(*ROWS).replace("time_s", "time_s,\u00b5").encode("latin-1"), r"byte 7 \(0xb5\) is not UTF-8", 1),
    "NUL inside": (text(*ROWS).encode().replace(b"1.03", b"\0\0\0\0"), "4 NUL bytes, the first at byte", 5),
    "NUL only": (bytes(64), "64 NUL bytes", 1),
    "missing column": (
        text(*ROWS).replace("gyro_z_dps", "gyro_z_dsp"),
        r"column gyro_z_dps \(nearest: gyro_z_dsp\) missing; found time_s, accel_x_g",
        1,
    ),
    "a whole sensor under other names": (
        text(*ROWS).replace("gyro_", "angular_"),
        "gyro_z_dps.* missing; .*of a log without gyroscope, set gyro_x, gyro_y, gyro_z to null",
        1,
    ),
    "no header": (text(*ROWS[1:], header=ROWS[0]), "column time_s, accel_x_g, .* missing; found 0.00, 0.01", 1),
    "N/A": (with_row(3, "0.03,0.01,#N/A,1,0,0,0"), "is '#N/A'", 5),
    "decimal comma": (with_row(3, '0.03,0.01,"0,5",1,0,0,0'), "is '0,5', a decimal comma; write numbers with a", 5),
    "header again": (text(*ROWS[:4], HEADER, *ROWS[4:]), r"column time_s \(time\) is 'time_s'", 6),
    "two bad lines": (with_row(3, "x").replace(ROWS[5], "y"), r"1 fields .* \(1 more such lines, up to line 7\)", 5),
    "bad line after empty lines": (text(*ROWS[:2], "", "", "0.03,0.01,ERR,1,0,0,0"), "is 'ERR'", 6),
    "time back": (with_row(3, ROWS[1]), r"time goes back to 0.01 s after 0.02 s \(1 such samples\)", 5),
    "time again": (with_row(3, ROWS[2]), "time repeats 0.02 s after 0.02 s", 5),
    "time back after empty lines": (text(*ROWS[:3], "", "", ROWS[1]), "time goes back to", 7),
    "mg": (text("0,0,0,998,1,1,1", "1,0,0,998,1,1,1"), "the numbers look like mg", 0),
    "beyond full scale": (with_row(3, "0.03,0,0,1,0,-301,0"), "gyro_y is -301 deg/s at 0.03 s, beyond 1.2 times", 5),
    "no rotation": (
        text(*(r + ",1,0,0,0.5" for r in ROWS), header=HEADER + ",table_qw,table_qx,table_qy,table_qz"),
        "quaternion has the length 1.118",
        2,
    ),
    "half an attitude": (
        text(*(r + ",1,0,0" for r in ROWS), header=HEADER + ",table_qw,table_qx,table_qy"),
        "table_qz missing; table_qw, table_qx, table_qy, table_qz come together",
        0,
    ),
    "time out of range": (with_row(3, "1e11,0,0,1,0,0,0"), "is s the unit of column time_s", 5),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refusal_says_what_and_where(tmp_path: Path, canonical: dict[str, Any], case: str) -> None:
    content, message, line = REFUSED[case]
    file = tmp_path / "accel_x.csv"
    file.write_bytes(content.encode() if isinstance(content, str) else content)
    with pytest.raises(InputError) as caught:
        read(tmp_path, canonical)
    assert re.search(message, caught.value.message), caught.value.message
    assert caught.value.file == (f"{file}:{line}" if line else str(file))


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("start", ["", "\ufeff"])
def test_a_fault_far_into_a_large_file_is_located_exactly(
    tmp_path: Path, canonical: dict[str, Any], start: str, end: str
) -> None:
    rows = [f"{i / 100:.2f},0.01,0.02,1.0{i},0.1,0.2,0.3" for i in range(60_000)]  # more than two blocks
    rows[100:100], rows[200:200] = [""] * 3, ["# a remark"] * 2
    rows[51_234] = "512.29,0.01,\u22120.02,1,0,0,0"
    canonical["csv"]["comment"] = "#"
    (tmp_path / "accel_x.csv").write_text(start + end.join([HEADER, *rows, ""]), encoding="utf-8", newline="")
    with pytest.raises(InputError, match="; a finite number is expected") as caught:
        read(tmp_path, canonical)
    assert caught.value.file == f"{tmp_path / 'accel_x.csv'}:51236"


def test_the_search_for_bad_lines_ends_after_ten_thousand(tmp_path: Path, canonical: dict[str, Any]) -> None:
    (tmp_path / "accel_x.csv").write_text(text(*ROWS, *["x"] * 50_000))
    with pytest.raises(InputError, match=r"at least 10000 more such lines, up to line 10010") as caught:
        read(tmp_path, canonical)
    assert caught.value.file == f"{tmp_path / 'accel_x.csv'}:10"


def test_what_is_refused_differs_from_a_log_that_is_read(tmp_path: Path, canonical: dict[str, Any]) -> None:
    (tmp_path / "accel_x.csv").write_text(text(*ROWS))
    assert read(tmp_path, canonical).notes == ()


@pytest.mark.parametrize(
    ("content", "found", "rows"),
    [
        (b"\xef\xbb\xbf" + text(*ROWS).encode(), ("N-BOM", 1), 8),
        (text(*ROWS).encode()[:-1], ("N-TAIL", 9), 7),
        (text(*ROWS).encode() + b"0.08,0.0", ("N-TAIL", 10), 8),
        (text(*ROWS).encode() + bytes(1000), ("N-NULTAIL", 10), 8),
        (text(*ROWS).encode().replace(b"\n", b"\r\n", 3), ("N-EOL", 0), 8),
        (text(*ROWS).encode().replace(b"\n", b"\r"), ("N-EOL", 0), 8),
    ],
    ids=["byte order mark", "open last line", "cut last line", "NUL tail", "mixed line ends", "CR line ends"],
)
def test_repair_is_noted(
    tmp_path: Path, canonical: dict[str, Any], content: bytes, found: tuple[str, int], rows: int
) -> None:
    (tmp_path / "accel_x.csv").write_bytes(content)
    recording = read(tmp_path, canonical)
    assert [(n.code, n.first) for n in recording.notes] == [found]
    assert recording.samples == rows
    assert recording.accelerometer is not None
    assert recording.accelerometer[:, 2].tolist() == [float(f"1.0{i}") for i in range(rows)]


def test_number_cut_at_the_end_of_the_file_never_counts(tmp_path: Path, canonical: dict[str, Any]) -> None:
    whole = text(*ROWS).encode()
    for length in range(len(HEADER) + 1 + 2 * len(ROWS[0]) + 2, len(whole)):
        (tmp_path / "accel_x.csv").write_bytes(whole[:length])
        recording = read(tmp_path, canonical)
        assert recording.accelerometer is not None
        assert recording.gyroscope is not None
        assert recording.accelerometer[:, 2].tolist() == [float(f"1.0{i}") for i in range(recording.samples)]
        assert set(recording.gyroscope[:, 2]) == {0.3}


def test_all_faulty_files_of_a_unit_are_named_together(tmp_path: Path, canonical: dict[str, Any]) -> None:
    (tmp_path / "a.csv").write_text("time_s\n0\n1\n")
    (tmp_path / "b.csv").write_bytes(b"")
    with pytest.raises(MissingInputError, match=r"c \(tried .*a\.csv:1 \(missing_column\); .*b\.csv \(empty\)"):
        read_recordings(procedure("a", "b", "c"), ingest_of(canonical), SENSOR, tmp_path)


def test_missing_files_are_named_together_with_what_was_tried(tmp_path: Path, canonical: dict[str, Any]) -> None:
    write_recording(tmp_path / "b.csv", make_recording())
    with pytest.raises(MissingInputError) as caught:
        read_recordings(procedure("a", "b", "c", optional=("d",)), ingest_of(canonical), SENSOR, tmp_path)
    tried = "{0} (tried {0}" + ", ".join(SUFFIXES) + ")"
    assert caught.value.message == f"missing recordings: {tried.format('a')}; {tried.format('c')}"
    assert caught.value.file == str(tmp_path)


def test_missing_folder_is_named(tmp_path: Path, canonical: dict[str, Any]) -> None:
    with pytest.raises(MissingInputError, match="the folder does not exist"):
        read(tmp_path / "nowhere", canonical)


def test_a_folder_without_any_recording_is_told_with_what_it_holds(tmp_path: Path, canonical: dict[str, Any]) -> None:
    with pytest.raises(MissingInputError, match=r"; the folder is empty$"):
        read_recordings(procedure("a"), ingest_of(canonical), SENSOR, tmp_path)
    for name in ("gyroscope.txt", "accelerometer.txt"):
        (tmp_path / name).write_text("0 1 2 3\n")
    said = r"; the folder holds accelerometer\.txt, gyroscope\.txt: python -m pipeline check proposes a profile$"
    with pytest.raises(MissingInputError, match=said):
        read_recordings(procedure("a"), ingest_of(canonical), SENSOR, tmp_path)


def test_missing_part_is_named(tmp_path: Path) -> None:
    (tmp_path / "accelerometer.txt").write_text("0 1 2 3\n")
    with pytest.raises(MissingInputError, match=re.escape("recording (gyroscope.txt)")):
        read_recordings(procedure("recording"), ingest_of(profile("xsens_mti_multi_position")), SENSOR, tmp_path)


def test_parts_of_different_times_are_refused(tmp_path: Path) -> None:
    ingest = profile("xsens_mti_multi_position")
    (tmp_path / "accelerometer.txt").write_text("0.00 32768 32768 36838\n0.01 32768 32768 36838\n")
    (tmp_path / "gyroscope.txt").write_text("  0.00\t32768 32768 32768\n  0.02\t32768 32768 32768 \n")
    with pytest.raises(InputError, match=r"time 0.02 s differs from 0.01 s in .*accelerometer.txt:2") as caught:
        read_recordings(procedure("recording"), ingest_of(ingest), SENSOR, tmp_path)
    assert caught.value.file == f"{tmp_path / 'gyroscope.txt'}:2"
    (tmp_path / "gyroscope.txt").write_text("0.00 32768 32768 32768\n")
    with pytest.raises(InputError, match=r"1 rows, but .*accelerometer.txt has 2"):
        read_recordings(procedure("recording"), ingest_of(ingest), SENSOR, tmp_path)


def test_fixed_parts_need_one_required_recording(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=re.escape("write {file} where the recording's name belongs")):
        recording_files(procedure("a", "b"), ingest_of(profile("xsens_mti_multi_position")), tmp_path)


@pytest.mark.parametrize("suffix", [".csv", ".gcsv", ".mcap"])
def test_what_is_no_regular_file_is_refused_and_never_waited_for(
    tmp_path: Path, canonical: dict[str, Any], suffix: str
) -> None:
    path = tmp_path / f"accel_x{suffix}"
    for make, what in (
        (path.mkdir, "is a directory"),
        (lambda: os.mkfifo(path), "is a FIFO"),
        (lambda: path.symlink_to("/dev/zero"), "is a device"),
    ):
        make()
        with pytest.raises(InputError, match=f"{what}; a regular file, or a symbolic link to one, is expected"):
            read(tmp_path, canonical)
        path.rmdir() if path.is_dir() else path.unlink()


def test_one_file_under_two_names_is_refused(tmp_path: Path, canonical: dict[str, Any]) -> None:
    for name in "ab":
        write_recording(tmp_path / f"{name}.csv", make_recording())
    with pytest.raises(InputError, match="recordings a and b are the same file, byte for byte"):
        read_recordings(procedure("a", "b"), ingest_of(canonical), SENSOR, tmp_path)


def test_second_kind_of_file_is_noted(tmp_path: Path, canonical: dict[str, Any]) -> None:
    write_recording(tmp_path / "accel_x.csv", make_recording())
    (tmp_path / "accel_x.mcap").touch()
    assert [(n.code, n.detail) for n in read(tmp_path, canonical).notes] == [
        ("N-NOTREAD", "accel_x.mcap exists too and was not read")
    ]


def test_a_file_of_an_optional_recording_with_another_suffix_is_noted(
    tmp_path: Path, canonical: dict[str, Any]
) -> None:
    write_recording(tmp_path / "a.csv", make_recording())
    (tmp_path / "b.txt").touch()
    known = procedure("a", "b")
    optional = known.recordings["b"].replaced(optional=True)
    known = known.replaced(recordings={**known.recordings, "b": optional})
    (recording,) = read_recordings(known, ingest_of(canonical), SENSOR, tmp_path)
    told = "no b: b.txt lies there; rename it, or set procedure.recordings.b.file=b.txt"
    assert [(n.code, n.detail) for n in recording.notes] == [("N-NOTREAD", told)]


def test_files_are_found_csv_before_mcap_and_suffixes_as_they_are(tmp_path: Path, canonical: dict[str, Any]) -> None:
    for name in ("a.csv", "a.mcap", "b.mcap", "c.log"):
        (tmp_path / name).touch()
    entries = procedure("a", "b", "c", "d").recordings
    wanted = procedure().replaced(recordings=entries | {"c": entries["c"].replaced(file="c.log")})
    found = recording_files(wanted, ingest_of(canonical), tmp_path)
    assert {n: [p.name for p in files] for n, files in found.items()} == {
        "a": ["a.csv"],
        "b": ["b.mcap"],
        "c": ["c.log"],
    }


@pytest.mark.parametrize(
    "axis_map", [["+x", "+y", "+y"], ["x", "y", "z"], ["+x", "+y"], ["+x", "+y", "+w"], ["", "+y", "+z"]]
)
def test_axis_map_of_another_form_is_refused(tmp_path: Path, canonical: dict[str, Any], axis_map: list[str]) -> None:
    (tmp_path / "accel_x.csv").write_text(text(*ROWS))
    with pytest.raises(ConfigurationError, match=r"sensor\.axis_map is"):
        read(tmp_path, canonical, SENSOR.replaced(axis_map=axis_map))


def change(ingest: dict[str, Any], key: str, value: Any) -> None:
    *path, last = key.split("/")
    for step in path:
        ingest = ingest[step]
    ingest[last] = value


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        (
            "csv/columns/accel_x/unit",
            "m/s2",
            "columns.accel_x.unit is 'm/s2'; allowed are g, mg, ug, m/s^2, mm/s^2, counts",
        ),
        ("csv/columns/accel_x/unit", None, "columns.accel_x.unit is None; allowed are g, mg"),
        ("csv/columns/gyro_x/unit", "g", "columns.gyro_x.unit is 'g'; allowed are deg/s, mdps, mrad/s, rad/s, counts"),
        ("csv/columns/accel_x/unit", "counts", "accel_x.counts_per_unit is None; counts need a number"),
        ("csv/columns/accel_x/counts_per_unit", 2.0, "belong to the unit counts; this is g"),
        ("csv/columns/accel_x/column", 3, "accel_x.column is 3; it is a name of the header"),
        ("csv/columns/accel_x/colum", "a", "accel_x.colum is unknown; did you mean column?"),
        ("csv/columns/acel_x", {}, "columns.acel_x is unknown; did you mean accel_x?"),
        ("csv/columns/accel_x", None, "accel_x of the accelerometer is not described"),
        ("csv/columns/time", None, "needs either a time column"),
        ("csv/rate_hz", 100.0, "needs either a time column"),
        ("csv/rate_hz", -1, "rate_hz is -1; it is a positive number"),
        ("csv/delimiter", ";;", "delimiter is ';;'; it is one character, or whitespace"),
        ("csv/delimiter", "", "delimiter is ''; it is one character, or whitespace, auto, comma, semicolon"),
        ("csv/header", "yes", "header is 'yes'; it is true or false"),
        ("csv/header", False, "it is an index from 0, for header is false"),
        ("csv/skip_lines", -1, "skip_lines is -1; it is a number of lines"),
        ("csv/decimal", ";", "csv.decimal is ';'; it is '.' or ','"),
        ("csv/decimals", ",", "csv.decimals is unknown; did you mean decimal?"),
        ("mcap/imu_topic", 3, "imu_topic is 3; it is a name"),
        ("mcap/topic", "/imu", "mcap.topic is unknown"),
        ("csv/columns", [], "describes neither an accelerometer nor a gyroscope"),
    ],
)
def test_profile_that_no_file_suits_is_refused(canonical: dict[str, Any], key: str, value: Any, message: str) -> None:
    change(canonical, key, value)
    if key == "csv/columns":
        change(canonical, key, {"time": {"column": "t", "unit": "s"}})
    with pytest.raises(ConfigurationError, match=re.escape(message)):
        check_ingest(ingest_of(canonical))


@pytest.mark.parametrize("name", ["canonical_csv", "mcap", "xsens_mti_multi_position", "mpu6050_multi_position"])
def test_profiles_that_ship_are_sound(name: str) -> None:
    check_ingest(ingest_of(profile(name)))


def test_file_shorter_than_its_preamble_is_refused(tmp_path: Path) -> None:
    (tmp_path / "accel_x.csv").write_text("Fs,100\n")
    with pytest.raises(InputError, match="ends within the 4 lines that"):
        read(tmp_path, profile("mpu6050_multi_position"))


def test_counts_that_are_not_whole_are_read_as_numbers(tmp_path: Path) -> None:
    ingest = profile("mpu6050_multi_position")
    ingest["csv"]["skip_lines"] = 0
    (tmp_path / "accel_x.csv").write_text("ax,ay,az,gx,gy,gz\n0.5,0,16384,0,0,0\n1,0,16384,0,0,0\n")
    recording = read(tmp_path, ingest)
    assert recording.accelerometer is not None
    assert recording.accelerometer[0, 0] == 0.5 / 16384
    np.testing.assert_array_equal(recording.time_ns, [0, 10_000_000])


def test_a_file_of_another_suffix_is_named(tmp_path: Path, canonical: dict[str, Any]) -> None:
    (tmp_path / "a.txt").write_text("time_s\n")
    with pytest.raises(MissingInputError, match=r"a\.txt lies there; .* procedure\.recordings\.a\.file=a\.txt"):
        read_recordings(procedure("a"), ingest_of(canonical), SENSOR, tmp_path)
