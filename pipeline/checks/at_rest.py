"""Check single recordings: a static one that moves or has other noise, and axes that do not vary or are copies.

A static recording determines the noise of all results, so it must be at rest. It is cut into blocks of a second, of
16 samples at least. A block moves where

    a sensor scatters in it by more than 4 times the usual scatter and more than exp(5 s) times the median scatter,
        where s is the standard deviation of the logarithm of the scatters by their quartiles (correlated noise),
    its mean differs from the recording's median by more than a bias can change slowly at rest, or
    the table turns by 0.02 deg/s or more

The usual scatter is the first quartile of the blocks. Its limit is twice the scatter of the table's rests in the unit's
other recordings or twice the sensor file's white noise, whichever is larger; without rests, four times that white
noise. The slow change of a bias is at most the sum of six standard deviations of ``bias_wander``, ``bias_drift`` over
the recording, ``bias_temperature`` times the range of the temperature, ``warm_up`` (limits of the sensor file), and 6
times the usual scatter, as for fully correlated noise.

A static recording is compared with the rests of the unit's other recordings, by the table's log, or with the quietest
tenth of a recording by hand. It gets the note ``N-REFERENCE`` where

    its scatter is more than twice theirs on an axis,
    its white noise, by successive differences, is less than half of theirs on all axes, or
    its gyroscope's mean is outside the range of the table's rests by more than the sum of 6 standard deviations of a
        rest's mean, Earth's rate, the slow change above and, as the unit may lie in another attitude,
        ``g_sensitivity`` and ``g_squared_sensitivity``

It may then be a recording of another unit. White noise grows with the square root of the sampling rate: the limits
include the ratio of the rates.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from imu_logs.units import TRIADS
from pipeline.checks.evidence import LEAST_RATE_DPS, axis_index, place, quantiles, refusal
from pipeline.core.records import SENSOR_UNITS, SENSORS, Integers, Mask, Note, Recording, Values, median, once
from pipeline.core.settings import DataSheet, Sensor, Settings
from pipeline.physics.kinematics import EARTH_RATE_DPS
from pipeline.physics.signal.rests import RATE_AT_REST, RATE_AT_REST_DPS, runs, still_on_table

REST_BLOCK_S, FEWEST_OF_BLOCK = 1.0, 16  # shorter than a knock with its decay; samples, for a standard deviation
# samples of a rest, and rests of a recording, that determine the usual scatter
MIN_SAMPLES_OF_REST, MIN_RESTS_OF_SCATTER = 8, 3
LOUDER = 4.0  # the scatter of 16 samples of white noise is so large in fewer than 1 of 10^9 blocks
# quartile of a normal distribution; factor and limit of s
QUARTER_SIZE, UNUSUAL, MAX_SCATTER_DEVIATION = 0.6745, 5.0, 0.4
# a running bench adds noise to that on a desk; data sheets state typical noise
MAX_TIMES_RESTS, MAX_TIMES_DATA_SHEET = 2.0, 4.0
STEPPED_DEG = 0.1  # between two samples of a rest: five times what RATE_AT_REST_DPS turns in a second
SIGNIFICANT_DEVIATIONS_AT_REST = 6.0  # standard deviations, as in pipeline.physics.signal.rests
MIN_NOISE_SAMPLES_AT_REST = 60  # fewest that determine the noise in pipeline.estimation.noise
MIN_DRIFT_REST_S = 10.0  # in which a wander of 100 s changes by a third of its size
UNKNOWN_DEGC = 5.0  # change of temperature in some minutes of a room, where none is logged
HALF_TURN_DEG = 180.0  # in which both axes across a level turn vary by 1 g at least
SPANNED = 0.2  # of what the motion requires
INNER = (0.05, 0.95)  # shares of the samples
MIN_COPIED_SHARE = 0.5  # share of the changes of an axis that another makes at the same row, to the last digit
LEVEL_G = 0.5  # of the axes across a turn together, from which gravity turns in the body
MIN_AXIS_SAMPLES = 32  # samples, of which an axis is copied or stays


def check_static(recordings: Sequence[Recording], settings: Settings) -> list[Recording]:
    """Return the recordings of a unit; of a static one only the part at rest, with the note ``N-MOVED``.

    ``IngestError``: too little of a static recording is at rest.
    """
    if all(r.role != "static" for r in recordings):
        return list(recordings)
    sensor_model, rests = settings.sensor, _rests_of(recordings)
    resting = [_resting(r, rests, sensor_model) if r.role == "static" else r for r in recordings]
    return [_doubted(r, recordings, rests, sensor_model) if r.role == "static" else r for r in resting]


def with_rates_at_rest(recordings: Sequence[Recording]) -> list[Recording]:
    """Return the recordings, those of turns (of a sheet) with the rate that the gyroscope reads in those at rest.

    A slow turn about the vertical looks like a rest to the accelerometer.
    """
    still = [r for r in recordings if r.kind == "rest" and r.role != "validation" and r.gyroscope is not None]
    at_rest = [median(r.gyroscope[r.valid]) for r in still if r.gyroscope is not None and r.valid.any()]
    if not at_rest:
        return list(recordings)
    usual = median(np.array(at_rest)).tolist()
    return [replace(r, source={**r.source, RATE_AT_REST: usual}) if r.kind == "turn" else r for r in recordings]


def _doubted(
    recording: Recording, recordings: Sequence[Recording], rests_of: Mapping[str, Values], sensor_model: Sensor
) -> Recording:
    """Return a static recording, with the note ``N-REFERENCE`` if it contradicts the rests of the others."""
    others = [r for r in recordings if r.role != "static" and r.samples > 1]
    if recording.samples < MIN_NOISE_SAMPLES_AT_REST or not others:
        return recording
    intervals = np.array([r.interval for r in others]) / recording.interval
    faster, slower = np.sqrt(max(1.0, intervals.max())), np.sqrt(max(1.0, 1.0 / intervals.min()))
    details = []
    for sensor in SENSORS:
        reading, rests = recording.reading(sensor), rests_of[sensor]
        if not len(rests):
            rests = _rests_by_hand(recordings, sensor)
        if reading is None or not len(rests) or not len(moments := _moments_of_blocks(recording, sensor)):
            continue
        step = _digit(reading)
        static, usual = median(moments), median(rests)
        louder = float(np.max(static[0] / np.maximum(usual[0], step)))
        quieter = float(np.min(usual[1] / np.maximum(static[1], step)))
        if louder > MAX_TIMES_RESTS * faster:
            told = f"the {sensor} scatters {louder:.3g} times as much as in the rests of the other recordings"
            details.append(f"{told}; its noise would be used for all of them")
        elif quieter > MAX_TIMES_RESTS * slower:
            details.append(
                f"the {sensor} has at most {1.0 / quieter:.2g} times the white noise of the rests of the other "
                "recordings: if the recording is of another unit, the noise of this one is underestimated"
            )
        if sensor == "gyroscope":
            means = rests[:, 2]
            away = float(np.max([means.min(axis=0) - static[2], static[2] - means.max(axis=0)]))
            noise = SIGNIFICANT_DEVIATIONS_AT_REST * float(usual[0].max()) / np.sqrt(MIN_SAMPLES_OF_REST)
            most = noise + _bias_change([recording, *others], sensor_model.gyroscope)
            if away > most:
                details.append(
                    f"the {sensor} reads {away:.3g} deg/s beyond all rests of the other recordings, where the sensor "
                    f"file allows {most:.3g}: is the static recording of this unit?"
                )
    notes = [Note("N-REFERENCE", recording.samples, 0, 0, detail) for detail in details]
    return recording.noted(*notes)


def _digit(reading: Values) -> Values:
    """Return the smallest change of each axis between two samples, infinity for a constant one: (3,) array."""
    step = np.abs(np.diff(np.asfortranarray(reading), axis=0))  # numpy is fast along a contiguous axis
    return np.asarray(np.where(step > 0.0, step, np.inf).min(axis=0, initial=np.inf))


def _bias_change(recordings: Sequence[Recording], data_sheet: DataSheet) -> float:
    """Return the largest plausible change of the gyroscope's reading at rest between recordings, deg/s."""
    effects = data_sheet.effects
    attitude = 2.0 * effects.get("g_sensitivity", 0.0) + effects.get("g_squared_sensitivity", 0.0)
    known = [r.temperature for r in recordings if r.temperature is not None]
    change = float(np.ptp(np.concatenate(known))) if len(known) == len(recordings) else UNKNOWN_DEGC
    duration = max(r.time[-1] for r in recordings) - min(r.time[0] for r in recordings)
    duration = max(float(duration), sum(float(r.time[-1] - r.time[0]) for r in recordings))
    return attitude + 2.0 * EARTH_RATE_DPS + _slow(data_sheet, change, duration)


def _blocks(recording: Recording, values: Values) -> Values:
    """Return the samples in blocks of a second: (n, 3) array to (k, size, 3), (n,) array to (k, size)."""
    size = max(FEWEST_OF_BLOCK, round(REST_BLOCK_S / recording.interval))
    count = len(values) // size
    return values[: count * size].reshape(count, size, *values.shape[1:])


def _resting(recording: Recording, rests_of: Mapping[str, Values], sensor_model: Sensor) -> Recording:
    """Return the longest part of a static recording at rest, with a note if it is not all of it."""
    if recording.samples < 2 * FEWEST_OF_BLOCK:
        return recording
    count, size = _blocks(recording, recording.time).shape
    if count < 2:
        return recording
    moving, why = np.zeros(count, bool), ""
    if recording.table_rate is not None:
        rate = np.abs(_blocks(recording, recording.table_rate)).max(axis=1)
        moving = rate >= RATE_AT_REST_DPS
        why = f"the table turns at up to {rate.max():.3g} deg/s" if moving.any() else ""
    for sensor in recording.readings:
        moves, what = _moving(recording, sensor, sensor_model.of(sensor), rests_of[sensor])
        why = why or (what if moves.any() else "")
        moving |= moves
    if not moving.any():
        return recording
    parts = [(a * size, b * size if b < count else recording.samples) for a, b in runs(~moving)]
    start, stop = max(parts, key=lambda part: part[1] - part[0], default=(0, 0))
    start, stop = start + (size if start else 0), stop - (size if stop < recording.samples else 0)
    left_out = recording.samples - (stop - start)
    if stop - start < MIN_NOISE_SAMPLES_AT_REST or (stop - start) * recording.interval < MIN_DRIFT_REST_S:
        raise refusal(
            recording,
            "not_at_rest",
            f"it is for the noise at rest, and no {MIN_DRIFT_REST_S:g} s of it are at rest: {why} "
            f"({int(moving.sum())} of {count} stretches of {size * recording.interval:.3g} s move)",
            "remove it, the noise is then taken from the rests of the other recordings, or record it again",
        )
    t = recording.time
    detail = f"only {place(recording, start, stop - 1)} are used of {t[0]:.6g} to {t[-1]:.6g} s: the rest moves; {why}"
    note = Note("N-MOVED", left_out, 0, 0, detail, float(t[0]), float(t[-1]))
    return recording.select(slice(start, stop)).noted(note)


def _moving(recording: Recording, sensor: str, sheet: DataSheet, rests: Values) -> tuple[Mask, str]:
    """Return in which blocks a sensor moves, and the strongest evidence of it in words."""
    unit = SENSOR_UNITS[sensor]
    scatter, _, means = np.moveaxis(_moments_of_blocks(recording, sensor), 1, 0)
    ordered, place = np.sort(scatter, axis=0), 0.25 * (len(scatter) - 1)  # np.percentile is slow
    usual, middle = ordered[int(place)], median(scatter)
    usual = usual + place % 1.0 * (ordered[int(place) + 1] - usual)
    tiny = np.finfo(float).tiny
    spread = np.log(np.maximum(middle, tiny) / np.maximum(usual, tiny)) / QUARTER_SIZE
    louder = np.maximum(LOUDER, np.exp((QUARTER_SIZE + UNUSUAL) * np.minimum(spread, MAX_SCATTER_DEVIATION)))
    white = sheet.white(recording.interval)
    if len(rests):
        usual = np.minimum(usual, MAX_TIMES_RESTS * np.maximum(np.median(rests[:, 0], axis=0), white))
    elif white:
        usual = np.minimum(usual, MAX_TIMES_DATA_SHEET * white)
    usual = np.maximum(usual, 0.5 * _digit(_blocks(recording, np.asarray(recording.reading(sensor))).reshape(-1, 3)))
    loud = scatter / usual
    away = np.abs(means - median(means))
    change = UNKNOWN_DEGC if recording.temperature is None else float(np.ptp(recording.temperature))
    slow = _slow(sheet, change, float(recording.time[-1] - recording.time[0]))
    allowed = slow + SIGNIFICANT_DEVIATIONS_AT_REST * usual
    moving = np.any(loud > louder, axis=1) | np.any(away > allowed, axis=1)
    if np.any(loud > louder):
        return moving, f"the {sensor} scatters {loud.max():.3g} times as usual"
    what = f"the {sensor} changes by {away.max():.3g} {unit}, a resting one by {allowed.max():.3g} {unit} at most"
    return moving, what


def _slow(data_sheet: DataSheet, change: float, duration: float) -> float:
    """Return the largest plausible change of a bias at rest, for a change of temperature (degC) and a duration (s)."""
    effects = data_sheet.effects
    return (
        SIGNIFICANT_DEVIATIONS_AT_REST * data_sheet.bias_wander
        + effects.get("bias_drift", 0.0) * duration
        + effects.get("bias_temperature", 0.0) * change
        + effects.get("warm_up", 0.0)
    )


def _rests_of(recordings: Sequence[Recording]) -> dict[str, Values]:
    """Return ``_moments`` of the rests of the table's log for each sensor: (k, 3, 3) array; k = 0 without rests."""
    moments: dict[str, list[Values]] = {sensor: [np.zeros((0, 3, 3))] for sensor in SENSORS}
    for recording in recordings:
        if recording.role == "static" or recording.axis is None:
            continue
        rows = np.flatnonzero(still_on_table(recording))
        angle = np.zeros(len(rows)) if recording.table_angle is None else recording.table_angle[rows]
        stepped = np.abs(np.diff(angle)) > STEPPED_DEG  # the table moved between two samples
        ends = np.append(np.flatnonzero((np.diff(rows) > 1) | stepped) + 1, len(rows))
        starts = np.append(0, ends[:-1])
        long = np.flatnonzero(ends - starts >= MIN_SAMPLES_OF_REST)
        if not (long := long[:: len(long) // MIN_RESTS_OF_SCATTER + 1]).size:
            continue
        rows = np.concatenate([rows[starts[k] : ends[k]] for k in long])
        found = recording.readings
        parts = _moments(np.concatenate([reading[rows] for reading in found.values()], axis=1), (ends - starts)[long])
        for k, sensor in enumerate(found):
            moments[sensor].append(parts[..., 3 * k : 3 * k + 3])
    return {sensor: np.concatenate(parts) for sensor, parts in moments.items()}


def _rests_by_hand(recordings: Sequence[Recording], sensor: str) -> Values:
    """Return ``_moments`` of the quietest tenth of each recording by hand, with an unknown mean (NaN)."""
    found = [np.zeros((0, 3, 3))]
    for recording in recordings:
        reading = recording.reading(sensor) if recording.role == "rests" else None
        if reading is None or len(moments := _moments_of_blocks(recording, sensor)) < 10:
            continue
        scatter, white, _ = np.percentile(moments, 10.0, axis=0)
        found.append(np.stack([scatter, white, np.full(3, np.nan)])[None])
    return np.concatenate(found)


@once
def _moments_of_blocks(recording: Recording, sensor: str) -> Values:
    """Return ``_moments`` of a sensor in blocks of a second: (k, 3, 3) array."""
    blocks = _blocks(recording, np.asarray(recording.reading(sensor)))
    return _moments(blocks.reshape(-1, 3), np.full(*blocks.shape[:2])) if len(blocks) else np.zeros((0, 3, 3))


def _moments(values: Values, sizes: Integers) -> Values:
    """Return scatter, white noise and mean of the parts with k numbers of samples of (n, c) values: (k, 3, c) array.

    The white noise by successive differences does not include slow changes (J. von Neumann, Annals of Mathematical
    Statistics 12 (1941), 367-395).
    """
    starts, size = np.cumsum(sizes) - sizes, sizes[:, None]
    mean = np.add.reduceat(values, starts) / size
    change = np.diff(values, axis=0, append=values[-1:])
    change[starts + sizes - 1] = 0.0  # to the next part
    squares = np.stack([(values - np.repeat(mean, sizes, axis=0)) ** 2, 0.5 * change**2])
    spread = np.sqrt(np.add.reduceat(squares, starts, axis=1) / (size - 1))
    return np.stack([*spread, mean], axis=1)


def check_axes(recordings: Sequence[Recording]) -> None:
    """Refuse an axis that is constant while the table turns, or that is a copy of another."""
    for recording in recordings:
        if recording.samples >= MIN_AXIS_SAMPLES:
            _check_copies(recording)
            if recording.axis is not None:
                _check_spans(recording)


def _check_copies(recording: Recording) -> None:
    """Refuse an axis that is a copy of another.

    Where axis a changes, its copy b reads ``b[n] = a[n]`` and not ``b[n-1] = a[n]``. In a log of few digits both are
    equally frequent by chance, so the difference of their shares of k changes counts. Its standard deviation by chance
    is at most ``sqrt(0.5 / k)``, that of two digits of equal frequency.
    """
    pairs = itertools.combinations(range(3), 2)
    for (sensor, reading), (one, two) in itertools.product(recording.readings.items(), pairs):
        a, b = reading[:, one], reading[:, two]
        if np.count_nonzero(np.abs(a) == np.abs(b)) <= MIN_COPIED_SHARE * MIN_AXIS_SAMPLES:
            continue  # in any rows: too few for a refusal
        changing = a[1:] != a[:-1]
        if changing.sum() < MIN_AXIS_SAMPLES:
            continue
        least = max(MIN_COPIED_SHARE, SIGNIFICANT_DEVIATIONS_AT_REST * float(np.sqrt(0.5 / changing.sum())))
        for sign, what in ((1.0, "a copy"), (-1.0, "the negative")):
            same, by_chance = ((a[1:] == sign * other)[changing] for other in (b[1:], b[:-1]))
            if same.mean() - by_chance.mean() > least:
                names = [TRIADS[sensor][i] for i in (one, two)]
                message = f"{names[1]} is {what} of {names[0]} in {same.mean():.0%} of the rows in which it changes"
                raise refusal(recording, "copied_axis", message, f"correct ingest.csv.columns.{names[1]}.column")


def _check_spans(recording: Recording) -> None:
    rate, axis = recording.logged_rate, axis_index(recording)
    if rate is None:
        return
    stuck: list[tuple[str, float, str, str]] = []  # channel, its span, the required one with its unit, the rows
    if recording.gyroscope is not None:
        required, spans = float(_span(rate)), _span(recording.gyroscope).tolist()
        turned_other = max(spans) >= SPANNED * required and int(np.argmax(spans)) != axis  # see check_mounting
        if required > LEAST_RATE_DPS and spans[axis] < SPANNED * required and not turned_other:
            stuck.append((TRIADS["gyroscope"][axis], spans[axis], f"{required:.3g} deg/s", "the rows"))
    angle = recording.table_angle
    if angle is None:
        angle = np.cumsum(0.5 * (rate[1:] + rate[:-1]) * recording.time_steps)
    if recording.accelerometer is not None and np.ptp(angle) >= HALF_TURN_DEG:
        turns = np.abs(np.diff(angle, prepend=angle[0])) > RATE_AT_REST_DPS * recording.interval
        rows = turns if turns.sum() >= MIN_AXIS_SAMPLES else np.ones(len(angle), bool)  # rests may be most of the time
        spans = _span(recording.accelerometer[-len(angle) :][rows]).tolist()
        across = [(axis + 1) % 3, (axis + 2) % 3]
        # Not in a turn about the vertical or about another axis: see check_mounting.
        if max(spans[i] for i in across) >= LEVEL_G >= spans[axis]:
            which = "the rows in which the table turns"
            stuck += [(TRIADS["accelerometer"][i], spans[i], "1 g", which) for i in across if spans[i] < SPANNED]
    for channel, span, expected, which in stuck:
        message = (
            f"{channel} stays within {span:.3g} {expected.partition(' ')[2]} in nine tenths of {which}, while the "
            f"table's motion about {recording.axis} makes it vary by {expected}"
        )
        hint = "is the column right, and does this axis of the sensor work?"
        raise refusal(recording, "stuck", message, hint)


def _span(values: Values) -> Values:
    low, high = quantiles(values, *INNER)
    return np.asarray(high - low)
