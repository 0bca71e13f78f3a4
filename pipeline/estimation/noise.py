"""The noise of a sensor, from what its recordings hold.

    noise[n] = white * w[n] + wander * m[n]        (``pipeline.records.Noise``)

It is pinned by the first of these that there is:

1. ``static``: a long rest. Temperature and warm-up, which would pass for wander, are regressed out. The scatter within
   the rests of the other recordings joins in for the white noise, where it agrees.
2. ``rests``: the rests of the other recordings, each with a mean of its own. By hand a unit creeps, which moves gravity
   from one axis to another and is no wander of a bias: there the accelerometer's wander is that of the component along
   gravity, and its white noise the scatter about a parabola in time.
3. ``residual``: short windows of turns, less a local polynomial: white noise alone. With P the projection that removes
   the polynomial and R the autocovariance of the filter, ``median(|P y|^2) = white^2 tr(P R) (1 - 2/(9 nu))^3``, where
   ``nu = tr(P R)^2 / tr(P R P R)`` (Satterthwaite 1946; the median, so that windows over a ramp do not count).
4. ``data_sheet``: ``white = noise_density sqrt(1 / (2 dt))``.

``white`` is that of a raw sample: a filter is undone by its exact autocovariance, taken from its impulse response.
Wander that the recordings cannot tell from none is the data sheet's, unless they exclude that; then it is 0.
A recording held out for validation is not looked at.

Rests are cut into blocks. The restricted likelihood of their means and of the scatter within them is that of

    mean_b = d_b beta + white sqrt(v_b) e_b + bias m_b
    S      = sum of squares about the block means,   E S = white^2 sum n_b (r_0 - v_b + ratio^2 (1 - B_bb))

where

    white, ratio, tau, B : the noise model of ``pipeline.estimation.gauss_markov``
    r    : autocovariance of the filter's output for white noise of variance 1; v_b: variance of its mean over a block
    d_b  : a constant for each rest, and what a rest cannot separate from the bias: temperature and warm-up
    beta : nuisance parameters, projected out, so that they do not bias the estimate of the noise

    -2 log L = log det C + log det(d^T C^-1 d) + nu log(E S) + (N - p + nu) log white^2

with ``nu`` degrees of freedom of S. White noise is at its maximum at every ratio and correlation time.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import ConfigurationError, InputError
from pipeline.estimation.gauss_markov import (
    DEFAULT_TIME_S,
    FARTHEST,
    SHARPEST_WIDTH,
    SHEET_WIDTH,
    TIME_FACTORS,
    Blocks,
    GaussMarkov,
    Prior,
    Setting,
    fast,
    orthonormal,
    variance_of_average,
)
from pipeline.records import Noise, Recording, median
from pipeline.signal.filters import filter_autocovariance, temperature_of, variance_of_mean
from pipeline.signal.quiet_motion import along_gravity, creep_of
from pipeline.signal.rests import rest_readings, stretches_of, usable

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.records import Integers, Mask, Values

TIMES = np.exp2(np.arange(-6.0, 4.0))  # correlation times tried, in those of the data sheet
SHORTEST_BLOCK = 8  # samples of a block
FEWEST_SAMPLES = 60  # which tell white noise to a tenth
WINDOW, WINDOW_DEGREE, WINDOW_ARC_DEG = 16, 4, 60.0
WARM_UP_S = (60.0, 180.0, 500.0)  # time constants of warm-up that are regressed out
SMALLEST_WHITE = 1e-9  # keeps the weights of a noise-free recording finite
SEEN, AGREES = 6.0, 4.0  # twice the gain in log-likelihood
BLOCKS = 60  # of all rests together
RATIOS = np.concatenate([[0.0], np.geomspace(2e-3, 5.0, 40)])  # of the bias to white noise: a step is 22 %
WEAKEST_DIRECTION = 1e-3  # of unit columns, below which two nuisance columns count as one


def estimate_noise(sensor: str, recordings: list[Recording], data_sheet: dict[str, Any]) -> Noise:
    """Return white noise and bias wander of a sensor.

    ``data_sheet``: ``noise_density`` (g/sqrt(Hz) or deg/s/sqrt(Hz)), ``bias_wander`` (g or deg/s), ``wander_time_s``.
    Raises ``ConfigurationError`` if neither the recordings nor the data sheet tell the noise.
    """
    known = [r for r in recordings if r.role != "validation" and r.reading(sensor) is not None and r.samples > 1]
    static = [r for r in known if r.role == "static"]
    rests = _rests_of([r for r in known if r.role != "static"], sensor, everything=False)
    long_rests = _rests_of(static, sensor, everything=True)
    for source, found, more in (("static", long_rests, rests), ("rests", rests, [])):
        if sum(len(rest.time) for rest in found) >= FEWEST_SAMPLES:
            if sensor == "accelerometer" and source == "rests" and _by_hand(known):
                return _noise_along_gravity(found, known, data_sheet)
            chosen = static if source == "static" else known
            noise = _noise_of_rests(found, more, chosen, data_sheet, source)
            length = sum(float(rest.time[-1] - rest.time[0]) for rest in found) if source == "static" else 0.0
            return replace(noise, length=length)
    white = _white_of_turns(known, sensor)
    return _with_sheet_wander(white, data_sheet, "residual") if white is not None else _of_sheet(known, data_sheet)


def noise_of(sensor: str, recordings: Sequence[Recording], settings: Mapping[str, Any]) -> Noise | None:
    """Return the noise that a stage before has found, else the estimate; None where nothing tells it.

    ``settings``: ``noise`` by sensor, where a stage before has found it; ``sensor``, the data sheet.
    """
    if "noise" in settings:
        known: Noise | None = settings["noise"][sensor]
        return known
    try:
        return estimate_noise(sensor, list(recordings), dict(settings.get("sensor", {}).get(sensor) or {}))
    except (ConfigurationError, InputError):
        return None


def prior_of(sensor: str, recordings: Sequence[Recording], settings: Mapping[str, Any]) -> Prior:
    """Return what the data sheet and a static recording tell of the bias instability.

    The prior is that of the data sheet times the likelihood of the static recording at each wander and correlation
    time. A standard deviation from a rest of length T, about ``T / (2 tau)`` independent values, has the relative
    uncertainty ``sqrt(tau / T)``. Where that is below ``SHARPEST_WIDTH``, the likelihood counts as that of a shorter
    rest: no sensor is a Gauss-Markov process that well. Above the likeliest wander, the likelihood is at least
    ``exp(-FARTHEST**2)`` of its maximum: the residuals of turns can show more wander than the rest (lack of fit).
    Noise that is correlated over seconds (a filter in the sensor, values held between samples, chance in a short rest)
    says nothing of a slow wander, and counts as white noise in the means of the blocks of a fit: then the prior is that
    of the data sheet.

    ``settings``: section ``sensor``.
    """
    sheet = settings.get("sensor", {}).get(sensor) or {}
    static = any(r.role == "static" and r.reading(sensor) is not None and r.samples > 1 for r in recordings)
    return static_or_sheet(noise_of(sensor, recordings, settings) if static and sheet else None, sheet)


def static_or_sheet(noise: Noise | None, sheet: Mapping[str, Any]) -> Prior:
    """Return the prior by the data sheet, and by a noise that a static recording tells (``prior_of``)."""
    stated = Prior(float(sheet.get("bias_wander") or 0.0), _wander_time(sheet))
    if noise is None or noise.source != "static" or noise.seen is None or fast(noise):
        return stated
    width = np.sqrt(noise.correlation_time / noise.length)
    seen = noise.seen * min(1.0, float(width / SHARPEST_WIDTH) ** 2)
    largest = int(np.argmax(seen.max(axis=0)))  # turns may show more than a rest, never less
    seen[:, largest:] = np.maximum(seen[:, largest:], seen.max() - FARTHEST**2)
    return Prior(
        float(np.sqrt(np.mean(noise.wander**2))),
        noise.correlation_time,
        float(np.clip(width, SHARPEST_WIDTH, SHEET_WIDTH)),
        stated,
        (RATIOS * float(np.sqrt(np.mean(noise.white**2))), seen),
    )


def _rests_of(recordings: Sequence[Recording], sensor: str, *, everything: bool) -> list[Rest]:
    """Return the rests of recordings; those of recordings that share a clock share their time."""
    return [
        Rest(time, reading, 0 if recording.clock_shared else number)
        for number, recording in enumerate(recordings, start=1)
        for time, reading in rest_readings(recording, sensor, everything=everything)
    ]


def _by_hand(recordings: list[Recording]) -> bool:
    logged = any(r.table_angle is not None or r.table_rate is not None for r in recordings)
    return any(r.role == "rests" for r in recordings) and not logged


def _noise_along_gravity(rests: list[Rest], chosen: list[Recording], sheet: dict[str, Any]) -> Noise:
    """Return the noise of an accelerometer that may creep: see the module, 2."""
    found = [along_gravity(rest.time, rest.reading) for rest in rests]
    along = [replace(rest, reading=values[:, None]) for rest, (values, _) in zip(rests, found, strict=True)]
    noise = _noise_of_rests(along, [], chosen, sheet, "rests", creeping=[k for k, (_, c) in enumerate(found) if c])
    covariance = filter_autocovariance(chosen[0])
    creeps = [creep_of(rest.time, rest.reading) for rest in rests]
    lost = [len(rest.time) - creep.freedom for rest, creep in zip(rests, creeps, strict=True)]
    counts = np.array([len(rest.time) for rest in rests])
    free = np.sum(counts * covariance[0] - np.array(lost) * counts * variance_of_mean(covariance, counts))
    white = np.sqrt(np.sum([creep.squares for creep in creeps], axis=0) / float(free))
    wander = np.full(3, float(noise.wander[0]))
    return replace(noise, white=np.maximum(white, SMALLEST_WHITE), wander=wander)


def _noise_of_rests(
    rests: list[Rest],
    more: list[Rest],
    chosen: list[Recording],
    sheet: dict[str, Any],
    source: str,
    *,
    creeping: Sequence[int] = (),
) -> Noise:
    covariance = filter_autocovariance(chosen[0])
    memory = int(np.searchsorted(-np.abs(covariance), -0.01 * covariance[0]))
    shortest = max(SHORTEST_BLOCK, 4 * memory)
    blocks = _blocks_of(rests, shortest)
    if more and len(covariance) == 1:  # a filter still settles in a short rest after a move
        blocks = _with_scatter(blocks, _blocks_of(more, shortest))
    passed = (2.0 * covariance.sum() - covariance[0]) > 0.5  # at 0 Hz; a high-pass lets no wander through
    told = blocks.cut & ~np.isin(blocks.rest, creeping)
    if told.sum() - len(np.unique(blocks.rest[told])) < 3 or not passed:
        expected = np.sum(blocks.count * (covariance[0] - variance_of_mean(covariance, blocks.count)))
        return _with_sheet_wander(np.sqrt(blocks.scatter / max(float(expected), 1e-300)), sheet, source)
    return _best(blocks, _nuisance(blocks, chosen, source, creeping), covariance, sheet, source)


def _nuisance(blocks: _RestBlocks, chosen: list[Recording], source: str, creeping: Sequence[int] = ()) -> Values:
    """Return a constant for each rest, and a line where the unit creeps; for a static one temperature and warm-up."""
    rest, centre = blocks.rest[blocks.cut], (blocks.start + blocks.length / 2.0)[blocks.cut]
    columns = [(rest == r).astype(float) for r in np.unique(rest)]
    if source != "static":
        columns += [(rest == r) * (centre - centre[rest == r].mean()) for r in np.intersect1d(rest, creeping)]
        return np.stack(columns, axis=1)
    columns += [np.exp(-(centre - centre.min()) / tau) for tau in WARM_UP_S if centre.min() < 4.0 * tau]
    for recording in chosen:
        if recording.temperature is not None and np.isfinite(recording.temperature).all():
            smooth = np.interp(centre, recording.time, temperature_of(recording))
            if np.ptp(smooth) > 0.1:
                columns.append(smooth - smooth.mean())
    return np.stack(columns, axis=1)


def _best(blocks: _RestBlocks, design: Values, covariance: Values, sheet: dict[str, Any], source: str) -> Noise:
    """Return the most likely noise; one ratio of wander to white noise for all axes unless they differ."""
    times = TIMES * _wander_time(sheet)
    log_likelihood, white = likelihood(blocks, design, covariance, times)
    gain = 2.0 * (log_likelihood - log_likelihood[:, :1])
    pooled = gain.sum(axis=2).max(axis=1)
    row = int(np.argmax(pooled))
    sheet_row = int(np.argmin(np.abs(TIMES - 1.0)))
    if pooled[row] < max(pooled[sheet_row] + AGREES, SEEN):
        row = sheet_row
    near = np.clip(row + np.log2(TIME_FACTORS).astype(int), 0, len(TIMES) - 1)
    seen = 0.5 * gain[near].sum(axis=2) if source == "static" else None
    if pooled[row] < SEEN:
        return replace(_unseen(gain[sheet_row], white[sheet_row, 0], sheet, source), seen=seen)
    columns = range(gain.shape[2])
    apart = gain[row].max(axis=0).sum() - pooled[row] > SEEN
    axes = [slice(c, c + 1) for c in columns] if apart else [slice(None)] * len(columns)
    ratio = np.array([_peak(gain[row][:, axis].sum(axis=1)) for axis in axes])
    own = np.maximum([np.interp(ratio[c], RATIOS, white[row, :, c]) for c in columns], SMALLEST_WHITE)
    return Noise(own, own * ratio, float(times[row]), source, seen=seen)


def _peak(gain: Values) -> float:
    """Return the ratio at the maximum, by a parabola through the three points about it."""
    k = int(np.argmax(gain))
    if k < 2 or k == len(gain) - 1:
        return float(RATIOS[k])
    x, (a, b, c) = np.log(RATIOS[k - 1 : k + 2]), gain[k - 1 : k + 2]
    bend = a - 2.0 * b + c
    return float(np.exp(x[1] + (0.5 * (a - c) / bend * (x[1] - x[0]) if bend < 0 else 0.0)))


def _unseen(gain: Values, white: Values, sheet: dict[str, Any], source: str) -> Noise:
    """Return the data sheet's wander where the likelihood allows it, else none; ``gain`` is by ratio and axis."""
    noise = _with_sheet_wander(white, sheet, source)
    column = np.argmin(np.abs(RATIOS[:, None] - noise.wander / noise.white), axis=0)
    loss = -float(np.take_along_axis(gain, column[None], axis=0).sum())
    return noise if loss < AGREES else replace(noise, wander=np.zeros(3))


def _wander_time(sheet: Mapping[str, Any]) -> float:
    return float(sheet.get("wander_time_s") or DEFAULT_TIME_S)


def _with_sheet_wander(white: Values, sheet: dict[str, Any], source: str) -> Noise:
    wander = np.full(3, float(sheet.get("bias_wander") or 0.0))
    return Noise(np.maximum(white, SMALLEST_WHITE), wander, _wander_time(sheet), source)


def _white_of_turns(recordings: list[Recording], sensor: str) -> Values | None:
    """Return the white noise of short windows less a local polynomial, or None where there are too few."""
    squares, trace, nu = [], 0.0, 1.0
    x = np.linspace(-1.0, 1.0, WINDOW)
    basis, _ = np.linalg.qr(np.vander(x, WINDOW_DEGREE + 1))
    P = np.eye(WINDOW) - basis @ basis.T
    for recording in recordings:
        values = recording.reading(sensor)
        assert values is not None  # noqa: S101
        slow = usable(recording, values)
        if recording.table_rate is not None:
            slow &= np.abs(recording.table_rate) * recording.interval * WINDOW < WINDOW_ARC_DEG
        covariance = np.zeros(WINDOW)
        known = filter_autocovariance(recording)[:WINDOW]
        covariance[: len(known)] = known
        PR = P @ covariance[np.abs(np.subtract.outer(np.arange(WINDOW), np.arange(WINDOW)))]
        trace = float(np.trace(PR))
        nu = trace**2 / float(np.sum(PR * PR.T))
        for start, stop in stretches_of(recording, slow):
            count = (stop - start) // WINDOW
            windows = values[start : start + count * WINDOW].reshape(count, WINDOW, 3)
            squares.append(np.sum(np.einsum("ij,njc->nic", P, windows) ** 2, axis=1) / trace)
    found = np.concatenate(squares) if squares else np.empty((0, 3))
    if len(found) < 5:
        return None
    return np.sqrt(median(found) / (1.0 - 2.0 / (9.0 * nu)) ** 3)


def _of_sheet(recordings: list[Recording], sheet: dict[str, Any]) -> Noise:
    density = sheet.get("noise_density")
    if not density or not recordings:
        raise ConfigurationError(
            "the recordings hold no rest and too few even stretches to tell the noise; "
            "give the sensor's noise_density, or record static (a rest of some minutes)"
        )
    white = float(density) * np.sqrt(0.5 / recordings[0].interval)
    return _with_sheet_wander(np.full(3, white), sheet, "data_sheet")


@dataclass(frozen=True)
class Rest:
    """Times, s, and readings of a rest, and the number of its clock: rests of one number share their time."""

    time: Values
    reading: Values
    clock: int = 0


@dataclass(frozen=True)
class _RestBlocks:
    """Block means and scatter of rests."""

    # each (b,), s; first sample time and duration of each block
    start: Values
    length: Values
    count: Integers  # (b,); samples of each
    mean: Values  # (b, 3); less the mean of its rest
    rest: Integers  # (b,); the rest that each belongs to
    clock: Integers  # (b,); blocks of the same number have a known distance in time
    # (b,); whether its rest holds two blocks or more; the mean of a single one does not show the bias move
    cut: Mask
    scatter: Values  # (3,); sum of squares about the block means


def _blocks_of(rests: Sequence[Rest], shortest: int) -> _RestBlocks:
    """Cut rests into blocks.

    ``shortest``: fewest samples of a block in a rest that is cut.
    """
    sizes = np.array([len(rest.time) for rest in rests])
    size = max(shortest, int(np.ceil(sizes.sum() / BLOCKS)))
    if not np.any(sizes >= 2 * size):  # many rests, all short: cut each in two rather than none
        size = max(shortest, int(sizes.max()) // 2)
    pieces = np.maximum(1, sizes // size)
    cuts = {(n, k): np.diff(np.linspace(0, n, k + 1).astype(int)) for n, k in set(zip(sizes, pieces, strict=True))}
    counts = np.concatenate([cuts[n, k] for n, k in zip(sizes, pieces, strict=True)])
    rest = np.repeat(np.arange(len(rests)), pieces)
    time = np.concatenate([r.time for r in rests])
    values = np.concatenate([r.reading for r in rests])
    clock = np.array([r.clock for r in rests])[rest]
    means = np.add.reduceat(values, np.concatenate([[0], np.cumsum(sizes)[:-1]])) / sizes[:, None]
    values = values - np.repeat(means, sizes, axis=0)
    first = np.concatenate([[0], np.cumsum(counts)[:-1]])
    mean = np.add.reduceat(values, first) / counts[:, None]
    scatter = np.maximum(np.sum(values * values, axis=0) - np.sum(counts[:, None] * mean * mean, axis=0), 0.0)
    length = (time[first + counts - 1] - time[first]) * counts / np.maximum(counts - 1, 1)
    return _RestBlocks(time[first], length, counts, mean, rest, clock, pieces[rest] > 1, scatter)


def _with_scatter(blocks: _RestBlocks, more: _RestBlocks) -> _RestBlocks:
    """Return the blocks with the scatter of others added where it agrees with theirs; nothing else of them counts.

    Scatters agree where the estimates of white noise differ by less than 3 standard deviations on every axis.
    """
    nu = np.array([np.sum(b.count - 1) for b in (blocks, more)], float)
    if np.any(nu < 1) or np.any(blocks.scatter == 0) or np.any(more.scatter == 0):
        return blocks
    log_ratio = np.log(blocks.scatter / nu[0]) - np.log(more.scatter / nu[1])
    if np.any(np.abs(log_ratio) > 3.0 * np.sqrt(2.0 / nu[0] + 2.0 / nu[1])):
        return blocks

    stacked = {f.name: np.concatenate([getattr(blocks, f.name), getattr(more, f.name)]) for f in fields(_RestBlocks)}
    stacked["rest"][len(blocks.rest) :] += blocks.rest.max() + 1
    stacked["cut"][len(blocks.cut) :] = False
    return _RestBlocks(**{**stacked, "scatter": blocks.scatter + more.scatter})


def likelihood(
    blocks: _RestBlocks, design: Values, covariance: Values, correlation_times: Values
) -> tuple[Values, Values]:
    """Return the log likelihood at each correlation time, by ``RATIOS``, by axis, and the white noise there: (t, r, 3).

    ``design``: (c, p), the nuisance columns d, at the c blocks that are ``cut``. ``covariance``: (l,), the filter's
    autocovariance r. ``correlation_times``: (t,), s.
    """
    v = variance_of_mean(covariance, blocks.count)
    within = float(np.sum(blocks.count * (covariance[0] - v)))
    correlated = covariance[0] ** 2 / (covariance[0] ** 2 + 2.0 * np.sum(covariance[1:] ** 2))
    nu = max(float(np.sum(blocks.count - 1)) * correlated, 1e-9)
    cut = blocks.cut
    chosen = Blocks(np.arange(cut.sum()), 1.0 / v[cut], blocks.start[cut], blocks.length[cut], blocks.clock[cut])
    settings = [Setting(float(ratio), float(tau)) for tau in correlation_times for ratio in RATIOS]
    basis = orthonormal(design, v[cut], WEAKEST_DIRECTION)
    log_determinant, squares = GaussMarkov(chosen, settings).restricted(basis, blocks.mean[cut])
    inner = [np.sum(blocks.count * (1.0 - variance_of_average(blocks.length, tau))) for tau in correlation_times]
    expected = within + np.outer(inner, RATIOS**2).ravel()
    free = len(chosen.weight) - basis.shape[1] + nu
    variance = np.maximum((squares + nu * blocks.scatter / expected[:, None]) / free, 1e-18)
    penalty = log_determinant + nu * np.log(expected)
    log_likelihood = -0.5 * (penalty[:, None] + free * np.log(variance))
    shape = (len(correlation_times), len(RATIOS), -1)
    return log_likelihood.reshape(shape), np.sqrt(variance).reshape(shape)
