"""The ROS 2 node, with recorded messages and a stand-in for rclpy, publishes what apply writes."""

from __future__ import annotations

import subprocess
import sys
from types import ModuleType, SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from pipeline.app.commands.apply import main as apply_main
from pipeline.app.field_logs import ros2_node
from pipeline.app.field_logs.ros2_node import MessageCalibrator
from pipeline.core.files import write_json
from pipeline.core.records import Coefficient, FittedEffect, Recording, SensorCalibration
from pipeline.estimation.noise_identification import identify_noise
from pipeline.ingest.arrow import write_recording

if TYPE_CHECKING:
    from pathlib import Path

SAMPLES = 400
AXES = ["-y", "+x", "+z"]


@pytest.fixture
def calibration(tmp_path: Path) -> Path:
    values = {"b_T_x": 0.1, "b_T_y": 0.2, "b_T_z": -0.1}
    warm = FittedEffect("bias_temperature", {k: Coefficient(v, "deg/s/degC") for k, v in values.items()})
    names = [f"G_{a}{b}" for a in "xyz" for b in "xyz"]
    G = FittedEffect("g_sensitivity", {n: Coefficient(0.01 * i, "deg/s/g") for i, n in enumerate(names)})
    parts = {
        "accelerometer": SensorCalibration(
            "accelerometer", np.array([0.02, -0.01, 0.03]), np.diag([1.01, 0.99, 1.02]) + 0.003
        ).to_json(),
        "gyroscope": SensorCalibration(
            "gyroscope", np.array([1.0, -2.0, 0.5]), np.eye(3) + 0.01, effects=(warm, G)
        ).to_json(),
    }
    document = {"unit": "U1", "schema_version": 1, "status": "ok", "error": None, **parts}
    document["log"] = {"ingest": {}, "axis_map": {"accelerometer": AXES, "gyroscope": AXES}}
    time, noise = np.arange(500, dtype=np.int64) * 2_000_000, np.random.default_rng(1).normal(0, 0.1, (500, 3))
    rest = Recording("static", "static", None, time, gyroscope=noise)
    document["noise"] = identify_noise([rest])
    write_json(tmp_path / "U1.json", document)
    return tmp_path / "U1.json"


@pytest.fixture
def log(tmp_path: Path) -> Path:
    rng = np.random.default_rng(4)
    time = (2_000_000 * np.arange(SAMPLES)).astype(np.int64) + 10**18
    force, rate = rng.normal(0, 1, (SAMPLES, 3)), rng.normal(0, 50, (SAMPLES, 3))
    write_recording(
        tmp_path / "drive.mcap", Recording("drive", "rests", None, time, force, rate, 30 + 1e-3 * np.arange(SAMPLES))
    )
    return tmp_path / "drive.mcap"


def plain(value: Any) -> Any:
    """Return a message of the decoder, which cannot be copied, as the objects that rclpy gives."""
    if isinstance(value, (list, tuple)):
        return [plain(each) for each in value]
    fields = getattr(type(value), "__slots__", None)
    return SimpleNamespace(**{f.lstrip("_"): plain(getattr(value, f)) for f in fields}) if fields else value


def messages(log: Path, *topics: str) -> list[tuple[str, Any]]:
    with log.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        return [(channel.topic, plain(m)) for _, channel, _, m in reader.iter_decoded_messages(topics=topics or None)]


class Ros:
    """A stand-in for rclpy that plays recorded messages to the subscriptions of a node."""

    def __init__(self, played: list[tuple[str, Any]]) -> None:
        self.played, self.subscriptions, self.published, self.warnings = played, {}, [], []  # type: ignore[var-annotated]

    def modules(self) -> dict[str, ModuleType]:
        def module(name: str, **content: Any) -> ModuleType:
            made = ModuleType(name)
            made.__dict__.update(content)
            return made

        logger = SimpleNamespace(warning=self.warnings.append, fatal=self.warnings.append)
        node = SimpleNamespace(
            get_logger=lambda: logger,
            create_subscription=lambda _type, topic, callback, _qos: self.subscriptions.update({topic: callback}),
            create_publisher=lambda _type, topic, _depth: SimpleNamespace(
                publish=lambda message: self.published.append((topic, message))
            ),
            destroy_node=lambda: None,
        )
        rclpy = module(
            "rclpy", init=lambda **_: None, create_node=lambda _: node, spin=self.spin, try_shutdown=lambda: None
        )
        return {
            "rclpy": rclpy,
            "rclpy.qos": module("rclpy.qos", qos_profile_sensor_data=10),
            "rclpy.utilities": module(
                "rclpy.utilities", remove_ros_args=lambda words: [w for w in words if w != "--ros-args"]
            ),
            "sensor_msgs": module("sensor_msgs"),
            "sensor_msgs.msg": module("sensor_msgs.msg", Imu=object, Temperature=object),
        }

    def spin(self, _node: Any) -> None:
        for topic, message in self.played:
            if topic in self.subscriptions:
                self.subscriptions[topic](message)


def run(monkeypatch: pytest.MonkeyPatch, calibration: Path, played: list[tuple[str, Any]], *options: str) -> Ros:
    ros = Ros(played)
    for name, module in ros.modules().items():
        monkeypatch.setitem(sys.modules, name, module)
    assert ros2_node.main([str(calibration), *options, "--ros-args"]) == 0
    return ros


def vectors(message: Any) -> list[float]:
    of = [getattr(getattr(message, v), a) for v in ("linear_acceleration", "angular_velocity") for a in "xyz"]
    return [*of, *message.linear_acceleration_covariance, *message.angular_velocity_covariance]


def test_the_node_publishes_what_apply_writes(
    calibration: Path, log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    played = messages(log)
    imu_topic, warm_topic = "/imu/data", "/imu/temperature"
    played.insert(0, next(each for each in played if each[0] == warm_topic))  # apply gives it to the first message too
    ros = run(monkeypatch, calibration, played, "--topic", imu_topic, "--temperature-topic", warm_topic)
    assert {topic for topic, _ in ros.published} == {f"{imu_topic}_calibrated"}
    assert (
        apply_main(["--calibration", str(calibration), str(log), "-o", str(tmp_path / "out.mcap"), "--ingest", "mcap"])
        == 0
    )
    expected = {
        (m.header.stamp.sec, m.header.stamp.nanosec): vectors(m)
        for _, m in messages(tmp_path / "out.mcap", f"{imu_topic}_calibrated")
    }
    assert len(ros.published) == len(expected) == SAMPLES
    variance = ros.published[0][1].angular_velocity_covariance[0]
    assert variance == pytest.approx(np.radians(0.1) ** 2, rel=0.2)  # 500 samples, times the matrix
    for _, message in ros.published:
        stamp = message.header.stamp.sec, message.header.stamp.nanosec
        np.testing.assert_allclose(vectors(message), expected[stamp], rtol=0, atol=1e-12)


def test_messages_wait_for_a_temperature_and_a_log_that_is_played_again_starts_anew(
    calibration: Path, log: Path
) -> None:
    told: list[str] = []
    calibrator = MessageCalibrator(calibration, told.append)
    readings = [m for _, m in messages(log) if hasattr(m, "linear_acceleration")]
    assert calibrator.imu(readings[0]) is None
    assert calibrator.imu(readings[1]) is None
    assert told == ["the calibration needs a temperature: messages are dropped until the first one comes"]
    calibrator.temperature(SimpleNamespace(header=readings[0].header, temperature=31.0))
    first = [vectors(calibrator.imu(m)) for m in readings[:5]]
    again = [vectors(calibrator.imu(m)) for m in readings[:5]]
    assert first == again
    assert "stamps run backwards by 0.008 s" in told[-1]


def test_a_message_without_a_gyroscope_keeps_its_field(calibration: Path, log: Path) -> None:
    calibrator = MessageCalibrator(calibration, print)
    readings = [m for _, m in messages(log) if hasattr(m, "linear_acceleration")][:1]
    calibrator.temperature(SimpleNamespace(header=readings[0].header, temperature=31.0))
    (message,) = readings
    message.angular_velocity_covariance[0] = message.linear_acceleration_covariance[0] = -1.0
    before = vectors(message)
    assert vectors(calibrator.imu(message)) == before


def test_the_module_needs_no_ros(tmp_path: Path) -> None:
    code = "import sys, pipeline.app.field_logs.ros2_node; assert not {'rclpy', 'sensor_msgs'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=True)
