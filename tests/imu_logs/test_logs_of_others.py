"""Units, headers, separators, bad rows and names in logs of others."""

from __future__ import annotations

import io
import struct
import zipfile
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from nptdms import ChannelObject, TdmsWriter
from pymavlink.dialects.v20 import common as mavlink

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
        (f"% {NAMES}", ""), (f"// {NAMES}", ""), (f"//{NAMES}", ""),
        (NAMES, ","), (f"{NAMES},", ""), (f"{NAMES},", ","),
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


FIELDS = {f"accel_{a}": {"field": f"data[{i}]", "unit": "g"} for i, a in enumerate("xyz", 1)}
FIELDS |= {f"gyro_{a}": {"field": f"data[{i}]", "unit": "deg/s"} for i, a in enumerate("xyz", 4)}


def of_topic(name: str, fields: dict[str, Any], **more: Any) -> imu_logs.Profile:
    return imu_logs.load_profile({"name": "mine", "mcap": {"topics": {name: fields}, **more}})


def assert_motion(log: imu_logs.Log, tolerance: float = 1e-9) -> None:
    np.testing.assert_allclose(log.time_ns, np.rint(MOTION[:, 0] * 1e9), atol=1)
    for column, channel in enumerate(("accel_x", "accel_y", "accel_z", "gyro_x", "gyro_y", "gyro_z"), 1):
        np.testing.assert_allclose(log.values[channel], MOTION[:, column], atol=tolerance)


def test_arrays_of_numpy(tmp_path: Path) -> None:
    np.save(tmp_path / "data.npy", MOTION)
    assert_motion(
        imu_logs.read(tmp_path / "data.npy", of_topic("/", FIELDS | {"time": {"field": "data[0]", "unit": "s"}}))
    )
    np.savez(tmp_path / "log.npz", t=MOTION[:, 0], acc=MOTION[:, 1:4], gyr=MOTION[:, 4:])
    (proposal,) = imu_logs.propose(tmp_path / "log.npz")
    assert proposal.columns[0]["accel_x"]["column"] == "acc[0]"
    assert proposal.columns[0]["gyro_z"]["column"] == "gyr[2]"


def test_arrays_without_a_time_ask_for_the_rate(tmp_path: Path) -> None:
    np.savez(tmp_path / "log.npz", acc=MOTION[:, 1:4], gyr=MOTION[:, 4:])
    (proposal,) = imu_logs.propose(tmp_path / "log.npz")
    assert "rate_hz" in proposal.unknown()
    assert 'rate_hz: "???"' in proposal.text()
    fields = {
        k: {**v, "field": ("acc" if k[0] == "a" else "gyr") + f"[{'xyz'.index(k[-1])}]"} for k, v in FIELDS.items()
    }
    assert_motion(imu_logs.read(tmp_path / "log.npz", of_topic("/", fields, rate_hz=100.0)))


def test_labview(tmp_path: Path) -> None:
    """Files of NI's format, written by nptdms."""
    waveform = {"wf_increment": 0.01, "wf_start_offset": 0.0}
    units = {"a": "g", "w": "deg/s"}
    channels = [
        ChannelObject(
            "imu", f"{letter}{axis}", MOTION[:, 1 + 3 * (letter == "w") + i], waveform | {"unit_string": units[letter]}
        )
        for letter in "aw"
        for i, axis in enumerate("xyz")
    ]
    with TdmsWriter(tmp_path / "log.tdms") as writer:
        writer.write_segment(channels)
    (proposal,) = imu_logs.propose(tmp_path / "log.tdms")
    assert proposal.complete, proposal.unknown()
    assert_motion(imu_logs.read(tmp_path / "log.tdms", proposal.profile("mine")))


def test_mavlink_telemetry(tmp_path: Path) -> None:
    """A log of a ground station: packets of the official library, each after the time of its arrival."""
    link = mavlink.MAVLink(io.BytesIO())
    packets = []
    for t, *readings in MOTION.tolist():
        force = [round(1000 * v) for v in readings[:3]]
        rate = [round(1000 * v * np.pi / 180) for v in readings[3:]]
        message = mavlink.MAVLink_scaled_imu_message(round(1000 * t), *force, *rate, 0, 0, 0)
        packets.append(struct.pack(">Q", 1_700_000_000_000_000 + round(1e6 * t)) + message.pack(link))
    (tmp_path / "flight.tlog").write_bytes(b"".join(packets))
    (proposal,) = imu_logs.propose(tmp_path / "flight.tlog")
    assert proposal.complete, proposal.unknown()
    assert proposal.columns[0]["gyro_x"]["unit"] == "mrad/s"
    log = imu_logs.read(tmp_path / "flight.tlog", proposal.profile("mine").model_copy(update={
        "mcap": {**proposal.profile("mine").mcap, "clock_difference_s": None}}))  # fmt: skip
    assert_motion(log, tolerance=0.03)  # whole mg and mrad/s


def test_a_zip_of_text_logs(tmp_path: Path) -> None:
    """As Sensor Logger exports a phone's recording: a file for each sensor."""
    with zipfile.ZipFile(tmp_path / "phone.zip", "w") as archive:
        for name, columns, unit in (("TotalAcceleration", [1, 2, 3], "g"), ("Gyroscope", [4, 5, 6], "deg/s")):
            rows = "\n".join(",".join(f"{row[c]:.9g}" for c in [0, *columns]) for row in MOTION)
            archive.writestr(f"{name}.csv", f"seconds_elapsed,x [{unit}],y [{unit}],z [{unit}]\n{rows}\n")
        archive.writestr("Metadata.csv", "device,model\nphone,none\n")
    (proposal,) = imu_logs.propose(tmp_path / "phone.zip")
    assert proposal.complete, (proposal.unknown(), proposal.evidence)
    assert_motion(imu_logs.read(tmp_path / "phone.zip", proposal.profile("mine")))
    with pytest.raises(imu_logs.IngestError, match="3 text logs are in the zip file"):
        imu_logs.read(tmp_path / "phone.zip")


def test_a_text_with_the_suffix_of_matlab_is_a_text(tmp_path: Path) -> None:
    file = tmp_path / "xsens_acc.mat"
    np.savetxt(file, MOTION[:, :4] + 0.01 * np.sin(MOTION[:, [0]] * [0, 3, 5, 7]), "%.9f")
    (proposal,) = imu_logs.propose(file)
    assert [proposal.columns[0][c]["column"] for c in ("time", "accel_x", "accel_z")] == [0, 1, 3]


@pytest.mark.parametrize(
    ("start", "words"),
    [
        (b"H Product:Blackbox flight data recorder by Nicholas Sherlock", "blackbox_decode"),
        (struct.pack(">QB", 1_700_000_000_000_000, 0xFD) + bytes(20), r"\.tlog"),
        (struct.pack(">QB", 1_700_000_000_000_000, 0xFE) + bytes(20), r"\.tlog"),
        (b"TDSm" + bytes(40), r"\.tdms"),
        (b"\x00\x00\x00\x18ftypmp41" + bytes(40), "MP4"),
        (b"\x93NUMPY\x01\x00" + bytes(40), r"\.npy"),
        (b"\xfa\xff\x36" + bytes(40), "Xsens"),
    ],
)
def test_kinds_of_binary_files_are_named_by_their_first_bytes(tmp_path: Path, start: bytes, words: str) -> None:
    (tmp_path / "log.dat").write_bytes(start)
    for use in (imu_logs.read, imu_logs.propose):
        with pytest.raises(imu_logs.IngestError, match=words):
            use(tmp_path / "log.dat")
