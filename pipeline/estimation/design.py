"""Build the design matrix of base and effects, a linear problem in the measurement direction.

    y_c = b_c + K_c . u + sum over effects z_c(p) + noise,    c = x, y, z

where b is the bias, K_c row c of the inverse of the calibration matrix, u the truth by the table. The layout of an
effect (``Layout``) states which columns are for one axis and which all axes share. Each column is built once:

    A = [1, u, every-axis regressors | y_x, its columns and shared ones | y_y, ... | y_z, ...]

so that ``A^T A`` contains all products of the 3 n rows.

The errors e of the angle at the stops of the table (``pipeline.estimation.table_errors``) are additional parameters
with the prior ``N(0, u^2)``. With their columns T, scaled by u, they are eliminated from all products:

    A^T C^-1 A - A^T C^-1 T (1 + T^T C^-1 T)^-1 T^T C^-1 A
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, partial, reduce
from itertools import groupby, pairwise
from typing import Any, TypeAlias

import numpy as np

from pipeline.core.errors import InputError, NotObservableError
from pipeline.core.records import BASE_COUNT, DEFERRED, MATRIX_ROWS, Index, Motion, Noise, Values, motion_at_rest
from pipeline.estimation.engine import LinearMap, ScaledColumns, scaled_inverse
from pipeline.estimation.gauss_markov import Products, Setting
from pipeline.estimation.observations import Observations, RecordingRows, without_rows
from pipeline.estimation.table_errors import StopErrors, errors_of_stops
from pipeline.physics.effects.base import Effect, Layout, truth
from pipeline.physics.effects.formula_effect import FormulaEffect

REMEMBERED = 4  # motions of a part after effects of timing: of the base, and of terms without their own effect
# singular value of unit columns that is determined; share of its vector
MIN_DESIGN_SINGULAR_VALUE, PART_OF_IT = 1e-3, 0.1
MOTION_FIELDS = (  # fields of ``Motion`` on which formulas depend
    "time", "specific_force", "angular_rate", "angular_acceleration", "temperature", "angle", "rate", "level",
    "direction", "temperature_rate",
)  # fmt: skip
JoinedMotions: TypeAlias = "list[tuple[Motion, list[Motion]]]"  # one for several recordings, and those that it joins


@dataclass(frozen=True)
class NormalPrior:
    """The normal prior of an effect's p parameters: ``N(mean, precision^-1)``."""

    mean: Values  # (p,)
    precision: Values  # (p, p)


@dataclass(frozen=True)
class EffectColumns:
    """The columns of an effect at given values of its parameters."""

    effect: Effect
    values: Values  # (p,); at which its derivatives are taken
    full: bool = False  # whether the nonlinear parameters have columns, too
    prior: NormalPrior | None = None  # of the parameters; None: flat

    @property
    def key(self) -> tuple[Hashable, ...]:
        """What the columns and the prior follow from, for the observations of one unit."""
        prior = self.prior and (self.prior.mean.tobytes(), self.prior.precision.tobytes())
        # two formulas of a search may have one name
        what = self.effect if isinstance(self.effect, FormulaEffect) else self.effect.name
        return what, self.values.tobytes(), self.full, prior

    def layout(self) -> Layout:
        """Return the layout of the effect's columns."""
        return Layout.SHARED if self.full else self.effect.layout

    def regressors(self, sensor: str, motion: Motion, K: Values, everything: Motion | None = None) -> Values:
        """Return the columns in the shape of the layout; ``everything``: the motion after all effects of timing."""
        if everything is not None and self.effect.moves and np.any(self.values):
            slope = self.effect.slope(sensor, everything, self.values)
            if slope is not None:
                return (slope @ K.T)[:, :, None]
        of = self.effect.columns if self.full else self.effect.regressors
        return of(sensor, motion, K, self.values)

    def columns(self, sensor: str, motion: Motion, K: Values) -> Values:
        """Return the columns of all parameters: (n, 3, p) array."""
        return self.effect.columns(sensor, motion, K, self.values)


Terms: TypeAlias = Sequence[EffectColumns]


def placed(terms: Terms, base: int = BASE_COUNT) -> dict[str, tuple[EffectColumns, slice]]:
    """Return each term and the slice of its parameters, which follow ``base`` parameters, by the effect's name."""
    edges = np.cumsum([base, *(len(term.values) for term in terms)]).tolist()
    return {t.effect.name: (t, slice(*edge)) for t, edge in zip(terms, pairwise(edges), strict=True)}


def stepped(terms: Terms, step: Values) -> tuple[list[EffectColumns], Values]:
    """Return terms after a step of their parameters, and the step taken, which effects may limit."""
    moved = [replace(t, values=t.effect.stepped(t.values, step[at])) for t, at in placed(terms, 0).values()]
    taken = [new.values - old.values for new, old in zip(moved, terms, strict=True)]
    return moved, np.concatenate([np.zeros(0), *taken])


def true_motion(part: RecordingRows, terms: Terms, but: Effect | None = None) -> Motion:
    """Return the true motion of the sensor at the timestamps, with all effects of timing except ``but``."""
    movers = [term for term in terms if term.effect.moves and term.effect is not but and np.any(term.values)]
    if not movers:
        return part.motion
    key = tuple((term.effect.name, term.values.tobytes()) for term in movers)
    if key not in part.moved:
        while len(part.moved) >= REMEMBERED:
            part.moved.pop(next(iter(part.moved)))
        part.moved[key] = reduce(lambda motion, term: term.effect.moved(motion, term.values), movers, part.motion)
    return part.moved[key]


def without_unknown_motion(observations: Observations, terms: Terms) -> Observations:
    """Remove the rows that effects of timing shift to times of unknown motion; without any, return the same object."""
    known = [true_motion(part, terms).reference_valid for part in observations.parts]
    if all(mask is None or mask.all() for mask in known):
        return observations
    lost = [np.zeros(len(p.weight), bool) if m is None else ~m for p, m in zip(observations.parts, known, strict=True)]
    return without_rows(observations, lost)


def motions_of(part: RecordingRows, terms: Terms) -> list[Motion]:
    """Return the motion on which each term acts, and last the motion of the base.

    A term with a slope by the motion of the base gets that.
    """
    if not any(term.effect.moves and np.any(term.values) for term in terms):
        return [part.motion] * (len(terms) + 1)
    everything = true_motion(part, terms)
    acting = [t.effect if t.effect.moves and np.any(t.values) and not t.effect.has_slope else None for t in terms]
    return [*(everything if own is None else true_motion(part, terms, own) for own in acting), everything]


def joined_motions(motions: Sequence[Motion]) -> JoinedMotions:
    """Return the motions of successive recordings that hold the same signals as one, each with those that it joins."""
    joined = []
    for held, group in groupby(motions, lambda motion: [name for name in MOTION_FIELDS if motion.has(name)]):
        members = list(group)
        if "direction" not in held:  # it is computed from the whole motion
            joined += [(each, [each]) for each in members]
            continue
        signals: dict[str, Any] = {name: partial(_joined, members, name) for name in held}
        now = {name: signals[name]() for name in held if name not in DEFERRED}
        joined.append((motion_at_rest(now["time"]).changed(**signals | now), members))
    return joined


def _joined(motions: Sequence[Motion], name: str) -> Values:
    return np.concatenate([getattr(motion, name) for motion in motions])


def columns_of_samples(term: EffectColumns, sensor: str, joined: JoinedMotions, K: Values) -> Values:
    """Return the columns of a term whose regressors at a sample depend on the motion there alone."""
    columns = []
    for motion, members in joined:
        try:
            columns.append(term.regressors(sensor, motion, K))
        except InputError:  # of one recording, which the error has to name
            columns += [term.regressors(sensor, each, K) for each in members]
    return np.concatenate(columns)


@dataclass(frozen=True)
class Start:
    """The start of a fit: the base by ordinary least squares, or another fit."""

    bias: Values  # (3,)
    K: Values  # (3, 3)
    scale: Values  # (3,); white noise of each axis, for the weights between the axes
    terms: tuple[EffectColumns, ...] = ()  # the effects at their values

    @property
    def key(self) -> tuple[Hashable, ...]:
        """What a fit from here follows from."""
        return self.bias.tobytes(), self.K.tobytes(), self.scale.tobytes(), *(term.key for term in self.terms)


def ordinary_base(observations: Observations, noise: Noise | None) -> Start:
    """Fit bias and matrix by ordinary least squares.

    Raises ``NotObservableError`` if the motion does not determine them.
    """
    if not observations.parts:
        raise NotObservableError(
            f"no recording holds the {observations.sensor} together with the motion of a table; "
            "effects are fitted against a reference: record table_angle_deg or the table's attitude"
        )
    u = np.concatenate([truth(observations.sensor, part.motion) for part in observations.parts])
    root = np.sqrt(observations.weight)[:, None]
    X, y = root * np.column_stack([np.ones(len(u)), u]), root * observations.reading
    factors = ScaledColumns.of(X, MIN_DESIGN_SINGULAR_VALUE)
    weak = factors.undetermined(["bias", *(f"column {b} of the matrix" for b in "xyz")], PART_OF_IT)
    if weak:
        named = [name for name in weak if name != "bias"]
        raise NotObservableError(
            f"the recordings of the {observations.sensor} do not determine {', '.join(named or weak)}: "
            "the table's motion must excite all three axes; record turns about each of them"
        )
    beta = factors.solve(y)
    residual = y - X @ beta
    scale = np.sqrt((np.sum(residual**2, axis=0) + observations.scatter) / max(observations.samples - 4.0, 1.0))
    if noise is not None and np.all(np.isfinite(noise.white)) and np.all(noise.white > 0):
        scale = noise.white
    largest = max(float(scale.max()), float(np.abs(observations.reading).max()) * 1e-12, 1e-300)
    return Start(beta[0], beta[1:].T, np.maximum(scale, 1e-6 * largest))


def _norms(weight: Values, columns: Values) -> Values:
    return np.asarray(np.sqrt(np.einsum("i,ij,ij->j", weight, columns, columns)))


class Design:
    """Products of base, terms and readings under noise settings.

    ``scale``: (3,), white noise of each axis. ``target``: (n, 3), values to explain; None: the readings. ``base``: (n,
    3), regressors of K; None: the truth. ``project``: project the base out of the other columns first, so that products
    lose no digits.
    """

    def __init__(
        self,
        observations: Observations,
        terms: Terms,
        K: Values,
        scale: Values,
        *,
        target: Values | None = None,
        base: Values | None = None,
        project: bool = False,
    ) -> None:
        self.scale = scale
        self._place(observations.sensor, terms)
        self._priors = [(at, t, t.prior) for at, t in zip(self.slices, terms, strict=True) if t.prior]
        weight = observations.weight
        A = np.ones((len(weight), self._width))
        A[:, self._readings] = observations.reading if target is None else target
        self._fill(A, observations, terms, K)
        if base is not None:
            A[:, 1:4] = base
        self.size = _norms(weight, A)
        if project:
            root = np.sqrt(weight)[:, None]
            Q, R = np.linalg.qr(root * A[:, :4])
            inner = Q.T @ (root * A[:, 4:])
            A[:, 4:] -= A[:, :4] @ np.linalg.solve(R, inner)
        self.columns = Products(observations.blocks, weight, A)
        self._changes = self._by_stops(observations, terms, K) if observations.angle_deg > 0.0 else None
        self._from = [np.add.outer(at * self._width, at).ravel() for at in self._local]
        self._to = [np.add.outer(index * (self.count + 1), index).ravel() for index in self._total]

    def reweighted(self, observations: Observations) -> Design:
        """Return the design of the same rows with other weights."""
        found, blocks, weight = copy(self), observations.blocks, observations.weight
        found.columns = Products(blocks, weight, self.columns.columns)
        found.__dict__.pop("_stops", None)
        found.size = _norms(weight, self.columns.columns)
        return found

    def _by_stops(self, observations: Observations, terms: Terms, K: Values) -> tuple[Values, Values, Index, int]:
        """Return what errors of the angle of unit variance change, over the noise (``StopErrors``)."""
        motions = [true_motion(part, terms) for part in observations.parts]
        before, after, stop, last = errors_of_stops(observations.sensor, motions, K)
        unit = observations.angle_deg / self.scale
        return unit * before, unit * after, stop, last + 1

    @cached_property
    def _stops(self) -> tuple[StopErrors, Values] | None:
        """The errors of the angle at the stops, and the sums of the columns over them; None if noise hides them."""
        if self._changes is None:
            return None
        found = StopErrors(self.columns, *self._changes)
        return found, found.sums(self.scale, [*map(self.places, range(3))], self.count + 1)

    def _place(self, sensor: str, terms: Terms) -> None:
        """Assign to each axis its columns of A, and the parameter of each column."""
        local: list[list[int]] = [[0, 1, 2, 3] for _ in range(3)]
        total: list[list[int]] = [[c, *range(row.start, row.stop)] for c, row in enumerate(MATRIX_ROWS)]
        self.slices: list[slice] = []
        self._columns: list[list[slice]] = []
        width, parameters = 4, BASE_COUNT
        for term in terms:
            layout = term.layout()
            shared, count = layout == Layout.SHARED, len(term.effect.parameters(sensor))
            count -= 0 if shared else len(term.effect.nonlinear)
            each = count if shared else count // 3
            places = []
            for c in range(3):
                places.append(slice(width, width + each))
                local[c] += range(width, width + each)
                offset = parameters if shared else parameters + c * each
                total[c] += range(offset, offset + each)
                if layout != Layout.EVERY_AXIS or c == 2:
                    width += each
            self._columns.append(places)
            self.slices.append(slice(parameters, parameters + count))
            parameters += count
        self._readings = [width, width + 1, width + 2]
        self._local = [np.array([*index, width + c]) for c, index in enumerate(local)]
        self._total = [np.array([*index, parameters]) for index in total]
        self.count, self._width = parameters, width + 3

    def _fill(self, A: Values, observations: Observations, terms: Terms, K: Values) -> None:
        """Write the columns of base and terms; the first column is 1 already."""
        sensor = observations.sensor
        known: dict[tuple[int, ...], JoinedMotions] = {}
        *of_terms, everything = zip(*(motions_of(part, terms) for part in observations.parts), strict=True)
        A[:, 1:4] = np.concatenate([truth(sensor, motion) for motion in everything])
        for term, motions, places in zip(terms, of_terms, self._columns, strict=True):
            if not term.effect.of_samples:
                pairs = zip(motions, everything, strict=True)
                columns = np.concatenate([term.regressors(sensor, motion, K, every) for motion, every in pairs])
            else:
                key = tuple(map(id, motions))
                known[key] = known.get(key) or joined_motions(motions)
                columns = columns_of_samples(term, sensor, known[key], K)
            A[:, places[0].start : places[2].stop] = columns.reshape(len(columns), -1)  # x, y, z follow each other

    def of_axis(self, c: int) -> Values:
        """Return the columns of one axis, the readings last: (n, q + 1) array."""
        return self.columns.columns[:, self._local[c]]

    def left(self, step: Values) -> Values:
        """Return what a step of the parameters, (p,), leaves of the readings: (n, 3) array."""
        of_axes = ((self.of_axis(c), self.places(c)[1][:-1]) for c in range(3))
        return np.stack([columns[:, -1] - columns[:, :-1] @ step[places] for columns, places in of_axes], axis=1)

    def places(self, c: int) -> tuple[Index, Index]:
        """Return the indices of the columns of one axis in A, and their parameters; the readings last."""
        return self._local[c], self._total[c]

    def products(self, settings: Sequence[Setting]) -> tuple[Values, Values]:
        """Return all products of parameters' columns and, last, the readings, (g, p + 1, p + 1); and log det C, (g,).

        The priors are added, and errors of the angle are eliminated. ``log det C`` lacks a constant.
        """
        if self._stops:
            stops, sums = self._stops
            square, logarithms = stops.products(settings, self._of_axes(self.columns.white[None])[0], sums)
        else:
            of_columns, of_one = self.columns.products(settings)
            square, logarithms = self._of_axes(of_columns), 3.0 * of_one
        last = self.count
        for at, term, prior in self._priors:  # as readings of the parameters themselves
            rest = prior.mean - term.values
            square[:, at, at] += prior.precision
            square[:, at, last] += prior.precision @ rest
            square[:, last, at] += prior.precision @ rest
            square[:, last, last] += rest @ prior.precision @ rest
        return square, logarithms

    def _of_axes(self, of_columns: Values) -> Values:
        """Return the sum of the axes' products, (g, p + 1, p + 1), by those of all columns, (g, q, q)."""
        of_columns, count = of_columns.reshape(len(of_columns), -1), self.count + 1
        total = np.zeros((len(of_columns), count**2))
        for to, at, scale in zip(self._to, self._from, self.scale, strict=True):
            total[:, to] += of_columns.take(at, 1) / scale**2
        return total.reshape(-1, count, count)

    def linear_map(self, setting: Setting) -> LinearMap:
        """Return the linear map from small changes of the readings to the parameters, under a noise setting."""
        inverse, weights, derivative = self._inverse(setting), [], []
        if self._stops:  # they couple the axes
            stops, sums = self._stops
            for c, explained in enumerate(stops.explained(setting, sums[:, :-1])):
                own = self.of_axis(c)[:, :-1] / self.scale[c]
                explained[:, self._total[c][:-1]] -= self.columns.weight[:, None] * own
                weights.append(explained.T / -self.scale[c])
            return LinearMap(tuple(weights), (inverse,) * 3)
        influence = self.columns.influence(setting)
        for local, total, scale in zip(self._local, self._total, self.scale, strict=True):
            weights.append(influence[local[:-1]])  # without the readings, which are last
            derivative.append(inverse[:, total[:-1]] / scale**2)
        return LinearMap(tuple(weights), tuple(derivative))

    def prior_covariances(self, setting: Setting) -> dict[str, Values]:
        """Return the contribution of each effect's prior to the covariance of the parameters: (p, p) arrays."""
        inverse = self._inverse(setting)
        return {t.effect.name: inverse[:, at] @ prior.precision @ inverse[at] for at, t, prior in self._priors}

    def _inverse(self, setting: Setting) -> Values:
        """Return the inverse of the products of the parameters' columns: (p, p) array."""
        return scaled_inverse(self.products([setting])[0][0, :-1, :-1])

    def sizes(self) -> Values:
        """Return the norm of each parameter's column before the projection: (p + 1,) array."""
        squares = np.zeros(self.count + 1)
        for c in range(3):
            local, total = self.places(c)
            squares[total] += (self.size[local] / self.scale[c]) ** 2  # each index once
        return np.sqrt(squares)
