"""Rank the effects by the improvement of a fit: the whitened profile likelihood of every candidate.

    log L(theta) = -N/2 log RSS(theta) - 1/2 log det C(theta),    delta BIC = 2 (max log L' - max log L) - k log N

where theta is the noise setting, over which the likelihood of each candidate is maximised separately, RSS the whitened
residual sum of squares, N the number of readings and k the number of added parameters. Base and selected effects are
projected out of the candidates' columns first, so that each candidate is a separate small linear problem.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy

from pipeline.estimation.design import BASE, Design, Start, Term
from pipeline.estimation.gauss_markov import WHITE, Setting

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from pipeline.estimation.observations import Observations
    from pipeline.records import Index, Values

EXCITED = 1e-3  # share of a column's norm that the base leaves
NEW = 1e-4  # share of the variance of a candidate's weakest direction that the chosen effects leave
RIDGE = 1e-11  # of unit columns: 1e5 times the rounding of a double
LEFT = 1e-10  # share of a column's square, which is ten times the ridge's: what is left below it is rounding


@dataclass(frozen=True)
class Score:
    """The improvement by one candidate."""

    name: str
    # against the model without it; p of the likelihood ratio
    delta_bic: float
    p_value: float
    parameters: int  # k above
    # each (p,); estimates and standard uncertainties, nonlinear parameters at their start
    values: Values
    uncertainty: Values
    setting: int  # index of its best noise setting
    admissible: bool = True  # whether it adds anything that the chosen effects cannot do
    plausible: bool = True  # whether the estimates are within the sensor's limits
    drop: float = 0.0  # by how much the estimates lower the unwhitened sum of squares


class Ranking:
    """Every candidate as a small linear problem given base and configured effects, at a fit.

    Fitted effects are at their values, others at each of their starts: one effect may be there several times.

    ``base``: the fit of base and configured effects. ``candidates``: by name.
    """

    def __init__(
        self,
        observations: Observations,
        base: Start,
        fit: Start,
        candidates: Mapping[str, Term],
        settings: Sequence[Setting],
    ) -> None:
        self.settings = [WHITE, *settings]
        self.samples = 3.0 * observations.samples
        self.within = float(np.sum(observations.scatter / fit.scale**2))
        fitted = {term.effect.name: replace(term, full=False) for term in fit.terms}
        self.candidates: list[Term] = []
        for name, term in candidates.items():
            if name in fitted or term.effect.moves:
                self.candidates.append(fitted.get(name, term))
            else:
                self.candidates += [Term(term.effect, values) for values in term.effect.starts(observations.sensor)]
        configured = [replace(fitted[term.effect.name], full=True) for term in base.terms]
        design = Design(observations, [*configured, *self.candidates], fit.K, fit.scale, project=True)
        stacked, logarithms = design.products(self.settings)
        self.design, self.stacked, self.logarithms = design, stacked, logarithms
        self.penalty = 0.5 * logarithms - np.array([setting.prior for setting in self.settings])
        known = BASE + sum(s.stop - s.start for s in design.slices[: len(configured)])
        self.beside = products = without(stacked, np.arange(known))[:, known:, known:]
        self._reduce(products, design.sizes()[known:], [s.start - known for s in design.slices[len(configured) :]])

    def _reduce(self, products: Values, sizes: Values, starts: Sequence[int]) -> None:
        """Reduce each candidate to the directions that the motion excites, scaled to unit norm under white noise."""
        ends = [*starts[1:], len(sizes) - 1]
        size = np.where(sizes > 0, sizes, 1.0)
        self.places: list[Index] = []
        blocks, width = [], 0
        for start, end in zip(starts, ends, strict=True):
            block = slice(start, end)
            values, vectors = np.linalg.eigh(products[0, block, block] / np.outer(size[block], size[block]))
            kept = values > EXCITED**2
            blocks.append(vectors[:, kept] / np.sqrt(values[kept]) / size[block, None])
            self.places.append(np.arange(width, width + int(kept.sum())))
            width += int(kept.sum())
        self.blocks = blocks

        def reduced(columns: Values) -> Values:
            own = [columns[:, :, s:e] @ block for s, e, block in zip(starts, ends, blocks, strict=True)]
            return np.concatenate([*own, columns[:, :, -1:]], axis=2)

        self.products: Values = reduced(reduced(products).transpose(0, 2, 1))
        self.spans = [slice(start, end) for start, end in zip(starts, ends, strict=True)]

    def indices(self, name: str) -> list[int]:
        """Return the candidates that are this effect and that the motion excites."""
        return [j for j, term in enumerate(self.candidates) if term.effect.name == name and len(self.places[j]) > 0]

    def of_effects(self, names: Sequence[str]) -> list[int]:
        """Return the index of the first candidate that is each effect, if possible of those that the motion excites.

        A fit may take an effect to where the motion does not excite it, as a time constant of many recordings.
        """
        first = {term.effect.name: j for j, term in reversed([*enumerate(self.candidates)])}
        return [next(iter(self.indices(name)), first[name]) for name in names]

    def chosen(self, selected: Sequence[int]) -> Values:
        """Return the products without what base and selected candidates explain: (t, q + 1, q + 1) array."""
        return without(self.products, np.concatenate([np.zeros(0, int), *[self.places[j] for j in selected]]))

    def log_likelihood(self, rss: Values) -> Values:
        """Return log L at each noise setting."""
        total = np.maximum(rss + self.within, 1e-300)
        return np.asarray(-0.5 * self.samples * np.log(total / self.samples) - self.penalty)

    def log_likelihoods(self, selected: Sequence[int]) -> Values:
        """Return log L of base and selected candidates at each noise setting, the first white noise alone."""
        place = np.concatenate([*[self.places[j] for j in selected], [-1]]).astype(int)
        left = without(self.products[:, place[:, None], place], np.arange(len(place) - 1))
        return self.log_likelihood(left[:, -1, -1])

    def of_model(self, selected: Sequence[int]) -> tuple[float, int]:
        """Return the log likelihood of base and selected candidates, and its best noise setting."""
        found = self.log_likelihoods(selected)
        return float(found[1:].max()), int(np.argmax(found[1:])) + 1

    def scores(self, selected: Sequence[int], limits: dict[str, Values]) -> list[Score]:
        """Return the score of each candidate given the selected ones, best first.

        ``selected``: indices of candidates. ``limits``: effect to (p,) array, limits of plausibility of the parameters'
        absolute values.
        """
        products = self.chosen(selected)
        before = float(self.log_likelihood(products[:, -1, -1])[1:].max())
        names = {self.candidates[j].effect.name for j in selected}
        alike: dict[int, list[int]] = {}  # candidates with as many directions are solved together
        for j, term in enumerate(self.candidates):
            if len(self.places[j]) and term.effect.name not in names:
                alike.setdefault(len(self.places[j]), []).append(j)
        found = {j: score for members in alike.values() for j, score in self._scored(members, products, before, limits)}
        best: dict[str, Score] = {}
        for _, score in sorted(found.items()):
            held = best.get(score.name)
            if held is None or score.delta_bic > held.delta_bic:
                best[score.name] = score
        return sorted(best.values(), key=lambda s: -s.delta_bic)

    def _scored(
        self, members: Sequence[int], products: Values, before: float, limits: dict[str, Values]
    ) -> Iterator[tuple[int, Score]]:
        """Yield the scores of candidates with equal numbers of directions."""
        places = [slice(self.places[j][0], self.places[j][-1] + 1) for j in members]
        inner = np.stack([products[:, at, at] for at in places])
        cross = np.stack([products[:, at, -1] for at in places])
        own = np.einsum("tii->ti", self.products)
        definite = inner + RIDGE * np.stack([own[:, at] for at in places])[..., None] * np.eye(inner.shape[-1])
        solved = np.linalg.solve(definite, cross[..., None])[..., 0]
        rss = products[:, -1, -1] - np.sum(cross * solved, axis=2)
        likelihood = self.log_likelihood(rss)
        weakest = np.linalg.eigvalsh(inner[:, 0])[:, 0]
        for i, j in enumerate(members):
            this = self.candidates[j].effect
            best = int(np.argmax(likelihood[i, 1:])) + 1
            k = inner.shape[-1] + (0 if this.moves else len(this.nonlinear))
            gain = max(2.0 * (float(likelihood[i, best]) - before), 0.0)
            values, uncertainty = self._estimate(j, solved[i, best], definite[i, best], rss[i, best])
            limit = limits.get(this.name)
            signal = solved[i, best]
            yield (
                j,
                Score(
                    this.name,
                    gain - k * float(np.log(self.samples)),
                    float(scipy.special.chdtrc(k, gain)),
                    k,
                    values,
                    uncertainty,
                    best,
                    bool(weakest[i] > NEW),
                    limit is None or bool(np.all(np.abs(values) - 2.0 * uncertainty <= limit)),
                    float(2.0 * signal @ cross[i, 0] - signal @ inner[i, 0] @ signal),
                ),
            )

    def _estimate(self, j: int, solved: Values, inner: Values, rss: float) -> tuple[Values, Values]:
        """Return the parameters and their standard uncertainties from the reduced coefficients."""
        term, block = self.candidates[j], self.blocks[j]
        variance = (max(rss, 0.0) + self.within) / self.samples
        covariance = block @ np.linalg.solve(inner, block.T) * variance
        values, uncertainty = term.values.copy(), np.zeros(len(term.values))
        linear = slice(0, len(block))
        values[linear] = block @ solved + (term.values[linear] if term.effect.moves else 0.0)
        uncertainty[linear] = np.sqrt(np.clip(np.diag(covariance), 0.0, None))
        return values, uncertainty

    def shares(self, j: int, selected: Sequence[int], setting: int) -> dict[str, float]:
        """Return the share of a candidate's fitted signal that each other effect reproduces.

        ``j``: the candidate. ``selected``: other candidates that the model holds. ``setting``: index of the noise
        setting.
        """
        others = [i for i in selected if i != j]
        products = self.chosen(others)[setting]
        place = self.places[j]
        inner = products[np.ix_(place, place)]
        ridge = RIDGE * np.diag(np.diag(self.products[setting][np.ix_(place, place)]))
        signal = np.linalg.solve(inner + ridge, products[place, -1])
        power = float(signal @ inner @ signal)
        found: dict[str, float] = {}
        for i, term in enumerate(self.candidates):
            if term.effect.name == self.candidates[j].effect.name or i in others or len(self.places[i]) == 0:
                continue
            at = self.places[i]
            own = products[np.ix_(at, at)] + RIDGE * np.diag(np.diag(self.products[setting][np.ix_(at, at)]))
            cross = products[np.ix_(at, place)] @ signal
            share = float(cross @ np.linalg.solve(own, cross)) / power if power > 0 else 0.0
            found[term.effect.name] = max(found.get(term.effect.name, 0.0), min(share, 1.0))
        return found

    def same_as(self, j: int) -> set[str]:
        """Return the effects whose signals a candidate reproduces completely, together with the base."""
        left = self.chosen([j])[0]
        return {
            term.effect.name
            for i, (term, at) in enumerate(zip(self.candidates, self.places, strict=True))
            if i != j and len(at) and np.linalg.eigvalsh(left[np.ix_(at, at)])[-1] < NEW
        }

    def explained(self) -> Values:
        """Return the whitened sum of squares that each candidate takes from the base, white noise: (c,)."""
        products = self.products[0]
        out = np.zeros(len(self.candidates))
        for j, place in enumerate(self.places):
            if len(place):
                inner = products[np.ix_(place, place)] + RIDGE * np.eye(len(place))
                out[j] = float(products[place, -1] @ np.linalg.solve(inner, products[place, -1]))
        return out

    def visibility(self, j: int, limits: Values) -> Values:
        """Return the expected gain in 2 log L of an effect whose parameters are all at their limits: (t,) array."""
        block = self.spans[j]
        squares = np.einsum("tii->ti", self.beside[:, block, block])
        return np.asarray(np.sum(limits[: squares.shape[1]] ** 2 * squares, axis=1))


def without(products: Values, index: Index) -> Values:
    """Return products of columns after some of them are projected out of all: (t, p, p) array.

    Zeros in theirs, and in those of columns of which only rounding is left; the last column, the readings, is kept.

    ``products``: (t, p, p). ``index``: (q,).
    """
    if len(index) == 0:
        return products
    rest = products - products[:, index, :].transpose(0, 2, 1) @ projection(products, index)
    new = np.einsum("tpp->tp", rest) > LEFT * np.einsum("tpp->tp", products)
    new[:, -1] = True
    rest *= new[:, :, None]
    rest *= new[:, None, :]
    return np.asarray(rest)


def projection(products: Values, index: Index) -> Values:
    """Return the coefficients of the projection of each column onto some of the columns: (t, q, p) array.

    ``products``: (t, p, p). ``index``: (q,).
    """
    inner, cross = products[:, index[:, None], index], products[:, index, :]
    size = np.sqrt(np.maximum(np.einsum("tii->ti", inner), 1e-300))
    scaled = inner / (size[:, :, None] * size[:, None, :]) + RIDGE * np.eye(len(index))
    return np.asarray(np.linalg.solve(scaled, cross / size[:, :, None]) / size[:, :, None])
