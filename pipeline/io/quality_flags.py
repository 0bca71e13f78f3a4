"""Quality flags of a recording: gaps, clipped and stuck readings. Flagged samples stay, and no fit uses them.

A reading is *stuck* where it stays the same for longer than noise allows. The share ``p`` of equal neighbours in
windows of 64 samples measures how noisy the channel is; a run of ``L`` equal values among ``n`` is expected

    n p^(L-1)

times by chance, and flagged where that is below 10^-6. Where the 95th percentile of ``p`` exceeds one half, the noise
is below the resolution and nothing can be decided.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import IngestError
from pipeline.io.units import TRIADS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.io.channel_table import ChannelTable
    from pipeline.io.ingest_settings import Checks
    from pipeline.records import Note

GAP, CLIPPED, STUCK = np.uint16(1), np.uint16(2), np.uint16(4)
GAP_INTERVALS = 1.5  # half way to one missing sample
JITTER_NOTED, JITTER_TOO_LARGE = 0.2, 0.5  # rms, relative to the median interval; spectra need regular samples
FULL_SCALE_MARGIN = 1.2  # sensors read up to a fifth past their nominal range
RAIL = 1e-4  # relative; the top code of 16 bits lies 3e-5 below full scale
BEYOND = 1e-3  # relative; with nominal counts per unit the top code lies up to so far above
UNIT_NAMES = {"accelerometer": "g", "gyroscope": "deg/s"}
WINDOW = 64  # samples in which the share of equal neighbours is counted
BY_CHANCE = 1e-6  # expected number of such runs in the recording
SHORTEST_RUN = 20  # samples; the estimate of p from windows of 64 is too coarse for less
QUIET = 0.5  # share of equal neighbours at which noise is below the resolution
DEAD_ROWS = 1000  # shorter recordings may be constant by their resolution


def flag_gaps(table: ChannelTable, flags: NDArray[np.uint16], checks: Checks) -> list[Note]:
    """Flag gaps and note irregular intervals; refuse more missing time than ``checks.missing_time`` allows."""
    steps = np.diff(table.time_ns)
    usual = float(np.median(steps))
    limit = GAP_INTERVALS * usual
    if int(steps.max()) <= limit:
        return _irregular(table, steps, usual)
    rows = np.flatnonzero(steps > limit) + 1
    flags[rows] |= GAP
    lengths = steps[rows - 1]
    lost = float(np.sum(lengths - usual)) / float(table.time_ns[-1] - table.time_ns[0])
    detail = (
        f"gaps longer than {GAP_INTERVALS} times the median interval of {usual / 1e6:.6g} ms; "
        f"the longest lasts {lengths.max() / 1e9:.6g} s, {lost:.3%} of the time is missing"
    )
    if lost > checks.missing_time:
        message = f"{rows.size} {detail}"
        hint = f"ingest.checks.missing_time allows a share of {checks.missing_time:g}"
        raise IngestError(message, table.place(int(rows[np.argmax(lengths)])), code="missing_time", hint=hint)
    return [table.note("N-GAP", rows, detail), *_irregular(table, steps[steps <= limit], usual)]


def _irregular(table: ChannelTable, steps: NDArray[np.int64], usual: float) -> list[Note]:
    if not steps.size or int(steps.max()) - int(steps.min()) <= JITTER_NOTED * usual:
        return []
    jitter = float(np.sqrt(np.mean((steps / usual - 1.0) ** 2)))
    if jitter <= JITTER_NOTED:
        return []
    detail = f"intervals scatter by {jitter:.0%} rms of their median of {usual / 1e6:.6g} ms"
    if jitter > JITTER_TOO_LARGE:
        detail += ": too irregular for spectra and Allan deviations"
    return [table.note("N-JITTER", np.array([0, len(table.time_ns) - 1]), detail)]


def flag_clipped(table: ChannelTable, sensor: str, full_scale: float, flags: NDArray[np.uint16]) -> list[Note]:
    """Flag readings at full scale, g or deg/s; refuse those far beyond it."""
    notes = []
    for channel in TRIADS[sensor]:
        if channel not in table.values:
            continue
        values = table.values[channel]
        count = abs(table.encodings[channel].scale) if channel in table.encodings else 0.0
        largest = max(float(values.max()), -float(values.min()))
        if largest < full_scale - max(1.5 * count, RAIL * full_scale):
            continue
        size = np.abs(values)
        if largest > FULL_SCALE_MARGIN * full_scale:
            row = int(np.argmax(size > FULL_SCALE_MARGIN * full_scale))
            message = (
                f"{channel} is {values[row]:.6g} {UNIT_NAMES[sensor]} at {table.time_ns[row] / 1e9:.9g} "
                f"s, beyond {FULL_SCALE_MARGIN} times the full scale of {full_scale:g}; correct "
                f"ingest.csv.columns.{channel}.unit or sensor.{sensor}.full_scale"
            )
            raise IngestError(message, table.place(row), code="beyond_full_scale")
        rows = np.flatnonzero(_at_rail(size, full_scale, count))
        if rows.size:
            flags[rows] |= CLIPPED
            detail = f"{channel} reaches the full scale of {full_scale:g} {UNIT_NAMES[sensor]} and may be clipped"
            notes.append(table.note("N-CLIP", rows, detail))
    return notes


def _at_rail(size: NDArray[np.float64], full_scale: float, count: float) -> NDArray[np.bool_]:
    """Return which sizes lie at full scale, or at a largest value beyond it that occurs more than once.

    Many sensors read on past their nominal range (131 counts per deg/s reach 250.1 deg/s), some by a fifth.
    """
    clipped = (size >= full_scale - max(1.5 * count, RAIL * full_scale)) & (size <= (1.0 + BEYOND) * full_scale)
    largest = size.max()
    if largest > full_scale:
        at_largest = size >= largest - 1.5 * count
        if at_largest.sum() > 1:
            clipped |= at_largest
    return np.asarray(clipped)


def flag_stuck(table: ChannelTable, sensor: str, flags: NDArray[np.uint16]) -> list[Note]:
    """Flag readings that stay the same for longer than the channel's own noise allows.

    An axis that never changes, or stays for half of the rows while the others of its sensor change, is refused.
    """
    neighbours = {c: v[1:] == v[:-1] for c in TRIADS[sensor] if (v := table.values.get(c)) is not None}
    notes = []
    for channel, same in neighbours.items():
        if not _in_a_row(same, SHORTEST_RUN - 1):
            continue
        share = equal_share(same)
        others = [not s.any() or equal_share(s) <= QUIET for c, s in neighbours.items() if c != channel]
        if same.all() and len(same) >= DEAD_ROWS and others and all(others):
            message = (
                f"{channel} is {table.values[channel][0] + 0.0:.6g} {UNIT_NAMES[sensor]} in all {len(same) + 1} rows, "
                "while the other axes change"
            )
            hint = "is the column right, and the sensor's axis alive?"
            raise IngestError(message, table.path, code="stuck", hint=hint)
        rows = _stuck_rows(same, share)
        rows = rows[(flags[rows] & CLIPPED) == 0]
        if rows.size >= len(same) / 2 and others and all(others):
            message = (
                f"{channel} stays at one value for longer than its noise allows in {rows.size} of "
                f"{len(same) + 1} rows, while the other axes change"
            )
            raise IngestError(message, table.place(int(rows[0])), code="stuck", hint="is the sensor's axis alive?")
        if 0 < rows.size < len(same) / 2:
            flags[rows] |= STUCK
            detail = (
                f"{channel} stays at {table.values[channel][rows[0]]:.6g} {UNIT_NAMES[sensor]} for longer than its "
                "noise allows: stuck, and left out of every fit"
            )
            notes.append(table.note("N-STUCK", rows, detail))
    return notes


def equal_share(same: NDArray[np.bool_]) -> float:
    """Return the 95th percentile, over windows that are not wholly equal, of the share of equal neighbours."""
    whole = len(same) // WINDOW * WINDOW
    if whole == 0:
        return 1.0
    shares = np.bincount(np.flatnonzero(same[:whole]) // WINDOW, minlength=whole // WINDOW) / WINDOW
    partial = shares[shares < 1.0]
    if not partial.size:
        return 1.0
    place = 0.95 * (partial.size - 1)  # np.quantile costs more than all the rest, for every channel of every file
    return float(np.interp(place, np.arange(partial.size), np.sort(partial)))


def _stuck_rows(same: NDArray[np.bool_], share: float) -> NDArray[np.intp]:
    """Return the rows in runs of equal values that are longer than chance allows."""
    if share > QUIET:
        return np.zeros(0, np.intp)
    p = max(share, 1.0 / WINDOW)
    longest = max(SHORTEST_RUN, int(np.ceil(np.log(BY_CHANCE / len(same)) / np.log(p))) + 1)
    if not _in_a_row(same, longest - 1):
        return np.zeros(0, np.intp)
    edges = np.flatnonzero(np.diff(same, prepend=False, append=False))
    starts, stops = edges[::2], edges[1::2]
    long = stops - starts + 1 >= longest
    return np.concatenate([np.arange(a, b + 1) for a, b in zip(starts[long], stops[long], strict=True)])


def _in_a_row(same: NDArray[np.bool_], count: int) -> bool:
    """Return whether so many neighbours in a row are equal."""
    places, further = np.flatnonzero(same), count - 1
    return bool(np.any(places[further:] - places[: max(len(places) - further, 0)] == further))
