"""What a procedure would find of one effect: the smallest size, and the look-alikes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from numpy.typing import NDArray

    from pipeline.model.effects.base import Effect

STEPS = 14  # of bisection: a factor of 1e11 to 0.2 %
LEAST, LARGEST = 1e-8, 1e3  # share of the limits
ALMOST_SURE = 0.95
ALIKE = 0.8
PARTLY = 0.3  # share of a signal below which an effect cannot be preferred for having fewer parameters


@dataclass(frozen=True)
class Detection:
    """What a procedure would find of one effect; sizes as shares of its limits.

    Attributes
    ----------
    effect : str
    unit_sizes : (p,) array
        Size of each parameter at share 1; 0 for time constants, which are fixed.
    found, sure : float
        Where half of the cases, and 95 %, pass the gate; infinite where none does.
    named : float
        Where half of the cases pass it and no look-alike is preferred.
    taken_for : str or None
        The look-alike that is preferred at the size ``found``.
    look_alikes : dict of str to float
        Effect to the share of the signal that it reproduces, largest first, above 0.8.
    """

    effect: str
    unit_sizes: NDArray[np.float64]
    found: float
    sure: float
    named: float
    taken_for: str | None
    look_alikes: dict[str, float]


def smallest(probability: Callable[[float], NDArray[np.float64]], wanted: float) -> float:
    """Return the smallest share at which a probability, averaged over the signs, is reached; infinite if none."""
    low, high = np.log(LEAST), np.log(LARGEST)
    if np.mean(probability(LARGEST)) < wanted:
        return float("inf")
    for _ in range(STEPS):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if np.mean(probability(float(np.exp(middle)))) >= wanted else (middle, high)
    return float(np.exp(high))


def limits_or_none(
    effects: Iterable[Effect], sensor: str, limits: Mapping[str, NDArray[np.float64]]
) -> dict[str, NDArray[np.float64]]:
    """Return the limits of every effect's parameters, infinite where an effect has none, such as one of a user's own.

    Parameters
    ----------
    effects : iterable of Effect
    sensor : str
    limits : mapping of str to (p,) array
        Of the effects that have limits.
    """
    return {this.name: limits.get(this.name, np.full(len(this.parameters(sensor)), np.inf)) for this in effects}
