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
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import ConfigurationError, InputError
from pipeline.estimation.gauss_markov import DEFAULT_TIME_S, SHARPEST_WIDTH, SHEET_WIDTH, Prior
from pipeline.estimation.rest_blocks import (
    RATIOS,
    Likelihood,
    Rest,
    RestBlocks,
    blocks_of,
    likelihood,
    with_scatter,
)
from pipeline.records import Noise, Recording
from pipeline.signal.creep import along_gravity, creep_of
from pipeline.signal.filters import filter_autocovariance, variance_of_mean
from pipeline.signal.rests import rest_readings, stretches_of, usable
from pipeline.signal.temperature import temperature_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

TIMES = np.exp2(np.arange(-6.0, 4.0))  # correlation times tried, in those of the data sheet
SHORTEST_BLOCK = 8
FEWEST_SAMPLES = 60
WINDOW, WINDOW_DEGREE, WINDOW_ARC_DEG = 16, 4, 60.0
WARM_UP_S = (60.0, 180.0, 500.0)
SMALLEST_WHITE = 1e-9  # keeps the weights of a noise-free recording finite
SEEN, AGREES = 6.0, 4.0  # twice the gain in log-likelihood


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
    """Return what a static recording tells of the bias instability, or else the data sheet.

    A standard deviation from a rest of length T, about ``T / (2 tau)`` independent values, has the relative uncertainty
    ``sqrt(tau / T)``.

    ``settings``: section ``sensor``.
    """
    sheet = settings.get("sensor", {}).get(sensor) or {}
    static = any(r.role == "static" and r.reading(sensor) is not None and r.samples > 1 for r in recordings)
    return static_or_sheet(noise_of(sensor, recordings, settings) if static and sheet else None, sheet)


def static_or_sheet(noise: Noise | None, sheet: Mapping[str, Any]) -> Prior:
    """Return the prior by a noise that a static recording tells, or else by the data sheet."""
    if noise and noise.source == "static":
        width = float(np.clip(np.sqrt(noise.correlation_time / noise.length), SHARPEST_WIDTH, SHEET_WIDTH))
        return Prior(float(np.sqrt(np.mean(noise.wander**2))), noise.correlation_time, width)
    return Prior(float(sheet.get("bias_wander") or 0.0), _wander_time(sheet))


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
    blocks = blocks_of(rests, shortest)
    if more and len(covariance) == 1:  # a filter still settles in a short rest after a move
        blocks = with_scatter(blocks, blocks_of(more, shortest))
    passed = (2.0 * covariance.sum() - covariance[0]) > 0.5  # at 0 Hz; a high-pass lets no wander through
    told = blocks.cut & ~np.isin(blocks.rest, creeping)
    if told.sum() - len(np.unique(blocks.rest[told])) < 3 or not passed:
        expected = np.sum(blocks.count * (covariance[0] - variance_of_mean(covariance, blocks.count)))
        return _with_sheet_wander(np.sqrt(blocks.scatter / max(float(expected), 1e-300)), sheet, source)
    found = likelihood(blocks, _nuisance(blocks, chosen, source, creeping), covariance, TIMES * _wander_time(sheet))
    return _best(found, sheet, source)


def _nuisance(
    blocks: RestBlocks, chosen: list[Recording], source: str, creeping: Sequence[int] = ()
) -> NDArray[np.float64]:
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


def _best(found: Likelihood, sheet: dict[str, Any], source: str) -> Noise:
    """Return the most likely noise; one ratio of wander to white noise for all axes unless they differ."""
    gain = 2.0 * (found.log_likelihood - found.log_likelihood[:, :1])
    pooled = gain.sum(axis=2).max(axis=1)
    row = int(np.argmax(pooled))
    sheet_row = int(np.argmin(np.abs(TIMES - 1.0)))
    if pooled[row] - pooled[sheet_row] < AGREES:
        row = sheet_row
    if pooled[row] < SEEN:
        return _unseen(found, sheet_row, sheet, source)
    columns = range(gain.shape[2])
    apart = gain[row].max(axis=0).sum() - pooled[row] > SEEN
    axes = [slice(c, c + 1) for c in columns] if apart else [slice(None)] * len(columns)
    ratio = np.array([_peak(gain[row][:, axis].sum(axis=1)) for axis in axes])
    white = np.array([np.interp(ratio[c], RATIOS, found.white[row, :, c]) for c in columns])
    white = np.maximum(white, SMALLEST_WHITE)
    return Noise(white, white * ratio, float(TIMES[row] * _wander_time(sheet)), source)


def _peak(gain: NDArray[np.float64]) -> float:
    """Return the ratio at the maximum, by a parabola through the three points about it."""
    k = int(np.argmax(gain))
    if k < 2 or k == len(gain) - 1:
        return float(RATIOS[k])
    x, (a, b, c) = np.log(RATIOS[k - 1 : k + 2]), gain[k - 1 : k + 2]
    bend = a - 2.0 * b + c
    return float(np.exp(x[1] + (0.5 * (a - c) / bend * (x[1] - x[0]) if bend < 0 else 0.0)))


def _unseen(found: Likelihood, row: int, sheet: dict[str, Any], source: str) -> Noise:
    """Return the data sheet's wander where the likelihood allows it, else none."""
    white = np.maximum(found.white[row, 0], SMALLEST_WHITE)
    noise = _with_sheet_wander(white, sheet, source)
    column = np.argmin(np.abs(RATIOS[:, None] - noise.wander / white), axis=0)
    each = np.arange(len(white))
    loss = 2.0 * np.sum(found.log_likelihood[row, 0] - found.log_likelihood[row, column[each], each])
    return noise if loss < AGREES else Noise(white, np.zeros(3), noise.correlation_time, source)


def _wander_time(sheet: Mapping[str, Any]) -> float:
    return float(sheet.get("wander_time_s") or DEFAULT_TIME_S)


def _with_sheet_wander(white: NDArray[np.float64], sheet: dict[str, Any], source: str) -> Noise:
    wander = np.full(3, float(sheet.get("bias_wander") or 0.0))
    return Noise(np.maximum(white, SMALLEST_WHITE), wander, _wander_time(sheet), source)


def _white_of_turns(recordings: list[Recording], sensor: str) -> NDArray[np.float64] | None:
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
    return np.sqrt(np.median(found, axis=0) / (1.0 - 2.0 / (9.0 * nu)) ** 3)


def _of_sheet(recordings: list[Recording], sheet: dict[str, Any]) -> Noise:
    density = sheet.get("noise_density")
    if not density or not recordings:
        raise ConfigurationError(
            "the recordings hold no rest and too few even stretches to tell the noise; "
            "give the sensor's noise_density, or record static (a rest of some minutes)"
        )
    white = float(density) * np.sqrt(0.5 / recordings[0].interval)
    return _with_sheet_wander(np.full(3, white), sheet, "data_sheet")
