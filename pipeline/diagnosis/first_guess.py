"""A first guess at physics that the catalogue does not know: which shape the residual has, in words and as a formula.

Where the residual depends on a covariate (``pipeline.diagnosis.unknown``), each simple shape in it is scored as an
effect would be, beside base, configured and selected effects, on the axes that it improves:

    delta BIC = 2 (max log L' - max log L) - (r a + s) log N

with r coefficients on each of a axes and s scanned parameters (``pipeline.diagnosis.shape_search``). The best one is
told in words and written as the definition of an effect, to be named, tried and confirmed by the user. A covariate that
says nothing more beside the best shape of another is named as explained by it. And where slow effects were selected, a
step or exponential of the temperature is tried in their place: it is taken for the truth if it explains far more.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.diagnosis import shapes
from pipeline.diagnosis.guess_words import in_words
from pipeline.diagnosis.shape_search import CLEARLY, best_scanned, guess_of
from pipeline.diagnosis.unknown import SLOW, dependences
from pipeline.estimation.selection import FAR_ABOVE, select
from pipeline.model.effects import catalogue, forget, register
from pipeline.model.effects.base import unit_of
from pipeline.model.effects.files import effect_from

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from pipeline.diagnosis.guess_words import Guess
    from pipeline.estimation.selection import Selection
    from pipeline.records import Noise

FAR_MORE = 0.1  # of what they gain
MUCH = 40.0
OWNERS = {"harmonic": "table", "ripple": "table", "band": "table"}


def unexplained(selection: Selection) -> list[dict[str, Any]]:
    """Return the covariates on which the residual still depends, each with its shape, the best first.

    Parameters
    ----------
    selection : Selection

    Returns
    -------
    list of dict
        ``covariate, p_value, shape`` (words), ``axes, formulas, coefficients`` (of each axis), ``size, unit,
        delta_bic, explained_by`` (another covariate whose shape says it all, or None) and ``kind``.
    """
    found = dict(dependences(selection))
    sensor = selection.observations.sensor
    guesses = sorted((guess_of(selection, covariate) for covariate in found), key=_rank)
    if not found:
        instead = _instead(selection)
        if instead is None:
            return []
        guesses, found = [instead], {instead.covariate: instead.gain.p_value}
    best = guesses[0]
    beside = dict(dependences(selection, shapes.columns_of(best.shape.formulas, sensor)))
    return [
        {
            "covariate": guess.covariate,
            "p_value": found[guess.covariate],
            "shape": in_words(guess, sensor),
            "kind": guess.shape.kind,
            "axes": ["xyz"[c] for c in guess.gain.axes],
            "formulas": list(guess.shape.formulas),
            "coefficients": [guess.coefficients[c].tolist() for c in guess.gain.axes],
            "size": float(np.abs(guess.sizes).max()),
            "unit": "1" if guess.shape.kind == "ripple" else unit_of(sensor),
            "delta_bic": guess.gain.delta_bic,
            "explained_by": None if guess is best or guess.covariate in beside else best.covariate,
        }
        for guess in guesses
    ]


def _instead(selection: Selection) -> Guess | None:
    """Return a step or exponential of the temperature that explains far more than the slow effects that were selected.

    Where the unit only warms up, all of these are one curve in time, and none is far better.
    """
    slow = [term for term in selection.fit.terms if term.effect.name in SLOW and term.effect.name in selection.names]
    if not slow or any(part.motion.temperature is None for part in selection.observations.parts):
        return None
    others = tuple(term for term in selection.fit.terms if term not in slow)
    names = [name for name in selection.names if name not in SLOW]
    without = replace(selection, names=names, fit=replace(selection.fit, terms=others))
    guess, before = best_scanned(without, "temperature", "temperature")
    gain = 2.0 * (selection.fit.log_likelihood - before)
    parameters = sum(len(term.values) for term in slow)
    worth = gain - parameters * float(np.log(3.0 * selection.observations.samples))
    return guess if guess.gain.delta_bic > worth + max(MUCH, FAR_MORE * gain) else None


def _rank(guess: Guess) -> float:
    """Return the order of guesses: time, of which everything slow is a function, only where it is clearly better."""
    return -guess.gain.delta_bic + (CLEARLY if guess.covariate == "time" else 0.0)


def suggested_effect(
    unknown: Sequence[Mapping[str, Any]], sensor: str, taken: Collection[str] = ()
) -> dict[str, Any] | None:
    """Return the definition of an effect with the best shape, as a file in ``effects/`` holds it; None without one.

    Parameters
    ----------
    unknown : sequence of mapping
        What ``unexplained`` returned.
    sensor : str
    taken : collection of str
        Names of effects that there are.
    """
    if not unknown:
        return None
    entry = unknown[0]
    name = f"unknown_{entry['covariate']}"
    number = 2
    while name in taken:
        name, number = f"unknown_{entry['covariate']}_{number}", number + 1
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


def select_beside(
    selection: Selection,
    unknown: Sequence[Mapping[str, Any]],
    configured: Sequence[str],
    noise: Noise | None,
    sheet: Mapping[str, Any],
) -> Selection:
    """Select again with the best shape in the base: what the catalogue took of it, it takes no longer.

    Where the residual stays far above the noise even so, the shape is not what is missing, and nothing changes.

    Parameters
    ----------
    selection : Selection
    unknown : sequence of mapping
        What ``unexplained`` returned of it; where nothing was found, there is nothing to do.
    configured : sequence of str
    noise : Noise or None
    sheet : mapping
        As for ``selection.select``.
    """
    definition = suggested_effect(unknown, selection.observations.sensor, catalogue())
    if definition is None:
        return selection
    register(effect_from(definition, "a first guess"))
    try:
        again = select(selection.observations, [*configured, definition["name"]], noise, sheet)
    finally:
        forget(definition["name"])
    floor = 0.0 if noise is None else float(np.sqrt(np.mean(noise.white**2 + noise.wander**2)))
    return selection if 0.0 < FAR_ABOVE * floor < again.fit.residual_rms else again
