"""Effects that raise the error of readings that a fit leaves out, and so are not offered.

The differences d of the squared errors, with minus without an effect, of n units of exchange (rests, moves, stretches
of turns, pieces of the held-out motion) have

    mean(d) > t sqrt(s(d)^2 / m + v),   m = n (1 - r) / (1 + r)
    mean(d) > 0.02 median(squared error without the effect)

with the one-sided 95 % quantile t of Student's distribution, the correlation r of successive units, and the variance v
of mean(d) by wander of the bias, which is in all of them and lowers the error of the one or the other fit by chance.
Where v is known, r is the effect's own and counts as 0, and t is for all comparisons with fewer effects (Bonferroni).
The others stay selected.

The first test alone refuses one in twenty effects that these readings do not show. Of 26 effects that it refused in
the blind study (seed 4203), three raised the rms by 0.06 to 0.16 %, and were the hidden ones; the others raised it by
0.5 % and more. The second test is a rise of the rms by 1 %, by the median, which a knock in a few units does not raise.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import Self

import numpy as np
import scipy

from pipeline.core.records import Mask, Noise, Values
from pipeline.estimation.gauss_markov import block_covariance
from pipeline.estimation.generalized_least_squares import JointFit, fit_terms
from pipeline.estimation.multi_position.fit import COMPARED_STEP, FitByHand, fit
from pipeline.estimation.multi_position.gyroscope import GyroscopeModel
from pipeline.estimation.multi_position.model import Model
from pipeline.estimation.multi_position.selection import SelectionByHand
from pipeline.estimation.observations import without_rows
from pipeline.estimation.ranking import projection
from pipeline.estimation.selection import Selection

FEWEST_EXCHANGED = 5  # units of exchange that have a scatter
LEAST_RISE = 0.02  # of the median squared error: a smaller one is no harm, see above
MAX_FALSE_HARM, MAX_CORRELATION = 0.05, 0.9  # one-sided; r of successive units, see above
REST_FOLDS = 3  # as every third rest is held out of a published fit (procedure.holdout_every)
TURN_FOLDS, LEFT_OUT_STRETCHES = 5, 20  # a fold leaves out a fifth of every recording, in four stretches
HELD_OUT_PIECES = 20  # of held-out motion: some seconds each
SPARE = 2  # least number of equations beyond the parameters in a fold


def harmful(
    names: Sequence[str], squares: Sequence[Values], what: str, shared: Callable[[int, int], float] | None = None
) -> dict[str, str]:
    """Return the last of the selected effects with which the error rises significantly, with the reason.

    ``squares``: of each unit of exchange, without effects, and with each further one; ``what``: the error, in words;
    ``shared``: returns v above, of two of the squares. An effect may raise the error while another one is missing, so
    that all are compared with fewer.
    """
    found: dict[str, str] = {}
    count = len(names)
    while count:
        known = [(shared(k, count), count) if shared else () for k in range(count)]
        fewer = next((k for k in range(count - 1, -1, -1) if _raises(squares[k], squares[count], *known[k])), None)
        if fewer is None:
            break
        ratio = float(np.sqrt(np.mean(squares[count]) / np.mean(squares[fewer])))
        found |= dict.fromkeys(names[fewer:count], f"it makes the error {what} {ratio:.4g} times as large")
        count = fewer
    return found


def _raises(before: Values, after: Values, shared: float = 0.0, comparisons: int = 1) -> bool:
    """Return whether the mean of the squared errors of units of exchange rises significantly: (n,) arrays in order."""
    change, n = after - before, len(after)
    if n < FEWEST_EXCHANGED or not np.mean(change) > LEAST_RISE * np.median(before):
        return False
    apart = change - np.mean(change)
    r = float(np.clip(apart[1:] @ apart[:-1] / max(float(apart @ apart), 1e-300), 0.0, MAX_CORRELATION))
    m = n if shared else n * (1.0 - r) / (1.0 + r)
    limit = float(scipy.special.stdtrit(max(m - 1.0, 1.0), 1.0 - MAX_FALSE_HARM / comparisons))
    return bool(np.mean(change) > limit * np.sqrt(np.var(change, ddof=1) / m + shared))


@dataclass(frozen=True)
class InPieces:
    """The errors of a calibration in successive pieces of held-out motion."""

    square: Values  # (k,), mean squared error of each piece
    mean: Values  # (k, 3), mean error of the vector, or (k, 1), of the magnitude
    rms: float  # of all samples

    @classmethod
    def of(cls, error: Values) -> Self:
        """Return n errors in pieces: (n, 3) or (n, 1) array."""
        squares = np.einsum("ij,ij->i", error, error)
        mean = [np.full(len(part), 1.0 / len(part)) @ part for part in pieces(error)]
        return cls(np.array([part.mean() for part in pieces(squares)]), np.array(mean), float(np.sqrt(squares.mean())))


def pieces(values: Values) -> list[Values]:
    """Return the values of successive samples, (n, ...), in ``HELD_OUT_PIECES`` parts or, of fewer samples, in n."""
    return np.array_split(values, min(HELD_OUT_PIECES, len(values)))


def harmful_on_held_out(names: Sequence[str], errors: Sequence[InPieces], time: Values, noise: Noise) -> dict[str, str]:
    """Return the effects that raise the error on held-out motion, with the reason; ``time``: (n,), s.

    ``errors``: before effects are added, and with each further one.
    """
    start, end = (np.array([part[k] for part in pieces(time)]) for k in (0, -1))
    correlation = block_covariance(start, end - start, noise.correlation_time)
    variance = noise.wander**2 if errors[0].mean.shape[1] > 1 else np.mean(noise.wander**2)

    def shared(before: int, after: int) -> float:
        """Return the variance of ``2 mean(d^T m)`` by the wander m, with the change d of the calibrated readings."""
        change = 2.0 * (errors[after].mean - errors[before].mean)
        return float(np.sum(change * (correlation @ change) * variance)) / len(start) ** 2

    return harmful(names, [each.square for each in errors], "on held-out motion", shared)


def fits_of(selection: Selection, left_out: Collection[str] = ()) -> list[JointFit]:
    """Return the fits of the base, without some of its effects, and with each further selected effect.

    Those of the search are not fitted again.
    """
    names, fit = selection.names, selection.fit
    known = {} if left_out else {**selection.fits, tuple(names): fit, (): selection.base}
    base, of = [t for t in selection.base.terms if t.effect.name not in left_out], {t.effect.name: t for t in fit.terms}
    terms = [[*base, *(of[name] for name in names[:count])] for count in range(len(names) + 1)]
    steps = [(tuple(names[:count]), each) for count, each in enumerate(terms)]
    return [known.get(k) or fit_terms(selection.observations, each, fit, selection.settings) for k, each in steps]


def harmful_in_turns(selection: Selection, fits: Sequence[JointFit]) -> dict[str, str]:
    """Return the effects that raise the error in stretches of the turns that the fit leaves out, with the reason.

    Each fit is repeated without a fifth of every recording by one step from its values.
    """
    fit = selection.fit
    if not selection.names:
        return {}
    key = harmful_in_turns, *selection.names, fit.bias.tobytes(), fit.K.tobytes()
    return selection.observations.once(key, lambda: _harmful_in_turns(selection, fits))


def _harmful_in_turns(selection: Selection, fits: Sequence[JointFit]) -> dict[str, str]:
    names, observations = selection.names, selection.observations
    stretches = [np.arange(len(part.weight)) * LEFT_OUT_STRETCHES // len(part.weight) for part in observations.parts]
    weight, of_fold = observations.weight, np.concatenate(stretches) % TURN_FOLDS
    label = np.concatenate([k * LEFT_OUT_STRETCHES + each for k, each in enumerate(stretches)])
    used = np.bincount(label, weight, len(stretches) * LEFT_OUT_STRETCHES)
    folds = [without_rows(observations, [each % TURN_FOLDS == k for each in stretches]) for k in range(TURN_FOLDS)]
    squares = []
    for each in fits:
        design, errors = each.design(observations), np.zeros(len(weight))
        for k, rest in enumerate(folds):
            products = design.reweighted(rest).products([each.setting])[0]
            step = projection(products, np.arange(products.shape[1] - 1))[0][:, -1]
            errors += np.where(of_fold == k, np.sum((design.left(step) / each.scale) ** 2, axis=1), 0.0)
        squares.append(np.bincount(label, weight * errors, len(used))[used > 0.0] / used[used > 0.0])
    return harmful(names, squares, "in stretches of turns that the fit leaves out")


@dataclass(frozen=True)
class LeftOut:
    """The squared errors of each fit of a selection at rests, and in moves, that are left out of it in turn."""

    of_rests: Sequence[Values]  # each (m,), g^2 or (deg/s)^2; none of the last fits, if folds have too few equations
    of_moves: Sequence[Values] = ()  # each (k,), deg^2; of the gyroscope
    judged: Sequence[bool] = ()  # whether each fit has some degrees of freedom in every fold

    @property
    def errors(self) -> list[float | None]:
        """The rms error of each fit."""
        pairs = zip_longest(self.of_rests, self.judged)
        return [float(np.sqrt(np.mean(squares))) if known else None for squares, known in pairs]

    def harmful(self, names: Sequence[str]) -> dict[str, str]:
        """Return the effects that raise an error significantly, with the reason."""
        names = names[: max(0, len(self.of_rests) - 1)]
        of_moves = harmful(names, self.of_moves, "after moves that the fit leaves out") if self.of_moves else {}
        return of_moves | harmful(names, self.of_rests, "at rests that the fit leaves out")


def rests_in_turn(model: Model) -> list[Mask]:
    """Return the rests of a model, every third in turn, as masks; none where they are too few, as in one soak."""
    count = len(model.rests.time)
    return [np.arange(count) % REST_FOLDS == k for k in range(REST_FOLDS if count >= REST_FOLDS else 0)]


def left_out(
    selection: SelectionByHand,
    parts: Sequence[tuple[Model, Mask]],
    known: Callable[[int, int], FitByHand | None] = lambda _fold, _count: None,
) -> LeftOut:
    """Return the errors of a selection's fits on rests and moves that are left out of it in turn.

    ``parts``: models without some of the rests, and which. ``known``: returns the fit of a fold with so many of the
    selected effects, or None.
    """
    model = selection.model
    rests, moves, judged = [], [], []
    models = [part for part, _ in parts]
    others = [model.without(~held) for _, held in parts] if isinstance(model, GyroscopeModel) else []
    moving = bool(others) and all(part.moves is not None for part in others)
    equations = min(len(part.equations(selection.base.state).residual) for part in models)  # as many with any effects
    for count, each in enumerate(selection.fits):
        judged.append(equations >= each.rank + SPARE)
        if equations <= each.rank:
            continue
        given = each.state, selection.hypotheses, selection.bounds
        fits = [known(k, count) or fit(part, *given, small=COMPARED_STEP) for k, part in enumerate(models)]
        rests.append(np.concatenate([_at_rests(model, part, f) for part, f in zip(models, fits, strict=True)]))
        if moving:
            errors = [part.direction_errors(f.state)[0] for part, f in zip(others, fits, strict=True)]
            moves.append(np.concatenate(errors) ** 2)
    return LeftOut(rests, moves, judged)


def _at_rests(model: Model, part: Model, fitted: FitByHand) -> Values:
    """Return the squared errors at the rests of a model that a part of it leaves out, without those that both do."""
    squares = part.held_out_squares(fitted.state)
    if isinstance(model, GyroscopeModel) and isinstance(part, GyroscopeModel):
        return np.asarray(squares[~model.every.held_out[part.every.held_out]])
    return squares
