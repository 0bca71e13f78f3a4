"""The temperature of the unit over the whole session, and what its thermometer says of it.

    T(t) = T_ambient + dT (1 - exp(-t / tau)) + d sum_k sin(2 pi t / p_k + phase_k) / 2 + ramp(t)

where

T_ambient : room, degC
dT, tau   : warm-up after power-on, degC and s
d         : slow drift of the room, degC, with two periods p_k of half an hour to two hours
ramp      : triangle of a thermal chamber, degC: up, down below the room, and back
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True)
class Environment:
    """Temperature over time.

    Attributes
    ----------
    ambient, warm_up, drift : float, degC
    warm_up_time : float, s
    periods, phases : (2,) array, s and rad
        Of the room's drift.
    ramp, ramp_period : float, degC and s
        Amplitude of the chamber's triangle and its period; 0 where there is none.
    noise : float, degC
        Of the thermometer.
    """

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
        """Return what the thermometer says."""
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
