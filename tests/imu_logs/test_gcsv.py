"""Gyroflow's self-describing log: scales, axes and times as its own head says them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from sample_logs import SENSOR, procedure
from unit_settings import ingest_of

from pipeline.core.errors import IngestError
from pipeline.ingest.read import read_recordings

if TYPE_CHECKING:
    from pathlib import Path

    from pipeline.core.records import Recording

HEAD = {"version": "1.3", "orientation": "XYZ", "tscale": "0.001", "gscale": "0.00122173047", "ascale": "0.00048828125"}
ROWS = "0,39,86,183,-114,-1569,-299\n10,40,87,184,-113,-1568,-298\n20,41,88,185,-112,-1567,-297\n"


def log(rows: str = ROWS, first: str = "GYROFLOW IMU LOG", names: str = "t,gx,gy,gz,ax,ay,az", **head: Any) -> str:
    lines = [f"{key},{value}" for key, value in {**HEAD, **head}.items() if value is not None]
    return "\n".join([first, *lines, names]) + "\n" + rows


def read(folder: Path, text: str, **sensor: Any) -> Recording:
    (folder / "log.gcsv").write_text(text)
    return read_recordings(procedure("log"), ingest_of({"name": "any"}), SENSOR.replaced(**sensor), folder)[0]


def test_counts_are_scaled_as_the_file_says_and_stay_integers(tmp_path: Path) -> None:
    recording = read(tmp_path, log())
    assert recording.accelerometer is not None
    assert recording.gyroscope is not None
    np.testing.assert_allclose(recording.accelerometer[0], np.array([-114, -1569, -299]) * 0.00048828125, rtol=1e-14)
    np.testing.assert_allclose(recording.gyroscope[1], np.degrees(np.array([40, 87, 184]) * 0.00122173047), rtol=1e-14)
    assert recording.time_ns.tolist() == [0, 10_000_000, 20_000_000]


def test_times_of_a_scale_that_is_no_binary_fraction_are_exact(tmp_path: Path) -> None:
    rows = "".join(f"{10**9 + 3 * i},0,0,0,0,0,2048\n" for i in range(4))
    recording = read(tmp_path, log(rows, tscale="0.000001"))
    assert recording.time_ns.tolist() == [1000 * (10**9 + 3 * i) for i in range(4)]


@pytest.mark.parametrize("orientation", ["XYZ", "YxZ", "ZXY", "xYz"])
def test_orientation_names_the_reading_of_each_body_axis(tmp_path: Path, orientation: str) -> None:
    """A small letter is the reading turned round: of ``YxZ``, body x is the reading y, body y the reading -x."""
    reading = np.array([-114, -1569, -299]) * 0.00048828125
    expected = [reading["XYZ".index(c.upper())] * (1 if c.isupper() else -1) for c in orientation]
    recording = read(tmp_path, log(orientation=orientation))
    assert recording.accelerometer is not None
    np.testing.assert_allclose(recording.accelerometer[0], expected, rtol=1e-14)


def test_temperature_and_the_tables_angle_may_follow(tmp_path: Path) -> None:
    rows = "".join(f"{10 * i},0,0,0,0,0,2048,25.5,{i}\n" for i in range(4))
    recording = read(tmp_path, log(rows, names="t,gx,gy,gz,ax,ay,az,temperature_degc,table_angle_deg"))
    assert recording.temperature is not None
    assert recording.table_angle is not None
    assert recording.temperature.tolist() == [25.5] * 4
    assert recording.table_angle.tolist() == [0.0, 1.0, 2.0, 3.0]


def test_a_gyroscope_alone_is_read(tmp_path: Path) -> None:
    recording = read(tmp_path, log("0,1,2,3\n10,1,2,4\n", names="t,gx,gy,gz", ascale=None))
    assert recording.accelerometer is None
    assert recording.gyroscope is not None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (log(first="time,ax"), "GYROFLOW IMU LOG is expected"),
        (log(version="2.0"), "version 2.0 of .gcsv is not known"),
        (log(gscale=None), "gscale is missing"),
        (log(tscale="0"), "tscale is '0'; a positive number"),
        (log(orientation="XXZ"), "orientation is 'XXZ'"),
        (log(names="a,b"), "no line of column names"),
    ],
)
def test_a_head_that_says_too_little_is_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(IngestError, match=message) as caught:
        read(tmp_path, text)
    assert caught.value.code == "gcsv"


def test_two_maps_of_the_axes_are_one_too_many(tmp_path: Path) -> None:
    with pytest.raises(IngestError, match=r"states its orientation \(YxZ\) and sensor.axis_map is"):
        read(tmp_path, log(orientation="YxZ"), axis_map=["+y", "-x", "+z"])
