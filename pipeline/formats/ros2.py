"""The ROS 2 messages that hold a calibration log: their definitions, and the length of one as CDR.

CDR aligns a number to its own size, counted from after the 4 bytes of the encapsulation header. The decoder accepts
bytes that are left over and bytes of another type; the length of a message does not lie:

    Imu                4 + up8(12 + L) + 37 * 8
    Temperature        4 + up8(12 + L) +  2 * 8
    QuaternionStamped  4 + up8(12 + L) +  4 * 8

where

L      : bytes of the frame's name with its closing zero
up8(n) : n rounded up to a multiple of 8
12     : seconds, nanoseconds and length of the name
"""

from __future__ import annotations

from typing import Any

IMU = "sensor_msgs/msg/Imu"
TEMPERATURE = "sensor_msgs/msg/Temperature"
JOINT_STATE = "sensor_msgs/msg/JointState"
QUATERNION_STAMPED = "geometry_msgs/msg/QuaternionStamped"

_RULE = "=" * 80
_HEADER = f"""{_RULE}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{_RULE}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
_QUATERNION = f"""{_RULE}
MSG: geometry_msgs/Quaternion
float64 x 0
float64 y 0
float64 z 0
float64 w 1
"""
_VECTOR = f"""{_RULE}
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
"""
DEFINITIONS = {
    IMU: f"""std_msgs/Header header
geometry_msgs/Quaternion orientation
float64[9] orientation_covariance
geometry_msgs/Vector3 angular_velocity
float64[9] angular_velocity_covariance
geometry_msgs/Vector3 linear_acceleration
float64[9] linear_acceleration_covariance
{_HEADER}{_QUATERNION}{_VECTOR}""",
    TEMPERATURE: f"""std_msgs/Header header
float64 temperature
float64 variance
{_HEADER}""",
    JOINT_STATE: f"""std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
{_HEADER}""",
    QUATERNION_STAMPED: f"""std_msgs/Header header
geometry_msgs/Quaternion quaternion
{_HEADER}{_QUATERNION}""",
}
DOUBLES = {IMU: 37, TEMPERATURE: 2, QUATERNION_STAMPED: 4}


def encoded_length(kind: str, message: Any) -> int:  # noqa: ANN401  (made by the decoder from the file's definition)
    """Return how many bytes a message takes."""
    size = 12 + _length(message.header.frame_id)
    if kind != JOINT_STATE:
        return 4 + _up(size, 8) + 8 * DOUBLES[kind]
    size = _up(size, 4) + 4
    for name in message.name:
        size = _up(size, 4) + 4 + _length(name)
    for numbers in (message.position, message.velocity, message.effort):
        size = _up(size, 4) + 4
        if len(numbers):
            size = _up(size, 8) + 8 * len(numbers)
    return 4 + size


def _length(text: str) -> int:
    return len(text.encode()) + 1


def _up(size: int, multiple: int) -> int:
    return -(-size // multiple) * multiple
