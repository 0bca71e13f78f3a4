"""Checks that need all recordings of a unit: its rests, its reference, its mounting, and whether they share samples.

Shared samples mean that held-out motion is not held out. The rows of all recordings are compared by the numbers of
their sensor channels, rounded to ten digits so that another unit of the file does not hide them, and again at the
coarser decimals of a rounded copy. A row counts where it occurs once in its own recording: rests of a coarse sensor
repeat rows. Two recordings share samples where at least 20 such rows follow each other in both, each within 8 rows of
the one before; by chance that is as improbable as

    (8 c / n)^19,   c : rows that occur in both,   n : rows of the longer recording

for which 10^-6 is the limit, as for stuck readings (``pipeline.io.quality_flags``). So whole copies are found, shifted
in rows or time, cut, or with rows left out.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.io.quality_flags import BY_CHANCE
from pipeline.model.kinematics import normal_gravity_g
from pipeline.preprocessing.at_rest import check_axes, check_static
from pipeline.preprocessing.coarse_temperature import refined
from pipeline.preprocessing.evidence import place, refusal
from pipeline.preprocessing.mounting import check_mounting
from pipeline.preprocessing.reference import check_motion, check_turns
from pipeline.records import SENSORS, Note

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from pipeline.records import Index, Recording

FEWEST, APART = 20, 8  # rows, see above
DIGITS = 10  # of 16 bits of counts in any unit, 5 are significant; twice that
SAME_GRAVITY_G = 1e-4  # gravity changes by as much over 0.3 km of height
OF_DECIMALS = 200  # samples by which the decimals are told: a finer reading ends in a zero in a tenth of them
MIX = np.uint64(0x9E3779B97F4A7C15)  # 2^64 over the golden ratio (Knuth, TAOCP 3, 6.4): spreads sums of bit patterns


def check_recordings(recordings: Sequence[Recording], settings: Mapping[str, Any]) -> list[Recording]:
    """Return the recordings of a unit, their turns by the convention, with notes on what was found.

    Parameters
    ----------
    recordings : sequence of Recording
        In body axes, not filtered.
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
    checked = refined(check_motion(check_mounting(turns, settings), delays, settings))
    return _placed(checked, settings.get("table") or {})


def _placed(recordings: list[Recording], table: Mapping[str, Any]) -> list[Recording]:
    """Add notes on what latitude and azimuth mean: gravity that was left at 1 g, and where the turn axes point."""
    latitude, azimuth = table.get("latitude_deg"), table.get("azimuth_deg")
    if latitude is None:
        return recordings
    gravity = normal_gravity_g(float(latitude))
    wrong = table.get("gravity_g") == 1.0 and abs(gravity - 1.0) >= SAME_GRAVITY_G
    detail = (
        f"table.gravity_g is 1, its default; at latitude {latitude:g} deg gravity is {gravity:.5f} g at sea level, and "
        f"0.000315 g less for each km of height. Scale and bias of the accelerometer are then in units of local "
        f"gravity, {abs(gravity - 1.0):.3%} off standard g: set table.gravity_g={gravity:.5f} for standard g"
    )
    k = next((k for k, r in enumerate(recordings) if r.accelerometer is not None), None)
    notes = [(k, Note("N-GRAVITY", 1, 0, 0, detail))] if wrong and k is not None else []
    if table.get("azimuth_of") == "turn_axis" and azimuth is not None:
        turns = [(k, r) for k, r in enumerate(recordings) if r.axis and not r.up and r.role != "validation"]
        ends = [f"body {r.axis} to {(azimuth + 90.0 * (1 - r.sense)) % 360.0:g} deg in {r.name}" for _, r in turns]
        detail = (
            f"Earth's rotation is in the model: by table.azimuth_deg and the sense of the encoder the shaft points "
            f"with {', '.join(ends)}, clockwise from north; if it does not, correct table.azimuth_deg by 180 deg"
        )
        notes += [(turns[0][0], Note("N-AZIMUTH", len(turns), 0, 0, detail))] if turns else []
    for k, note in notes:
        recordings[k] = replace(recordings[k], notes=(*recordings[k].notes, note))
    return recordings


def check_shared_rows(recordings: Sequence[Recording]) -> None:
    """Refuse two recordings that hold the same samples, naming both and the rows."""
    decimals = [_decimals(r) for r in recordings]
    pairs = {tuple(min(a, b) for a, b in zip(x, y, strict=True)) for x, y in itertools.combinations(decimals, 2)}
    for coarse in sorted(pairs, reverse=True):
        _check_at(recordings, coarse)


def _decimals(recording: Recording) -> tuple[int, ...]:
    """Return the decimals of each sensor's readings, by its first samples; ``DIGITS`` for an absent sensor."""
    out = []
    for sensor in SENSORS:
        reading = recording.reading(sensor)
        part = np.zeros((0, 3)) if reading is None else reading[:OF_DECIMALS]
        part = part[np.isfinite(part).all(axis=1)]
        exact = (d for d in range(1, DIGITS) if len(part) and np.all(np.abs(part - np.round(part, d)) < 10.0**-DIGITS))
        out.append(next(exact, DIGITS))
    return tuple(out)


def _check_at(recordings: Sequence[Recording], decimals: Sequence[int]) -> None:
    """Refuse two recordings that hold the same samples, rounded to the decimals of each sensor."""
    keys = [_keys(r, decimals) for r in recordings]
    if not any(len(k) for k in keys):
        return
    value = np.concatenate(keys)
    owner = np.repeat(np.arange(len(keys)), [len(k) for k in keys])
    row = np.concatenate([np.arange(len(k)) for k in keys])
    order = np.argsort(value, kind="stable")  # equal rows next to each other, in the order of recordings
    value, owner, row = value[order], owner[order], row[order]
    same = value[1:] == value[:-1]
    if np.count_nonzero(same) < FEWEST - 1:
        return
    within = same & (owner[1:] == owner[:-1])
    single = ~(np.append(within, False) | np.append(False, within))
    value, owner, row = value[single], owner[single], row[single]
    for step in range(1, len(keys)):  # a row may be in several recordings: each pair lies at most so far apart
        twin = np.flatnonzero(value[step:] == value[:-step])
        if twin.size < FEWEST:
            break
        for pair in np.unique(owner[twin] * len(keys) + owner[twin + step]):
            chosen = twin[owner[twin] * len(keys) + owner[twin + step] == pair]
            one, two = divmod(int(pair), len(keys))
            _check_pair(recordings[one], recordings[two], row[chosen], row[chosen + step])


def _keys(recording: Recording, decimals: Sequence[int]) -> NDArray[np.uint64]:
    """Return a number for each row's readings; rows with equal readings have equal numbers."""
    pairs = zip(SENSORS, decimals, strict=True)
    found = [np.round(r, d) for s, d in pairs if (r := recording.reading(s)) is not None]
    if not found:
        return np.zeros(0, np.uint64)
    values = np.ascontiguousarray(np.concatenate(found, axis=1) + 0.0)  # no negative zero
    bits = values.view(np.uint64)
    key = np.zeros(len(bits), np.uint64)
    for column in range(bits.shape[1]):
        key = (key ^ bits[:, column]) * MIX
        key ^= key >> np.uint64(29)
    return key


def _check_pair(one: Recording, two: Recording, first: Index, second: Index) -> None:
    """Refuse two recordings whose common rows follow each other in both."""
    order = np.argsort(first)
    first, second = first[order], second[order]
    common, longest = len(first), max(one.samples, two.samples)
    ahead = (np.diff(first) <= APART) & (np.diff(second) > 0) & (np.diff(second) <= APART)
    edges = np.flatnonzero(np.diff(ahead, prepend=False, append=False))
    if not edges.size:
        return
    lengths = edges[1::2] - edges[::2] + 1
    best = int(np.argmax(lengths))
    count = int(lengths[best])
    chance = APART * common / longest
    if count < FEWEST or (count < common / 2 and chance < 1.0 and chance ** (count - 1) > BY_CHANCE):
        return
    a, b = int(edges[2 * best]), int(edges[2 * best + 1])
    late, early = (two, one) if two.role == "validation" or one.role != "validation" else (one, two)
    spans = {one.name: (first[a], first[b]), two.name: (second[a], second[b])}
    own, other = (place(r, int(spans[r.name][0]), int(spans[r.name][1])) for r in (late, early))
    held_out = "; held-out motion would not be held out" if late.role == "validation" else ""
    raise refusal(
        late,
        "shared_rows",
        f"{own} are those of recording {early.name}, {other} ({common} rows are the same){held_out}",
        "record each by itself, or remove the copy",
    )
