"""Compensation of MCAP logs, read back by the format's own library."""

from __future__ import annotations

import json
import struct
import subprocess
import sys
from collections import defaultdict
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from mcap_ros2.decoder import DecoderFactory
from unit_settings import ingest_of

from imu_logs.mcap_write import DEFINITIONS, IMU, TEMPERATURE
from pipeline.app.commands.apply import main
from pipeline.app.field_logs.stream import LogProfile, compensate_log
from pipeline.core.errors import InputError
from pipeline.core.records import SENSORS, Coefficient, FittedEffect, Recording, SensorCalibration
from pipeline.estimation.noise_identification import identify_noise
from pipeline.physics.compensation import load

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

G0 = 9.80665
EPOCH_NS = 1_700_000_000_000_000_000
COUNT = 3000


def effect(name: str, **values: float) -> FittedEffect:
    return FittedEffect(name, {k: Coefficient(v, "", 0.0) for k, v in values.items()})


@pytest.fixture
def calibration(tmp_path: Path) -> Path:
    accelerometer = SensorCalibration(
        "accelerometer", np.array([0.02, -0.01, 0.03]), np.diag([1.01, 0.99, 1.02]) + 0.003
    )
    gyroscope = SensorCalibration(
        "gyroscope", np.array([1.0, -2.0, 0.5]), np.eye(3) + 0.01,
        effects=(effect("bias_temperature", b_T_x=0.1, b_T_y=0.2, b_T_z=-0.1),),
    )  # fmt: skip
    file = tmp_path / "U1.json"
    parts = {"accelerometer": accelerometer.to_json(), "gyroscope": gyroscope.to_json()}
    file.write_text(
        json.dumps({"unit": "U1", "schema_version": 1, "status": "ok", "error": None, **parts}), encoding="utf-8"
    )
    return file


def imu_message(stamp: int, force: Iterable[float], rate: Iterable[float], frame: str = "imu") -> bytes:
    text = frame.encode() + b"\0"
    head = b"\x00\x01\x00\x00" + struct.pack("<iII", stamp // 10**9, stamp % 10**9, len(text)) + text
    head += bytes(-(len(head) - 4) % 8)
    numbers = [0.1, 0.2, 0.3, 0.9, *range(9), *rate, *range(9, 18), *force, *range(18, 27)]
    return head + struct.pack("<37d", *numbers)


def temperature_message(stamp: int, value: float) -> bytes:
    head = b"\x00\x01\x00\x00" + struct.pack("<iII", stamp // 10**9, stamp % 10**9, 4) + b"imu\0"
    return head + bytes(-(len(head) - 4) % 8) + struct.pack("<2d", value, 0.0)


def signals() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stamps, ns, specific force, g, and rate, deg/s."""
    rng = np.random.default_rng(4)
    stamps = EPOCH_NS + 10_000_000 * np.arange(COUNT)
    return stamps, rng.normal(0, 1, (COUNT, 3)), rng.normal(0, 50, (COUNT, 3))


def write_log(
    path: Path, compression: CompressionType = CompressionType.ZSTD, *, chunked: bool = True, varied: bool = False,
    temperature: bool = True,
) -> Path:  # fmt: skip
    stamps, force, rate = signals()
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=100_000, compression=compression, use_chunking=chunked)
        writer.start(profile="ros2", library="a recorder")
        text = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        imu = writer.register_schema(IMU, "ros2msg", DEFINITIONS[IMU].encode())
        warm = writer.register_schema(TEMPERATURE, "ros2msg", DEFINITIONS[TEMPERATURE].encode())
        channels = [
            writer.register_channel("/chatter", "cdr", text),
            writer.register_channel("/imu/data", "cdr", imu, metadata={"offered_qos_profiles": "some"}),
            writer.register_channel("/imu/temperature", "cdr", warm),
        ]
        writer.add_metadata("session", {"driver": "somebody"})
        for i, stamp in enumerate(stamps.tolist()):
            frame = "imu" if not varied or i % 3 else "another_imu"
            data = imu_message(stamp, force[i] * G0, np.radians(rate[i]), frame)
            writer.add_message(channels[1], stamp + 500, data, stamp + 300, i)
            if temperature and i % 20 == 10:
                value = 25.0 + 1e-3 * i
                writer.add_message(channels[2], stamp + 600, temperature_message(stamp + 100, value), stamp, i)
            if i % 100 == 0:
                writer.add_message(channels[0], stamp, b"\x00\x01\x00\x00" + struct.pack("<I", 3) + b"hi\0", stamp, i)
        writer.add_attachment(stamps[0], stamps[0], "plan.txt", "text/plain", b"a drive around the block")
        writer.finish()
    return path


def messages(path: Path) -> dict[str, list[tuple[int, int, int, bytes]]]:
    found = defaultdict(list)
    with path.open("rb") as stream:
        for _, channel, message in make_reader(stream, validate_crcs=True).iter_messages(log_time_order=False):
            found[channel.topic].append((message.log_time, message.publish_time, message.sequence, message.data))
    return dict(found)


def decoded(path: Path, topic: str) -> list[Any]:
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        return [message for _, _, _, message in reader.iter_decoded_messages(topics=[topic])]


def numbers(found: list[Any]) -> tuple[np.ndarray, np.ndarray]:
    force = np.array([[m.linear_acceleration.x, m.linear_acceleration.y, m.linear_acceleration.z] for m in found])
    rate = np.array([[m.angular_velocity.x, m.angular_velocity.y, m.angular_velocity.z] for m in found])
    return force, rate


def in_house_units(found: list[Any]) -> tuple[np.ndarray, np.ndarray]:
    force, rate = numbers(found)
    return force / G0, rate * (180.0 / np.pi)


@pytest.mark.parametrize(
    ("compression", "chunked"),
    [
        (CompressionType.ZSTD, True),
        (CompressionType.LZ4, True),
        (CompressionType.NONE, True),
        (CompressionType.NONE, False),
    ],
)
def test_every_message_is_kept_and_a_topic_of_calibrated_ones_is_added(
    calibration: Path,
    tmp_path: Path,
    compression: CompressionType,
    chunked: bool,  # noqa: FBT001
) -> None:
    log, out = write_log(tmp_path / "log.mcap", compression, chunked=chunked), tmp_path / "out.mcap"
    assert main(["--calibration", str(calibration), str(log), "-o", str(out)]) == 0
    before, after = messages(log), messages(out)
    added = after.pop("/imu/data_calibrated")
    assert after == before
    assert [m[:3] for m in added] == [m[:3] for m in before["/imu/data"]]
    with out.open("rb") as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics.message_count == sum(map(len, before.values())) + COUNT
        assert [a.name for a in reader.iter_attachments()] == ["plan.txt"]
        made = {"unit": "U1", "topic": "/imu/data_calibrated", "readings": "/imu/data", "warnings": ""}
        assert [m.metadata for m in reader.iter_metadata()] == [{"driver": "somebody"}, made]
        by_topic = {c.topic: c for c in summary.channels.values()}
    later = added[COUNT // 2][0]
    with out.open("rb") as stream:  # by the index of the chunks
        kept = [
            m.log_time for _, c, m in make_reader(stream).iter_messages(starting_at=later) if c.topic.endswith("ted")
        ]
    assert len(kept) == COUNT - COUNT // 2
    assert by_topic["/imu/data_calibrated"].schema_id == by_topic["/imu/data"].schema_id
    assert by_topic["/imu/data_calibrated"].metadata == {"offered_qos_profiles": "some"}


def test_calibrated_messages_are_those_of_the_arrays_to_the_last_bit(calibration: Path, tmp_path: Path) -> None:
    data = json.loads(calibration.read_text())
    data["gyroscope"]["effects"] = []
    data["gyroscope"]["covariance"] = {"parameters": [], "values": []}
    calibration.write_text(json.dumps(data))
    log, out = write_log(tmp_path / "log.mcap"), tmp_path / "out.mcap"
    main(["--calibration", str(calibration), str(log), "-o", str(out), "--topic", "/imu/clean"])
    raw, calibrated = decoded(out, "/imu/data"), decoded(out, "/imu/clean")
    force, rate = in_house_units(raw)
    expected = load(calibration).apply(force, rate)
    found = numbers(calibrated)
    np.testing.assert_array_equal(found[0], expected.accelerometer * G0)
    np.testing.assert_array_equal(found[1], np.radians(expected.gyroscope))
    for a, b in zip(raw[:20], calibrated[:20], strict=True):
        assert (a.header.stamp.nanosec, a.header.frame_id) == (b.header.stamp.nanosec, b.header.frame_id)
        assert a.orientation.w == b.orientation.w == 0.9
        assert list(a.linear_acceleration_covariance) == list(b.linear_acceleration_covariance)


@pytest.mark.parametrize("varied", [False, True])
def test_covariances_are_those_of_a_calibrated_sample(calibration: Path, tmp_path: Path, *, varied: bool) -> None:
    data = json.loads(calibration.read_text())
    rng, n, dt, sigma = np.random.default_rng(1), 20_000, 0.01, np.array([0.02, 0.03, 0.05])
    raw = sigma * rng.standard_normal((n, 3))
    time_ns = (np.arange(n) * dt * 1e9).astype(np.int64)
    rest = Recording("static", "static", None, time_ns, gyroscope=raw)
    data["noise"] = identify_noise([rest])
    calibration.write_text(json.dumps(data))
    matrix = np.array(data["gyroscope"]["matrix"])
    scatter = np.cov(np.radians(raw @ matrix.T), rowvar=False)
    log, out = write_log(tmp_path / "log.mcap", varied=varied), tmp_path / "out.mcap"
    compensate_log(load(calibration), log, out)
    for before, after in zip(decoded(out, "/imu/data")[:9], decoded(out, "/imu/data_calibrated")[:9], strict=True):
        found = np.reshape(after.angular_velocity_covariance, (3, 3))
        np.testing.assert_allclose(found, scatter, rtol=0.05, atol=0.02 * scatter.max())
        np.testing.assert_array_equal(found, found.T)
        assert list(before.linear_acceleration_covariance) == list(after.linear_acceleration_covariance)
        assert list(before.orientation_covariance) == list(after.orientation_covariance)


def test_messages_of_varying_length_are_compensated_alike(calibration: Path, tmp_path: Path) -> None:
    for name, varied in (("alike", False), ("varied", True)):
        write_log(tmp_path / f"{name}.mcap", varied=varied)
        compensate_log(load(calibration), tmp_path / f"{name}.mcap", tmp_path / f"{name}_out.mcap")
    alike, varied = (decoded(tmp_path / f"{n}_out.mcap", "/imu/data_calibrated") for n in ("alike", "varied"))
    assert {m.header.frame_id for m in varied} == {"imu", "another_imu"}
    np.testing.assert_array_equal(numbers(alike), numbers(varied))


def test_a_temperature_topic_is_followed_causally(calibration: Path, tmp_path: Path) -> None:
    log, out = write_log(tmp_path / "log.mcap"), tmp_path / "out.mcap"
    done = compensate_log(load(calibration), log, out)
    assert done.notes == ["11 messages come before the first temperature and are compensated with it"]
    stamps, _, _ = signals()
    force, rate = in_house_units(decoded(out, "/imu/data"))
    ramp = 25.0 + 1e-3 * ((stamps - EPOCH_NS - 100) / 1e7)  # the line through a ramp is the ramp
    expected = load(calibration).apply(force, rate, ramp, smoothing=0.0).gyroscope
    found = np.degrees(numbers(decoded(out, "/imu/data_calibrated"))[1])
    np.testing.assert_allclose(found[50:], expected[50:], atol=1e-6, rtol=0)
    held = 25.0 + 1e-3 * np.maximum((np.arange(COUNT) - 11) // 20 * 20 + 10, 10)
    expected = load(calibration).apply(force, rate, held, smoothing=0.0).gyroscope
    compensate_log(load(calibration), log, out, smoothing=0.0)
    found = np.degrees(numbers(decoded(out, "/imu/data_calibrated"))[1])
    np.testing.assert_allclose(found, expected, atol=1e-12, rtol=0)


def test_a_log_without_the_temperature_that_is_needed_is_refused(calibration: Path, tmp_path: Path) -> None:
    log = write_log(tmp_path / "log.mcap", temperature=False)
    with pytest.raises(InputError, match="effects of temperature, but the log holds no messages of sensor_msgs"):
        compensate_log(load(calibration), log, tmp_path / "out.mcap")
    assert not (tmp_path / "out.mcap").exists()


def test_a_damaged_log_leaves_no_output(calibration: Path, tmp_path: Path) -> None:
    log = write_log(tmp_path / "log.mcap")
    data = bytearray(log.read_bytes())
    data[len(data) // 2] ^= 1
    log.write_bytes(bytes(data))
    with pytest.raises(InputError, match="damaged"):
        main(["--calibration", str(calibration), str(log), "-o", str(tmp_path / "out.mcap")])
    assert sorted(f.name for f in tmp_path.iterdir()) == ["U1.json", "log.mcap"]


def test_a_log_that_is_calibrated_already_is_not_calibrated_again(calibration: Path, tmp_path: Path) -> None:
    log, out = write_log(tmp_path / "log.mcap"), tmp_path / "out.mcap"
    compensate_log(load(calibration), log, out)
    with pytest.raises(InputError, match=r"topics are of type|has a topic /imu/data_calibrated already"):
        compensate_log(load(calibration), out, tmp_path / "twice.mcap")


def test_a_topic_that_this_command_made_is_known_again(calibration: Path, tmp_path: Path) -> None:
    log, out, twice = write_log(tmp_path / "log.mcap"), tmp_path / "out.mcap", tmp_path / "twice.mcap"
    for topic, reason in (("/imu/clean", "was made by this command with unit U1"), (None, "has the name of one")):
        compensate_log(load(calibration), log, out, topic=topic)
        chosen = topic or "/imu/data_calibrated"
        profile = LogProfile(ingest_of({"mcap": {"imu_topic": chosen}}))
        source = out
        if topic is None:
            source = tmp_path / "bare.mcap"  # without the metadata: another program copied the messages
            with source.open("wb") as stream:
                writer = Writer(stream)
                writer.start()
                schema = writer.register_schema(IMU, "ros2msg", DEFINITIONS[IMU].encode())
                channel = writer.register_channel(chosen, "cdr", schema)
                for log_time, publish_time, sequence, data in messages(out)[chosen]:
                    writer.add_message(channel, log_time, data, publish_time, sequence)
                writer.finish()
            calibration.write_text(calibration.read_text().replace('"effects": [{', '"effects": [], "x": [{'))
        compensate_log(load(calibration), source, twice, profile, topic="/imu/twice")
        with twice.open("rb") as stream:
            made = [m.metadata for m in make_reader(stream).iter_metadata() if m.name == "imu_calibration"]
        assert (made[-1]["readings"], made[-1]["topic"]) == (chosen, "/imu/twice")
        assert f"topic {chosen} {reason}" in made[-1]["warnings"]


def test_an_mcap_log_goes_to_a_pipe_as_to_a_file(calibration: Path, tmp_path: Path) -> None:
    log, out, piped = write_log(tmp_path / "log.mcap"), tmp_path / "out.mcap", tmp_path / "piped.mcap"
    main(["--calibration", str(calibration), str(log), "-o", str(out)])
    command = [sys.executable, "-m", "pipeline", "apply", "--calibration", str(calibration), str(log), "-o", "-"]
    piped.write_bytes(subprocess.run(command, capture_output=True, check=True).stdout)
    assert piped.read_bytes() == out.read_bytes()


def test_a_truncated_log_is_compensated_where_the_profile_allows_it(calibration: Path, tmp_path: Path) -> None:
    log, out = write_log(tmp_path / "log.mcap"), tmp_path / "out.mcap"
    log.write_bytes(log.read_bytes()[: log.stat().st_size // 2])
    with pytest.raises(InputError, match="truncated"):
        compensate_log(load(calibration), log, out)
    profile = LogProfile(ingest_of({"mcap": {"allow_truncated": True}}))
    done = compensate_log(load(calibration), log, out, profile)
    assert 0 < done.samples < COUNT
    assert len(messages(out)["/imu/data_calibrated"]) == done.samples
    assert any("truncated" in note for note in done.notes)


def test_readings_mapped_from_json_give_imu_messages(calibration: Path, tmp_path: Path) -> None:
    log, out = tmp_path / "log.mcap", tmp_path / "out.mcap"
    stamps, force, rate = signals()
    with log.open("wb") as stream:
        writer = Writer(stream, chunk_size=20_000)
        writer.start()
        channel = writer.register_channel("/raw", "json", writer.register_schema("raw", "jsonschema", b"{}"))
        for i in range(300):
            values = {"t": i * 10_000, "a": (force[i] * 16384).round().tolist(), "w": rate[i].tolist(), "T": 30.0}
            writer.add_message(channel, int(stamps[i]), json.dumps(values).encode(), int(stamps[i]), i)
        writer.finish()
    fields: dict[str, Any] = {"time": {"field": "t", "unit": "us"}, "temperature": {"field": "T", "unit": "degC"}}
    for i, a in enumerate("xyz"):
        fields[f"accel_{a}"] = {"field": f"a[{i}]", "unit": "counts", "counts_per_unit": 16384.0}
        fields[f"gyro_{a}"] = {"field": f"w[{i}]", "unit": "deg/s"}
    done = compensate_log(load(calibration), log, out, LogProfile(ingest_of({"mcap": {"topics": {"/raw": fields}}})))
    assert (done.samples, done.topic) == (300, "/raw_calibrated")
    assert messages(out)["/raw"] == messages(log)["/raw"]
    found = decoded(out, "/raw_calibrated")
    expected = load(calibration).apply((force[:300] * 16384).round() / 16384, rate[:300], np.full(300, 30.0))
    np.testing.assert_allclose(numbers(found)[0] / G0, expected.accelerometer, atol=1e-12)
    np.testing.assert_allclose(np.degrees(numbers(found)[1]), expected.gyroscope, atol=1e-10)
    assert found[7].header.stamp.nanosec == 70_000_000
    counted = LogProfile(ingest_of({"mcap": {"topics": {"/raw": fields}, "rate_hz": 250.0}}))
    again = compensate_log(load(calibration), log, out, counted)
    assert again.samples == 300
    times = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in decoded(out, "/raw_calibrated")]
    assert times == (int(stamps[0]) + 4_000_000 * np.arange(300)).tolist()


def test_the_sensors_axes_are_turned_to_the_bodys(calibration: Path, tmp_path: Path) -> None:
    log, out = write_log(tmp_path / "log.mcap"), tmp_path / "out.mcap"
    compensate_log(load(calibration), log, out, LogProfile(ingest_of({}), dict.fromkeys(SENSORS, ("-y", "+x", "+z"))))
    force, rate = in_house_units(decoded(out, "/imu/data"))
    turned = np.stack([force[:, 1], -force[:, 0], force[:, 2]], axis=1)  # body x is the reading's y, body y is -x
    expected = load(calibration).apply(turned, rate, np.zeros(COUNT), smoothing=0.0).accelerometer
    np.testing.assert_array_equal(numbers(decoded(out, "/imu/data_calibrated"))[0], expected * G0)
