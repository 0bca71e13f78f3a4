"""White noise plus Gauss-Markov bias: the recursions against the dense covariance."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import dblquad

from pipeline.core.records import Noise
from pipeline.estimation.gauss_markov import (
    BIAS_RATIO_GRID,
    SLOW_SPECTRUM_SHARE,
    STATED_WIDTH,
    Blocks,
    GaussMarkov,
    Products,
    Setting,
    WanderPrior,
    block_covariance,
    constant_bias_s,
    orthonormal,
    restricted_on_grid,
    variance_of_average,
)

SETTINGS = [Setting(0.0, 1.0), Setting(0.1, 2.0), Setting(0.7, 60.0), Setting(5.0, 900.0), Setting(1.0, 0.3)]


def shuffled_blocks(seed: int = 0, count: int = 40) -> Blocks:
    """Return blocks of irregular length with gaps, in no order, on two clocks."""
    rng = np.random.default_rng(seed)
    length = rng.uniform(0.0, 9.0, count)
    length[::5] = 0.0
    start = np.cumsum(rng.uniform(0.0, 5.0, count) + np.append(0.0, length[:-1]))
    clock = np.repeat([0, 1], [25, count - 25])
    order = rng.permutation(count)
    rows = np.cumsum(np.append(0, rng.integers(1, 5, count - 1)))
    return Blocks(rows, rng.uniform(1.0, 50.0, count), start[order], length[order], clock[order])


def dense(blocks: Blocks, setting: Setting) -> np.ndarray:
    return np.diag(1.0 / blocks.weight) + setting.ratio**2 * blocks.covariance(setting.time)


def test_the_covariance_of_averages_is_the_integral_over_both_blocks() -> None:
    start, length, tau = np.array([0.0, 5.0]), np.array([3.0, 8.0]), 4.0
    B = block_covariance(start, length, tau)
    for j in range(2):
        for k in range(2):
            inner = dblquad(
                lambda s, t: np.exp(-abs(s - t) / tau), start[j], start[j] + length[j], start[k], start[k] + length[k]
            )[0]
            assert B[j, k] == pytest.approx(inner / (length[j] * length[k]), rel=1e-6)
    assert variance_of_average(np.array([0.0, 1e-4]), 1.0) == pytest.approx([1.0, 1.0 - 1e-4 / 3.0], abs=1e-9)


def test_products_solutions_and_determinants_are_those_of_the_dense_covariance() -> None:
    blocks = shuffled_blocks()
    columns = np.random.default_rng(1).standard_normal((len(blocks.weight), 4))
    model = GaussMarkov(blocks, SETTINGS)
    for found, squares, solved, logarithm, setting in zip(
        *(each(columns) for each in (model.products, model.squares, model.solve)),
        model.log_determinant,
        SETTINGS,
        strict=True,
    ):
        C = dense(blocks, setting)
        np.testing.assert_allclose(squares, np.diag(found), rtol=1e-9)
        np.testing.assert_allclose(found, columns.T @ np.linalg.solve(C, columns), rtol=1e-9)
        np.testing.assert_allclose(solved, np.linalg.solve(C, columns), rtol=1e-8)
        assert logarithm == pytest.approx(np.linalg.slogdet(C)[1], rel=1e-10)


def test_the_restricted_likelihood_is_that_of_the_projected_values() -> None:
    blocks = shuffled_blocks(2)
    rng = np.random.default_rng(3)
    values = rng.standard_normal((len(blocks.weight), 2))
    design = orthonormal(rng.standard_normal((len(values), 3)), 1.0 / blocks.weight, 1e-3)
    logarithm, squares = GaussMarkov(blocks, SETTINGS).restricted(design, values)
    Q = np.linalg.qr(design, mode="complete")[0][:, 3:]
    reference = [np.linalg.slogdet(Q.T @ dense(blocks, s) @ Q)[1] for s in SETTINGS]
    expected = [
        np.einsum("ic,ij,jc->c", Q.T @ values, np.linalg.inv(Q.T @ dense(blocks, s) @ Q), Q.T @ values)
        for s in SETTINGS
    ]
    np.testing.assert_allclose(squares, expected, rtol=1e-8)
    np.testing.assert_allclose(logarithm - logarithm[0], np.array(reference) - reference[0], atol=1e-8)


def test_a_likelihood_between_the_computed_ratios_is_that_of_each_setting() -> None:
    rng = np.random.default_rng(8)
    m, times, ratios = 90, (25.0, 100.0, 400.0), BIAS_RATIO_GRID.tolist()
    weight, length = rng.integers(60, 120, m).astype(float), rng.uniform(5.0, 9.0, m)
    blocks = Blocks(np.arange(m), weight, np.cumsum(length) - length, length, np.repeat([0, 1], [60, 30]))
    design = orthonormal(rng.standard_normal((m, 4)), 1.0 / weight, 1e-3)
    wander = GaussMarkov(blocks, [Setting(0.3, 100.0)]).draw(rng, 2)
    values = np.column_stack([wander, rng.standard_normal(m) / np.sqrt(weight), design[:, 0]])
    found = restricted_on_grid(blocks, times, ratios, design, values)
    expected = GaussMarkov(blocks, [Setting(q, tau) for tau in times for q in ratios]).restricted(design, values)
    np.testing.assert_allclose(found[0], expected[0], atol=0.02)
    np.testing.assert_allclose(found[1][:, :3], expected[1][:, :3], rtol=2e-3)
    assert np.all(found[1][:, 3] < 1e-9)  # nothing but rounding is left of a column of the design


def test_draws_have_the_dense_covariance() -> None:
    blocks, true = shuffled_blocks(4), Setting(0.4, 33.0)
    drawn = GaussMarkov(blocks, [true]).draw(np.random.default_rng(5), 40_000)
    assert np.cov(drawn) == pytest.approx(dense(blocks, true), abs=0.02)


def test_products_of_samples_and_the_expected_bias_are_those_of_all_rows() -> None:
    blocks = shuffled_blocks(6)
    rng = np.random.default_rng(7)
    weight = rng.uniform(0.5, 2.0, blocks.first[-1] + 3)
    blocks = Blocks(blocks.first, blocks.sums(weight[:, None])[:, 0], blocks.start, blocks.length, blocks.clock)
    columns, label, setting = rng.standard_normal((len(weight), 3)), blocks.label(len(weight)), SETTINGS[2]
    bias = setting.ratio**2 * blocks.covariance(setting.time)[np.ix_(label, label)]
    C = np.diag(1.0 / weight) + bias
    held = Products(blocks, weight, columns)
    (found,), (logarithm,) = held.products([setting])
    np.testing.assert_allclose(found, columns.T @ np.linalg.solve(C, columns), rtol=1e-9)
    assert logarithm == pytest.approx(np.linalg.slogdet(C)[1] + np.sum(np.log(weight)), rel=1e-9)
    np.testing.assert_allclose(held.influence(setting), np.linalg.solve(C, columns).T, atol=1e-10)
    np.testing.assert_allclose(held.bias(setting), bias @ np.linalg.solve(C, columns), atol=1e-10)


def test_a_stated_instability_leaves_no_hypothesis_without_any() -> None:
    assert min(s.ratio for s in WanderPrior(1e-3, 50.0).grid(1e-2)) > 0.0
    free = WanderPrior().grid(1e-2)
    none = sum(np.exp(s.prior) for s in free if s.ratio == 0.0)
    assert none / sum(np.exp(s.prior) for s in free) == pytest.approx(0.9)


def test_what_a_static_recording_tells_counts_once_beside_what_the_sensor_file_states() -> None:
    tried = np.geomspace(1e-5, 1e-1, 30)
    likelihood = -0.5 * (np.log(tried / 2e-3) / 0.4) ** 2 + np.zeros((5, 1))
    stated, white = WanderPrior(1e-3, 80.0), 1e-2
    grid = WanderPrior(2e-3, 100.0, 0.4, stated, (tried, likelihood)).grid(white)
    wander = np.array([s.ratio * white for s in grid])
    near = (np.abs(np.log(wander / 1e-3)) < 2.5 * STATED_WIDTH) & np.isin([s.time for s in grid], [100.0])
    expected = -0.5 * (np.log(wander[near] / 1e-3) / STATED_WIDTH) ** 2 + np.interp(wander[near], tried, likelihood[0])
    found = np.array([s.prior for s in grid])[near]
    assert np.count_nonzero(near) > 10
    np.testing.assert_allclose(found - found[0], expected - expected[0], atol=1e-9)


def test_a_bias_counts_as_constant_while_its_spectrum_is_below_that_of_white_noise() -> None:
    white, wander, tau, interval = 2.0, 3.0, 100.0, 0.1
    noise = Noise(np.full(3, white), np.full(3, wander), tau, "static")
    lags = np.arange(-200_000, 200_001) * 0.01  # s
    frequency = 1.0 / (2.0 * constant_bias_s(noise, interval))
    spectrum = 0.01 * np.sum(wander**2 * np.exp(-np.abs(lags) / tau) * np.cos(2.0 * np.pi * frequency * lags))
    assert spectrum == pytest.approx(SLOW_SPECTRUM_SHARE * white**2 * interval, rel=0.01)
    assert constant_bias_s(Noise(np.full(3, white), np.zeros(3), tau, "static"), interval) == np.inf
    assert constant_bias_s(Noise(np.full(3, white), np.full(3, wander), tau, "rests"), interval) == np.inf


def test_blocks_far_vaguer_than_the_others_are_as_if_absent() -> None:
    """Errors of a table at its stops are 1e9 times the noise of readings that hardly have any."""
    rng = np.random.default_rng(0)
    sharp = rng.permutation(np.repeat([True, False], 33))
    weight = np.where(sharp, 80.0, 1e-19)
    start = np.cumsum(rng.uniform(3.0, 33.0, 66))
    rows, zero, clock = np.arange(66), np.zeros(66), np.ones(66, int)
    columns = rng.standard_normal((66, 4)) * sharp[:, None]
    setting = [Setting(3.0, 60.0)]
    every = GaussMarkov(Blocks(rows, weight, start, zero, clock), setting).products(columns)
    some = Blocks(rows[:33], weight[sharp], start[sharp], zero[:33], clock[:33])
    assert every == pytest.approx(GaussMarkov(some, setting).products(columns[sharp]), rel=1e-6)
