"""Axes that stay where the motion requires them to vary, and axes that are copies of another one.

In a turn by half a turn or more about a level axis each of the axes across it goes through gravity's whole range once
at least, so that the middle nine tenths of its readings span more than 0.2 of it; the gyroscope's axis spans the
table's rate. Percentiles are not moved by single glitches.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.preprocessing.evidence import LEAST_RATE_DPS, axis_index, quantiles, rate_of_turn, refusal
from pipeline.records import AXES, SENSORS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from pipeline.records import Recording

    Array = NDArray[np.float64]

HALF_TURN_DEG = 180.0
SPANNED = 0.2  # of what the motion requires
INNER = (0.05, 0.95)  # shares of the samples
COPIED = 0.5  # share of the changes of an axis that are another's to the last digit
LEVEL_G = 0.5  # of the axes across a turn together, from which gravity turns in the body
FEWEST = 32
SHORT = {"accelerometer": "accel", "gyroscope": "gyro"}


def check_axes(recordings: Sequence[Recording]) -> None:
    """Refuse an axis that stays while the table turns, or that is a copy of another.

    Parameters
    ----------
    recordings : sequence of Recording
        All of a unit.

    Raises
    ------
    IngestError
        Naming file and channel.
    """
    for recording in recordings:
        if recording.samples < FEWEST:
            continue
        _check_copies(recording)
        if recording.axis is not None:
            _check_spans(recording)


def _check_copies(recording: Recording) -> None:
    for sensor in SENSORS:
        reading = recording.reading(sensor)
        if reading is None:
            continue
        for one, two in ((0, 1), (0, 2), (1, 2)):
            a, b = reading[:, one], reading[:, two]
            changing = a[1:] != a[:-1]
            if changing.sum() < FEWEST:
                continue
            for sign, what in ((1.0, "a copy"), (-1.0, "the negative")):
                same = (a == sign * b)[1:][changing]
                if same.mean() > COPIED:
                    names = [f"{SHORT[sensor]}_{AXES[i]}" for i in (one, two)]
                    raise refusal(
                        recording,
                        "copied_axis",
                        f"{names[1]} is {what} of {names[0]} in {same.mean():.0%} of the rows in which it changes",
                        "correct the columns in the ingest profile",
                    )


def _check_spans(recording: Recording) -> None:
    rate = rate_of_turn(recording)
    axis = axis_index(recording)
    if rate is None:
        return
    if recording.gyroscope is not None:
        required, spanned = _span(rate), _span(recording.gyroscope[:, axis])
        if required > LEAST_RATE_DPS and spanned < SPANNED * required:
            seen = np.array([_span(recording.gyroscope[:, i]) for i in range(3)])
            if (
                seen.max() < SPANNED * required or seen.argmax() == axis
            ):  # else the axis is another: the mounting's matter
                _refuse(recording, f"gyro_{AXES[axis]}", spanned, required, "deg/s")
    if recording.accelerometer is None or _turned(recording, rate) < HALF_TURN_DEG:
        return
    across = [(axis + 1) % 3, (axis + 2) % 3]
    spans = [_span(recording.accelerometer[:, i]) for i in across]
    if max(spans) < LEVEL_G or _span(recording.accelerometer[:, axis]) > LEVEL_G:
        return  # a turn about the vertical, or about another axis: the mounting's matter
    for i, spanned in zip(across, spans, strict=True):
        if spanned < SPANNED:
            _refuse(recording, f"accel_{AXES[i]}", spanned, 1.0, "g")


def _turned(recording: Recording, rate: Array) -> float:
    if recording.table_angle is not None:
        return float(np.ptp(recording.table_angle))
    turned = np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(recording.time))
    return float(np.ptp(turned))


def _span(values: Array) -> float:
    low, high = quantiles(values, *INNER)
    return float(high - low)


def _refuse(recording: Recording, channel: str, spanned: float, required: float, unit: str) -> None:
    raise refusal(
        recording,
        "stuck",
        f"{channel} stays within {spanned:.3g} {unit} in nine tenths of the rows, while the table's motion about "
        f"{recording.axis} makes it vary by {required:.3g} {unit}",
        "is the column right, and the sensor's axis alive?",
    )
