"""Filter the readings, and smooth the temperature.

RC low-pass (Sudsanguan 2019, eqs 3.3 to 3.14, an RC circuit discretised backwards), per axis:

    a[n] = a[n-1] + k[n] (r[n] - a[n-1]),   k[n] = dt[n] / (dt[n] + RC),   f_c = 1 / (2 pi RC)

where

    r, a  : reading before and after
    dt[n] : time since the sample before, s; longer where samples are lost, so that the equation holds over gaps
    RC    : time constant, s
    f_c   : cutoff, Hz

Butterworth low-pass, high-pass, band-pass and band-stop are second-order sections at the recording's median interval.
At a gap (an interval above 1.5 medians) such a filter restarts, because its state does not include the lost samples.

A causal filter starts in the steady state of the first reading, so that a constant passes from the first sample on. Its
output is late by the group delay,

    delay = -d arg H / d omega = Re(sum n b_n z^-n / sum b_n z^-n) - Re(sum n a_n z^-n / sum a_n z^-n)

with z = e^(i omega dt) (RC for the RC filter). A zero-phase filter runs forwards, then backwards: it has no delay, and
the square of the attenuation. Both multiply the standard deviation of white noise by

    noise_gain = sqrt(sum_n h[n]^2) = sqrt(mean over frequency of |H|^2)          (|H|^4 where zero-phase)

The temperature is smoothed before it is used as a regressor, because the noise of the thermometer would bias the
coefficients (errors in variables). A moving average is biased at the ends of a file; a locally linear kernel is not:

    T(t) = a,  (a, b) = argmin sum_i exp(-(t_i - t)^2 / (2 h^2)) (T_i - a - b (t_i - t))^2

where h is the bandwidth. A straight ramp passes it unchanged, also at the ends of a file. A corner of a ramp is rounded
by 0.4 h times the change of slope. So h is halved as long as the halved bandwidth changes the temperature by more than
the thermometer's noise s explains:

    max_t |T_h(t) - T_{h/2}(t)| > 6 s sqrt(5 dt / (sqrt(pi) h))

Sources: Fan & Gijbels, Local Polynomial Modelling and Its Applications, 1996, section 3.2; the choice of h after
Lepski, Theory of Probability and Its Applications 35, 1991.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from itertools import pairwise
from typing import Literal

import numpy as np

from pipeline.core.errors import ConfigurationError, InputError
from pipeline.core.records import Integers, Note, Recording, Values, noise_of_steps, once_of_log
from pipeline.core.settings import Filter

MAX_GAP_MEDIANS = 1.5  # medians of the interval: a lost sample makes two of one
JITTER = 0.1  # of the interval: beyond it samples count as uneven
IMPULSE_SAMPLES = 4096  # of a response, half of them on either side of the impulse: 20 s at 100 Hz
FORGOTTEN_VARIANCE = 1e-9  # of the variance: less does not change a digit that is published
BANDS: dict[str, Literal["lowpass", "highpass", "bandpass", "bandstop"]] = {
    "low_pass": "lowpass",
    "high_pass": "highpass",
    "band_pass": "bandpass",
    "band_stop": "bandstop",
}
KERNEL_BLOCK = 128  # cells at once: their kernels stay in the processor's cache
# bandwidths: over about 30 s; below the thermal time constant of a package, which is seconds
WIDEST_S, NARROWEST_S = 10.0, 0.5
RELATIVE_ROUNDING = 1e-12  # relative: some thousand roundings of a double
MIN_SWING_DEGC = 1.0  # twice the step of a coarse thermometer, 0.5 degC
DISTINCT, AT_ENDS = 6.0, 5.0  # standard deviations; by how much the variance is larger at the ends of a file


def apply_filter(recording: Recording, settings: Filter) -> Recording:
    """Filter the accelerometer and gyroscope readings of a recording; all other channels are unchanged.

    ``filter`` of the result has these settings, ``delay_s`` (at 0 Hz; of a band-pass in the middle of its band; 0 of a
    high-pass, which does not delay signals far above its cutoff) and ``noise_gain``.

    Raises ``ConfigurationError`` if a setting is missing or a cutoff is not below half the sampling rate,
    ``InputError`` if the recording is too short to have a sampling interval.
    """
    name = settings.name
    if name == "none":
        return recording
    if recording.samples < 2:
        message = f"recording {recording.name} has {recording.samples} samples; a filter needs at least 2"
        raise InputError(message, recording.source.get("file"))
    sections, run = _filter_of(recording, settings)
    zero_phase, interval = settings.zero_phase, recording.interval
    return recording.with_readings(
        accelerometer=None if recording.accelerometer is None else run(recording.accelerometer),
        gyroscope=None if recording.gyroscope is None else run(recording.gyroscope),
        notes=recording.notes + (() if name == "rc_low_pass" else _timing_notes(recording)),
        filter={
            **settings.json_value,
            "delay_s": 0.0 if zero_phase or name == "high_pass" else _group_delay(settings, sections, interval),
            "noise_gain": _noise_gain(sections, zero_phase=zero_phase),
        },
    )


def filtered(values: Values, recording: Recording) -> Values:
    """Filter (n, k) values at the samples of a recording as its readings were filtered."""
    if recording.filter["name"] == "none":
        return values
    applied = Filter.model_validate({key: recording.filter[key] for key in Filter.model_fields})
    return _filter_of(recording, applied)[1](values)


def _filter_of(recording: Recording, settings: Filter) -> tuple[Values, Callable[[Values], Values]]:
    """Return the second-order sections of a filter, and the function that filters values at a recording's samples."""
    zero_phase, interval = settings.zero_phase, recording.interval
    if settings.name == "rc_low_pass":
        time_constant = _time_constant(settings, interval)
        k, time = interval / (interval + time_constant), recording.time

        def run(reading: Values) -> Values:
            forward = _rc_low_pass(time, reading, time_constant)
            return _rc_low_pass(-time[::-1], forward[::-1], time_constant)[::-1] if zero_phase else forward

        return np.array([[k, 0.0, 0.0, 1.0, k - 1.0, 0.0]]), run
    sections = _butterworth_sections(settings, interval)
    return sections, partial(_section_filtered, sections, stretch_starts(recording), zero_phase)


def impulse_response(recording: Recording, samples: int) -> Values:
    """Return the response of a recording's filter to an impulse in the middle of evenly spaced samples: (n,) array."""
    impulse = np.zeros((samples, 1))
    impulse[samples // 2] = 1.0
    time_ns = np.round(np.arange(samples) * recording.interval * 1e9).astype(np.int64)
    return filtered(impulse, Recording("impulse", "static", None, time_ns, filter=recording.filter))[:, 0]


def filter_autocovariance(recording: Recording) -> Values:
    """Return the autocovariance of a recording's filter output for white noise of variance 1: (l,) array from lag 0."""
    if recording.filter["name"] == "none" or recording.samples < 2:
        return np.ones(1)
    spectrum = np.fft.rfft(impulse_response(recording, IMPULSE_SAMPLES), 2 * IMPULSE_SAMPLES)
    covariance: Values = np.fft.irfft(np.abs(spectrum) ** 2)[:IMPULSE_SAMPLES]
    far = np.flatnonzero(np.abs(covariance) > FORGOTTEN_VARIANCE * covariance[0])[-1]
    return covariance[: far + 1]


def variance_of_mean(covariance: Values, count: Integers) -> Values:
    """Return the variance of the mean of ``count`` successive samples of a stationary sequence.

    ``v_n = (r_0 + 2 sum_{l<n} (1 - l/n) r_l) / n``, r the autocovariance from lag 0; 0 beyond its end.
    """
    kinds, which = np.unique(count, return_inverse=True)
    lag = np.arange(len(covariance))
    weight = np.clip(1.0 - lag / kinds[:, None], 0.0, None) * np.where(lag == 0, 1.0, 2.0)
    return np.asarray((weight @ covariance / kinds)[which])


def _rc_low_pass(time: Values, reading: Values, time_constant: float) -> Values:
    """Filter (n, m) readings by eq. 3.14.

    The recursion is summed in closed form over blocks: with P[n] = prod (1 - k), ``a[n] = P[n] (a[0] + sum k r / P)``.
    A block ends before P falls to 1e-100, which keeps all digits.
    """
    dt = np.diff(time)
    k = np.concatenate([[0.0], dt / (dt + time_constant)])
    decay = np.cumsum(np.log1p(-k))
    out = np.empty_like(reading)
    last, start = reading[0], 0
    while start < len(time):
        level = decay[start - 1] if start else 0.0
        stop = max(start + 1, int(np.searchsorted(-decay, 230.0 - level, side="right")))
        P = np.exp(decay[start:stop] - level)[:, None]
        out[start:stop] = P * (last + np.cumsum(k[start:stop, None] * reading[start:stop] / P, axis=0))
        last, start = out[stop - 1], stop
    return out


def _group_delay(settings: Filter, sections: Values, interval: float) -> float:
    """Return the group delay, s, of second-order sections b0 b1 b2 a0 a1 a2: at 0 Hz, or in the middle of a band."""
    n, omega = np.arange(3), 0.0  # rad a sample
    if settings.name == "band_pass":  # the middle of the band as the bilinear transform maps it
        edges = np.tan(np.pi * interval * np.array([settings.low_hz, settings.high_hz]))
        omega = 2.0 * float(np.arctan(np.sqrt(np.prod(edges))))
    turn = np.exp(-1j * omega * n)
    numerator, denominator = ((c @ (n * turn)) / (c @ turn) for c in (sections[:, :3], sections[:, 3:]))
    return float(np.sum(np.real(numerator - denominator))) * interval


def _noise_gain(sections: Values, *, zero_phase: bool) -> float:
    """Return the factor on the standard deviation of white noise.

    The mean of |H|^2 over N frequencies differs from ``sum h^2`` by terms of size r^N, r the largest pole radius; N is
    chosen for r^N < 1e-16.
    """
    radius = max(float(np.max(np.abs(np.roots(a)))) if np.any(a[1:]) else 0.0 for a in sections[:, 3:])
    size = 2 ** int(np.clip(np.ceil(np.log2(-40.0 / np.log(np.clip(radius, 1e-6, 1.0 - 1e-9)))), 10, 20))
    response = np.ones(size // 2 + 1)
    for row in sections:
        response *= np.abs(np.fft.rfft(row[:3], size) / np.fft.rfft(row[3:], size)) ** (4 if zero_phase else 2)
    weight = np.full(len(response), 2.0)
    weight[[0, -1]] = 1.0
    return float(np.sqrt(weight @ response / size))


def _time_constant(settings: Filter, interval: float) -> float:
    """Return RC in s, from the cutoff where one is given."""
    cutoff, time_constant = settings.cutoff_hz, settings.time_constant_s
    if cutoff is None:
        if time_constant is None:
            raise ConfigurationError("filter rc_low_pass needs filter.cutoff_hz (Hz) or filter.time_constant_s (s)")
        return float(time_constant)
    _require_below_nyquist("cutoff_hz", cutoff, interval)
    return float(1.0 / (2.0 * np.pi * cutoff))


def _require_below_nyquist(key: str, frequency: float | None, interval: float) -> None:
    nyquist = 0.5 / interval
    if frequency is None:
        raise ConfigurationError(f"filter.{key} is null; this filter needs it, in Hz, below {nyquist:.4g} Hz")
    if frequency >= nyquist:
        problem = f"filter.{key} is {frequency:g} Hz, but the readings come every {interval:.4g} s"
        raise ConfigurationError(f"{problem}: it must lie between 0 and half the sampling rate, {nyquist:.4g} Hz")


def _butterworth_sections(settings: Filter, interval: float) -> Values:
    from scipy.signal import butter  # noqa: PLC0415  (0.6 s that the default, no filter, does not pay)

    name, order = settings.name, settings.order
    if order is None:
        raise ConfigurationError("filter.order is null; this filter needs it, a whole number from 1 to 10")
    keys = ("low_hz", "high_hz") if name.startswith("band") else ("cutoff_hz",)
    for key in keys:
        _require_below_nyquist(key, getattr(settings, key), interval)
    edges = [float(getattr(settings, key)) for key in keys]
    if len(edges) == 2 and edges[0] >= edges[1]:
        raise ConfigurationError(f"filter.low_hz is {edges[0]:g} Hz; it must be below filter.high_hz, {edges[1]:g} Hz")
    band = edges if len(edges) == 2 else edges[0]
    return butter(order, band, BANDS[name], output="sos", fs=1.0 / interval)


def _section_filtered(sections: Values, starts: list[int], zero_phase: bool, reading: Values) -> Values:  # noqa: FBT001
    from scipy.signal import sosfilt, sosfilt_zi, sosfiltfilt  # noqa: PLC0415  (see _butterworth_sections)

    at_rest = sosfilt_zi(sections)[:, :, None]
    out = np.empty_like(reading)
    for start, stop in pairwise(starts):
        part = reading[start:stop]
        if zero_phase:
            padding = min(6 * len(sections) + 3, stop - start - 1)
            out[start:stop] = sosfiltfilt(sections, part, axis=0, padlen=padding)
        else:
            out[start:stop] = sosfilt(sections, part, axis=0, zi=at_rest * part[0])[0]
    return out


def stretch_starts(recording: Recording) -> list[int]:
    """Return the first sample of each stretch without a gap, and the number of samples."""
    gaps = np.flatnonzero(recording.time_steps > MAX_GAP_MEDIANS * recording.interval) + 1
    return [0, *gaps.tolist(), recording.samples]


def _timing_notes(recording: Recording) -> tuple[Note, ...]:
    """Return notes on gaps and uneven intervals, which a filter of evenly spaced samples does not expect."""
    notes = []
    starts = stretch_starts(recording)
    if len(starts) > 2:
        detail = f"{recording.name}: the filter started anew after each of {len(starts) - 2} gaps"
        notes.append(Note("N-FILTER-RESTART", len(starts) - 2, 0, 0, detail))
    dt = recording.time_steps
    uneven = np.abs(dt / recording.interval - 1.0)
    count = int(np.sum((uneven > JITTER) & (dt <= MAX_GAP_MEDIANS * recording.interval)))
    if count > 0.05 * len(dt):
        detail = f"{recording.name}: {count} intervals are off the median by over 10 %; the filter takes them as even"
        notes.append(Note("N-FILTER-JITTER", count, 0, 0, detail))
    return tuple(notes)


def smooth_temperature(time: Values, temperature: Values) -> Values:
    """Return a smoothed temperature log: (n,) array, degC; ``time`` increases."""
    bandwidth = WIDEST_S
    if len(time) < 3 or time[-1] == time[0]:
        return _local_line(time, temperature, bandwidth)
    step = np.abs(np.diff(temperature))
    noise, least = float(noise_of_steps(step)), RELATIVE_ROUNDING * float(np.abs(temperature).max())
    if noise == 0.0 and step.any():  # a coarse thermometer: a change below half a count is not significant
        noise = float(step[step > 0].min())
        least += 0.5 * noise
    interval = (time[-1] - time[0]) / (len(time) - 1)
    smooth = _local_line(time, temperature, bandwidth)
    while bandwidth > max(NARROWEST_S, 4.0 * interval):
        finer = _local_line(time, temperature, bandwidth / 2.0)
        allowed = max(DISTINCT * noise * float(np.sqrt(AT_ENDS * interval / (np.sqrt(np.pi) * bandwidth))), least)
        if float(np.abs(smooth - finer).max()) <= allowed:
            break
        smooth, bandwidth = finer, bandwidth / 2.0
    return smooth


@once_of_log
def temperature_of(recording: Recording) -> Values:
    """Return the smoothed temperature of a recording that logs it: (n,) array, degC."""
    logged = recording.temperature
    assert logged is not None  # noqa: S101
    return smooth_temperature(recording.time, logged)


@once_of_log
def temperature_rate_of(recording: Recording) -> Values:
    """Return the derivative of the smoothed temperature of a recording that logs it: (n,) array, degC/s."""
    return rate_of_change(recording.time, temperature_of(recording))


def rate_of_change(time: Values, values: Values) -> Values:
    """Return the derivative of values at increasing times: (n,) array; 0 of a single value."""
    return np.gradient(values, time) if len(time) > 1 else np.zeros(len(time))


def heats_and_cools(temperatures: Iterable[Values | None]) -> bool:
    """Return whether the temperature rises and falls by ``MIN_SWING_DEGC`` within recordings, each smoothed, degC."""
    rises = falls = False
    for warmth in temperatures:
        if warmth is not None and len(warmth) and np.ptp(warmth) >= MIN_SWING_DEGC:
            rises |= bool(np.max(warmth - np.minimum.accumulate(warmth)) >= MIN_SWING_DEGC)
            falls |= bool(np.max(np.maximum.accumulate(warmth) - warmth) >= MIN_SWING_DEGC)
    return rises and falls


def _local_line(time: Values, temperature: Values, bandwidth: float) -> Values:
    """Return the value of the local line at each time: (n,) array, degC."""
    cell = np.floor((time - time[0]) / (bandwidth / 5.0)).astype(np.int64)
    cell = np.concatenate([[0], np.cumsum(cell[1:] != cell[:-1])])  # skip empty cells; times increase
    count = np.bincount(cell)
    t = np.bincount(cell, time) / count
    value = np.bincount(cell, temperature) / count
    level = np.empty_like(t)
    for start in range(0, len(t), KERNEL_BLOCK):
        block = slice(start, start + KERNEL_BLOCK)
        near = slice(*np.searchsorted(t, [t[block][0] - 5 * bandwidth, t[block][-1] + 5 * bandwidth]))
        x, n, v = (t[near] - t[block][0]) / bandwidth, count[near], value[near] - value[start]
        middle = (t[block] - t[block][0]) / bandwidth
        weights = x - middle[:, None]
        np.exp(np.multiply(weights, -0.5 * weights, out=weights), out=weights)
        s0, s1, s2, r0, r1 = (weights @ np.stack([n, n * x, n * x * x, n * v, n * x * v], 1)).T
        s1, s2, r1 = s1 - middle * s0, s2 - middle * (2.0 * s1 - middle * s0), r1 - middle * r0  # about the cell itself
        determinant = s0 * s2 - s1 * s1
        alone = determinant <= 1e-12 * s0 * s0
        line = np.where(alone, r0 / s0, (s2 * r0 - s1 * r1) / np.where(alone, 1.0, determinant))
        level[block] = value[start] + line
    if len(t) == 1:
        return np.full_like(time, level[0])
    smooth: Values = np.interp(time, t, level)
    # np.interp is constant beyond the end cells: extrapolate linearly instead.
    before, after = time < t[0], time > t[-1]
    smooth[before] = level[0] + (time[before] - t[0]) * (level[1] - level[0]) / (t[1] - t[0])
    smooth[after] = level[-1] + (time[after] - t[-1]) * (level[-1] - level[-2]) / (t[-1] - t[-2])
    return smooth
