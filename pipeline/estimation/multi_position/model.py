"""What a model by hand is: parameters, and the linear form at them; see ``accelerometer`` and ``gyroscope``."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np

from pipeline.estimation.design import Term
from pipeline.model.effects import catalogue
from pipeline.model.effects.base import Owner
from pipeline.records import Motion

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from pipeline.estimation.multi_position.equations import Equations
    from pipeline.estimation.multi_position.rests import Rests
    from pipeline.model.effects.base import Effect

    Values = NDArray[np.float64]

OWNERS = (Owner.SENSOR, Owner.RECORDING)


@dataclass(frozen=True)
class State:
    """Parameters: bias (3,), matrix (3, 3), and the effects at their values."""

    bias: Values
    matrix: Values
    terms: tuple[Term, ...] = ()

    @property
    def K(self) -> Values:  # noqa: N802  (as in every equation)
        """Inverse of the matrix: (3, 3) array."""
        return np.asarray(np.linalg.solve(self.matrix, np.eye(3)), np.float64)

    def without_effects(self) -> State:
        """Return bias and matrix alone."""
        return replace(self, terms=())


class Model(Protocol):
    """The equations of one sensor.

    Attributes
    ----------
    sensor : str
    rests : Rests
    kinds : int
        Of scatter.
    rests_equations : int
        Equations of the rests; they come first.
    white : (3,) array
        Noise of a raw sample.
    directions : (12, b) array
        What each base parameter does to bias and matrix (row by row).
    """

    sensor: str
    rests: Rests
    kinds: int
    rests_equations: int
    white: Values
    directions: Values

    def equations(self, state: State, candidates: Sequence[Term] = ()) -> Equations:
        """Return the linear form at some parameters."""
        ...

    def samples(self) -> float:
        """Return how many samples are behind the equations."""
        ...

    def held_out_error(self, state: State) -> float | None:
        """Return the rms error at rests that no fit sees, g or deg/s; None where there are none."""
        ...

    def without(self, held: NDArray[np.bool_]) -> Model:
        """Return the model with some of its rests, and the moves before them, held out."""
        ...


def stepped(model: Model, state: State, step: Values) -> tuple[State, Values]:
    """Return the parameters after a step, and what of it was taken: effects may refuse a part of it."""
    count = model.directions.shape[1]
    change = model.directions @ step[:count]
    terms, taken, at = [], [step[:count]], count
    for term in state.terms:
        size = len(term.values)
        values = term.effect.stepped(term.values, step[at : at + size])
        taken.append(values - term.values)
        terms.append(Term(term.effect, values))
        at += size
    moved = State(state.bias + change[:3], state.matrix + change[3:].reshape(3, 3), tuple(terms))
    return moved, np.concatenate(taken)


def motion_of(time: Values, force: Values, rate: Values, temperature: Values, *, still: bool) -> Motion:
    """Return a motion that is known from the unit's own calibrated signals; derivatives are left at zero."""
    nothing = np.zeros_like(force)
    return Motion(
        time=time,
        specific_force=force,
        angular_rate=rate,
        angular_acceleration=nothing,
        specific_force_rate=nothing,
        temperature=None if np.isnan(temperature).any() else temperature,
        angle=None,
        rate=None,
        axis=None,
        still=np.full(len(time), still),
        direction=nothing,
    )


def added(sensor: str, terms: Sequence[Term], motion: Motion, K: Values) -> Values:
    """Return what effects add to the readings: (n, 3) array."""
    total = np.zeros_like(motion.specific_force)
    for term in terms:
        total = total + term.effect.reading(sensor, motion, K, term.values)
    return total


def refusal(this: Effect, sensor: str, rests: Rests) -> str:
    """Return why an effect can be no part of a model by hand; empty where it can."""
    unknown = [need for need in this.needs if need != "temperature"]
    checks = [
        (sensor not in this.sensors, f"{this.name} is no effect of the {sensor}"),
        (sensor in this.unseen, this.unseen.get(sensor, "")),
        (this.owner == Owner.TABLE or this.moves, "there is no table"),
        (this.owner == Owner.MOUNTING, "by hand nobody knows the unit's heading, nor about which point it turns"),
        ("temperature" in this.needs and np.isnan(rests.temperature).any(), "the recordings hold no temperature"),
        (bool(unknown), f"without a table nobody knows the {' and '.join(unknown)}"),
        (this.needs_clock and not rests.clock_shared, "the time between the recordings is not known"),
    ]
    return next((reason for applies, reason in checks if applies), "")


def candidates_for(sensor: str, rests: Rests, configured: Sequence[str]) -> list[Effect]:
    """Return the effects that could be missing, as far as rests and moves can hold them."""
    return [e for name, e in catalogue().items() if name not in configured and not refusal(e, sensor, rests)]
