"""Check the quality of a recording: refuse impossible values; flag gaps, clipped and stuck readings for the fits.

Refused are times at another rate than the stated one, a specific force far from gravity, readings beyond the range,
rates that contradict the table or the rotation of gravity, and an attitude that is no rotation: the cause is nearly
always a wrong unit or column. ``pipeline.checks.mounting`` checks the mounting.

A reading is *stuck* where it is constant for longer than noise allows. The share ``p`` of equal neighbours in windows
of 64 samples measures the noise of the channel. A run of ``L`` equal values among ``n`` is expected ``n p^(L-1)`` times
by chance, with the 95th percentile of ``p``, and flagged if that is below 10^-6. If this percentile exceeds one half,
the noise is below the resolution, and no run is flagged.

The unit of the angular rates follows from the rotation of gravity between rests. In the sensor's axes,

    du/dt = -(s w) x u

with the direction u of the specific force, measured at rest before and after a move; the reading w of the gyroscope,
minus its mean in these rests; and the unknown s, deg/s per unit of the gyroscope. With the right s, the integral from u
before the move gives u after it. With any other possible unit (57.3 times, or another range of the sensor) the error is
tens of degrees.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from imu_logs.clocks import bursts_error, rounded_error
from imu_logs.log import Log
from imu_logs.profile import Checks
from imu_logs.units import ATTITUDE, DEGREES, FORCE_UNITS, TABLE_CHANNELS, TRIADS
from pipeline.core.errors import IngestError
from pipeline.core.records import SENSOR_UNITS, Index, Integers, Mask, Note, Recording, Values, median, runs_of
from pipeline.core.settings import Sensor

GAP, CLIPPED, STUCK = np.uint16(1), np.uint16(2), np.uint16(4)  # bits of ``Recording.flags``
GAP_INTERVALS = 1.5  # half way to one missing sample
JITTER_NOTED, JITTER_TOO_LARGE = 0.2, 0.5  # rms, relative to the median interval; spectra need regular samples
FULL_SCALE_MARGIN = 1.2  # sensors read up to a fifth beyond their nominal range
RAIL = 1e-4  # relative; the largest code of 16 bits is 3e-5 below full scale
FULL_SCALE_TOLERANCE = 1e-3  # relative; with nominal counts per unit the largest code may be above full scale by this
NEIGHBOUR_WINDOW = 64  # samples in which the share of equal neighbours is counted
EXPECTED_CHANCE_RUNS = 1e-6  # expected number of such runs in the recording
SHORTEST_RUN = 20  # samples; the estimate of p from windows of 64 is too coarse for less
FEWEST_STEPS = 64  # of the resolution: a channel with a smaller span shows noise alone
EQUAL_NEIGHBOUR_SHARE = 0.5  # share of equal neighbours at which noise is below the resolution
MAX_NOTED_STRETCHES = 10  # of stuck rows that have a note each; more are one note: ``check`` lists 20 notes of a file
DEAD_ROWS = 1000  # shorter recordings may be constant by their resolution
NEAR = 0.7  # of a factor between two units; other units differ by more than its square
LEAST_COUNTS = 1500.0  # g: accelerometers have 2048 counts per g and more
FORCE_RANGE_G = (0.3, 3.0)  # about 1 g at rest; another unit is wrong by a factor of 9.8 or 1000
QUATERNION_TOLERANCE = 0.01  # components rounded to two decimals
RATE_TOLERANCE = 0.2  # another unit of time is wrong by a factor of 1000
MEDIAN_SAMPLES = 200_000  # samples that a median is taken of
# Largest readings of a sensor at rest: gravity with a bias of a fifth, zero-rate output of consumer MEMS (MPU-6050
# product specification 3.1). Where a log is coarse, a rest repeats such a reading although it is not clipped.
REST_LIMITS = {"accelerometer": 1.2, "gyroscope": 20.0}
TURNING_DPS = 5.0  # a smaller rate is of the size of a low-cost gyroscope's bias
# Factors that would make wrong intervals right, and the kind of times that this indicates.
_OTHER_FACTORS = {
    1e-3: "times of a unit a thousand times shorter", 1e3: "times of a unit a thousand times longer",
    1e-6: "times of a unit a million times shorter", 1e6: "times of a unit a million times longer", 1e-9: "ns",
}  # fmt: skip
ROTATION_BLOCK_S = 0.25  # two blocks make the shortest rest, half a second
MIN_VARIANCE_SAMPLES = 5  # samples, for a variance
STILL_VARIANCE_RATIO = 9.0  # times the 10th percentile of the variance
MIN_RELATIVE_VARIANCE = 1e-7  # relative to the square of the specific force
LARGEST_DRIFT_DEG = 2.0  # between any two parts of a rest; more is slow motion
LARGEST_STEP_DEG = 0.5  # from block to block of a rest; a turn at 2 deg/s
BLOCK_NOISE = 5.0  # standard deviations between the means of two blocks; in 10^5 blocks noise exceeds it less than once
ROTATION_BINS = 64  # a half turn rotates by less than 3 deg in each
LONGEST_MOVE_S = 30.0  # a bias of 0.5 deg/s then adds 15 deg, the limit FITS_DEG
SMALLEST_TURN_DEG = 20.0  # above FITS_DEG, so that a prediction without rotation does not fit
MIN_MEDIAN_MOVES = 3  # for a median
MOST_MOVES = 40  # bounds the cost
MAX_ROTATION_SAMPLES = 200_000  # bounds the cost
FITS_DEG, FAILS_DEG = 15.0, 30.0  # the error of any other possible unit is tens of degrees
INTERVALS_S = 5e-5, 0.5  # between samples of an IMU: others cannot be integrated over moves of a second
TURN_CHANNELS = {"table_angle", "table_rate"}  # with them, other checks compare the rates in scale
BETWEEN_TIME_UNITS = (1e-3, 1e-6, 1e3, 1e6)  # between s, ms and us
RANGE_FACTORS = (1 / 8, 1 / 4, 1 / 2, 2.0, 4.0, 8.0)  # between full-scale ranges of a gyroscope, 250 to 2000 deg/s


def flag_gaps(table: Log, flags: NDArray[np.uint16], checks: Checks) -> list[Note]:
    """Flag gaps, and note irregular intervals; raise ``IngestError`` beyond ``checks.missing_time`` of missing time."""
    steps = np.diff(table.time_ns)
    usual = float(median(steps))
    limit = GAP_INTERVALS * usual
    if int(steps.max()) <= limit:
        return _irregular(table, steps, usual)
    rows = np.flatnonzero(steps > limit) + 1
    flags[rows] |= GAP
    lengths = steps[rows - 1]
    lost = float(np.sum(lengths - usual)) / float(table.time_ns[-1] - table.time_ns[0])
    detail = f"gaps longer than {GAP_INTERVALS} times the median interval of {usual / 1e6:.6g} ms;"
    detail += f" the longest lasts {lengths.max() / 1e9:.6g} s, {lost:.3%} of the time is missing"
    if lost > checks.missing_time:
        message = f"{rows.size} {detail}"
        hint = f"ingest.checks.missing_time allows a share of {checks.missing_time:g}"
        error = IngestError(message, table.place(int(rows[np.argmax(lengths)])), code="missing_time", hint=hint)
        raise bursts_error(table) or rounded_error(table, error) or error
    return [table.note("N-GAP", rows, detail), *_irregular(table, steps[steps <= limit], usual)]


def without_gaps(recording: Recording) -> Recording:
    """Return a recording whose times are made, without the gaps between them."""
    flags = None if recording.flags is None else recording.flags & ~GAP
    return replace(recording, flags=flags, notes=tuple(note for note in recording.notes if note.code != "N-GAP"))


def _irregular(table: Log, steps: Integers, usual: float) -> list[Note]:
    if not steps.size or int(steps.max()) - int(steps.min()) <= JITTER_NOTED * usual:
        return []
    jitter = float(np.sqrt(np.mean((steps / usual - 1.0) ** 2)))
    if jitter <= JITTER_NOTED:
        return []
    detail = f"intervals scatter by {jitter:.0%} rms of their median of {usual / 1e6:.6g} ms"
    if jitter > JITTER_TOO_LARGE:
        detail += ": too irregular for spectra and Allan deviations"
    return [table.note("N-JITTER", np.array([0, len(table.time_ns) - 1]), detail)]


def flag_clipped(table: Log, sensor: str, full_scale: float, flags: NDArray[np.uint16]) -> list[Note]:
    """Flag readings at full scale, g or deg/s; refuse those far beyond it."""
    notes = []
    for channel in TRIADS[sensor]:
        values = table.values[channel]
        count = table.count_sizes.get(channel, 0.0)
        largest = max(float(values.max()), -float(values.min()))
        if largest < (least := full_scale - max(1.5 * count, RAIL * full_scale)):
            continue
        size = np.abs(values)
        if largest > FULL_SCALE_MARGIN * full_scale:
            row = int(np.argmax(size > FULL_SCALE_MARGIN * full_scale))
            message = (
                f"{channel} is {values[row]:.6g} {SENSOR_UNITS[sensor]} at {table.time_ns[row] / 1e9:.9g} "
                f"s, beyond {FULL_SCALE_MARGIN} times the full scale of {full_scale:g}; correct "
                f"ingest.csv.columns.{channel}.unit or sensor.{sensor}.full_scale"
            )
            raise IngestError(message, table.place(row), code="beyond_full_scale")
        # Many sensors read beyond their nominal range (131 counts per deg/s reach 250.1 deg/s), some by a fifth: a
        # largest value beyond the range that occurs more than once is clipped, too.
        clipped = (size >= least) & (size <= (1.0 + FULL_SCALE_TOLERANCE) * full_scale)
        at_largest = size >= size.max() - 1.5 * count
        if size.max() > full_scale and at_largest.sum() > 1:
            clipped |= at_largest
        rows = np.flatnonzero(clipped)
        if rows.size:
            flags[rows] |= CLIPPED
            detail = f"{channel} reaches the full scale of {full_scale:g} {SENSOR_UNITS[sensor]} and may be clipped"
            notes.append(table.note("N-CLIP", rows, detail))
    return notes


def flag_flat_tops(table: Log, sensor: str, flags: NDArray[np.uint16]) -> list[Note]:
    """Flag readings that repeat the largest or the smallest value of their channel more often than noise allows.

    The range of such a sensor or logger is smaller than is stated. k repetitions are expected ``n p^k`` times by
    chance, with p as for stuck readings, of the other values. A value that a sensor may read at rest is no such end.
    Logs with a table's motion are not searched: a table may keep its largest rate, and its log contradicts a
    clipped reading.
    """
    notes: list[Note] = []
    if set(TABLE_CHANNELS) & table.values.keys():
        return notes
    for channel in TRIADS[sensor]:
        values = table.values[channel]
        steps, ends = np.abs(np.diff(values)), (values.min(), values.max())
        same = steps == 0.0
        if ends[1] - ends[0] < FEWEST_STEPS * np.min(steps, where=~same, initial=np.inf):
            continue
        share = max(equal_share(same & (values[1:] != ends[0]) & (values[1:] != ends[1])), 1.0 / NEIGHBOUR_WINDOW)
        for end in (e for e in ends if abs(e) > REST_LIMITS[sensor]):
            at_end = values == end
            rows = np.flatnonzero(at_end & ((flags & CLIPPED) == 0))
            by_chance = len(values) * share ** np.count_nonzero(same & at_end[1:])
            if not rows.size or share > EQUAL_NEIGHBOUR_SHARE or by_chance > EXPECTED_CHANCE_RUNS:
                continue
            flags[rows] |= CLIPPED
            detail = f"{channel} repeats {end:.6g} {SENSOR_UNITS[sensor]}, the end of its readings, more often than"
            detail += f" noise allows: clipped below the stated sensor.{sensor}.full_scale, and left out of every fit"
            notes.append(table.note("N-CLIP", rows, detail))
    return notes


def find_stuck(table: Log, sensor: str, flags: NDArray[np.uint16]) -> dict[str, Index]:
    """Return the rows, by channel, of readings that are constant for longer than the noise of the channel allows.

    ``IngestError``: an axis is constant in half of the rows or more, while the other axes of its sensor change.
    """
    neighbours = {c: table.values[c][1:] == table.values[c][:-1] for c in TRIADS[sensor]}
    found = {}
    for channel, same in neighbours.items():
        if not _in_a_row(same, SHORTEST_RUN - 1):
            continue
        others = [not s.any() or equal_share(s) <= EQUAL_NEIGHBOUR_SHARE for c, s in neighbours.items() if c != channel]
        dead = bool(same.all()) and len(same) >= DEAD_ROWS
        rows = _stuck_rows(same, equal_share(same))
        rows = np.arange(len(same)) if dead else rows[(flags[rows] & CLIPPED) == 0]
        if not rows.size:
            continue
        value = f"{table.values[channel][rows[0]] + 0.0:.6g} {SENSOR_UNITS[sensor]}"
        if rows.size >= len(same) / 2 and others and all(others):
            part = f"stays at one value for longer than its noise allows in {rows.size} of"
            what = f"is {value} in all" if dead else part
            message = f"{channel} {what} {len(same) + 1} rows, while the other axes change"
            hint = "is the column right, and the sensor's axis alive?"
            raise IngestError(message, table.path if dead else table.place(int(rows[0])), code="stuck", hint=hint)
        if rows.size < len(same) / 2:
            found[channel] = rows
    return found


def _common_rows(found: Mapping[str, Index]) -> dict[str, Index]:
    """Cut runs that are longer, by chance, than the runs of other channels that were stuck at the same time."""
    runs = {c: np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1) for c, rows in found.items()}
    starts, stops = (np.array([run[end] for of in runs.values() for run in of]) for end in (0, -1))

    def cut(first: int, last: int) -> Index:
        first = starts[(starts >= first) & (starts < first + SHORTEST_RUN) & (starts <= last)].max()
        last = stops[(stops <= last) & (stops > last - SHORTEST_RUN) & (stops >= first)].min()
        return np.arange(first, last + 1)

    return {c: np.concatenate([cut(int(run[0]), int(run[-1])) for run in of]) for c, of in runs.items()}


def flag_stuck(table: Log, found: Mapping[str, Index], flags: NDArray[np.uint16]) -> list[Note]:
    """Flag stuck rows; return a note for each stretch of rows, or one note if there are many stretches."""
    if not found:
        return []
    found = _common_rows(found)
    temperature = table.values.get("temperature")
    same = None if temperature is None else temperature[1:] == temperature[:-1]
    every = np.unique(np.concatenate([*found.values()]))
    stretches = np.split(every, np.flatnonzero(np.diff(every) > 1) + 1)
    where = f" in {len(stretches)} places" if len(stretches) > MAX_NOTED_STRETCHES else ""
    notes = []
    flags[every] |= STUCK
    for rows in [every] if where else stretches:
        first_rows = {channel: stuck[0] for channel, at in found.items() if (stuck := at[np.isin(at, rows)]).size}
        channel, row = next(iter(first_rows.items()))
        unit = next(SENSOR_UNITS[sensor] for sensor, triad in TRIADS.items() if channel in triad)
        one = f"stays at {table.values[channel][row] + 0.0:.6g} {unit}"
        stay = one if len(first_rows) == 1 and not where else f"stay{'s' * (len(first_rows) == 1)} at one value{where}"
        first, last = int(rows[0]), int(rows[-1])
        detail = f"{', '.join(first_rows)} {stay} for longer than noise allows"
        if not where:
            detail += f", for {(table.time_ns[last] - table.time_ns[first]) / 1e9:.3g} s"
        if not where and "table_angle" in table.values:
            turned = abs(np.subtract(*table.values["table_angle"][[last, first]]))
            detail += f" while the table turns by {turned:.3g} deg"
        if not where and same is not None and same[first:last].all() and equal_share(same) <= EQUAL_NEIGHBOUR_SHARE:
            detail += ", and the temperature with them"
        notes.append(table.note("N-STUCK", rows, f"{detail}: stuck, and left out of every fit"))
    return notes


def equal_share(same: Mask) -> float:
    """Return the 95th percentile of the share of equal neighbours, over windows that are not entirely equal."""
    whole = len(same) // NEIGHBOUR_WINDOW * NEIGHBOUR_WINDOW
    if whole == 0:
        return 1.0
    shares = same[:whole].reshape(-1, NEIGHBOUR_WINDOW).mean(axis=1)
    partial = shares[shares < 1.0]
    if not partial.size:
        return 1.0
    place = 0.95 * (partial.size - 1)  # np.quantile costs more than the rest of this function
    return float(np.interp(place, np.arange(partial.size), np.sort(partial)))


def _stuck_rows(same: Mask, share: float) -> Index:
    """Return the rows in runs of equal values that are too long for chance."""
    if share > EQUAL_NEIGHBOUR_SHARE:
        return np.zeros(0, np.intp)
    p = max(share, 1.0 / NEIGHBOUR_WINDOW)
    longest = max(SHORTEST_RUN, int(np.ceil(np.log(EXPECTED_CHANCE_RUNS / len(same)) / np.log(p))) + 1)
    if not _in_a_row(same, longest - 1):
        return np.zeros(0, np.intp)
    runs = runs_of(same)
    long = runs[runs[:, 1] - runs[:, 0] + 1 >= longest]
    return np.concatenate([np.arange(a, b + 1) for a, b in long])


def _in_a_row(same: Mask, count: int) -> bool:
    """Return whether ``count`` successive neighbours are equal."""
    if np.count_nonzero(same) < count:
        return False
    places, further = np.flatnonzero(same), count - 1
    return bool(np.any(places[further:] - places[: len(places) - further] == further))


def examine(table: Log, sensor: Sensor | None, checks: Checks) -> tuple[NDArray[np.uint16] | None, list[Note]]:
    """Return quality flags (None if none is set) and notes; raise ``IngestError`` for impossible values."""
    for channels in (*TRIADS.values(), ATTITUDE):
        missing = [c for c in channels if c not in table.values]
        if 0 < len(missing) < len(channels):
            message = f"{', '.join(missing)} missing; {', '.join(channels)} come together or not at all"
            raise IngestError(message, table.path, code="missing_column")
    if len(table.time_ns) < 2:
        raise IngestError(f"{len(table.time_ns)} data rows; at least 2 are needed", table.path, code="no_rows")
    _check_rate(table, checks)
    _check_force(table)
    _check_attitude(table)
    flags = np.zeros(len(table.time_ns), np.uint16) if table.flags is None else table.flags.copy()
    notes = flag_gaps(table, flags, checks)
    stuck: dict[str, Index] = {}
    for name in (s for s, triad in TRIADS.items() if triad[0] in table.values):
        if sensor is not None:
            notes += flag_clipped(table, name, sensor.of(name).full_scale, flags)
        notes += flag_flat_tops(table, name, flags)
        stuck |= find_stuck(table, name, flags)
    notes += flag_stuck(table, stuck, flags)
    if not TURN_CHANNELS & table.values.keys():
        _check_time_unit(table)
    _check_turn_rate(table)
    return (flags if flags.any() else None), notes


def _check_rate(table: Log, checks: Checks) -> None:
    if checks.rate_hz is None:
        return
    interval_us = float(np.median(np.diff(table.time_ns))) / 1e3
    ratio = interval_us * checks.rate_hz / 1e6
    if abs(ratio - 1.0) <= RATE_TOLERANCE:
        return
    looks = [times for factor, times in _OTHER_FACTORS.items() if abs(ratio * factor - 1.0) <= RATE_TOLERANCE]
    message = f"the median interval is {interval_us:g} us, and ingest.checks.rate_hz of {checks.rate_hz:g} Hz expects"
    message += f" {1e6 / checks.rate_hz:g} us{f'; the numbers look like {looks[0]}' if looks else ''}"
    hint = "correct ingest.csv.columns.time.unit or ingest.checks.rate_hz"
    raise IngestError(message, table.path, code="wrong_rate", hint=hint)


def _check_force(table: Log) -> None:
    if "accel_x" not in table.values:
        return
    stride = -(-len(table.time_ns) // MEDIAN_SAMPLES)
    squares = np.asarray(sum(table.values[c][::stride] ** 2 for c in TRIADS["accelerometer"]))
    usual = float(np.sqrt(median(squares)))
    low, high = FORCE_RANGE_G
    if low <= usual <= high:
        return
    pairs, near = itertools.permutations(FORCE_UNITS.items(), 2), 1.0 / NEAR
    alike = [f"{unit} declared as {stated}" for (unit, own), (stated, of) in pairs if NEAR < usual * of / own < near]
    hint = f"the numbers look like {' or '.join(alike)}" if alike else "is the unit or the scale right?"
    if usual > LEAST_COUNTS:
        hint = "the numbers look like raw counts, which need counts_per_unit"
    message = f"median specific force is {usual:.4g} g, and a log of rests and turns has about 1 g (allowed {low} to"
    message += f" {high}): {hint}; correct ingest.csv.columns.accel_x.unit (accel_y, accel_z)"
    raise IngestError(message, table.path, code="implausible_force")


def _check_attitude(table: Log) -> None:
    if ATTITUDE[0] not in table.values:
        return
    norm = np.sqrt(sum(table.values[c] ** 2 for c in ATTITUDE))
    wrong = np.flatnonzero(np.abs(norm - 1.0) > QUATERNION_TOLERANCE)
    if wrong.size:
        row = int(wrong[0])
        message = f"the table's quaternion has the length {norm[row]:.4g} at {table.time_ns[row] / 1e9:.9g} s"
        message += f" ({wrong.size} such samples); 1 is expected"
        raise IngestError(message, table.place(row), code="bad_attitude")


def _check_turn_rate(table: Log) -> None:
    """Raise ``IngestError`` if rates differ by a factor of 180/pi from the table's, or from gravity's rotation.

    Without a table's angle or rate, also if they differ from gravity's rotation by that of another full-scale range.
    """
    if "gyro_x" not in table.values:
        return
    stride = -(-len(table.time_ns) // MEDIAN_SAMPLES)
    if "table_rate" in table.values:
        rate = np.abs(table.values["table_rate"][::stride])
        turning = rate > max(TURNING_DPS, 0.3 * float(rate.max()))
        if turning.sum() < 20:
            return
        size = np.sqrt(sum(table.values[c][::stride][turning] ** 2 for c in TRIADS["gyroscope"]))
        ratio = float(median(size / rate[turning]))
        seen = f"while the table turns the angular rate is {ratio:.3g} times the table's"
    else:
        found = declared_scale(table)
        if found is None:
            return
        ratio, seen = found
    for factor, what in ((1 / DEGREES, "rad/s that were declared as deg/s"), (DEGREES, "deg/s declared as rad/s")):
        if NEAR < ratio / factor < 1 / NEAR:
            hint = "correct ingest.csv.columns.gyro_x.unit (gyro_y, gyro_z)"
            raise IngestError(f"{seen}: the numbers look like {what}", table.path, code="implausible_rate", hint=hint)
    if not TURN_CHANNELS & table.values.keys():
        what = "the gyroscope has another full-scale range than declared, or the times are wrong by this factor"
        key = "counts_per_unit" if "gyro_x" in table.count_sizes else "unit"
        hint = f"correct ingest.csv.columns.gyro_x.{key} (gyro_y, gyro_z), or the unit of the time"
        raise IngestError(f"{seen}: {what}", table.path, code="implausible_rate", hint=hint)


@dataclass(frozen=True)
class MoveByHand:
    """A move between two rests."""

    turns: Values  # integral of the angular rate over parts of the move, (64, 3), unit of the gyroscope times s
    before: Values  # direction of the specific force at rest
    after: Values

    @property
    def angle_deg(self) -> float:
        """Angle of gravity's rotation in the sensor's axes, deg."""
        return float(np.degrees(np.arccos(np.clip(self.before @ self.after, -1.0, 1.0))))

    @property
    def way(self) -> float:
        """Total angle of the move by the gyroscope, in its unit times s."""
        return float(np.linalg.norm(self.turns, axis=1).sum())


def interval_of(steps: Values) -> float:
    """Return the usual interval from the steps of time; the mean step forward where most times are written twice."""
    middle = float(np.median(steps))
    return middle if middle > 0 else float(np.mean(np.maximum(steps, 0.0)))


def rests_of(force: Values, interval_s: float) -> list[tuple[int, int]]:
    """Return start and stop of stretches of at least half a second at rest, from (n, 3) forces in any unit."""
    width = max(MIN_VARIANCE_SAMPLES, round(ROTATION_BLOCK_S / interval_s))
    count = len(force) // width
    if count < 4:
        return []
    blocks = force[: count * width].reshape(count, width, 3)
    means = blocks.mean(axis=1)
    scatter = blocks.var(axis=1).sum(axis=1)
    size = float(np.median(np.linalg.norm(means, axis=1)))
    still = scatter < max(STILL_VARIANCE_RATIO * float(np.quantile(scatter, 0.1)), MIN_RELATIVE_VARIANCE * size**2)
    noise = BLOCK_NOISE * float(np.sqrt(2.0 * np.quantile(scatter, 0.1) / width))
    slow = np.linalg.norm(np.diff(means, axis=0), axis=1) <= max(np.radians(LARGEST_STEP_DEG) * size, noise)
    still &= np.append(slow, False) | np.append(False, slow)
    found = [(a, b) for a, b in runs_of(still).tolist() if b - a >= 2]
    drift = max(np.radians(LARGEST_DRIFT_DEG) * size, noise)
    return [(a * width, b * width) for a, b in found if np.linalg.norm(means[a:b] - means[a], axis=1).max() <= drift]


def moves_of(force: Values, rate: Values, time_s: Values) -> list[MoveByHand]:
    """Return the moves between rests in which gravity rotated by more than 20 degrees; (n, 3) readings in any unit."""
    steps = np.diff(time_s, append=2 * time_s[-1] - time_s[-2])
    rests = rests_of(force, interval_of(steps))
    found: list[MoveByHand] = []
    for (a, b), (c, d) in itertools.pairwise(rests):
        if len(found) == MOST_MOVES or time_s[c] - time_s[b - 1] > LONGEST_MOVE_S:
            continue
        ends = [force[a:b].mean(axis=0), force[c:d].mean(axis=0)]
        before, after = (e / np.linalg.norm(e) for e in ends)
        start = max(a, b - 1)
        bias = (rate[a:b].mean(axis=0) + rate[c:d].mean(axis=0)) / 2
        turned = (rate[start : c + 1] - bias) * steps[start : c + 1, None]
        edges = np.linspace(0, len(turned), ROTATION_BINS + 1).astype(int)
        sums = np.concatenate([np.zeros((1, 3)), np.cumsum(turned, axis=0)])
        move = MoveByHand(np.diff(sums[edges], axis=0), before, after)
        if move.angle_deg > SMALLEST_TURN_DEG:
            found.append(move)
    return found


def misfit_deg(moves: Sequence[MoveByHand], scales: Sequence[float]) -> Values:
    """Return the median over moves of ``misfits_deg``: (len(scales),) array, deg."""
    return np.asarray(np.median(misfits_deg(moves, scales), axis=0))


def misfits_deg(moves: Sequence[MoveByHand], scales: Sequence[float]) -> Values:
    """Return the angle between predicted and measured gravity after each move, for each scale: (moves, scales) array.

    ``scales``: candidates of ``s``, deg/s per unit of the gyroscope.
    """
    factors = np.radians(np.asarray(scales, float))[None, :, None]
    direction = np.repeat(np.stack([m.before for m in moves])[:, None, :], len(scales), axis=1)
    for part in np.stack([m.turns for m in moves], axis=1):
        vector = -part[:, None, :] * factors
        angle = np.linalg.norm(vector, axis=2, keepdims=True)
        axis = vector / np.maximum(angle, 1e-12)
        along = np.sum(axis * direction, axis=2, keepdims=True)
        cos, sin = np.cos(angle), np.sin(angle)
        direction = direction * cos + np.cross(axis, direction) * sin + axis * along * (1 - cos)
    after = np.stack([m.after for m in moves])[:, None, :]
    return np.asarray(np.degrees(np.arccos(np.clip(np.sum(direction * after, axis=2), -1.0, 1.0))))


def _both_sensors(table: Log) -> tuple[Values, Values, Values] | None:
    """Return force, (n, 3), rate, (n, 3), and time, (n,), of the first samples; None without both sensors."""
    if not {"accel_x", "gyro_x"} <= table.values.keys():
        return None
    part = slice(0, MAX_ROTATION_SAMPLES)
    force, rate = (np.column_stack([table.values[c][part] for c in TRIADS[s]]) for s in ("accelerometer", "gyroscope"))
    return force, rate, (table.time_ns[part] - table.time_ns[0]) / 1e9


def _check_time_unit(table: Log) -> None:
    """Raise ``IngestError`` if only over times of another unit the rates turn gravity as it is measured."""
    interval, (shortest, longest) = interval_of(np.diff(table.time_ns)) / 1e9, INTERVALS_S
    signals = None if shortest <= interval <= longest else _both_sensors(table)
    if signals is None:
        return
    force, rate, time_s = signals
    for factor in (f for f in BETWEEN_TIME_UNITS if shortest <= interval * f <= longest):
        moves = moves_of(force, rate, time_s * factor)
        if len(moves) >= MIN_MEDIAN_MOVES and (misfit := float(misfit_deg(moves, [1.0])[0])) <= FITS_DEG:
            message = f"the median interval is {interval:g} s; in {len(moves)} moves between rests gravity turns by the"
            message += f" angle of the rates if the times are multiplied by {factor:g} ({misfit:.1f} deg error)"
            hint = "correct ingest.csv.columns.time.unit"
            raise IngestError(message, table.path, code="wrong_rate", hint=hint)


def declared_scale(table: Log) -> tuple[float, str] | None:
    """Return the factor by which the angular rates are wrong, and the evidence; None if they are right or undecided."""
    signals = _both_sensors(table)
    moves = [] if signals is None else moves_of(*signals)
    if len(moves) < MIN_MEDIAN_MOVES:
        return None
    scales = (1.0, DEGREES, 1 / DEGREES, *RANGE_FACTORS)
    misfits = misfit_deg(moves, scales)
    best = int(np.argmin(misfits))
    if misfits[0] < SMALLEST_TURN_DEG or misfits[best] > min(FITS_DEG, 0.5 * misfits[0]):
        return None
    return 1 / scales[best], (
        f"in {len(moves)} moves between rests gravity turns by the angle of the rates if they are multiplied by "
        f"{scales[best]:.4g} ({misfits[best]:.1f} deg error, {misfits[0]:.0f} deg as declared)"
    )
