"""Rank the effects by how much each improves a fit: the profile likelihood of every candidate.

    log L(theta) = -N/2 log RSS(theta) - 1/2 log det C(theta),    delta BIC = 2 (max log L' - max log L) - k log N

where theta is the noise setting, over which the likelihood of each candidate is maximised separately, RSS the whitened
residual sum of squares, N the number of readings and k the number of added parameters. Base and selected effects are
projected out of the candidates' columns first, so that each candidate is a separate small linear problem.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from pipeline.core.records import BASE_COUNT, Index, Values, standard_uncertainty
from pipeline.estimation.candidates import estimates
from pipeline.estimation.design import Design, EffectColumns, Start, Terms
from pipeline.estimation.gates import within
from pipeline.estimation.gauss_markov import WHITE_SETTING, Setting
from pipeline.estimation.observations import Observations

MIN_NEW_COLUMN_SHARE = 1e-3  # share of a column's norm, after projection of the base, from which on it is determined
# the same of the variance of a candidate's weakest direction, after projection of the selected effects
MIN_NEW_VARIANCE = 1e-4
UNIT_COLUMN_RIDGE = 1e-11  # of unit columns: 1e5 times the rounding of a double
# share of a column's square after a projection, below which it is rounding: ten times that of the ridge
MIN_LEFT_SQUARE_SHARE = 1e-10


@dataclass(frozen=True)
class Score:
    """The improvement by one candidate."""

    name: str
    delta_bic: float  # against the model without it
    p_value: float  # of the likelihood ratio
    parameters: int  # k above
    values: Values  # (p,); estimates, nonlinear parameters at their start
    uncertainty: Values  # (p,); their standard uncertainties
    setting: int  # index of its best noise setting
    admissible: bool = True  # whether the selected effects do not already explain its signal
    plausible: bool = True  # whether the estimates are within the sensor's limits
    drop: float = 0.0  # decrease of the unwhitened sum of squares by the estimates
    rough: bool = False  # whether it is by a fit that is only near the candidate's optimum

    def refined(self, gain: float, samples: float, terms: Terms, covariance: Values, limit: Values | float) -> Score:
        """Return the score by a fit at the candidate's optimum; ``covariance``: see ``estimates``."""
        gain, (values, uncertainty) = max(gain, 0.0), estimates(terms, covariance)[self.name]
        delta_bic = gain - self.parameters * float(np.log(samples))
        p, plausible = float(scipy.special.chdtrc(self.parameters, gain)), within(values, uncertainty, limit)
        found = replace(self, delta_bic=delta_bic, p_value=p, plausible=plausible)
        return replace(found, values=values, uncertainty=uncertainty)


class Ranking:
    """Every candidate as a small linear problem given base and configured effects, at a fit.

    Fitted effects are at their values, others at each of their starts: one effect may have several candidates.

    ``base``: the fit of base and configured effects. ``candidates``: by name. ``walks``: further settings, for the
    posterior at the same fit. Attributes of each candidate: ``spans``, its columns in ``projected``, the products after
    projection; ``blocks``, its excited directions, (k, r), scaled to unit norm under white noise; ``places``, these
    directions in ``products``. The readings come last.
    """

    def __init__(
        self,
        observations: Observations,
        base: Start,
        fit: Start,
        candidates: Mapping[str, EffectColumns],
        settings: Sequence[Setting],
        *,
        walks: Sequence[Setting] = (),
    ) -> None:
        self.settings = [WHITE_SETTING, *settings]
        self.samples = 3.0 * observations.samples
        self.within = float(np.sum(observations.scatter / fit.scale**2))
        fitted = {term.effect.name: replace(term, full=False) for term in fit.terms}
        self.candidates: list[EffectColumns] = []
        for name, term in candidates.items():
            if name in fitted or term.effect.moves:
                self.candidates.append(fitted.get(name, term))
            else:
                starts = term.effect.starts(observations.sensor)
                self.candidates += [EffectColumns(term.effect, values) for values in starts]
        configured = [replace(fitted[term.effect.name], full=True) for term in base.terms]
        design = Design(observations, [*configured, *self.candidates], fit.K, fit.scale, project=True)
        self.stacked, self.logarithms = design.products([*self.settings, *walks])
        self.sizes, self.slices, of_settings = design.sizes(), design.slices, slice(len(self.settings))
        self.penalty = 0.5 * self.logarithms[of_settings] - np.array([setting.prior for setting in self.settings])
        known = BASE_COUNT + sum(s.stop - s.start for s in design.slices[: len(configured)])
        self.with_walks = without(self.stacked, np.arange(known))[:, known:, known:]
        self.projected = self.with_walks[of_settings]
        self.spans = [slice(s.start - known, s.stop - known) for s in design.slices[len(configured) :]]
        size = np.where(self.sizes > 0, self.sizes, 1.0)[known:]
        unit = self.projected[0] / (size[:, None] * size)
        self.blocks: list[Values] = [np.zeros(0)] * len(self.spans)
        for members in by_size([span.stop - span.start for span in self.spans]):
            decomposed = np.linalg.eigh(np.stack([unit[self.spans[j], self.spans[j]] for j in members]))
            for j, values, vectors in zip(members, *decomposed, strict=True):
                kept = values > MIN_NEW_COLUMN_SHARE**2
                self.blocks[j] = vectors[:, kept] / np.sqrt(values[kept]) / size[self.spans[j], None]
        ends = np.cumsum([block.shape[1] for block in self.blocks]).tolist()
        self.places = [np.arange(end - block.shape[1], end) for block, end in zip(self.blocks, ends, strict=True)]

        def reduced(columns: Values) -> Values:
            parts = [columns[:, :, span] @ block for span, block in zip(self.spans, self.blocks, strict=True)]
            return np.concatenate([*parts, columns[:, :, -1:]], axis=2)

        self.products: Values = reduced(reduced(self.projected).transpose(0, 2, 1))
        self._excited: dict[str, list[int]] = {}
        for j, term in enumerate(self.candidates):
            if len(self.places[j]) > 0:
                self._excited.setdefault(term.effect.name, []).append(j)
        self._with: dict[tuple[int, ...], Values] = {}  # log L of selected candidates and one more, from ``scores``
        self._explained: dict[int, float] = {}  # see ``explained``

    def indices(self, name: str) -> list[int]:
        """Return the indices of the candidates of an effect that the motion excites."""
        return self._excited.get(name, [])

    def of_effects(self, names: Sequence[str]) -> list[int]:
        """Return the index of the first candidate of each effect, if possible of those that the motion excites.

        The motion may not excite an effect at its fitted value, for example at a time constant of many recordings.
        """
        first = {term.effect.name: j for j, term in reversed([*enumerate(self.candidates)])} if names else {}
        return [next(iter(self.indices(name)), first[name]) for name in names]

    def chosen(self, selected: Sequence[int]) -> Values:
        """Return the products with base and selected candidates projected out: (t, q + 1, q + 1) array."""
        return without(self.products, self._at(selected))

    def _at(self, selected: Sequence[int]) -> Index:
        """Return the places of selected candidates in ``products``."""
        return np.concatenate([np.zeros(0, int), *[self.places[j] for j in selected]])

    def log_likelihood(self, rss: Values) -> Values:
        """Return log L at each noise setting."""
        total = np.maximum(rss + self.within, 1e-300)
        return np.asarray(-0.5 * self.samples * np.log(total / self.samples) - self.penalty)

    def log_likelihoods(self, selected: Sequence[int]) -> Values:
        """Return log L of base and selected candidates at each noise setting, the first white noise alone."""
        if (known := self._with.get(tuple(selected))) is not None:
            return known
        return self.log_likelihood(self.left([selected])[0])

    def left(self, sets: Sequence[Sequence[int]], settings: slice = slice(None)) -> Values:
        """Return what base and each set of candidates leave of the whitened sum of squares at some noise settings.

        ``sets``: m sets with equal numbers of directions. Returns a (m, t) array.
        """
        place = np.array([[*self._at(selected), -1] for selected in sets])
        products = self.products[settings][:, place[:, :, None], place[:, None]].swapaxes(0, 1)
        rest = without(products.reshape(-1, *products.shape[2:]), np.arange(place.shape[1] - 1))
        return rest[:, -1, -1].reshape(len(sets), -1)

    def of_model(self, selected: Sequence[int]) -> tuple[float, int]:
        """Return the largest log likelihood of base and selected candidates, and the index of its noise setting."""
        likelihoods = self.log_likelihoods(selected)[1:]
        return float(likelihoods.max()), int(np.argmax(likelihoods)) + 1

    def scores(self, selected: Sequence[int], limits: dict[str, Values]) -> list[Score]:
        """Return the best score of each effect given selected candidates, the best effect first.

        ``selected``: indices of candidates. ``limits``: effect to (p,) array, limits of plausibility of the parameters'
        absolute values.
        """
        products = self.chosen(selected)
        before = float(self.log_likelihood(products[:, -1, -1])[1:].max())
        names = {self.candidates[j].effect.name for j in selected}
        able = [j for j, term in enumerate(self.candidates) if len(self.places[j]) and term.effect.name not in names]
        scores = {}
        for index in by_size([self.blocks[j].shape for j in able]):
            members = [able[k] for k in index]
            for j, score, likelihoods, explained in self._scored(members, products, before, limits):
                scores[j], self._with[*selected, j] = score, likelihoods
                if not selected:
                    self._explained[j] = explained
        best: dict[str, Score] = {}
        for _, score in sorted(scores.items()):
            if score.name not in best or score.delta_bic > best[score.name].delta_bic:
                best[score.name] = score
        return sorted(best.values(), key=lambda s: -s.delta_bic)

    def _scored(
        self, members: Sequence[int], products: Values, before: float, limits: dict[str, Values]
    ) -> Iterator[tuple[int, Score, Values, float]]:
        """Yield index, score, log likelihoods, and what it explains under white noise, of candidates of equal size."""
        places = [slice(self.places[j][0], self.places[j][-1] + 1) for j in members]
        inner = np.stack([products[:, at, at] for at in places])
        cross = np.stack([products[:, at, -1] for at in places])
        squares = np.einsum("tii->ti", self.products)
        ridge = UNIT_COLUMN_RIDGE * np.stack([squares[:, at] for at in places])
        definite = inner + ridge[..., None] * np.eye(inner.shape[-1])
        solved = np.linalg.solve(definite, cross[..., None])[..., 0]
        explained = np.sum(cross * solved, axis=2)
        rss = products[:, -1, -1] - explained
        likelihood = self.log_likelihood(rss)
        weakest = np.linalg.eigvalsh(inner[:, 0])[:, 0]
        likeliest, row = np.argmax(likelihood[:, 1:], axis=1) + 1, np.arange(len(members))
        blocks, signals = np.stack([self.blocks[j] for j in members]), solved[row, likeliest]
        linear, variance = (blocks @ signals[..., None])[..., 0], np.maximum(rss[row, likeliest], 0.0) + self.within
        covariances = blocks @ np.linalg.solve(definite[row, likeliest], blocks.transpose(0, 2, 1))
        uncertainties = standard_uncertainty(covariances * (variance / self.samples)[:, None, None])
        of_white = 2.0 * cross[:, 0] - (inner[:, 0] @ signals[..., None])[..., 0]
        of_one, drops = float(np.log(self.samples)), np.sum(signals * of_white, axis=1).tolist()
        for i, j in enumerate(members):
            term, this, best = self.candidates[j], self.candidates[j].effect, int(likeliest[i])
            k = inner.shape[-1] + (0 if this.moves else len(this.nonlinear))
            gain = max(2.0 * (float(likelihood[i, best]) - before), 0.0)
            values, uncertainty, at = term.values.copy(), np.zeros(len(term.values)), slice(linear.shape[1])
            values[at] = linear[i] + (term.values[at] if this.moves else 0.0)
            uncertainty[at] = uncertainties[i]
            plausible = within(values, uncertainty, limits.get(this.name, np.inf))
            p, admissible = float(scipy.special.chdtrc(k, gain)), bool(weakest[i] > MIN_NEW_VARIANCE)
            delta_bic = gain - k * of_one
            score = Score(this.name, delta_bic, p, k, values, uncertainty, best, admissible, plausible, drops[i])
            yield j, score, likelihood[i], float(explained[i, 0])

    def shares(self, j: int, selected: Sequence[int], setting: int) -> dict[str, float]:
        """Return the share of candidate j's fitted signal that each other effect reproduces.

        ``selected``: other candidates in the model. ``setting``: index of the noise setting.
        """
        others = [i for i in selected if i != j]
        products = self.chosen(others)[setting]
        definite = products + UNIT_COLUMN_RIDGE * np.diag(np.diag(self.products[setting]))
        place = self.places[j]
        signal = np.linalg.solve(definite[np.ix_(place, place)], products[place, -1])
        power = float(signal @ products[np.ix_(place, place)] @ signal)
        shares: dict[str, float] = {}
        for i, (term, at) in enumerate(zip(self.candidates, self.places, strict=True)):
            name = term.effect.name
            if name != self.candidates[j].effect.name and i not in others and len(at):
                cross = products[np.ix_(at, place)] @ signal
                gain = float(cross @ np.linalg.solve(definite[np.ix_(at, at)], cross))
                shares[name] = max(shares.get(name, 0.0), min(gain / power, 1.0) if power > 0 else 0.0)
        return shares

    def same_as(self, j: int) -> set[str]:
        """Return the effects whose signals candidate j reproduces completely, together with the base."""
        rest = self.chosen([j])[0]
        return {
            term.effect.name
            for i, (term, at) in enumerate(zip(self.candidates, self.places, strict=True))
            if i != j and len(at) and np.linalg.eigvalsh(rest[np.ix_(at, at)])[-1] < MIN_NEW_VARIANCE
        }

    def explained(self) -> Values:
        """Return the decrease of the base's whitened sum of squares by each candidate, white noise: (c,) array."""
        if not self._explained:
            self.scores([], {})
        return np.array([self._explained.get(j, 0.0) for j in range(len(self.places))])

    def visibility(self, j: int, limits: Values) -> Values:
        """Return the expected gain in 2 log L of an effect whose parameters are all at their limits: (t,) array."""
        block = self.spans[j]
        squares = np.einsum("tii->ti", self.projected[:, block, block])
        return np.asarray(np.sum(limits[: squares.shape[1]] ** 2 * squares, axis=1))


def by_size(sizes: Iterable[Hashable]) -> Iterable[list[int]]:
    """Return the indices of equal sizes, which are computed together."""
    found: dict[Hashable, list[int]] = {}
    for j, size in enumerate(sizes):
        found.setdefault(size, []).append(j)
    return found.values()


def without(products: Values, index: Index) -> Values:
    """Return products of columns after some of them are projected out of all: (t, p, p) array.

    Rows and columns of the projected ones, and of those whose remainder is rounding, are zero; the last column, the
    readings, is not set to zero. ``products``: (t, p, p). ``index``: (q,).
    """
    if len(index) == 0:
        return products
    rest = products[:, index, :].transpose(0, 2, 1) @ projection(products, index)
    np.subtract(products, rest, out=rest)
    new = np.einsum("tpp->tp", rest) > MIN_LEFT_SQUARE_SHARE * np.einsum("tpp->tp", products)
    new[:, -1] = True
    setting, column = np.nonzero(~new)
    rest[setting, column] = rest[setting, :, column] = 0.0
    return np.asarray(rest)


def projection(products: Values, index: Index) -> Values:
    """Return the coefficients of the projection of each column onto some of the columns, ``index``: (t, q, p) array."""
    inner, cross = products[:, index[:, None], index], products[:, index, :]
    size = np.sqrt(np.maximum(np.einsum("tii->ti", inner), 1e-300))
    scaled = inner / (size[:, :, None] * size[:, None, :]) + UNIT_COLUMN_RIDGE * np.eye(len(index))
    return np.asarray(np.linalg.solve(scaled, cross / size[:, :, None]) / size[:, :, None])
