"""Fit what formats of other programs can hold: a part of the matrix, and none or some of the effects.

The truth t of the full calibration at the samples of the fit is the reference. With the readings r without the effects
that a format holds, the accelerometer's matrix S and bias b minimise

    sum |t - S (r - b)|^2,    S: full, diagonal, or 1

S is that of the calibration where the attitudes do not determine it. A gyroscope turns to one side more than to the
other, so that a fitted bias would not be that at rest: its diagonal is ``s_i = K_ii / |K_i|^2``, with K the inverse of
the full matrix, and its bias contains the mean of the effects that are not held and do not depend on the rate, as the
bias of a fit without them does.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core.records import Reduced
from pipeline.evaluation.held_out.error_breakdown import rms_error_of, with_known_effects
from pipeline.physics.effects import effect_of, owner_of
from pipeline.physics.effects.base import OF_THE_BIAS, Owner

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.core.records import SensorCalibration, Values
    from pipeline.evaluation.held_out.samples import HeldOutCase, Samples

# part of the matrix, and effects, of the formats in ``pipeline/output/exports/templates``
HELD: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("full", ()),
    ("full", ("g_sensitivity",)),
    ("full", OF_THE_BIAS),
    ("full", (*OF_THE_BIAS, "scale_factor_temperature")),
    ("diagonal", ()),
    ("diagonal", OF_THE_BIAS),
    ("none", ()),
    ("none", OF_THE_BIAS),
)
LEAST_SPREAD_G = 0.1  # rms in each direction; in one attitude, effects alone would determine a matrix
FEWEST_ROWS = 6  # orientations, of which an axis has an offset and three factors
AT_REST_TOO = {"time", "temperature", "specific_force"}  # signals


def reduced(case: HeldOutCase, samples: Sequence[Samples], *, held_out: bool) -> list[Reduced]:
    """Return the best that each kind of format holds, with its error on samples; ``held_out``: no fit used them.

    Kinds that hold all of the calibration are left out, and all where the samples of the fit are too few. On a table,
    a calibration without effects needs no motion, and that of a gyroscope no samples: its bias remains.
    """
    calibration = case.calibration
    own = {e.name for e in calibration.effects if owner_of(e) == Owner.SENSOR}
    plain = held_out and not calibration.effects and not case.by_hand
    fitted, truth = samples, np.empty((0, 3))
    if not plain or calibration.sensor != "gyroscope":
        fitted = case.fit_samples(followed=not plain) if held_out else samples
        if sum(int(s.known.sum()) for s in fitted) < FEWEST_ROWS:
            return []
        truth = _calibrated(calibration, fitted)
    found: dict[tuple[str, frozenset[str]], Reduced] = {}
    for part, names in HELD:
        kept = frozenset(names) & own
        if (part, kept) in found or (part == "full" and kept == own):
            continue
        effects = tuple(e for e in calibration.effects if e.name in kept or e.name not in own)
        partial = replace(calibration, effects=effects)
        if calibration.sensor == "gyroscope":  # effects of the rate have no mean that a rest would have
            moving = [e for e in calibration.effects if not effect_of(e).fields("gyroscope", e.values) <= AT_REST_TOO]
            partial = replace(calibration, effects=tuple(e for e in calibration.effects if e in effects or e in moving))
        left = truth if partial.effects == calibration.effects else _calibrated(partial, fitted)
        bias, matrix = _fitted(calibration, part, left, truth)
        partial = replace(partial, effects=effects)
        error = rms_error_of(replace(partial, bias=bias, matrix=matrix), samples)
        found[part, kept] = Reduced(part, sorted(kept), bias.tolist(), matrix.tolist(), error)
    return list(found.values())


def _calibrated(calibration: SensorCalibration, samples: Sequence[Samples]) -> Values:
    """Return calibrated readings at samples that represent the recordings: (n, 3) array."""
    return np.concatenate([with_known_effects(calibration, s)[0][s.representative] for s in samples])


def _fitted(calibration: SensorCalibration, part: str, left: Values, truth: Values) -> tuple[Values, Values]:
    """Return bias and matrix; ``left``: calibrated readings without the effects that are not held, (n, 3)."""
    K = np.linalg.inv(calibration.matrix)
    diagonal = np.diag(np.diag(K) / np.sum(K**2, axis=1))
    matrix: Values = {"full": calibration.matrix, "diagonal": diagonal, "none": np.eye(3)}[part]
    if calibration.sensor == "gyroscope":
        if left is truth:
            return calibration.bias, matrix
        change = left - truth
        change = change[np.isfinite(change).all(axis=1)]
        return calibration.bias + np.mean(change @ K.T, axis=0), matrix
    known = np.isfinite(left + truth).all(axis=1)
    left, truth = left[known], truth[known]
    reading = left @ K.T  # minus the bias
    ones = np.ones((len(reading), 1))
    spread = np.linalg.svd(reading - reading.mean(axis=0), compute_uv=False)[-1] / np.sqrt(len(reading))
    if part == "none" or spread < LEAST_SPREAD_G:
        offset = np.mean(truth - reading @ matrix.T, axis=0)
    elif part == "full":
        *rows, offset = np.linalg.lstsq(np.hstack([reading, ones]), truth, rcond=None)[0]
        matrix = np.array(rows).T
    else:
        pairs = [np.linalg.lstsq(np.hstack([reading[:, [i]], ones]), truth[:, i], rcond=None)[0] for i in range(3)]
        matrix, offset = np.diag([p[0] for p in pairs]), np.array([p[1] for p in pairs])
    return calibration.bias - np.linalg.solve(matrix, offset), matrix
