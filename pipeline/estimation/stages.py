"""Run the stages of a fit: the contract of a stage is ``FitStage``, ``StageInput`` and ``StageOutput``.

A stage is a module ``pipeline/estimation/<stage>.py``, or of one sensor ``pipeline/estimation/<sensor>/<stage>.py``,
with its declaration in ``FIT_STAGES``, by name (``FitStage``), and ``fit(task: StageInput)``. It returns a
``StageOutput``; a fit to a table's motion or to moves, which has a budget of its own, returns the
``SensorCalibration``. The stages of the staged method are functions of one module for each sensor. A stage of known
effects has no ``fit`` (``FitStage.known``).

A stage raises ``CannotCalibrateError`` if there is no recording for it, ``NotObservableError`` if the recordings do not
determine its parameters. ``check_stages`` refuses a method whose stages cannot follow each other before any job.

The stage ``given`` (``method=given``) is no fit: it takes bias, matrix and effects from an existing calibration file,
for validation and diagnosis with the recordings. The uncertainty is that of the file. If the file states none, the
covariance is zero, which the budget states; any held-out error beyond noise is then an error of the calibration.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import Literal, TypeAlias

import numpy as np

from pipeline.core.errors import CannotCalibrateError, ConfigurationError
from pipeline.core.records import (
    BASE,
    BASE_COUNT,
    BASE_NAMES,
    LIMIT,
    NORMAL,
    NOT_ESTIMATED,
    SENSORS,
    Contribution,
    Estimate,
    FittedEffect,
    Index,
    Multiply,
    Noise,
    NoiseParts,
    SensorCalibration,
    StageDetails,
    StageResult,
    Subtract,
    UnitRecordings,
    Values,
    base_values,
)
from pipeline.core.settings import DataSheet, Method, Settings
from pipeline.estimation.engine import ResidualNoise, ScaledColumns, linear_convergence
from pipeline.estimation.gauss_markov import WanderPrior, block_covariance
from pipeline.estimation.known_effects import known_effects, subtracted, with_known, without_known
from pipeline.estimation.multi_position.model import motion_at_rests
from pipeline.estimation.noise import wander_prior
from pipeline.estimation.rest_means import Rests, readings_in, rests_of
from pipeline.estimation.table_errors import type_b
from pipeline.estimation.turns import TurnPart
from pipeline.estimation.uncertainty_budget import (
    GRAVITY,
    TEMPERATURE,
    base_parameters,
    centred,
    combined,
    keep_larger,
    limited_effects,
    scatter_contribution,
)
from pipeline.physics.effects import effect_of

GIVEN, GIVEN_SOURCE = "given", "given calibration"
NOT_WANTED = "not_wanted"  # stage of a sensor whose method is null
MOST_PASSES = 4  # each reduces the error of the known effects by their share of the reading, at most a hundredth
SETTLED = 1e-6  # change of bias, g or deg/s, and matrix in a pass: the known effects change by a hundredth of it
Change: TypeAlias = Literal["readings", "bias", "matrix", "effects"]


@dataclass(frozen=True, kw_only=True)
class FitStage:
    """The declaration of a stage; the stages of one module continue each other.

    A stage that changes the readings states effects with known parameters, from the sensor's section of the settings;
    ``fit_stage`` subtracts them from what all later stages read, and adds them to what these return.
    """

    sensors: tuple[str, ...] = SENSORS
    needs: tuple[Change, ...] = ()  # what an earlier stage must have changed
    changes: tuple[Change, ...] = ()  # what it estimates or corrects
    accepts: tuple[Change, ...] = ()  # changes by stages of other modules that it uses, keeps or estimates anew
    free: bool = False  # estimates each element of bias and matrix freely; else the verdict may blame the method
    reference: bool = False  # the fit with which the diagnosis compares the other methods on a table
    known: Callable[[str, DataSheet], list[FittedEffect]] | None = None  # of a stage that changes the readings


@dataclass(frozen=True)
class StageInput:
    """What a stage gets."""

    sensor: str
    recordings: UnitRecordings  # all of the unit, with the noise of each sensor; a stage uses those of its roles
    previous: SensorCalibration | None  # the result of the stage before; None for the first
    settings: Settings
    stage: str = ""  # its name, for a module of several stages

    @property
    def noise(self) -> Noise | None:
        """The noise of the sensor; None: the recordings do not show it."""
        return self.recordings.noises[self.sensor]

    @property
    def data_sheet(self) -> DataSheet:
        """The figures of the sensor."""
        return self.settings.sensor.of(self.sensor)

    @property
    def prior(self) -> WanderPrior:
        """The bias instability before the fit."""
        return wander_prior(self.noise, self.data_sheet)

    @property
    def stages(self) -> tuple[StageResult, ...]:
        """The results of the stages before."""
        return self.previous.stages if self.previous else ()

    @property
    def rests(self) -> Rests:
        """The rests of the fit; raises ``CannotCalibrateError`` if there is none."""
        found = rests_of(self.sensor, self.recordings.filtered, self.settings.procedure)
        if found is None or found.held_out.all():
            raise CannotCalibrateError(f"no rest of the {self.sensor} was found: record rests")
        return found.select(~found.held_out)


@dataclass(frozen=True, kw_only=True)
class StageOutput:
    """What a free fit of some elements of bias and matrix to rests returns: n equations with p estimated elements.

    ``fit_stage`` makes the calibration of it. The errors of the estimates are those of a least-squares fit with equal
    weights, ``-J^+ D``, with the derivative J of the residuals with respect to the estimates, and their change D by the
    noise of the rests, by elements that are not estimated, or by an effect. So it states covariance, degrees of freedom
    and budget; an element that no stage estimates has the uncertainty of the sensor file's limit; and what effects at
    their limits would change. Raises ``NotObservableError`` if the equations do not determine the estimates.

    The bias of the accelerometer, by the length of gravity at rest:

    >>> def fit(task: StageInput) -> StageOutput:
    ...     rests, g, bias = task.rests, task.settings.table.gravity_g, np.zeros(3)
    ...     for _ in range(10):  # Gauss-Newton
    ...         force = rests.reading - bias
    ...         length = np.linalg.norm(force, axis=1, keepdims=True)
    ...         residual, direction = length[:, 0] - g, force / length
    ...         bias = bias + np.linalg.lstsq(direction, residual)[0]
    ...     return StageOutput(
    ...         estimated=BIAS_NAMES, bias=bias, rests=rests, residual=residual, jacobian=-direction,
    ...         by_reading=direction, by_gravity=np.full(len(residual), -1.0),
    ...     )
    >>> found = fit(task).calibration(task)  # of a simulated unit with the bias 0.05, -0.02, 0.01 g
    >>> np.abs(found.bias - [0.05, -0.02, 0.01]) < found.parameters.expanded_uncertainty[:3]
    array([ True,  True,  True])
    >>> [line.source for line in found.lines]
    ['noise of the readings', 'not determined by the recordings: limit of the sensor file', 'local gravity']
    """

    estimated: Sequence[str]  # names of BASE_NAMES
    bias: Values  # (3,), g or deg/s
    matrix: Values | None = None  # (3, 3); None: that of the stage before
    rests: Rests
    residual: Values  # (n,); g or deg/s, times a weight of mean square 1
    jacobian: Values  # (n, p), of the residuals with respect to the estimated elements
    by_reading: Values  # (n, 3), of the residuals with respect to the mean reading of their rest
    by_gravity: Values | None = None  # (n,), with respect to local gravity, where an equation contains it
    row: Index | None = None  # (n,), rest of each equation; None: each has one
    details: StageDetails = field(default_factory=StageDetails)

    def calibration(self, task: StageInput) -> SensorCalibration:
        """Return the calibration after the stage, with its uncertainty."""
        before = task.previous or SensorCalibration(task.sensor)
        matrix = before.matrix if self.matrix is None else self.matrix
        columns = ScaledColumns.of(self.jacobian)
        columns.require_full_rank(list(self.estimated))
        gain, place = -columns.weights(), before.parameters.places(self.estimated)
        by_element, rest = self._by_element(matrix), np.setdiff1d(np.arange(BASE_COUNT), place)
        known = np.zeros(BASE_COUNT) if task.previous is None else before.parameters.standard_uncertainty[BASE]
        of_others = np.where(known > 0.0, known, limits_of_base(task.data_sheet))[rest]
        noise = self._noise(task, gain, place, np.sum((by_element[:, rest] * of_others) ** 2, axis=1))
        change = np.eye(BASE_COUNT)  # of all elements by errors of those that are not estimated
        change[place] = gain @ by_element
        change[:, place] = 0.0
        lines, missing = [noise], {"temperature": TEMPERATURE}
        if len(kept := rest[known[rest] > 0.0]):
            own = np.asarray(before.parameters.select(kept).covariance)
            covariance = change[:, kept] @ own @ change[:, kept].T
            freedom = np.full(BASE_COUNT, float(before.parameters.degrees_of_freedom[kept].min()))
            lines.append(Contribution("stages before", "A", "Student's t", covariance, freedom))
        if len(left := rest[known[rest] == 0.0]):
            by_limit = change[:, left] * limits_of_base(task.data_sheet)[left]
            remark, freedom = NOT_ESTIMATED + ", ".join(BASE_NAMES[k] for k in left), np.full(BASE_COUNT, np.inf)
            lines.append(Contribution(LIMIT, "B", NORMAL, by_limit @ by_limit.T, freedom, remark=remark))
        u = task.settings.table.gravity_accuracy_g
        if self.by_gravity is not None and u:
            lines.append(type_b(GRAVITY, NORMAL, u, "g", _at_places(place, (gain @ self.by_gravity)[:, None])))
        elif self.by_gravity is not None and u is None:
            missing[GRAVITY] = "table.gravity_accuracy_g is not stated"
        parameters = base_parameters(task.sensor, self.bias, matrix, noise.covariance)
        details = replace(self.details, rests=len(self.rests.time), condition=columns.condition)
        rms = float(np.sqrt(np.mean(self.residual**2)))
        correction = Subtract(self.bias), Multiply(matrix)
        result = StageResult(task.stage, {n: parameters[n] for n in self.estimated}, rms, correction, details)
        convergence = linear_convergence(self.jacobian, self.residual, columns.condition, columns.rank)
        stages, at_limits = (*task.stages, result), self._at_limits(task, gain, place, matrix)
        found = SensorCalibration(task.sensor, self.bias, matrix, stages, convergence=convergence, at_limits=at_limits)
        return combined(found, lines, missing)

    def _by_rest(self, values: Values) -> Values:
        """Return values of the rests, (m, ...), for each equation."""
        return values if self.row is None else np.asarray(values[self.row])

    def _noise(self, task: StageInput, gain: Values, place: Index, variance: Values) -> Contribution:
        """Return the contribution of white noise and bias wander, widened where the residuals are larger.

        ``variance``: (n,), of the residuals by what is not estimated.
        """
        rests, prior = self.rests, task.prior
        white = rests.variance(rests.white if task.noise is None else task.noise.white)
        wander = prior.wander**2 * block_covariance(rests.start, rests.length, prior.time)
        wander = np.where(rests.recording[:, None] == rests.recording, wander, 0.0)
        of_rests = np.eye(len(rests.time)) if self.row is None else np.eye(len(rests.time))[self.row]
        by_source, expected = np.zeros((2, len(gain), len(gain))), variance
        for c in range(3):
            D = self.by_reading[:, c, None] * of_rests
            A = gain @ D
            by_source[0] += A @ np.diag(white[:, c]) @ A.T
            by_source[1] += A @ wander @ A.T
            expected = expected + np.einsum("nm,ml,nl->n", D, np.diag(white[:, c]) + wander, D)
        freedom = len(self.residual) - len(gain)
        of_noise = by_source.sum(axis=0)
        ratio = float(np.sum(self.residual**2) / np.sum(expected)) * len(self.residual) / freedom if freedom else 1.0
        parts = [*by_source, (max(ratio, 1.0) - 1.0) * of_noise]
        u = NoiseParts(*(_at_places(place, np.sqrt(np.diag(part))[:, None])[:, 0] for part in parts))
        covariance = np.zeros((BASE_COUNT, BASE_COUNT))
        covariance[np.ix_(place, place)] = max(ratio, 1.0) * of_noise
        return scatter_contribution(covariance, float(freedom) if freedom else np.inf, u)

    def _by_element(self, matrix: Values) -> Values:
        """Return the derivative of the residuals with respect to bias and matrix, as those of the readings: (n, 12).

        A change e of the bias acts as one of a reading by -e, dM of the matrix by K dM (reading - bias).
        """
        off, K = self._by_rest(self.rests.reading) - self.bias, np.asarray(np.linalg.solve(matrix, np.eye(3)))
        of_matrix = np.einsum("nc,ci,nj->nij", self.by_reading, K, off).reshape(-1, 9)
        return np.concatenate([-self.by_reading, of_matrix], axis=1)

    def _at_limits(self, task: StageInput, gain: Values, place: Index, matrix: Values) -> dict[str, Values]:
        """Return the change of bias and matrix by each effect at its limits: (12, p)."""
        rests, found, force = self.rests, dict[str, Values](), self.rests.reading @ matrix.T
        if task.sensor == "gyroscope":
            of_force = readings_in("accelerometer", task.recordings.filtered, rests)
            # where the attitude is unknown, the most along each axis
            force = np.where(np.isnan(of_force), task.settings.table.gravity_g, of_force)
        motion = centred([motion_at_rests(rests, force)])[0]
        K = np.asarray(np.linalg.solve(matrix, np.eye(3)))
        for this, start, limits in limited_effects(task.sensor, (), task.data_sheet):
            if this.available(motion):
                z = self._by_rest(this.columns(task.sensor, motion, K, start) * limits)
                keep_larger(found, this.name, _at_places(place, gain @ np.einsum("nc,ncp->np", self.by_reading, z)))
        return found


def limits_of_base(data_sheet: DataSheet) -> Values:
    """Return the standard uncertainty of bias and matrix, uniform within the sensor file's limits: (12,) array."""
    matrix = np.where(np.eye(3, dtype=bool), data_sheet.scale_factor, data_sheet.cross_axis)
    return np.asarray(base_values(np.full(3, data_sheet.bias), matrix) / np.sqrt(3.0), np.float64)


def _at_places(place: Index, values: Values) -> Values:
    """Return (p, m) values of some elements of bias and matrix as those of all: (12, m) array."""
    found = np.zeros((BASE_COUNT, values.shape[1]))
    found[place] = values
    return found


FIT_STAGES = {GIVEN: FitStage(changes=("bias", "matrix", "effects")), NOT_WANTED: FitStage()}


@cache
def stage_module(sensor: str, stage: str) -> str:
    """Return the module of a stage."""
    if stage in FIT_STAGES:
        return __name__
    own, of_both = f"pipeline.estimation.{sensor}.{stage}", f"pipeline.estimation.{stage}"
    return next((name for name in (own, of_both) if find_spec(name)), f"pipeline.estimation.{sensor}.staged")


def declared(sensor: str, stage: str) -> FitStage:
    """Return the declaration of a stage; raise ``ConfigurationError`` if there is no such stage of the sensor."""
    found = _declaration(sensor, stage)
    if found is None:
        raise ConfigurationError(
            f"no stage of the {sensor} is called {stage!r}: a stage is a module pipeline/estimation/{stage}.py, or for "
            f"one sensor pipeline/estimation/{sensor}/{stage}.py, with its declaration in FIT_STAGES"
        )
    return found


def _declaration(sensor: str, stage: str) -> FitStage | None:
    found: FitStage | None = getattr(import_module(stage_module(sensor, stage)), "FIT_STAGES", {}).get(stage)
    return found if found is not None and sensor in found.sensors else None


def declarations(calibration: SensorCalibration) -> dict[str, FitStage]:
    """Return the declarations of a calibration's stages by name, in order; a further result, as ``faces``, has none."""
    found = {stage.name: _declaration(calibration.sensor, stage.name) for stage in calibration.stages}
    return {name: stage for name, stage in found.items() if stage is not None}


def last_fit(calibration: SensorCalibration) -> FitStage:
    """Return the declaration of the last stage of a calibration's method, before the stage ``effects``."""
    fits = [stage for name, stage in declarations(calibration).items() if name != "effects"]
    return fits[-1] if fits else FitStage()


def check_stages(sensor: str, stages: Sequence[str]) -> None:
    """Raise ``ConfigurationError`` if a stage, of those in order, lacks what it needs or loses an earlier change."""
    for i, stage in enumerate(stages):
        found, module = declared(sensor, stage), stage_module(sensor, stage)
        if "readings" in found.changes and found.known is None:
            raise ConfigurationError(f"the stage {stage} changes the readings: declare in its FitStage what it knows")
        made = {change for before in stages[:i] for change in declared(sensor, before).changes}
        if lacking := [need for need in found.needs if need not in made]:
            raise ConfigurationError(
                f"the stage {stage} needs {_listed(lacking)} by an earlier stage: put a stage that estimates "
                f"{'it' if len(lacking) == 1 else 'them'} before {stage}"
            )
        for before in stages[:i]:
            lost = [change for change in declared(sensor, before).changes if change not in found.accepts]
            if lost and stage_module(sensor, before) != module:
                problem = f"the stage {stage} cannot follow {before}: it does not honour {_listed(lost)} of {before}"
                raise ConfigurationError(f"{problem}; change their order, or leave one of them out")


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:-1]) + " and " * (len(names) > 1) + names[-1]


def fit_stage(
    sensor: str, stage: str, recordings: UnitRecordings, previous: SensorCalibration | None, settings: Settings
) -> SensorCalibration:
    """Run a stage on the result of the stage before.

    Raises ``CannotCalibrateError`` if the sensor's method is null, ``ConfigurationError`` as of ``check_stages``.
    """
    if stage == NOT_WANTED:
        raise CannotCalibrateError(f"method.{sensor} is null: the configuration leaves this sensor uncalibrated")
    if stage == GIVEN:
        return given_calibration(sensor, settings.method)
    check_stages(sensor, [*declarations(previous), stage] if previous else [stage])
    known = known_effects(sensor, settings.method)
    if declared(sensor, stage).known:
        parameters = {f"{e.name}.{n}": Estimate(p.value, p.unit) for e in known for n, p in e.parameters.items()}
        return SensorCalibration(sensor, effects=known, stages=(StageResult(stage, parameters),))
    for other in SENSORS:
        if other != sensor and (of_other := known_effects(other, settings.method)):
            filtered = subtracted(recordings.filtered, SensorCalibration(other), of_other, ("rests",))
            recordings = replace(recordings, filtered=filtered)
    fit = import_module(stage_module(sensor, stage)).fit
    task = StageInput(sensor, recordings, previous, settings, stage)
    return _fit_to_corrected(fit, task, previous, known) if known and previous is not None else _fitted(fit, task)


def _fitted(fit: Callable[[StageInput], SensorCalibration | StageOutput], task: StageInput) -> SensorCalibration:
    found = fit(task)
    return found.calibration(task) if isinstance(found, StageOutput) else found


def _fit_to_corrected(
    fit: Callable[[StageInput], SensorCalibration | StageOutput],
    task: StageInput,
    previous: SensorCalibration,
    known: Sequence[FittedEffect],
) -> SensorCalibration:
    """Return the fit to the readings less the known effects, which depend on bias and matrix, with these effects."""
    sensor, recordings, stages = task.sensor, task.recordings, declarations(previous)
    held = [s for s in previous.stages if s.name in stages and stages[s.name].known]
    before = without_known(previous, known)
    before = replace(before, stages=tuple(s for s in previous.stages if s not in held))
    at = before
    for _ in range(MOST_PASSES):
        filtered = replace(recordings, filtered=subtracted(recordings.filtered, at, known, (sensor, "rests")))
        found = _fitted(fit, replace(task, recordings=filtered, previous=before if before.stages else None))
        if found is before:  # nothing to fit
            return previous
        change = max(np.abs(found.bias - at.bias).max(), np.abs(found.matrix - at.matrix).max())
        at = found
        if change <= SETTLED:
            break
    return with_known(at, known, held)


def is_given(sensor: str, method: Method) -> bool:
    """Return whether the calibration of a sensor is given, and not fitted."""
    return method.given is not None and sensor in method.given


def given_calibration(sensor: str, method: Method) -> SensorCalibration:
    """Return the given calibration of a sensor from the configuration (``method.given``).

    Effects of mounting, place, table and timing belong to the bench of that calibration: they are not used, and the
    stage lists them. Raises ``CannotCalibrateError`` if the file has no calibration of the sensor.
    """
    given = method.given
    assert given is not None  # noqa: S101  (``is_given``)
    part, source = given[sensor], given["source"]
    if part is None:
        raise CannotCalibrateError(f"the given calibration {source} holds nothing of the {sensor}")
    found = SensorCalibration.from_json(sensor, part)
    found = replace(found, effects=tuple(_in_order(effect, sensor) for effect in found.effects))
    bench = part["of_the_bench"]
    every = found.parameters
    kept = every.select(every.places([name for name in every.names if name.partition(".")[0] not in bench]))
    parameters = base_parameters(sensor, found.bias, found.matrix, kept.covariance[BASE, BASE])
    details = StageDetails(source=source, sha256=given["sha256"], notes=given["notes"], left_out=bench)
    stage = StageResult(GIVEN, parameters, details=details)
    effects = tuple(e for e in found.effects if e.name not in bench)
    calibration = SensorCalibration(sensor, found.bias, found.matrix, effects=effects, stages=(stage,))
    if not part["uncertain"]:
        return combined(calibration, [], unknown_uncertainty(sensor, method))
    freedom = np.full(len(kept), np.inf) if found.freedom is None else kept.degrees_of_freedom
    line = Contribution(GIVEN_SOURCE, "B", NORMAL, kept.covariance, freedom, remark=f"as {source} states it")
    return combined(calibration, [line], {})


def _in_order(fitted: FittedEffect, sensor: str) -> FittedEffect:
    """Return an effect with its parameters in their order; settings are stored in that of the names."""
    names = [parameter.name for parameter in effect_of(fitted).parameters(sensor)]
    return replace(fitted, parameters={name: fitted.parameters[name] for name in names})


def unknown_uncertainty(sensor: str, method: Method) -> dict[str, str]:
    """Return the entry of a budget for a given calibration whose file states no uncertainty; else empty."""
    given = method.given
    if given is None or not given.get(sensor) or given[sensor]["uncertain"]:
        return {}
    return {GIVEN_SOURCE: f"{given['source']} states no uncertainty: none is known, and zeros stand for it"}


def details_on_table(
    noise: ResidualNoise, freedom: Values, parts: Sequence[TurnPart], used: int, condition: float | None = None
) -> StageDetails:
    """Return the details of a fit to samples of a table's turns; ``used``: number of samples."""
    return StageDetails(
        samples_used=used,
        samples_left_out=sum(part.recording.samples for part in parts) - used,
        condition=condition,
        white_noise=noise.white.tolist(),
        bias_wander=noise.wander.tolist(),
        degrees_of_freedom=float(freedom.min()),
    )
