"""Build the design matrix of base and effects, a linear problem in the measurement direction.

    y_c = b_c + K_c . u + sum over effects z_c(p) + noise,    c = x, y, z

where b is the bias, K_c row c of the inverse of the calibration matrix, u the truth by the table. The layout of an
effect (``Layout``) states which columns are for one axis and which all axes share; each column is built once:

    A = [1, u, every-axis regressors | y_x, its columns and shared ones | y_y, ... | y_z, ...]

so that ``A^T A`` contains all products of the 3 n rows.

The errors e of the angle at the stops of the table (``pipeline.estimation.table_errors``) are additional parameters
with the prior ``N(0, u^2)``. With their columns T, scaled by u, they are eliminated from all products:

    A^T C^-1 A - A^T C^-1 T (1 + T^T C^-1 T)^-1 T^T C^-1 A
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import NotObservableError
from pipeline.estimation.engine import LinearMap, scaled_inverse
from pipeline.estimation.gauss_markov import Products, Setting
from pipeline.estimation.least_squares import ScaledColumns
from pipeline.estimation.observations import without_rows
from pipeline.estimation.table_errors import errors_of_stops
from pipeline.model.effects.base import Effect, Layout, truth

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.estimation.observations import Observations, Part
    from pipeline.records import Index, Motion, Noise, Values

BASE = 12  # bias and matrix
REMEMBERED = 4  # motions of a part after effects of timing: base and as many terms without themselves
WEAKEST_DIRECTION, PART_OF_IT = 1e-3, 0.1  # share of unit columns that counts as determined; of such a direction
BASE_NAMES = [f"bias_{a}" for a in "xyz"] + [f"matrix_{a}{b}" for a in "xyz" for b in "xyz"]


@dataclass(frozen=True)
class NormalPrior:
    """The normal prior of an effect's p parameters: ``N(mean, precision^-1)``."""

    mean: Values  # (p,)
    precision: Values  # (p, p)


@dataclass(frozen=True)
class Term:
    """The columns of an effect at given values of its parameters."""

    effect: Effect
    values: Values  # (p,); where its derivative is taken
    full: bool = False  # whether the columns of its nonlinear parameters are among them
    prior: NormalPrior | None = None  # of the parameters; None: flat

    def layout(self) -> Layout:
        """Return the layout of the effect's columns."""
        return Layout.SHARED if self.full else self.effect.layout

    def regressors(self, sensor: str, motion: Motion, K: Values, everything: Motion | None = None) -> Values:
        """Return the columns in the shape of the layout; ``everything``: the motion after all effects of timing."""
        if everything is not None and self.effect.moves and np.any(self.values):
            slope = self.effect.slope(sensor, everything)
            if slope is not None:
                return (slope @ K.T)[:, :, None]
        of = self.effect.columns if self.full else self.effect.regressors
        return of(sensor, motion, K, self.values)


def placed(terms: Sequence[Term], base: int = BASE) -> dict[str, tuple[Term, slice]]:
    """Return each term and the slice of its parameters, which follow ``base`` parameters, by the effect's name."""
    edges = np.cumsum([base, *(len(term.values) for term in terms)]).tolist()
    return {t.effect.name: (t, slice(*edge)) for t, edge in zip(terms, pairwise(edges), strict=True)}


def stepped(terms: Sequence[Term], step: Values) -> tuple[list[Term], Values]:
    """Return terms after a step of their parameters, and the step taken, which effects may limit."""
    moved = [replace(t, values=t.effect.stepped(t.values, step[at])) for t, at in placed(terms, 0).values()]
    taken = [new.values - old.values for new, old in zip(moved, terms, strict=True)]
    return moved, np.concatenate([np.zeros(0), *taken])


def true_motion(part: Part, terms: Sequence[Term], but: Effect | None = None) -> Motion:
    """Return the true motion of the sensor at the time stamps, with all effects of timing except ``but``."""
    movers = [term for term in terms if term.effect.moves and term.effect is not but and np.any(term.values)]
    if not movers:
        return part.motion
    key = tuple((term.effect.name, term.values.tobytes()) for term in movers)
    if key not in part.moved:
        motion = part.motion
        for term in movers:
            motion = term.effect.moved(motion, term.values)
        while len(part.moved) >= REMEMBERED:
            part.moved.pop(next(iter(part.moved)))
        part.moved[key] = motion
    return part.moved[key]


def without_unknown_motion(observations: Observations, terms: Sequence[Term]) -> Observations:
    """Remove the rows that effects of timing move to times with unknown motion; return the same object if none are."""
    known = [true_motion(part, terms).reference_valid for part in observations.parts]
    if all(mask is None or mask.all() for mask in known):
        return observations
    lost = [np.zeros(len(p.weight), bool) if m is None else ~m for p, m in zip(observations.parts, known, strict=True)]
    return without_rows(observations, lost)


def motions_of(part: Part, terms: Sequence[Term]) -> list[Motion]:
    """Return the motion on which each term acts, and last the motion of the base."""
    everything = true_motion(part, terms)
    moves = [term.effect.moves and bool(np.any(term.values)) for term in terms]
    acted = [
        true_motion(part, terms, term.effect) if move else everything for term, move in zip(terms, moves, strict=True)
    ]
    return [*acted, everything]


@dataclass(frozen=True)
class Start:
    """The start of a fit: the base by ordinary least squares, or another fit."""

    bias: Values  # (3,)
    K: Values  # (3, 3)
    scale: Values  # (3,); white noise of each axis, for the weights between the axes
    terms: tuple[Term, ...] = ()  # the effects at their values


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
    factors = ScaledColumns.of(X, WEAKEST_DIRECTION)
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


class Design:
    """Products of base, terms and readings under noise settings.

    ``scale``: (3,). ``target``: (n, 3), values to explain; None: the readings. ``project``: project the base out of the
    other columns first, so that products lose no digits. ``base``: (n, 3), regressors of K instead of the truth.
    """

    def __init__(
        self,
        observations: Observations,
        terms: Sequence[Term],
        K: Values,
        scale: Values,
        *,
        target: Values | None = None,
        base: Values | None = None,
        project: bool = False,
    ) -> None:
        self.scale = scale
        self._place(observations.sensor, terms)
        self._priors = [(at, t) for at, t in zip(self.slices, terms, strict=True) if t.prior]
        weight = observations.weight
        A = np.zeros((len(weight), self._width))
        A[:, self._readings] = observations.reading if target is None else target
        row = 0
        for part in observations.parts:
            rows = slice(row, row + len(part.weight))
            self._fill(A[rows], observations.sensor, part, terms, K)
            row = rows.stop
        if base is not None:
            A[:, 1:4] = base
        self.size = np.sqrt(np.einsum("i,ij,ij->j", weight, A, A))
        if project:
            root = np.sqrt(weight)[:, None]
            Q, R = np.linalg.qr(root * A[:, :4])
            inner = Q.T @ (root * A[:, 4:])
            A[:, 4:] -= A[:, :4] @ np.linalg.solve(R, inner)
        self.columns = Products(observations.blocks, weight, A)
        self.stops, self._own, self._at = 0, [self.columns] * 3, list(self._local)
        if observations.angle_deg > 0.0:
            self._add_stops(observations, terms, K)
        width, count = self._own[0].columns.shape[1], self.count + 1 + self.stops
        self._from = [np.add.outer(at * width, at).ravel() for at in self._at]
        self._to = [np.add.outer(index * count, index).ravel() for index in self._total]

    def _add_stops(self, observations: Observations, terms: Sequence[Term], K: Values) -> None:
        """Add the errors of the angle, as parameters after the readings, with separate columns for each axis."""
        motions = [true_motion(part, terms) for part in observations.parts]
        before, after, group, last = errors_of_stops(observations.sensor, motions, K)
        self.stops = last + 1
        A, rows, blocks = self.columns.columns, np.arange(len(group)), observations.blocks
        for c in range(3):
            T = np.zeros((len(rows), self.stops))
            T[rows, group] = observations.angle_deg * before[:, c]
            T[rows, group + 1] = observations.angle_deg * after[:, c]
            self._own[c] = Products(blocks, observations.weight, np.hstack([A[:, self._local[c]], T]))
            self._total[c] = np.append(self._total[c], self.count + 1 + np.arange(self.stops))
            self._at[c] = np.arange(len(self._total[c]))

    def _place(self, sensor: str, terms: Sequence[Term]) -> None:
        """Assign to each axis its columns of A, and the parameter of each column."""
        local: list[list[int]] = [[0, 1, 2, 3] for _ in range(3)]
        total: list[list[int]] = [[c, 3 + 3 * c, 4 + 3 * c, 5 + 3 * c] for c in range(3)]
        self.slices: list[slice] = []
        self._columns: list[list[slice]] = []
        width, parameters = 4, BASE
        for term in terms:
            layout = term.layout()
            count = len(term.effect.parameters(sensor))
            if layout != Layout.SHARED:
                count -= len(term.effect.nonlinear)
            each = count if layout == Layout.SHARED else count // 3
            places = []
            for c in range(3):
                places.append(slice(width, width + each))
                local[c] += range(width, width + each)
                offset = parameters if layout == Layout.SHARED else parameters + c * each
                total[c] += range(offset, offset + each)
                if layout != Layout.EVERY_AXIS or c == 2:
                    width += each
            self._columns.append(places)
            self.slices.append(slice(parameters, parameters + count))
            parameters += count
        self._readings = [width, width + 1, width + 2]
        for c in range(3):
            local[c].append(width + c)
            total[c].append(parameters)
        self.count = parameters
        self._width = width + 3
        self._local = [np.array(index) for index in local]
        self._total = [np.array(index) for index in total]

    def _fill(self, A: Values, sensor: str, part: Part, terms: Sequence[Term], K: Values) -> None:
        *motions, everything = motions_of(part, terms)
        A[:, 0] = 1.0
        A[:, 1:4] = truth(sensor, everything)
        for term, motion, places in zip(terms, motions, self._columns, strict=True):
            regressors = term.regressors(sensor, motion, K, everything)
            if term.layout() == Layout.EVERY_AXIS:
                A[:, places[0]] = regressors
            else:
                for c in range(3):
                    A[:, places[c]] = regressors[:, c]

    def of_axis(self, c: int) -> Values:
        """Return the columns of one axis, the readings last: (n, q + 1) array."""
        return self.columns.columns[:, self._local[c]]

    def places(self, c: int) -> tuple[Index, Index]:
        """Return the indices of the columns of one axis in A, and their parameters; the readings last."""
        return self._local[c], self._total[c][: len(self._local[c])]

    def products(self, settings: Sequence[Setting]) -> tuple[Values, Values]:
        """Return all products of parameters' columns and, last, the readings, (g, p + 1, p + 1); and log det C, (g,).

        The priors are added, and errors of the angle are eliminated. The determinant has an unknown constant factor.
        """
        whole, logarithms = self._with_stops(settings)
        if not self.stops:
            return whole, logarithms
        p = self.count + 1
        cross, inner = whole[:, p:, :p], whole[:, p:, p:]
        left = whole[:, :p, :p] - cross.transpose(0, 2, 1) @ np.linalg.solve(inner, cross)
        return left, logarithms + np.linalg.slogdet(inner)[1]

    def _with_stops(self, settings: Sequence[Setting]) -> tuple[Values, Values]:
        """Return ``products`` with the errors of the angle as the last parameters."""
        count = self.count + 1 + self.stops
        total = np.zeros((len(settings), count**2))
        distinct = {id(own): own for own in self._own}  # without stops, one for all axes
        of_settings = {key: own.products(settings) for key, own in distinct.items()}
        for c, own in enumerate(self._own):
            flat = of_settings[id(own)][0].reshape(len(settings), -1)
            total[:, self._to[c]] += flat[:, self._from[c]] / self.scale[c] ** 2
        square = total.reshape(-1, count, count)
        last = self.count
        for at, term in self._priors:  # as readings of the parameters themselves
            prior = term.prior
            assert prior is not None  # noqa: S101
            rest = prior.mean - term.values
            square[:, at, at] += prior.precision
            square[:, at, last] += prior.precision @ rest
            square[:, last, at] += prior.precision @ rest
            square[:, last, last] += rest @ prior.precision @ rest
        of_stops = np.arange(last + 1, count)
        square[:, of_stops, of_stops] += 1.0
        return square, np.sum([of_settings[id(own)][1] for own in self._own], axis=0)

    def linear_map(self, setting: Setting) -> LinearMap:
        """Return the linear map from small changes of the readings to the parameters, under a noise setting."""
        inverse, distinct = self._inverse(setting), {id(own): own for own in self._own}
        influence = {key: own.influence(setting) for key, own in distinct.items()}
        weights, back = [], []
        for own, at, total, scale in zip(self._own, self._at, self._total, self.scale, strict=True):
            free = total != self.count  # the readings lie between parameters and stops
            weights.append(influence[id(own)][at[free]])
            back.append(inverse[: self.count, (total - (total > self.count))[free]] / scale**2)
        return LinearMap((weights[0], weights[1], weights[2]), (back[0], back[1], back[2]))

    def prior_covariances(self, setting: Setting) -> dict[str, Values]:
        """Return the contribution of each effect's prior to the covariance of the parameters: (p, p) arrays."""
        inverse = self._inverse(setting)[: self.count, : self.count]
        return {t.effect.name: inverse[:, at] @ t.prior.precision @ inverse[at] for at, t in self._priors if t.prior}

    def _inverse(self, setting: Setting) -> Values:
        """Return the inverse of the products of the columns of parameters and stops: (q, q) array."""
        gram = self._with_stops([setting])[0][0]
        return scaled_inverse(np.delete(np.delete(gram, self.count, 0), self.count, 1))

    def sizes(self) -> Values:
        """Return the norm of each parameter's column before the projection: (p + 1,) array."""
        squares = np.zeros(self.count + 1)
        for c in range(3):
            local, total = self.places(c)
            squares[total] += (self.size[local] / self.scale[c]) ** 2  # each index once
        return np.sqrt(squares)
