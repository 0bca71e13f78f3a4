"""Checks that need all recordings of a unit: their mounting, their reference, and whether they share samples.

Checks of a single file are in ``pipeline.io``. The order is: the reference of the turns (do angle, rate,
gyroscope, gravity and time agree in size), mounting (which direction was up, which way the table turned), then the
reference of held-out motion, then shared samples.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.preprocessing.at_rest import check_static
from pipeline.preprocessing.dead_axes import check_axes
from pipeline.preprocessing.mounting import check_mounting
from pipeline.preprocessing.reference import check_motion, check_turns
from pipeline.preprocessing.shared_rows import check_shared_rows

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.records import Recording


def check_recordings(recordings: Sequence[Recording], settings: Mapping[str, Any]) -> list[Recording]:
    """Return the recordings of a unit, their turns by the convention, with notes on what was found.

    Parameters
    ----------
    recordings : sequence of Recording
        All of one unit, in body axes, not filtered.
    settings : mapping
        The unit's configuration: sections ``procedure``, ``sensor``, ``table`` and ``ingest``.

    Raises
    ------
    InputError
        If the recordings contradict each other, or the table's log contradicts itself or gravity.
    """
    check_shared_rows(recordings)
    check_axes(recordings)
    turns, delays = check_turns(check_static(recordings, settings), settings)
    return check_motion(check_mounting(turns, settings), delays, settings)
