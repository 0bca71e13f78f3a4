"""Whether a calibration does harm: held-out errors after it against those of the raw readings.

The squared errors of both are compared in pairs over B stretches of the held-out samples (rests count one by one),

    d_b = mean over stretch b of (e_calibrated^2 - e_raw^2),    t = mean(d) sqrt(B) / s(d)

A calibration is worse than none where Student's t with B - 1 degrees of freedom exceeds that with ``P = LEVEL`` and the
calibrated error is above the interval in which it is expected (``pipeline.validation.expected``): noise and stated
uncertainties do not explain it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.model.effects.base import unit_of
from pipeline.validation.ladder import last_step

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.records import SensorCalibration
    from pipeline.validation.samples import Samples

LEVEL = 1e-3  # chance that a calibration as good as none is refused
STRETCHES, FEWEST = 20, 5  # a stretch of a recording of minutes is longer than most wander stays alike


def worse_than_raw(
    calibration: SensorCalibration,
    samples: Sequence[Samples],
    expected: Sequence[float] | None,
    other: SensorCalibration | None,
) -> str | None:
    """Return why a calibration must not be used, as one sentence; None where it may.

    Parameters
    ----------
    calibration : SensorCalibration
    samples : sequence of Samples
        Held out.
    expected : (low, high) or None
        Where the rms error should lie; None: nothing is said.
    other : SensorCalibration or None
        Of the other sensor.
    """
    if expected is None:
        return None
    before, after = [], []
    for held in samples:
        found = last_step(calibration, held, other)
        if found is None:
            return None
        known = held.known
        before.append((np.linalg.norm(held.reading, axis=1) - held.magnitude)[known])
        after.append((np.linalg.norm(found[0], axis=1) - found[1])[known])
    raw, left = np.concatenate(before), np.concatenate(after)
    sizes = [float(np.sqrt(np.mean(e**2))) for e in (raw, left)]
    if sizes[1] <= max(sizes[0], expected[1]) or len(raw) < FEWEST:
        return None
    pieces = np.array_split(left**2 - raw**2, min(STRETCHES, len(raw)))
    means = np.array([piece.mean() for piece in pieces])
    spread = float(means.std(ddof=1))
    from scipy.special import stdtrit  # noqa: PLC0415  (only where the calibration seems to do harm)

    if means.mean() * np.sqrt(len(means)) <= stdtrit(len(means) - 1, 1.0 - LEVEL) * spread:
        return None
    unit = unit_of(calibration.sensor)
    return (
        f"the calibration makes held-out motion worse: {sizes[0]:.3g} {unit} rms before it, {sizes[1]:.3g} {unit} "
        f"after, where noise and stated uncertainties leave at most {expected[1]:.3g} {unit}. Check that fit and "
        "held-out recordings are of this unit in the same mounting, and what the table logged"
    )
