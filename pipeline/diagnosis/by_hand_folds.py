"""What a diagnosis by hand is worth on rests that it has not seen, although it uses all of them: by cross-validation.

Twenty rests are too few to keep every third from a selection. So the selection sees all, and every third rest (with the
move before it) is left out in turn, of ``FOLDS`` models:

    held_out_error : each step's effects, fitted without the rests on which they are judged
    nested         : selected and fitted without them; unbiased by the selection, too

The published calibration and its held-out error see nothing of this: its fit keeps its own every third rest out.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import PipelineError
from pipeline.estimation.accelerometer import nonlinear_least_squares
from pipeline.estimation.multi_position.fit import fit
from pipeline.estimation.multi_position.selection import FAR, select
from pipeline.model.effects import effect

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from pipeline.estimation.multi_position.model import Model, State
    from pipeline.estimation.multi_position.selection import Selection
    from pipeline.records import Noise, Recording, SensorCalibration

FOLDS = 3
SPARE = 2  # equations beyond the parameters, from which on a fold is judged


def with_all_rests(
    accelerometer: SensorCalibration, recordings: Sequence[Recording], noise: Noise | None, settings: Mapping[str, Any]
) -> SensorCalibration:
    """Return the accelerometer's calibration by all rests: it tells which of them contradict the others.

    Parameters
    ----------
    accelerometer : SensorCalibration
        Of its method; returned as it is where it has effects, or where all rests do not determine it.
    recordings : sequence of Recording
    noise : Noise or None
        Of the accelerometer, where it is known.
    settings : mapping
        Sections ``table`` and ``sensor``, and ``procedure`` with ``holdout_every`` 0.
    """
    known = {"noise": {"accelerometer": noise}} if noise is not None else {}
    if accelerometer.effects:
        return accelerometer
    try:
        return nonlinear_least_squares.fit(recordings, None, {**settings, **known})
    except PipelineError:
        return accelerometer


def held_out_errors(selection: Selection) -> list[float | None]:
    """Return the rms error, g or deg/s, of each of the selection's fits on rests that were left out of it in turn."""
    model = selection.model
    if model.held_out_error(selection.fits[0].state) is not None:  # a recording for validation
        return [model.held_out_error(found.state) for found in selection.fits]
    near = {n: FAR * limit for n, limit in selection.limits.items() if effect(n).nonlinear}
    errors = []
    for found in selection.fits:
        squares: list[float] = []
        for part, held in _folds(model):
            fitted = fit(part, found.state, selection.hypotheses, near)
            if len(fitted.residual) < fitted.rank + SPARE:
                squares = []
                break
            squares.append(_squared(part, fitted.state) * held)
        errors.append(float(np.sqrt(np.sum(squares) / len(model.rests.time))) if squares else None)
    return errors


def nested(
    selection: Selection, start: SensorCalibration, configured: Sequence[str], noise: Noise | None,
    sheet: Mapping[str, Any],
) -> dict[str, Any] | None:  # fmt: skip
    """Return what the whole procedure, selection included, is worth on rests that it does not see.

    Returns
    -------
    dict or None
        ``folds``, ``error_before`` and ``error_after`` (rms, g or deg/s) and ``named``: in how many of the folds each
        effect was selected. None where nothing was selected, or a recording for validation judges.
    """
    model = selection.model
    if not selection.names or model.held_out_error(selection.fits[0].state) is not None:
        return None
    named: dict[str, int] = {}
    squares = np.zeros(2)
    for part, held in _folds(model):
        found = select(part, start, configured, noise, sheet)
        for name in found.names:
            named[name] = named.get(name, 0) + 1
        squares += held * np.array([_squared(part, found.fits[k].state) for k in (0, -1)])
    before, after = np.sqrt(squares / len(model.rests.time)).tolist()
    return {"folds": FOLDS, "error_before": before, "error_after": after, "named": named}


def _folds(model: Model) -> Iterator[tuple[Model, int]]:
    """Return the models that leave out every third rest in turn, and how many each leaves out."""
    fold = np.arange(len(model.rests.time)) % FOLDS
    for k in range(FOLDS):
        held: NDArray[np.bool_] = fold == k
        yield model.without(held), int(held.sum())


def _squared(model: Model, state: State) -> float:
    error = model.held_out_error(state)
    return 0.0 if error is None else error**2
