"""Check all recordings of a unit together: its rests, its reference, its mounting, and whether they share samples.

Two recordings that share samples are refused, because motion that is in both is not held out. Their rows are compared
by the readings of the sensors, rounded to ten digits so that a conversion of units in one file makes no difference, and
again rounded to the decimals of the coarser one. Only a row that occurs once in its recording counts: the rests of a
coarse sensor repeat rows. Two recordings share samples where at least 20 such rows follow each other in both, each
within 8 rows of the one before. By chance the probability is

    (8 c / n)^19,   c : rows that occur in both,   n : rows of the longer recording

and its limit is 10^-6, as for stuck readings (``pipeline.ingest.quality_flags``). This detects whole copies, copies
shifted in rows or time, cut copies, and copies with rows left out.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from imu_logs.units import TRIADS
from pipeline.checks.at_rest import check_axes, check_static, with_rates_at_rest
from pipeline.checks.coarse_temperature import refined
from pipeline.checks.evidence import place, refusal
from pipeline.checks.mounting import check_mounting
from pipeline.checks.reference import check_motion, check_turns
from pipeline.core.records import SENSOR_UNITS, SENSORS, Note
from pipeline.ingest.quality_flags import EXPECTED_CHANCE_RUNS
from pipeline.physics.kinematics import normal_gravity_g
from pipeline.physics.signal.quiet_motion import coarse_of, rounding_of, step_and_noise
from pipeline.physics.signal.rests import settling_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from pipeline.core.records import Index, Recording
    from pipeline.core.settings import Settings, Table

MIN_STEP_ROWS, APART = 20, 8  # rows, see above
RESOLUTION_NOTE = "N-RESOLUTION"
SAME_STEP = 1e-6  # relative: rounding of a difference of decimals
MAX_SIGNIFICANT_DIGITS = 10  # of 16 bits of counts in any unit, 5 are significant; twice that
SAME_GRAVITY_G = 1e-4  # gravity changes by as much over 0.3 km of height
OF_DECIMALS = 200  # samples that determine the decimals: a finer reading ends in a zero in a tenth of them
MIX = np.uint64(0x9E3779B97F4A7C15)  # 2^64 over the golden ratio (Knuth, TAOCP 3, 6.4): spreads sums of bit patterns


def check_recordings(recordings: Sequence[Recording], settings: Settings) -> list[Recording]:
    """Return the recordings of a unit, their turns by the convention, with notes on faults and corrections.

    Parameters
    ----------
    recordings : sequence of Recording
        In body axes, not filtered.
    settings : Settings
        Sections ``procedure``, ``sensor``, ``table`` and ``ingest``.

    Raises
    ------
    InputError
        If the recordings contradict each other, or the table's log contradicts itself or gravity.
    """
    _check_shared_rows(recordings)
    check_axes(recordings)
    recordings = _with_settling(_with_steps(with_rates_at_rest(recordings)))
    turns, delays = check_turns(check_static(recordings, settings), settings)
    checked = refined(check_motion(check_mounting(turns, settings), delays, settings))
    return _placed(checked, settings.table)


def _with_steps(recordings: Sequence[Recording]) -> Sequence[Recording]:
    """Note the axes whose readings have steps that hide their noise, with step and decimals (``N-RESOLUTION``)."""
    noted = list(recordings)
    for sensor in SENSORS:
        own = [k for k, r in enumerate(recordings) if r.reading(sensor) is not None]
        found = [step_and_noise(np.asarray(recordings[k].reading(sensor))) for k in own]
        steps, rounding = coarse_of(found), np.sqrt(3.0) * rounding_of(found)  # half-width of a rectangle
        for step in np.unique(steps[steps > 0.0]):
            axes = ", ".join(name for name, s in zip(TRIADS[sensor], steps, strict=True) if s == step)
            digits = next(
                (f", {d} decimal{'s' * (d != 1)}," for d in range(MAX_SIGNIFICANT_DIGITS) if _is_whole(step * 10.0**d)),
                "",
            )
            detail = (
                f"{axes}: steps of {step:.3g} {SENSOR_UNITS[sensor]}{digits} and noise of less than half a step: "
                f"means are off by up to {rounding[steps == step].max():.3g} {SENSOR_UNITS[sensor]}, however long the "
                "recording, and effects of this size cannot be distinguished from rounding. Log more digits, or set a "
                "smaller range"
            )
            first = noted[own[0]]
            noted[own[0]] = replace(first, notes=(*first.notes, Note(RESOLUTION_NOTE, first.samples, 0, 0, detail)))
    return noted


def _with_settling(recordings: Sequence[Recording]) -> Sequence[Recording]:
    """Note an accelerometer that settles in the rests by hand, with the time that is left out or would be needed."""
    noted = list(recordings)
    for k, recording in enumerate(recordings):
        by_hand = recording.role in {"rests", "validation"} and recording.logged_rate is None
        settling = settling_of(recording) if by_hand else None
        if settling is None:
            continue
        detail = (
            f"after moves the accelerometer settles with a time constant of {settling.time_s:.2g} s, as with a slow "
            f"filter; it is settled {settling.left_out_s:.2g} s after a rest was found"
        )
        detail += (
            f", and the rests are too short for that: their means are off by {settling.left_g:.2g} g. Rest longer, or "
            "log without this filter"
            if settling.clear
            else ", and this time is left out of every rest"
        )
        note = Note("N-REFERENCE" if settling.clear else "N-SETTLING", recording.samples, 0, 0, detail)
        noted[k] = replace(recording, notes=(*recording.notes, note))
    return noted


def _is_whole(value: float) -> bool:
    return abs(value - round(value)) < SAME_STEP * abs(value)


def _placed(recordings: list[Recording], table: Table) -> list[Recording]:
    """Note the gravity at the latitude if ``gravity_g`` is left at 1, and the azimuths of the turn axes."""
    latitude, azimuth = table.latitude_deg, table.azimuth_deg
    if latitude is None:
        return recordings
    gravity, notes = normal_gravity_g(float(latitude)), []
    measured = [k for k, r in enumerate(recordings) if r.accelerometer is not None]
    if measured and table.gravity_g == 1.0 and abs(gravity - 1.0) >= SAME_GRAVITY_G:
        detail = (
            f"table.gravity_g is 1, its default; at latitude {latitude:g} deg gravity is {gravity:.5f} g at sea level, "
            "and 0.000315 g less for each km of height. Scale and bias of the accelerometer are then in units of local "
            f"gravity, {abs(gravity - 1.0):.3%} off standard g: set table.gravity_g={gravity:.5f} for standard g"
        )
        notes.append((measured[0], Note("N-GRAVITY", 1, 0, 0, detail)))
    turns = [(k, r) for k, r in enumerate(recordings) if r.axis and not r.up and r.role != "validation"]
    if turns and table.azimuth_of == "turn_axis" and azimuth is not None:
        ends = [f"body {r.axis} to {(azimuth + 90.0 * (1 - r.sense)) % 360.0:g} deg in {r.name}" for _, r in turns]
        detail = (
            f"Earth's rotation is in the model: by table.azimuth_deg and the sense of the encoder the shaft points "
            f"with {', '.join(ends)}, clockwise from north; if it does not, correct table.azimuth_deg by 180 deg"
        )
        notes.append((turns[0][0], Note("N-AZIMUTH", len(turns), 0, 0, detail)))
    for k, note in notes:
        recordings[k] = replace(recordings[k], notes=(*recordings[k].notes, note))
    return recordings


def _check_shared_rows(recordings: Sequence[Recording]) -> None:
    """Refuse two recordings with the same samples."""
    decimals = [_decimals(r) for r in recordings]
    for coarser in sorted({tuple(map(min, x, y)) for x, y in itertools.combinations(decimals, 2)}, reverse=True):
        _check_at(recordings, coarser)


def _decimals(recording: Recording) -> tuple[int, ...]:
    """Return the decimals of each sensor's readings; ``MAX_SIGNIFICANT_DIGITS`` for an absent sensor."""
    decimals = []
    for sensor in SENSORS:
        reading = recording.reading(sensor)
        part = np.zeros(0) if reading is None else reading[:OF_DECIMALS][np.isfinite(reading[:OF_DECIMALS]).all(axis=1)]
        exact = (
            d
            for d in range(1, MAX_SIGNIFICANT_DIGITS)
            if part.size and np.all(np.abs(part - np.round(part, d)) < 10.0**-MAX_SIGNIFICANT_DIGITS)
        )
        decimals.append(next(exact, MAX_SIGNIFICANT_DIGITS))
    return tuple(decimals)


def _check_at(recordings: Sequence[Recording], decimals: Sequence[int]) -> None:
    """Refuse two recordings with the same samples, rounded to the decimals of each sensor."""
    keys = [_keys(r, decimals) for r in recordings]
    value = np.concatenate(keys)
    owner = np.repeat(np.arange(len(keys)), [len(k) for k in keys])
    row = np.concatenate([np.arange(len(k)) for k in keys])
    order = np.argsort(value, kind="stable")  # equal rows next to each other, in the order of recordings
    value, owner, row = value[order], owner[order], row[order]
    same = value[1:] == value[:-1]
    if np.count_nonzero(same) < MIN_STEP_ROWS - 1:
        return
    within = same & (owner[1:] == owner[:-1])
    single = ~(np.append(within, False) | np.append(False, within))  # rows that occur once in their recording
    value, owner, row = value[single], owner[single], row[single]
    for step in range(1, len(keys)):  # a row may be in several recordings: a pair of it is up to n - 1 places apart
        twin = np.flatnonzero(value[step:] == value[:-step])
        if twin.size < MIN_STEP_ROWS:
            break
        pairs = owner[twin] * len(keys) + owner[twin + step]
        for pair in np.unique(pairs):
            chosen = twin[pairs == pair]
            one, two = divmod(int(pair), len(keys))
            _check_pair(recordings[one], recordings[two], row[chosen], row[chosen + step])


def _keys(recording: Recording, decimals: Sequence[int]) -> NDArray[np.uint64]:
    """Return a hash of each row's readings: (n,) array; empty without readings."""
    pairs = zip(SENSORS, decimals, strict=True)
    columns = [c for s, d in pairs if (r := recording.reading(s)) is not None for c in np.round(r, d).T]
    key = np.zeros(recording.samples if columns else 0, np.uint64)
    for column in columns:
        key = (key ^ (column + 0.0).view(np.uint64)) * MIX  # + 0.0: no negative zero
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
    if count < MIN_STEP_ROWS or (count < common / 2 and chance < 1.0 and chance ** (count - 1) > EXPECTED_CHANCE_RUNS):
        return
    a, b = int(edges[2 * best]), int(edges[2 * best + 1])
    late, early = (two, one) if two.role == "validation" or one.role != "validation" else (one, two)
    spans = {one.name: (first[a], first[b]), two.name: (second[a], second[b])}
    rows, copied = (place(r, int(spans[r.name][0]), int(spans[r.name][1])) for r in (late, early))
    held_out = "; held-out motion would not be held out" if late.role == "validation" else ""
    raise refusal(
        late,
        "shared_rows",
        f"{rows} are those of recording {early.name}, {copied} ({common} rows are the same){held_out}",
        "record each by itself, or remove the copy",
    )
