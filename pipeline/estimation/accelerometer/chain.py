"""The stages of the staged accelerometer, followed one after the other, and what they are in the contract's form.

Each stage computes factors or offsets from the extremes of the turns as the stages before it leave them, and corrects
the extremes by them for the next:

    extremes -> orthogonality -> misalignment -> bias -> scale_factor

A stage is a module of this package with a function ``outcome(extremes, gravity_g, as_printed) -> Outcome``.

The contract's form of the corrections so far is, for each axis,

    reading = bias + k u + c |u|,   k = (1/P + 1/N) / 2,   c = (1/P - 1/N) / 2,   matrix_ii = 1 / k

where P and N are the products of all factors of the positive and the negative side, with both sides of the factors of
orthogonality and misalignment averaged, and ``bias`` is the reading that is corrected to zero.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.records import AXES

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from pipeline.estimation.accelerometer.extremes import Extremes


@dataclass(frozen=True)
class Outcome:
    """What one stage found.

    Attributes
    ----------
    steps : list of dict
        Its steps of the correction, see ``pipeline.estimation.correction``.
    values : dict of str to (float, str)
        Value and unit of each of its parameters.
    positive, negative : (3,) array
        Its factors in the contract's form.
    subtracted : (3,) array, g
        What it takes off.
    """

    steps: list[dict[str, Any]]
    values: dict[str, tuple[float, str]]
    positive: NDArray[np.float64] = field(default_factory=lambda: np.ones(3))
    negative: NDArray[np.float64] = field(default_factory=lambda: np.ones(3))
    subtracted: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))


def per_axis(name: str, values: NDArray[np.float64], unit: str) -> dict[str, tuple[float, str]]:
    """Return ``<name>_x .. <name>_z`` with a unit."""
    return {f"{name}_{axis}": (float(value), unit) for axis, value in zip(AXES, values, strict=True)}


@dataclass(frozen=True)
class Chain:
    """The stages up to one of them, followed.

    Attributes
    ----------
    steps : list of dict
        The correction up to and including the last stage.
    outcome : Outcome
        Of the last stage.
    bias : (3,) array, g
    positive, negative : (3,) array
        P and N.
    """

    steps: list[dict[str, Any]]
    outcome: Outcome
    bias: NDArray[np.float64]
    positive: NDArray[np.float64]
    negative: NDArray[np.float64]

    @property
    def k(self) -> NDArray[np.float64]:
        """Reading per g, mean of both sides: (3,) array."""
        return (1.0 / self.positive + 1.0 / self.negative) / 2.0

    @property
    def c(self) -> NDArray[np.float64]:
        """Half the difference of both sides: (3,) array."""
        return (1.0 / self.positive - 1.0 / self.negative) / 2.0

    def vector(self) -> NDArray[np.float64]:
        """Return bias, matrix, c and the last stage's parameters in one vector."""
        values = [value for value, _ in self.outcome.values.values()]
        return np.concatenate([self.bias, np.diag(1.0 / self.k).ravel(), self.c, values])


def follow(extremes: Extremes, names: Sequence[str], gravity_g: float, *, as_printed: bool) -> Chain:
    """Run stages one after the other, each on the output of the one before.

    Parameters
    ----------
    extremes : Extremes
        Of the uncorrected readings.
    names : sequence of str
        Stages, in order; at least one.
    gravity_g : float, g
    as_printed : bool
    """
    steps: list[dict[str, Any]] = []
    bias, positive, negative = np.zeros(3), np.ones(3), np.ones(3)
    for name in names:
        outcome = import_module(f"{__package__}.{name}").outcome(extremes, gravity_g, as_printed=as_printed)
        bias = bias + outcome.subtracted * (1.0 / positive + 1.0 / negative) / 2.0
        positive, negative = positive * outcome.positive, negative * outcome.negative
        for step in outcome.steps:
            extremes = extremes.corrected(step, as_printed=as_printed)
        steps += outcome.steps
    return Chain(steps, outcome, bias, positive, negative)
