from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from pipeline.core.errors import NotObservableError
from pipeline.estimation.engine import ScaledColumns, cholesky
from tests.estimation.complex_step import jacobian_of, solve_linear, solve_nonlinear

if TYPE_CHECKING:
    from numpy.typing import NDArray


def test_a_straight_line_has_its_textbook_uncertainty() -> None:
    x = np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
    y = np.array([1.0, 3.0, 2.0, 5.0, 4.0])
    fit = solve_linear(np.column_stack([np.ones(5), x]), y)
    # By hand: mean 3, slope 8/10; residual sum of squares 10 - 6.4 = 3.6, s^2 = 1.2.
    assert fit.x == pytest.approx([3.0, 0.8], abs=1e-14)
    assert fit.covariance == pytest.approx(np.diag([1.2 / 5, 1.2 / 10]), abs=1e-14)
    assert (fit.degrees_of_freedom, fit.converged) == (3, True)


def test_columns_of_very_different_size_are_no_rank_deficiency() -> None:
    rng = np.random.default_rng(1)
    A = rng.normal(size=(50, 3)) * np.array([1e-12, 1.0, 1e12])
    truth = np.array([3e12, -2.0, 5e-12])
    assert solve_linear(A, A @ truth).x == pytest.approx(truth, rel=1e-10)


def test_hilbert_columns_keep_the_digits_that_normal_equations_lose() -> None:
    n = 8
    H = 1.0 / (np.arange(n)[:, None] + np.arange(n)[None, :] + 1.0)
    x = solve_linear(H, H.sum(axis=1)).x
    assert np.max(np.abs(x - 1.0)) < 1e-5  # condition 1.5e10; its square is beyond double precision


def test_parameters_that_the_data_do_not_determine_are_named() -> None:
    A = np.random.default_rng(2).normal(size=(20, 4))
    A[:, 3] = 2.0 * A[:, 1]
    with pytest.raises(NotObservableError, match=r"3 of 4 parameters.*: bias_y, scale_y\."):
        ScaledColumns.of(A).require_full_rank(["bias_x", "bias_y", "scale_x", "scale_y"])


def test_a_column_of_zeros_is_named() -> None:
    A = np.array([[1.0, 0.0], [2.0, 0.0], [3.0, 0.0]])
    with pytest.raises(NotObservableError, match="each other: lag"):
        ScaledColumns.of(A).require_full_rank(["bias", "lag"])


def test_fewer_equations_than_parameters_are_refused() -> None:
    with pytest.raises(NotObservableError, match="2 of 3 parameters"):
        ScaledColumns.of(np.ones((2, 3)) + np.eye(3)[:2]).require_full_rank(["a", "b", "c"])


def _circle(x: NDArray[np.float64]) -> NDArray[np.float64]:
    angle = np.linspace(0.0, 2.0, 30)
    points = np.stack([3.0 + 2.0 * np.cos(angle), -1.0 + 2.0 * np.sin(angle)])
    return np.sqrt((points[0] - x[0]) ** 2 + (points[1] - x[1]) ** 2) - x[2]


def test_a_circle_is_found_from_far_off_and_from_near() -> None:
    far = solve_nonlinear(_circle, np.array([0.5, 1.0, 0.1]), jacobian_of(_circle))
    near = solve_nonlinear(_circle, np.array([2.5, -0.8, 1.7]), jacobian_of(_circle))
    assert far.x == pytest.approx([3.0, -1.0, 2.0], abs=1e-12)
    assert near.x == pytest.approx([3.0, -1.0, 2.0], abs=1e-12)
    assert far.converged
    assert near.converged


def test_uncertainty_covers_the_truth_in_its_share_of_repeats() -> None:
    rng = np.random.default_rng(3)
    t = np.linspace(0.0, 4.0, 60)
    truth = np.array([2.0, 0.7])
    inside = 0
    for _ in range(400):
        y = truth[0] * np.exp(-truth[1] * t) + 0.02 * rng.normal(size=60)

        def left(b: NDArray[np.float64], y: NDArray[np.float64] = y) -> NDArray[np.float64]:
            return np.asarray(b[0] * np.exp(-b[1] * t) - y)

        fit = solve_nonlinear(left, np.array([1.8, 0.6]), jacobian_of(left))
        inside += int(np.abs(fit.x[1] - truth[1]) < fit.standard_uncertainty[1])
    assert 0.683 - 0.07 < inside / 400 < 0.683 + 0.07  # three standard deviations of the count


def test_a_search_cut_short_is_not_called_converged() -> None:
    def valley(x: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.array([x[0] - 5.0, 1e3 * (x[1] - x[0] ** 2), 1.0])

    fit = solve_nonlinear(valley, np.array([1.0, 0.0]), jacobian_of(valley), steps=1)
    assert not fit.converged
    assert fit.cosine > 1e-3


def test_the_weights_are_the_pseudo_inverse_and_solve_all_channels() -> None:
    rng = np.random.default_rng(4)
    A, y = rng.normal(size=(12, 3)), rng.normal(size=(12, 2))
    factors = ScaledColumns.of(A)
    assert factors.weights() == pytest.approx(np.linalg.pinv(A), rel=1e-10)
    assert factors.solve(y) == pytest.approx(factors.weights() @ y, rel=1e-10)


def test_a_covariance_has_a_factor_whatever_the_size_of_its_common_error() -> None:
    for size in (1.0, 3e9):
        C = np.stack([np.eye(30) + size**2, 4.0 * np.eye(30) + size**2])
        L = cholesky(C)
        assert np.abs(L @ L.swapaxes(1, 2) / C - 1.0).max() < (1e-12 if size == 1.0 else 1e-8)
