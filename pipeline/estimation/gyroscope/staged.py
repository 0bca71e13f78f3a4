"""Fit the gyroscope by the staged method, equation by equation (Sudsanguan 2019, eqs 3.44-3.53).

The readings are reduced to the means b at rest and the slopes R of steady turns. The input of each stage is the output
of the stage before:

    bias -> orthogonality_and_misalignment -> scale_factor

The estimate is a function of b and R, which are linear in the readings, so its covariance follows from theirs by the
derivative of all stages so far (JCGM 100:2008, 5.2.2). ``as_printed`` is the thesis's variant with its errata.

By the table's log, the samples of the recordings made for the gyroscope are at rest, in the steady part of a turn about
one axis, or neither. The first two give, for each channel c,

    b_c = mean of y_c at rest
    R_ic = sum rate (y_c - b_c) / sum rate^2   over the steady parts of the turns about axis i

where y is the reading, deg/s, and the rate is signed, so that turns at several rates and in both directions are one
regression. If the table's place and azimuth are set, Earth's rotation is first subtracted from y. Without a rest in
these recordings the bias is from the static recording. As printed, row i is the mean reading over the mean rate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from pipeline.core.errors import NotObservableError
from pipeline.core.records import (
    AFTER_BASE,
    AXES,
    BASE,
    Convergence,
    CorrectionStep,
    Mask,
    Multiply,
    Recording,
    SensorCalibration,
    StageResult,
    Subtract,
    Values,
    corrected,
    motion_at_rest,
)
from pipeline.core.settings import Settings
from pipeline.estimation.engine import LinearMap, ScaledColumns, derivative
from pipeline.estimation.stages import FitStage, StageInput, details_on_table
from pipeline.estimation.table_errors import Reference, noise_on_table
from pipeline.estimation.turns import TurnPart, blocks_of_samples, parts_of, steady_turns, used_motions
from pipeline.estimation.uncertainty_budget import budgeted, noise_contribution, stage_parameters
from pipeline.physics.signal.filters import filter_autocovariance
from pipeline.physics.signal.rests import runs

EstimatedStep = tuple[Subtract | Multiply, dict[str, tuple[float, str]]]

# deg/s of b, and of R, of the central differences: exact to 1e-10 for these functions of degree two
DIFFERENCE_STEP_DPS = 1e-5
FORGOTTEN_RATE_CHANGE = 1e-5  # share of a change of rate in a filter's output, below which the filter has settled
FIT_STAGES = {
    "bias": FitStage(sensors=("gyroscope",), accepts=("readings",), changes=("bias",)),
    "orthogonality_and_misalignment": FitStage(sensors=("gyroscope",), accepts=("readings",), changes=("matrix",)),
    "scale_factor": FitStage(sensors=("gyroscope",), accepts=("readings",), changes=("matrix",)),
}


def bias(response: Response) -> EstimatedStep:
    """Return the bias (3.47-3.48): ``g_bi = g_r - b``, b the mean of the readings at rest.

    The rests are those of the recordings made for the gyroscope, by the table's log, as in the thesis. The static
    recording may be far away in time and temperature: it is used only where these hold no rest.
    """
    values = {f"b_{axis}": (float(b), "deg/s") for axis, b in zip(AXES, response.rest, strict=True)}
    return Subtract(response.rest), values


def orthogonality_and_misalignment(response: Response) -> EstimatedStep:
    """Return the matrix of orthogonality and misalignment (3.49-3.51).

        S M = diag(I),   M = S^-1 diag(I),   g_mis = g_bi M

    where row i of S is the reading of (x, y, z), without bias, while the table turns about axis i at the rate I_i, and
    readings g are row vectors; the contract's ``matrix`` acts on columns and is M transposed. With turns at several
    rates and in both directions, S is I times the slopes of the readings against the signed rate, so ``M = R^-1``.
    Printed is ``M = diag(I) S^-1`` (3.50), which (3.49) and (3.51) contradict; it differs only where the rates do.
    """
    response.require_turns()
    rate = np.diag(response.rate)
    S = rate @ response.slope
    M = np.linalg.solve(S.T, rate).T if response.as_printed else np.linalg.solve(S, rate)
    values = {f"M_{i + 1}{j + 1}": (float(M[i, j]), "1") for i in range(3) for j in range(3)}
    return Multiply(np.array(M.T, np.float64, order="C")), values


def scale_factor(response: Response) -> EstimatedStep:
    """Return the scale factors (3.52-3.53): ``S_i = I_i / (g_max - g_min)``, ``g_sc = g_mis S``.

    g_max is the reading of axis i while the table turns about it at the rate I_i, and g_min its reading at rest. The
    matrix of the stage before carries the scale already, so S is 1.000, as in every printed table. Printed is
    ``I / g_max - g_min``, which differs only where g_min is not zero.
    """
    response.require_turns()
    g_min = response.rest
    g_max = g_min + response.rate * np.diag(response.slope)
    scale = response.rate / g_max - g_min if response.as_printed else response.rate / (g_max - g_min)
    values = {f"S_{axis}": (float(s), "1") for axis, s in zip(AXES, scale, strict=True)}
    return Multiply(np.asarray(np.diag(scale), np.float64)), values


STAGE_EQUATIONS = {f.__name__: f for f in (bias, orthogonality_and_misalignment, scale_factor)}


@dataclass(frozen=True)
class CorrectedRates:
    """The output of a stage: the correction so far, and the parameters of the last stage."""

    steps: list[CorrectionStep] = field(default_factory=list)
    values: dict[str, tuple[float, str]] = field(default_factory=dict)

    def contract(self) -> tuple[Values, Values]:
        """Return bias and matrix of ``matrix @ (reading - bias)``, the composition of all steps."""
        offset: Values = np.zeros(3)
        matrix: Values = np.eye(3)
        for step in self.steps:
            if isinstance(step, Subtract):
                offset = offset + step.offset
            elif isinstance(step, Multiply):
                offset, matrix = step.matrix @ offset, step.matrix @ matrix
        return np.asarray(np.linalg.solve(matrix, offset), float), matrix

    def vector(self) -> Values:
        """Return bias, matrix and the last stage's parameters in one vector."""
        offset, matrix = self.contract()
        return np.concatenate([offset, matrix.ravel(), [value for value, _ in self.values.values()]])


def follow(response: Response, names: Sequence[str], start: Sequence[CorrectionStep] = ()) -> CorrectedRates:
    """Run stages one after the other, each on the output of the one before; ``start``: the correction so far."""
    found = CorrectedRates([*start])
    for step in found.steps:
        response = response.after(step)
    for name in names:
        step, values = STAGE_EQUATIONS[name](response)
        response = response.after(step)
        found = CorrectedRates([*found.steps, step], values)
    return found


class Estimates(NamedTuple):
    """The estimates from samples at rest and in steady turns, without their uncertainty."""

    samples: TurnSamples
    weights: Values  # (4, n); ``theta = weights @ readings``
    theta: Values  # (4, 3); mean reading at rest, and the response to the rate about each axis
    response: Response


def estimates_of(recordings: Sequence[Recording], settings: Settings) -> Estimates:
    """Return what the stages read of recordings; ``settings``: sections ``table`` and ``method``."""
    as_printed = settings.method.as_printed
    samples = samples_of(parts_of(recordings, "gyroscope", settings.table, "the staged method"), recordings)
    weights = weights_of(samples.rate, as_printed=as_printed)
    theta = weights @ samples.reading
    return Estimates(samples, weights, theta, Response(theta[0], theta[1:], samples.speed, as_printed))


def fit(task: StageInput) -> SensorCalibration:
    """Run one stage of the staged method; role ``gyroscope``, on a table, also ``static`` if these hold no rest."""
    name, recordings, previous, settings = task.stage, task.recordings, task.previous, task.settings
    if settings.procedure.sheet is not None and name == "bias":
        from pipeline.estimation.gyroscope.cholesky_lu import fit_bias  # noqa: PLC0415  (only for turns of a sheet)

        return fit_bias(recordings, settings)
    prior, before = task.prior, [stage.name for stage in task.stages]
    samples, weights, theta, response = estimates_of(recordings.filtered, settings)
    design = np.column_stack([np.ones(len(samples.rate)), samples.rate[:, samples.speed > 0]])
    residuals = samples.reading - theta[0] - samples.rate @ theta[1:]

    def chain(values: Values) -> Values:
        b, *slope = values.reshape(3, 4).T
        return follow(replace(response, rest=b, slope=np.array(slope)), [*before, name]).vector()

    here = theta.T.ravel()
    so_far = previous.stages[-1].correction if previous and previous.stages else None
    found = follow(response, [name], so_far or ())
    x, y, z = np.split(derivative(chain, here, np.full(here.size, DIFFERENCE_STEP_DPS)), 3, axis=1)
    map_ = LinearMap((weights, weights, weights), (x, y, z))
    reference = Reference("gyroscope", used_motions(samples.parts), theta[1:].T, settings.table)
    noise = noise_on_table(reference, residuals, design, blocks_of_samples(samples.parts), prior)
    scatter = noise_contribution(noise, map_, prior)
    after = corrected(found.steps, samples.reading)
    error = np.linalg.norm(after, axis=1) - np.linalg.norm(samples.rate, axis=1)
    parameters = stage_parameters(found.values, scatter.covariance[AFTER_BASE, AFTER_BASE])
    details = details_on_table(noise, scatter.degrees_of_freedom, samples.parts, len(after))
    result = StageResult(name, parameters, float(np.sqrt(np.mean(error**2))), tuple(found.steps), details)
    offset, matrix = found.contract()
    condition, columns = ScaledColumns.of(design).condition, design.shape[1]
    convergence = Convergence(0.0, condition, columns, columns, closed_form=True)
    stages = (*task.stages, result)
    calibration = SensorCalibration("gyroscope", offset, matrix, stages=stages, convergence=convergence)

    def results(errors: Values) -> Values:
        return np.array([chain(here + e)[BASE] for e in errors])

    reference = replace(reference, K=np.asarray(np.linalg.solve(matrix, np.eye(3))))
    return budgeted(calibration, reference, map_.results(BASE), noise, [scatter.of(BASE)], settings, results)


@dataclass(frozen=True)
class Response:
    """Mean readings at rest, and responses to the rate in steady turns."""

    rest: Values  # (3,), deg/s; mean reading at rest
    slope: Values  # (3, 3); row i: reading of x, y, z per deg/s about axis i
    rate: Values  # (3,), deg/s; I: mean magnitude of the rate about each axis; 0 where none was recorded
    as_printed: bool = False  # whether the equations are those that are printed

    def after(self, step: CorrectionStep) -> Response:
        """Return the response of readings after a step of a correction."""
        if isinstance(step, Subtract):
            return replace(self, rest=self.rest - step.offset)
        assert isinstance(step, Multiply)  # noqa: S101  (``STAGE_EQUATIONS``)
        return replace(self, rest=step.matrix @ self.rest, slope=self.slope @ step.matrix.T)

    def require_turns(self) -> None:
        """Raise ``NotObservableError`` where there is no turn about one of the axes."""
        missing = [axis for axis, rate in zip(AXES, self.rate, strict=True) if rate == 0.0]
        if missing:
            problem = f"the gyroscope was not turned steadily about {' and '.join(missing)}"
            raise NotObservableError(f"{problem}: record a turn at a constant rate about each of x, y and z")


@dataclass(frozen=True)
class TurnSamples:
    """The used samples, stacked."""

    reading: Values  # (n, 3), deg/s; less Earth's rotation where it is known
    rate: Values  # (n, 3), deg/s; signed rate of the table about its turn axis, in the column of the axis; 0 at rest
    parts: list[TurnPart]

    @property
    def speed(self) -> Values:
        """I: mean magnitude of the rate about each axis, 0 where there is no steady turn: (3,) array, deg/s."""
        moving = np.count_nonzero(self.rate, axis=0)
        return np.asarray(np.abs(self.rate).sum(axis=0) / np.maximum(moving, 1))


def samples_of(parts: Sequence[TurnPart], recordings: Sequence[Recording]) -> TurnSamples:
    """Return the samples at rest and in steady turns; without a rest, also the samples of a static recording."""
    chosen, readings, rates = [], [], []
    for part in parts:
        memory = _memory(part.recording)
        steady, still = steady_turns(part, memory), _without_tails(part, memory)
        rate = np.zeros((part.recording.samples, 3))
        if part.motion.axis is not None:
            rate[steady, part.motion.axis] = np.asarray(part.motion.rate)[steady]
        chosen.append(replace(part, keep=(still | steady) & part.keep))
        rates.append(rate[chosen[-1].keep])
        earth = chosen[-1].used_motion.angular_rate - rates[-1]
        readings.append(chosen[-1].reading("gyroscope") - earth)
    if all(np.any(rate, axis=1).all() for rate in rates):
        for recording in recordings:
            if recording.role == "static" and recording.gyroscope is not None:
                chosen.append(TurnPart(recording, motion_at_rest(recording.time), recording.valid))
                readings.append(chosen[-1].reading("gyroscope"))
                rates.append(np.zeros_like(readings[-1]))
    return TurnSamples(np.concatenate(readings), np.concatenate(rates), chosen)


def _memory(recording: Recording) -> float:
    """Return the settling time of the recording's filter, s."""
    if recording.filter["name"] == "none":
        return 0.0
    covariance = np.abs(filter_autocovariance(recording))
    return float(np.flatnonzero(covariance > FORGOTTEN_RATE_CHANGE * covariance[0])[-1] + 1) * recording.interval


def _without_tails(part: TurnPart, memory: float) -> Mask:
    """Return the samples at rest in which a filter has settled after a turn, and before the next turn."""
    still, time = part.motion.still.copy(), part.motion.time
    before = memory if part.recording.filter.get("zero_phase") else 0.0
    for start, stop in runs(part.motion.still) if memory > 0 else []:
        if start > 0:
            still[start:stop] &= time[start:stop] >= time[start] + memory
        if stop < len(time):
            still[start:stop] &= time[start:stop] <= time[stop - 1] - before
    return still


def weights_of(rate: Values, *, as_printed: bool) -> Values:
    """Return the weights of the samples in (b, R_x, R_y, R_z): (4, n) array."""
    rest = np.all(rate == 0, axis=1)
    if not np.any(rest):
        raise NotObservableError(
            "the gyroscope's recordings hold no rest, or none longer than the filter's memory, and there is no static "
            "recording: let the table rest for some seconds before a turn"
        )
    weights = np.zeros((4, len(rate)))
    weights[0] = rest / rest.sum()
    for axis in range(3):
        by = np.sign(rate[:, axis]) if as_printed else rate[:, axis]
        if np.any(by):
            slope = by / (by @ rate[:, axis])
            weights[axis + 1] = slope - slope.sum() * weights[0]
    return weights
