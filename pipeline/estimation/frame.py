"""Compute the uncertainty of the body frame of a calibration against the case of the unit.

Turn axes, faces and zeros define the frame in which bias, matrix and U hold. About each axis of the body

    on a table  U^2 = k^2 (s^2 / m + l^2),    s^2 = max(s_stated^2, sum_j (r_j - r)^2 / (m - 1))
    by faces    U^2 = k^2 / (4 / s_f^2 + 2 / s_a^2)

where s is the standard deviation of the unit's rotation in its seat and r_j the fitted rotation in mounting j of m, of
which the frame is the mean; l the levelling of the table, with which its zero is set; s_f that of a face, four of which
show a rotation about one axis, and s_a that of the axis of stated turns, two of which do. k is that of a normal
distribution for 95 %. Without a stated seat, and without fitted mountings, nothing shows how the case lies on a table.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.core.records import AXES, coverage_factor
from pipeline.estimation.candidates import MOUNTING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.core.records import Recording, SensorCalibration, Values
    from pipeline.core.settings import Settings

NORMAL_FACTOR = float(coverage_factor(np.inf))
FACES_ABOUT, TURNS_ABOUT = 4, 2  # faces, and axes of turns, that show a rotation about one axis


def frame_uncertainty(
    calibration: SensorCalibration, recordings: Sequence[Recording], settings: Settings
) -> list[float] | None:
    """Return the expanded uncertainty of the frame about x, y and z of the body, deg; None where nothing is stated."""
    table, procedure = settings.table, settings.procedure
    if table.motion == "none":
        if procedure.faces is None:
            return None
        precision = FACES_ABOUT / procedure.faces.accuracy_deg**2
        if procedure.turns is not None and calibration.sensor == "gyroscope":
            precision += TURNS_ABOUT / procedure.turns.axis_accuracy_deg**2
        return [NORMAL_FACTOR / float(np.sqrt(precision))] * len(AXES)
    fitted = next((e.values.reshape(-1, 3) for e in calibration.effects if e.name == MOUNTING), np.zeros((0, 3)))
    if table.seat_deg is None and len(fitted) < 2:
        return None
    count = len(fitted) or _mountings(recordings, calibration.sensor)
    seats: Values = np.full(3, table.seat_deg or 0.0)
    if len(fitted) > 1:
        seats = np.maximum(seats, np.std(fitted, axis=0, ddof=1))
    return [float(u) for u in NORMAL_FACTOR * np.hypot(seats / np.sqrt(count), table.levelling_deg or 0.0)]


def _mountings(recordings: Sequence[Recording], sensor: str) -> int:
    """Return the number of mountings in the turns of a sensor: its setups, or recordings without one."""
    return max(len({r.setup or r.name for r in recordings if r.role == sensor and r.axis is not None}), 1)
