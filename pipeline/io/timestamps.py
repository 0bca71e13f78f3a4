"""Convert timestamps of messages to integer nanoseconds, and check their values and order.

A double resolves a time since 1970 to 238 ns only. So timestamps are not converted to doubles. If the log stores
doubles, whole seconds and fraction are converted separately, without further loss.

Accelerometer and gyroscope may be in separate messages, with different times and rates of one clock. The rows are then
the messages of the slower sensor, at t_k. The faster sensor is averaged over the interval about each row:

    mean_k = (A(e_{k+1}) - A(e_k)) / (e_{k+1} - e_k),   A = integral of the reading,   e_k = (t_{k-1} + t_k) / 2

The reading is interpolated linearly between two messages. Unlike interpolation, an average preserves the integral and
the density of white noise. It is a low-pass filter over the slower sensor's interval.
"""

from __future__ import annotations

from decimal import Decimal
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import IngestError
from pipeline.io.units import SECOND_NS, SINCE_1970_NS, UNITS
from pipeline.records import Note

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from pipeline.records import Index, Integers, Mask, Values


MAX_NANOSECONDS = np.iinfo(np.int64).max

YEAR_2000, YEAR_2100 = 946_684_800 * SECOND_NS, 4_102_444_800 * SECOND_NS
MIN_MESSAGES = 3  # messages of a sensor: a row has a neighbour on both sides
MAX_GAP_INTERVALS = 1.5  # times the median interval, as of a recording's rows
MAX_FLOAT_RESOLUTION = 0.01  # of the median interval: coarsest resolution of a time in floating-point numbers


def nanoseconds(moment: tuple[int, int] | float | Decimal, unit: str) -> int:
    """Convert one time to ns, from (seconds, nanoseconds) or from a number in a unit."""
    if isinstance(moment, tuple):
        if not 0 <= moment[1] < SECOND_NS:
            raise ValueError(f"its stamp has {moment[1]} nanoseconds; 0 to 999999999 are possible")
        found = moment[0] * SECOND_NS + moment[1]
    else:
        found = int((Decimal(moment) * int(UNITS["time"][unit][0])).to_integral_value())
    if abs(found) > MAX_NANOSECONDS:
        raise ValueError(f"its stamp of {found} ns is out of range")
    return found


def of_pair(seconds: NDArray[Any], nanos: NDArray[Any]) -> Integers:
    """Convert times in seconds and nanoseconds to ns."""
    parts = nanos.astype(np.int64)
    wrong = np.flatnonzero((parts < 0) | (parts >= SECOND_NS))
    if wrong.size:
        row = int(wrong[0])
        raise ValueError(f"the stamp {row + 1} messages on has {parts[row]} nanoseconds; 0 to 999999999 are possible")
    whole: Integers = seconds.astype(np.int64) * SECOND_NS + parts
    return whole


def of_number(values: NDArray[Any], unit: str) -> Integers:
    """Convert times in a unit to ns."""
    scale = int(UNITS["time"][unit][0])
    if values.dtype.kind in "iu":
        if values.size and int(max(values.max(), -int(values.min()))) > MAX_NANOSECONDS // scale:
            raise ValueError(f"a stamp of {values.max()} {unit} is out of range")
        counted: Integers = values.astype(np.int64) * scale
        return counted
    numbers = values.astype(np.float64)
    if not (np.abs(numbers) < MAX_NANOSECONDS / scale).all():
        raise ValueError("a stamp is not finite, or out of range")
    whole = np.floor(numbers)
    parts: Integers = whole.astype(np.int64) * scale + np.rint((numbers - whole) * scale).astype(np.int64)
    return parts


def counted(rows: int, rate_hz: float, before: int = 0) -> Integers:
    """Return the times of rows that are counted at a rate, ns; ``before``: rows that were counted before them."""
    return np.asarray(np.rint(np.arange(before, before + rows) * (1e9 / rate_hz)).astype(np.int64))


def check_plausible(topic: str, time: Integers, log_time: Integers, difference_s: float | None, path: str) -> None:
    """Raise ``IngestError`` for impossible stamps ``time``; ``log_time``: times of the recorder.

    ``difference_s``: largest allowed difference of both (None: any); if the stamps do not count from 1970, without a
    constant offset.
    """
    absolute = bool((np.abs(time) > SINCE_1970_NS).any())
    strange = np.flatnonzero((time < YEAR_2000) | (time > YEAR_2100)) if absolute else np.flatnonzero(time < 0)
    if strange.size:
        row = int(strange[0])
        message = (
            f"message {row + 1} on {topic}: header stamp {time[row] / 1e9:.9g} s is no time since power-on and lies "
            f"outside the years 2000 to 2100 ({strange.size} such messages)"
        )
        hint = "correct the logger's clock, or set ingest.mcap.time_source=log_time"
        raise IngestError(message, path, code="bad_time", hint=hint)
    if difference_s is None:
        return
    apart = time - log_time
    if not (absolute and (log_time > YEAR_2000).all()):
        apart = apart - np.int64(np.median(apart[:: max(1, len(apart) // 1001)]))
    far = np.flatnonzero(np.abs(apart) > difference_s * SECOND_NS)
    if far.size:
        row = int(far[0])
        message = (
            f"message {row + 1} on {topic}: header stamp and the recorder's time are {apart[row] / 1e9:.9g} s apart "
            f"({far.size} such messages); {difference_s:g} s are allowed"
        )
        hint = "one of the clocks is wrong; if the log was replayed, set ingest.mcap.clock_difference_s=null"
        raise IngestError(message, path, code="bad_time", hint=hint)


def sorted_once(time: Integers, columns: Iterable[NDArray[Any]]) -> tuple[Index, Index, Mask]:
    """Return the order by time, the places in it that repeat a time, and which of these repeat all numbers, too.

    NaN is equal to NaN.
    """
    order = np.argsort(time, kind="stable")
    repeats = np.flatnonzero(np.diff(time[order]) == 0) + 1
    one, other = order[repeats - 1], order[repeats]
    same = np.ones(len(repeats), np.bool_)
    for column in columns:
        both_nan = np.isnan(column[one]) & np.isnan(column[other]) if column.dtype.kind == "f" else False
        same &= (column[one] == column[other]) | both_nan
    return order, repeats, same


def in_order(
    topic: str, time: Integers, columns: Sequence[NDArray[Any]], reorder_s: float, path: str
) -> tuple[Index | None, list[Note]]:
    """Return the order by time, without repeated messages; None if the messages are in order.

    ``columns``: all numbers that are read. Raises ``IngestError`` for two different messages of one stamp, and for a
    message that is more than ``reorder_s`` late.
    """
    steps = np.diff(time)
    if (steps > 0).all():
        return None, []
    notes = []
    late = np.maximum.accumulate(time) - time
    if late.max() > reorder_s * SECOND_NS:
        row = int(np.argmax(late > reorder_s * SECOND_NS))
        message = (
            f"message {row + 1} on {topic}: header stamp {time[row] / 1e9:.9g} s after "
            f"{(time[row] + late[row]) / 1e9:.9g} s ({int((steps < 0).sum())} such messages); stamps have to increase"
        )
        allowed = f"up to {reorder_s:g} s are put in order: ingest.mcap.reorder_s"
        hint = f"a log that was restarted belongs in two files ({allowed})"
        raise IngestError(message, path, code="bad_time", hint=hint)
    order, repeats, same = sorted_once(time, columns)
    inversions = int((steps < 0).sum())
    if inversions:
        detail = f"times on {topic} go back {inversions} times, by up to {late.max() / 1e9:.9g} s; sorted by time"
        notes.append(Note("N-SORT", inversions, 0, 0, detail))
    if repeats.size:
        if not same.all():
            place = repeats[np.argmin(same)]
            one, other = order[place - 1], order[place]
            message = (
                f"message {other + 1} on {topic}: header stamp {time[other] / 1e9:.9g} s as message {one + 1}, with "
                f"other numbers ({int((~same).sum())} such messages)"
            )
            raise IngestError(message, path, code="bad_time", hint="two sensors may send on one topic")
        notes.append(Note("N-DUP", int(repeats.size), 0, 0, f"messages on {topic} that stand there twice were dropped"))
        order = np.delete(order, repeats)
    return order, notes


def check_fine(topic: str, time: Integers, path: str) -> None:
    """Raise ``IngestError`` for times in floating-point numbers that are too coarse to differentiate."""
    if len(time) < 2:
        return
    resolution = float(np.spacing(np.abs(time).max() / 1e9)) * 1e9
    interval = float(np.median(np.diff(time)))
    if resolution > MAX_FLOAT_RESOLUTION * interval:
        message = (
            f"times on {topic} are floating-point numbers that hold {resolution:.3g} ns, more than "
            f"{MAX_FLOAT_RESOLUTION:.0%} of the interval of {interval:.3g} ns"
        )
        raise IngestError(message, path, code="bad_time", hint="log integer times")


def rows_covered(slow: Integers, fast: Integers, topic: str, path: str) -> Index:
    """Return the messages of the slower sensor whose interval the faster one, on ``topic``, covers without a gap.

    Raises ``IngestError`` if there are none.
    """
    found = np.zeros(0, np.intp)
    if len(slow) >= MIN_MESSAGES and len(fast) >= MIN_MESSAGES:
        edges, steps = _edges(slow), np.diff(fast)
        inside = (edges[:-1] >= fast[0]) & (edges[1:] <= fast[-1])
        gaps = np.flatnonzero(steps > MAX_GAP_INTERVALS * np.median(steps))
        begun = np.searchsorted(fast[gaps], edges[1:], side="left")  # gaps that begin before the end of a row
        ended = np.searchsorted(fast[gaps + 1], edges[:-1], side="right")  # and that end before its beginning
        found = np.flatnonzero(inside & (begun == ended)) + 1
    if len(found) < MIN_MESSAGES:
        message = f"the messages on {topic} do not cover those of the other sensor in time"
        raise IngestError(message, path, code="bad_time", hint="both topics need stamps of one clock")
    return found


def averaged(slow: Integers, rows: Index, fast: Integers, values: Values) -> Values:
    """Return the mean of a channel of the faster sensor over the interval about each of the slower ``rows``."""
    edges = (_edges(slow) - slow[0]) / 1e9
    time = (fast - slow[0]) / 1e9
    integral = np.concatenate([[0.0], np.cumsum(0.5 * (values[1:] + values[:-1]) * np.diff(time))])
    j = np.clip(np.searchsorted(time, edges, side="right") - 1, 0, len(time) - 2)
    step, since = np.diff(time)[j], edges - time[j]
    at_edges = integral[j] + since * (values[j] + 0.5 * (values[j + 1] - values[j]) * since / step)
    means: Values = (np.diff(at_edges) / np.diff(edges))[rows - 1]
    return means


def _edges(slow: Integers) -> Integers:
    """Return the middles between messages: start and end of the interval of each message but the first and last."""
    edges: Integers = slow[:-1] + np.diff(slow) // 2
    return edges
