"""Noise terms against the exact likelihood, numerical integrals of their spectra, and simulated mixtures."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.fft import dct
from scipy.signal import lfilter

from pipeline.core.records import Recording
from pipeline.estimation.noise_identification import identify_noise, static_stretches
from pipeline.estimation.noise_terms import (
    INSTABILITY,
    QUANTISATION,
    WALK,
    WHITE,
    TermTrial,
    allan_variance,
    evaluate,
    fixed_shapes,
    markov_shape,
    maximised,
    spectrum_of,
)

DT = 0.1
Values = np.ndarray[Any, np.dtype[np.float64]]


def recording(values: Values, interval: float = DT, role: str = "static", **more: Any) -> Recording:
    """Return a recording of a gyroscope with the same values on every axis, or (n, 3) values."""
    reading = np.stack([values] * 3, axis=1) if values.ndim == 1 else values
    time_ns = np.rint(np.arange(len(reading)) * interval * 1e9).astype(np.int64)
    return Recording("static", role, None, time_ns, gyroscope=reading, **more)


def simulated(rng: np.random.Generator, n: int, *, K: float = 0.0, G: float = 0.0, T: float = 1.0) -> Values:
    """Return white noise N = 1, a random walk and a Gauss-Markov process, sample by sample."""
    walk = np.cumsum(K * np.sqrt(DT) * rng.standard_normal(n))
    keep = np.exp(-DT / T)
    drive = np.sqrt(1.0 - keep**2) * rng.standard_normal(n)
    drive[0] = rng.standard_normal()
    return np.asarray(1.0 / np.sqrt(DT) * rng.standard_normal(n) + walk + G * lfilter([1.0], [1.0, -keep], drive))


def test_likelihood_of_white_noise_and_walk_is_the_exact_restricted_one() -> None:
    n, N, K = 18, 0.7, 1.3  # 18 samples: every coefficient has a bin of its own
    values = np.random.default_rng(1).standard_normal(n)
    ramp = np.arange(n) - 8.5
    steps = np.minimum.outer(np.arange(n), np.arange(n)) * K**2 * DT
    C = N**2 / DT * np.eye(n) + steps
    X = np.stack([np.ones(n), ramp], axis=1)
    inverse = np.linalg.inv(C)
    A = X.T @ inverse @ X
    P = inverse - inverse @ X @ np.linalg.solve(A, X.T @ inverse)
    exact = np.linalg.slogdet(C)[1] + np.linalg.slogdet(A)[1] - np.log(n) + values @ P @ values
    spectrum = spectrum_of([np.stack([values, ramp], axis=1)[None]], DT)
    assert len(spectrum.omega) == n - 1
    parameters = np.array([2.0 * np.log(N), 2.0 * np.log(K), 0.0, 0.0])
    fits = evaluate(spectrum, [TermTrial(0, (WHITE, WALK), (1,), parameters)])
    assert float(fits.deviance[0]) == pytest.approx(float(exact), rel=1e-9)
    assert float(fits.beta[0, 0]) == pytest.approx(float(np.linalg.solve(A, X.T @ inverse @ values)[1]), rel=1e-9)


def test_other_spectra_are_the_variances_of_the_coefficients() -> None:
    n, T = 400, 2.0
    lag = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    omega = np.pi * np.arange(1, n) / n
    transform = dct(np.eye(n), axis=0, norm="ortho")[1:]
    rows = np.diff(np.eye(n + 1), axis=0) / DT
    exact = np.einsum("ki,ij,kj->k", transform, rows @ rows.T, transform)
    np.testing.assert_allclose(exact, fixed_shapes(omega, DT)[QUANTISATION], rtol=0.02, atol=0.01 / DT**2)
    markov = np.einsum("ki,ij,kj->k", transform, np.exp(-lag * DT / T), transform)
    shape, slope = markov_shape(omega, DT, np.log([T]))
    np.testing.assert_allclose(markov, shape[0], rtol=0.1)  # the ends of the recording, 1 / 20 of it each
    np.testing.assert_allclose(markov[40:], shape[0][40:], rtol=0.03)
    step = (markov_shape(omega, DT, np.log([T]) + 1e-6)[0] - shape) / 1e-6
    np.testing.assert_allclose(slope, step, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("name", "constant", "density"),
    [
        ("white", np.nan, lambda f: 4.0 + 0.0 * f),
        ("bias_instability", np.nan, lambda f: 4.0 / (2.0 * np.pi * f)),
        ("random_walk", np.nan, lambda f: 4.0 / (2.0 * np.pi * f) ** 2),
        ("gauss_markov", 3.0, lambda f: 24.0 / (1.0 + (6.0 * np.pi * f) ** 2)),
    ],
)
def test_allan_variances_are_the_integrals_of_the_two_sided_spectra(name: str, constant: float, density: Any) -> None:
    for tau in (0.5, 3.0, 40.0):
        f = np.geomspace(1e-6 / tau, 3e3 / tau, 200_001)
        integrand = density(f) * np.sin(np.pi * f * tau) ** 4 / (np.pi * f * tau) ** 2
        integral = 4.0 * np.trapezoid(integrand * f, np.log(f))
        found = allan_variance(name, 2.0, np.array([tau]), constant)
        assert found[0] == pytest.approx(integral, rel=2e-3)


def test_flicker_noise_in_the_sampled_spectrum_is_one_over_f() -> None:
    w = np.array([1e-4, 1e-2, 0.1])
    np.testing.assert_allclose(fixed_shapes(w, DT)[INSTABILITY], 1.0 / w, rtol=1e-3)  # B^2 / (2 pi f) / dt


def test_terms_of_a_mixture_are_found_within_their_intervals() -> None:
    rng = np.random.default_rng(3)
    columns = [simulated(rng, 30_000, K=0.1), simulated(rng, 30_000, G=1.5, T=30.0), simulated(rng, 30_000)]
    t = np.arange(30_000) * DT
    columns[2] += 0.003 * t + 0.4 * np.cos(2.0 * np.pi * 1.2345 * t + 0.3)
    found = identify_noise([recording(np.stack(columns, axis=1))])["gyroscope"]
    assert (found["source"], found["samples"], found["length_s"]) == ("static", 30_000, pytest.approx(3000.0))
    x, y, z = (found["axes"][a] for a in "xyz")
    compositions = [part["ranking"][0]["terms"] for part in (x, y, z)]
    assert compositions == [["white", "random_walk"], ["white", "gauss_markov"], ["white", "ramp", "sinusoid"]]
    (markov,), (sinusoid,) = y["terms"]["gauss_markov"], z["terms"]["sinusoid"]
    for part, truth in (
        (x["terms"]["white"], 1.0),
        (x["terms"]["random_walk"], 0.1),
        (markov, 1.5),
        (markov["correlation_time_s"], 30.0),
        (z["terms"]["ramp"], 0.003),
        (sinusoid, 0.4),
        (sinusoid["frequency_hz"], 1.2345),
    ):
        low, high = part["interval"]
        assert low < truth < high
        assert low < part["value"] < high
    assert x["terms"]["random_walk"]["unit"] == "deg/s/sqrt(s)"
    assert x["terms"]["bias_instability"]["reason"] == "not detected in the presence of random walk"
    for part in (x, y, z):
        assert part["p_value"] > 1e-3
        assert part["doubts"] == []
        curve = {name: np.array(values) for name, values in part["allan"].items()}
        assert np.all((curve["low"] < curve["fit"]) & (curve["fit"] < curve["high"]))
        short = curve["tau_s"] < 30.0
        np.testing.assert_allclose(curve["deviation"][short], curve["fit"][short], rtol=0.2)


def test_a_recording_too_short_for_a_walk_says_so_with_an_upper_limit_that_falls_with_its_length() -> None:
    values = simulated(np.random.default_rng(4), 30_000, K=0.001)
    limits = []
    for n in (1_000, 30_000):
        terms = identify_noise([recording(values[:n])])["gyroscope"]["axes"]["x"]["terms"]
        walk = terms["random_walk"]
        assert walk["value"] is None
        assert f"the recording is too short: over its {0.1 * n:.3g} s" in walk["reason"]
        assert walk["upper_limit"] > 0.001
        limits.append(walk["upper_limit"])
    assert limits[1] < 0.2 * limits[0]


def test_the_upper_limit_is_where_the_profile_likelihood_loses_its_quantile() -> None:
    values = np.random.default_rng(5).standard_normal(500) / np.sqrt(DT)
    found = identify_noise([recording(values)])["gyroscope"]["axes"]["x"]
    limit = found["terms"]["random_walk"]["upper_limit"]
    spectrum = spectrum_of([values[None, :, None]], DT)

    def profile(K: float) -> float:
        start = np.array([0.0, 2.0 * np.log(K), 0.0, 0.0])
        return float(maximised(spectrum, [TermTrial(0, (WHITE, WALK), (), start, held=1)]).deviance[0])

    least = min(profile(K) for K in np.geomspace(1e-5, 1.0, 120))
    assert profile(limit) - least == pytest.approx(1.644854**2, rel=0.05)


def test_a_slow_change_with_temperature_is_no_noise() -> None:
    rng, n = np.random.default_rng(6), 20_000
    warm = 25.0 + 3.0 * np.sin(np.linspace(0.0, 5.0, n))
    found = identify_noise([recording(simulated(rng, n) + 0.3 * warm, temperature=warm)])["gyroscope"]
    terms = found["axes"]["x"]["terms"]
    low, high = terms["temperature"]["interval"]
    assert low < 0.3 < high
    assert found["axes"]["x"]["ranking"][0]["terms"] == ["white", "temperature"]


def test_a_run_states_n_b_and_k_within_the_intervals_of_the_full_identification() -> None:
    rng = np.random.default_rng(11)
    columns = [simulated(rng, 20_000, K=K) for K in (0.0, 0.1, 0.03)]
    rest = recording(np.stack(columns, axis=1))
    stated, full = (identify_noise([rest], full=each)["gyroscope"]["axes"] for each in (False, True))
    for axis in "xyz":
        terms, others = stated[axis]["terms"], full[axis]["terms"]
        assert terms.keys() == others.keys()
        assert stated[axis].keys() == full[axis].keys()
        for name in ("white", "random_walk"):
            assert terms[name]["interval"] is None
            assert (terms[name]["value"] is None) == (others[name]["value"] is None)
            if terms[name]["value"]:
                low, high = others[name]["interval"]
                assert low < terms[name]["value"] < high
        curve = stated[axis]["allan"]
        assert curve["low"] is None
        np.testing.assert_allclose(curve["deviation"][:8], curve["fit"][:8], rtol=0.1)


def test_upper_limits_of_a_run_hold_in_95_percent_of_recordings() -> None:
    rng, K, covered = np.random.default_rng(13), 0.02, []
    for _ in range(60):
        rest = recording(np.stack([simulated(rng, 1000, K=K) for _ in "xyz"], axis=1))
        walks = [a["terms"]["random_walk"] for a in identify_noise([rest], full=False)["gyroscope"]["axes"].values()]
        covered += [walk["upper_limit"] > K for walk in walks if walk["value"] is None]
    assert len(covered) > 150
    assert np.mean(covered) == pytest.approx(0.95, abs=0.06)  # 3 standard deviations of a share


def test_n_b_and_k_are_those_of_all_stretches_together() -> None:
    values = np.random.default_rng(12).standard_normal(6000) / np.sqrt(DT)
    flags = np.zeros(6000, np.uint16)
    for start in range(100, 6000, 110):
        flags[start : start + 12] = 2  # longer than a gap that is bridged
    rest = recording(values, flags=flags)
    white = identify_noise([rest], full=False)["gyroscope"]["axes"]["x"]["terms"]["white"]["value"]
    used = sum(len(s.time) for s in static_stretches("gyroscope", rest))
    assert used > 5000
    assert white == pytest.approx(1.0, abs=4.0 / np.sqrt(2.0 * used))


def test_an_allan_deviation_of_another_noise_is_in_doubt() -> None:
    band = lfilter([1.0], [1.0, -1.6, 0.95], np.random.default_rng(8).standard_normal(20_000))
    (doubt,) = identify_noise([recording(np.asarray(band))], full=False)["gyroscope"]["axes"]["x"]["doubts"]
    assert "not that of N, B and K" in doubt


def test_short_gaps_and_marked_samples_are_bridged_and_long_ones_cut() -> None:
    whole = recording(np.arange(1000.0))
    flags = np.zeros(1000, np.uint16)
    flags[300:303] = 2  # clipped
    gaps = recording(np.arange(1000.0), flags=flags).select(np.r_[0:500, 505:800, 850:1000])
    stretches = static_stretches("gyroscope", gaps)
    assert [len(s.time) for s in stretches] == [800, 150]
    np.testing.assert_allclose(stretches[0].reading[:, 0], np.arange(800.0))
    np.testing.assert_allclose(stretches[0].time, whole.time[:800])


@pytest.mark.parametrize(
    ("values", "reason"),
    [(np.ones(500), "the readings do not change"), (np.random.default_rng(7).standard_normal(40), "60 are needed")],
)
def test_readings_that_hold_no_noise_are_refused_with_a_reason(values: Values, reason: str) -> None:
    found = identify_noise([recording(values)])["gyroscope"]
    assert reason in (found["reason"] or found["axes"]["x"]["reason"])
    assert "no readings of the accelerometer" in identify_noise([recording(values)])["accelerometer"]["reason"]


def test_samples_that_come_in_bursts_are_refused() -> None:
    values = recording(np.random.default_rng(9).standard_normal(999))
    time_ns = values.time_ns.copy()
    time_ns[1::2] -= 90_000_000  # pairs of samples 10 ms apart, every 200 ms
    found = identify_noise([replace(values, time_ns=time_ns)])["gyroscope"]
    assert found["axes"] is None
    assert "sampling intervals scatter by more than 50%" in found["reason"]


def test_a_spectrum_that_no_composition_has_is_in_doubt() -> None:
    rng = np.random.default_rng(8)
    band = lfilter([1.0], [1.0, -1.6, 0.95], rng.standard_normal(20_000))  # a resonance, as of vibration
    (doubt,) = identify_noise([recording(np.asarray(band))])["gyroscope"]["axes"]["x"]["doubts"]
    assert "no composition fits the spectrum" in doubt
    coarse = np.round(0.3 * rng.standard_normal(2000))
    assert "coarser than their noise" in identify_noise([recording(coarse)])["gyroscope"]["axes"]["x"]["doubts"][-1]
