"""The parameters of a sensor's calibration, and its uncertainty budget.

Parameters have names, units, values, a covariance and degrees of freedom. The budget has lines, the sources that it
does not include, and a Monte Carlo run.

Every vector and covariance of parameters has this order: ``bias_x .. bias_z``; ``matrix_xx, matrix_xy .. matrix_zz``,
row by row; then ``<effect>.<parameter>``, or the parameters of a stage. The base is bias and matrix.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from imu_logs.log import Index, Mask, Values
from imu_logs.units import AXES, SENSOR_UNITS

BIAS_NAMES = tuple(f"bias_{axis}" for axis in AXES)
MATRIX_NAMES = tuple(f"matrix_{row}{column}" for row in AXES for column in AXES)
BASE_NAMES = BIAS_NAMES + MATRIX_NAMES
BASE_COUNT = len(BASE_NAMES)
BASE, AFTER_BASE = slice(0, BASE_COUNT), slice(BASE_COUNT, None)
BIAS, MATRIX = slice(0, len(BIAS_NAMES)), slice(len(BIAS_NAMES), BASE_COUNT)
MATRIX_ROWS = tuple(slice(start, start + len(AXES)) for start in range(MATRIX.start, MATRIX.stop, len(AXES)))
NORMAL, RECTANGULAR = "normal", "rectangular"
LIMIT = "not determined by the recordings: limit of the sensor file"  # a source of the uncertainty budget
NOT_ESTIMATED = "not estimated by the method: "  # begins its remark where no stage estimates the elements that follow
LACK_OF_FIT = "lack of fit"  # a part of the noise of the readings
PART_NAMES = {"white": "white noise", "wander": "bias wander", "lack_of_fit": LACK_OF_FIT}
PART_NAMES |= {"wander_and_scatter": "bias wander and scatter of the rests"}
PLAIN = {float, str, int, bool, type(None)}  # types of most values of a record, which JSON holds unchanged
MONTE_CARLO = "monte_carlo"  # key of the run in a published budget


def as_json(value: Any) -> Any:  # noqa: ANN401  (a record, or a value in one)
    """Return the JSON value of a record: its fields by name, arrays and tuples as lists."""
    if type(value) in PLAIN:
        return value
    if isinstance(value, (np.ndarray, np.generic)):  # a tuple: a union takes three times as long
        return value.tolist()
    if isinstance(value, (list, tuple)):
        return [each if type(each) in PLAIN else as_json(each) for each in value]
    if is_dataclass(value):
        value = vars(value)
    if type(value) is dict or isinstance(value, Mapping):
        return {key: each if type(each) in PLAIN else as_json(each) for key, each in value.items()}
    return value


def with_arrays(entries: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of a document with arrays in place of lists."""
    return {key: np.array(value) if isinstance(value, list) else value for key, value in entries.items()}


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
    """Return the standard uncertainties of (..., p, p) covariances: (..., p) array; rounding below 0 counts as 0."""
    return np.sqrt(np.clip(np.diagonal(covariance, axis1=-2, axis2=-1), 0.0, None))


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
        names, units = tuple(self.names[k] for k in at), tuple(self.units[k] for k in at)
        return Parameters(names, units, self.values[at], self.covariance[np.ix_(at, at)], self.degrees_of_freedom[at])


@dataclass(frozen=True)
class NoiseParts:
    """The known parts of the noise of the readings: (p,) standard uncertainties; None: not separate."""

    white: Values | None = None
    wander: Values | None = None
    lack_of_fit: Values | None = None  # that noise does not explain: 0 in a correct model
    wander_and_scatter: Values | None = None  # of rests by hand

    def mapped(self, change: Callable[[Values], Values]) -> NoiseParts:
        """Return the parts with each changed by a function."""
        return NoiseParts(**{name: values if values is None else change(values) for name, values in vars(self).items()})

    def to_json(self) -> dict[str, list[float]]:
        """Return the entry of the document."""
        return {PART_NAMES[name]: values for name, values in as_json(self).items() if values is not None}

    @classmethod
    def from_json(cls, data: Mapping[str, list[float]]) -> Self:
        """Return the object from the value of ``to_json``."""
        return cls(**{part: np.array(data[name], float) for part, name in PART_NAMES.items() if name in data})


@dataclass(frozen=True)
class BudgetLine:
    """One line of an uncertainty budget: the share of one source (JCGM 100:2008, 8 and annex H)."""

    source: str
    kind: str  # A (from the scatter of these recordings) or B (from other knowledge)
    distribution: str  # assumed for the input
    standard_uncertainty: Values  # (p,), of the parameters, from this source only
    degrees_of_freedom: Values  # (p,)
    input_uncertainty: float | None = None  # standard uncertainty; None if the source is not a single quantity
    input_unit: str = ""
    independent: int = 1  # number of independent quantities with this uncertainty (stops of a table, axes)
    parts: NoiseParts = NoiseParts()
    remark: str = ""

    def at(self, rows: Sequence[int | None]) -> BudgetLine:
        """Return the line of some parameters, by their places; None: a parameter without an uncertainty."""
        u, freedom = _at(self.standard_uncertainty, rows), _at(self.degrees_of_freedom, rows, np.inf)
        parts = self.parts.mapped(lambda values: _at(values, rows))
        return replace(self, standard_uncertainty=u, degrees_of_freedom=freedom, parts=parts)

    def to_json(self) -> dict[str, Any]:
        """Return the published line; the sensitivity is contribution / input uncertainty."""
        contribution, u = self.standard_uncertainty, self.input_uncertainty
        return {
            "source": self.source,
            "type": self.kind,
            "distribution": self.distribution,
            "standard_uncertainty": u,
            "unit": self.input_unit,
            "independent_inputs": self.independent,
            "sensitivity": (contribution / u).tolist() if u else None,
            "contribution": contribution.tolist(),
            "degrees_of_freedom": finite(self.degrees_of_freedom),
            "parts": self.parts.to_json(),
            "remark": self.remark,
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """Return the object from the value of ``to_json``."""
        return cls(
            data["source"],
            data["type"],
            data["distribution"],
            np.array(data["contribution"], float),
            unlimited(data["degrees_of_freedom"]),
            data["standard_uncertainty"],
            data["unit"],
            data["independent_inputs"],
            NoiseParts.from_json(data["parts"]),
            data["remark"],
        )


@dataclass(frozen=True)
class Contribution:
    """The share of one source with its covariance; the fields are those of ``BudgetLine``."""

    source: str
    kind: str
    distribution: str
    covariance: Values  # (p, p), of the parameters, from this source only
    degrees_of_freedom: Values  # (p,)
    input_uncertainty: float | None = None
    input_unit: str = ""
    independent: int = 1
    parts: NoiseParts = NoiseParts()
    remark: str = ""

    @property
    def standard_uncertainty(self) -> Values:
        """Standard uncertainty of each parameter from this source: (p,) array."""
        return standard_uncertainty(self.covariance)

    def of(self, selected: slice) -> Contribution:
        """Return the contribution to the selected parameters."""
        parts = self.parts.mapped(lambda values: values[selected])
        freedom = self.degrees_of_freedom[selected]
        return replace(self, covariance=self.covariance[selected, selected], degrees_of_freedom=freedom, parts=parts)

    def line(self) -> BudgetLine:
        """Return the line of the budget."""
        others = {key: value for key, value in vars(self).items() if key != "covariance"}
        return BudgetLine(standard_uncertainty=self.standard_uncertainty, **others)


@dataclass(frozen=True)
class NotIncluded:
    """A source that a budget does not include."""

    source: str
    reason: str
    up_to: Mapping[str, float] = field(default_factory=dict)  # largest error, of ``bias`` or of ``matrix`` (relative)

    def to_json(self) -> dict[str, Any]:
        """Return the published entry."""
        return {"source": self.source, "reason": self.reason} | ({"up_to": dict(self.up_to)} if self.up_to else {})


@dataclass(frozen=True)
class MonteCarlo:
    """A Monte Carlo run and its comparison with the law of propagation (JCGM 101:2008, 8); arrays: (p,)."""

    trials: int
    seed: int
    digits: int
    estimate: Values
    expanded_uncertainty: Values  # by the law of propagation
    mean: Values
    standard_uncertainty: Values
    low: Values  # ends of the coverage interval, 95 %
    high: Values
    tolerance: Values
    d_low: Values  # differences of the ends
    d_high: Values
    validated: Mask

    def at(self, rows: Sequence[int | None]) -> MonteCarlo:
        """Return the run of some parameters; None: one without an uncertainty."""
        values = {key: values for key, values in vars(self).items() if isinstance(values, np.ndarray)}
        arrays: dict[str, Any] = {key: _at(each, rows, key == "validated") for key, each in values.items()}
        return replace(self, **arrays)

    def to_json(self) -> dict[str, Any]:
        """Return the published entry."""
        return {"trials": self.trials, "reason": None, **as_json(self), "all_validated": bool(self.validated.all())}


@dataclass(frozen=True)
class NoMonteCarlo:
    """The reason why there is no Monte Carlo run although it is configured."""

    reason: str

    def to_json(self) -> dict[str, Any]:
        """Return the published entry."""
        return {"trials": 0, "reason": self.reason}


def _run_from_json(data: Mapping[str, Any] | None) -> MonteCarlo | NoMonteCarlo | None:
    if data is None:
        return None
    if not data["trials"]:
        return NoMonteCarlo(data["reason"])
    return MonteCarlo(**with_arrays({each.name: data[each.name] for each in fields(MonteCarlo)}))


@dataclass(frozen=True)
class Budget:
    """The budget of a calibration; the totals are those of its parameters."""

    lines: tuple[BudgetLine, ...]
    not_included: tuple[NotIncluded, ...]
    monte_carlo: MonteCarlo | NoMonteCarlo | None = None

    def at(self, rows: Sequence[int | None]) -> Budget:
        """Return the budget of some parameters, by their places; None: a parameter without an uncertainty."""
        run = self.monte_carlo
        run = run.at(rows) if isinstance(run, MonteCarlo) else run
        return replace(self, lines=tuple(line.at(rows) for line in self.lines), monte_carlo=run)

    def to_json(self, parameters: Parameters) -> dict[str, Any]:
        """Return the published budget; ``parameters``: of the calibration."""
        document = {
            "parameters": list(parameters.names),
            "units": list(parameters.units),
            "contributions": [line.to_json() for line in self.lines],
            "standard_uncertainty": parameters.standard_uncertainty.tolist(),
            "effective_degrees_of_freedom": finite(parameters.degrees_of_freedom),
            "coverage_factor": parameters.coverage_factor.tolist(),
            "expanded_uncertainty": parameters.expanded_uncertainty.tolist(),
            "not_included": [entry.to_json() for entry in self.not_included],
        }
        return document if self.monte_carlo is None else document | {MONTE_CARLO: self.monte_carlo.to_json()}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """Return the object from the value of ``to_json``."""
        lines = tuple(map(BudgetLine.from_json, data.get("contributions", ())))
        left_out = tuple(NotIncluded(**entry) for entry in data.get("not_included", ()))
        return cls(lines, left_out, _run_from_json(data.get(MONTE_CARLO)))


def _at(values: Values, rows: Sequence[int | None], absent: float = 0.0) -> Values:
    """Return the values at these places, and ``absent`` in place of None."""
    return np.array([absent if row is None else values[row] for row in rows], values.dtype)


def finite(values: Values) -> list[float | None]:
    """Return a list for JSON, with None in place of values that are not finite."""
    return [v if math.isfinite(v) else None for v in np.asarray(values, float).tolist()]


def unlimited(values: list[float | None]) -> Values:
    """Return the degrees of freedom from the value of ``finite``: infinite in place of None."""
    return np.array([np.inf if value is None else value for value in values])
