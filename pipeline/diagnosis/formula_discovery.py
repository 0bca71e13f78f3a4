"""The formula of physics that the catalogue does not hold, judged against catalogue and recordings, as an effect file.

The search (``pipeline.diagnosis.functional_form_search``) is made in addition to the selected effects, and again
without them, since they may have been selected instead of the form. With each form in the base, effects are selected
again. Of these models, and that of the catalogue alone, the one with the least

    -2 log L + k log N + 2 C log 10

is reported, with k parameters of effects and scanned constants, N readings and the complexity C of the form. Stability
is the share of resamples in which the form has the best score of all finalists. Each resample leaves out one recording,
or a fifth of every recording. Resamples in which no form has a clear score are not counted. The front lists, by
complexity, the forms that gain more than all simpler ones.
"""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import chain, count
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.diagnosis import functional_forms as forms
from pipeline.diagnosis.functional_form_search import CLEARLY, PRICE, Forms, Scored, search, without_effects
from pipeline.diagnosis.residual_dependence import dependences
from pipeline.diagnosis.residual_regression import ProjectedCurves, Scan
from pipeline.diagnosis.words import listed
from pipeline.estimation.design import Term
from pipeline.estimation.generalized_least_squares import Fit, fit_terms
from pipeline.estimation.observations import Observations, without_each_recording, without_rows
from pipeline.estimation.selection import FAR_ABOVE, Selection, select
from pipeline.model.effects import catalogue, effect_from, forget, register
from pipeline.model.effects.base import Effect, unit_of
from pipeline.model.formula import SIGNALS, parse

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping, Sequence

    from pipeline.diagnosis.findings import Case
    from pipeline.records import Values

LEAST_STABLE = 0.5  # share of resamples, a convention: below it, other formulas together are the best more often
NEEDED = {"temperature": "bias_temperature"}  # covariate: the effect that is observable where the covariate varies
FINALISTS = 8  # forms that compete in the resamples
FOLDS = 5  # parts of every recording that are left out in turn
LISTED = 6  # entries of the front


@dataclass(frozen=True)
class Discovery:
    """What was found beyond the catalogue."""

    context: Selection  # in whose residual the form was found
    reported: Selection  # with the form in its base, where there is one
    unknown: list[dict[str, Any]]  # covariates on which the residual depends, the form first
    suggested: dict[str, Any] | None = None  # the effect's definition
    front: list[dict[str, Any]] = field(default_factory=list)


def why_not_suggested(found: Discovery, hidden: Mapping[str, str]) -> str | None:
    """Return why a form that was found is not offered as an effect: not stable, or of a signal that shows no effect."""
    covariate = found.unknown[0]["covariate"]
    if covariate in NEEDED and NEEDED[covariate] in hidden:
        return f"effects of the {covariate} are not observable: {hidden[NEEDED[covariate]]}"
    stability = found.front[0]["stability"] if found.front else None
    if stability is not None and stability < LEAST_STABLE:
        return f"it is not stable: another formula is the best in {100 * (1 - stability):.0f} % of the resamples"
    return None


def dependent(selection: Selection) -> list[dict[str, Any]]:
    """Return the covariates on which the residual depends, the likeliest first: ``covariate, p_value, delta_bic``."""
    return [{"covariate": name, "p_value": p, "delta_bic": delta} for name, p, delta in dependences(selection)]


def discover(selection: Selection, unknown: list[dict[str, Any]], case: Case) -> Discovery:
    """Search for a formula in addition to base, configured and selected effects.

    ``unknown`` is what ``dependent`` returned of the selection. Where the residual stays far above the noise with the
    best form, the form is not what is missing, and none is suggested.
    """
    noise = case.noise
    floor = 0.0 if noise is None else float(np.sqrt(np.mean(noise.white**2 + noise.wander**2)))
    best, least = Discovery(selection, selection, unknown), _worth(selection, []) + CLEARLY
    for context in [selection, without_effects(selection)] if selection.names else [selection]:
        terms, ranked = search(context)
        if not terms:
            continue
        entry = _entry(context, terms)
        definition = suggested_effect([entry], selection.observations.sensor, catalogue())
        assert definition is not None  # noqa: S101  (there is an entry)
        form = effect_from(definition, "a first guess")
        if 0.0 < FAR_ABOVE * floor < _beside(context, form).residual_rms:
            continue
        with _registered(form):
            names = [*case.configured, definition["name"]]
            again = select(context.observations, names, noise, case.sensor_config, accelerometer=case.accelerometer)
        if _worth(again, terms) <= least:
            continue
        least = _worth(again, terms)
        best = Discovery(context, again, [entry, *unknown], definition, _front(context, terms, ranked))
    return replace(best, unknown=_explained(selection, best)) if best.suggested else best


def _worth(selection: Selection, terms: Sequence[Scored]) -> float:
    """Return 2 log L minus the price of all parameters and of the formula."""
    fitted = sum(len(term.values) for term in selection.fit.terms) + sum(term.form.scanned for term in terms)
    price = PRICE * sum(term.form.complexity for term in terms)
    return 2.0 * selection.fit.log_likelihood - fitted * float(np.log(3.0 * selection.observations.samples)) - price


def _beside(context: Selection, form: Effect) -> Fit:
    """Fit a form in addition to the effects of a selection."""
    terms = [*context.fit.terms, Term(form, np.zeros(len(form.parameters(context.observations.sensor))))]
    return fit_terms(context.observations, terms, context.start, context.settings)


@contextmanager
def _registered(form: Effect) -> Iterator[None]:
    """Hold a form in the catalogue for the time of a ``with`` block."""
    register(form)
    try:
        yield
    finally:
        forget(form.name)


def _entry(selection: Selection, terms: Sequence[Scored]) -> dict[str, Any]:
    """Return a form as an entry of ``unexplained``: words, formulas, and the coefficients on each of its axes."""
    sensor, first = selection.observations.sensor, terms[0]
    texts = [text for term in terms for text in term.form.formulas]
    projected = ProjectedCurves(Scan(selection), forms.columns_of(texts, sensor))
    found = projected.coefficients(range(len(texts)), terms[-1].gain.setting)
    axes = sorted({axis for term in terms for axis in term.gain.axes})
    words, sizes, at = [], [], 0
    for term in terms:
        own = found[:, at : at + len(term.form.formulas)]
        at += own.shape[1]
        sizes.append(_size(selection, term, own))
        words.append(forms.described(term.form, sizes[-1], term.gain.axes, sensor))
    return {
        "covariate": first.form.covariate,
        "p_value": first.gain.p_value,
        "shape": listed(words),
        "kind": first.form.kind,
        "axes": ["xyz"[c] for c in axes],
        "formulas": texts,
        "units": [term.form.unit(sensor) for term in terms for _ in term.form.formulas],
        "coefficients": [found[c].tolist() for c in axes],
        "size": float(np.abs(sizes[0][list(first.gain.axes)]).max()),
        "unit": "1" if first.form.kind == "ripple" else unit_of(sensor),
        "delta_bic": sum(term.gain.delta_bic for term in terms),
        "explained_by": None,
    }


def _size(selection: Selection, term: Scored, coefficients: Values) -> Values:
    """Return amplitude, height or whole change of a term on each axis: (3,) array."""
    if term.form.factor.kind == "harmonic" and term.form.kind in ("harmonic", "ripple"):
        return np.asarray(np.sqrt(np.sum(coefficients**2, axis=1)), np.float64)
    if term.form.kind in ("step", "band") and term.form.modulator is None:
        return coefficients[:, 0]
    columns = forms.columns_of(term.form.formulas, selection.observations.sensor)
    values = np.concatenate([columns(part.motion) for part in selection.observations.parts])
    each = values if values.ndim == 3 else np.repeat(values[:, None], 3, axis=1)
    return np.asarray(np.ptp(np.einsum("ncr,cr->nc", each, coefficients), axis=0), np.float64)


def _explained(selection: Selection, found: Discovery) -> list[dict[str, Any]]:
    """Return the entries, the form's first; of the others it is said whether the form explains them too."""
    form, *others = found.unknown
    columns = forms.columns_of(form["formulas"], selection.observations.sensor)
    still = {name for name, _, _ in dependences(found.context, columns)}
    rest = [entry for entry in others if entry["covariate"] != form["covariate"]]
    return [form, *({**e, "explained_by": None if e["covariate"] in still else form["covariate"]} for e in rest)]


def _front(selection: Selection, terms: Sequence[Scored], ranked: Sequence[Scored]) -> list[dict[str, Any]]:
    """Return the forms of one term that gain more than all simpler ones, and before them the one that is suggested."""
    finalists = list(ranked[:FINALISTS])
    stable = _stability(selection, finalists)
    shown: list[Scored] = []
    for each in sorted(ranked, key=lambda each: (each.form.complexity + each.form.scanned, -each.gain.delta_bic)):
        if not shown or each.gain.delta_bic > shown[-1].gain.delta_bic:
            shown.append(each)
    shown = [terms[0], *(each for each in shown if each.form is not terms[0].form)][:LISTED]
    return [
        {
            "formula": " + ".join(each.form.formulas),
            "complexity": each.form.complexity,
            "constants": each.form.scanned,
            "delta_bic": each.gain.delta_bic,
            "score": each.score,
            "axes": ["xyz"[c] for c in each.gain.axes],
            "stability": next((s for f, s in zip(finalists, stable, strict=True) if f.form is each.form), None),
            "suggested": each.form is terms[0].form,
        }
        for each in shown
    ]


def _stability(selection: Selection, finalists: Sequence[Scored]) -> list[float]:
    """Return in which share of the resamples each form has the best score."""
    wins, counted = np.zeros(len(finalists)), 0
    for observations in _resamples(selection.observations):
        tried = Forms(replace(selection, observations=observations))
        gains = tried.gains([each.form for each in finalists])
        scores = [g.delta_bic - PRICE * each.form.complexity for g, each in zip(gains, finalists, strict=True)]
        if max(scores) > CLEARLY:
            wins[int(np.argmax(scores))] += 1
            counted += 1
    return [float(share) for share in wins / max(counted, 1)]


def _resamples(observations: Observations) -> Iterator[Observations]:
    """Yield the observations without each recording, then without each fifth of every recording."""
    yield from without_each_recording(observations)
    lengths = [len(part.weight) for part in observations.parts]
    for fold in range(FOLDS):
        yield without_rows(observations, [np.arange(n) * FOLDS // n == fold for n in lengths])


def suggested_effect(
    unknown: Sequence[Mapping[str, Any]], sensor: str, taken: Collection[str] = ()
) -> dict[str, Any] | None:
    """Return the definition of an effect with the form of the first entry of ``unexplained``; None without one.

    Its name is none of those that are ``taken``.
    """
    if not unknown or not unknown[0].get("formulas"):
        return None
    entry = unknown[0]
    plain = f"unknown_{entry['covariate']}"
    name = next(n for n in chain([plain], (f"{plain}_{k}" for k in count(2))) if n not in taken)
    terms = zip("ABCDEFGHIJKL", entry["formulas"], entry["units"], strict=False)
    signals = {signal for text in entry["formulas"] for signal in parse(text).signals}
    of_table = entry["kind"] == "band" or any(not SIGNALS[signal].c for signal in signals)
    return {
        "name": name,
        "owner": "table" if of_table else "recording" if "time" in signals else "sensor",
        "sensors": [sensor],
        "meaning": f"First guess, to be confirmed: the {sensor} shows {entry['shape']}."[:500],
        "terms": {term: {"formula": formula, "unit": unit} for term, formula, unit in terms},
        "axes": list(entry["axes"]),
        "source": "what a diagnosis found in the residual",
    }


def effect_file(definition: Mapping[str, Any], unit: str) -> str:
    """Return the text of an effect file, ready to be copied into a campaign's ``effects/``; a unit showed it."""
    import yaml  # noqa: PLC0415  (only a unit with unknown physics pays for it)

    name, sensor = definition["name"], definition["sensors"][0]
    remarks = (
        f"# What unit {unit} shows beyond the catalogue of effects: a first guess, to be named, tried and confirmed.\n"
        f"# To try it, copy this file to effects/{name}.yaml in the campaign's directory and add {name} to\n"
        f"# effects.{sensor}. To rename it, change the file's name and the one below together.\n"
    )
    return remarks + str(yaml.safe_dump(dict(definition), sort_keys=False, allow_unicode=True, width=110))
