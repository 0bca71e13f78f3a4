"""The posterior over effects: against dense evidence, full enumeration, draws, and units with known truth."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.linalg import null_space
from scipy.special import logsumexp

from pipeline.core.records import Motion
from pipeline.estimation.candidates import time_constants
from pipeline.estimation.evidence import (
    LIMIT_SCALES,
    READINGS,
    SCALE_PRIOR,
    CandidateProblem,
    Given,
    Version,
    _explained,
    excited,
)
from pipeline.estimation.posterior import ODDS, UPPER_LIMIT_SHARE, Answers, SetSearch, answers, quantiles
from pipeline.estimation.ranking import without
from pipeline.physics.effects.equations import BEND, free_curves

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    Values = NDArray[np.float64]

NAMES = {"a": 2, "b": 1, "c": 3}


class Dense:
    """Readings of a base and three effects under two noises, and their evidence by the definition."""

    def __init__(self, seed: int, sizes: dict[str, float]) -> None:
        rng = np.random.default_rng(seed)
        n = 40
        self.X = np.column_stack([np.ones(n), rng.standard_normal(n)])
        self.Z = {name: rng.standard_normal((n, k)) * 8.0 for name, k in NAMES.items()}
        self.Z["b"] += 0.7 * self.Z["a"][:, :1]
        walk = np.minimum.outer(np.arange(n), np.arange(n)) + 1.0
        self.C = [np.eye(n), np.eye(n) + 0.02 * walk]
        self.prior = np.log([0.7, 0.3])
        self.y = self.X @ [3.0, -1.0] + np.linalg.cholesky(self.C[1]) @ rng.standard_normal(n)
        for name, size in sizes.items():
            self.y += self.Z[name] @ (size * rng.choice([-1.0, 1.0], NAMES[name]))

    def log_evidence(self, scales: dict[str, float], theta: int) -> float:
        """Return log p of the contrasts of the readings, sigma integrated with the prior 1 / sigma."""
        A = null_space(self.X.T)
        V = self.C[theta] + sum((s**2 * self.Z[n] @ self.Z[n].T for n, s in scales.items()), np.zeros_like(self.C[0]))
        V, z = A.T @ V @ A, A.T @ self.y
        return float(
            self.prior[theta] - 0.5 * np.linalg.slogdet(V)[1] - 0.5 * len(z) * np.log(z @ np.linalg.solve(V, z))
        )

    def averaged(self, names: Iterable[str]) -> float:
        """Return log p of a set, all scales and noises enumerated, with its prior odds."""
        names = tuple(names)
        terms = [
            self.log_evidence({n: float(LIMIT_SCALES[s]) for n, s in zip(names, picks, strict=True)}, theta)
            + sum(float(SCALE_PRIOR[s]) for s in picks)
            for picks in product(range(len(LIMIT_SCALES)), repeat=len(names))
            for theta in range(2)
        ]
        return float(logsumexp(terms)) + ODDS * len(names)

    def problem(self) -> CandidateProblem:
        """Return the same as products under each noise."""
        columns = np.column_stack([*self.Z.values(), self.y])
        products, prior = [], []
        for C, log_prior in zip(self.C, self.prior, strict=True):
            inverse = np.linalg.inv(C)
            XtX = self.X.T @ inverse @ self.X
            M = inverse - inverse @ self.X @ np.linalg.solve(XtX, self.X.T @ inverse)
            products.append(columns.T @ M @ columns)
            prior.append(log_prior - 0.5 * np.linalg.slogdet(C)[1] - 0.5 * np.linalg.slogdet(XtX)[1])
        edges = np.cumsum([0, *NAMES.values()])
        versions = {
            name: [Version(np.arange(start, stop), 0.0)]
            for name, start, stop in zip(NAMES, edges[:-1], edges[1:], strict=True)
        }
        limits = {name: np.ones(k) for name, k in NAMES.items()}
        padded = np.pad(np.array(products), ((0, 0), (0, 1), (0, 1)))
        return CandidateProblem(padded, np.array(prior), 0.0, len(self.y) - 2.0, versions, limits)


@pytest.mark.parametrize("sizes", [{}, {"a": 0.1}, {"a": 0.3, "c": 0.05}], ids=["nothing", "weak", "two"])
def test_the_score_of_every_set_is_its_evidence_by_the_definition(sizes: dict[str, float]) -> None:
    dense = Dense(3, sizes)
    search = SetSearch(dense.problem())
    zero = search.pool[frozenset()].score - dense.averaged(())
    for names, found in search.pool.items():
        expected = dense.averaged(sorted(names)) + zero
        assert found.score == pytest.approx(expected, abs=1e-8 if len(names) < 2 else 0.15), names
    assert search.best() == frozenset(sizes)


@pytest.mark.parametrize("sizes", [{}, {"a": 0.1}, {"a": 0.3, "c": 0.05}], ids=["nothing", "weak", "two"])
def test_the_probabilities_of_all_sets_are_those_of_their_evidence_and_sum_to_one(sizes: dict[str, float]) -> None:
    dense = Dense(3, sizes)
    found = answers([SetSearch(dense.problem())], lambda _: 0, NAMES)
    stated = dict(found.sets)
    each = {names: dense.averaged(names) for names in stated}
    total = logsumexp(list(each.values()))
    assert sum(stated.values()) == pytest.approx(1.0, abs=1e-9)
    for names, value in each.items():
        assert stated[names] == pytest.approx(np.exp(value - total), abs=0.03), names
    for name in NAMES:
        assert found.probability(name) == pytest.approx(sum(p for names, p in stated.items() if name in names))


def test_residuals_below_the_known_noise_are_no_evidence_of_less_noise() -> None:
    dense = Dense(3, {"a": 0.0, "b": 0.0, "c": 0.0})
    problem = dense.problem()
    free, size = problem.free, 0.3 * problem.free / float(problem.products[0, READINGS, READINGS])
    for factor, known in ((size, True), (1e4 * size, False)):  # of the readings' squares
        products = problem.products.copy()
        products[:, READINGS] *= np.sqrt(factor)
        products[:, :, READINGS] *= np.sqrt(factor)
        given = Given(replace(problem, products=products, least=1.0), [{}, {"b": (0, 2)}])
        rss = given.squares[0]
        assert bool(np.all(rss < free)) == known
        gain = np.diff(given.alone()[0])[0] - np.diff(given.level[0])[0]
        wanted = 0.5 * (rss[0] - rss[1]) if known else 0.5 * free * np.log(rss[0] / rss[1])
        assert gain == pytest.approx(wanted, rel=1e-6)


def test_an_upper_limit_is_the_quantile_of_draws_from_the_posterior() -> None:
    rng = np.random.default_rng(8)
    weight, mean = np.array([0.7, 0.2, 0.1]), np.array([[0.1], [-1.0], [2.0]])
    deviation = np.array([[0.5], [0.1], [1.0]])
    pick = rng.choice(3, 400_000, p=weight)
    drawn = np.abs(mean[pick, 0] + deviation[pick, 0] * rng.standard_normal(len(pick)))
    alone = np.ones(1), np.zeros((1, 2)), np.array([[1.0, 2.0]])
    of_two, of_three, again = quantiles([alone, (weight, mean, deviation), alone])
    assert of_three == pytest.approx([np.quantile(drawn, UPPER_LIMIT_SHARE)], rel=0.01)
    assert of_two == pytest.approx([2.128045, 4.256090], rel=1e-6)  # of a normal distribution: 59/60 from one side
    assert again.tolist() == of_two.tolist()


def test_limits_of_absent_effects_cover_the_true_size_as_often_as_they_say() -> None:
    rng, covered, n = np.random.default_rng(21), 0, 60
    for k in range(n):  # sizes drawn from the prior at its second scale
        size = abs(0.06 * rng.standard_normal())
        dense = Dense(1000 + k, {"b": size})
        covered += answers([SetSearch(dense.problem())], lambda _: 0, NAMES).upper_limit["b"][0] >= size
    assert covered >= 54  # 3 % point of a binomial of 60 and 0.95


def test_effects_that_exclude_each_other_are_never_together() -> None:
    dense = Dense(5, {"a": 0.3, "b": 0.3})
    free = dense.problem()
    apart = CandidateProblem(
        free.products, free.prior, free.within, free.free, free.versions, free.limits,
        {"a": frozenset("b"), "b": frozenset("a")},
    )  # fmt: skip
    assert frozenset("ab") in SetSearch(free).pool
    found = SetSearch(apart)
    assert not any({"a", "b"} <= names for names in found.pool)
    assert set(answers([found], lambda _: 0, NAMES).upper_limit) == set(NAMES)


def test_an_answer_set_holds_the_fewest_sets_with_95_percent() -> None:
    sets = [(("a",), 0.6), (("b",), 0.3), ((), 0.06), (("a", "b"), 0.04)]
    found = Answers(sets, {})
    assert found.answer_set() == sets[:3]
    assert found.probability("a") == pytest.approx(0.64)


def test_directions_without_excitation_are_left_out() -> None:
    column = np.random.default_rng(1).standard_normal((30, 1))
    Z = np.column_stack([column, column])  # only the sum of both parameters shows
    size = np.linalg.norm(Z, axis=0)
    (change,) = excited((Z.T @ Z)[None], size[None], np.array([[2.0, 2.0]]), 1e-3)
    assert change is not None
    assert np.linalg.matrix_rank(Z @ change, tol=1e-9) == 1
    np.testing.assert_allclose(Z @ change, 2.0 * Z, atol=1e-12)


def test_a_column_of_which_only_rounding_is_left_carries_no_information() -> None:
    rng = np.random.default_rng(4)
    base = rng.standard_normal((200, 3)) * [1.0, 1e3, 1e-3]
    copy, near = base @ [1.0, 2e-3, -5e2], base @ [1.0, 1e-3, 0.0] + 0.1 * rng.standard_normal(200)
    A = np.column_stack([base, copy, near, rng.standard_normal(200)])
    rest = without((A.T @ A)[None], np.arange(3))[0]
    assert not rest[:4].any()
    assert not rest[:, :4].any()
    left = near - base @ np.linalg.lstsq(base, near, rcond=None)[0]
    assert rest[4, 4] == pytest.approx(left @ left, rel=1e-6)


def test_the_free_curve_of_the_rate_holds_lever_arms_that_differ_by_axis() -> None:
    rng = np.random.default_rng(6)
    omega = np.repeat(np.eye(3), 50, axis=0) * rng.uniform(-200.0, 200.0, 150)[:, None]
    n, zero = len(omega), np.zeros((len(omega), 3))
    motion = Motion(np.arange(n) * 0.1, zero, omega, zero, zero, None, None, None, None, np.zeros(n, bool))
    curve = next(c for c in free_curves("accelerometer", [motion], bent=False) if c.name == "other_rate")
    Z = np.column_stack([np.ones(n), curve.regressors("accelerometer", motion, np.eye(3), np.zeros(0))])
    for axis, arm in enumerate(rng.standard_normal((3, 3))):  # of the proof mass of each axis
        felt = np.cross(omega, np.cross(omega, arm))[:, axis]
        taken = Z @ np.linalg.lstsq(Z, felt, rcond=None)[0]
        np.testing.assert_allclose(taken, felt, atol=1e-9 * np.abs(felt).max())


def test_a_bend_of_the_temperature_saturates_from_either_end_on() -> None:
    temperature = np.linspace(20.0, 30.0, 101)
    n, zero = len(temperature), np.zeros((len(temperature), 3))
    motion = Motion(np.arange(n) * 0.1, zero, zero, zero, zero, temperature, None, None, None, np.ones(n, bool))
    (bend,) = (c for c in free_curves("gyroscope", [motion], bent=True) if c.name.endswith(BEND))
    terms = [term for term, _ in time_constants(bend, "gyroscope")]
    columns = np.concatenate([t.regressors("gyroscope", motion, np.eye(3)) for t in terms], axis=1)
    ends = columns[[0, -1]]
    np.testing.assert_allclose(ends.max(axis=0), 1.0)
    assert ends.min() < 1e-4
    assert np.all(np.abs(np.diff(columns, axis=0).sum(axis=0)) > 0.8)
    for wanted in (np.exp((temperature - 30.0) / 2.7), np.tanh((temperature - 20.0) / 2.5)):
        plain = np.column_stack([np.ones(n), wanted])
        left = [
            np.std(wanted - (A := np.column_stack([plain[:, 0], c])) @ np.linalg.lstsq(A, wanted)[0]) for c in columns.T
        ]
        assert min(left) < 0.03 * np.std(wanted)


@pytest.mark.parametrize("columns", [3, 9])
@pytest.mark.parametrize("power", [1e6, 1e19])
def test_one_direction_far_above_the_noise_is_scored_whatever_rounding_adds(columns: int, power: float) -> None:
    """By hand: ``log|I + D G D| = log(1 + s^2 g)`` for a G of one direction, also if rounding makes it indefinite."""
    rng = np.random.default_rng(3)
    u = rng.standard_normal((1, 2, columns))
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    added = rng.standard_normal((1, 2, columns, columns)) * (1e-11 if power > 1e12 else 0.0)
    inner = power * (u[..., :, None] * u[..., None, :] + added + added.swapaxes(2, 3))
    gain, log_det = _explained(inner, 0.5 * power * u, np.array([0.25 * power]))
    shown = LIMIT_SCALES[:, None, None] ** 2 * power
    assert gain == pytest.approx(np.broadcast_to(0.25 * power * shown / (1.0 + shown), gain.shape), rel=1e-9)
    assert log_det == pytest.approx(np.broadcast_to(np.log1p(shown), gain.shape), abs=2e-2)
