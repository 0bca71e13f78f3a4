"""Spectra and Allan variances of the noise terms of a sensor at rest, with the coefficients of IEEE Std 952.

With ``w = 2 pi f dt`` and ``s = 2 sin(w / 2)``, each term adds to the variance of a coefficient of the cosine transform
(first column) and to the Allan variance at the averaging time t (second column):

    quantisation Q     : Q^2 s^2 / dt^2                                   3 Q^2 / t^2
    white N            : N^2 / dt                                         N^2 / t
    bias_instability B : B^2 / s        (two-sided B^2 / (2 pi f))        (2 ln 2 / pi) B^2
    random_walk K      : K^2 dt / s^2                                     K^2 t / 3
    gauss_markov G, T  : G^2 (1 - p^2) / ((1 - p)^2 + p s^2)              2 G^2 / x (1 - (3 - 4 e^-x + e^-2x) / (2 x))
    ramp R             : deterministic, R t                               R^2 t^2 / 2
    sinusoid A, f      : deterministic, A cos(2 pi f t + phase)           A^2 sin^4(pi f t) / (pi f t)^2

where p = exp(-dt / T), x = t / T, and G is the standard deviation of the process. N^2 is the two-sided spectral density
of white noise: ``N = sigma sqrt(dt)``, and the Allan deviation at 1 s is N. A density of a data sheet that is one-sided
is ``sqrt(2) N``. The overlapping Allan deviation of N readings with the integral theta, over m intervals dt, is

    sigma^2(tau) = sum_i (theta[i + 2m] - 2 theta[i + m] + theta[i])^2 / (2 tau^2 (N - 2m + 1)),   tau = m dt

For long averages only every (m / ``PER_AVERAGE``)th term is summed, because neighbouring terms are nearly equal.
Sources: IEEE Std 952-1997, annex C; Riley, NIST SP 1065, section 5.2.4.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pipeline.records import Values

QUANTISATION, WHITE, INSTABILITY, WALK, MARKOV = range(5)
PER_AVERAGE = 64  # terms of the sum that overlap in one average
SINGLE = (QUANTISATION, WHITE, INSTABILITY, WALK)
STOCHASTIC = ("quantisation", "white", "bias_instability", "random_walk", "gauss_markov")
UNITS = {
    "quantisation": "{0} s", "white": "{0}/sqrt(Hz)", "bias_instability": "{0}", "random_walk": "{0}/sqrt(s)",
    "gauss_markov": "{0}", "ramp": "{0}/s", "sinusoid": "{0}",
}  # fmt: skip


def unit_of(term: str, unit: str) -> str:
    """Return the unit of a term's coefficient for a sensor's unit."""
    return UNITS[term].format(unit)


def fixed_shapes(omega: Values, interval: float) -> Values:
    """Return the spectra of Q, N, B and K with unit coefficients: (4, b) array. ``omega``: w, rad per sample."""
    s = 2.0 * np.sin(omega / 2.0)
    dt = interval
    return np.stack([s**2 / dt**2, np.full_like(s, 1.0 / dt), 1.0 / s, dt / s**2])


def markov_shape(omega: Values, interval: float, log_time: Values) -> tuple[Values, Values]:
    """Return the spectrum of Gauss-Markov processes of unit variance, and its derivative by the log of T."""
    squares = 4.0 * np.sin(omega / 2.0) ** 2
    rate = interval * np.exp(-log_time)[..., None]
    p, q = np.exp(-rate), -np.expm1(-rate)
    denominator = q**2 + p * squares
    shape = q * (1.0 + p) / denominator
    slope = (-2.0 * p - shape * (squares - 2.0 * q)) / denominator * p * rate
    return shape, slope


def allan_variance(name: str, term: Mapping[str, Any], tau: Values) -> Values:
    """Return the Allan variance of a term as published (``value`` ...) at averaging times in s."""
    value = float(term["value"])
    if name == "gauss_markov":
        x = tau / float(term["correlation_time_s"]["value"])
        series = x < 1e-3  # the closed form cancels there; its error is x^2, relative
        y = np.where(series, 1.0, x)
        bend = 1.0 - (3.0 - 4.0 * np.exp(-y) + np.exp(-2.0 * y)) / (2.0 * y)
        return np.asarray(value**2 * np.where(series, 2.0 * x / 3.0, 2.0 / y * bend))
    if name == "sinusoid":
        x = np.pi * float(term["frequency_hz"]["value"]) * tau
        return np.asarray(value**2 * np.sin(x) ** 4 / x**2)
    power = {
        "quantisation": 3.0 / tau**2,
        "white": 1.0 / tau,
        "bias_instability": np.full_like(tau, 2.0 * np.log(2.0) / np.pi),
        "random_walk": tau / 3.0,
        "ramp": tau**2 / 2.0,
    }
    return np.asarray(value**2 * power[name])


def each_term(terms: Mapping[str, Any]) -> list[tuple[str, Mapping[str, Any]]]:
    """Return name and content of each published term of an axis with a value, without terms that are regressed out."""
    listed = [(name, part) for name, parts in terms.items() for part in (parts if isinstance(parts, list) else [parts])]
    return [(name, part) for name, part in listed if part["value"] is not None and name in UNITS]


def allan_deviation(values: Values, interval: float, points_per_decade: int = 10) -> tuple[Values, Values]:
    """Return averaging times, s, and the overlapping Allan deviation of (n,) or (n, k) readings, evenly sampled.

    (m,) and (m,) or (m, k) arrays; both empty where there are fewer than 3 readings.
    """
    n = len(values)
    longest = (n - 1) // 2
    if longest < 1:
        return np.empty(0), np.empty((0, *values.shape[1:]))
    count = 1 + int(points_per_decade * np.log10(longest))
    lengths = np.unique(np.geomspace(1, longest, count).astype(np.int64))
    theta = np.zeros((values[0].size, n + 1))
    np.cumsum((values - values.mean(axis=0)).reshape(n, -1).T, axis=1, out=theta[:, 1:])
    twice = 2.0 * theta
    deviation = np.empty((len(lengths), len(theta)))
    for row, m in enumerate(lengths):
        step = max(1, int(m) // PER_AVERAGE)
        second = theta[:, 2 * m :: step] - twice[:, m:-m:step]
        second += theta[:, : -2 * m : step]
        deviation[row] = np.sqrt(np.einsum("ij,ij->i", second, second) / (2.0 * second.shape[1])) / m
    return lengths.astype(np.float64) * interval, deviation.reshape(-1, *values.shape[1:])
