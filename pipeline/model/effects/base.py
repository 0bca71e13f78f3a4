"""What an effect is.

An effect adds to the reading of a sensor:

    reading = bias + K @ truth + z(motion, K; p),    K = matrix^-1

where ``p`` are its parameters and ``z`` vanishes at ``p = 0``. It says its value and its derivative; both in the
measurement direction, from a motion that has no noise, so that fitting it is linear wherever the physics is.
"""

from __future__ import annotations

import abc
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from pipeline.records import SENSORS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.records import Motion


class Owner(StrEnum):
    """Whose an effect is; only the sensor's are compensated in field logs."""

    SENSOR = "sensor"
    RECORDING = "recording"
    MOUNTING = "mounting"
    TABLE = "table"


@dataclass(frozen=True)
class Parameter:
    """One parameter of an effect: its name, unit and meaning."""

    name: str
    unit: str
    meaning: str


class Effect(abc.ABC):
    """A physical effect on the readings of a sensor.

    Attributes
    ----------
    name : str
    owner : Owner
    sensors : tuple of str
        The sensors to which it applies.
    needs : tuple of str
        What the recording must hold beside a motion: ``temperature``, ``angle``.
    excitation : str
        What a recording must do for this effect to show, as advice to the user.
    source : str
        Where the equation comes from.
    """

    name: ClassVar[str]
    owner: ClassVar[Owner]
    sensors: ClassVar[tuple[str, ...]] = SENSORS
    needs: ClassVar[tuple[str, ...]] = ()
    excitation: ClassVar[str]
    source: ClassVar[str]

    @abc.abstractmethod
    def parameters(self, sensor: str) -> tuple[Parameter, ...]:
        """Return the parameters for ``sensor``; units in g or deg/s and their products."""

    @abc.abstractmethod
    def columns(
        self, sensor: str, motion: Motion, K: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the derivative of the reading with respect to each parameter, at ``values``: (n, 3, p) array.

        Parameters
        ----------
        sensor : str
        motion : Motion
        K : (3, 3) array
            Inverse of the calibration matrix.
        values : (p,) array
        """

    def reading(
        self, sensor: str, motion: Motion, K: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return what the effect adds to the reading: (n, 3) array, g or deg/s.

        Linear effects have ``columns @ values``; the others override this with the exact value.
        """
        added: NDArray[np.float64] = self.columns(sensor, motion, K, values) @ values
        return added

    def available(self, motion: Motion) -> bool:
        """Return whether the motion holds what the effect needs."""
        return all(getattr(motion, need) is not None for need in self.needs)


def truth(sensor: str, motion: Motion) -> NDArray[np.float64]:
    """Return what an ideal sensor would read: (n, 3) array, specific force in g or angular rate in deg/s."""
    return motion.specific_force if sensor == "accelerometer" else motion.angular_rate


def truth_rate(sensor: str, motion: Motion) -> NDArray[np.float64]:
    """Return the time derivative of ``truth``: (n, 3) array, g/s or deg/s^2."""
    return motion.specific_force_rate if sensor == "accelerometer" else motion.angular_acceleration


def per_axis(regressors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Spread (n, 3) regressors, one coefficient an axis, to (n, 3, 3) columns."""
    out = np.zeros((len(regressors), 3, 3))
    out[:, [0, 1, 2], [0, 1, 2]] = regressors
    return out


def every_axis(regressors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Spread (n, q) regressors that act on each axis with coefficients of its own to (n, 3, 3 q) columns.

    Parameter order: all of x, then y, then z, so that ``values.reshape(3, q) @ regressors[i]`` is what is added.
    """
    n, q = regressors.shape
    out = np.zeros((n, 3, 3, q))
    out[:, [0, 1, 2], [0, 1, 2], :] = regressors[:, None, :]
    return out.reshape(n, 3, 3 * q)


def axis_parameters(symbol: str, unit: str, meaning: str) -> tuple[Parameter, ...]:
    """Return one parameter an axis, ``<symbol>_x .. <symbol>_z``."""
    return tuple(Parameter(f"{symbol}_{a}", unit, meaning) for a in "xyz")


def unit_of(sensor: str) -> str:
    """Return the unit of a sensor's readings."""
    return "g" if sensor == "accelerometer" else "deg/s"
