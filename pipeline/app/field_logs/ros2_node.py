"""Run a ROS 2 node that publishes calibrated ``sensor_msgs/Imu`` messages.

    python -m pipeline.app.field_logs.ros2_node results/demo/calibrations/U1.json --topic /imu/data_raw

It publishes on ``<topic>_calibrated``. As with ``python -m pipeline apply``, a message is a copy of the original with
calibrated vectors and, if the calibration states the noise of a sample, with their covariances; stamp, frame and
orientation are unchanged. Only ``main`` imports ROS: ``MessageCalibrator`` accepts any object with the fields of the
message.
"""

from __future__ import annotations

import argparse
import copy
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from imu_logs.mcap_write import VECTORS
from pipeline.core.errors import PipelineError
from pipeline.core.records import SENSORS, axis_matrix, maps_of_log
from pipeline.physics.compensation import SMOOTHING_S, load, read_calibration
from pipeline.physics.measurement import ExponentialRegression

# Sensor to the field of the message, its covariance, and its unit in g or deg/s.
FIELDS = {sensor: (vector, f"{vector}_covariance", 1.0 / one) for vector, (sensor, _unit, one) in VECTORS.items()}
ABSENT = -1.0  # first element of the covariance of a field without data (sensor_msgs/Imu)
DEPTH = 10  # of the queue of messages, as in the examples of rclpy


class MessageCalibrator:
    """Calibrates Imu messages one by one.

    ``needs_temperature``: whether an effect of the calibration depends on the temperature. Messages before the first
    temperature are then dropped, with one warning. A regression line (memory ``SMOOTHING_S``) extrapolates past
    temperatures. Time counts from the first message. If stamps run backwards (a log is played again), the memory of
    earlier samples is cleared, with a warning.
    """

    def __init__(self, file: Path, warn: Callable[[str], Any], python_effects: Sequence[str] = ()) -> None:
        self.compensation, self.warn = load(file, python_effects), warn
        self.axes = {s: axis_matrix(m) for s, m in maps_of_log(read_calibration(file).get("log") or {}).items()}
        covariances = self.compensation.covariances
        self.covariances = {s: (c / FIELDS[s][2] ** 2).ravel().tolist() for s, c in covariances.items()}
        self.needs_temperature = "temperature" in self.compensation.stream().needs
        self.warmth: float | None = None
        self.waiting = False
        self._start(None)

    def _start(self, first: int | None) -> None:
        """Clear the memory of earlier samples, except the last temperature."""
        self.stream, self.line = self.compensation.stream(0.0), ExponentialRegression(SMOOTHING_S)
        self.first, self.last = first, -1
        if self.warmth is not None:
            self._temperature_at(0.0, self.warmth)

    def _temperature_at(self, time: float, measured: float = float("nan")) -> float:
        return float(self.line.apply(np.array([time]), np.array([measured]))[0])

    def _time(self, message: Any) -> float:  # noqa: ANN401  (any message with a header)
        """Return the stamp of a message, s from the first one."""
        stamp = message.header.stamp
        self.now = stamp.sec * 1_000_000_000 + stamp.nanosec
        self.first = self.now if self.first is None else self.first
        return float((self.now - self.first) / 1e9)

    def temperature(self, message: Any) -> None:  # noqa: ANN401  (sensor_msgs/Temperature, degC)
        """Store a temperature."""
        self.warmth = float(message.temperature)
        self._temperature_at(self._time(message), self.warmth)

    def imu(self, message: Any) -> Any | None:  # noqa: ANN401  (sensor_msgs/Imu)
        """Return the calibrated copy of a message; None if the calibration needs a temperature and has none yet."""
        if self.needs_temperature and self.warmth is None:
            if not self.waiting:
                self.warn("the calibration needs a temperature: messages are dropped until the first one comes")
            self.waiting = True
            return None
        time = self._time(message)
        if self.now < self.last:
            self.warn(f"stamps run backwards by {(self.last - self.now) / 1e9:g} s: earlier samples are ignored")
            self._start(self.now)
            time = 0.0
        self.last = self.now
        readings = {}
        for sensor, (field, covariance, factor) in FIELDS.items():
            if getattr(message, covariance)[0] != ABSENT:
                vector = getattr(message, field)
                readings[sensor] = self.axes[sensor] @ (np.array([vector.x, vector.y, vector.z]) * factor)
        out = copy.deepcopy(message)
        if not readings:
            return out
        warmth = {"temperature": self._temperature_at(time)} if self.needs_temperature else {}
        found = self.stream.apply(**readings, **warmth, time=time)
        for sensor in set(readings) & {s for s in SENSORS if self.compensation.calibration(s) is not None}:
            field, covariance, factor = FIELDS[sensor]
            x, y, z = (getattr(found, sensor) / factor).tolist()
            vector = getattr(out, field)
            vector.x, vector.y, vector.z = x, y, z
            if sensor in self.covariances:
                setattr(out, covariance, self.covariances[sensor].copy())
        return out


def main(argv: list[str] | None = None) -> int:
    """Run the node until ROS stops it."""
    rclpy, messages = import_module("rclpy"), import_module("sensor_msgs.msg")
    sensor_data = import_module("rclpy.qos").qos_profile_sensor_data
    words = sys.argv if argv is None else ["ros2_node", *argv]
    given = _parser().parse_args(import_module("rclpy.utilities").remove_ros_args(words)[1:])
    rclpy.init(args=words)
    node = rclpy.create_node("imu_calibration")
    try:
        calibrator = MessageCalibrator(given.calibration, node.get_logger().warning, given.python_effects)
        publisher = node.create_publisher(messages.Imu, given.output or f"{given.topic}_calibrated", DEPTH)

        def on_imu(message: Any) -> None:  # noqa: ANN401
            calibrated = calibrator.imu(message)
            if calibrated is not None:
                publisher.publish(calibrated)

        node.create_subscription(messages.Imu, given.topic, on_imu, sensor_data)
        if calibrator.needs_temperature:
            node.create_subscription(messages.Temperature, given.temperature_topic, calibrator.temperature, sensor_data)
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    except PipelineError as error:
        node.get_logger().fatal(str(error))
        return 2
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m pipeline.app.field_logs.ros2_node", description=__doc__)
    add = parser.add_argument
    add("calibration", type=Path, help="calibrations/<unit>.json")
    add("--topic", default="/imu/data_raw", help="topic of the readings (default: %(default)s)")
    add("--output", help="topic of the calibrated messages (default: topic of the readings with suffix _calibrated)")
    add("--temperature-topic", default="/imu/temperature", help="sensor_msgs/Temperature (default: %(default)s)")
    add("--python-effect", action="append", default=[], dest="python_effects", metavar="FILE", help="as of apply")
    return parser


if __name__ == "__main__":
    sys.exit(main())
