"""The best of the simple shapes in one covariate, scored beside base, configured and selected effects.

The families are those of ``pipeline.diagnosis.shapes``, the score that of ``pipeline.diagnosis.leftover``.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.diagnosis import shapes
from pipeline.diagnosis.guess_words import Guess
from pipeline.diagnosis.leftover import Leftover

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from pipeline.diagnosis.leftover import Gain
    from pipeline.diagnosis.shapes import Shape
    from pipeline.estimation.selection import Selection

    Values = NDArray[np.float64]

CLEARLY = 10.0
MOST_HARMONICS = 3


def guess_of(selection: Selection, covariate: str) -> Guess:
    """Return the best shape in a covariate."""
    sensor = selection.observations.sensor
    if covariate == "angle":
        factors = ("", "u") if sensor == "gyroscope" else ("",)
        return max((_harmonic(selection, factor) for factor in factors), key=_worth)
    if covariate == "specific_force":
        signals = ["u"] if sensor == "accelerometer" else []
        return max((_polynomial(selection, covariate, s) for s in (*signals, "fx", "fy", "fz")), key=_worth)
    signal = "speed" if covariate == "rate" else covariate
    guesses = [best_scanned(selection, covariate, signal)[0], _polynomial(selection, covariate, signal)]
    if sensor == "gyroscope" and covariate == "rate":
        guesses.append(_polynomial(selection, covariate, "u"))
    return max(guesses, key=_worth)


def _worth(guess: Guess) -> float:
    return guess.gain.delta_bic


def _harmonic(selection: Selection, factor: str) -> Guess:
    """Return the harmonics of the table's angle, one and then another while that helps."""
    tried = shapes.harmonics(factor)
    texts = [text for shape in tried for text in shape.formulas]
    leftover = _leftover(selection, texts)
    chosen: list[int] = []
    gain: Gain | None = None
    while len(chosen) < MOST_HARMONICS:
        options = [[*chosen, n] for n in range(len(tried)) if n not in chosen]
        gains = [_of_harmonics(leftover, option) for option in options]
        best = int(np.argmax([g.delta_bic for g in gains]))
        if gain is not None and gains[best].delta_bic < gain.delta_bic + CLEARLY:
            break
        chosen, gain = options[best], gains[best]
    assert gain is not None  # noqa: S101
    cycles = [tried[n].figures["cycles"][0] for n in chosen]
    formulas = tuple(text for n in chosen for text in tried[n].formulas)
    shape = replace(tried[0], formulas=formulas, figures={"cycles": cycles})
    index = [k for n in chosen for k in (2 * n, 2 * n + 1)]
    found = _on_axes(leftover.coefficients(index, gain.setting), gain)
    amplitude = np.sqrt(np.sum(found.reshape(3, -1, 2) ** 2, axis=2)).max(axis=1)
    return Guess("angle", shape, gain, found, amplitude)


def _of_harmonics(leftover: Leftover, chosen: Sequence[int]) -> Gain:
    index = leftover.independent([k for n in chosen for k in (2 * n, 2 * n + 1)])
    if len(index) < 2 * len(chosen):
        return replace(leftover.gain(np.zeros_like(leftover.left), 1), delta_bic=-np.inf)
    return leftover.gain(leftover.drop(index)[:, :, -1], len(index), len(chosen))


def _polynomial(selection: Selection, covariate: str, signal: str) -> Guess:
    """Return the polynomial of the best order; powers that base or effects hold already are left out."""
    span = shapes.Span.of(selection.observations, _spanned(selection, signal))
    texts = shapes.powers(span, signal)
    leftover = _leftover(selection, texts)
    kept = leftover.independent(range(len(texts)))
    drops = leftover.drop(kept) if kept else np.zeros((*leftover.left.shape, 1))
    gains = [leftover.gain(drops[:, :, k], k + 1) for k in range(drops.shape[2])]
    best = int(np.argmax([g.delta_bic for g in gains]))
    index = kept[: best + 1]
    found = _on_axes(leftover.coefficients(index, gains[best].setting), gains[best])
    formulas = tuple(texts[k] for k in index)
    shape = shapes.Shape("polynomial", signal, formulas, 0, {"order": (index[-1] + 1) if index else 0})
    return Guess(covariate, shape, gains[best], found, _spread(selection, formulas, found))


def _spanned(selection: Selection, signal: str) -> str:
    if signal != "u":
        return signal
    return "fz" if selection.observations.sensor == "accelerometer" else "wz"


def best_scanned(selection: Selection, covariate: str, signal: str) -> tuple[Guess, float]:
    """Return the best step, band or exponential, and the log likelihood without it.

    It is the best of a coarse scan, then of a fine one about it.

    Parameters
    ----------
    selection : Selection
    covariate, signal : str
    """
    span = shapes.Span.of(selection.observations, signal)
    places = span.places()
    single = shapes.steps(span, places)
    if signal in ("temperature", "time"):
        single += shapes.soft_steps(span, places, [span.size / shapes.PLACES])
        single += shapes.exponentials(span, [span.size * c for c in shapes.CONSTANTS])
    pairs = shapes.bands(span, places) if signal == "speed" else []
    shape, gain, leftover, weights = _best_of(selection, single, pairs)
    fine = shapes.finer(shape, span)
    if fine:
        other = _best_of(selection, fine, [])
        if other[1].delta_bic > gain.delta_bic:
            shape, gain, leftover, weights = other
    inner = np.einsum("q,cqp,p->c", weights, leftover.inner[gain.setting], weights)
    found = _on_axes((leftover.cross[gain.setting] @ weights / np.maximum(inner, 1e-300))[:, None], gain)
    sizes = found[:, 0] if shape.kind != "exponential" else _spread(selection, shape.formulas, found)
    return Guess(covariate, shape, gain, found, sizes), leftover.before


def _best_of(
    selection: Selection, single: Sequence[Shape], pairs: Sequence[Shape]
) -> tuple[Shape, Gain, Leftover, Values]:
    """Return the best of shapes with one coefficient an axis, and which columns it is made of."""
    leftover = _leftover(selection, [shape.formulas[0] for shape in single])
    weights = np.zeros((len(single), len(single) + len(pairs)))
    weights[: len(single), : len(single)] = np.eye(len(single))
    for k, shape in enumerate(pairs):
        for j, value in shape.combination.items():
            weights[j, len(single) + k] = value
    drops = leftover.drops(weights)
    both = [*single, *pairs]
    scanned = np.array([shape.scanned for shape in both])
    order = np.argsort(-leftover.gains(drops, 3 + scanned))[:40]
    gains = {int(k): leftover.gain(drops[:, :, k], 1, both[k].scanned) for k in order}
    best = max(gains, key=lambda k: gains[k].delta_bic)
    return both[best], gains[best], leftover, weights[:, best]


def _leftover(selection: Selection, texts: Sequence[str]) -> Leftover:
    return Leftover(selection, shapes.columns_of(texts, selection.observations.sensor))


def _on_axes(coefficients: Values, gain: Gain) -> Values:
    kept = np.zeros_like(coefficients)
    kept[list(gain.axes)] = coefficients[list(gain.axes)]
    return kept


def _spread(selection: Selection, formulas: Sequence[str], coefficients: Values) -> Values:
    """Return by how much a shape changes over all rows: (3,) array."""
    if not formulas:
        return np.zeros(3)
    columns = shapes.columns_of(formulas, selection.observations.sensor)
    values = []
    for part in selection.observations.parts:
        value = columns(part.motion)
        each = value if value.ndim == 3 else np.broadcast_to(value[:, None, :], (len(value), 3, value.shape[1]))
        values.append(np.einsum("ncr,cr->nc", each, coefficients))
    spread: Values = np.ptp(np.concatenate(values), axis=0)
    return spread
