"""Times of an MCAP log: whole nanoseconds of the sensor's clock, put in order with a note, or refused."""

from __future__ import annotations

import gzip
import json
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from mcap.writer import Writer
from unit_settings import ingest_of

from imu_logs.clocks import of_number
from imu_logs.message_read import read_log
from imu_logs.profile import mcap_format
from pipeline.core.errors import IngestError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from imu_logs.log import Log

MS = 1_000_000
EPOCH = 1_700_000_000_123_456_789
FIELDS = {
    "time": {"field": "t", "unit": "ns"},
    **{f"accel_{a}": {"field": f"a[{i}]", "unit": "g"} for i, a in enumerate("xyz")},
}


def read(
    path: Path,
    stamps: Sequence[Any],
    *,
    log_times: Sequence[int] | None = None,
    numbers: Sequence[float] | None = None,
    unit: str = "ns",
    **mcap: Any,
) -> Log:
    """Write messages with these stamps, and read them."""
    with (path / "log.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel("/imu", "json", 0)
        for index, stamp in enumerate(stamps):
            number = float(index) if numbers is None else numbers[index]
            log_time = EPOCH + index * MS if log_times is None else log_times[index]
            writer.add_message(channel, log_time, json.dumps({"t": stamp, "a": [number, 0, 1]}).encode(), log_time)
        writer.finish()
    topics = {"/imu": {**FIELDS, "time": {"field": "t", "unit": unit}}}
    return read_log(path / "log.mcap", mcap_format(ingest_of({"mcap": {"topics": topics, **mcap}})))


@pytest.mark.parametrize(("unit", "scale"), [("s", 10**9), ("ms", 10**6), ("us", 10**3)])
def test_a_moment_that_is_a_double_is_rounded_to_the_nearest_nanosecond(unit: str, scale: int) -> None:
    moments = np.float64(EPOCH / scale) + np.random.default_rng(2).uniform(-5.0, 5.0, 200)
    expected = [round(Fraction(moment) * scale) for moment in moments.tolist()]
    assert of_number(moments, unit).tolist() == expected
    assert of_number(-moments, unit).tolist() == [-t for t in expected]


def test_nanoseconds_since_1970_keep_their_last_digit(tmp_path: Path) -> None:
    stamps = [EPOCH + i * MS + i for i in range(50)]
    assert read(tmp_path, stamps).time_ns.tolist() == stamps
    seconds = [f"{s // 10**9}.{s % 10**9:09d}" for s in stamps]
    plain = read(tmp_path, [float(s) for s in seconds], unit="s")  # JSON keeps 17 digits of a double
    assert np.abs(plain.time_ns - stamps).max() <= 240


def test_messages_out_of_order_are_sorted_and_counted(tmp_path: Path) -> None:
    order = [0, 1, 3, 2, 4, 6, 5, 7]
    table = read(tmp_path, [EPOCH + i * MS for i in order], numbers=[float(i) for i in order])
    assert table.time_ns.tolist() == [EPOCH + i * MS for i in range(8)]
    assert table.values["accel_x"].tolist() == [float(i) for i in range(8)]
    assert [(n.code, n.count) for n in table.notes] == [("N-SORT", 2)]
    assert "by up to 0.001 s" in table.notes[0].detail


def test_message_later_than_the_limit_is_refused(tmp_path: Path) -> None:
    stamps = [EPOCH, EPOCH + 3000 * MS, EPOCH + 1000 * MS]
    with pytest.raises(IngestError, match=r"message 3 on /imu: header stamp .* \(1 such messages\)") as caught:
        read(tmp_path, stamps)
    assert caught.value.code == "bad_time"
    assert read(tmp_path, stamps, reorder_s=2.0).time_ns.tolist() == sorted(stamps)


def test_message_that_stands_there_twice_is_dropped_and_counted(tmp_path: Path) -> None:
    order = [0, 1, 2, 1, 2, 3]
    table = read(tmp_path, [EPOCH + i * MS for i in order], numbers=[float(i) for i in order])
    assert table.values["accel_x"].tolist() == [0.0, 1.0, 2.0, 3.0]
    assert [(n.code, n.count) for n in table.notes] == [("N-SORT", 1), ("N-DUP", 2)]


def test_two_readings_with_one_stamp_are_refused(tmp_path: Path) -> None:
    with pytest.raises(IngestError, match=r"message 3 on /imu: .* as message 2, with other numbers"):
        read(tmp_path, [EPOCH, EPOCH + MS, EPOCH + MS])


def test_stamps_of_zero_are_refused_unless_the_recorder_s_times_are_wanted(tmp_path: Path) -> None:
    with pytest.raises(IngestError, match=r"all header stamps are 0; .* set ingest\.mcap\.time_source=log_time"):
        read(tmp_path, [0] * 5)
    table = read(tmp_path, [0] * 5, time_source="log_time")
    assert table.time_ns.tolist() == [EPOCH + i * MS for i in range(5)]
    assert [n.code for n in table.notes] == ["N-LOGTIME"]


REFUSED: dict[str, tuple[list[Any], dict[str, Any], str]] = {
    "before 2000": ([800 * 10**15, 800 * 10**15 + MS], {}, "outside the years 2000 to 2100 .2 such messages"),
    "after 2100": ([EPOCH, EPOCH + MS, 5 * 10**18], {}, "message 3 on /imu: .* outside the years 2000 to 2100"),
    "before power-on": ([-MS, 0, MS], {}, "message 1 on /imu: header stamp -0.001 s"),
    "replayed": ([EPOCH - 10**15 + i * MS for i in range(3)], {}, "are -1000000 s apart .3 such messages.; 3600 s"),
    "jump of a rollover": (
        [EPOCH, EPOCH + MS, EPOCH + 2 * MS + 2**32 * 1000],
        {},
        r"message 3 on /imu: .* are 4294\.96\d* s apart \(1 such messages\)",
    ),
    "jump since power-on": ([MS, 2 * MS, 2**32 * 1000], {}, r"message 3 on /imu: .* are 4294\.9\d* s apart"),
    "recorder's time is none": ([1, 2], {"log_times": [1, 2**63]}, "the recorder's time of 9223372036854775808 ns"),
    "beyond all times": ([1, 10**20], {}, "message 2 on /imu .* its stamp of 100000000000000000000 ns is out of range"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_times_that_cannot_be_are_refused(tmp_path: Path, case: str) -> None:
    stamps, options, expected = REFUSED[case]
    with pytest.raises(IngestError, match=expected):
        read(tmp_path, stamps, **options)


def test_replayed_log_is_read_if_the_profile_says_so(tmp_path: Path) -> None:
    stamps = [EPOCH - 10**15 + i * MS for i in range(3)]
    assert read(tmp_path, stamps, clock_difference_s=None).time_ns.tolist() == stamps


FOREIGN = {
    "text": (b"time_s,accel_x_g\n0,1\n", "it starts with 'time_s,a'; a text log needs the suffix .csv"),
    "gzip": (gzip.compress(b"x" * 100), "a gzip file"),
    "ROS 1 bag": (b"#ROSBAG V2.0\n" + bytes(50), "a ROS 1 bag"),
    "sqlite bag": (b"SQLite format 3\0" + bytes(50), "an SQLite database"),
    "zeros": (bytes(100), "zeros: data that a memory card lost"),
    "empty": (b"", r"the file is empty \(0 bytes\)"),
    "half the magic": (b"\x89MCA", "truncated: the file has only 4 bytes"),
    "magic only": (b"\x89MCAP0\r\n", "truncated"),
    "no header": (b"\x89MCAP0\r\n" + b"\x0f" + (4).to_bytes(8, "little") + bytes(4), "no Header record"),
}


@pytest.mark.parametrize("case", FOREIGN)
def test_file_of_another_kind_is_named(tmp_path: Path, case: str) -> None:
    data, expected = FOREIGN[case]
    (tmp_path / "a.mcap").write_bytes(data)
    with pytest.raises(IngestError, match=expected) as caught:
        read_log(tmp_path / "a.mcap", mcap_format(ingest_of({})))
    assert caught.value.file == str(tmp_path / "a.mcap")


def test_file_that_is_not_there_is_an_error_of_ingest(tmp_path: Path) -> None:
    with pytest.raises(IngestError, match="cannot be read: No such file"):
        read_log(tmp_path / "a.mcap", mcap_format(ingest_of({})))
