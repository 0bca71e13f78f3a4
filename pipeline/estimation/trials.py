"""An uncertainty budget beside a Monte Carlo run over the same inputs (JCGM 101:2008), for one calibration.

    parameters_r = f(z + e_r),    e_r = e_noise + sum over sources of type B e_s,    r = 1 .. M

where

    z       : what a fit first makes of the readings by a linear map (a sinusoid's coefficients, a response to the rate,
              the lengths of gravity at the rests, the moves' directions), so that nothing is lost by drawing it
    f       : all that follows, without linearising
    e_noise : normal under each candidate of the noise (white, bias wander, scatter of rests), the candidates drawn by
              their likelihood: not the Student's t that the budget takes for that mixture
    e_s     : normal; rounding errors are many, so that their sum is

Both intervals are compared at one significant digit of u below a million trials, at two from there on: the ends of a
Monte Carlo interval scatter by 2.7 u / sqrt(M).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.estimation.monte_carlo import compare, distribution_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from pipeline.records import Contribution, SensorCalibration

    Values = NDArray[np.float64]

SEED = 101
BATCH = 500
TWO_DIGITS = 1_000_000  # trials
KEY = "monte_carlo"
NEWTONS = 4


@dataclass(frozen=True)
class Errors:
    """The distribution of the errors e.

    Attributes
    ----------
    weight : (k,) array
        Of the candidates; they sum to 1.
    candidates : (k, q, q) array
        Covariance of the noise under each.
    spare : float
        Degrees of freedom of the scale that they share.
    stated : sequence of Contribution
        Sources of type B, as covariances of z.
    """

    weight: Values
    candidates: Values
    spare: float
    stated: Sequence[Contribution] = ()

    def draw(self, rng: np.random.Generator, count: int) -> Values:
        """Return (count, q) errors."""
        size = self.candidates.shape[1]
        chosen = rng.choice(len(self.weight), count, p=self.weight)
        out = np.empty((count, size))
        for k in np.unique(chosen):
            out[chosen == k] = normal(rng, self.candidates[k], int(np.count_nonzero(chosen == k)))
        if np.isfinite(self.spare):
            out *= np.sqrt(self.spare / rng.chisquare(self.spare, count))[:, None]
        for source in self.stated:
            out += normal(rng, source.covariance, count)
        return out

    def through(self, results: Callable[[Values], Values]) -> Callable[[np.random.Generator, int], Values]:
        """Return how parameters are drawn, where ``results`` makes (t, p) of them of (t, q) errors."""
        return lambda rng, count: results(self.draw(rng, count))


def trials_of(settings: Mapping[str, Any]) -> int:
    """Return how many trials ``uncertainty.monte_carlo`` asks for; 0: none."""
    return int((settings.get("uncertainty") or {}).get(KEY) or 0)


def beside_trials(
    calibration: SensorCalibration,
    draw: Callable[[np.random.Generator, int], Values],
    trials: int,
    direct: Sequence[Contribution] = (),
) -> SensorCalibration:
    """Return a calibration whose budget also holds the Monte Carlo run, and how it compares.

    Parameters
    ----------
    calibration : SensorCalibration
        With its budget.
    draw : callable
        Generator and t to (t, p) parameters.
    trials : int
        M.
    direct : sequence of Contribution
        Sources of type B that act on the parameters themselves.
    """
    rng, drawn = np.random.default_rng(SEED), []
    for start in range(0, trials, BATCH):
        values = draw(rng, min(BATCH, trials - start))
        for source in direct:
            values = values + normal(rng, source.covariance, len(values))
        drawn.append(values)
    budget = dict(calibration.budget or {})
    budget[KEY] = _compared(calibration, np.concatenate(drawn))
    return replace(calibration, budget=budget)


def without_trials(calibration: SensorCalibration, reason: str) -> SensorCalibration:
    """Return a calibration whose budget says why it holds no Monte Carlo run."""
    return replace(calibration, budget={**(calibration.budget or {}), KEY: {"trials": 0, "reason": reason}})


def _compared(calibration: SensorCalibration, drawn: Values) -> dict[str, Any]:
    effects = [value for effect in calibration.effects for value in effect.values]
    estimate = np.concatenate([calibration.bias, calibration.matrix.ravel(), effects])
    expanded = np.array((calibration.budget or {})["expanded_uncertainty"])
    digits = 2 if len(drawn) >= TWO_DIGITS else 1
    found = distribution_of(drawn)
    against = compare(estimate, expanded, found, digits=digits)
    known = expanded > 0.0
    validated = against.borne_out | ~known
    return {
        "trials": len(drawn),
        "reason": None,
        "seed": SEED,
        "digits": digits,
        "estimate": estimate.tolist(),
        "expanded_uncertainty": expanded.tolist(),
        "mean": found.estimate.tolist(),
        "standard_uncertainty": found.standard_uncertainty.tolist(),
        "low": found.symmetric[:, 0].tolist(),
        "high": found.symmetric[:, 1].tolist(),
        "tolerance": np.where(known, against.tolerance, 0.0).tolist(),
        "d_low": against.low.tolist(),
        "d_high": against.high.tolist(),
        "validated": validated.tolist(),
        "all_validated": bool(validated.all()),
    }


def quadratic_results(columns: Values, curvature: Values, inverse: Values) -> Callable[[Values], Values]:
    """Return the step of a least-squares fit by errors of its equations, to second order of the model.

        g(d) = (X + H d)^T W (X d + d^T H d / 2 - e) = 0

    Parameters
    ----------
    columns : (n, p) array
        X.
    curvature : (n, p, p) array
        H, symmetric in its last two.
    inverse : (n, n) array
        W, the weights of the fit.

    Returns
    -------
    callable
        (t, n) errors e to (t, p) steps d, by Gauss-Newton.
    """
    size = np.sqrt(np.einsum("np,nm,mp->p", columns, inverse, columns))
    size = np.where(size > 0.0, size, 1.0)
    back = np.linalg.pinv(columns.T @ inverse @ columns / np.outer(size, size), rcond=1e-13, hermitian=True)
    back = back / np.outer(size, size)
    gain = back @ columns.T @ inverse
    n, p = columns.shape
    flat = curvature.reshape(n * p, p)

    def step(e: Values) -> Values:
        d = e @ gain.T
        for _ in range(NEWTONS):
            bent = (d @ flat.T).reshape(len(d), n, p)
            left = (d @ columns.T + 0.5 * np.einsum("tnp,tp->tn", bent, d) - e) @ inverse
            gradient = left @ columns + np.einsum("tnp,tn->tp", bent, left)
            d = d - gradient @ back
        return np.asarray(d)

    return step


def normal(rng: np.random.Generator, covariance: Values, count: int) -> Values:
    """Return (count, q) normal errors, also of a singular covariance."""
    values, vectors = np.linalg.eigh(covariance)
    root: Values = vectors * np.sqrt(np.clip(values, 0.0, None))
    drawn: Values = rng.standard_normal((count, len(values))) @ root.T
    return drawn
