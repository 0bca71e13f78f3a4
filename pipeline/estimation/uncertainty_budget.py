"""Compute the uncertainty budget of a fit (JCGM 100:2008, GUM, 5, 8 and annex G).

    U = sum over sources of U_s,    nu_eff = u^4 / sum_s (u_s^4 / nu_s),    expanded uncertainty = k(nu_eff) u

The noise of the readings is of type A, from the residuals (``pipeline.estimation.engine``), including slow errors and
lack of fit. Its parts are stated separately: white noise, the bias instability by the static recording or the sensor
file, and lack of fit beyond both. All other contributions are of type B, with infinite degrees of freedom:

    limits        : misalignments that rests do not determine (``multi_position.result.limits_contribution``)
    bench         : the table's stated accuracies (``pipeline.estimation.table_errors``), local gravity
    quantisation  : where white noise does not make the rounding errors of the samples independent
    others        : temperature, repeatability, a time from a count of rows (``pipeline.estimation.stated_lines``)

Sources without a stated accuracy are listed as not included.

An effect of the sensor file at its limit would change bias and matrix of a fit without that effect by

    d beta = sum over rows A z(p_j = limit_j),    up to sum_j |d beta_j|

with the linear map A of the fit from its readings (``pipeline.estimation.engine``) or equations to its parameters, and
the column z of parameter j of the effect. Where the recordings leave the effect open
(``pipeline.estimation.observability``), the largest change is not in the expanded uncertainty: the
calibration states it apart (``pipeline.physics.compensation``).

An error of the accelerometer by hand changes the direction of gravity, to which the moves of the gyroscope refer:

    df = M_a (z - db_a) + dM_a v_a,    d beta = A D df

with D, the derivative of the moves' equations with respect to the specific force at each rest. These changes are named
``accelerometer.<effect>``.

A change with temperature counts from the mean temperature of the recordings, at which bias and matrix hold.
Effects of timing move the motion, and are left out: they act where the motion changes.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from pipeline.core.records import (
    AFTER_BASE,
    BASE,
    BASE_COUNT,
    BASE_NAMES,
    BIAS,
    LIMIT,
    MATRIX,
    NORMAL,
    RECTANGULAR,
    SENSOR_UNITS,
    Budget,
    Coefficient,
    Contribution,
    Estimate,
    FittedEffect,
    Motion,
    NoiseParts,
    NotIncluded,
    SensorCalibration,
    Values,
    base_units,
    base_values,
    matrix_of,
    standard_uncertainty,
)
from pipeline.core.settings import DataSheet, Settings, Table
from pipeline.estimation.candidates import TILT, limits_of, tilt_like_zeros
from pipeline.estimation.design import EffectColumns, Terms, columns_of_samples, joined_motions
from pipeline.estimation.engine import LinearMap, ResidualNoise, scaled_inverse, through, with_trials
from pipeline.estimation.gauss_markov import WanderPrior
from pipeline.estimation.multi_position.accelerometer import AccelerometerModel
from pipeline.estimation.multi_position.fit import FitByHand
from pipeline.estimation.multi_position.gyroscope import GyroscopeModel
from pipeline.estimation.multi_position.model import Model, motion_at_rests
from pipeline.estimation.table_errors import TIME_BASE, BudgetLines, Reference, table_errors, type_b
from pipeline.estimation.turns import RowGroups
from pipeline.physics.effects import catalogue, effect
from pipeline.physics.effects.base import REFERENCE_TEMPERATURE, Effect, Layout, Owner, turning_direction

OWNERS = (Owner.SENSOR, Owner.RECORDING)  # errors of place, table and timing have lines of their own in the budget
OF_ACCELEROMETER = "accelerometer."  # before an effect of the accelerometer that changes the gyroscope's parameters
# share of a variance, up to which a part of it may be chance: the lack of fit was 0 to 5 % on a table within its stated
# accuracies, 18 to 73 % with 0.02 deg between its axes (12 simulated units each, 18 positions)
CHANCE_VARIANCE_SHARE = 0.1
DITHERED = 0.5  # counts of white noise above which rounding errors are independent (Widrow & Kollar 2008)
NOISE_SOURCE, QUANTISATION_SOURCE = "noise of the readings", "quantisation"
NOT_STATED = "one calibration does not show it: calibrate the unit again after switching it off"
TEMPERATURE = "the parameters hold at the temperature of these recordings; no accuracy of the thermometer is stated"
ACROSS = (
    "table_tilt estimates the component across the shaft alone; the one about the shaft is the same as a common zero "
    "of the turns"
)
GRAVITY = "local gravity"
# Of a fit, by which the change by an open effect is computed: means of 0.12 s of 2.4 million samples at 1 kHz. In 20
# minutes at 1 kHz no figure of ``open`` changes by more than 2e-5 of itself.
MAX_CHANGED_SAMPLES = 20_000


def limited_effects(sensor: str, known: Collection[str], sheet: DataSheet) -> Iterator[tuple[Effect, Values, Values]]:
    """Yield each effect of the sensor file that is not in the model, its start, and the limits of its coefficients.

    An effect with time constants has several starts; limits of time constants are 0.
    """
    limits = limits_of(sensor, sheet)
    within = {*known, *(name for other in known for name in effect(other).contains)}
    for name, this in catalogue().items():
        if name in within or sensor not in this.sensors or sensor in this.unseen or this.owner not in OWNERS:
            continue
        if name not in limits or this.moves or this.of_turns or not np.isfinite(limits[name]).all():
            continue
        of_linear = limits[name] * [p.name not in this.nonlinear for p in this.parameters(sensor)]
        yield from ((this, start, of_linear) for start in this.starts(sensor))


def keep_larger(found: dict[str, Values], name: str, change: Values) -> None:
    """Keep the larger of two changes by an effect at different time constants."""
    if name not in found or np.abs(change).sum() > np.abs(found[name]).sum():
        found[name] = change


def changes_on_table(
    reference: Reference, fit: LinearMap, modelled: Collection[str], data_sheet: DataSheet
) -> dict[str, Values]:
    """Return the change of bias and matrix by each effect at its limits, (12, p), of a fit on a table."""
    found: dict[str, Values] = {}
    motions, fit = _in_blocks(centred(reference.motions), fit)
    sensor, K = reference.sensor, reference.K
    gains = np.stack([J[BASE] @ A for J, A in zip(fit.derivative, fit.weights, strict=True)])
    joined = joined_motions([motion.changed(direction=turning_direction(motion)) for motion in motions])
    for this, start, limits in limited_effects(sensor, modelled, data_sheet):
        if not all(this.available(motion) for motion in motions):
            continue
        term = EffectColumns(this, start)  # limits of nonlinear parameters are 0
        if this.of_samples:
            columns = columns_of_samples(term, sensor, joined, K)
        else:
            columns = np.concatenate([term.regressors(sensor, motion, K) for motion in motions])
        each = gains @ (columns if columns.ndim == 2 else columns.transpose(1, 0, 2))  # of each channel
        change = each.sum(axis=0) if term.layout() == Layout.SHARED else np.concatenate(each, axis=1)
        full = np.zeros((BASE_COUNT, len(limits)))
        full[:, : change.shape[1]] = change
        keep_larger(found, this.name, full * limits)
    return found


def _in_blocks(motions: Sequence[Motion], fit: LinearMap) -> tuple[Sequence[Motion], LinearMap]:
    """Return the mean motion of blocks of samples, and the map from readings that are equal in a block."""
    size = sum(len(motion.time) for motion in motions) // MAX_CHANGED_SAMPLES
    if size < 2:
        return motions, fit
    firsts = [np.arange(0, len(motion.time), size) for motion in motions]
    groups = [RowGroups(np.arange(len(m.time)), first, len(m.time)) for first, m in zip(firsts, motions, strict=True)]
    edges = np.cumsum([0, *(rows.total for rows in groups[:-1])])
    starts = np.concatenate([first + edge for first, edge in zip(firsts, edges, strict=True)])
    summed = {id(A): np.add.reduceat(A, starts, axis=1) for A in fit.weights}
    means = [rows.motion(motion) for rows, motion in zip(groups, motions, strict=True)]
    return means, replace(fit, weights=tuple(summed[id(A)] for A in fit.weights))


def centred(motions: Sequence[Motion]) -> list[Motion]:
    """Return the motions with the mean temperature to which effects refer."""
    known = [motion.temperature for motion in motions if motion.temperature is not None]
    shift = REFERENCE_TEMPERATURE - float(np.mean(np.concatenate(known))) if known else 0.0
    return [m if m.temperature is None else m.changed(temperature=m.temperature + shift) for m in motions]


def changes_by_hand(
    model: Model, fitted: FitByHand, gain: Values, modelled: Collection[str], data_sheet: DataSheet
) -> dict[str, Values]:
    """Return ``changes_on_table`` of a fit to rests and moves; ``gain``: of ``gain_of``."""
    model = _at_mean_temperature(model)
    if isinstance(model, AccelerometerModel):
        model.after_moves = True
    warm = bool(np.all(np.isfinite(model.rests.temperature)))
    signals, every = {"temperature"} if warm else set[str](), limited_effects(model.sensor, modelled, data_sheet)
    listed = [(this, start, limits) for this, start, limits in every if set(this.needs) <= signals]
    equations = model.equations(fitted.state, [EffectColumns(this, start) for this, start, _ in listed])
    found: dict[str, Values] = {}
    for (this, _, limits), columns in zip(listed, equations.candidates, strict=True):
        keep_larger(found, this.name, gain @ columns * limits)
    return found


def gain_of(fitted: FitByHand, place: Values) -> Values:
    """Return the change of bias and matrix by a change of the residuals of rests and moves: (12, n) array.

    ``place``: (12 + e, b + e), from the parameters of the fit to bias, matrix and effects.
    """
    equations = fitted.equations
    n, scale = len(equations.residual), max(fitted.hypotheses, key=lambda hypothesis: hypothesis[1])[2]
    white, _ = equations.whitened(fitted.noise, np.column_stack([equations.columns, np.eye(n)]), scale)
    X, root = white[:, :-n], white[:, -n:]
    inverse = scaled_inverse(X.T @ X + scale * np.diag(fitted.precision))
    return np.asarray((place @ inverse @ X.T @ root)[BASE], np.float64)


def _at_mean_temperature(model: Model) -> Model:
    """Return a copy of the model with the mean temperature of its rests at the one to which effects refer."""
    out, mean = copy(model), np.mean(model.rests.temperature)
    if not np.isfinite(mean):
        return out
    shift = REFERENCE_TEMPERATURE - float(mean)
    out.rests = replace(model.rests, temperature=model.rests.temperature + shift)
    for name in ("moves", "turns", "soaks", "attitudes"):
        if (part := getattr(model, name, None)) is not None:
            setattr(out, name, replace(part, temperature=part.temperature + shift))
    return out


def changes_through_gravity(
    model: GyroscopeModel, fitted: FitByHand, gain: Values, accelerometer: SensorCalibration, data_sheet: DataSheet
) -> dict[str, Values]:
    """Return the change of the gyroscope's bias and matrix by each effect of the accelerometer at its limits, (12, p).

    ``accelerometer``: with the changes of its own bias and matrix. ``gain``: of ``gain_of``. ``data_sheet``: of
    the accelerometer.
    """
    if model.moves is None or not accelerometer.at_limits:
        return {}
    rests, force, M = model.every, model.at_rests.force, accelerometer.matrix
    motion = centred([motion_at_rests(rests, force)])[0]
    of_moves = np.asarray(model.equations_of_moves(fitted.state).force)
    by_force = np.einsum("pn,nmc->pmc", gain[:, model.of_moves], of_moves)
    K = np.asarray(np.linalg.solve(M, np.eye(3)), np.float64)
    found: dict[str, Values] = {}
    for this, start, limits in limited_effects("accelerometer", (), data_sheet):
        own = accelerometer.at_limits.get(this.name)
        if own is None:
            continue
        z = this.columns("accelerometer", motion, K, start) * limits
        df = np.einsum("ij,mjp->mip", M, z - own[BIAS])
        df += np.stack([(force @ K.T) @ matrix_of(change).T for change in own.T], axis=2)
        keep_larger(found, OF_ACCELEROMETER + this.name, np.einsum("pmc,mcq->pq", by_force, df))
    return found


def effective_degrees_of_freedom(contributions: ArrayLike, degrees_of_freedom: ArrayLike) -> Values:
    """Return ``nu_eff`` by Welch and Satterthwaite: (n,) array, infinite where no finite one contributes.

    ``contributions``: (m, n), standard uncertainty that each of m inputs contributes to each of n results; the inputs
    are independent. ``degrees_of_freedom``: (m,) or (m, n), of each; may be infinite.
    """
    u = np.atleast_2d(np.asarray(contributions, float))
    nu = np.asarray(degrees_of_freedom, float)
    share = np.sum(u**4 / np.broadcast_to(nu[:, None] if nu.ndim == 1 else nu, u.shape), axis=0)
    total = np.sum(u**2, axis=0) ** 2
    return np.asarray(np.divide(total, share, out=np.full(u.shape[1], np.inf), where=share > 0.0))


def noise_contribution(noise: ResidualNoise, fit: LinearMap, prior: WanderPrior | None) -> Contribution:
    """Return the contribution of white noise, bias instability and lack of fit; with its parts if there is a prior."""
    covariance, freedom = noise.posterior(fit).averaged()
    if prior is None:
        return scatter_contribution(covariance, freedom)
    total = np.diag(covariance)
    white, wander = noise.variances(fit, prior)
    white = np.clip(white, 0.0, np.clip(total, 0.0, None))  # rounding may leave a negative zero
    wander = np.clip(wander, 0.0, np.clip(total - white, 0.0, None))
    parts = NoiseParts(np.sqrt(white), np.sqrt(wander), np.sqrt(np.clip(total - white - wander, 0.0, None)))
    return scatter_contribution(covariance, freedom, parts)


def scatter_contribution(
    covariance: Values, degrees_of_freedom: float | Values, parts: NoiseParts | None = None, remark: str = ""
) -> Contribution:
    """Return the contribution of the readings' scatter for a fit that computes its covariance directly."""
    freedom, parts = np.full(len(covariance), degrees_of_freedom, np.float64), parts or NoiseParts()
    return Contribution(NOISE_SOURCE, "A", "Student's t", covariance, freedom, parts=parts, remark=remark)


def _quantisation(noise: ResidualNoise, fit: LinearMap, counts_per_unit: float, unit: str) -> BudgetLines:
    """Return the contribution of rounding to whole counts, or why it has no separate line.

    With white noise of half a count or more, the rounding errors of the samples are independent, of variance 1/12
    count^2, and part of the noise of the residuals. With less, all samples of a block have the same error.
    """
    step = 1.0 / counts_per_unit
    if np.all(noise.white >= DITHERED * step):
        size = float(noise.white.min()) / step
        return [], {QUANTISATION_SOURCE: f"contained in the {NOISE_SOURCE}, which reach {size:.1f} counts or more"}
    label = noise.blocks.label(fit.weights[0].shape[1])
    rough = np.where(noise.white < DITHERED * step, 1.0, 0.0) * np.ones((len(label), 3))
    effects = [fit.of_groups(rough * axis, label, len(noise.blocks.weight)) for axis in np.eye(3)]
    u, effect = step / np.sqrt(12.0), np.concatenate(effects, axis=1)
    return [type_b(QUANTISATION_SOURCE, RECTANGULAR, u, unit, effect)], {}


def gravity_line(calibration: SensorCalibration, table: Table) -> BudgetLines:
    """Return the contribution of local gravity, which scales the matrix, ``dM = M dG / G``, or why there is none."""
    u = table.gravity_accuracy_g
    if not u:
        return [], {GRAVITY: "table.gravity_accuracy_g is not stated"} if u is None else {}
    effect = np.zeros((len(calibration.parameters), 1))
    effect[MATRIX, 0] = calibration.matrix.ravel() / table.gravity_g
    return [type_b(GRAVITY, NORMAL, u, "g", effect)], {}


def clock_contribution(fit: SensorCalibration, ppm: float, kind: str = NORMAL, remark: str = "") -> Contribution:
    """Return the contribution of the sensor's clock, for rates that are an angle over its time: ``dM = M de``."""
    effect = np.zeros((len(fit.parameters), 1))
    effect[MATRIX, 0] = 1e-6 * fit.matrix.ravel()
    return type_b(TIME_BASE, kind, ppm, "ppm", effect, remark)


def clock_line(calibration: SensorCalibration, table: Table) -> BudgetLines:
    """Return the contribution of the sensor's clock as the table states it, or why there is none."""
    ppm = table.clock_accuracy_ppm
    if ppm is None:
        return [], {TIME_BASE: "table.clock_accuracy_ppm is not stated"}
    return [clock_contribution(calibration, ppm)], {}


def combined(fit: SensorCalibration, lines: Sequence[Contribution], missing: Mapping[str, str]) -> SensorCalibration:
    """Return a calibration with the covariance and the degrees of freedom of all contributions together.

    ``lines``: contributions to all of its parameters. ``missing``: source to the reason why it is not included.
    """
    parameters = fit.parameters
    covariance, freedom = np.zeros((len(parameters),) * 2), np.full(len(parameters), np.inf)
    if lines:
        covariance = np.sum([c.covariance for c in lines], axis=0)
        u = np.array([c.standard_uncertainty for c in lines])
        freedom = effective_degrees_of_freedom(u, np.array([c.degrees_of_freedom for c in lines]))
    reasons, sources = {**missing, "repeatability": f"{NOT_STATED}, and compare"}, {c.source for c in lines}
    left_out = tuple(NotIncluded(source, reason) for source, reason in reasons.items() if source not in sources)
    return with_uncertainty(fit, covariance, freedom, Budget(tuple(c.line() for c in lines), left_out))


def budgeted(  # noqa: PLR0917  (what a fit on a table is)
    calibration: SensorCalibration,
    reference: Reference,
    fit: LinearMap,
    noise: ResidualNoise,
    contributions: Sequence[Contribution],
    settings: Settings,
    results: Callable[[Values], Values],
    estimated: Sequence[str] | None = None,
) -> SensorCalibration:
    """Return a calibration on a table with its budget and, if configured, a Monte Carlo run.

    ``contributions``: first that of the noise; the others act on the parameters directly. ``results``: function of
    (t, q) errors of the fit's linear map, channel after channel, to (t, p) parameters. ``estimated``: effects of a
    joint fit, whose noise contains that of rounding; an error that one of them estimates is no input.
    """
    sensor = calibration.sensor
    rounded, found, missing = lines_on_table(reference, fit, noise, settings, estimated)
    modelled = [*(estimated or ()), *(e.name for e in calibration.effects)]
    at_limits = changes_on_table(reference, fit, modelled, settings.sensor.of(sensor))
    complete = combined(replace(calibration, at_limits=at_limits), [*contributions, *rounded, *found], missing)
    trials = settings.uncertainty.monte_carlo
    if not trials:
        return complete
    first = fit.first()
    rounded, found, _ = lines_on_table(reference, first, noise, settings, estimated)
    draw = through(noise.posterior(first), [c.covariance for c in (*found, *rounded)], results)
    return with_trials(complete, draw, trials, contributions[1:])


def lines_on_table(
    reference: Reference,
    fit: LinearMap,
    noise: ResidualNoise,
    settings: Settings,
    estimated: Sequence[str] | None = None,
) -> tuple[list[Contribution], list[Contribution], dict[str, str]]:
    """Return the contributions of rounding and of stated accuracies, and reasons for others; see ``budgeted``."""
    found, missing = table_errors(reference, fit, estimated or ())
    if estimated and TILT in estimated and tilt_like_zeros(reference.motions, estimated) is not None:
        missing["levelling"] = ACROSS
    rounded, contained = list[Contribution](), {QUANTISATION_SOURCE: f"contained in the {NOISE_SOURCE}"}
    if estimated is None:
        counts = settings.sensor.of(reference.sensor).counts_per_unit
        rounded, contained = _quantisation(noise, fit, counts, SENSOR_UNITS[reference.sensor])
    return rounded, found, {**missing, "temperature": TEMPERATURE, **contained}


def covariance_without_reference(calibration: SensorCalibration) -> Values:
    """Return the covariance without errors that calibration and held-out reference share: local gravity, time base.

    Both scale the matrix, ``dM = M e``, and the reference equally, so that held-out errors do not contain them.
    """
    out = calibration.parameters.covariance.copy()
    for line in calibration.lines:
        if line.source in (GRAVITY, TIME_BASE):
            shared = np.zeros(len(out))
            shared[MATRIX] = np.sign(calibration.matrix.ravel()) * line.standard_uncertainty[MATRIX]
            out -= np.outer(shared, shared)
    return out


def own_and_bench(calibration: SensorCalibration, *, with_lack_of_fit: bool = False) -> tuple[Values, Values]:
    """Divide the covariance of a calibration into the parts from its readings and from the bench.

    ``with_lack_of_fit``: whether the bench has the lack of fit, a part of the readings' contribution, too.
    """
    C = calibration.parameters.covariance
    of_bench = np.zeros(len(C))
    for line in calibration.lines:
        part, whole = line.parts.lack_of_fit, np.square(line.standard_uncertainty)
        if with_lack_of_fit and part is not None:
            of_bench += np.where(part**2 > CHANCE_VARIANCE_SHARE * whole, part**2, 0.0)
        of_bench += whole * (line.kind == "B" and line.source != LIMIT)
    share = np.clip(of_bench / np.maximum(np.diag(C), 1e-300), 0.0, 1.0)
    return C * np.sqrt(np.outer(1.0 - share, 1.0 - share)), C * np.sqrt(np.outer(share, share))


def stage_parameters(values: Mapping[str, tuple[float, str]], covariance: Values) -> dict[str, Estimate]:
    """Return the parameters of a stage."""
    u = standard_uncertainty(covariance).tolist()
    return {name: Estimate(*values[name], uncertainty) for name, uncertainty in zip(values, u, strict=True)}


def base_parameters(sensor: str, bias: Values, matrix: Values, covariance: Values) -> dict[str, Estimate]:
    """Return bias and matrix as the parameters of a stage."""
    values = zip(base_values(bias, matrix).tolist(), base_units(sensor), strict=True)
    return stage_parameters(dict(zip(BASE_NAMES, values, strict=True)), covariance)


def effect_parameters(
    sensor: str, terms: Terms, covariance: Values
) -> tuple[tuple[FittedEffect, ...], dict[str, Estimate]]:
    """Return the fitted effects, and their parameters as those of a stage; they follow bias and matrix."""
    u = iter(standard_uncertainty(covariance)[AFTER_BASE].tolist())
    effects, parameters = [], {}
    for term in terms:
        pairs = zip(term.effect.parameters(sensor), term.values.tolist(), strict=True)
        described = {p.name: Coefficient(value, p.unit) for p, value in pairs}
        for name, p in described.items():
            parameters[f"{term.effect.name}.{name}"] = Estimate(p.value, p.unit, next(u) or None)
        effects.append(FittedEffect(term.effect.name, described, term.effect.definition))
    return tuple(effects), parameters


def with_uncertainty(fit: SensorCalibration, covariance: Values, freedom: Values, budget: Budget) -> SensorCalibration:
    """Return a calibration with a new budget and covariance, and with effects that follow from it."""
    complete = replace(fit, covariance=covariance, freedom=freedom).parameters
    known = freedom[complete.standard_uncertainty > 0.0]
    expanded, effects = iter(complete.expanded_uncertainty.tolist()[AFTER_BASE]), []
    for one in fit.effects:
        parameters = {n: replace(p, expanded_uncertainty=next(expanded) or None) for n, p in one.parameters.items()}
        effects.append(replace(one, parameters=parameters))
    least = float(known.min()) if len(known) else float("inf")
    return replace(
        fit, effects=tuple(effects), covariance=covariance, degrees_of_freedom=least, freedom=freedom, budget=budget
    )
