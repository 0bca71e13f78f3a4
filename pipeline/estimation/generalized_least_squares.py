"""Fit bias, matrix and effects together, by generalized least squares in the measurement direction.

    y = b + K u(t') + sum over effects z(t'; p) + noise,    beta = (b, K, p)
    step = (J^T C^-1 J)^-1 J^T C^-1 r

where

    u  : truth by the table, at the time t' that follows from the effects of timing
    J  : derivative of the model with respect to beta; r: readings minus the model
    C  : white noise plus a Gauss-Markov bias, ``pipeline.estimation.gauss_markov``

Most parameters are linear; time offsets, lags and time constants need a few Gauss-Newton rounds. The estimate has the
weights of the most likely noise. Its uncertainty, by ``pipeline.estimation.engine``, is averaged over all hypotheses
about the noise, weighted by their restricted likelihood.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import compress

import numpy as np

from pipeline.core.errors import NotObservableError
from pipeline.core.records import (
    AFTER_BASE,
    BASE,
    BASE_COUNT,
    BASE_NAMES,
    BIAS,
    MATRIX,
    NORMAL,
    Contribution,
    Convergence,
    Noise,
    Recording,
    SensorCalibration,
    StageDetails,
    StageResult,
    Values,
    base_values,
    matrix_of,
)
from pipeline.core.settings import Settings
from pipeline.estimation.candidates import FIXED_AT_ZERO, TILT, is_fixed, parameter_names, require_available, starts_of
from pipeline.estimation.design import (
    Design,
    Start,
    Terms,
    motions_of,
    ordinary_base,
    placed,
    stepped,
    without_unknown_motion,
)
from pipeline.estimation.engine import (
    MIN_EIGENVALUE_SHARE,
    ErrorMixture,
    ResidualNoise,
    noise_outside_known_errors,
    undetermined_columns,
    with_matrix,
)
from pipeline.estimation.gauss_markov import WHITE_SETTING, Setting, selection_grid
from pipeline.estimation.noise import wander_prior
from pipeline.estimation.observations import Observations, observe, weighted
from pipeline.estimation.table_errors import Reference, disturbance
from pipeline.estimation.uncertainty_budget import (
    budgeted,
    combined,
    effect_parameters,
    noise_contribution,
    scatter_contribution,
)
from pipeline.physics.effects.base import Layout, truth
from pipeline.physics.effects.mounting import Mounting, errors_in_mean_frame, in_mean_frame

MAX_ITERATIONS = 25  # of Gauss-Newton
SMALL_STEP_UNCERTAINTIES = 1e-3  # of a standard uncertainty
BIAS_TO_WHITE_GRID = (0.01, 0.03, 0.1, 0.2, 0.3, 0.5, 1.0, 3.0)  # of bias to white noise: the grid of a fit
CORRELATION_TIME_GRID_S = (30.0, 100.0, 300.0, 1000.0)  # s, correlation times of that grid
# of log L below the likeliest noise: with any effect of 48 simulated sensors, a noise left out had a weight below 1e-4
FAR_LESS_LIKELY = 25.0
LEAST_EIGENVALUE = 1e-7  # of the products of columns of unit norm: a column is 3e-4 new


@dataclass(frozen=True, kw_only=True)
class JointFit(Start):
    """The best fit of base and effects to the readings."""

    # (12 + p, 12 + p); of bias, K (row by row) and the effects' parameters, averaged over the noise settings of the fit
    covariance: Values
    log_likelihood: float  # under the best noise setting, up to a constant of the readings
    setting: Setting  # that noise setting
    # settings under which a model with further effects may be likely. Effects explain signals that a model without them
    # takes for noise. A setting of more noise (log det C) than the likeliest, and ``FAR_LESS_LIKELY``, is left out
    likely: Sequence[Setting]
    degrees_of_freedom: float
    residual_rms: float  # of single samples, unit of the sensor
    rounds: int
    converged: bool
    condition: float  # of the scaled products of columns
    rank: int  # parameters, or combinations of them, that the readings determine
    _designs: dict[Observations, Design] = field(default_factory=dict, init=False, repr=False)  # results of ``design``

    @cached_property
    def in_mean_frame(self) -> tuple[JointFit, Values]:
        """The fit in the frame of the mean mounting, and the map of its errors to that frame."""
        found = next((each for each in placed(self.terms).values() if isinstance(each[0].effect, Mounting)), None)
        if found is None:
            return self, np.eye(len(self.covariance))
        mounting, place = found
        K, theta = in_mean_frame(self.K, mounting.values)
        change = errors_in_mean_frame(K, theta, place, len(self.covariance))
        terms = tuple(replace(term, values=theta) if term is mounting else term for term in self.terms)
        return replace(self, K=K, terms=terms, covariance=change @ self.covariance @ change.T), change

    def design(self, observations: Observations) -> Design:
        """Return the design of observations at this solution, with the residual as readings; it is built once."""
        if observations not in self._designs:
            self._designs[observations] = design_at(observations, self)
        return self._designs[observations]


def fit_terms(
    observations: Observations,
    terms: Terms,
    start: Start,
    settings: Sequence[Setting],
    small: float = SMALL_STEP_UNCERTAINTIES,
) -> JointFit:
    """Fit base and effects from a start.

    ``terms``: effects, at the start of their nonlinear parameters. ``settings``: noise settings over which the
    likelihood is maximised. ``small``: the last step, standard uncertainties.
    """
    linear = not any(term.effect.nonlinear or term.effect.layout == Layout.SHARED for term in terms)
    rounds, converged, state = 0, False, _with_all_columns(start, terms)
    design = design_at(observations, state)
    solved = _solve(design, observations, settings)
    while rounds < MAX_ITERATIONS and not converged:
        rounds += 1
        moved, taken = stepped(state.terms, solved.step[AFTER_BASE])
        taken = np.concatenate([solved.step[BASE], taken])
        K = state.K + matrix_of(taken)
        state = replace(state, bias=state.bias + taken[BIAS], K=K, terms=tuple(moved))
        largest = small * np.sqrt(np.diag(solved.best_covariance))
        largest[BASE] = np.maximum(largest[BASE], 1e-12)
        converged = linear or bool(np.all(np.abs(taken) <= largest))
        if not converged:
            design = design_at(observations, state)
            solved = _solve(design, observations, settings)
    residual = design.left(solved.step * converged)  # a step so small changes the columns by nothing that counts
    noise = observations.less_stop_errors
    squares = np.sum(noise.weight[:, None] * residual**2) + np.sum(noise.scatter)
    covariance, freedom = solved.posterior.averaged()
    return JointFit(
        state.bias,
        state.K,
        state.scale,
        state.terms,
        covariance=covariance,
        log_likelihood=solved.log_likelihood,
        setting=solved.setting,
        likely=solved.likely,
        degrees_of_freedom=float(freedom.min()),
        residual_rms=float(np.sqrt(squares / (3.0 * noise.samples))),
        rounds=rounds,
        converged=converged,
        condition=solved.condition,
        rank=solved.rank,
    )


def _with_all_columns(start: Start, terms: Terms) -> Start:
    """Return a base with terms whose parameters all have a column."""
    full = (replace(term, values=np.array(term.values, float), full=True) for term in terms)
    return Start(start.bias, start.K, start.scale, tuple(full))


def design_at(observations: Observations, at: Start, candidates: Terms | None = None) -> Design:
    """Return the design of a model at given parameters with its residual, or that of the terms ``candidates``."""
    residual, base = _residual(observations, at)
    terms, project = (at.terms, False) if candidates is None else (candidates, True)
    return Design(observations, terms, at.K, np.maximum(at.scale, 1e-300), target=residual, base=base, project=project)


def _residual(observations: Observations, at: Start) -> tuple[Values, Values]:
    """Return the readings minus the model, and the vectors on which K acts: truth and effects added to it."""
    sensor, K = observations.sensor, at.K
    predicted, base = [], []
    for part in observations.parts:
        *motions, everything = motions_of(part, at.terms)
        u = truth(sensor, everything)
        reading = at.bias + u @ K.T
        for term, motion in zip(at.terms, motions, strict=True):
            if term.effect.moves:
                continue
            z = term.effect.reading(sensor, motion, K, term.values)
            reading = reading + z
            if term.effect.layout == Layout.SHARED:
                u = u + np.linalg.solve(K, z.T).T
        predicted.append(reading)
        base.append(u)
    return observations.reading - np.concatenate(predicted), np.concatenate(base)


@dataclass(frozen=True)
class _SolvedStep:
    """A Gauss-Newton step under the likeliest setting, and the covariance under each."""

    step: Values
    posterior: ErrorMixture
    best_covariance: Values
    log_likelihood: float
    setting: Setting
    likely: Sequence[Setting]
    condition: float
    cosine: float  # largest between a whitened column and the whitened residual, before the step
    rank: int
    # each (g,); of every setting: log det C + log det(X^T C^-1 X), and the weighted sum of squared residuals
    logarithms: Values
    squares: Values


def _solve(design: Design, observations: Observations, settings: Sequence[Setting]) -> _SolvedStep:
    """Solve for the step under each noise setting, and return the most likely one."""
    n = 3.0 * observations.samples
    within = float(np.sum(observations.scatter / design.scale**2))
    size = design.sizes()[:-1]
    size = np.where(size > 0, size, 1.0)
    spare = max(n - design.count, 1.0)
    products, logarithms = design.products(settings)
    gram, rhs = products[:, :-1, :-1] / np.outer(size, size), products[:, :-1, -1] / size
    unit = np.sqrt(np.maximum(np.einsum("gpp->gp", gram), 1e-30))
    values, vectors = np.linalg.eigh(gram / (unit[:, :, None] * unit[:, None, :]))
    kept = values > MIN_EIGENVALUE_SHARE * values[:, -1:]
    half = vectors * np.where(kept, 1.0 / np.sqrt(np.where(kept, values, 1.0)), 0.0)[:, None, :] / unit[:, :, None]
    determinants = np.sum(np.log(np.where(kept, values, 1.0)), axis=1) + 2.0 * np.sum(np.log(unit), axis=1)
    steps = (half @ (half.transpose(0, 2, 1) @ rhs[..., None]))[..., 0]
    rss = np.maximum(np.maximum(products[:, -1, -1] - np.sum(steps * rhs, axis=1), 0.0) + within, 1e-300)
    scores = -0.5 * n * np.log(rss / n) - 0.5 * logarithms + np.array([s.prior for s in settings])
    covariances = half @ half.transpose(0, 2, 1) / np.outer(size, size) * (rss / spare)[:, None, None]
    best = int(np.argmax(scores))
    weight = np.exp(scores - scores[best])
    norm = unit[best] * np.sqrt(max(float(products[best, -1, -1]), 1e-300))
    return _SolvedStep(
        step=steps[best] / size,
        posterior=ErrorMixture(weight / weight.sum(), covariances, spare),
        best_covariance=covariances[best],
        log_likelihood=float(scores[best]),
        setting=settings[best],
        likely=[*compress(settings, (scores > scores[best] - FAR_LESS_LIKELY) | (logarithms < logarithms[best]))],
        condition=float(np.sqrt(values[best, -1] / max(values[best, 0], 1e-300))),
        cosine=float(np.max(np.abs(rhs[best]) / norm)),
        rank=int(kept[best].sum()),
        logarithms=logarithms + determinants,
        squares=rss,
    )


def _residual_noise(
    design: Design, observations: Observations, settings: Sequence[Setting], reference: Reference
) -> ResidualNoise:
    """Weight the hypotheses about the noise by their restricted likelihood, for a design at its solution."""
    weight, blocks, white = observations.weight, observations.in_blocks(np.inf), design.scale  # few: dense covariances
    disturbed = disturbance(reference, observations.reading, blocks, weight, white)
    if disturbed is not None:
        columns = np.zeros((3, len(blocks.weight), design.count + 1))
        for c in range(3):
            columns[c][:, design.places(c)[1]] = blocks.sums(weight[:, None] * design.of_axis(c))
        columns /= blocks.weight[:, None]
        X = columns[:, :, :-1] * (np.sqrt(blocks.weight) / white[:, None])[:, :, None]
        X /= np.maximum(np.linalg.norm(X, axis=(0, 1)), 1e-300)
        return noise_outside_known_errors(X, columns[:, :, -1].T, blocks, settings, white, disturbed, weight)
    solved, free = _solve(design, observations, settings), max(3.0 * observations.samples - design.count, 1.0)
    squares = solved.squares[:, None] / free
    found = ResidualNoise.of(observations.blocks, settings, solved.logarithms, squares, free, weight)
    return replace(found, white_variance=found.white_variance * design.scale**2)


def fit_best(observed: Observations, choices: Sequence[Terms], start: Start, settings: Sequence[Setting]) -> JointFit:
    """Fit from the combination of starts among ``choices`` with the largest likelihood after one linear step.

    Effects of timing are first fitted with the base alone: far from their values a linear step is inaccurate, and other
    effects would absorb their signal.
    """

    def best() -> JointFit:
        begin, possible = start, choices
        timing = [term for term in choices[0] if term.effect.moves and not np.any(term.values)]
        if timing and len(timing) < len(choices[0]):  # they move the rows, and so change the likelihood of the starts
            begin = fit_terms(observed, timing, start, settings)
            fitted = {term.effect.name: term.values for term in begin.terms}
            possible = [[replace(t, values=fitted.get(t.effect.name, t.values)) for t in each] for each in choices]

        def likelihood(terms: Terms) -> float:
            design = design_at(observed, _with_all_columns(begin, terms))
            return _solve(design, observed, settings).log_likelihood

        chosen = possible[0] if len(possible) == 1 else max(possible, key=likelihood)
        return fit_terms(observed, chosen, begin, settings)

    key = fit_best, start.key, tuple(tuple(term.key for term in terms) for terms in choices), tuple(settings)
    return observed.once(key, best)


def require_observable(observations: Observations, fit: JointFit) -> None:
    """Raise ``NotObservableError``, with the parameters, if the recordings do not determine a fit."""
    design = fit.design(observations)
    names = [*BASE_NAMES, *parameter_names(observations.sensor, [t.effect for t in fit.terms])]
    free = np.ones(len(names), bool)  # a prior determines the others
    for place, term in zip(design.slices, fit.terms, strict=True):
        free[place] = term.prior is None or np.linalg.matrix_rank(term.prior.precision) < len(term.values)
    names = [name for name, kept in zip(names, free, strict=True) if kept]
    size = design.sizes()[:-1][free]
    products = design.products([WHITE_SETTING])[0][0, :-1, :-1][np.ix_(free, free)]
    lost = undetermined_columns(products / np.outer(*[np.where(size > 0, size, 1.0)] * 2), LEAST_EIGENVALUE)
    weak = [name for name, each in zip(names, lost, strict=True) if each]
    if weak:
        involved = [t.effect for t in fit.terms if any(name.startswith(f"{t.effect.name}.") for name in weak)]
        advice = "; ".join(f"{effect.name} needs {effect.excitation}" for effect in involved)
        raise NotObservableError(
            f"the recordings of the {observations.sensor} do not determine {', '.join(weak)}: "
            f"{advice or 'record turns about all three axes'}; or take the effect out of effects.{observations.sensor}"
        )


def fit_joint(  # noqa: PLR0917  (the interface that the stages and the diagnosis share)
    sensor: str,
    recordings: Sequence[Recording],
    effects: Sequence[str],
    noise: Noise | None,
    settings: Settings,
    start: SensorCalibration | None = None,
    accelerometer: SensorCalibration | None = None,
) -> SensorCalibration:
    """Fit bias, matrix and effects together.

    ``recordings``: all of a unit; held-out ones are not used. ``effects``: in the order of the report. ``noise``: from
    a static recording, it determines the bias wander. ``start``: the calibration so far, with its stages and the
    starting values of effects. ``accelerometer``: for the gyroscope, the fit with the mountings. Raises
    ``NotObservableError`` if the recordings do not determine a parameter; ``ConfigurationError`` if an effect is
    unknown or not of this sensor.
    """
    observations = weighted(observe(sensor, recordings, settings.table), noise)
    combinations = starts_of(effects, observations, start, accelerometer)
    base = ordinary_base(observations, noise)
    require_available(observations, effects)
    grid = selection_grid(noise, BIAS_TO_WHITE_GRID, CORRELATION_TIME_GRID_S)
    fit = fit_best(observations, combinations, base, grid)
    known = without_unknown_motion(observations, fit.terms)
    if known is not observations:
        observations, fit = known, fit_terms(known, fit.terms, fit, grid)
    require_observable(observations, fit)
    return calibration_of(fit, observations, start, settings, noise)


def calibration_of(
    fit: JointFit,
    observations: Observations,
    before: SensorCalibration | None,
    settings: Settings | None = None,
    noise: Noise | None = None,
) -> SensorCalibration:
    """Convert a fit to a calibration: ``matrix = K^-1``, with ``d matrix = -matrix dK matrix``.

    With ``settings``, the uncertainties include the accuracies of the table, except those that an effect of the fit
    estimates.
    """
    (fit, turned), sensor = fit.in_mean_frame, observations.sensor
    matrix = np.asarray(np.linalg.solve(fit.K, np.eye(3)), np.float64)
    change = np.eye(len(fit.covariance))
    change[MATRIX, MATRIX] = -np.kron(matrix, matrix.T)
    covariance = change @ fit.covariance @ change.T
    change = change @ turned
    effects, parameters = effect_parameters(sensor, fit.terms, covariance)
    is_fixed_at_zero = [is_fixed(name, p.value, p.unit, p.standard_uncertainty) for name, p in parameters.items()]
    if any(is_fixed_at_zero):  # no estimates: 0 without an uncertainty
        rows = BASE_COUNT + np.flatnonzero(is_fixed_at_zero)
        change[rows] = covariance[rows] = covariance[:, rows] = 0.0
        of_terms = np.split(is_fixed_at_zero, np.cumsum([len(term.values) for term in fit.terms])[:-1])
        pairs = zip(fit.terms, of_terms, strict=True)
        fit = replace(fit, terms=tuple(replace(t, values=np.where(fixed, 0.0, t.values)) for t, fixed in pairs))
        effects, parameters = effect_parameters(sensor, fit.terms, covariance)
    details = StageDetails(
        samples=round(observations.samples),
        rounds=fit.rounds,
        condition=fit.condition,
        wander_ratio=fit.setting.ratio,
        wander_time_s=fit.setting.time,
        # bias and matrix are fitted again, from ordinary least squares
        replaces=before.stages[-1].name if before is not None and before.stages else None,
    )
    stage = StageResult("effects", parameters, fit.residual_rms, None, details)
    stages = (*(before.stages if before else ()), stage)
    found = before or SensorCalibration(sensor)
    found = replace(found, bias=fit.bias, matrix=matrix, stages=stages, effects=effects, converged=fit.converged)
    if settings is None:
        return combined(found, [scatter_contribution(covariance, fit.degrees_of_freedom)], {})
    names = [term.effect.name for term in fit.terms]
    design = fit.design(observations)
    cosine = _solve(design, observations, [fit.setting]).cosine
    found = replace(found, convergence=Convergence(cosine, fit.condition, fit.rank, len(covariance)))
    first = design.linear_map(fit.setting)
    prior = wander_prior(noise, settings.sensor.of(sensor))
    whole = replace(first, derivative=tuple(change @ J for J in first.derivative))
    reference = Reference(sensor, [part.motion for part in observations.parts], fit.K, settings.table)
    errors = _residual_noise(design, observations, prior.grid(float(np.sqrt(np.mean(design.scale**2)))), reference)
    values = np.concatenate([base_values(fit.bias, fit.K), *(term.values for term in fit.terms)])
    of_channels = np.concatenate(first.derivative, axis=1)
    lines = [noise_contribution(errors, whole, prior)]
    for name, prior_part in design.prior_covariances(fit.setting).items():
        remark = FIXED_AT_ZERO if name == TILT and not observations.levelling_deg else ""
        part, freedom = change @ prior_part @ change.T, np.full(len(change), np.inf)
        lines.append(Contribution(name.replace("_", " "), "B", NORMAL, part, freedom, remark=remark))
    return budgeted(
        found, reference, whole, errors, lines, settings, lambda e: with_matrix(values + e @ of_channels.T), names
    )
