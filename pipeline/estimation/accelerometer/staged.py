"""The staged method of the accelerometer: what its stages have in common (Sudsanguan 2019, eqs 3.15-3.43).

The stages are followed one after the other (``pipeline.estimation.accelerometer.chain``), so the whole method is a
function of a few coefficients, those of the sinusoids fitted to the turns. The covariance of all that comes out follows
from theirs by the derivative of the whole chain (JCGM 100:2008, 5.2.2), taken by differences. As printed, the extremes
are single samples, order statistics of the noise: the covariance is then that of synthetic turns, the fitted sinusoids
with new noise of the size that the residuals have.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import ConfigurationError
from pipeline.estimation.accelerometer.chain import follow
from pipeline.estimation.accelerometer.extremes import (
    Extremes,
    extremes_of_samples,
    extremes_of_sinusoids,
    sinusoids_of,
    turns_of,
)
from pipeline.estimation.correction import apply_correction
from pipeline.estimation.engine import LinearMap, assess_noise
from pipeline.estimation.gauss_markov import blocks_of_samples
from pipeline.estimation.least_squares import ScaledColumns, certificate, certified
from pipeline.estimation.noise import prior_of
from pipeline.estimation.table_errors import Reference, disturbance
from pipeline.estimation.turns import parts_of
from pipeline.estimation.uncertainty_budget import budgeted, combined, noise_contribution, scatter_contribution
from pipeline.model.effects import effect
from pipeline.records import FittedEffect, SensorCalibration, StageResult

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from pipeline.estimation.accelerometer.chain import Chain
    from pipeline.estimation.accelerometer.extremes import Turn
    from pipeline.estimation.engine import ResidualNoise
    from pipeline.estimation.gauss_markov import Prior
    from pipeline.estimation.turns import Sinusoid
    from pipeline.records import Contribution, Recording

STAGES = ("orthogonality", "misalignment", "bias", "scale_factor")
REPLICATES = 60
SEED = 20190508
AS_PRINTED = "the printed variant takes single samples, through which no error of the table can be followed"
STEP = 1e-7  # g, of the differences: truncation and rounding are then both about 1e-8 of the derivative


def fit_stage(
    name: str, recordings: Sequence[Recording], previous: SensorCalibration | None, settings: Mapping[str, Any]
) -> SensorCalibration:
    """Run one stage of the staged method.

    Parameters
    ----------
    name : str
        The stage.
    recordings : sequence of Recording
        Those of role ``accelerometer`` are used.
    previous : SensorCalibration or None
        The result of the stage before.
    settings : mapping
        Sections ``table``, ``method`` and ``sensor``.

    Returns
    -------
    SensorCalibration
    """
    names = [*_stages_before(previous), name]
    as_printed = bool(settings["method"].get("as_printed", False))
    gravity_g = float(settings["table"].get("gravity_g", 1.0))
    parts = parts_of(recordings, "accelerometer", settings["table"], "the staged method")
    turns = turns_of(parts, as_printed=as_printed)
    sinusoids = sinusoids_of(turns)
    prior = prior_of("accelerometer", recordings, settings)

    def run(extremes: Extremes) -> Chain:
        return follow(extremes, names, gravity_g, as_printed=as_printed)

    chain = run(extremes_of_samples(turns) if as_printed else extremes_of_sinusoids(_coefficients(sinusoids)))
    fit = _linear_map(sinusoids, run)
    noise = _noise(turns, fit, prior, settings["table"])
    scatter = _resampled(turns, sinusoids, noise, run) if as_printed else noise_contribution(noise, fit, prior)
    after = apply_correction({"steps": chain.steps}, np.concatenate([turn.reading for turn in turns]))
    result = StageResult(
        name=name,
        parameters=_parameters(chain, scatter.covariance),
        residual_rms=float(np.sqrt(np.mean((np.linalg.norm(after, axis=1) - gravity_g) ** 2))),
        correction={"steps": chain.steps},
        details=_details(turns, noise, float(scatter.degrees_of_freedom.min())),
    )
    last = name == "scale_factor"
    found = SensorCalibration(
        sensor="accelerometer",
        bias=chain.bias,
        matrix=np.diag(1.0 / chain.k),
        stages=(*(previous.stages if previous else ()), result),
        effects=(_asymmetry(chain),) if last else (),
        convergence=_certificate(sinusoids),
    )
    kept = slice(0, 15 if last else 12)
    if as_printed:
        return combined(found, [scatter.of(kept)], {"everything but noise": AS_PRINTED})
    motions = [motion for turn in turns for motion in turn.motions]
    reference = Reference("accelerometer", motions, fit.results(kept), np.diag(chain.k), settings["table"])

    def results(errors: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.array([run(extremes_of_sinusoids(_moved(sinusoids, e))).vector()[kept] for e in errors])

    return budgeted(found, reference, noise, [scatter.of(kept)], settings, results)


def _parameters(chain: Chain, covariance: NDArray[np.float64]) -> dict[str, dict[str, Any]]:
    own = np.sqrt(np.clip(np.diag(covariance)[15:], 0.0, None))
    return {
        name: {"value": value, "unit": unit, "standard_uncertainty": float(u)}
        for (name, (value, unit)), u in zip(chain.outcome.values.items(), own, strict=True)
    }


def _details(turns: Sequence[Turn], noise: ResidualNoise, freedom: float) -> dict[str, Any]:
    used = sum(len(turn.angle) for turn in turns)
    total = sum(recording.samples for turn in turns for recording, _ in turn.used)
    return {
        "samples_used": used,
        "samples_left_out": total - used,
        "white_noise": noise.white.tolist(),
        "bias_wander": noise.wander.tolist(),
        "degrees_of_freedom": freedom,
    }


def _asymmetry(chain: Chain) -> FittedEffect:
    asymmetry = effect("scale_factor_asymmetry")
    return FittedEffect(
        asymmetry.name,
        {
            parameter.name: {"value": float(value), "unit": parameter.unit}
            for parameter, value in zip(asymmetry.parameters("accelerometer"), chain.c, strict=True)
        },
    )


def _certificate(sinusoids: Sequence[Sequence[Sinusoid]]) -> dict[str, Any]:
    """Return the certificate of the worst of the sinusoids' fits."""
    every = [s for turn in sinusoids for s in turn]
    parts = [certificate(s.columns, s.residuals, s.condition, s.columns.shape[1]) for s in every]
    worst = {key: max(part[key] for part in parts) for key in ("cosine", "condition")}
    count = sum(part["parameters"] for part in parts)
    return certified(worst["cosine"], worst["condition"], count, count)


def _stages_before(previous: SensorCalibration | None) -> list[str]:
    names = [] if previous is None else [stage.name for stage in previous.stages]
    unknown = [name for name in names if name not in STAGES]
    if unknown:
        raise ConfigurationError(
            f"a stage of the staged method cannot follow {unknown[0]!r}, which leaves no corrected readings for it; "
            f"the stages of the accelerometer are {', '.join(STAGES)}"
        )
    return names


def _coefficients(sinusoids: Sequence[Sequence[Sinusoid]]) -> list[list[NDArray[np.float64]]]:
    return [[sinusoid.coefficients for sinusoid in turn] for turn in sinusoids]


def _moved(sinusoids: Sequence[Sequence[Sinusoid]], errors: NDArray[np.float64]) -> list[list[NDArray[np.float64]]]:
    """Return the coefficients with errors, which come channel by channel and in these turn by turn."""
    moved, at = [[s.coefficients.copy() for s in turn] for turn in sinusoids], 0
    for channel in range(3):
        for turn in moved:
            size = len(turn[channel])
            turn[channel] += errors[at : at + size]
            at += size
    return moved


def _noise(turns: Sequence[Turn], fit: LinearMap, prior: Prior, table: Mapping[str, Any]) -> ResidualNoise:
    """Return what all turns together say of the noise: the residuals of ``y = b + K u + C |u|``.

    A sinusoid of its own for each turn and channel would take up the wander from turn to turn.
    """
    motions = [motion for turn in turns for motion in turn.motions]
    u = np.concatenate([motion.specific_force for motion in motions])
    reading = np.concatenate([turn.reading for turn in turns])
    X = np.column_stack([np.ones(len(u)), u, np.abs(u)])
    blocks = blocks_of_samples([used for turn in turns for used in turn.used])
    beta = ScaledColumns.of(X).solve(reading)
    residuals = reading - X @ beta
    disturbed = disturbance(Reference("accelerometer", motions, fit, beta[1:4].T, table), residuals, blocks)
    return assess_noise(residuals, X, blocks, prior, disturbed)


def _side_by_side(matrices: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return a block-diagonal matrix."""
    rows, columns = np.sum([m.shape for m in matrices], axis=0)
    out = np.zeros((rows, columns))
    i = j = 0
    for m in matrices:
        out[i : i + m.shape[0], j : j + m.shape[1]] = m
        i, j = i + m.shape[0], j + m.shape[1]
    return out


def _linear_map(sinusoids: Sequence[Sequence[Sinusoid]], run: Callable[[Extremes], Chain]) -> LinearMap:
    """Return the map from readings to ``Chain.vector``, by the derivative of the chain."""
    coefficients = _coefficients(sinusoids)
    here = run(extremes_of_sinusoids(coefficients)).vector()
    weights, derivatives = [], []
    for channel in range(3):
        columns = []
        for turn in range(3):
            for j in range(len(coefficients[turn][channel])):
                moved = [[c.copy() for c in channels] for channels in coefficients]
                moved[turn][channel][j] += STEP
                columns.append((run(extremes_of_sinusoids(moved)).vector() - here) / STEP)
        derivatives.append(np.column_stack(columns))
        weights.append(_side_by_side([turn[channel].weights for turn in sinusoids]))
    return LinearMap((weights[0], weights[1], weights[2]), (derivatives[0], derivatives[1], derivatives[2]))


def _resampled(
    turns: Sequence[Turn],
    sinusoids: Sequence[Sequence[Sinusoid]],
    noise: ResidualNoise,
    run: Callable[[Extremes], Chain],
) -> Contribution:
    """Return the scatter of ``Chain.vector`` over synthetic turns."""
    rng = np.random.default_rng(SEED)
    means = [
        turn.reading - np.column_stack([s.residuals for s in fits]) for turn, fits in zip(turns, sinusoids, strict=True)
    ]
    cuts = np.cumsum([len(turn.angle) for turn in turns])[:-1]
    vectors = []
    for noisy in noise.draws(rng, REPLICATES):
        added = np.split(noisy, cuts)
        synthetic = [replace(turn, reading=mean + new) for turn, mean, new in zip(turns, means, added, strict=True)]
        vectors.append(run(extremes_of_samples(synthetic)).vector())
    return scatter_contribution(np.cov(np.array(vectors).T), REPLICATES - 1.0)
