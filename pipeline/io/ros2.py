"""The ROS 2 messages that hold a calibration log, and their definitions as recorders write them."""

from __future__ import annotations

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
