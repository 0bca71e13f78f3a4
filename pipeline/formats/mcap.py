"""ROS 2 logs in MCAP files to channels.

    specific force [g]   = linear_acceleration [m/s^2] / 9.80665
    angular rate [deg/s] = angular_velocity [rad/s] * 180/pi

Times are the stamps in the messages' headers, integer ns: the sensor's clock, not the recorder's. The rows are the Imu
messages; table messages belong to them by equal stamps, and a temperature with stamps of its own is interpolated. A
covariance whose first element is -1 says that the quantity is absent (sensor_msgs/Imu).
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from mcap_ros2.decoder import DecoderFactory

from pipeline.errors import InputError
from pipeline.formats.channel_table import ChannelTable
from pipeline.formats.mcap_container import read_container
from pipeline.formats.ros2 import IMU, JOINT_STATE, QUATERNION_STAMPED, TEMPERATURE, encoded_length
from pipeline.formats.text_file import read_bytes
from pipeline.formats.units import ACCELEROMETER, ATTITUDE, GYROSCOPE, to_house_unit
from pipeline.records import Note

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from pipeline.formats.mcap_container import Container
    from pipeline.formats.settings import McapFormat

MAGIC = b"\x89MCAP0\r\n"


@dataclass(frozen=True)
class Series:
    """The decoded messages of one topic.

    Attributes
    ----------
    topic : str
    time_ns : (n,) array of int64, ns
        Stamps of the headers, increasing.
    messages : list
    """

    topic: str
    time_ns: NDArray[np.int64]
    messages: list[Any]


def read_mcap(path: Path, settings: McapFormat) -> ChannelTable:
    """Read a ROS 2 log.

    Raises
    ------
    InputError
        If the file is damaged or incomplete, has no or several Imu topics, or its stamps do not increase.
    """
    data, where = read_bytes(path), str(path)
    if not data.startswith(MAGIC):
        start = data[:8].decode("ascii", "replace")
        raise InputError(f"not an MCAP file: it starts with {start!r}; a text log needs the suffix .csv", where)
    container = read_container(data, where)
    notes: list[Note] = []
    if not container.verified:
        notes.append(Note("N-NOCRC", 1, 0, 0, "written without checksums: damage cannot be told from data"))
    imu = _series(container, IMU, settings.imu_topic, where, required=True)
    assert imu is not None  # noqa: S101  (required)
    values = _imu_values(imu, where)
    used = {imu.topic}
    for kind, topic, read in (
        (TEMPERATURE, settings.temperature_topic, _temperature),
        (JOINT_STATE, settings.joint_topic, _joint_reader(settings.joint)),
        (QUATERNION_STAMPED, settings.attitude_topic, _attitude),
    ):
        series = _series(container, kind, topic, where, required=topic is not None)
        if series is not None:
            used.add(series.topic)
            values |= read(series, imu, where, notes)
    _check_finite(values, imu, where)
    ignored = sorted({c.topic for c in container.channels.values()} - used)
    if ignored:
        notes.append(Note("N-IGNORED", len(ignored), 0, 0, f"topics not used: {', '.join(ignored)}"))
    source = {"file": where, "sha256": hashlib.sha256(data).hexdigest(), "rows": len(imu.messages)}
    return ChannelTable(where, imu.time_ns, values, source, lambda _row: 0, notes=tuple(notes))


def _series(container: Container, kind: str, topic: str | None, path: str, *, required: bool) -> Series | None:
    """Decode the messages of the named topic, or of the only topic of a type."""
    kinds = {c.topic: getattr(container.schemas.get(c.schema_id), "name", "?") for c in container.channels.values()}
    topics = [t for t, k in kinds.items() if k == kind and topic in (None, t)]
    if not topics and required:
        found = ", ".join(f"{t} ({k})" for t, k in kinds.items()) or "no topics"
        raise InputError(f"no topic {topic or ''} of type {kind}; the file has {found}".replace("  ", " "), path)
    if len(topics) > 1:
        raise InputError(
            f"{len(topics)} topics are of type {kind}: {', '.join(topics)}; choose one in ingest.mcap", path
        )
    messages = [m for t in topics for m in _decoded(container, t, kind, path)]
    if not messages:
        if required:
            raise InputError(f"topic {topics[0]} holds no messages", path)
        return None
    return Series(topics[0], _stamps(messages, topics[0], path), messages)


def _decoded(container: Container, topic: str, kind: str, path: str) -> list[Any]:
    factory = DecoderFactory()
    out: list[Any] = []
    for channel in container.channels.values():
        if channel.topic != topic:
            continue
        schema = container.schemas[channel.schema_id]
        try:
            decoder = factory.decoder_for(channel.message_encoding, schema)
        except Exception as error:
            raise InputError(f"topic {topic}: its message definition cannot be read ({error})", path) from error
        if decoder is None:
            raise InputError(
                f"topic {topic} is encoded as {channel.message_encoding!r} with {schema.encoding!r} definitions; "
                "cdr with ros2msg is supported",
                path,
            )
        for message in container.messages.get(channel.id, []):
            out.append(_decode(decoder, message.data, kind, f"message {len(out) + 1} on {topic}", path))
    return out


def _decode(decoder: Callable[[bytes], Any], data: bytes, kind: str, which: str, path: str) -> Any:  # noqa: ANN401
    """Decode one message and see that it has the length that its content needs."""
    try:
        message = decoder(data)
        needed = encoded_length(kind, message)
    except Exception as error:
        raise InputError(f"{which} ({len(data)} bytes) is no {kind} ({type(error).__name__} {error})", path) from error
    if len(data) != needed:
        raise InputError(f"{which} has {len(data)} bytes where {kind} needs {needed}: damaged, or another type", path)
    return message


def _stamps(messages: Sequence[Any], topic: str, path: str) -> NDArray[np.int64]:
    stamps = np.array([(m.header.stamp.sec, m.header.stamp.nanosec) for m in messages], np.int64)
    if not stamps.any() and len(stamps) > 1:
        raise InputError(f"topic {topic}: all header stamps are 0; the sensor's own times are needed", path)
    time: NDArray[np.int64] = stamps[:, 0] * 1_000_000_000 + stamps[:, 1]
    back = np.flatnonzero(np.diff(time) <= 0)
    if back.size:
        row = int(back[0]) + 1
        raise InputError(
            f"message {row + 1} on {topic}: header stamp {time[row] / 1e9:.9g} s after {time[row - 1] / 1e9:.9g} s "
            f"({back.size} such messages); stamps have to increase",
            path,
        )
    return time


def _imu_values(imu: Series, path: str) -> dict[str, NDArray[np.float64]]:
    values: dict[str, NDArray[np.float64]] = {}
    for channels, name, unit in (
        (ACCELEROMETER, "linear_acceleration", "m/s^2"),
        (GYROSCOPE, "angular_velocity", "rad/s"),
    ):
        absent = np.array([getattr(m, f"{name}_covariance")[0] == -1.0 for m in imu.messages])
        if absent.all():
            continue
        if absent.any():
            row = int(np.argmax(absent != absent[0])) + 1
            raise InputError(
                f"{name} is absent (covariance -1) in some messages on {imu.topic}, see message {row}", path
            )
        vectors = [getattr(m, name) for m in imu.messages]
        numbers = np.array([(v.x, v.y, v.z) for v in vectors])
        values |= {c: to_house_unit(c, np.ascontiguousarray(numbers[:, i]), unit) for i, c in enumerate(channels)}
    if not values:
        raise InputError(f"topic {imu.topic} says that both quantities are absent (covariance -1)", path)
    return values


def _temperature(series: Series, imu: Series, _path: str, notes: list[Note]) -> dict[str, NDArray[np.float64]]:
    degrees = np.array([m.temperature for m in series.messages])
    if np.array_equal(series.time_ns, imu.time_ns):
        return {"temperature": degrees}
    detail = f"temperature of {len(degrees)} messages with stamps of their own, interpolated, held at the ends"
    notes.append(Note("N-INTERPOLATED", len(imu.messages), 0, 0, detail))
    origin = imu.time_ns[0]
    return {"temperature": np.interp(imu.time_ns - origin, series.time_ns - origin, degrees)}


def _joint_reader(joint: str | None) -> Callable[..., dict[str, NDArray[np.float64]]]:
    """Return the reader of the table's encoder, the joint of that name or the only one."""

    def read(series: Series, imu: Series, path: str, notes: list[Note]) -> dict[str, NDArray[np.float64]]:
        messages = _matched(series, imu, path, notes)
        names = list(messages[0].name)
        if joint is None and len(names) != 1:
            raise InputError(f"topic {series.topic} has the joints {', '.join(names)}; set ingest.mcap.joint", path)
        name = joint or names[0]
        values = {}
        for channel, field, unit in (("table_angle", "position", "rad"), ("table_rate", "velocity", "rad/s")):
            numbers = [_of_joint(m, name, field, series.topic, path) for m in messages]
            given = [v for v in numbers if v is not None]
            if given and len(given) != len(numbers):
                raise InputError(f"{field} of joint {name} is empty in some messages on {series.topic}", path)
            if given:
                values[channel] = to_house_unit(channel, np.array(given), unit)
        return values

    return read


def _of_joint(message: Any, name: str, field: str, topic: str, path: str) -> float | None:  # noqa: ANN401
    numbers = getattr(message, field)
    if name not in message.name:
        raise InputError(f"joint {name} is not on {topic}, which has {', '.join(message.name)}", path)
    if len(numbers) == 0:
        return None
    if len(numbers) != len(message.name):
        raise InputError(f"{topic} has {len(numbers)} numbers of {field} for {len(message.name)} joints", path)
    return float(numbers[message.name.index(name)])


def _attitude(series: Series, imu: Series, path: str, notes: list[Note]) -> dict[str, NDArray[np.float64]]:
    quaternions = [m.quaternion for m in _matched(series, imu, path, notes)]
    numbers = np.array([(q.w, q.x, q.y, q.z) for q in quaternions])
    return {c: np.ascontiguousarray(numbers[:, i]) for i, c in enumerate(ATTITUDE)}


def _matched(series: Series, imu: Series, path: str, notes: list[Note]) -> list[Any]:
    """Return the messages with the stamps of the Imu messages."""
    index = np.minimum(np.searchsorted(series.time_ns, imu.time_ns), len(series.time_ns) - 1)
    unmatched = np.flatnonzero(series.time_ns[index] != imu.time_ns)
    if unmatched.size:
        raise InputError(
            f"{unmatched.size} of {len(index)} Imu messages have no message of equal stamp on {series.topic}, the "
            f"first at {imu.time_ns[unmatched[0]] / 1e9:.9g} s; the table has to be logged with the Imu's stamps",
            path,
        )
    extra = len(series.time_ns) - len(index)
    if extra:
        notes.append(Note("N-UNMATCHED", extra, 0, 0, f"messages on {series.topic} between the Imu's were not used"))
    return [series.messages[i] for i in index]


def _check_finite(values: dict[str, NDArray[np.float64]], imu: Series, path: str) -> None:
    for channel, numbers in values.items():
        wrong = np.flatnonzero(~np.isfinite(numbers))
        if wrong.size:
            row = int(wrong[0])
            raise InputError(
                f"{channel} is {numbers[row]} at {imu.time_ns[row] / 1e9:.9g} s ({wrong.size} such samples); finite "
                "numbers are expected",
                path,
            )
