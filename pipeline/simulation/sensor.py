"""A simulated sensor: what it reads in a true motion.

    reading = clip(round(c (bias + K truth + effects + noise)) / c),   noise[n] = white w[n] + wander m[n]
    m[n+1] = r m[n] + sqrt(1 - r^2) w'[n],   r = exp(-(t[n+1] - t[n]) / T)

where

K      : (3, 3), scale factor, non-orthogonality and mounting in one, ``K = matrix^-1``
c      : counts per g or deg/s
white  : noise density * sqrt(1 / (2 dt)): the band up to Nyquist, unit of the sensor
wander : standard deviation of the bias wander m, a Gauss-Markov process with correlation time T, which goes on between
         the recordings of a session
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.model.effects import effect
from pipeline.model.effects.base import truth

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from pipeline.model.effects.base import Effect
    from pipeline.records import Motion


@dataclass(frozen=True)
class SimulatedSensor:
    """One accelerometer or gyroscope with known errors.

    Attributes
    ----------
    sensor : str
        ``accelerometer`` or ``gyroscope``.
    sheet : mapping
        The sensor's section of the configuration (full scale, counts, noise).
    bias : (3,) array, g or deg/s
    matrix : (3, 3) array
        The calibration matrix that a perfect calibration finds, body = matrix @ (reading - bias - effects).
    effects : dict of str to array
        Values of the parameters of each effect on the reading.
    kinds : dict of str to Effect
        Effects that are not in the catalogue, by name.
    """

    sensor: str
    sheet: Mapping[str, Any]
    bias: NDArray[np.float64]
    matrix: NDArray[np.float64]
    effects: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    kinds: dict[str, Effect] = field(default_factory=dict)

    def exact(self, motion: Motion) -> NDArray[np.float64]:
        """Return the reading without noise and quantisation: (n, 3) array."""
        K = np.asarray(np.linalg.solve(self.matrix, np.eye(3)), np.float64)
        reading: NDArray[np.float64] = self.bias + truth(self.sensor, motion) @ K.T
        for name, values in self.effects.items():
            reading = reading + self.kind(name).reading(self.sensor, motion, K, values)
        return reading

    def kind(self, name: str) -> Effect:
        """Return an effect by name: one of its own, or of the catalogue."""
        return self.kinds.get(name) or effect(name)

    def white(self, interval: float) -> float:
        """Return the standard deviation of one sample's white noise; interval in s."""
        return float(self.sheet["noise_density"]) * float(np.sqrt(0.5 / interval))

    def quantised(self, reading: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the reading in whole counts, at most at full scale: (n, 3) array, g or deg/s."""
        counts = np.round(reading * self.sheet["counts_per_unit"])
        top = self.sheet["full_scale"] * self.sheet["counts_per_unit"]
        kept: NDArray[np.float64] = np.clip(counts, -top, top - 1.0) / self.sheet["counts_per_unit"]
        return kept

    @property
    def decimals(self) -> int:
        """Decimals that keep a printed reading within a tenth of a count."""
        return int(np.ceil(np.log10(self.sheet["counts_per_unit"]))) + 1


def bias_wander(
    sessions: list[NDArray[np.float64]], correlation_time: float, rng: np.random.Generator
) -> list[NDArray[np.float64]]:
    """Return one realisation of a stationary Gauss-Markov process of unit variance for three axes.

    Parameters
    ----------
    sessions : list of (n,) arrays, s
        Sample times of one recording after the other; each evenly sampled.
    correlation_time : float, s
    rng : Generator

    Returns
    -------
    list of (n, 3) arrays
    """
    from scipy.signal import lfilter  # noqa: PLC0415  (0.3 s, needed where readings are made alone)

    out, last, before = [], rng.standard_normal(3), sessions[0][0]
    for time in sessions:
        step = (time[-1] - time[0]) / (len(time) - 1) if len(time) > 1 else 0.0
        r = np.exp(-step / correlation_time)
        across = np.exp(-(time[0] - before) / correlation_time)
        drive = np.sqrt(1.0 - r * r) * rng.standard_normal((len(time), 3))
        drive[0] = across * last + np.sqrt(1.0 - across * across) * rng.standard_normal(3)
        process = lfilter([1.0], [1.0, -r], drive, axis=0)
        out.append(process)
        last, before = process[-1], time[-1]
    return out
