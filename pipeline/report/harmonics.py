"""Harmonics of a residual over turns, and what noise alone would show of them.

    e = sum_k a_k cos k A + b_k sin k A,    amplitude_k = sqrt(a_k^2 + b_k^2)

where A is the table's angle. 1 cycle a turn is misalignment, tilt or encoder, 2 and 4 quadratic nonlinearity or
asymmetry, 3 cubic nonlinearity; more are gears and steps of the table.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.report.residuals import BINS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.report.residuals import Residual

HARMONICS = 12
ONE_IN_A_THOUSAND = float(np.sqrt(2.0 * np.log(1000.0)))  # of a Rayleigh distribution


def angle_bins(angle: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return in which of 36 bins of a turn each of (n,) angles in deg lies, and how many lie in each bin."""
    cell = (np.mod(angle, 360.0) * (BINS / 360.0)).astype(np.int64) % BINS
    return cell, np.bincount(cell, minlength=BINS)


def harmonics(residual: Residual) -> NDArray[np.float64] | None:
    """Return the amplitudes of 0 to 12 cycles a turn: (13, 3) array, None where not all angles of a turn were visited.

    From means in 36 bins of the angle; ``sinc`` undoes what averaging over a bin takes away.
    """
    angle = residual.motion.angle
    if angle is None:
        return None
    cell, count = angle_bins(angle)
    if not count.all():
        return None
    mean = np.stack([np.bincount(cell, e, BINS) / count for e in residual.error.T], 1)
    amplitude = np.abs(np.fft.rfft(mean, axis=0))[: HARMONICS + 1] * (2.0 / BINS)
    amplitude[0] /= 2.0
    scaled: NDArray[np.float64] = amplitude / np.sinc(np.arange(HARMONICS + 1) / BINS)[:, None]
    return scaled


def harmonic_noise(
    residual: Residual, white: NDArray[np.float64], wander: NDArray[np.float64], time: float
) -> NDArray[np.float64]:
    """Return the amplitude that noise alone exceeds once in a thousand, by cycles a turn: (13,) array.

    ``a^2 + b^2`` of a harmonic has the mean ``2 (2 white^2 / n + 2 S(f) / D)``, where S is the two-sided spectrum of
    the wander, ``2 s^2 T / (1 + (2 pi f T)^2)``, D the time that was recorded, and n the samples, as many as they are
    worth where the bins hold unequally many: ``1 / n`` is the mean of ``1 / (36 n_bin)``.

    Parameters
    ----------
    residual : Residual
    white, wander : (3,) array
        Standard deviations; the largest axis counts.
    time : float, s
        Correlation time of the wander.
    """
    motion = residual.motion
    assert motion.angle is not None  # noqa: S101
    duration = max(float(np.ptp(motion.time)), 1e-9)
    turns = max(float(np.abs(np.diff(motion.angle)).sum()) / 360.0, 1.0)
    frequency = np.arange(HARMONICS + 1) * turns / duration
    spectrum = 2.0 * float(wander.max()) ** 2 * time / (1.0 + (2.0 * np.pi * frequency * time) ** 2)
    each = float(white.max()) ** 2 * float(np.mean(1.0 / np.maximum(angle_bins(motion.angle)[1], 1))) / BINS
    spread = np.sqrt(2.0 * each + 2.0 * spectrum / duration)
    spread[0] = np.hypot(np.sqrt(each), wander.max())  # a mean, not an amplitude
    level: NDArray[np.float64] = ONE_IN_A_THOUSAND * spread
    return level
