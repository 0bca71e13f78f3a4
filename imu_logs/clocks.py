"""Convert timestamps of messages to integer nanoseconds, and check their values and order.

A double resolves a time since 1970 to 238 ns only. So timestamps are not converted to doubles. If the log stores
doubles, whole seconds and fraction are converted separately, without further loss.

Accelerometer and gyroscope may be in separate messages, with different times and rates of one clock. The rows are then
the messages of the slower sensor, at t_k. The faster sensor is averaged over the interval about each row:

    mean_k = (A(e_{k+1}) - A(e_k)) / (e_{k+1} - e_k),   A = integral of the reading,   e_k = (t_{k-1} + t_k) / 2

The reading is interpolated linearly between two messages. Unlike interpolation, an average preserves the integral and
the density of white noise. It is a low-pass filter over the slower sensor's interval.

Find samples that arrive in bursts, and the regular clock of samples that have no times of their own.

A FIFO that is read out, a radio link, or a clock in whole milliseconds gives several rows one time. A sensor that
samples without a pause takes row k at ``t_k = a + T k``, and the last row of burst b less than T before the burst
arrives. So T is the slope of the line through the times of the bursts over the numbers of their last rows. The line
replaces the times if

    at least FEWEST_BURSTS bursts determine T to within MAX_INTERVAL_UNCERTAINTY,
    the times of the bursts scatter about it by less than T, and MARGIN_INTERVALS for the jitter of the clock that logs
    them: each lost row moves all later bursts by T,
    and the step from burst to burst is the step within a burst: rows of two sensors differ by their biases.

The uncertainty of T is twice the standard one of the regression, and at least ``1.5 T / n`` for n rows: errors within
0 and T, first 0 and then T, change the slope by as much. It is a line of the uncertainty budget.

Otherwise the log is refused where it would be refused without bursts, for repeated times or missing time. The refusal
names the setting ``rate_hz``, by which the user states that no row is missing. Rows with times of their own keep them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imu_logs.errors import IngestError
from imu_logs.log import Index, Integers, Log, Mask, Note, Values
from imu_logs.units import SECOND_NS, SINCE_1970_NS, TRIADS, UNITS

MAX_NANOSECONDS = np.iinfo(np.int64).max

YEAR_2000, YEAR_2100 = 946_684_800 * SECOND_NS, 4_102_444_800 * SECOND_NS
MIN_MESSAGES = 3  # messages of a sensor: a row has a neighbour on both sides
MAX_GAP_INTERVALS = 1.5  # times the median interval, as of a recording's rows
MAX_FLOAT_RESOLUTION = 0.01  # of the median interval: coarsest resolution of a time in floating-point numbers
SHORTEST_NS = 25_000  # below the interval of 32 kHz, the fastest output of an IMU (ICM-42688-P, data sheet, GYRO_ODR)
IN_BURST = 0.5  # of the mean interval: at least half of the intervals are shorter where samples arrive in bursts
FEWEST_UNTIMED = 0.01  # share of rows without a time of their own, above which it is no single fault
UNTIMED = 0.95  # share of the rows of bursts that have no time of their own, if none has
REPEATED = 0.5  # share of such rows that repeat the row before them, above which they were logged twice
MIN_BURSTS = 3  # bursts, to call them so
FEWEST_BURSTS = 10  # that determine a clock
# of the interval: a tenth of what the clock of a MEMS sensor may be off (configs/sensor)
MAX_INTERVAL_UNCERTAINTY = 1e-3
MARGIN_INTERVALS = 0.5  # of the interval
ONE_SENSOR = 6.0  # standard errors
SAME_SIZE, MAX_BURST_DISTANCE = 0.8, 1.5  # share of bursts of the usual size +-1; times the usual distance
READ_OUT_NS, LARGEST_FIFO = 2_000_000, 4096  # interval of rows while a FIFO is read by I2C, and its rows
# of the time between bursts, and of a burst; longer ones are of a logger that pauses
MAX_BURST_SHARE, LONGEST_NS = 0.25, 1e9


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


@dataclass(frozen=True)
class Bursts:
    """The bursts of a log.

    ``times``: of the rows by the regular clock, None where it is not determined, for the reason ``lacks``.
    """

    size: int  # usual number of rows
    apart_ns: float  # usual time between two bursts
    within_ns: float  # usual interval within a burst
    rate_hz: float  # of the rows in usual bursts
    untimed: Index  # rows without a time of their own
    start: int  # first row of the second burst
    times: Integers | None = None
    lacks: str = ""
    interval_ns: float = 0.0
    uncertainty_ns: float = 0.0  # of the interval, expanded (95 %)
    departure_ns: float = 0.0  # largest, of a burst from the clock

    @property
    def clock(self) -> dict[str, float]:
        """Interval and expanded uncertainty, for the source of a recording."""
        return {"interval_ns": self.interval_ns, "uncertainty_ns": self.uncertainty_ns}

    def described(self, rows: int) -> str:
        """Return the replacement of the times of a log in words."""
        return (
            f"samples arrive in bursts of {self.size}, {self.apart_ns / 1e6:.6g} ms apart: {self.untimed.size} of "
            f"{rows} rows have no time of their own. All rows were given the regular clock that their number and the "
            f"duration determine, an interval of {self.interval_ns / 1e6:.8g} ms +- {self.uncertainty_ns / 1e6:.2g} ms "
            f"(95 %); the bursts depart from it by up to {self.departure_ns / 1e6:.2g} ms"
        )

    def error(self, path: str, place: str) -> IngestError:
        """Return the refusal of a log; ``path``: of the file, ``place``: of the first burst."""
        own = f", with times {self.within_ns / 1e6:.3g} ms apart" if self.within_ns > SHORTEST_NS else ""
        message = f"samples arrive in bursts of {self.size}, {self.apart_ns / 1e6:.6g} ms apart{own}: {self.lacks}"
        hint = f"if no row is missing, count the rows: {setting_of_rate(path, self.rate_hz, text=place != path)}"
        return IngestError(message, place, code="bursts", hint=hint)


def setting_of_rate(path: str, rate_hz: float, *, text: bool) -> str:
    """Return the setting that counts the rows of a log; ``text``: it has lines."""
    if path.endswith(".gcsv"):
        return "save the log as .csv, with ingest.csv.rate_hz"
    setting = "ingest.csv.columns.time=null and ingest.csv.rate_hz" if text else "ingest.mcap.rate_hz"
    return f"{setting}={rate_hz:.6g}, the mean of this log; table.clock_accuracy_ppm states how exact it is"


def find_bursts(time_ns: Integers, values: Mapping[str, Values]) -> Bursts | None:
    """Return the bursts of a log, None for samples that arrive one by one; ``values``: of the rows, by channel."""
    steps = np.diff(time_ns)
    if len(steps) < 2 * MIN_BURSTS or steps.min() < 0 or time_ns[-1] == time_ns[0]:
        return None
    mean = float(time_ns[-1] - time_ns[0]) / len(steps)
    untimed, short = steps < SHORTEST_NS, steps <= IN_BURST * mean
    in_bursts = np.count_nonzero(short) >= len(steps) / 2
    if not in_bursts and np.count_nonzero(untimed) < FEWEST_UNTIMED * len(steps):
        return None
    first = np.flatnonzero(steps > mean if in_bursts else ~untimed) + 1
    sizes, apart = np.diff(first), np.diff(time_ns[first])
    columns = [values[c] for triad in TRIADS.values() for c in triad if c in values] or list(values.values())
    same = np.flatnonzero(untimed)
    repeated = np.ones(same.size, np.bool_)
    for column in columns:
        repeated &= column[same + 1] == column[same]
    if len(sizes) < MIN_BURSTS or (same.size and repeated.mean() > REPEATED):
        return None
    size, near = int(np.median(sizes)), apart <= MAX_BURST_DISTANCE * np.median(apart)
    usual = near & (np.abs(sizes - size) <= 1)
    usual = usual if usual.any() else near
    found = Bursts(
        size=max(size, 2),
        apart_ns=float(np.median(apart)),
        within_ns=float(np.median(steps[short])) if in_bursts else 0.0,
        rate_hz=float(sizes[usual].sum() / apart[usual].sum() * 1e9),
        untimed=same + 1,
        start=int(first[0]),
    )
    if in_bursts and np.count_nonzero(untimed & short) < UNTIMED * np.count_nonzero(short):
        even = np.mean(np.abs(sizes - found.size) <= 1) >= SAME_SIZE and bool(near.all())
        even = even and (found.size - 1) * found.within_ns <= min(MAX_BURST_SHARE * found.apart_ns, LONGEST_NS)
        read_out = found.within_ns <= READ_OUT_NS and len(sizes) >= FEWEST_BURSTS and found.size <= LARGEST_FIFO
        lacks = "the times of a FIFO's readout, or a logger that pauses, which ingest.checks.missing_time allows"
        return replace(found, lacks=lacks) if even or read_out else None
    return _with_clock(found, time_ns, first, columns)


def _with_clock(bursts: Bursts, time_ns: Integers, first: Index, columns: list[Values]) -> Bursts:
    """Return bursts without times within them, with the regular clock of their rows or the reason for none."""
    last = first - 1  # of each burst but the last one, which may be cut
    if len(last) < FEWEST_BURSTS:
        return replace(bursts, lacks=f"{len(last) + 1} bursts are too few to determine the interval of the samples")
    moments = (time_ns[last] - time_ns[0]).astype(np.float64)
    rows = last - last.mean()
    interval = float(rows @ moments / (rows @ rows))
    residual = moments - moments.mean() - interval * rows
    uncertainty = float(2.0 * np.sqrt(residual @ residual / (len(last) - 2) / (rows @ rows)))
    uncertainty = max(uncertainty, 1.5 * interval / len(time_ns))
    departure = float(np.abs(residual).max())
    found = replace(bursts, interval_ns=interval, uncertainty_ns=uncertainty, departure_ns=departure)
    if np.ptp(residual) > (1.0 + MARGIN_INTERVALS) * interval:
        off = f"{departure / interval:.3g} intervals"
        return replace(found, lacks=f"they depart from a regular clock by up to {off}, as if rows were missing")
    if uncertainty > MAX_INTERVAL_UNCERTAINTY * interval:
        within = f"{uncertainty / interval:.2g} of it, where {MAX_INTERVAL_UNCERTAINTY:g} is needed"
        return replace(found, lacks=f"they determine the interval of the samples only to within {within}")
    if not _of_one_sensor(first, columns):
        return replace(found, lacks="their rows differ as those of two sensors or of two merged logs do")
    clock = moments.mean() + interval * (np.arange(len(time_ns)) - last.mean())
    times: Integers = time_ns[0] + np.rint(clock).astype(np.int64)
    return replace(found, times=times)


def _of_one_sensor(first: Index, columns: list[Values]) -> bool:
    """Return whether the step from burst to burst is on average that from row to row within a burst."""
    start, stop = first[:-1], first[1:] - 1
    several = stop > start
    start, stop = start[several], stop[several]
    if start.size < FEWEST_BURSTS:
        return True
    for column in columns:
        apart = (column[stop] - column[start]) / (stop - start) - (column[stop + 1] - column[stop])
        if abs(apart.mean()) > ONE_SENSOR * apart.std(ddof=1) / np.sqrt(apart.size):
            return False
    return True


def with_regular_clock(table: Log) -> Log:
    """Return a table with the regular clock of its samples and a note, unchanged where their times are their own."""
    bursts = find_bursts(table.time_ns, table.values)
    if bursts is None or bursts.times is None:
        return table
    note = table.note("N-BURSTS", bursts.untimed, bursts.described(len(table.time_ns)))
    source = {**table.source, "bursts": bursts.clock}
    return replace(table, time_ns=bursts.times, source=source, notes=(*table.notes, note))


def bursts_error(table: Log) -> IngestError | None:
    """Return the refusal of a table whose samples arrive in bursts; None for others."""
    bursts = find_bursts(table.time_ns, table.values)
    return None if bursts is None else bursts.error(table.path, table.place(bursts.start))


def rounded_error(table: Log, error: IngestError) -> IngestError | None:
    """Return the refusal of missing time for times that are multiples of about the interval; None for others.

    Such times are rounded, or rows are missing: rows 1 and 2 ms apart are of 800 Hz in whole ms, or of 1 kHz with
    losses.
    """
    steps = np.diff(table.time_ns)
    unit, shortest = int(np.gcd.reduce(steps)), int(steps.min())
    if steps.max() > shortest + unit:
        return None
    rate_hz = len(steps) / float(table.time_ns[-1] - table.time_ns[0]) * 1e9
    hint = (
        f"the times are multiples of {unit / 1e6:.6g} ms; if they are rounded and no row is missing, count the rows: "
        f"{setting_of_rate(table.path, rate_hz, text=table.lines is not None)}"
    )
    return IngestError(error.fact, error.file, code=error.code, hint=hint)
