"""Rotate readings from the sensor's axes to the body's axes.

    body[m_i] = s_i * reading_i,   axis_map[i] = s_i m_i

where axis i of the reading points along the body axis m_i with the sign s_i. Some chips have a left-handed
accelerometer frame and a right-handed gyroscope frame, so that each sensor may have a separate map.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from imu_logs.units import TRIADS
from pipeline.core.errors import ConfigurationError
from pipeline.core.records import AXES

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.core.records import Values
    from pipeline.core.settings import Sensor

STRAIGHT = ("+x", "+y", "+z")


def axis_matrix(axis_map: Sequence[str]) -> Values:
    """Return the (3, 3) signed permutation ``B`` of an axis map, ``body = B @ reading``."""
    entries = [str(a) for a in axis_map]
    if [a for a in entries if a[:1] not in "+-" or a[1:] not in AXES] or sorted(a[1:] for a in entries) != list(AXES):
        raise ConfigurationError(
            f"sensor.axis_map is [{', '.join(entries)}]; it names the body axis that the sensor's x, y and z point "
            "along, each once and with its sign, for example [+y, -x, +z]"
        )
    matrix = np.zeros((3, 3))
    for reading, entry in enumerate(entries):
        matrix[AXES.index(entry[1:]), reading] = 1.0 if entry[0] == "+" else -1.0
    return matrix


def axis_maps(sensor: Sensor | None) -> dict[str, tuple[str, ...]]:
    """Return the axis map of each sensor: its own, else that of the sensor model; straight without a model."""
    return {s: STRAIGHT if sensor is None else tuple(sensor.of(s).axis_map or sensor.axis_map) for s in TRIADS}


def maps_of_log(log: Mapping[str, Any]) -> dict[str, tuple[str, ...]]:
    """Return the axis maps in the section ``log`` of a calibration: one per sensor, in older files one for both."""
    stated = log.get("axis_map") or STRAIGHT
    return {s: tuple(stated[s] if isinstance(stated, dict) else stated) for s in TRIADS}


def in_body_axes(axis_map: Sequence[str], readings: Values) -> Values:
    """Rotate (n, 3) readings to the body's axes; return the same array if the map is straight."""
    if tuple(axis_map) == STRAIGHT:
        return readings
    matrix = axis_matrix(axis_map)
    turned: Values = readings[:, np.argmax(np.abs(matrix), axis=1)] * matrix.sum(axis=1)
    return turned


def map_of_orientation(text: str) -> tuple[str, ...]:
    """Return the axis map of an orientation such as YxZ: body axis j is the reading named by letter j."""
    found = {name.lower(): ("+" if name.isupper() else "-") + body for name, body in zip(text, AXES, strict=True)}
    return tuple(found[axis] for axis in AXES)
