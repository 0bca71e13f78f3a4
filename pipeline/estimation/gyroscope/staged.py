"""The staged method of the gyroscope: what its stages have in common (Sudsanguan 2019, eqs 3.44-3.53).

The readings are reduced to the means b at rest and the slopes R of steady turns
(``pipeline.estimation.gyroscope.response``). A stage is a module of this package with a function
``outcome(response, as_printed) -> Outcome`` and works on the response that the stages before it leave. The estimate is
a function of b and R, which are linear in the readings, so its covariance follows from theirs by the derivative of the
whole chain (JCGM 100:2008, 5.2.2).
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import ConfigurationError
from pipeline.estimation.correction import apply_correction
from pipeline.estimation.engine import LinearMap, assess_noise
from pipeline.estimation.gyroscope.response import Response, samples_of, weights_of
from pipeline.estimation.least_squares import certified
from pipeline.estimation.noise import prior_of
from pipeline.estimation.table_errors import Reference, disturbance
from pipeline.estimation.turns import parts_of
from pipeline.estimation.uncertainty_budget import budgeted, noise_contribution
from pipeline.records import SensorCalibration, StageResult

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from pipeline.records import Recording

STAGES = ("bias", "orthogonality_and_misalignment", "scale_factor")
STEP = 1e-5  # deg/s of b, and of R, of the central differences


@dataclass(frozen=True)
class Outcome:
    """What one stage found: its step of the correction, and value and unit of each of its parameters."""

    step: dict[str, Any]
    values: dict[str, tuple[float, str]]


@dataclass(frozen=True)
class Chain:
    """The stages up to one of them, followed: the correction so far, and what the last stage found."""

    steps: list[dict[str, Any]]
    outcome: Outcome

    def contract(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return bias and matrix of ``matrix @ (reading - bias)``, which all steps together are."""
        offset: NDArray[np.float64] = np.zeros(3)
        matrix: NDArray[np.float64] = np.eye(3)
        for step in self.steps:
            if "subtract" in step:
                offset = offset + np.asarray(step["subtract"])
            else:
                offset, matrix = np.asarray(step["matrix"]) @ offset, np.asarray(step["matrix"]) @ matrix
        return np.asarray(np.linalg.solve(matrix, offset), float), matrix

    def vector(self) -> NDArray[np.float64]:
        """Return bias, matrix and the last stage's parameters in one vector."""
        bias, matrix = self.contract()
        return np.concatenate([bias, matrix.ravel(), [value for value, _ in self.outcome.values.values()]])


def fit_stage(
    name: str, recordings: Sequence[Recording], previous: SensorCalibration | None, settings: Mapping[str, Any]
) -> SensorCalibration:
    """Run one stage of the staged method.

    Parameters
    ----------
    name : str
        The stage.
    recordings : sequence of Recording
        Those of role ``gyroscope`` are used, and for want of a rest in them those of role ``static``.
    previous : SensorCalibration or None
        The result of the stage before.
    settings : mapping
        Sections ``table``, ``method`` and ``sensor``.

    Returns
    -------
    SensorCalibration

    Raises
    ------
    CannotCalibrateError
        If no recording of the gyroscope logs the table's motion.
    NotObservableError
        If there is no rest, or no steady turn about an axis that the stage needs.
    """
    names = [*_stages_before(previous), name]
    as_printed = bool(settings["method"].get("as_printed", False))
    samples = samples_of(parts_of(recordings, "gyroscope", settings["table"], "the staged method"), recordings)
    weights = weights_of(samples.rate, as_printed=as_printed)
    theta = weights @ samples.reading
    prior = prior_of("gyroscope", recordings, settings)
    design = np.column_stack([np.ones(len(samples.rate)), samples.rate[:, samples.speed > 0]])
    residuals = samples.reading - theta[0] - samples.rate @ theta[1:]

    def run(values: NDArray[np.float64]) -> Chain:
        return follow(Response(values[0], values[1:], samples.speed), names, as_printed=as_printed)

    chain = run(theta)
    fit = _linear_map(theta, weights, run)
    reference = Reference("gyroscope", samples.motions, fit, theta[1:].T, settings["table"])
    disturbed = disturbance(reference, residuals, samples.blocks)
    noise = assess_noise(residuals, design, samples.blocks, prior, disturbed)
    scatter = noise_contribution(noise, fit, prior)
    after = apply_correction({"steps": chain.steps}, samples.reading)
    error = np.linalg.norm(after, axis=1) - np.linalg.norm(samples.rate, axis=1)
    result = StageResult(
        name=name,
        parameters=_parameters(chain, scatter.covariance),
        residual_rms=float(np.sqrt(np.mean(error**2))),
        correction={"steps": chain.steps},
        details={
            "samples_used": len(samples.reading),
            "samples_left_out": samples.total - len(samples.reading),
            "white_noise": noise.white.tolist(),
            "bias_wander": noise.wander.tolist(),
            "degrees_of_freedom": float(scatter.degrees_of_freedom.min()),
        },
    )
    bias, matrix = chain.contract()
    size = np.linalg.norm(design, axis=0)
    condition = float(np.linalg.cond(np.linalg.qr(design / size, mode="r")))
    found = SensorCalibration(
        sensor="gyroscope",
        bias=bias,
        matrix=matrix,
        stages=(*(previous.stages if previous else ()), result),
        convergence=certified(0.0, condition, design.shape[1], design.shape[1]) | {"closed_form": True},
    )
    kept, K = slice(0, 12), np.asarray(np.linalg.solve(matrix, np.eye(3)))
    reference = Reference("gyroscope", samples.motions, fit.results(kept), K, settings["table"])

    def results(errors: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.array([run(theta + e.reshape(3, 4).T).vector()[kept] for e in errors])

    return budgeted(found, reference, noise, [scatter.of(kept)], settings, results)


def follow(response: Response, names: Sequence[str], *, as_printed: bool) -> Chain:
    """Run stages one after the other, each on the output of the one before.

    Parameters
    ----------
    response : Response
        Of the uncorrected readings.
    names : sequence of str
        Stages, in order; at least one.
    as_printed : bool
    """
    steps: list[dict[str, Any]] = []
    for name in names:
        outcome: Outcome = import_module(f"{__package__}.{name}").outcome(response, as_printed=as_printed)
        response = response.corrected(outcome.step)
        steps.append(outcome.step)
    return Chain(steps, outcome)


def _stages_before(previous: SensorCalibration | None) -> list[str]:
    names = [] if previous is None else [stage.name for stage in previous.stages]
    unknown = [name for name in names if name not in STAGES]
    if unknown:
        raise ConfigurationError(
            f"a stage of the staged method cannot follow {unknown[0]!r}, which leaves no corrected readings for it; "
            f"the stages of the gyroscope are {', '.join(STAGES)}"
        )
    return names


def _linear_map(
    theta: NDArray[np.float64], weights: NDArray[np.float64], run: Callable[[NDArray[np.float64]], Chain]
) -> LinearMap:
    """Return the map from readings to ``Chain.vector``, by the derivative of the chain."""
    derivatives = []
    for channel in range(3):
        columns = []
        for row in range(4):
            up, down = theta.copy(), theta.copy()
            up[row, channel] += STEP
            down[row, channel] -= STEP
            columns.append((run(up).vector() - run(down).vector()) / (2.0 * STEP))
        derivatives.append(np.column_stack(columns))
    return LinearMap((weights, weights, weights), (derivatives[0], derivatives[1], derivatives[2]))


def _parameters(chain: Chain, covariance: NDArray[np.float64]) -> dict[str, dict[str, Any]]:
    own = np.sqrt(np.clip(np.diag(covariance)[12:], 0.0, None))
    return {
        name: {"value": value, "unit": unit, "standard_uncertainty": float(u)}
        for (name, (value, unit)), u in zip(chain.outcome.values.items(), own, strict=True)
    }
