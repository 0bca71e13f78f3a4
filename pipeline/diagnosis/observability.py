"""Which effects the recordings cannot show, and why.

An effect is not observable where it needs what the recordings do not hold, where base and configured effects add up to
all that it would add (less than 1e-3 of its columns is left), or where it would hide in the noise even with all its
parameters at the sensor's limits,

    lambda = sum_j limit_j^2 H_jj < k log N + 10

with H the whitened products of its columns: the gain in 2 log L that it could reach on average, against the gate.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.estimation.selection import GATE_BIC
from pipeline.model.effects import catalogue

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.estimation.observations import Observations
    from pipeline.estimation.selection import Selection
    from pipeline.model.effects.base import Effect
    from pipeline.records import Motion

LEAST_SPAN_DEGC = 1.0  # twice the step of a coarse thermometer, 0.5 degC
OF_A_TABLE = {"angle": "no angle of a table", "rate": "no rate of a table", "level": "nothing that tells the heading"}


@dataclass(frozen=True)
class Facts:
    """What the recordings did."""

    temperature: bool  # whether every recording holds one
    span: float  # of the temperature, degC
    moving: bool  # whether any used sample moves
    one_way: bool  # whether the turns about no axis go in both directions
    clock_shared: bool


def facts_of(observations: Observations) -> Facts:
    """Return what the recordings did."""
    warmth = [part.motion.temperature for part in observations.parts]
    known = [t for t in warmth if t is not None]
    span = float(np.ptp(np.concatenate(known))) if known else 0.0
    moving = any(np.any(~part.motion.still) for part in observations.parts)
    ways: dict[int, set[int]] = {}
    for part in observations.parts:
        if part.motion.axis is not None and part.motion.rate is not None:
            seen = np.unique(np.sign(part.motion.rate[~part.motion.still]))
            ways.setdefault(part.motion.axis, set()).update(int(s) for s in seen if s)
    return Facts(
        temperature=len(known) == len(warmth),
        span=span,
        moving=moving,
        one_way=moving and not any(len(w) == 2 for w in ways.values()),
        clock_shared=observations.clock_shared,
    )


def not_observable(selection: Selection, configured: list[str]) -> dict[str, str]:
    """Return the effects that these recordings cannot show, each with the reason and what would show it.

    Parameters
    ----------
    selection : Selection
    configured : list of str
        Effects of the model, which are not asked for.
    """
    observations, facts = selection.observations, facts_of(selection.observations)
    found = {}
    for name, this in catalogue().items():
        if observations.sensor not in this.sensors or name in configured or name in selection.names:
            continue
        if name == "earth_rotation" and observations.earth:
            continue
        reason = _reason(this, selection, facts)
        if reason:
            advice = "" if observations.sensor in this.unseen else f"; it needs {this.excitation}"
            found[name] = reason + advice
    return found


def _reason(this: Effect, selection: Selection, facts: Facts) -> str | None:
    places = selection.first.indices(this.name)
    hidden = _hidden(this, selection, places)
    motions = [part.motion for part in selection.observations.parts]
    lacking = [text for need, text in OF_A_TABLE.items() if need in this.needs and _nowhere(need, motions)]
    checks = [
        (selection.observations.sensor in this.unseen, this.unseen.get(selection.observations.sensor, "")),
        ("temperature" in this.needs and not facts.temperature, "the recordings hold no temperature"),
        (this.needs_clock and not facts.clock_shared, "the time between the recordings is not known"),
        (bool(lacking), f"the recordings hold {' and '.join(lacking)}"),
        (not places, _unexcited(this, facts)),
        ("temperature" in this.needs and facts.span < LEAST_SPAN_DEGC, _steady(facts)),
        (hidden, _faint(this, selection) if hidden else ""),
    ]
    return next((reason for applies, reason in checks if applies), None)


def _nowhere(need: str, motions: Sequence[Motion]) -> bool:
    return all(getattr(motion, need) is None for motion in motions)


def _steady(facts: Facts) -> str:
    return f"the temperature changes by no more than {facts.span:.2g} degC"


def _faint(this: Effect, selection: Selection) -> str:
    unit = this.parameters(selection.observations.sensor)[0].unit
    limit = selection.limits[this.name][0]
    return f"even at its limit of {limit:.2g}{'' if unit == '1' else ' ' + unit} it would be below the noise"


def _unexcited(this: Effect, facts: Facts) -> str:
    if this.needs_motion and not facts.moving:
        return "the table never moved while it was sampled"
    if "temperature" in this.needs:
        return _steady(facts)
    if this.needs_both_directions and facts.one_way:
        return "every turn goes in one direction, in which it looks exactly like a part of bias and matrix"
    return "bias and matrix explain all that it would add in this motion"


def _hidden(this: Effect, selection: Selection, places: list[int]) -> bool:
    limits = selection.limits.get(this.name)
    score = selection.alone.get(this.name)
    if limits is None or score is None or not places or score.delta_bic > GATE_BIC:
        return False
    gate = score.parameters * float(np.log(selection.first.samples)) + GATE_BIC
    return max(selection.first.visibility(j, limits, score.setting) for j in places) < gate
