"""From the sensor's own axes to the body's: a signed permutation.

    body[m_i] = s_i * reading_i,   axis_map[i] = s_i m_i

where

i   : reading axis x, y, z
m_i : body axis that it points along
s_i : ``+`` or ``-``
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import ConfigurationError
from pipeline.formats.units import TRIADS
from pipeline.records import AXES, Note

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from pipeline.formats.channel_table import ChannelTable


def axis_matrix(axis_map: Sequence[str]) -> NDArray[np.float64]:
    """Return the (3, 3) signed permutation ``B`` of an axis map, ``body = B @ reading``.

    Raises
    ------
    ConfigurationError
        If the map does not name each body axis once, with its sign.
    """
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


def to_body_axes(table: ChannelTable, axis_map: Sequence[str]) -> ChannelTable:
    """Turn a table's readings into the body's axes, integers and all.

    A left-handed map is used as it stands, with a note: no rotation does that, only a sensor with such axes.
    """
    matrix = axis_matrix(axis_map)
    if np.array_equal(matrix, np.eye(3)):
        return table
    values, encodings = dict(table.values), dict(table.encodings)
    for triad in TRIADS.values():
        for row, body in enumerate(triad):
            reading = triad[int(np.flatnonzero(matrix[row])[0])]
            sign = matrix[row].sum()
            if reading in table.values:
                values[body] = table.values[reading] if sign > 0 else -table.values[reading]
            encodings.pop(body, None)
            if reading in table.encodings:
                encoding = table.encodings[reading]
                encodings[body] = replace(encoding, scale=sign * encoding.scale)
    notes = table.notes
    if np.linalg.det(matrix) < 0:
        detail = f"sensor.axis_map [{', '.join(map(str, axis_map))}] is left-handed"
        notes = (*notes, Note("N-LEFTHANDED", 1, 0, 0, detail))
    return replace(table, values=values, encodings=encodings, notes=notes)
