"""Check all recordings of a unit together: its rests, its reference, its mounting, and whether they share samples.

Two recordings that share samples are refused, because motion that is in both is not held out. Their rows are compared
by the readings of the sensors, rounded to ten digits so that a conversion of units in one file makes no difference, and
again rounded to the decimals of the coarser one. Only a row that occurs once in its recording counts: the rests of a
coarse sensor repeat rows. Two recordings share samples where at least 20 such rows follow each other in both, each
within 8 rows of the one before. By chance the probability is

    (8 c / n)^19,   c : rows that occur in both,   n : rows of the longer recording

and its limit is 10^-6, as for stuck readings (``pipeline.ingest.quality_flags``). This detects whole copies, copies
shifted in rows or time, cut copies, and copies with rows left out.

Estimate the temperature between the steps of a coarse thermometer, from all recordings of a unit.

A thermometer that reads in steps h has an error of up to h / 2 as long as the temperature stays between two steps.
Smoothing cannot remove so long an error of a regressor: a warm-up, which needs no thermometer, would then explain a
bias that follows the temperature better than the temperature does. But the time of each step is known, and

    q_i = h round((T(t_i) + s e_i) / h),    T(t) = c exp(-t / theta) + m(t),    m'' white noise of density lambda

with readings q, white noise e, and a body that settles after power-on in a room that changes slowly. T maximises the
posterior; s, lambda and theta (or c = 0) maximise its evidence by Laplace's approximation.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imu_logs.units import TRIADS
from pipeline.checks.at_rest import check_axes, check_static, with_rates_at_rest
from pipeline.checks.evidence import place, refusal
from pipeline.checks.mounting import check_mounting
from pipeline.checks.reference import check_motion, check_turns
from pipeline.core.records import SENSOR_UNITS, SENSORS, Index, Note, Recording, Values, finite_rows, runs_of
from pipeline.core.settings import Settings, Table
from pipeline.ingest.quality_flags import EXPECTED_CHANCE_RUNS
from pipeline.physics.kinematics import normal_gravity_g
from pipeline.physics.signal.quiet_motion import rounding_of_readings
from pipeline.physics.signal.rests import settling_of

CELL_S = 10.0  # between the nodes of T, a line between them: of 5 degC with theta = 300 s it misses 1e-3 degC
CELL_PARTS = 4  # parts of a cell; equal readings in a part become one
MAX_TEMPERATURE_NODES = 4000  # 11 h; a longer log is left as it is
ONE_STEP = 0.99  # least share of the changes that are of one step: larger noise dithers the steps, and averages out
NOISE_GRID = (0.02, 0.04, 0.07, 0.12, 0.2)  # s over h
DRIFT_DENSITIES = tuple(10.0 ** np.arange(-12.0, -3.0))  # lambda, degC^2 / s^3: 0.03 to 30 degC in an hour
THERMAL_TIME_CONSTANTS_S = (None, *np.geomspace(50.0, 1600.0, 21))  # theta: of packages on boards to that of housings
AMPLITUDE_DEGC = 10.0  # standard deviation of c and of the level, about the mean
FEWEST_CHANGES = 2  # of the reading: without them nothing is known between the steps
# of Newton's method; change of the log posterior; share of a step
MAX_NEWTON_ITERATIONS, SETTLED_LOG_POSTERIOR, MIN_STEP_SHARE = 40, 1e-3, 1e-3
DOUBLE_ROUNDING = 1e-12  # relative: some thousand roundings of a double
MIN_STEP_ROWS, APART = 20, 8  # rows, see above
RESOLUTION_NOTE = "N-RESOLUTION"
SAME_STEP = 1e-6  # relative: rounding of a difference of decimals
MAX_SIGNIFICANT_DIGITS = 10  # of 16 bits of counts in any unit, 5 are significant; twice that
SAME_GRAVITY_G = 1e-4  # gravity changes by as much over 0.3 km of height
TENFOLD = 10.0 ** np.arange(1, MAX_SIGNIFICANT_DIGITS)[:, None, None]
FIRST_OF_DECIMALS = 8  # of them, which exclude most numbers of decimals
OF_DECIMALS = 200  # samples that determine the decimals: a finer reading ends in a zero in a tenth of them
MIX = np.uint64(0x9E3779B97F4A7C15)  # 2^64 over the golden ratio (Knuth, TAOCP 3, 6.4): spreads sums of bit patterns


def refined(recordings: Sequence[Recording]) -> list[Recording]:
    """Return the recordings of a unit; with a coarse thermometer, with the estimated temperature and a note."""
    known = [r for r in recordings if r.temperature is not None and np.isfinite(r.temperature).all()]
    step = _step(known)
    if step == 0.0 or len(known) < len(recordings) or not all(r.clock_shared for r in known):
        return list(recordings)
    first = min(float(r.time[0]) for r in known)
    if max(float(r.time[-1]) for r in known) - first > MAX_TEMPERATURE_NODES * CELL_S:
        return list(recordings)
    time, reading = (np.concatenate([getattr(r, name) for r in known]) for name in ("time", "temperature"))
    curve = _Curve(time - first, reading, step).best()
    nodes = first + CELL_S * np.arange(len(curve))
    detail = f"the thermometer reads in steps of {step:.3g} degC; between them the temperature is estimated"
    out = []
    for r in recordings:
        note = Note("N-STEPS", r.samples, 0, r.samples, f"{r.name}: {detail}")
        out.append(replace(r.noted(note), temperature=np.interp(r.time, nodes, curve)))
    return out


def _step(recordings: Sequence[Recording]) -> float:
    """Return the step of a thermometer with a smaller noise, degC; 0 for others and for a constant temperature."""
    changes = [np.abs(np.diff(np.asarray(r.temperature))) for r in recordings]
    each = np.concatenate([np.zeros(1), *changes])
    moved = each[each > 0.0]
    if len(moved) < FEWEST_CHANGES or 2 * len(moved) > len(each):
        return 0.0
    step = float(moved.min())
    return step if np.mean(moved < 1.5 * step) >= ONE_STEP else 0.0


class _Curve:
    """The curve T through nodes, fitted to readings; equal readings in a quarter of a cell are one with a count."""

    def __init__(self, time: Values, reading: Values, step: float) -> None:
        place, self.mean, self.step = time / CELL_S, float(reading.mean()), step
        keys = np.stack([np.floor(place * CELL_PARTS), np.rint(reading / step)], axis=1)
        _, inverse, count = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
        place, value = (np.bincount(inverse.ravel(), v) / count for v in (place, reading - self.mean))
        self.value, self.count, self.k = value, count.astype(float), place.astype(int)
        self.shares = 1.0 - place + self.k, place - self.k  # weights of the nodes k and k + 1
        self.nodes = int(self.k.max()) + 2
        self.last: tuple[Values, float] = np.interp(np.arange(self.nodes), self.k, value), 0.0
        self.known: dict[tuple[float, float, float | None], tuple[float, Values]] = {}

    def best(self) -> Values:
        """Return T at the nodes with the most probable noise, density and time of settling, by cyclic search."""
        noise, density, settling, before = NOISE_GRID[2], DRIFT_DENSITIES[4], THERMAL_TIME_CONSTANTS_S[12], None
        while (noise, density, settling) != before:
            before = noise, density, settling
            pairs = [(d, s) for d in DRIFT_DENSITIES for s in dict.fromkeys([settling, *THERMAL_TIME_CONSTANTS_S[::4]])]
            density, settling = max(pairs, key=lambda pair: self._evidence(noise, *pair))
            settling = max(THERMAL_TIME_CONSTANTS_S, key=lambda each: self._evidence(noise, density, each))
            noise = max(NOISE_GRID, key=lambda each: self._evidence(each, density, settling))
        return self.mean + self.known[noise, density, settling][1]

    def _evidence(self, *key: Any) -> float:  # noqa: ANN401
        if key not in self.known:
            self.known[key] = self._posterior(*key)
        return self.known[key][0]

    def _posterior(self, noise: float, density: float, settling: float | None) -> tuple[float, Values]:
        """Return the log evidence up to a constant, and T minus the mean, by Newton's method from the last result."""
        from scipy.linalg import cholesky_banded, solveh_banded  # noqa: PLC0415  (0.1 s that only this log pays)

        n, stiff, least = self.nodes, 1.0 / (density * CELL_S**3), AMPLITUDE_DEGC**-2
        prior = np.zeros((3, n))  # of m, by diagonals
        for node, weights in enumerate(((1.0, -2.0, 1.0), (4.0, -2.0, 0.0), (1.0, 0.0, 0.0))):
            prior[:, node : n - 2 + node] += stiff * np.array(weights)[:, None]
        prior[0] += least
        decay = np.zeros(n) if settling is None else np.exp(-CELL_S * np.arange(n) / settling)
        at_decay = self._at(decay)

        def objective(m: Values, c: float) -> tuple[float, Values, Values]:
            log, first, second = self._likelihood(self._at(m) + c * at_decay, noise * self.step)
            return log - 0.5 * (stiff * float(np.sum(np.diff(m, 2) ** 2)) + least * float(m @ m + c * c)), first, second

        m, c = self.last
        gained = float("inf")
        value, first, second = objective(m, c)
        for _ in range(MAX_NEWTON_ITERATIONS):
            band, (left, right) = prior.copy(), self.shares
            band[0] += np.bincount(self.k, second * left**2, n) + np.bincount(self.k + 1, second * right**2, n)
            band[1] += np.bincount(self.k, second * left * right, n)
            cross = self._back(second * at_decay)
            bent = stiff * np.diff(m, 2)
            slope = self._back(first) - least * m - np.convolve(bent, [1.0, -2.0, 1.0])
            solved = solveh_banded(band, np.stack([slope, cross], axis=1), lower=True)
            of_c = float(second @ at_decay**2 + least - cross @ solved[:, 1])  # the Schur complement
            to_c = float(first @ at_decay - least * c - cross @ solved[:, 0]) / of_c
            to_m: Values = solved[:, 0] - to_c * solved[:, 1]
            share = 1.0
            if gained < SETTLED_LOG_POSTERIOR:
                break
            while (new := objective(m + share * to_m, c + share * to_c))[0] < value and share > MIN_STEP_SHARE:
                share *= 0.5
            gained = new[0] - value
            if gained > 0.0:
                m, c, (value, first, second) = m + share * to_m, c + share * to_c, new
        self.last = m, c
        logarithms = [2.0 * float(np.sum(np.log(cholesky_banded(b, lower=True)[0]))) for b in (band, prior)]
        return value - 0.5 * (logarithms[0] - logarithms[1] + float(np.log(of_c / least))), m + c * decay

    def _at(self, nodes: Values) -> Values:
        """Return the values of a curve through the nodes at the readings."""
        return np.asarray(self.shares[0] * nodes[self.k] + self.shares[1] * nodes[self.k + 1])

    def _back(self, values: Values) -> Values:
        """Return the transpose of ``_at``: the weighted sums of values at the readings, by node."""
        left, right = (share * values for share in self.shares)
        return np.asarray(np.bincount(self.k, left, self.nodes) + np.bincount(self.k + 1, right, self.nodes))

    def _likelihood(self, curve: Values, noise: float) -> tuple[float, Values, Values]:
        """Return log L of a curve at the readings, and its first and negative second derivatives there."""
        from scipy.special import log_ndtr  # noqa: PLC0415  (as above)

        a, b = ((self.value + side * self.step - curve) / noise for side in (-0.5, 0.5))
        above = a > 0.0  # there the other tail, in which the difference keeps its digits
        a, b = np.where(above, -b, a), np.where(above, -a, b)
        low, high = log_ndtr(a), log_ndtr(b)
        log = high + np.log1p(-np.exp(np.minimum(low - high, -DOUBLE_ROUNDING)))
        at_a, at_b = (np.exp(-0.5 * x * x - 0.5 * np.log(2.0 * np.pi) - log) for x in (a, b))
        first = (at_a - at_b) / noise
        second = np.maximum((at_b * b - at_a * a) / noise**2 + first**2, 0.0)
        return float(self.count @ log), self.count * np.where(above, -first, first), self.count * second


def check_recordings(recordings: Sequence[Recording], settings: Settings) -> list[Recording]:
    """Return the recordings of a unit, their turns by the convention, with notes on faults and corrections.

    ``recordings``: in body axes, not filtered. Raises ``InputError`` if the recordings contradict each other, or the
    table's log contradicts itself or gravity.
    """
    _check_shared_rows(recordings)
    check_axes(recordings)
    recordings = [*map(_with_settling, _with_steps(with_rates_at_rest(recordings)))]
    turns, delays = check_turns(check_static(recordings, settings), settings)
    checked = refined(check_motion(check_mounting(turns, settings), delays, settings))
    return _placed(checked, settings.table)


def _with_steps(recordings: Sequence[Recording]) -> Sequence[Recording]:
    """Note the axes whose readings have steps that hide their noise, with step and decimals (``N-RESOLUTION``)."""
    noted = list(recordings)
    for sensor in SENSORS:
        steps, rounding = rounding_of_readings(recordings, sensor)
        for step in np.unique(steps[steps > 0.0]):
            off = np.sqrt(3.0) * rounding[steps == step].max()  # half-width of a rectangle
            axes = ", ".join(name for name, s in zip(TRIADS[sensor], steps, strict=True) if s == step)
            shifted = step * 10.0 ** np.arange(MAX_SIGNIFICANT_DIGITS)
            whole = np.flatnonzero(np.abs(shifted - np.rint(shifted)) < SAME_STEP * shifted).tolist()
            digits = f", {whole[0]} decimal{'s' * (whole[0] != 1)}," if whole else ""
            detail = (
                f"{axes}: steps of {step:.3g} {SENSOR_UNITS[sensor]}{digits} and noise of less than half a step: "
                f"means are off by up to {off:.3g} {SENSOR_UNITS[sensor]}, however long the "
                "recording, and effects of this size cannot be distinguished from rounding. Log more digits, or set a "
                "smaller range"
            )
            k, first = next((k, r) for k, r in enumerate(noted) if r.reading(sensor) is not None)
            noted[k] = first.noted(Note(RESOLUTION_NOTE, first.samples, 0, 0, detail))
    return noted


def _with_settling(recording: Recording) -> Recording:
    """Note an accelerometer that settles in the rests by hand, with the time that is left out or would be needed."""
    by_hand = recording.role in {"rests", "validation"} and recording.logged_rate is None
    settling = settling_of(recording) if by_hand else None
    if settling is None:
        return recording
    detail = f"after moves the accelerometer settles with a time constant of {settling.time_s:.2g} s,"
    detail += f" as with a slow filter; it is settled {settling.left_out_s:.2g} s after a rest was found"
    detail += (
        f", and the rests are too short for that: their means are off by {settling.left_g:.2g} g. Rest longer, or "
        "log without this filter"
        if settling.clear
        else ", and this time is left out of every rest"
    )
    return recording.noted(Note("N-REFERENCE" if settling.clear else "N-SETTLING", recording.samples, 0, 0, detail))


def _placed(recordings: list[Recording], table: Table) -> list[Recording]:
    """Note the gravity at the latitude if ``gravity_g`` is left at 1, and the azimuths of the turn axes."""
    latitude, azimuth = table.latitude_deg, table.azimuth_deg
    if latitude is None:
        return recordings
    gravity = normal_gravity_g(float(latitude))
    measured = [k for k, r in enumerate(recordings) if r.accelerometer is not None]
    if measured and table.gravity_g == 1.0 and abs(gravity - 1.0) >= SAME_GRAVITY_G:
        detail = (
            f"table.gravity_g is 1, its default; at latitude {latitude:g} deg gravity is {gravity:.5f} g at sea level, "
            "and 0.000315 g less for each km of height. Scale and bias of the accelerometer are then in units of local "
            f"gravity, {abs(gravity - 1.0):.3%} off standard g: set table.gravity_g={gravity:.5f} for standard g"
        )
        recordings[measured[0]] = recordings[measured[0]].noted(Note("N-GRAVITY", 1, 0, 0, detail))
    turns = [(k, r) for k, r in enumerate(recordings) if r.axis and not r.up and r.role != "validation"]
    if turns and table.azimuth_of == "turn_axis" and azimuth is not None:
        ends = [f"body {r.axis} to {(azimuth + 90.0 * (1 - r.sense)) % 360.0:g} deg in {r.name}" for _, r in turns]
        detail = "Earth's rotation is in the model: by table.azimuth_deg and the sense of the encoder the shaft points"
        detail += f" with {', '.join(ends)}, clockwise from north; if it does not, correct table.azimuth_deg by 180 deg"
        k, first = turns[0]
        recordings[k] = first.noted(Note("N-AZIMUTH", len(turns), 0, 0, detail))
    return recordings


def _check_shared_rows(recordings: Sequence[Recording]) -> None:
    recordings = [r for r in recordings if r.readings]
    decimals = [_decimals(r) for r in recordings]
    for coarser in sorted({tuple(map(min, x, y)) for x, y in itertools.combinations(decimals, 2)}, reverse=True):
        _check_at(recordings, coarser)


def _decimals(recording: Recording) -> tuple[int, ...]:
    """Return the decimals of each sensor's readings; ``MAX_SIGNIFICANT_DIGITS`` for an absent sensor."""
    decimals = []
    for sensor in SENSORS:
        reading = recording.reading(sensor)
        part = np.zeros((0, 3)) if reading is None else reading[:OF_DECIMALS]
        part = part[finite_rows(part)]
        possible = np.arange(1, MAX_SIGNIFICANT_DIGITS)
        for rows in (part[:FIRST_OF_DECIMALS], part):
            off = np.abs(rows - np.rint(rows * TENFOLD[possible - 1]) / TENFOLD[possible - 1])
            possible = possible[np.all(off < 10.0**-MAX_SIGNIFICANT_DIGITS, axis=(1, 2))]
        decimals.append(int(possible[0]) if possible.size and part.size else MAX_SIGNIFICANT_DIGITS)
    return tuple(decimals)


def _check_at(recordings: Sequence[Recording], decimals: Sequence[int]) -> None:
    """Refuse two recordings with the same samples, rounded to the decimals of each sensor."""
    value, samples = _keys(recordings, decimals), [r.samples for r in recordings]
    known = np.sort(value)  # faster than the order of equal rows
    if np.count_nonzero(known[1:] == known[:-1]) < MIN_STEP_ROWS - 1:
        return
    owner = np.repeat(np.arange(len(samples)), samples)
    row = np.concatenate([np.arange(n) for n in samples])
    order = np.argsort(value, kind="stable")  # equal rows next to each other, in the order of recordings
    value, owner, row = value[order], owner[order], row[order]
    within = (value[1:] == value[:-1]) & (owner[1:] == owner[:-1])
    single = ~(np.append(within, False) | np.append(False, within))  # rows that occur once in their recording
    value, owner, row = value[single], owner[single], row[single]
    for step in range(1, len(samples)):  # a row may be in several recordings: a pair of it is up to n - 1 places apart
        twin = np.flatnonzero(value[step:] == value[:-step])
        if twin.size < MIN_STEP_ROWS:
            break
        pairs = owner[twin] * len(samples) + owner[twin + step]
        for pair in np.unique(pairs):
            chosen = twin[pairs == pair]
            one, two = divmod(int(pair), len(samples))
            _check_pair(recordings[one], recordings[two], row[chosen], row[chosen + step])


def _keys(recordings: Sequence[Recording], decimals: Sequence[int]) -> NDArray[np.uint64]:
    """Return a hash of the readings in each row of all recordings, with zeros for those of an absent sensor."""
    key: NDArray[np.uint64] = np.zeros(1, np.uint64)
    for sensor, digits in zip(SENSORS, decimals, strict=True):
        readings = [np.zeros((r.samples, 3)) if (v := r.reading(sensor)) is None else v for r in recordings]
        for column in np.round(np.concatenate(readings), digits).T:
            key = (key ^ (column + 0.0).view(np.uint64)) * MIX  # + 0.0: no negative zero
            key ^= key >> np.uint64(29)
    return key


def _check_pair(one: Recording, two: Recording, first: Index, second: Index) -> None:
    """Refuse two recordings whose common rows follow each other in both."""
    order = np.argsort(first)
    first, second = first[order], second[order]
    common, longest = len(first), max(one.samples, two.samples)
    ahead = (np.diff(first) <= APART) & (np.diff(second) > 0) & (np.diff(second) <= APART)
    starts, stops = runs_of(ahead).T
    if not starts.size:
        return
    best = int(np.argmax(stops - starts))
    a, b = int(starts[best]), int(stops[best])
    count = b - a + 1
    chance = APART * common / longest
    if count < MIN_STEP_ROWS or (count < common / 2 and chance < 1.0 and chance ** (count - 1) > EXPECTED_CHANCE_RUNS):
        return
    late, early = (two, one) if two.role == "validation" or one.role != "validation" else (one, two)
    spans = {one.name: (first[a], first[b]), two.name: (second[a], second[b])}
    rows, copied = (place(r, int(spans[r.name][0]), int(spans[r.name][1])) for r in (late, early))
    held_out = "; held-out motion would not be held out" if late.role == "validation" else ""
    message = f"{rows} are those of recording {early.name}, {copied} ({common} rows are the same){held_out}"
    raise refusal(late, "shared_rows", message, "record each by itself, or remove the copy")
