"""From the sensor's own axes to the body's: a signed permutation.

    body[m_i] = s_i * reading_i,   axis_map[i] = s_i m_i

where

i   : reading axis x, y, z
m_i : body axis that it points along
s_i : ``+`` or ``-``

Each sensor of a unit may have a map of its own: some chips have a left-handed accelerometer frame beside a right-handed
gyroscope frame.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import ConfigurationError
from pipeline.io.units import TRIADS
from pipeline.records import AXES, Note

STRAIGHT = ("+x", "+y", "+z")

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from pipeline.io.channel_table import ChannelTable


def axis_matrix(axis_map: Sequence[str]) -> NDArray[np.float64]:
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


def axis_maps(sensor: Mapping[str, Any]) -> dict[str, tuple[str, ...]]:
    """Return the axis map of each sensor by the section ``sensor``: its own, else that of the unit, else straight."""
    common = sensor.get("axis_map") or STRAIGHT
    return {s: tuple((sensor.get(s) or {}).get("axis_map") or common) for s in TRIADS}


def maps_of_log(log: Mapping[str, Any]) -> dict[str, tuple[str, ...]]:
    """Return the axis maps in the section ``log`` of a calibration: one a sensor, in older files one for both."""
    stated = log.get("axis_map") or STRAIGHT
    return {s: tuple(stated[s] if isinstance(stated, dict) else stated) for s in TRIADS}


def to_body_axes(table: ChannelTable, maps: Mapping[str, Sequence[str]]) -> ChannelTable:
    """Rotate readings and their counts into the body's axes, by the axis map of each sensor.

    A left-handed map is used as it stands, with a note: no rotation does that, only a sensor with such axes.
    """
    values, encodings, notes = dict(table.values), dict(table.encodings), table.notes
    matrices = {sensor: axis_matrix(maps[sensor]) for sensor in TRIADS}
    if all(np.array_equal(m, np.eye(3)) for m in matrices.values()):
        return table
    for sensor, triad in TRIADS.items():
        matrix = matrices[sensor]
        for row, body in enumerate(triad):
            reading = triad[int(np.flatnonzero(matrix[row])[0])]
            sign = matrix[row].sum()
            if reading in table.values:
                values[body] = table.values[reading] if sign > 0 else -table.values[reading]
            encodings.pop(body, None)
            if reading in table.encodings:
                encoding = table.encodings[reading]
                encodings[body] = replace(encoding, scale=sign * encoding.scale)
    left = [s for s, m in matrices.items() if np.linalg.det(m) < 0 and TRIADS[s][0] in table.values]
    if left:
        detail = ", ".join(f"[{', '.join(maps[s])}] of the {s}" for s in left)
        notes = (*notes, Note("N-LEFTHANDED", len(left), 0, 0, f"left-handed axis map: {detail}"))
    return replace(table, values=values, encodings=encodings, notes=notes)
