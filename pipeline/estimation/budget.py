"""The uncertainty budget of a fit: its contributions, combined by the law of propagation (JCGM 100:2008, 5 and 8).

    U = sum over sources of U_s,    nu_eff by Welch and Satterthwaite,    expanded uncertainty = k(nu_eff) u

The noise of the readings is of type A: white noise and bias wander as the residuals show them
(``pipeline.estimation.residual_noise``), so that a lack of fit is in it, as slow errors are. Its parts are told apart:

    white noise : as scattered within short stretches
    bias wander : as large as the static recording or the data sheet lets expect
    lack of fit : what the residuals hold beyond both

Everything else is of type B and has infinite degrees of freedom. What nobody has stated is named and left out.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.estimation.averaged_covariance import averaged
from pipeline.estimation.propagation import effective_degrees_of_freedom
from pipeline.records import NORMAL, RECTANGULAR, Contribution, coverage_factor, finite

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from pipeline.estimation.gauss_markov import Prior
    from pipeline.estimation.linear_map import LinearMap
    from pipeline.estimation.residual_noise import ResidualNoise
    from pipeline.records import SensorCalibration

    Values = NDArray[np.float64]

ROUNDING = 1e-10  # of the largest effect of an input
DITHERED = 0.5  # counts of white noise above which rounding is a part of it
NOISE, QUANTISATION = "noise of the readings", "quantisation"
REPEATABILITY = "one calibration does not tell it: calibrate the unit again after switching it off, and compare"


def type_b(  # noqa: PLR0917  (the columns of a budget's line)
    source: str, distribution: str, u: float, unit: str, effect: Values, remark: str = ""
) -> Contribution:
    """Return the contribution of independent inputs of one standard uncertainty.

    Parameters
    ----------
    source, distribution : str
    u : float
        Standard uncertainty of each input.
    unit : str
    effect : (p, m) array
        What a unit of each input does to the parameters.
    remark : str
    """
    effect = np.where(np.abs(effect) > ROUNDING * np.abs(effect).max(initial=0.0), effect, 0.0)
    covariance = u**2 * effect @ effect.T
    freedom = np.full(len(effect), np.inf)
    return Contribution(source, "B", distribution, covariance, freedom, u, unit, effect.shape[1], remark=remark)


def noise_contribution(noise: ResidualNoise, fit: LinearMap, prior: Prior) -> Contribution:
    """Return what white noise, bias wander and lack of fit contribute.

    Parameters
    ----------
    noise : ResidualNoise
        As the residuals tell it.
    fit : LinearMap
    prior : Prior
        The bias wander that was expected.
    """
    unit: dict[int, tuple[Values, Values]] = {}
    white, wander = np.zeros(fit.parameters), np.zeros(fit.parameters)
    for A, J, s in zip(fit.weights, fit.derivative, noise.white, strict=True):
        if id(A) not in unit:
            a = noise.blocks.sums(A.T)
            unit[id(A)] = A @ A.T, a.T @ noise.blocks.covariance(prior.time) @ a
        alone, slow = unit[id(A)]
        white += s**2 * np.einsum("pi,ij,pj->p", J, alone, J)
        wander += prior.wander**2 * np.einsum("pi,ij,pj->p", J, slow, J)
    covariance, freedom = averaged(noise.weight, candidate_covariances(noise, fit), noise.spare)
    return Contribution(
        NOISE, "A", "Student's t", covariance, freedom, parts=_parts(np.diag(covariance), white, wander)
    )


def candidate_covariances(noise: ResidualNoise, fit: LinearMap) -> Values:
    """Return the covariance of a fit's results under each candidate of the noise: (k, p, p) array."""
    unit: dict[int, Values] = {}
    total = np.zeros((len(noise.weight), fit.parameters, fit.parameters))
    for A, J, own in zip(fit.weights, fit.derivative, noise.white_variance.T, strict=True):
        if id(A) not in unit:
            unit[id(A)] = noise.covariances(A)
        total += own[:, None, None] * (J @ unit[id(A)] @ J.T)
    return total


def _parts(total: Values, white: Values, wander: Values) -> dict[str, Values]:
    """Return the standard uncertainties of white noise, expected wander and lack of fit; their squares sum up."""
    white = np.minimum(white, total)
    wander = np.minimum(wander, total - white)
    return {
        "white noise": np.sqrt(white),
        "bias wander": np.sqrt(wander),
        "lack of fit": np.sqrt(np.clip(total - white - wander, 0.0, None)),
    }


def quantisation(noise: ResidualNoise, fit: LinearMap, counts_per_unit: float | None, unit: str) -> Contribution | str:
    """Return what rounding to whole counts contributes, or why it is no line of its own.

    White noise of half a count and more makes the rounding errors of the samples independent of each other, of variance
    1/12 count^2, and so a part of the noise that the residuals show (Widrow & Kollar, Quantization Noise, 2008).
    With less, neighbouring samples are rounded alike: then each block of samples has one error.

    Parameters
    ----------
    noise : ResidualNoise
    fit : LinearMap
    counts_per_unit : float or None
    unit : str
        Of the readings.
    """
    if not counts_per_unit:
        return "the sensor's counts_per_unit is not configured"
    step = 1.0 / float(counts_per_unit)
    if np.all(noise.white >= DITHERED * step):
        return f"contained in the {NOISE}, which reach {float(noise.white.min()) / step:.1f} counts or more"
    label = noise.blocks.label(int(noise.blocks.weight.sum()))
    ones = np.ones((len(label), 3))
    rough = np.where(noise.white < DITHERED * step, 1.0, 0.0)
    effects = [fit.of_groups(ones * rough * axis, label, len(noise.blocks.weight)) for axis in np.eye(3)]
    return type_b(QUANTISATION, RECTANGULAR, step / np.sqrt(12.0), unit, np.concatenate(effects, axis=1))


def scatter_contribution(
    covariance: Values, degrees_of_freedom: float, parts: Mapping[str, Values] | None = None, remark: str = ""
) -> Contribution:
    """Return the contribution of the readings' scatter where a fit gives its covariance at once."""
    freedom = np.full(len(covariance), float(degrees_of_freedom))
    return Contribution(NOISE, "A", "Student's t", covariance, freedom, parts=dict(parts or {}), remark=remark)


def gravity_contribution(sensor: str, matrix: Values, table: Mapping[str, Any], parameters: int) -> Contribution | None:
    """Return what the uncertainty of local gravity does to a matrix that is scaled by it, or None where none is stated.

    ``dM = M dG / G``: all else stays as it is.
    """
    u = table.get("gravity_accuracy_g")
    if sensor != "accelerometer" or not u:
        return None
    effect = np.zeros((parameters, 1))
    effect[3:12, 0] = matrix.ravel() / float(table.get("gravity_g") or 1.0)
    return type_b("local gravity", NORMAL, float(u), "g", effect)


def combined(
    calibration: SensorCalibration, contributions: Sequence[Contribution], not_included: Mapping[str, str]
) -> SensorCalibration:
    """Return a calibration with the covariance and the degrees of freedom of all contributions together.

    Parameters
    ----------
    calibration : SensorCalibration
        Its effects' expanded uncertainties are set anew.
    contributions : sequence of Contribution
        Of all of its parameters.
    not_included : mapping of str to str
        Source to the reason why it is not among them.
    """
    covariance = np.sum([c.covariance for c in contributions], axis=0)
    freedom = effective_degrees_of_freedom(
        np.array([c.standard_uncertainty for c in contributions]),
        np.array([c.degrees_of_freedom for c in contributions]),
    )
    head = {
        "parameters": calibration.parameter_names(),
        "units": _units(calibration),
        "contributions": [c.to_json() for c in contributions],
    }
    reasons = {**not_included, "repeatability": REPEATABILITY}
    left = [{"source": source, "reason": reason} for source, reason in reasons.items()]
    return with_uncertainty(calibration, covariance, freedom, head, left)


def with_uncertainty(
    calibration: SensorCalibration,
    covariance: Values,
    freedom: Values,
    budget: Mapping[str, Any],
    not_included: Sequence[Mapping[str, str]],
) -> SensorCalibration:
    """Return a calibration with a covariance, and all that follows from it: of its effects and its budget, too.

    Parameters
    ----------
    calibration : SensorCalibration
    covariance : (p, p) array
    freedom : (p,) array
        Effective degrees of freedom of each parameter.
    budget : mapping
        What else the budget's document holds.
    not_included : sequence of mapping
        ``source`` and ``reason``.
    """
    u = np.sqrt(np.clip(np.diag(covariance), 0.0, None))
    factors = coverage_factor(freedom)
    known = freedom[u > 0.0]
    document = {
        **budget,
        "standard_uncertainty": u.tolist(),
        "effective_degrees_of_freedom": finite(freedom),
        "coverage_factor": factors.tolist(),
        "expanded_uncertainty": (factors * u).tolist(),
        "not_included": list(not_included),
    }
    effects, at = [], 12
    for effect in calibration.effects:
        renewed = {}
        for name, parameter in effect.parameters.items():
            renewed[name] = {**parameter, "expanded_uncertainty": float(factors[at] * u[at])}
            at += 1
        effects.append(replace(effect, parameters=renewed))
    return replace(
        calibration,
        effects=tuple(effects),
        covariance=covariance,
        degrees_of_freedom=float(known.min()) if len(known) else float("inf"),
        freedom=freedom,
        budget=document,
    )


def _units(calibration: SensorCalibration) -> list[str]:
    unit = "g" if calibration.sensor == "accelerometer" else "deg/s"
    own = [str(p.get("unit", "")) for effect in calibration.effects for p in effect.parameters.values()]
    return [unit] * 3 + ["1"] * 9 + own
