"""The parameters of a sensor's calibration: their names, units, values, covariance and degrees of freedom.

Every vector and covariance of parameters has this order: ``bias_x .. bias_z``; ``matrix_xx, matrix_xy .. matrix_zz``,
row by row; then ``<effect>.<parameter>``, or the parameters of a stage. The base is bias and matrix.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from imu_logs.units import AXES, SENSOR_UNITS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike

    from imu_logs.log import Index, Values

BIAS_NAMES = tuple(f"bias_{axis}" for axis in AXES)
MATRIX_NAMES = tuple(f"matrix_{row}{column}" for row in AXES for column in AXES)
BASE_NAMES = BIAS_NAMES + MATRIX_NAMES
BASE_COUNT = len(BASE_NAMES)
BASE, AFTER_BASE = slice(0, BASE_COUNT), slice(BASE_COUNT, None)
BIAS, MATRIX = slice(0, len(BIAS_NAMES)), slice(len(BIAS_NAMES), BASE_COUNT)
MATRIX_ROWS = tuple(slice(start, start + len(AXES)) for start in range(MATRIX.start, MATRIX.stop, len(AXES)))


def base_units(sensor: str) -> tuple[str, ...]:
    """Return the units of bias and matrix."""
    return (SENSOR_UNITS[sensor],) * len(BIAS_NAMES) + ("1",) * len(MATRIX_NAMES)


def base_values(bias: Values, matrix: Values) -> Values:
    """Return bias and matrix in the order of the parameters: (12,) array."""
    return np.concatenate([bias, matrix.ravel()])


def matrix_of(values: Values) -> Values:
    """Return the matrix of (p,) parameters: (3, 3) array."""
    return values[MATRIX].reshape(len(AXES), len(AXES))


def coverage_factor(degrees_of_freedom: ArrayLike, probability: float = 0.95) -> Values:
    """Return the two-sided coverage factor k of Student's t, in the shape of ``degrees_of_freedom``.

    k solves ``P(|t_nu| <= k) = probability`` (JCGM 100:2008, annex G); for infinite ``nu`` it is the normal quantile.
    """
    from scipy.special import ndtri, stdtrit  # noqa: PLC0415  (0.1 s, only needed to write uncertainties)

    nu, upper = np.asarray(degrees_of_freedom, float), 0.5 + probability / 2.0
    limited = np.isfinite(nu)
    factors: Values = np.where(limited, stdtrit(np.where(limited, nu, 1.0), upper), ndtri(upper))[()]
    return factors


def standard_uncertainty(covariance: Values) -> Values:
    """Return the standard uncertainties of a (p, p) covariance: (p,) array; rounding below 0 counts as 0."""
    return np.sqrt(np.clip(np.diag(covariance), 0.0, None))


@dataclass(frozen=True)
class Estimate:
    """The value of a parameter."""

    value: float
    unit: str
    standard_uncertainty: float | None = None


@dataclass(frozen=True)
class Parameters:
    """p parameters of a sensor, or some of them."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Values  # (p,)
    covariance: Values  # (p, p); zeros if it is unknown
    degrees_of_freedom: Values  # (p,), effective ones

    def __len__(self) -> int:
        return len(self.names)

    @property
    def standard_uncertainty(self) -> Values:
        """Standard uncertainty of each parameter: (p,) array."""
        return standard_uncertainty(self.covariance)

    @property
    def coverage_factor(self) -> Values:
        """Coverage factor of each parameter for 95 %: (p,) array."""
        return coverage_factor(self.degrees_of_freedom)

    @property
    def expanded_uncertainty(self) -> Values:
        """Expanded uncertainty of each parameter, 95 %: (p,) array."""
        return self.coverage_factor * self.standard_uncertainty

    def places(self, names: Sequence[str]) -> Index:
        """Return the places of parameters by their names; ``ValueError`` with the names that are none of these."""
        if unknown := [name for name in names if name not in self.names]:
            raise ValueError(f"no parameter {', '.join(unknown)}; there are {', '.join(self.names)}")
        return np.array([self.names.index(name) for name in names], np.intp)

    def of_effect(self, name: str) -> slice:
        """Return the places of an effect's parameters; an empty slice if the effect is not among them."""
        places = [k for k, each in enumerate(self.names) if each.startswith(f"{name}.")]
        return slice(places[0], places[-1] + 1) if places else slice(0, 0)

    def select(self, selected: slice | Index) -> Parameters:
        """Return the parameters at these places."""
        at = np.arange(len(self))[selected]
        return Parameters(
            tuple(self.names[k] for k in at),
            tuple(self.units[k] for k in at),
            self.values[at],
            self.covariance[np.ix_(at, at)],
            self.degrees_of_freedom[at],
        )
