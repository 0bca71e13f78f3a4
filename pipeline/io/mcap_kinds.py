"""Which numbers are read of which messages: by the type of the message, or by the map of fields in the profile."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.io.field_path import ONLY, FieldPath
from pipeline.io.mcap_decode import Wanted
from pipeline.io.mcap_settings import TIME
from pipeline.io.message_definition import short_name
from pipeline.io.ros2 import IMU, JOINT_STATE, QUATERNION_STAMPED, TEMPERATURE
from pipeline.io.units import ACCELEROMETER, ATTITUDE, GYROSCOPE

if TYPE_CHECKING:
    from pipeline.io.mcap_settings import McapFormat

SHORT = {short_name(kind): kind for kind in (IMU, TEMPERATURE, JOINT_STATE, QUATERNION_STAMPED)}
ABSENT = "_absent"  # ends the name of a column that is -1 where a quantity is absent (sensor_msgs/Imu)
VECTORS = {"linear_acceleration": (ACCELEROMETER, "m/s^2"), "angular_velocity": (GYROSCOPE, "rad/s")}
TABLE_UNITS = {"table_angle": "rad", "table_rate": "rad/s"}
HEADER = "header"


def wanted_of(kind: str, settings: McapFormat) -> Wanted:
    """Return what is read of messages of a known type."""
    paths: dict[str, FieldPath] = {}
    if kind == IMU:
        for vector, (channels, _unit) in VECTORS.items():
            paths |= {c: FieldPath.parse(f"{vector}.{a}") for c, a in zip(channels, "xyz", strict=True)}
            paths[vector + ABSENT] = FieldPath.parse(f"{vector}_covariance[0]")
    elif kind == TEMPERATURE:
        paths["temperature"] = FieldPath.parse("temperature")
    elif kind == JOINT_STATE:
        joint = settings.joint or ONLY
        which = "the only joint" if joint == ONLY else f"joint {joint}"
        paths["table_angle"] = FieldPath(f"position of {which}", "position", joint)
        paths["table_rate"] = FieldPath(f"velocity of {which}", "velocity", joint)
    else:
        paths = {c: FieldPath.parse(f"quaternion.{a}") for c, a in zip(ATTITUDE, "wxyz", strict=True)}
    return Wanted(paths, FieldPath.parse("header.stamp") if settings.time_source == HEADER else None)


def wanted_by_map(topic: str, settings: McapFormat) -> Wanted:
    """Return what is read of messages whose fields the profile names."""
    fields = settings.topics[topic]
    time = fields.get(TIME) if settings.time_source == HEADER else None
    paths = {c: f.path for c, f in fields.items() if c != TIME}
    return Wanted(paths, time.path if time else None, time.unit if time else "ns")


def topic_of(kind: str, settings: McapFormat) -> str | None:
    """Return the topic that the profile names for a type; None stands for the only one."""
    return {
        IMU: settings.imu_topic,
        TEMPERATURE: settings.temperature_topic,
        JOINT_STATE: settings.joint_topic,
        QUATERNION_STAMPED: settings.attitude_topic,
    }[kind]
