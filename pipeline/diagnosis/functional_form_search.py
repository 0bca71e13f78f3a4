"""Search for the formula of physics that the catalogue of effects does not hold.

Every form of the grammar (``pipeline.diagnosis.functional_forms``) is scored as an effect would be, with base and
effects projected out, under the noise of the engine, on the a axes that it improves:

    score = 2 (max log L' - max log L) - (r a + s) log N - 2 C log 10

r coefficients, s scanned constants, N readings, C the form's complexity: each choice of the grammar is one of about
ten. Constants are scanned coarsely, then finer about the best. Further terms are added while they bring clearly more.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from pipeline.diagnosis import functional_forms as forms
from pipeline.diagnosis.functional_forms import Factor, Form, Span
from pipeline.diagnosis.residual_regression import Gain, ProjectedCurves, Scan
from pipeline.estimation.design import true_motion
from pipeline.model.effects import catalogue
from pipeline.model.effects.base import truth
from pipeline.model.formula import parse

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from pipeline.estimation.gauss_markov import Setting
    from pipeline.estimation.selection import Selection
    from pipeline.records import Values

PRICE = 2.0 * float(np.log(10.0))  # of a choice: log prior of one of about ten signals, functions or powers
CLEARLY = 10.0  # score of a form, and of a further term: "very strong" (Raftery, Sociological Methodology 25, 1995)
SLOWLY = 30.0  # the same of a form in time and temperature alone: HIGHEST_GATE of the selection
MORE = 0.02  # of the first term's delta BIC that a further one must have: less may be its constants' rounding
MOST_TERMS = 3
REFINED = 16  # forms that are scored under every noise setting, and whose constants are refined
ROUNDS = (1.0, 0.25, 0.0625)  # of the coarse scan's distance
VALUES_AT_ONCE = 4_000_000  # of columns that are scanned together: 32 MB
PROBED = 200  # rows at which two forms that are equal to 1e-9 are one


@dataclass(frozen=True)
class Scored:
    """A form, what it gains, and that minus the price of its complexity."""

    form: Form
    gain: Gain

    @property
    def score(self) -> float:
        """Delta BIC minus the price of the form's complexity."""
        return self.gain.delta_bic - PRICE * self.form.complexity

    @property
    def clear(self) -> bool:
        """Whether the evidence is very strong; wander of another kind than the model's looks like a slow form."""
        signals = {factor.signal for factor in (self.form.factor, self.form.modulator) if factor}
        return self.score > (SLOWLY if signals <= {"time", "temperature"} else CLEARLY)


class Forms:
    """The forms of the grammar that a unit's recordings can show, and what each gains in addition to a fit."""

    def __init__(self, selection: Selection) -> None:
        self.selection, self.sensor = selection, selection.observations.sensor
        motions = [true_motion(part, selection.fit.terms) for part in selection.observations.parts]
        self._signals = [(forms.signals_of(motion), truth(self.sensor, motion)) for motion in motions]
        self._known: dict[str, Values] = {}
        self.explain(())

    def explain(self, formulas: Sequence[str]) -> None:
        """Count formulas as explained from now on."""
        self.explained = forms.columns_of(formulas, self.sensor) if formulas else None
        self.scan = Scan(self.selection, self.explained)

    def column(self, text: str) -> Values:
        """Return a formula's values: (n,) array, or (n, 3) where each axis has its own."""
        if text not in self._known:
            formula = parse(text)
            found = []
            for signals, u in self._signals:
                each = [
                    forms.value(formula, signals | {"u": u[:, c]}) for c in range(3 if "u" in formula.signals else 1)
                ]
                found.append(np.stack(each, axis=1))
            self._known[text] = np.concatenate(found)
            if "u" not in formula.signals:
                self._known[text] = self._known[text][:, 0]
        return self._known[text]

    def columns(self, form: Form) -> Values:
        """Return the values of a form's columns: (n, r) or (n, 3, r) array."""
        own = np.stack([self.column(text) for text in form.factor.texts], axis=-1)
        if form.modulator is None:
            return own
        times = self.column(form.modulator.texts[0])[..., None]
        if own.ndim != times.ndim:
            own, times = (v if v.ndim == 3 else v[:, None] for v in (own, times))
        return np.asarray(own * times)

    def gains(self, tried: Sequence[Form], *, coarse: bool = False) -> list[Gain]:
        """Return what each form gains; ``coarse``: under few noise settings."""
        few = _few_settings(self.selection)
        scan = Scan(replace(self.selection, settings=few), self.explained) if coarse else self.scan
        found: dict[int, Gain] = {}
        kinds: dict[tuple[int, bool], list[int]] = {}
        for k, form in enumerate(tried):
            by_axis = "u" in (form.factor.signal, form.modulator.signal if form.modulator else "")
            kinds.setdefault((len(form.factor.texts), by_axis), []).append(k)
        for (r, by_axis), members in kinds.items():
            size = max(8, VALUES_AT_ONCE // (len(self.selection.observations.weight) * r * (3 if by_axis else 1)))
            for first in range(0, len(members), size):
                some = members[first : first + size]
                columns = np.stack([self.columns(tried[k]) for k in some], axis=-2)
                scanned = np.array([tried[k].scanned for k in some])
                found |= dict(zip(some, scan.best_axes(scan.drops(columns), r, scanned), strict=True))
        return [found[k] for k in range(len(tried))]

    def ranked(self) -> list[Scored]:
        """Return the best form of each name, best score first."""
        spans, tried = self._spans, self._tried
        scored = [Scored(form, gain) for form, gain in zip(tried, self.gains(tried, coarse=True), strict=True)]
        best = _best_of_each(scored)[:REFINED]
        best = [Scored(e.form, g) for e, g in zip(best, self.gains([each.form for each in best]), strict=True)]
        for apart in ROUNDS:
            near = [
                Form(factor, each.form.modulator)
                for each in best
                if each.form.factor.signal in spans
                for factor in forms.finer(each.form.factor, spans[each.form.factor.signal], apart)
            ]
            best = _best_of_each([*best, *(Scored(f, g) for f, g in zip(near, self.gains(near), strict=True))])
        return _best_of_each([*best, *(self._polynomial(span) for span in [*spans.values(), None])])

    @cached_property
    def _spans(self) -> dict[str, Span]:
        """Return the spans of the signals that all recordings hold."""
        observations = self.selection.observations
        motions = [part.motion for part in observations.parts]
        names = ["fx", "fy", "fz"]
        names += ["speed"] if any(np.any(~m.still) for m in motions) else []
        names += ["temperature"] if all(m.temperature is not None for m in motions) else []
        names += ["time"] if observations.clock_shared else []
        return {name: Span.of(observations, name) for name in names}

    @cached_property
    def _tried(self) -> list[Form]:
        """Return the forms of the coarse scan; of equal ones the simplest, and none of the catalogue."""
        spans = self._spans
        turning = any(part.motion.axis is not None for part in self.selection.observations.parts)
        factors = forms.factors(spans, turning=turning)
        pairs = [
            Form(factor, modulator)
            for modulator in forms.modulators(list(spans))
            for factor in factors
            if modulator is None or _may_multiply(modulator, factor)
        ]
        rows = np.random.default_rng(0).integers(len(self.selection.observations.weight), size=PROBED)
        seen = {_digest(self.column(text)[rows]) for text in _of_the_catalogue(self.sensor)}
        kept = []
        for form in sorted(pairs, key=lambda form: form.complexity):
            digest = _digest(self.columns(form)[rows])
            if digest not in seen:
                seen.add(digest)
                kept.append(form)
        return kept + [Form(band) for band in (forms.bands(spans["speed"]) if "speed" in spans else [])]

    def _polynomial(self, span: Span | None) -> Scored:
        """Return the polynomial of the best order, without powers that base or effects hold; None: in ``u``."""
        own = "fz" if self.sensor == "accelerometer" else "wz"
        signal = "u" if span is None else span.signal
        texts = forms.powers(span or Span.of(self.selection.observations, own), signal)
        projected = ProjectedCurves(self.scan, forms.columns_of(texts, self.sensor))
        kept = projected.independent(range(len(texts)))
        drops = projected.drop(kept) if kept else np.zeros((*self.scan.left.shape, 1))
        gains = self.scan.best_axes(drops, np.arange(1, drops.shape[2] + 1))
        best = max(range(len(gains)), key=lambda k: gains[k].delta_bic - PRICE * k)
        index = kept[: best + 1]
        formulas = tuple(texts[k] for k in index)
        return Scored(Form(forms.polynomial(signal, formulas, (index[-1] + 1) if index else 0)), gains[best])


def _few_settings(selection: Selection) -> list[Setting]:
    """Return the noise settings of the coarse scan: that of the fit, the least wander and the one in the middle."""
    ordered = sorted(selection.settings, key=lambda setting: setting.ratio)
    few = [selection.fit.setting, ordered[0], ordered[len(ordered) // 2]]
    return [setting for k, setting in enumerate(few) if setting not in few[:k]]


def _may_multiply(modulator: Factor, factor: Factor) -> bool:
    """Return whether a product says more than a function of one signal."""
    return factor.signal != modulator.signal or factor.kind == "step"


def _digest(values: Values) -> bytes:
    """Return what forms have in common whose values differ by a factor alone."""
    size = float(np.linalg.norm(values))
    flat = values.ravel() if values.ndim == 1 or values.shape[1] > 1 else values[:, 0].ravel()
    first = float(flat[np.argmax(np.abs(flat) > 1e-6 * size)]) if size > 0.0 else 1.0
    return np.round(values.reshape(len(values), -1) / (size * np.sign(first) or 1.0), 9).tobytes()


def _of_the_catalogue(sensor: str) -> list[str]:
    """Return the formulas of effects of the catalogue that every axis has a coefficient for."""
    declared = [getattr(e, "declared", None) for e in catalogue().values() if sensor in e.sensors]
    terms = [term for each in declared if each for term in each.terms.values()]
    return [term.formulas[""].text for term in terms if "" in term.formulas and not term.shared]


def _best_of_each(scored: Iterable[Scored]) -> list[Scored]:
    """Return the best of each form's constants, best score first."""
    best: dict[tuple[str, ...], Scored] = {}
    for each in scored:
        held = best.get(each.form.name)
        if held is None or each.score > held.score:
            best[each.form.name] = each
    return sorted(best.values(), key=lambda each: -each.score)


def search(selection: Selection) -> tuple[list[Scored], list[Scored]]:
    """Return the terms of the best form given the selected effects, none if none is clear, and all forms ranked."""
    terms: list[Scored] = []
    grammar = Forms(selection)
    first = found = grammar.ranked()
    while found and found[0].clear and (not terms or found[0].gain.delta_bic > MORE * terms[0].gain.delta_bic):
        terms.append(found[0])
        if len(terms) == MOST_TERMS:
            break
        grammar.explain([text for term in terms for text in term.form.formulas])
        found = [each for each in grammar.ranked() if not any(each.form.refines(term.form) for term in terms)]
    return terms, first


def without_effects(selection: Selection) -> Selection:
    """Return a selection of nothing: base and configured effects."""
    return replace(selection, names=[], fit=selection.base)
