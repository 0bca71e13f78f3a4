"""Search for the functional form of physics that the catalogue of effects does not hold.

Where the residual depends on a covariate (``pipeline.diagnosis.residual_dependence``), each simple form in it is scored
as an effect would be, given base, configured and selected effects, on the a axes that it improves:

    delta BIC = 2 (max log L' - max log L) - (r a + s) log N,    r coefficients, s scanned parameters, N readings

The best form is published in words and as the definition of an effect. Where slow effects were selected, a step or
exponential of the temperature is tried in their place, and replaces them if it explains far more.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import chain, count
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.diagnosis import functional_forms as forms
from pipeline.diagnosis.residual_dependence import SLOW, dependences
from pipeline.diagnosis.residual_regression import ProjectedCurves
from pipeline.estimation.selection import FAR_ABOVE, select
from pipeline.model.effects import catalogue, forget, register
from pipeline.model.effects.base import unit_of
from pipeline.model.effects.files import effect_from

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from numpy.typing import NDArray

    from pipeline.diagnosis.functional_forms import Form
    from pipeline.diagnosis.residual_regression import Gain
    from pipeline.estimation.selection import Selection
    from pipeline.records import Noise, SensorCalibration

    Values = NDArray[np.float64]

CLEARLY = 10.0  # delta BIC for a further harmonic, or for time in place of what changes with it
MOST_HARMONICS = 3  # at once; further ones are found once these are added
REFINED = 40  # forms of a scan, best first on all three axes, for which the axes are then chosen
FAR_MORE = 0.1  # of what slow effects gain, by which a form in their place must gain more
MUCH = 40.0  # delta BIC by which it must be better in any case
OWNERS = {"harmonic": "table", "ripple": "table", "band": "table"}


@dataclass(frozen=True)
class _FittedForm:
    """The best functional form in one covariate."""

    covariate: str
    form: Form
    gain: Gain
    coefficients: Values  # (3, r), zero on the axes that are left out
    sizes: Values  # (3,): amplitude, height or whole change, unit of the sensor; signed where a sign has a meaning


def unexplained(selection: Selection) -> list[dict[str, Any]]:
    """Return the covariates on which the residual still depends, each with its form, the best first.

    Entries hold ``covariate, p_value, shape`` (words), ``axes, formulas, coefficients`` (of each axis), ``size, unit,
    delta_bic, explained_by`` (another covariate whose form explains it too, or None) and ``kind``.
    """
    found = dict(dependences(selection))
    sensor = selection.observations.sensor
    fitted = sorted((_best_form(selection, covariate) for covariate in found), key=_rank)
    if not found:
        instead = _instead_of_slow_effects(selection)
        if instead is None:
            return []
        fitted, found = [instead], {instead.covariate: instead.gain.p_value}
    best = fitted[0]
    still = dict(dependences(selection, forms.columns_of(best.form.formulas, sensor)))
    return [
        {
            "covariate": each.covariate,
            "p_value": found[each.covariate],
            "shape": forms.described(each.form, each.sizes, each.gain.axes, sensor),
            "kind": each.form.kind,
            "axes": ["xyz"[c] for c in each.gain.axes],
            "formulas": list(each.form.formulas),
            "coefficients": [each.coefficients[c].tolist() for c in each.gain.axes],
            "size": float(np.abs(each.sizes).max()),
            "unit": "1" if each.form.kind == "ripple" else unit_of(sensor),
            "delta_bic": each.gain.delta_bic,
            "explained_by": None if each is best or each.covariate in still else best.covariate,
        }
        for each in fitted
    ]


def _instead_of_slow_effects(selection: Selection) -> _FittedForm | None:
    """Return a step or exponential of the temperature that explains far more than the selected slow effects.

    Where the unit only warms up, all of these are one curve in time, and none is far better.
    """
    slow = [term for term in selection.fit.terms if term.effect.name in SLOW and term.effect.name in selection.names]
    if not slow or any(part.motion.temperature is None for part in selection.observations.parts):
        return None
    others = tuple(term for term in selection.fit.terms if term not in slow)
    names = [name for name in selection.names if name not in SLOW]
    without = replace(selection, names=names, fit=replace(selection.fit, terms=others))
    found, before = _best_scanned(without, "temperature", "temperature")
    gain = 2.0 * (selection.fit.log_likelihood - before)
    parameters = sum(len(term.values) for term in slow)
    worth = gain - parameters * float(np.log(3.0 * selection.observations.samples))
    return found if found.gain.delta_bic > worth + max(MUCH, FAR_MORE * gain) else None


def _rank(fitted: _FittedForm) -> float:
    """Return the order of forms: time, of which everything slow is a function, only where it is clearly better."""
    return -fitted.gain.delta_bic + (CLEARLY if fitted.covariate == "time" else 0.0)


def _best_form(selection: Selection, covariate: str) -> _FittedForm:
    """Return the best form in a covariate."""
    sensor = selection.observations.sensor
    if covariate == "angle":
        found = [_best_harmonics(selection, factor) for factor in (("", "u") if sensor == "gyroscope" else ("",))]
    elif covariate == "specific_force":
        signals = ["u", "fx", "fy", "fz"] if sensor == "accelerometer" else ["fx", "fy", "fz"]
        found = [_best_polynomial(selection, covariate, signal) for signal in signals]
    else:
        signal = "speed" if covariate == "rate" else covariate
        found = [_best_scanned(selection, covariate, signal)[0], _best_polynomial(selection, covariate, signal)]
        if sensor == "gyroscope" and covariate == "rate":
            found.append(_best_polynomial(selection, covariate, "u"))
    return max(found, key=lambda fitted: fitted.gain.delta_bic)


def _best_harmonics(selection: Selection, factor: str) -> _FittedForm:
    """Return harmonics of the table's angle, added one by one while delta BIC rises clearly."""
    tried = forms.harmonics(factor)
    projected = _projected(selection, [text for form in tried for text in form.formulas])
    chosen: list[int] = []
    best, index = _gain_of_harmonics(projected, [])
    while len(chosen) < MOST_HARMONICS:
        options = [[*chosen, n] for n in range(len(tried)) if n not in chosen]
        gains = [_gain_of_harmonics(projected, option) for option in options]
        k = int(np.argmax([gain.delta_bic for gain, _ in gains]))
        if chosen and gains[k][0].delta_bic < best.delta_bic + CLEARLY:
            break
        chosen, (best, index) = options[k], gains[k]
    found = _on_axes(projected.coefficients(index, best.setting), best)
    amplitude = np.sqrt(np.sum(found.reshape(3, -1, 2) ** 2, axis=2)).max(axis=1)
    return _FittedForm("angle", forms.harmonic(factor, [forms.CYCLES[n] for n in chosen]), best, found, amplitude)


def _gain_of_harmonics(projected: ProjectedCurves, chosen: Sequence[int]) -> tuple[Gain, list[int]]:
    """Return what some harmonics gain, nothing where one is held already, and their columns."""
    columns = [k for n in chosen for k in (2 * n, 2 * n + 1)]
    index = projected.independent(columns)
    if not chosen or len(index) < len(columns):
        return replace(projected.gain(np.zeros_like(projected.left), 1), delta_bic=-np.inf), columns
    return projected.gain(projected.drop(index)[:, :, -1], len(index), len(chosen)), columns


def _best_polynomial(selection: Selection, covariate: str, signal: str) -> _FittedForm:
    """Return the polynomial of the best order, without powers that base or effects hold already."""
    own = "fz" if selection.observations.sensor == "accelerometer" else "wz"
    span = forms.Span.of(selection.observations, own if signal == "u" else signal)
    texts = forms.powers(span, signal)
    projected = _projected(selection, texts)
    kept = projected.independent(range(len(texts)))
    drops = projected.drop(kept) if kept else np.zeros((*projected.left.shape, 1))
    gains = [projected.gain(drops[:, :, k], k + 1) for k in range(drops.shape[2])]
    best = int(np.argmax([g.delta_bic for g in gains]))
    index = kept[: best + 1]
    found = _on_axes(projected.coefficients(index, gains[best].setting), gains[best])
    formulas = tuple(texts[k] for k in index)
    form = forms.polynomial(signal, formulas, (index[-1] + 1) if index else 0)
    return _FittedForm(covariate, form, gains[best], found, _change(selection, formulas, found))


def _best_scanned(selection: Selection, covariate: str, signal: str) -> tuple[_FittedForm, float]:
    """Return the best step, band or exponential, by a coarse and a fine scan, and the log likelihood without it."""
    span = forms.Span.of(selection.observations, signal)
    places = span.places()
    single = forms.steps(span, places)
    if signal in ("temperature", "time"):
        single += forms.steps(span, places, [span.size / forms.PLACES])
        single += forms.exponentials(span, [span.size * c for c in forms.CONSTANTS])
    form, gain, projected, weights = _best_of(selection, single, forms.bands(span, places) if signal == "speed" else [])
    fine = forms.finer(form, span)
    if fine:
        other = _best_of(selection, fine, [])
        if other[1].delta_bic > gain.delta_bic:
            form, gain, projected, weights = other
    inner = np.einsum("q,cqp,p->c", weights, projected.inner[gain.setting], weights)
    found = _on_axes((projected.cross[gain.setting] @ weights / np.maximum(inner, 1e-300))[:, None], gain)
    sizes = found[:, 0] if form.kind != "exponential" else _change(selection, form.formulas, found)
    return _FittedForm(covariate, form, gain, found, sizes), projected.before


def _best_of(
    selection: Selection, single: Sequence[Form], pairs: Sequence[Form]
) -> tuple[Form, Gain, ProjectedCurves, Values]:
    """Return the best of forms with one coefficient an axis, and the weights of the columns that it consists of."""
    projected = _projected(selection, [form.formulas[0] for form in single])
    both = [*single, *pairs]
    weights = np.zeros((len(single), len(both)))
    np.fill_diagonal(weights, 1.0)
    for k, form in enumerate(pairs, len(single)):
        for j, value in form.combination.items():
            weights[j, k] = value
    drops = projected.drops(weights)
    order = np.argsort(-projected.gains(drops, 3 + np.array([form.scanned for form in both])))[:REFINED]
    gains = {int(k): projected.gain(drops[:, :, k], 1, both[k].scanned) for k in order}
    best = max(gains, key=lambda k: gains[k].delta_bic)
    return both[best], gains[best], projected, weights[:, best]


def _projected(selection: Selection, texts: Sequence[str]) -> ProjectedCurves:
    return ProjectedCurves(selection, forms.columns_of(texts, selection.observations.sensor))


def _on_axes(coefficients: Values, gain: Gain) -> Values:
    """Return coefficients with zeros on the axes on which the form does not act."""
    kept = np.zeros_like(coefficients)
    kept[list(gain.axes)] = coefficients[list(gain.axes)]
    return kept


def _change(selection: Selection, formulas: Sequence[str], coefficients: Values) -> Values:
    """Return by how much a form changes over all rows: (3,) array."""
    if not formulas:
        return np.zeros(3)
    columns = forms.columns_of(formulas, selection.observations.sensor)
    values = np.concatenate([columns(part.motion) for part in selection.observations.parts])
    each = values if values.ndim == 3 else values[:, None, :]
    on_each_axis = np.broadcast_to(each, (len(each), 3, each.shape[2]))
    change: Values = np.ptp(np.einsum("ncr,cr->nc", on_each_axis, coefficients), axis=0)
    return change


def suggested_effect(
    unknown: Sequence[Mapping[str, Any]], sensor: str, taken: Collection[str] = ()
) -> dict[str, Any] | None:
    """Return the definition of an effect with the best form of what ``unexplained`` returned; None without one.

    Its name is none of those that are ``taken``.
    """
    if not unknown:
        return None
    entry = unknown[0]
    plain = f"unknown_{entry['covariate']}"
    name = next(n for n in chain([plain], (f"{plain}_{k}" for k in count(2))) if n not in taken)
    terms = dict(zip("ABCDEFGHIJ", entry["formulas"], strict=False))
    return {
        "name": name,
        "owner": OWNERS.get(entry["kind"], "sensor" if entry["covariate"] != "time" else "recording"),
        "sensors": [sensor],
        "meaning": f"First guess, to be confirmed: the {sensor} shows {entry['shape']}.",
        "terms": {term: {"formula": formula, "unit": entry["unit"]} for term, formula in terms.items()},
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


def select_with_form(
    selection: Selection,
    unknown: Sequence[Mapping[str, Any]],
    configured: Sequence[str],
    noise: Noise | None,
    sheet: Mapping[str, Any],
    *,
    accelerometer: SensorCalibration | None = None,
) -> Selection:
    """Select again with the best form in the base, so that effects of the catalogue no longer take its place.

    Where the residual stays far above the noise even so, the form is not what is missing, and nothing changes.
    ``unknown`` is what ``unexplained`` returned of the selection.
    """
    definition = suggested_effect(unknown, selection.observations.sensor, catalogue())
    if definition is None:
        return selection
    register(effect_from(definition, "a first guess"))
    try:
        again = select(
            selection.observations, [*configured, definition["name"]], noise, sheet, accelerometer=accelerometer
        )
    finally:
        forget(definition["name"])
    floor = 0.0 if noise is None else float(np.sqrt(np.mean(noise.white**2 + noise.wander**2)))
    return selection if 0.0 < FAR_ABOVE * floor < again.fit.residual_rms else again
