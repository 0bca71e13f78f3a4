"""The worked examples of the GUM (JCGM 100:2008) and of JCGM 101:2008, to the digits that they print."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from pipeline.core.records import coverage_factor
from pipeline.estimation.engine import compared, derivative, numerical_tolerance
from pipeline.estimation.uncertainty_budget import effective_degrees_of_freedom
from tests.estimation.complex_step import solve_linear

Function = Callable[[np.ndarray], np.ndarray]

# H.2: five simultaneous observations of V (V), I (mA) and phase angle (rad).
VOLTAGE = [5.007, 4.994, 5.005, 4.990, 4.999]
CURRENT = [19.663, 19.639, 19.640, 19.685, 19.678]
PHASE = [1.0456, 1.0438, 1.0468, 1.0428, 1.0433]
# H.3: readings of a thermometer and corrections, degC.
TEMPERATURE = [21.521, 22.012, 22.512, 23.003, 23.507, 23.999, 24.513, 25.002, 25.503, 26.010, 26.511]
CORRECTION = [-0.171, -0.169, -0.166, -0.159, -0.164, -0.165, -0.156, -0.157, -0.159, -0.161, -0.160]


def correlation(covariance: np.ndarray) -> np.ndarray:
    u = np.sqrt(np.diag(covariance))
    return covariance / np.outer(u, u)


def propagate(function: Function, x: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    C = derivative(function, x, 1e-4 * np.sqrt(np.diag(covariance)))
    return function(x), C @ covariance @ C.T


def impedance(x: np.ndarray) -> np.ndarray:
    z = x[0] / x[1]
    return np.array([z * np.cos(x[2]), z * np.sin(x[2]), z])


def test_h2_resistance_reactance_and_impedance_with_their_correlations() -> None:
    observed = np.column_stack([VOLTAGE, np.array(CURRENT) * 1e-3, PHASE])
    mean, covariance = observed.mean(axis=0), np.cov(observed.T) / len(observed)
    assert [round(m, d) for m, d in zip(mean, (4, 7, 5), strict=True)] == [4.9990, 0.0196610, 1.04446]
    u = np.sqrt(np.diag(covariance))
    assert [round(s, d) for s, d in zip(u, (4, 7, 5), strict=True)] == [0.0032, 0.0000095, 0.00075]
    r = correlation(covariance)
    assert [round(r[i, j], 2) for i, j in ((0, 1), (0, 2), (1, 2))] == [-0.36, 0.86, -0.65]
    value, result = propagate(impedance, mean, covariance)
    assert np.round(value, 3).tolist() == [127.732, 219.847, 254.260]
    u = np.sqrt(np.diag(result))
    assert [round(u[0], 3), round(u[2], 3)] == [0.071, 0.236]
    assert np.floor(1e3 * u[1]) / 1e3 == 0.295  # the GUM cuts 0.29558 here, where it rounds elsewhere
    assert u == pytest.approx([0.0710714074, 0.2955816839, 0.2363361], rel=1e-6)  # GTC's, of the same readings
    r = correlation(result)
    assert [round(r[i, j], 3) for i, j in ((0, 1), (0, 2), (1, 2))] == [-0.588, -0.485, 0.993]


def test_h3_calibration_line_of_a_thermometer() -> None:
    t = np.array(TEMPERATURE) - 20.0
    found = solve_linear(np.column_stack([np.ones_like(t), t]), np.array(CORRECTION))
    u = found.standard_uncertainty
    assert [round(found.x[0], 4), round(u[0], 4)] == [-0.1712, 0.0029]
    assert [round(found.x[1], 5), round(u[1], 5)] == [0.00218, 0.00067]
    assert round(correlation(found.covariance)[0, 1], 3) == -0.930
    assert round(float(np.sqrt(found.residual @ found.residual / found.degrees_of_freedom)), 4) == 0.0035
    value, covariance = propagate(lambda y: np.array([y[0] + 10.0 * y[1]]), found.x, found.covariance)
    assert [round(value[0], 4), round(float(np.sqrt(covariance[0, 0])), 4)] == [-0.1494, 0.0041]
    assert found.degrees_of_freedom == 9


def test_h1_effective_degrees_of_freedom_of_an_end_gauge() -> None:
    # Contributions in nm: standard, measured difference, expansion coefficients, temperature difference (table H.1).
    difference = [5.8, 3.9, 6.7]
    inner = effective_degrees_of_freedom(np.array([difference]).T, [24, 5, 8])
    assert int(inner[0]) == 25
    contributions = np.array([[25.0, 9.7, 2.9, 16.6]]).T
    nu = effective_degrees_of_freedom(contributions, [18, 25.6, 50, 2])
    assert int(nu[0]) == 16
    assert round(float(np.sqrt(np.sum(contributions**2)))) in (31, 32)
    assert round(coverage_factor(16, 0.99), 2) == 2.92


def test_the_coverage_factor_is_two_only_for_many_degrees_of_freedom() -> None:
    table = {5: 2.65, 10: 2.28, 20: 2.13, 50: 2.05, 100: 2.025}  # GUM table G.2, 95.45 %
    assert {nu: round(coverage_factor(nu, 0.9545), 3 if nu == 100 else 2) for nu in table} == table


def four_rectangular(generator: np.random.Generator, trials: int) -> np.ndarray:
    return generator.uniform(-np.sqrt(3.0), np.sqrt(3.0), (trials, 4))


def test_jcgm_101_9_2_3_sum_of_four_rectangular_quantities() -> None:
    drawn = four_rectangular(np.random.default_rng(101), 4_000_000).sum(axis=1, keepdims=True)
    U = coverage_factor(np.inf) * 2.0
    assert round(U, 2) == 3.92
    found = compared(drawn, [0.0], [U])  # two digits: 2.0 = 20 x 10^-1, delta = 0.05
    assert round(float(found.standard_uncertainty[0]), 2) == 2.00
    interval = np.concatenate([found.low, found.high])
    assert np.round(interval, 2).tolist() == [-3.88, 3.88]
    exact = 2.0 * np.sqrt(3.0) * (2.0 - 0.6**0.25)
    assert np.abs(interval) == pytest.approx([exact, exact], abs=0.01)
    assert found.tolerance.tolist() == [0.05]
    assert found.validated.tolist() == [True]
    three = compared(drawn, [0.0], [U], digits=3)
    assert three.tolerance.tolist() == pytest.approx([0.005])
    assert three.validated.tolist() == [False]


def test_jcgm_101_7_9_2_numerical_tolerance() -> None:
    assert numerical_tolerance([0.00035, 2.0, 100.0, 0.0996]) == pytest.approx([0.000005, 0.05, 5.0, 0.005])
    assert numerical_tolerance([0.00035], digits=1) == pytest.approx([0.00005])


def test_the_interval_of_a_skew_distribution_has_as_much_outside_on_either_side() -> None:
    found = compared(np.random.default_rng(1).standard_normal((200_000, 1)) ** 2, [1.0], [1.0])
    assert np.concatenate([found.low, found.high]) == pytest.approx([0.00098, 5.02], abs=0.06)
