"""Readings of a simulated sensor in a true motion, and the temperature of the unit.

    reading = clip(round(c (bias + K truth + effects + noise)) / c),   noise[n] = white w[n] + wander m[n]
    m[n+1] = r m[n] + sqrt(1 - r^2) w'[n],   r = exp(-(t[n+1] - t[n]) / T)

where

K      : (3, 3), scale factor, non-orthogonality and mounting in one, ``K = matrix^-1``
c      : counts per g or deg/s
white  : noise density * sqrt(1 / (2 dt)): the band up to Nyquist, unit of the sensor
wander : standard deviation of the bias wander m, a Gauss-Markov process with correlation time T, which goes on between
         the recordings of a session

The temperature over the session is

    T(t) = T_ambient + dT (1 - exp(-t / tau)) + d sum_k sin(2 pi t / p_k + phase_k) / 2 + ramp(t)

where

T_ambient : room, degC
dT, tau   : warm-up after power-on, degC and s
d         : slow drift of the room, degC, with two periods p_k of half an hour to two hours
ramp      : triangle of a thermal chamber, degC: up, down below the room, and back
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
    sheet : mapping
        The sensor's section of the configuration (full scale, counts, noise).
    bias : (3,) array, g or deg/s
    matrix : (3, 3) array
        What a perfect calibration finds: body = matrix @ (reading - bias - effects).
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
    """Return a stationary Gauss-Markov process of unit variance for three axes: (n, 3) array of each recording.

    ``sessions``: (n,) sample times of one recording after the other, s, each evenly sampled.
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


@dataclass(frozen=True)
class Environment:
    """Temperature over time: degC, s and rad, as in the equation above; ``noise``: of the thermometer."""

    ambient: float
    warm_up: float
    warm_up_time: float
    drift: float
    periods: NDArray[np.float64]
    phases: NDArray[np.float64]
    ramp: float = 0.0
    ramp_period: float = 3600.0
    noise: float = 0.03

    def temperature(self, time: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the true temperature: (n,) array, degC; time in s since power-on."""
        room = np.sin(2.0 * np.pi * time[:, None] / self.periods + self.phases).sum(1) / 2.0
        triangle = 2.0 / np.pi * np.arcsin(np.sin(2.0 * np.pi * time / self.ramp_period))
        warm = self.warm_up * (1.0 - np.exp(-time / self.warm_up_time))
        total: NDArray[np.float64] = self.ambient + warm + self.drift * room + self.ramp * triangle
        return total

    def reading(self, time: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        """Return the thermometer's reading: (n,) array, degC."""
        return self.temperature(time) + self.noise * rng.standard_normal(len(time))


def random_environment(rng: np.random.Generator, *, ramp: float = 0.0, ramp_period: float = 3600.0) -> Environment:
    """Return a room at about 25 degC (Sudsanguan 2019, 5.1) in which the unit warms up by a few degrees."""
    return Environment(
        ambient=25.0 + rng.uniform(-1.0, 1.0),
        warm_up=rng.uniform(3.0, 6.0),
        warm_up_time=rng.uniform(200.0, 400.0),
        drift=0.3,
        periods=rng.uniform(1800.0, 7200.0, 2),
        phases=rng.uniform(0.0, 2.0 * np.pi, 2),
        ramp=ramp,
        ramp_period=ramp_period,
    )
