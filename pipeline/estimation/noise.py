"""Estimate the noise of a sensor from its recordings, and the prior of its bias wander for a fit.

    noise[n] = white * w[n] + wander * m[n]        (``pipeline.core.records.Noise``)

with unit white noise w and a unit first-order Gauss-Markov process m. The first of these sources that exists determines
the noise:

1. ``static``: a long rest. Temperature and warm-up, which would look like wander, are regressed out. The scatter within
   the rests of the other recordings is also used for the white noise, if it agrees.
2. ``rests``: the rests of the other recordings, each with a separate mean. In recordings by hand the unit creeps
   (``pipeline.physics.signal.quiet_motion``): gravity moves from one axis to another, which is not wander of a bias.
   The accelerometer's wander is then estimated from the component along gravity, and its white noise from the scatter
   about a parabola in time. A hand trembles in place: the integral of its rate is bounded. So the correlation time is
   at most the length of a rest. With the 100 s of a sensor file, a tremor of 0.4 deg/s would be a wander of 1 deg/s.
3. ``residual``: the scatter of windows of 16 samples in turns about a local polynomial: white noise only. With P the
   projection that removes the polynomial and R the autocovariance of the filter, ``median(|P y|^2) = white^2 tr(P R)
   (1 - 2/(9 nu))^3``, where ``nu = tr(P R)^2 / tr(P R P R)`` (Satterthwaite 1946; the median is robust against windows
   over a ramp).
4. ``data_sheet``: the figures of the sensor file, ``white = noise_density sqrt(1 / (2 dt))``.

Readings in steps of d have a rounding error of standard deviation ``d / sqrt(12)`` (GUM F.2.2.1). Where the noise is
below half a step it does not show: ``white`` is then at least this, and the wander is that of the sensor file. An axis
whose readings do not change at all in the rests has the white noise of the sensor file.

``white`` is the noise of a raw sample: the effect of a filter is removed by its exact autocovariance, from its impulse
response. If the recordings do not show wander, it is the sensor file's figure if they allow it, else 0
(``Noise.wander_source``). A recording held out for validation is not used.

Rests are cut into blocks. The block means and the scatter within the blocks have a restricted likelihood:

    mean_b = d_b beta + white (sqrt(v_b) e_b + sqrt(q) m_b)
    S      = sum of squares about the block means,   E S = white^2 sum n_b (r_0 - v_b + q (1 - B_bb))

where

    white, q, tau, B : the noise model of ``pipeline.estimation.gauss_markov``; sqrt(q) is the ratio wander / white
    e_b  : unit white noise; m_b: the average of m over block b; n_b: its samples
    r    : autocovariance of the filter's output for white noise of variance 1; v_b: variance of its mean over a block
    d_b  : a constant for each rest, and functions that a rest cannot separate from the bias: temperature and warm-up
    beta : nuisance parameters, projected out, so that they do not bias the estimate of the noise

    -2 log L = log det C + log det(d^T C^-1 d) + nu log(E S) + (N - p + nu) log white^2

with ``nu`` degrees of freedom of S, maximised over the white noise at every q and tau.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from pipeline.core.errors import ConfigurationError, InputError
from pipeline.core.records import (
    NOISE_OF_ROWS,
    SENSORS,
    Integers,
    Mask,
    Noise,
    Recording,
    SensorCalibration,
    UnitRecordings,
    Values,
    WanderLikelihood,
    median,
    noise_of_steps,
)
from pipeline.core.settings import DataSheet, Sensor
from pipeline.estimation.gauss_markov import (
    MAX_PRIOR_WIDTHS,
    SHARPEST_WIDTH,
    STATED_WIDTH,
    TIME_FACTORS,
    Blocks,
    WanderPrior,
    fast,
    orthonormal,
    restricted_on_grid,
    variance_of_average,
)
from pipeline.physics.signal.filters import filter_autocovariance, temperature_of, variance_of_mean
from pipeline.physics.signal.quiet_motion import component_along_gravity, creep_of_readings, rounding_of_readings
from pipeline.physics.signal.rests import rest_readings, stretches_of, usable

CHANGING_KINDS = ("soak", "slow")  # kinds of recordings whose readings change slowly by more than noise
CORRELATION_TIME_FACTORS = np.exp2(np.arange(-6.0, 4.0))  # correlation times of the grid, over that of the sensor file
TIMES_BY_HAND = np.exp2(np.arange(-11.0, 4.0))  # the same by hand: from 0.05 s at 100 s; a tremor has 8 to 12 Hz
MIN_BLOCK_SAMPLES = 8  # samples of a block
MIN_NOISE_SAMPLES = 60  # which determine the white noise to a tenth
POLYNOMIAL_WINDOW, WINDOW_DEGREE, WINDOW_ARC_DEG = 16, 4, 60.0  # samples, degree of the polynomial, largest turn within
WARM_UP_S = (60.0, 180.0, 500.0)  # time constants of warm-up that are regressed out
SMALLEST_WHITE = 1e-9  # keeps the weights of a noise-free recording finite
DETECTION_GAIN, AGREEMENT_LOSS = 6.0, 4.0  # twice the difference in log-likelihood
REST_BLOCKS = 60  # of all rests together
SQRT_Q_GRID = np.concatenate([[0.0], np.geomspace(2e-3, 5.0, 40)])  # sqrt(q) of the grid; a step is 22 %
MIN_NUISANCE_SINGULAR_VALUE = 1e-3  # singular value of unit columns, below which two nuisance columns count as one


def estimate_noise(sensor: str, recordings: Sequence[Recording], data_sheet: DataSheet) -> Noise:
    """Return white noise and bias wander of a sensor; raise ``ConfigurationError`` if it has no readings."""
    fitted = [r for r in recordings if r.role != "validation" and r.reading(sensor) is not None and r.samples > 1]
    return _not_below_rounding(_of_recordings(sensor, fitted, data_sheet), sensor, fitted, data_sheet)


def _not_below_rounding(noise: Noise, sensor: str, recordings: Sequence[Recording], data_sheet: DataSheet) -> Noise:
    """Return the noise with at least the rounding error of coarse readings as white noise."""
    steps, rounding = rounding_of_readings(recordings, sensor)
    constant = noise.white <= SMALLEST_WHITE
    if not np.any(constant | (steps > 0.0)):
        return noise
    stated = data_sheet.white(recordings[0].interval)
    white = np.maximum(np.where(constant, stated, noise.white), steps / np.sqrt(12.0))
    found = _with_stated_wander(white, data_sheet, "data_sheet" if constant.all() and stated else noise.source)
    return replace(found, step=steps, rounding=rounding) if np.any(steps > 0.0) else found


def _of_recordings(sensor: str, fitted: list[Recording], data_sheet: DataSheet) -> Noise:
    """Return the noise as it shows in the recordings, else that of the sensor file."""
    others = [r for r in fitted if NOISE_OF_ROWS not in r.source and r.kind not in CHANGING_KINDS]
    if fitted and not others:
        return _of_means_or_soaks(sensor, fitted, data_sheet)
    fitted = others
    static = [r for r in fitted if r.role == "static"]
    static_rests, rests = (
        [
            RestReadings(time, reading, 0 if recording.clock_shared else number)
            for number, recording in enumerate(fitted, start=1)
            if (recording.role == "static") == whole
            for time, reading in rest_readings(recording, sensor, whole_recording=whole)
        ]
        for whole in (True, False)
    )
    if sum(len(rest.time) for rest in static_rests) >= MIN_NOISE_SAMPLES:
        noise = _noise_of_rests(static_rests, static, data_sheet, "static", other_rests=rests)
        return replace(noise, length=sum(float(rest.time[-1] - rest.time[0]) for rest in static_rests))
    if sum(len(rest.time) for rest in rests) >= MIN_NOISE_SAMPLES:
        if sensor == "accelerometer" and _by_hand(fitted):
            return _noise_along_gravity(rests, fitted, data_sheet)
        return _noise_of_rests(rests, fitted, data_sheet, "rests")
    white = _white_of_turns(fitted, sensor)
    if white is not None:
        return _with_stated_wander(white, data_sheet, "residual")
    if not fitted:
        raise ConfigurationError(f"no recording holds readings of the {sensor}: record static (a rest of some minutes)")
    return _with_stated_wander(np.full(3, data_sheet.white(fitted[0].interval)), data_sheet, "data_sheet")


def _of_means_or_soaks(sensor: str, recordings: list[Recording], data_sheet: DataSheet) -> Noise:
    """Return the noise of units with no rests or turns; in soaks and slow movement the fast part is noise."""
    soaks = [values for r in recordings if r.kind in CHANGING_KINDS and (values := r.reading(sensor)) is not None]
    if not soaks:
        return _with_stated_wander(np.full(3, recordings[0].source[NOISE_OF_ROWS][sensor]), data_sheet, "data_sheet")
    steps = np.concatenate([np.abs(np.diff(values, axis=0)) for values in soaks])
    return _with_stated_wander(noise_of_steps(steps), data_sheet, "rests")


def _by_hand(recordings: list[Recording]) -> bool:
    logged = any(r.table_angle is not None or r.table_rate is not None for r in recordings)
    return any(r.role == "rests" for r in recordings) and not logged


def _noise_along_gravity(rests: list[RestReadings], recordings: list[Recording], data_sheet: DataSheet) -> Noise:
    """Return the noise of an accelerometer in a unit that may creep: see the module, 2."""
    components = [component_along_gravity(rest.time, rest.reading) for rest in rests]
    along = [replace(rest, reading=values[:, None]) for rest, (values, _) in zip(rests, components, strict=True)]
    creeping = [k for k, (_, creeps) in enumerate(components) if creeps]
    noise = _noise_of_rests(along, recordings, data_sheet, "rests", creeping=creeping)
    creeps = [creep_of_readings(rest.time, rest.reading) for rest in rests]
    counts, covariance = np.array([len(rest.time) for rest in rests]), filter_autocovariance(recordings[0])
    fitted = counts - [creep.freedom for creep in creeps]
    free = np.sum(counts * (covariance[0] - fitted * variance_of_mean(covariance, counts)))
    white = np.sqrt(np.sum([creep.squares for creep in creeps], axis=0) / float(free))
    return replace(noise, white=np.maximum(white, SMALLEST_WHITE), wander=np.full(3, noise.wander[0]))


def _noise_of_rests(
    rests: list[RestReadings],
    recordings: list[Recording],
    data_sheet: DataSheet,
    source: str,
    *,
    other_rests: Sequence[RestReadings] = (),
    creeping: Sequence[int] = (),
) -> Noise:
    """Return the noise of ``rests``; the scatter within ``other_rests`` is used for the white noise only."""
    covariance = filter_autocovariance(recordings[0])
    memory = int(np.searchsorted(-np.abs(covariance), -0.01 * covariance[0]))
    shortest = max(MIN_BLOCK_SAMPLES, 4 * memory)
    blocks = _blocks_of(rests, shortest)
    if other_rests and len(covariance) == 1:  # a filter still settles in a short rest after a move
        blocks = _with_scatter(blocks, _blocks_of(other_rests, shortest))
    passes_wander = (2.0 * covariance.sum() - covariance[0]) > 0.5  # gain at 0 Hz: a high-pass removes wander
    informative = blocks.cut & ~np.isin(blocks.rest, creeping)
    if informative.sum() - len(np.unique(blocks.rest[informative])) < 3 or not passes_wander:
        expected = np.sum(blocks.count * (covariance[0] - variance_of_mean(covariance, blocks.count)))
        return _with_stated_wander(np.sqrt(blocks.scatter / max(float(expected), 1e-300)), data_sheet, source)
    design, lengths = _nuisance(blocks, recordings, source, creeping), [float(r.time[-1] - r.time[0]) for r in rests]
    if source == "static" or not _by_hand(recordings):
        return _most_likely(blocks, design, covariance, data_sheet, source)
    noise = _most_likely(blocks, design, covariance, data_sheet, source, longest=max(lengths))
    return replace(noise, length=sum(lengths)) if noise.wander_source == "rests" else noise


def _nuisance(blocks: _RestBlocks, recordings: list[Recording], source: str, creeping: Sequence[int]) -> Values:
    """Return the nuisance columns: a constant for each rest, a line for creep; temperature and warm-up if static."""
    rest, centre = blocks.rest[blocks.cut], (blocks.start + blocks.length / 2.0)[blocks.cut]
    columns = [(rest == r).astype(float) for r in np.unique(rest)]
    if source != "static":
        columns += [(rest == r) * (centre - centre[rest == r].mean()) for r in np.intersect1d(rest, creeping)]
        return np.stack(columns, axis=1)
    columns += [np.exp(-(centre - centre.min()) / tau) for tau in WARM_UP_S if centre.min() < 4.0 * tau]
    for recording in recordings:
        if recording.temperature is not None and np.isfinite(recording.temperature).all():
            smooth = np.interp(centre, recording.time, temperature_of(recording))
            if np.ptp(smooth) > 0.1:
                columns.append(smooth - smooth.mean())
    return np.stack(columns, axis=1)


def _most_likely(
    blocks: _RestBlocks,
    design: Values,
    covariance: Values,
    data_sheet: DataSheet,
    source: str,
    *,
    longest: float = float("inf"),
) -> Noise:
    """Return the most likely noise; one ratio of wander to white noise for all axes unless they differ.

    ``longest``: largest possible correlation time by hand, s.
    """
    times = (CORRELATION_TIME_FACTORS if np.isinf(longest) else TIMES_BY_HAND) * data_sheet.wander_time_s
    log_likelihood, white = _likelihood(blocks, design, covariance, times)
    gain = 2.0 * (log_likelihood - log_likelihood[:, :1])
    pooled = gain.sum(axis=2).max(axis=1)
    possible = max(np.count_nonzero(times <= longest), 1)
    row, time_source = int(np.argmax(pooled[:possible])), source
    stated_row = int(np.argmin(np.abs(times - data_sheet.wander_time_s)))
    if np.isinf(longest) and pooled[row] < max(pooled[stated_row] + AGREEMENT_LOSS, DETECTION_GAIN):
        row, time_source = stated_row, "data_sheet"
    if pooled[row] < DETECTION_GAIN:  # the sensor file's wander if the likelihood allows it, else 0
        noise = _with_stated_wander(white[stated_row, 0], data_sheet, source)
        nearest = np.argmin(np.abs(SQRT_Q_GRID[:, None] - noise.wander / noise.white), axis=0)
        if -float(np.take_along_axis(gain[stated_row], nearest[None], axis=0).sum()) >= AGREEMENT_LOSS:
            noise = replace(noise, wander=np.zeros(3), wander_source=source)
    else:
        columns = range(gain.shape[2])
        axes_differ = gain[row].max(axis=0).sum() - pooled[row] > DETECTION_GAIN
        axes = [slice(c, c + 1) for c in columns] if axes_differ else [slice(None)] * len(columns)
        ratio = np.array([_peak(gain[row][:, axis].sum(axis=1)) for axis in axes])
        likeliest = np.maximum([np.interp(ratio[c], SQRT_Q_GRID, white[row, :, c]) for c in columns], SMALLEST_WHITE)
        noise = Noise(likeliest, likeliest * ratio, float(times[row]), source, source, time_source)
    if source != "static":
        return noise
    near = np.clip(row + np.log2(TIME_FACTORS).astype(int), 0, len(times) - 1)
    wander = SQRT_Q_GRID * float(np.sqrt(np.mean(noise.white**2)))
    return replace(noise, likelihood=WanderLikelihood(times[near], wander, 0.5 * gain[near].sum(axis=2)))


def _peak(gain: Values) -> float:
    """Return the ratio at the maximum, by a parabola through the three points about it."""
    k = int(np.argmax(gain))
    if k < 2 or k == len(gain) - 1:
        return float(SQRT_Q_GRID[k])
    x, (a, b, c) = np.log(SQRT_Q_GRID[k - 1 : k + 2]), gain[k - 1 : k + 2]
    bend = a - 2.0 * b + c
    return float(np.exp(x[1] + (0.5 * (a - c) / bend * (x[1] - x[0]) if bend < 0 else 0.0)))


def _with_stated_wander(white: Values, data_sheet: DataSheet, source: str) -> Noise:
    wander = np.full(3, data_sheet.bias_wander)
    return Noise(np.maximum(white, SMALLEST_WHITE), wander, data_sheet.wander_time_s, source)


def _white_of_turns(recordings: list[Recording], sensor: str) -> Values | None:
    """Return the white noise from short windows about a local polynomial, or None if there are too few."""
    squares, nu = [], 1.0
    basis, _ = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, POLYNOMIAL_WINDOW), WINDOW_DEGREE + 1))
    P = np.eye(POLYNOMIAL_WINDOW) - basis @ basis.T
    for recording in recordings:
        values = recording.reading(sensor)
        assert values is not None  # noqa: S101
        slow = usable(recording, values)
        if recording.table_rate is not None:
            slow &= np.abs(recording.table_rate) * recording.interval * POLYNOMIAL_WINDOW < WINDOW_ARC_DEG
        lags = filter_autocovariance(recording)[:POLYNOMIAL_WINDOW]
        PR = P @ scipy.linalg.toeplitz(np.pad(lags, (0, POLYNOMIAL_WINDOW - len(lags))))
        trace = float(np.trace(PR))
        nu = trace**2 / float(np.sum(PR * PR.T))
        for start, stop in stretches_of(recording, slow):
            count = (stop - start) // POLYNOMIAL_WINDOW
            windows = values[start : start + count * POLYNOMIAL_WINDOW].reshape(count, POLYNOMIAL_WINDOW, 3)
            squares.append(np.sum(np.einsum("ij,njc->nic", P, windows) ** 2, axis=1) / trace)
    scatter = np.concatenate(squares) if squares else np.empty((0, 3))
    if len(scatter) < 5:
        return None
    return np.sqrt(median(scatter) / (1.0 - 2.0 / (9.0 * nu)) ** 3)


@dataclass(frozen=True)
class RestReadings:
    """Times, s, and readings of a rest; rests with the same ``clock`` have a common time."""

    time: Values
    reading: Values
    clock: int


@dataclass(frozen=True)
class _RestBlocks:
    # each (b,), s; first sample time and duration of each block
    start: Values
    length: Values
    count: Integers  # (b,); samples of each
    mean: Values  # (b, 3); minus the mean of its rest
    rest: Integers  # (b,); number of the rest of each
    clock: Integers  # (b,); blocks of the same number have a known distance in time
    cut: Mask  # (b,); whether its rest has two blocks or more: the mean of a single one does not show wander
    scatter: Values  # (3,); sum of squares about the block means


def _blocks_of(rests: Sequence[RestReadings], shortest: int) -> _RestBlocks:
    """Cut rests into blocks of at least ``shortest`` samples; a shorter rest is one block."""
    sizes = np.array([len(rest.time) for rest in rests])
    size = max(shortest, int(np.ceil(sizes.sum() / REST_BLOCKS)))
    if not np.any(sizes >= 2 * size):  # many rests, all short: cut each in two rather than none
        size = max(shortest, int(sizes.max()) // 2)
    pieces = np.maximum(1, sizes // size)
    rest = np.repeat(np.arange(len(rests)), pieces)
    place = np.arange(len(rest)) - (np.cumsum(pieces) - pieces)[rest]  # of a block in its rest
    counts = (place + 1) * sizes[rest] // pieces[rest] - place * sizes[rest] // pieces[rest]
    time = np.concatenate([r.time for r in rests])
    values = np.concatenate([r.reading for r in rests])
    of = np.repeat(np.arange(len(rests)), sizes)
    values -= (np.stack([np.bincount(of, v) for v in values.T], axis=1) / sizes[:, None])[of]
    clock = np.array([r.clock for r in rests])[rest]
    first = np.cumsum(counts) - counts
    mean = np.add.reduceat(values, first) / counts[:, None]
    scatter = np.maximum(np.einsum("nc,nc->c", values, values) - counts @ (mean * mean), 0.0)
    length = (time[first + counts - 1] - time[first]) * counts / np.maximum(counts - 1, 1)
    return _RestBlocks(time[first], length, counts, mean, rest, clock, pieces[rest] > 1, scatter)


def _with_scatter(blocks: _RestBlocks, others: _RestBlocks) -> _RestBlocks:
    """Add the scatter of other blocks, without their means, if both agree within 3 standard deviations on each axis."""
    nu = np.array([np.sum(b.count - 1) for b in (blocks, others)], float)
    if np.any(nu < 1) or np.any(blocks.scatter == 0) or np.any(others.scatter == 0):
        return blocks
    log_ratio = np.log(blocks.scatter / nu[0]) - np.log(others.scatter / nu[1])
    if np.any(np.abs(log_ratio) > 3.0 * np.sqrt(2.0 / nu[0] + 2.0 / nu[1])):
        return blocks
    without_means = replace(others, rest=others.rest + blocks.rest.max() + 1, cut=np.zeros_like(others.cut))
    stacked = {name: np.concatenate([value, vars(without_means)[name]]) for name, value in vars(blocks).items()}
    return _RestBlocks(**{**stacked, "scatter": blocks.scatter + others.scatter})


def _likelihood(blocks: _RestBlocks, design: Values, covariance: Values, times: Values) -> tuple[Values, Values]:
    """Return the log likelihood and the white noise: (t, r, 3), by correlation time, ``SQRT_Q_GRID`` and axis.

    ``design``: (c, p), the nuisance columns d, at the c blocks that are ``cut``. ``covariance``: (l,), the filter's
    autocovariance r. ``times``: (t,), s, of correlation.
    """
    v = variance_of_mean(covariance, blocks.count)
    within = float(np.sum(blocks.count * (covariance[0] - v)))
    correlated = covariance[0] ** 2 / (covariance[0] ** 2 + 2.0 * np.sum(covariance[1:] ** 2))
    nu = max(float(np.sum(blocks.count - 1)) * correlated, 1e-9)
    cut = blocks.cut
    cut_blocks = Blocks(np.arange(cut.sum()), 1.0 / v[cut], blocks.start[cut], blocks.length[cut], blocks.clock[cut])
    basis = orthonormal(design, v[cut], MIN_NUISANCE_SINGULAR_VALUE)
    means, times_s = blocks.mean[cut], times.tolist()
    log_determinant, squares = restricted_on_grid(cut_blocks, times_s, SQRT_Q_GRID.tolist(), basis, means)
    inner = np.sum(blocks.count * (1.0 - variance_of_average(blocks.length, times[:, None])), axis=1)
    expected = within + np.outer(inner, SQRT_Q_GRID**2).ravel()
    free = len(cut_blocks.weight) - basis.shape[1] + nu
    variance = np.maximum((squares + nu * blocks.scatter / expected[:, None]) / free, 1e-18)
    log_likelihood = -0.5 * ((log_determinant + nu * np.log(expected))[:, None] + free * np.log(variance))
    shape = (len(times), len(SQRT_Q_GRID), -1)
    return log_likelihood.reshape(shape), np.sqrt(variance).reshape(shape)


def noise_of(sensor: str, recordings: Sequence[Recording], data_sheet: DataSheet) -> Noise | None:
    """Return ``estimate_noise``; None where that is impossible."""
    try:
        return estimate_noise(sensor, recordings, data_sheet)
    except (ConfigurationError, InputError):
        return None


def with_noises(recordings: Sequence[Recording], model: Sensor, sensors: Sequence[str] = SENSORS) -> UnitRecordings:
    """Return the recordings of a unit with the noise of its sensors."""
    return UnitRecordings([*recordings], {s: noise_of(s, recordings, model.of(s)) for s in sensors})


def required_noises(
    recordings: UnitRecordings, sensor_model: Sensor, calibrations: Mapping[str, SensorCalibration | None]
) -> dict[str, Noise]:
    """Return the noise of each calibrated sensor; ``ConfigurationError`` if nothing determines it."""
    known, noises = [s for s, c in calibrations.items() if c is not None], recordings.noises
    return {s: noises[s] or estimate_noise(s, recordings.filtered, sensor_model.of(s)) for s in known}


def wander_prior(noise: Noise | None, data_sheet: DataSheet) -> WanderPrior:
    """Return the prior of the bias wander from the sensor file and the noise of a static recording.

    It is the prior of the sensor file times the likelihood of the static recording at each wander and correlation time.
    A standard deviation from a rest of length T, about ``T / (2 tau)`` independent values, has the relative uncertainty
    ``sqrt(tau / T)``. If that is below ``SHARPEST_WIDTH``, the likelihood is widened to that of a shorter rest, because
    no sensor is exactly a Gauss-Markov process. Above the likeliest wander, the likelihood is at least
    ``exp(-MAX_PRIOR_WIDTHS**2)`` of its maximum: the residuals of turns can show more wander than the rest (lack of
    fit). Noise that is correlated over seconds (a filter in the sensor, values repeated between samples, chance in a
    short rest) does not determine a slow wander, and is white noise in the means of the blocks of a fit: then the
    prior is that of the sensor file.
    """
    stated = WanderPrior(data_sheet.bias_wander, data_sheet.wander_time_s)
    if noise is None or noise.source != "static" or noise.likelihood is None or fast(noise):
        return stated
    width = float(np.sqrt(noise.correlation_time / noise.length))
    log_likelihood = noise.likelihood.log_likelihood * min(1.0, (width / SHARPEST_WIDTH) ** 2)
    largest = int(np.argmax(log_likelihood.max(axis=0)))
    log_likelihood[:, largest:] = np.maximum(log_likelihood[:, largest:], log_likelihood.max() - MAX_PRIOR_WIDTHS**2)
    wander, width = float(np.sqrt(np.mean(noise.wander**2))), float(np.clip(width, SHARPEST_WIDTH, STATED_WIDTH))
    return WanderPrior(wander, noise.correlation_time, width, stated, (noise.likelihood.wander, log_likelihood))
