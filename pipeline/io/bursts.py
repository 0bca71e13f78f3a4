"""Find samples that arrive in bursts, and the regular clock of samples that have no times of their own.

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

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import IngestError
from pipeline.io.units import TRIADS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pipeline.io.channel_table import ChannelTable
    from pipeline.records import Index, Integers, Values

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


def with_regular_clock(table: ChannelTable) -> ChannelTable:
    """Return a table with the regular clock of its samples and a note, unchanged where their times are their own."""
    bursts = find_bursts(table.time_ns, table.values)
    if bursts is None or bursts.times is None:
        return table
    note = table.note("N-BURSTS", bursts.untimed, bursts.described(len(table.time_ns)))
    source = {**table.source, "bursts": bursts.clock}
    return replace(table, time_ns=bursts.times, source=source, notes=(*table.notes, note))


def bursts_error(table: ChannelTable) -> IngestError | None:
    """Return the refusal of a table whose samples arrive in bursts; None for others."""
    bursts = find_bursts(table.time_ns, table.values)
    return None if bursts is None else bursts.error(table.path, table.place(bursts.start))


def rounded_error(table: ChannelTable, error: IngestError) -> IngestError | None:
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
