"""The channels of a table's log with a clock of its own, at the sensor's times."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import IngestError
from pipeline.io.channel_table import ChannelTable
from pipeline.io.clock_alignment import fit_clocks
from pipeline.io.table_log import interpolators, seconds_of, signals_of, unwrapped
from pipeline.io.units import TABLE_CHANNELS
from pipeline.records import Note

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.io.clock_alignment import ClockFit

TABLE_TIME = "table_time"


def own_rows(table: ChannelTable) -> ChannelTable:
    """Return the table's channels of a log whose rows hold a time of the table's own."""
    time = np.rint(table.values[TABLE_TIME]).astype(np.int64)
    new = np.concatenate([[True], time[1:] > np.maximum.accumulate(time)[:-1]])
    values = {c: table.values[c][new] for c in TABLE_CHANNELS if c in table.values}
    return ChannelTable(table.path, time[new], values, table.source, table.line_of)


def align(sensor: ChannelTable, log: ChannelTable) -> ChannelTable:
    """Return a sensor's log with the channels of a table's log at its own times.

    Rows that the table's log does not cover are left out. Where the table rests throughout, its log begins with the
    sensor's: nothing depends on it.

    Parameters
    ----------
    sensor : ChannelTable
        With a gyroscope.
    log : ChannelTable
        With the table's angle, rate or attitude.

    Raises
    ------
    IngestError
        If the two logs do not show the same motion.
    """
    log = unwrapped(log)
    t, own = seconds_of(sensor), seconds_of(log)
    if len(own) < 6:
        raise IngestError(f"the table's log has {len(own)} rows; at least 6 are needed", log.path, fault="no_sync")
    if signals_of(log).resting:
        tau = np.clip(t, 0.0, own[-1])
        note = Note("N-SYNC", len(t), 0, 0, "the table rests throughout its log: there is no motion to align by")
        return _merged(sensor, log, slice(0, len(t)), tau, None, [note])
    fit = fit_clocks(sensor, log)
    tau = fit.table_time(t)
    inside = np.flatnonzero((tau >= 0) & (tau <= own[-1]))
    if inside.size < 2:
        raise IngestError("no time is covered by both logs", log.path, fault="no_sync")
    rows = slice(int(inside[0]), int(inside[-1]) + 1)
    return _merged(sensor, log, rows, tau[rows], fit, _notes(sensor, log, rows, fit))


def _notes(sensor: ChannelTable, log: ChannelTable, rows: slice, fit: ClockFit) -> list[Note]:
    offset_s = float(log.time_ns[0] - sensor.time_ns[0]) / 1e9 + fit.offset
    detail = (
        f"the table's clock is {offset_s:.7g} s (+- {_short(fit.offset_uncertainty)} s, one standard deviation) ahead "
        f"of the sensor's {fit.middle:.4g} s after its first sample and gains {fit.drift * 1e6:.3g} ppm "
        f"(+- {_short(fit.drift_uncertainty * 1e6)}); brought together by the motion that both saw (correlation "
        f"{fit.correlation:.5f})"
    )
    first, last = sensor.line_of(rows.start), sensor.line_of(rows.stop - 1)
    times = float(sensor.time_ns[rows.start]) / 1e9, float(sensor.time_ns[rows.stop - 1]) / 1e9
    notes = [Note("N-SYNC", rows.stop - rows.start, first, last, detail, *times)]
    lost = len(sensor.time_ns) - (rows.stop - rows.start)
    if lost:
        notes.append(Note("N-CUT", lost, first, last, f"{lost} rows that the table's log does not cover were left out"))
    return notes


def _short(value: float) -> str:
    """Return a number to one digit, without a power of ten."""
    return np.format_float_positional(float(f"{value:.1g}"), trim="-")


def _merged(  # noqa: PLR0917  (parts of one table)
    sensor: ChannelTable, log: ChannelTable, rows: slice, tau: NDArray[np.float64], fit: ClockFit | None,
    notes: list[Note],
) -> ChannelTable:  # fmt: skip
    values = {c: v[rows] for c, v in sensor.values.items() if c not in log.values and c != TABLE_TIME}
    values |= {channel: at(tau) for channel, at in interpolators(log).items()}
    source = dict(sensor.source)
    if fit is not None:
        source["table_clock"] = {
            "offset_s": float(log.time_ns[0] - sensor.time_ns[0]) / 1e9 + fit.offset,
            "offset_uncertainty_s": fit.offset_uncertainty,
            "drift_ppm": fit.drift * 1e6,
            "drift_uncertainty_ppm": fit.drift_uncertainty * 1e6,
            "at_s": fit.middle,
            "correlation": fit.correlation,
        }
    same = log.source is sensor.source
    return ChannelTable(
        path=sensor.path,
        time_ns=sensor.time_ns[rows],
        values=values,
        source=source if same else {**source, "table_log": log.source},
        line_of=lambda row: sensor.line_of(row + rows.start),
        encodings={c: e for c, e in sensor.encodings.items() if c in values and c not in log.values},
        notes=(*sensor.notes, *(() if same else log.notes), *notes),
        flags=None if sensor.flags is None else sensor.flags[rows],
    )
