"""Errors of the table's angle at its stops, eliminated from a fit, against dense covariance matrices."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from pipeline.app.one_unit import unit_row
from pipeline.checks.bench import signed_axis
from pipeline.core.records import Noise
from pipeline.estimation.design import Design
from pipeline.estimation.gauss_markov import Blocks, Products, Setting
from pipeline.estimation.observations import Observations, observe, weighted
from pipeline.estimation.table_errors import StopErrors

sys.path.insert(0, str(Path(__file__).parents[1] / "preprocessing"))
sys.path.insert(0, str(Path(__file__).parents[1] / "study"))
from bench_units import judged
from benches import STEPS, USUAL_UP, K, recordings_of

ANGLE_DEG = 0.05
SCALE = np.array([8e-4, 9e-4, 7e-4])  # g
SETTINGS = [Setting(0.1, 60.0), Setting(1.0, 20.0)]


def observed(angle_deg: float) -> Observations:
    table = unit_row(["sensor=mpu6050", f"table.angle_accuracy_deg={angle_deg}"]).config.table
    turns = [r for r in recordings_of({}) if r.role == "accelerometer"]
    return weighted(observe("accelerometer", turns, table), Noise(SCALE, 0.1 * SCALE, 60.0, "rests"))


def covariance(observations: Observations, setting: Setting) -> np.ndarray:
    """Return the covariance of the readings, axis by axis, with the turns as ``benches`` makes them."""
    blocks, weight = observations.blocks, observations.weight
    label = blocks.label(len(weight))
    C = np.diag(1.0 / weight) + setting.ratio**2 * blocks.covariance(setting.time)[np.ix_(label, label)]
    found = block_diag(*(s**2 * C for s in SCALE))
    for part, axis in zip(observations.parts, "xyz", strict=True):
        assert part.motion.angle is not None
        own = np.concatenate([np.full(len(p.weight), p is part) for p in observations.parts])
        for angle in np.unique(STEPS):
            here = own.copy()
            here[own] = np.isclose(part.motion.angle, angle)
            about = -np.radians(angle + np.array([[-0.5], [0.5]])) * signed_axis(f"+{axis}")
            behind, ahead = Rotation.from_rotvec(about).apply(signed_axis(USUAL_UP[axis]))
            slope = K["accelerometer"] @ (ahead - behind)  # g per deg
            t = ANGLE_DEG * np.concatenate([here * s for s in slope])
            found += np.outer(t, t)
    return found


def test_products_and_estimates_are_those_of_the_dense_covariance() -> None:
    observations = observed(ANGLE_DEG)
    n = len(observations.weight)
    u = np.concatenate([part.motion.specific_force for part in observations.parts])
    X = np.hstack([np.kron(np.eye(3), np.ones((n, 1))), np.kron(np.eye(3), u)])
    y = observations.reading.T.ravel()
    design = Design(observations, [], K["accelerometer"], SCALE)
    found, logarithms = design.products(SETTINGS)
    dense = [covariance(observations, setting) for setting in SETTINGS]
    for products, sigma, setting in zip(found, dense, SETTINGS, strict=True):
        columns = np.column_stack([X, y])
        expected = columns.T @ np.linalg.solve(sigma, columns)
        assert np.allclose(products, expected, rtol=2e-4, atol=2e-4 * np.abs(expected).max())
        fitted = design.linear_map(setting)
        axes = zip(fitted.weights, fitted.derivative, y.reshape(3, n), strict=True)
        by_map = np.sum([back @ (weights @ of_axis) for weights, back, of_axis in axes], axis=0)
        by_matrix = np.linalg.solve(expected[:-1, :-1], expected[:-1, -1])
        spread = np.sqrt(np.diag(np.linalg.inv(expected[:-1, :-1])))
        assert np.all(np.abs(by_map - by_matrix) < 0.01 * spread)
    one, two = (np.linalg.slogdet(sigma)[1] for sigma in dense)
    assert logarithms[1] - logarithms[0] == pytest.approx(two - one, abs=0.02)


def test_bias_and_errors_at_stops_are_eliminated_as_by_dense_matrices_on_two_clocks_in_any_order() -> None:
    rng, count, scale = np.random.default_rng(5), 12, np.array([0.5, 1.0, 2.0])
    first, clock = np.array([0, 4, 5, 11, 17, 20, 30]), np.array([1, 1, 1, 0, 0, 0, 0])
    weight, columns = rng.uniform(1.0, 5.0, 40), rng.normal(size=(40, 5))
    start = np.array([3.0, 5.5, 9.0, 40.0, 7.0, 8.0, 21.0])  # on a shared clock, recordings follow in any order
    blocks = Blocks(first, np.add.reduceat(weight, first), start, np.zeros(7), clock)
    stop = np.sort(rng.integers(0, count - 1, 40))
    before, after = rng.normal(size=(2, 40, 3)) * (rng.uniform(size=40) > 0.3)[:, None]
    of_axis = [(np.array([0, 1, c + 2]), np.array([0, 1, c + 2])) for c in range(3)]
    rows = Products(blocks, weight, columns)
    stops = StopErrors(rows, before, after, stop, count)
    sums = stops.sums(scale, of_axis, 5)
    A, T = np.zeros((3, 40, 5)), np.zeros((3, 40, count))
    for c, (local, place) in enumerate(of_axis):
        A[c][:, place] = columns[:, local] / scale[c]
        T[c, np.arange(40), stop] = before[:, c]
        T[c, np.arange(40), stop + 1] += after[:, c]
    label = blocks.label(40)
    settings = [Setting(0.0, 1.0), Setting(0.02, 30.0), Setting(3.0, 500.0)]
    dense = []
    for setting in settings:
        bias = setting.ratio**2 * blocks.covariance(setting.time)[np.ix_(label, label)]
        known = np.vstack([*T])
        dense.append(np.kron(np.eye(3), np.diag(1.0 / weight) + bias) + known @ known.T)
    stacked = np.vstack([*A])
    white = stacked.T @ (np.tile(weight, 3)[:, None] * stacked)
    found, logarithms = stops.products(settings, white, sums)
    expected = np.stack([stacked.T @ np.linalg.solve(sigma, stacked) for sigma in dense])
    assert np.allclose(found, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
    determinants = np.array([np.linalg.slogdet(sigma)[1] for sigma in dense])
    assert logarithms - logarithms[0] == pytest.approx(determinants - determinants[0], abs=1e-8)
    for setting, sigma in zip(settings, dense, strict=True):
        explained = np.vstack(stops.explained(setting, sums))
        left = np.tile(weight, 3)[:, None] * stacked - np.linalg.solve(sigma, stacked)
        assert np.allclose(explained, left, rtol=1e-8, atol=1e-8 * np.abs(left).max())


def test_errors_of_the_angle_that_noise_hides_change_nothing() -> None:
    assert observed(ANGLE_DEG).angle_deg == ANGLE_DEG
    hidden = observed(1e-4)
    assert hidden.angle_deg == 0.0
    assert np.array_equal(hidden.less_stop_errors.weight, observed(0.0).weight)
    lower = observed(ANGLE_DEG).less_stop_errors.weight / hidden.weight
    assert 0.01 < lower.min() <= lower.max() < 0.1  # 12 samples of 8e-4 g beside 8.7e-4 g, once a stop


def test_an_effect_across_the_motion_is_named_beside_errors_of_the_angle_and_none_is_invented() -> None:
    hysteresis = judged("seats", 62, 51, 1.0, sensors=["accelerometer"])
    assert hysteresis["hidden"] == "accelerometer.hysteresis"  # 1e-4 g, with 1.7e-4 g of an angle error at each stop
    assert hysteresis["sensors"]["accelerometer"]["selected"] == ["hysteresis"]
    sensor = judged("single", 62, 11, 1.0, sensors=["accelerometer"])["sensors"]["accelerometer"]
    assert sensor["selected"] == []  # without these errors in the model: table_tilt
