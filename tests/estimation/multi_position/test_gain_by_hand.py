"""The gain of an effect beside a scatter that nobody knows: as an F-test judges it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import chdtrc, fdtrc

from pipeline.estimation.gauss_markov import Setting, selection_grid
from pipeline.estimation.multi_position.fit import judged_curves, project_out
from pipeline.estimation.multi_position.model import Equations, NoiseHypothesis

WHITE = [NoiseHypothesis(Setting(0.0, 1.0), (0.0,))]


def equations_of(residual: np.ndarray, base: np.ndarray, candidate: np.ndarray) -> Equations:
    n = len(residual)
    start = np.arange(n, dtype=float)
    return Equations(
        residual, base, [], [candidate], np.ones((1, n)), np.zeros((3, n, n)), start, np.ones(n), np.eye(n) > 0, start
    )


@pytest.mark.parametrize(("rests", "added"), [(27, 3), (27, 9), (40, 3), (16, 3)])
def test_p_is_that_of_the_f_test_where_only_the_rests_tell_their_scatter(rests: int, added: int) -> None:
    rng = np.random.default_rng(rests + added)
    for size in (0.0, 8.0, 16.0):
        base, candidate = rng.standard_normal((rests, 9)), rng.standard_normal((rests, added))
        r = 30.0 * rng.standard_normal(rests) + size * candidate.sum(axis=1)
        found = project_out(equations_of(r, base, candidate), WHITE)
        gain = (
            2.0
            * (found.with_candidate(0).max() - found.of_model()[0])
            * found.correction(0, 0, added, np.ones((1, rests)))
        )
        before = r - base @ np.linalg.lstsq(base, r)[0]
        both = np.column_stack([base, candidate])
        after = r - both @ np.linalg.lstsq(both, r)[0]
        spare = rests - 9 - added
        F = (before @ before - after @ after) / added / (after @ after / spare)
        exact = fdtrc(added, spare, F)
        assert np.log(chdtrc(added, gain)) == pytest.approx(np.log(exact), rel=0.15, abs=0.15)


def test_a_candidate_that_leaves_no_equation_to_judge_it_by_counts_nothing() -> None:
    rng = np.random.default_rng(3)
    found = project_out(
        equations_of(rng.standard_normal(12), rng.standard_normal((12, 9)), rng.standard_normal((12, 2))), WHITE
    )
    assert found.correction(0, 0, 2, np.ones((1, 12))) == 0.0


def test_a_candidate_that_the_base_holds_shows_nothing() -> None:
    rng = np.random.default_rng(4)
    base = rng.standard_normal((30, 9))
    found = project_out(equations_of(rng.standard_normal(30), base, base[:, :2] @ rng.standard_normal((2, 3))), WHITE)
    assert found.count(0, 0) == 0


def p_of_curves(swing: float, draws: int) -> np.ndarray:
    """Return p of a cubic of time over 40 rests whose wander, twice their noise, lies between those of the grid.

    ``swing``: amplitude over the wander.
    """
    rng, m = np.random.default_rng(9), 40
    time = 6.0 * np.arange(m)
    u = time / time[-1]
    shapes = np.stack([u, u**2, u**3], axis=1)
    wander = 2.0 * np.linalg.cholesky(np.exp(-np.abs(time[:, None] - time) / 100.0))
    hypotheses = [NoiseHypothesis(setting, (0.0,)) for setting in selection_grid(None, (0.3, 1.0, 3.0, 10.0))]
    found = []
    for _ in range(draws):
        r = wander @ rng.standard_normal(m) + rng.standard_normal(m) + 2.0 * swing * np.sin(2.0 * np.pi * u)
        one = equations_of(r, np.ones((m, 1)), shapes)
        bias = np.concatenate([np.eye(m)[None], np.zeros((2, m, m))])
        times = {"start": time, "length": np.full(m, 4.0), "joined": np.ones((m, m), bool)}
        found.append(judged_curves(replace(one, bias=bias, **times), hypotheses)[0][1])
    return np.array(found)


def test_curves_of_time_are_rare_beside_a_wander() -> None:
    p = p_of_curves(0.0, 200)
    assert np.mean(p < 0.01) < 0.05  # 0.34 where each likelihood has its own most likely wander
    assert p.min() > 2e-4


def test_a_swing_of_many_wanders_is_no_wander() -> None:
    assert p_of_curves(12.0, 10).max() < 1e-4
