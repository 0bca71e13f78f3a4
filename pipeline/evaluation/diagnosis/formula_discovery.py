"""Search for a formula of physics outside the catalogue, and write it as an effect file.

Every form of the grammar (``pipeline.evaluation.diagnosis.functional_forms``) is scored as an effect would be: base and
effects are projected out, and the noise is that of the engine. On the a axes that it improves, its score is

    2 (max log L' - max log L) - (r a + s) log N - 2 C log 10

with r coefficients, s scanned constants, N readings and complexity C: each choice of the grammar is one of about ten.
Constants are scanned coarsely, then more finely about the best. Further terms are added if their scores are clear.

The search is made in addition to the selected effects, and again without them, since they may have been selected
instead of the form. With the form in the base, effects are selected again. Of these models and the catalogue's alone,
the one with the least

    -2 log L + k log N + 2 C log 10

is reported, with k parameters of effects and scanned constants. Stability is the share of resamples in which the form
has the best score of all finalists. Each resample leaves out one recording, or a fifth of every recording. The front
lists, by complexity, the forms that gain more than all simpler ones.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, combinations, count, pairwise, starmap
from typing import Any, NamedTuple

import numpy as np

from pipeline.core.records import Dependence, FittedForm, Index, Mask, RankedFormula, Values
from pipeline.estimation.design import Design, EffectColumns
from pipeline.estimation.gates import MAX_MIN_DELTA_BIC, MIN_DELTA_BIC
from pipeline.estimation.gauss_markov import Setting
from pipeline.estimation.generalized_least_squares import fit_terms
from pipeline.estimation.observations import Observations, without_each_recording, without_rows
from pipeline.estimation.ranking import by_size
from pipeline.estimation.selection import FAR_ABOVE, Selection, select
from pipeline.evaluation.diagnosis import functional_forms as forms
from pipeline.evaluation.diagnosis.findings import DiagnosisInput
from pipeline.evaluation.diagnosis.form_scan import FormGain, ProjectedCurves, Scan
from pipeline.evaluation.diagnosis.functional_forms import Factor, Form, Span
from pipeline.evaluation.diagnosis.residual_dependence import dependences
from pipeline.evaluation.diagnosis.words import listed
from pipeline.physics.effects import catalogue, effect_from, forget, register
from pipeline.physics.effects.base import unit_of
from pipeline.physics.formula import SIGNALS, parse

PRICE = 2.0 * float(np.log(10.0))  # of a choice: log prior of one of about ten signals, functions or powers
# least delta BIC of a further term over that of the first: less may be rounding of the first's constants
MIN_FURTHER_GAIN_SHARE = 0.02
MAX_FORMULA_TERMS = 3  # as many as effects that a verdict believes at once (``BELIEVED``)
REFINED = 16  # forms that are scored under every noise setting, and whose constants are scanned more finely
SCAN_REFINEMENTS = (1.0, 0.25, 0.0625)  # of the coarse scan's distance
ROWS_AT_ONCE = 1024  # whose products of columns are computed together: 16 MB for 100 columns of a model
SAME_CRITERION = 1e-6  # a thousand times the rounding of fits of one model
BETWEEN_PLACES = 0.2  # share by which a term may explain more between the places of the coarse scan, at 1/4 of the span
SCREENED_ROWS = 500  # about; enough for ten of each parameter, and fewer would only let more formulas pass
PROBED = 200  # rows; two forms whose values there are equal to 1e-9 are one
LEAST_STABLE = 0.5  # share of resamples, a convention: below it, other formulas together are the best more often
OBSERVABLE_BY = {"temperature": "bias_temperature"}  # effect that is observable if the recordings vary the covariate
FINALISTS = 8  # forms that are compared in the resamples
RECORDING_FOLDS = 5  # parts of every recording that are left out in turn
LISTED_FORMULAS = 6  # entries of the front


class ScoredForm(NamedTuple):
    """A form and its gain."""

    form: Form
    gain: FormGain

    @property
    def score(self) -> float:
        """Delta BIC minus the price of the form's complexity."""
        return self.gain.delta_bic - PRICE * self.form.complexity

    @property
    def clear(self) -> bool:
        """Whether its score passes the gate; a form in time and temperature alone looks like unmodelled wander."""
        return self.score > (MAX_MIN_DELTA_BIC if self.form.signals <= {"time", "temperature"} else MIN_DELTA_BIC)


class FormProducts:
    """Forms as products f g of two kinds of columns F and G, and block means and squares of all these products.

    The products themselves are not computed: the sums of ``w f g`` in a block are ``F^T (w G)``, those of ``w f^2 g^2``
    are ``(F^2)^T (w G^2)``. ``apart``: whether F are factors and G modulators; else F are forms, and G is 1.
    """

    def __init__(self, grammar: Forms, tried: Sequence[Form], scan: Scan, *, apart: bool) -> None:
        self._squares: dict[tuple[Setting, ...], Values] = {}  # by noise: (t, q, p)
        self._across: dict[tuple[Design, tuple[Setting, ...]], Values] = {}  # by model and noise, see ``across``
        self.scanned = np.array([form.scanned for form in tried])
        kinds: tuple[list[Values], list[Values]] = [], [np.ones(len(scan.weight))]

        def places(kind: int, factor: Factor, times: Factor | None = None) -> list[list[int]]:
            """Return the places on each axis of the columns of a product, and of the sums of two: (3, q) list."""
            key = kind, factor.texts, times.texts if times else ()
            if key not in known:
                of_axes: list[list[int]] = []
                for axis in range(3 if "u" in (factor.signal, times and times.signal) else 1):
                    own = [grammar.on_axis(text, factor, axis) for text in factor.texts]
                    own += [one + other for one, other in combinations(own, 2)]
                    own = [grammar.on_axis(times.texts[0], times, axis) * each for each in own] if times else own
                    of_axes.append([*range(len(kinds[kind]), len(kinds[kind]) + len(own))])
                    kinds[kind].extend(own)
                known[key] = of_axes * (3 // len(of_axes))
            return known[key]

        known: dict[tuple[int, tuple[str, ...], tuple[str, ...]], list[list[int]]] = {}
        pairs = []  # places of both kinds on each axis
        for form in tried:
            modulator = places(1, form.modulator) if apart and form.modulator else [[0]] * 3
            pairs.append((places(0, form.factor, None if apart else form.modulator), modulator))
        # of forms whose columns have the same shape: number of columns, which forms, and their places on each axis
        self.alike: list[tuple[int, list[int], list[tuple[Index, Index]]]] = []
        for members in by_size((len(form.factor.texts), "u" in form.signals) for form in tried):
            first, axes = tried[members[0]], range(3 if "u" in tried[members[0]].signals else 1)
            f, m = (np.array(each) for each in zip(*(pairs[k] for k in members), strict=True))
            self.alike.append((len(first.factor.texts), members, [(f[:, axis], m[:, axis]) for axis in axes]))
        F, G = self.columns = [np.stack(known, axis=1) for known in kinds]
        weighted, edges = scan.weight[:, None] * G, [*scan.blocks.first.tolist(), len(F)]
        sums = np.stack([F[at].T @ weighted[at] for at in starmap(slice, pairwise(edges))])
        self.means = sums.reshape(len(sums), -1) / scan.blocks.weight[:, None]
        between = (scan.blocks.weight @ self.means**2).reshape(F.shape[1], -1)
        whole = sum((F[at] ** 2).T @ (weighted[at] * G[at]) for at in _pieces(len(F)))
        self.inside = np.maximum(whole - between, 0.0)

    def squares(self, scan: Scan) -> Values:
        """Return the whitened squares of the products: (t, q, p) array."""
        if scan.settings not in self._squares:
            self._squares[scan.settings] = scan.noise.squares(self.means).reshape(-1, *self.inside.shape) + self.inside
        return self._squares[scan.settings]

    def gains(self, scan: Scan) -> list[FormGain]:
        """Return the gain of each form."""
        found: dict[int, FormGain] = {}
        across, squares = self.across(scan), self.squares(scan)
        for r, members, places in self.alike:
            grams, with_all = [], []
            for f, m in places:
                own, gram = squares[:, f, m], np.empty((len(squares), len(members), r, r))
                gram[..., range(r), range(r)] = own[..., :r]
                for k, (i, j) in enumerate(combinations(range(r), 2), r):
                    gram[..., i, j] = gram[..., j, i] = 0.5 * (own[..., k] - own[..., i] - own[..., j])
                grams.append(gram)
                with_all.append(across[:, f[:, :r], m].reshape(len(across), -1, across.shape[3]))
            gains = scan.best_axes(scan.drops_of(grams, with_all), r, self.scanned[members])
            found |= dict(zip(members, gains, strict=True))
        return [found[k] for k in range(len(found))]

    def across(self, scan: Scan) -> Values:
        """Return the whitened products with the columns of model, readings and curves: (t, q, p, k) array."""
        key, own = (scan.design, scan.settings), scan.design.columns.columns.shape[1]
        if key not in self._across:
            self._across[key] = self._with_columns(scan, slice(own))
        curves = scan.columns.shape[1] > own  # that the scan projects out too
        found = [self._across[key], *([self._with_columns(scan, slice(own, None))] if curves else [])]
        return np.concatenate(found, axis=3)

    def _with_columns(self, scan: Scan, at: slice) -> Values:
        columns = np.sqrt(scan.weight)[:, None] * scan.every.inside[:, at]
        shape = *self.inside.shape, columns.shape[1]
        F, pieces = self.columns[0], _pieces(len(columns))
        products = ((self.columns[1][at, :, None] * columns[at, None]).reshape(len(F[at]), -1) for at in pieces)
        inside = sum(F[at].T @ product for at, product in zip(pieces, products, strict=True))
        between = self.means.T @ scan.noise.solve(scan.means(scan.columns[:, at]))
        return np.asarray(between.reshape(-1, *shape) + np.reshape(inside, shape))


def _pieces(rows: int) -> list[slice]:
    """Return the rows in pieces, so that the memory of a product of columns is bounded."""
    return [slice(first, first + ROWS_AT_ONCE) for first in range(0, rows, ROWS_AT_ONCE)]


class Forms:
    """The forms that a unit's recordings can show, and the gain of each in addition to a fit."""

    def __init__(self, selection: Selection) -> None:
        self.selection, self.sensor = selection, selection.observations.sensor
        self._columns: dict[str, Values] = {}
        self._kept: list[FormProducts] | None = None  # of the coarse scan
        self.explain(())

    def at(self, selection: Selection) -> Forms:
        """Return the forms for another fit of the same observations; they stay the same if the motion does."""
        timed = [[t.key for t in each.fit.terms if t.effect.moves] for each in (self.selection, selection)]
        if timed[0] != timed[1]:
            return Forms(selection)
        found = copy(self)
        found.selection = selection
        found.explain(())
        return found

    def explain(self, formulas: Sequence[str]) -> None:
        """Project formulas out of the residual and of all forms from now on."""
        self.explained = forms.columns_of(formulas, self.sensor) if formulas else None
        self.scan = Scan(self.selection, self.explained)

    def on_axis(self, text: str, factor: Factor | None, axis: int) -> Values:
        """Return the values of a factor's formula on an axis: (n,) array."""
        column = self.column(text, factor)
        return column[:, axis % column.shape[1]]

    def column(self, text: str, factor: Factor | None = None) -> Values:
        """Return a formula's values: (n, 1) array, or (n, 3) if the formula contains ``u``.

        ``factor``: whose formula it is.
        """
        if text not in self._columns:
            if factor and factor.constants:
                self._columns[text] = factor.values(self.column(factor.signal))
            else:
                of_parts = [forms.values_of(parse(text), signals) for signals in self._signals]
                self._columns[text] = np.concatenate(of_parts)
        return self._columns[text]

    def gains(self, tried: Sequence[Form]) -> list[FormGain]:
        """Return the gain of each form."""
        return FormProducts(self, tried, self.scan, apart=False).gains(self.scan) if tried else []

    def _coarse(self) -> list[Form]:
        """Return the forms with the best scores under the noise of the fit, the least wander and a middle one."""
        if self._kept is None:  # bands have no modulators
            bands = [form for form in self._tried if form.factor.kind == "band"]
            products = FormProducts(self, self._tried[: len(self._tried) - len(bands)], self.scan, apart=True)
            self._kept = [products, *([FormProducts(self, bands, self.scan, apart=False)] if bands else [])]
        ordered = sorted(self.selection.settings, key=lambda setting: setting.ratio)
        scan = self.scan.under(dict.fromkeys([self.selection.fit.setting, ordered[0], ordered[len(ordered) // 2]]))
        gains = [gain for table in self._kept for gain in table.gains(scan)]
        return [each.form for each in _best_of_each(map(ScoredForm, self._tried, gains))[:REFINED]]

    def ranked(self) -> list[ScoredForm]:
        """Return the best form of each name, best score first."""
        spans, refined, of_coarse = self._spans, self._coarse(), dict(self._columns)
        best = _best_of_each(map(ScoredForm, refined, self.gains(refined)))
        for spacing in SCAN_REFINEMENTS:
            around = ((each.form.factor, each.form.modulator) for each in best if each.form.factor.signal in spans)
            near = [Form(finer, by) for f, by in around for finer in forms.finer(f, spans[f.signal], spacing)]
            best = _best_of_each([*best, *map(ScoredForm, near, self.gains(near))])
        self._columns = of_coarse  # those of the finer constants would have as much memory again
        return _best_of_each([*best, *self._polynomials()])

    def may_leave(self, mean_square: float) -> bool:
        """Return whether a formula may leave so small a mean square of the residual.

        It may not if terms that explain no more together than apart leave more: in addition to given terms, all that
        ``MAX_FORMULA_TERMS`` explain is at most so many times what the best one does, and what the given ones explain
        with finer constants. White noise leaves least. A term is a factor with any modulator, a band, or a polynomial.
        """
        rows, root, first, bands, terms = self._screened
        axes, ones, explained = [(self.scan.white(c, rows), *terms[c]) for c in range(3)], np.ones_like(root), 0.0
        excess = sum(axis.residual @ axis.residual for axis, *_ in axes) - mean_square * 3.0 * np.sum(root**2)
        for _ in range(MAX_FORMULA_TERMS):
            products = np.add.reduceat(np.sum([axis.explained(F, G) for axis, F, G, _ in axes], axis=0), first)
            of_bands = np.sum([axis.explained(bands, ones) for axis, *_ in axes], axis=0)
            polynomials = np.sum([axis.explained_together(powers) for axis, *_, powers in axes], axis=0)
            most = max(products.max(), of_bands.max(), polynomials.max())
            if excess - explained > MAX_FORMULA_TERMS * most + BETWEEN_PLACES * explained:
                return False
            f, m = np.unravel_index(products.argmax(), products.shape)
            columns = slice(first[f], first[f] + len(self._factors[0][f].texts))
            explained += sum(axis.add(F[:, columns] * G[:, m, None]) for axis, F, G, _ in axes)
        return True

    @cached_property
    def _screened(self) -> tuple[Mask, Values, Index, Values, list[tuple[Values, Values, Values]]]:
        """Return rows, their weights' roots, and the columns of the terms there; see ``may_leave``."""
        thin, (factors, modulators), every = copy(self), self._factors, -(-len(self.scan.weight) // SCREENED_ROWS)
        vars(thin).update(_columns={}, _signals=[{k: v[::every] for k, v in each.items()} for each in self._signals])
        rows = np.concatenate([np.arange(len(each["u"])) % every == 0 for each in self._signals])
        root, first = np.sqrt(self.scan.weight[rows])[:, None], np.cumsum([0, *(len(f.texts) for f in factors[:-1])])
        above = thin.column("speed") >= (self._spans["speed"].places() if "speed" in self._spans else np.zeros(1))
        (low, high), terms = np.triu_indices(above.shape[1]), []
        for c in range(3):
            F = np.stack([thin.on_axis(text, factor, c) for factor in factors for text in factor.texts]).T
            G = np.stack([thin.on_axis(m.texts[0], m, c) if m else np.ones(len(F)) for m in modulators]).T
            powers = F[:, : len(forms.POWERS) * (len(self._spans) + 1)].reshape(len(F), -1, len(forms.POWERS))
            terms.append((F, root * G, root * powers.swapaxes(0, 1)))
        return rows, root, first, root * (above[:, low] & ~above[:, high]), terms

    @cached_property
    def _factors(self) -> tuple[list[Factor], list[Factor | None]]:
        turning = any(part.motion.axis is not None for part in self.selection.observations.parts)
        return forms.factors(self._spans, turning=turning), forms.modulators(self._spans)

    @cached_property
    def _signals(self) -> list[dict[str, Values]]:
        return [forms.signals_of(motion, self.sensor) for motion in self.scan.motions]

    @cached_property
    def _spans(self) -> dict[str, Span]:
        observations = self.selection.observations
        return {s: Span.of(observations, s) for s in ("fx", "fy", "fz", *forms.available_signals(observations))}

    @cached_property
    def _tried(self) -> list[Form]:
        """Return the forms of the coarse scan without those of the catalogue; of equal forms the simplest."""
        spans = self._spans
        factors, modulators = self._factors
        able = ((f, m) for m in modulators for f in factors if m is None or f.signal != m.signal or f.kind == "step")
        pairs = [Form(factor, modulator) for factor, modulator in able]
        rows = np.random.default_rng(0).integers(len(self.selection.observations.weight), size=PROBED)
        declared = [getattr(e, "declared", None) for e in catalogue().values() if self.sensor in e.sensors]
        terms = [term for each in declared if each for term in each.terms.values()]
        known = [term.formulas[""].text for term in terms if "" in term.formulas and not term.shared]
        pairs.sort(key=lambda form: form.complexity)
        each = {factor.texts: factor for factor in (*factors, *modulators) if factor} | {(): None}
        probed = {
            texts: np.stack([self.column(text, factor)[rows] for text in texts], axis=-1) if factor else np.ones(())
            for texts, factor in each.items()
        }
        seen = {*forms.digests([self.column(text)[rows] for text in known])}
        values = [probed[form.factor.texts] * probed[form.modulator.texts if form.modulator else ()] for form in pairs]
        distinct = []
        for form, digest in zip(pairs, forms.digests(values), strict=True):
            if digest not in seen:
                seen.add(digest)
                distinct.append(form)
        return distinct + [Form(band) for band in (forms.bands(spans["speed"]) if "speed" in spans else [])]

    @cached_property
    def _powers(self) -> list[tuple[str, tuple[str, ...], Values]]:
        """Return signal, formulas and their values of each polynomial."""
        u = Span.of(self.selection.observations, "fz" if self.sensor == "accelerometer" else "wz")
        texts = [(signal, forms.powers(span, signal)) for signal, span in {**self._spans, "u": u}.items()]
        return [(signal, each, self.scan.values(forms.columns_of(each, self.sensor))) for signal, each in texts]

    def _polynomials(self) -> list[ScoredForm]:
        """Return the polynomial of the best order of each signal, without powers that base or effects contain."""
        found = []
        for signal, texts, values in self._powers:
            projected = ProjectedCurves(self.scan, values)
            new = projected.independent(range(len(texts)))
            drops = projected.drop(new) if new else np.zeros((*self.scan.left.shape, 1))
            gains = self.scan.best_axes(drops, np.arange(1, drops.shape[2] + 1))
            best = max(range(len(gains)), key=lambda k: gains[k].delta_bic - PRICE * k)
            index = new[: best + 1]
            formulas = tuple(texts[k] for k in index)
            form = forms.polynomial(signal, formulas, (index[-1] + 1) if index else 0)
            found.append(ScoredForm(Form(form), gains[best]))
        return found


def _best_of_each(scored: Iterable[ScoredForm]) -> list[ScoredForm]:
    """Return the form with the best constants of each name, best score first."""
    best: dict[tuple[str, ...], ScoredForm] = {}
    for each in scored:
        name = each.form.name
        if name not in best or each.score > best[name].score:
            best[name] = each
    return sorted(best.values(), key=lambda each: -each.score)


def search(grammar: Forms) -> tuple[list[ScoredForm], list[ScoredForm]]:
    """Return the terms of the best form, none if none is clear, and all forms of one term, best first."""
    terms: list[ScoredForm] = []
    first = ranked = grammar.ranked()
    while ranked and ranked[0].clear:
        if terms and ranked[0].gain.delta_bic <= MIN_FURTHER_GAIN_SHARE * terms[0].gain.delta_bic:
            break
        terms.append(ranked[0])
        if len(terms) == MAX_FORMULA_TERMS:
            break
        grammar.explain([text for term in terms for text in term.form.formulas])
        ranked = [each for each in grammar.ranked() if not any(each.form.refines(term.form) for term in terms)]
    return terms, first


@dataclass(frozen=True)
class Discovery:
    """The result of a search outside the catalogue."""

    context: Selection  # in whose residual the form was found
    reported: Selection  # with the form in its base, if there is one
    unknown: Sequence[Dependence]  # that with the form first
    suggested: dict[str, Any] | None = None  # the effect's definition
    front: Sequence[RankedFormula] = ()


def why_not_suggested(discovery: Discovery, hidden: Mapping[str, str]) -> str | None:
    """Return why the form is not offered as an effect: unstable, or of a signal whose effects are not observable."""
    covariate = discovery.unknown[0].covariate
    if covariate in OBSERVABLE_BY and OBSERVABLE_BY[covariate] in hidden:
        return f"effects of the {covariate} are not observable: {hidden[OBSERVABLE_BY[covariate]]}"
    stability = discovery.front[0].stability if discovery.front else None
    if stability is not None and stability < LEAST_STABLE:
        return f"it is not stable: another formula is the best in {100 * (1 - stability):.0f} % of the resamples"
    return None


def discover(selection: Selection, unknown: Sequence[Dependence], case: DiagnosisInput) -> Discovery:
    """Search for a formula in addition to base, configured and selected effects.

    ``unknown``: the ``dependences`` of the selection. No form is suggested if the residual with it is far above the
    noise: then something else is missing. None is searched where that is certain before (``Forms.may_leave``).
    """
    noise = case.noise
    floor = float(np.sqrt(np.mean(noise.white**2 + noise.wander**2)))
    best, least = Discovery(selection, selection, unknown), _criterion(selection, []) + MIN_DELTA_BIC
    alone, grammar = replace(selection, steps={}, fit=selection.base), None
    tried: list[tuple[Sequence[str], Sequence[str]]] = []
    for context in [selection, alone] if selection.names else [selection]:
        grammar = grammar.at(context) if grammar else Forms(context)
        far = FAR_ABOVE * floor if FAR_ABOVE * floor < context.fit.residual_rms else 0.0
        if far and not grammar.may_leave(far**2):
            continue
        terms, ranked = search(grammar)
        if not terms:
            continue
        found, first = _fitted_form(context, terms), terms[0]
        if (found.formulas, found.axes) in tried:  # with the same form in the base, the same effects are selected
            continue
        entry = Dependence(first.form.covariate, first.gain.p_value, sum(term.gain.delta_bic for term in terms), found)
        definition = suggested_effect(entry.covariate, found, case.sensor, catalogue())
        form = effect_from(definition, "a first guess")
        added = [*context.fit.terms, EffectColumns(form, np.zeros(len(form.parameters(case.sensor))))]
        if far and fit_terms(context.observations, added, context.start, context.settings).residual_rms > far:
            continue
        tried.append((found.formulas, found.axes))
        names = [*case.configured, form.name]
        register(form)
        try:
            apart = replace(context.observations, kept=None)  # no other step has the form
            reselected = select(apart, names, noise, case.data_sheet, accelerometer=case.accelerometer)
        finally:
            forget(form.name)
        criterion = _criterion(reselected, terms)
        if criterion > least:
            # one form may be found in both contexts, as ``u ** 2`` and ``(u / 200) ** 2``: then the first
            least, best = criterion + SAME_CRITERION, Discovery(context, reselected, [entry, *unknown], definition)
            suggested = found, terms, ranked
    if best.suggested is None:
        return best
    found, terms, ranked = suggested
    return replace(best, unknown=_explained(best, found), front=_front(best.context, terms, ranked))


def _criterion(selection: Selection, terms: Sequence[ScoredForm]) -> float:
    """Return 2 log L minus the price of all parameters and of the formula."""
    fitted = sum(len(term.values) for term in selection.fit.terms) + sum(term.form.scanned for term in terms)
    price = PRICE * sum(term.form.complexity for term in terms)
    return 2.0 * selection.fit.log_likelihood - fitted * float(np.log(3.0 * selection.observations.samples)) - price


def _fitted_form(selection: Selection, terms: Sequence[ScoredForm]) -> FittedForm:
    """Return a form in words, with its formulas and their coefficients on each of its axes."""
    sensor, first = selection.observations.sensor, terms[0]
    texts = [text for term in terms for text in term.form.formulas]
    scan = Scan(selection)
    projected = ProjectedCurves(scan, scan.values(forms.columns_of(texts, sensor)))
    coefficients = projected.coefficients(range(len(texts)), terms[-1].gain.setting)
    axes = sorted({axis for term in terms for axis in term.gain.axes})
    of_terms = np.split(coefficients, np.cumsum([len(term.form.formulas) for term in terms])[:-1], axis=1)
    sizes = [_sizes_of(t.form, c, selection.observations) for t, c in zip(terms, of_terms, strict=True)]
    words = [_described(t.form, size, t.gain.axes, sensor) for t, size in zip(terms, sizes, strict=True)]
    return FittedForm(
        shape=listed(words),
        kind=first.form.kind,
        axes=["xyz"[c] for c in axes],
        formulas=texts,
        units=[term.form.unit(sensor) for term in terms for _ in term.form.formulas],
        coefficients=[coefficients[c].tolist() for c in axes],
        size=float(np.abs(sizes[0][list(first.gain.axes)]).max()),
        unit="1" if first.form.kind == "ripple" else unit_of(sensor),
    )


def _sizes_of(form: Form, coefficients: Values, observations: Observations) -> Values:
    """Return the amplitude, height or whole change of a form on each axis: (3,) array."""
    if form.factor.kind == "harmonic":
        return np.asarray(np.linalg.norm(coefficients, axis=1), np.float64)
    if form.is_height:
        return coefficients[:, 0]
    columns = forms.columns_of(form.formulas, observations.sensor)
    values = np.concatenate([columns(part.motion) for part in observations.parts])
    return np.asarray(np.ptp(np.sum(values * coefficients, axis=2), axis=0), np.float64)


def _described(form: Form, sizes: Values, axes: Sequence[int], sensor: str) -> str:
    """Return a fitted form as a noun phrase: ``a step at 31.0 degC, of 3.9 mg on x and -2.1 mg on z``.

    ``sizes``: those of ``_sizes_of``. Heights have a sign.
    """
    unit, scale = unit_of(sensor), 1.0
    if form.kind == "ripple":
        unit, scale = "%", 100.0
    elif sensor == "accelerometer" and float(np.abs(sizes).max()) < 0.1:
        unit, scale = "mg", 1e3
    values = scale * (sizes if form.is_height else np.abs(sizes))
    size = listed([f"{values[c]:.3g} {unit} on {'xyz'[c]}" for c in axes])
    phrase = form.factor.words
    if form.modulator:
        text = form.modulator.texts[0]
        phrase += f" in proportion to {'the rate' if form.kind == 'ripple' else forms.SIGNAL_WORDS.get(text, text)}"
    if form.factor.kind == "harmonic":
        return f"{phrase}, amplitude {size}"
    return f"{phrase}, of {size}" if form.is_height else f"{phrase}, {size} in all"


def _explained(found: Discovery, form: FittedForm) -> list[Dependence]:
    """Return the dependences with the form's covariate where the form explains them too."""
    first, *others = found.unknown
    columns = forms.columns_of(form.formulas, found.context.observations.sensor)
    remaining = {entry.covariate for entry in dependences(found.context, columns)}
    others = [entry for entry in others if entry.covariate != first.covariate]
    return [first, *(e if e.covariate in remaining else replace(e, explained_by=first.covariate) for e in others)]


def _front(context: Selection, terms: Sequence[ScoredForm], ranked: Sequence[ScoredForm]) -> list[RankedFormula]:
    """Return the forms of one term that gain more than all simpler ones, and before them the suggested one."""
    finalists = list(ranked[:FINALISTS])
    stable = _stability(context, finalists)
    shown: list[ScoredForm] = []
    for each in sorted(ranked, key=lambda each: (each.form.complexity + each.form.scanned, -each.gain.delta_bic)):
        if not shown or each.gain.delta_bic > shown[-1].gain.delta_bic:
            shown.append(each)
    shown = [terms[0], *(each for each in shown if each.form is not terms[0].form)][:LISTED_FORMULAS]
    return [
        RankedFormula(
            formula=" + ".join(each.form.formulas),
            complexity=each.form.complexity,
            constants=each.form.scanned,
            delta_bic=each.gain.delta_bic,
            score=each.score,
            axes=["xyz"[c] for c in each.gain.axes],
            stability=next((s for f, s in zip(finalists, stable, strict=True) if f.form is each.form), None),
            suggested=each.form is terms[0].form,
        )
        for each in shown
    ]


def _stability(context: Selection, finalists: Sequence[ScoredForm]) -> list[float]:
    """Return the share of the resamples with a clear score in which each form has the best score."""
    scan = Scan(context)
    observations, columns, alike = scan.observations, scan.columns, defaultdict(list)
    for each in finalists:
        values = scan.values(forms.columns_of(each.form.formulas, observations.sensor))
        places = columns.shape[1] + np.arange(values[0].size).reshape(values.shape[1:])
        columns = np.concatenate([columns, values.reshape(len(values), -1)], axis=1)
        alike[places.shape].append((each.form, places))
    lengths = [len(part.weight) for part in observations.parts]
    cells = [np.arange(n) * RECORDING_FOLDS // n for n in lengths]
    folds = (without_rows(observations, [cell == fold for cell in cells]) for fold in range(RECORDING_FOLDS))
    edges = np.flatnonzero(np.concatenate([np.diff(cell, prepend=-1) for cell in cells]))
    wins, model = dict.fromkeys((each.form for each in finalists), 0), slice(scan.columns.shape[1])
    for resample, products in scan.resampled(columns, edges, chain(without_each_recording(observations), folds)):
        scored: list[ScoredForm] = []
        for (_, r), members in alike.items():
            tried, of_axes = [form for form, _ in members], np.stack([places for _, places in members], axis=1)
            grams = [products[:, at[:, :, None], at[:, None]] for at in of_axes]
            drops = resample.drops_of(grams, [products[:, at.ravel(), model] for at in of_axes])
            gains = resample.best_axes(drops, r, np.array([form.scanned for form in tried]))
            scored += map(ScoredForm, tried, gains)
        best = max(scored, key=lambda each: each.score)
        wins[best.form] += best.score > MIN_DELTA_BIC
    return [wins[each.form] / max(sum(wins.values()), 1) for each in finalists]


def suggested_effect(covariate: str, form: FittedForm, sensor: str, taken: Collection[str]) -> dict[str, Any]:
    """Return the definition of an effect with the form of a dependence; its name differs from those in ``taken``."""
    plain = f"unknown_{covariate}"
    name = next(n for n in chain([plain], (f"{plain}_{k}" for k in count(2))) if n not in taken)
    terms = zip("ABCDEFGHIJKL", form.formulas, form.units, strict=False)
    signals = {signal for text in form.formulas for signal in parse(text).signals}
    of_table = form.kind == "band" or any(not SIGNALS[signal].c for signal in signals)
    return {
        "name": name,
        "owner": "table" if of_table else "recording" if "time" in signals else "sensor",
        "sensors": [sensor],
        "meaning": f"First guess, to be confirmed: the {sensor} shows {form.shape}."[:500],
        "terms": {term: {"formula": formula, "unit": unit} for term, formula, unit in terms},
        "axes": list(form.axes),
        "source": "what a diagnosis found in the residual",
    }
