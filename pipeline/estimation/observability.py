"""Find the effects that the recordings cannot show, with the reasons.

An effect is not observable if it needs a quantity that the recordings lack, if base and configured effects explain its
signal (less than 1e-3 of its columns remains), or if it would be below the noise even with all its parameters at the
sensor's limits. Then the mean gain in 2 log L is below that at which it passes (``pipeline.estimation.gates``):

    turns on a table    lambda = sum_j limit_j^2 H_jj,  with the whitened products H of its columns
    rests and moves     f n log(1 + lambda / n),  with the factor f of the gain and n equations

For turns this is the largest lambda under those noise hypotheses that are likely if the effect is in the model. Without
the effect a random walk is likelier, and would hide it.

lambda of a bias drift grows as the square of the time between the first and the last rest. So the necessary time is
known. (With 20 rests of an MPU-6050 in 110 s lambda is 12; the gate is 358. Of simulated drifts of half the limit, 0 of
4 are found in 4 minutes, 4 of 16 in 8, 10 of 16 in 11, and 15 of 16 in 14.)
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

import numpy as np

from pipeline.estimation.candidates import MOUNTING, NO_SWING, ZERO
from pipeline.estimation.gates import min_gain, passes
from pipeline.estimation.multi_position import selection as by_hand
from pipeline.estimation.multi_position.selection import DRIFT, no_candidate
from pipeline.estimation.observations import Observations
from pipeline.estimation.ranking import Score
from pipeline.estimation.selection import Selection
from pipeline.physics.effects import catalogue, effect
from pipeline.physics.effects.base import Effect
from pipeline.physics.effects.formula_effect import FormulaEffect
from pipeline.physics.signal.filters import MIN_SWING_DEGC, heats_and_cools

OF_A_TABLE = {"angle": "no angle of a table", "rate": "no rate of a table", "level": "nothing that shows the heading"}
UNDESCRIBED = "the table's log describes no sample at which the rate changes"
LEAST_WEIGHT = float(np.log(0.01))  # log of the likelihood of a noise hypothesis over that of the likeliest
MIN_FURTHER_EQUATIONS = 3  # equations beyond bias and matrix, to judge an effect with one coefficient
SUFFICIENT_RESTS = 40  # rests for the effects of the catalogue
MORE_RESTS = (
    f"record {SUFFICIENT_RESTS} rests or more, each in another orientation, all three axes inclined in most of them"
)


def at_its_limit(this: Effect, sensor: str, limit: float) -> str:
    """Return the first words of the reason why an effect is too small to be seen."""
    unit = this.parameters(sensor)[0].unit
    return f"even at its limit of {limit:.2g}{'' if unit == '1' else ' ' + unit} it would"


def _hidden(
    sensor: str, modelled: Collection[str], reason: Callable[[Effect], str], kinds: Collection[str] = ()
) -> dict[str, str]:
    """Return the reason for each effect of a sensor that is not observable, without those in the model.

    Effects of single turns (``Effect.of_turns``) are left to the checks of the recordings. ``kinds``: of a sheet's.
    """
    found = {}
    for name, this in catalogue().items():
        if sensor not in this.sensors or name in modelled or this.of_turns:
            continue
        within = next((other for other in modelled if name in effect(other).contains), None)
        text = f"{within}, which is in the model, contains it" if within else reason(this)
        if this.shown_by and this.shown_by not in kinds and not within:
            text = f"only recordings of kind {this.shown_by} (procedure listed) sweep the temperature far enough"
        if text:
            found[name] = text
    return found


def never_shown(hidden: Collection[str], selected: Collection[str]) -> list[str]:
    """Return the effects that are not observable for another reason than a selected effect that contains them."""
    return [name for name in hidden if not any(name in effect(other).contains for other in selected)]


def hidden_in(selection: Selection, modelled: Sequence[str]) -> list[str]:
    """Return ``never_shown`` of turns on a table."""
    return never_shown(not_observable(selection, modelled), selection.names)


def one_way(observations: Observations) -> bool:
    """Return whether the table turns, but about no axis in both directions."""
    signs: dict[int, set[float]] = {}
    for part in observations.parts:
        if part.motion.axis is not None and part.motion.rate is not None:
            rates = part.motion.rate[~part.motion.still]
            found = [sign for sign in (-1.0, 1.0) if np.any(sign * rates > 0.0)]
            signs.setdefault(part.motion.axis, set()).update(found)
    return _moving(observations) and not any(len(found) == 2 for found in signs.values())


def _moving(observations: Observations) -> bool:
    return any(bool(np.any(~part.motion.still)) for part in observations.parts)


def not_observable(selection: Selection, configured: Sequence[str]) -> dict[str, str]:
    """Return the reason for each effect that turns cannot show, and what would show it, without those in the model."""
    observations = selection.observations

    def reason(this: Effect) -> str:
        found = _reason(this, selection)
        return f"{found}; it needs {this.excitation}" if found and observations.sensor not in this.unseen else found

    earth = ["earth_rotation"] if observations.earth else []
    return _hidden(observations.sensor, [*configured, *selection.names, *earth], reason)


def alike_with_zeros(selection: Selection) -> dict[str, str]:
    """Return the effects that differ from a selected one only by a zero of the angle, if zeros are in the model."""
    of_angle = next((t.effect.name for t in selection.base.terms if t.effect.name in (MOUNTING, ZERO)), None)
    if of_angle is None:
        return {}
    known = "it needs turns whose zeros are known: mount the unit once for all turns, by the convention"
    return {
        other: f"it differs from {name}, which is selected, by a zero of the angle, which {of_angle} contains; {known}"
        for name in selection.names
        for other in selection.first.same_as(selection.first.indices(name)[0])
    }


def _reason(this: Effect, selection: Selection) -> str:
    """Return why turns cannot show an effect; empty if they can."""
    observations, excited = selection.observations, selection.first.indices(this.name)
    motions = [part.motion for part in observations.parts]
    needed = [(need, text) for need, text in OF_A_TABLE.items() if need in this.needs]
    lacking = [text for need, text in needed if all(getattr(motion, need) is None for motion in motions)]
    warm = "temperature" in this.needs
    warmth = [motion.temperature for motion in motions]
    known = [t for t in warmth if t is not None]
    span = float(np.ptp(np.concatenate(known))) if warm and known else 0.0
    in_one = "every turn goes in one direction, in which it looks exactly like a part of bias and matrix"
    checks = [
        (observations.sensor in this.unseen, this.unseen.get(observations.sensor, "")),
        (warm and len(known) < len(warmth), "the recordings hold no temperature"),
        (this.needs_clock and not observations.clock_shared, "the time between the recordings is not known"),
        (bool(lacking), f"the recordings hold {' and '.join(lacking)}"),
        (not excited and this.needs_motion and not _moving(observations), "the table never moved while it was sampled"),
        (this.needs_swing and span >= MIN_SWING_DEGC and not heats_and_cools(warmth), NO_SWING),
        (warm and (not excited or span < MIN_SWING_DEGC), _steady(span)),
        (not excited and this.needs_both_directions and one_way(observations), in_one),
        (not excited and this.moves, UNDESCRIBED),
        (not excited, "bias and matrix explain all that it would add in this motion"),
    ]
    return next((reason for applies, reason in checks if applies), "") or _faint(this, selection)


def _faint(this: Effect, selection: Selection) -> str:
    """Return why turns would not show an effect at its limits; empty if they would, or if it was seen."""
    limits, score = selection.limits.get(this.name), selection.alone.get(this.name)
    if limits is None or not np.all(np.isfinite(limits)) or score is None:
        return ""
    sensor, candidates = selection.observations.sensor, len(selection.candidates)
    if passes(score, sensor, candidates):
        return ""
    ranking, chosen = selection.ranking, selection.chosen()
    gate = min_gain(this, sensor, score.parameters, ranking.samples, candidates)
    for j in ranking.indices(this.name):
        seen = ranking.visibility(j, limits)[1:] >= gate
        if seen.any():
            likely = ranking.log_likelihoods([*chosen, j])[1:]
            if likely[seen].max() > likely.max() + LEAST_WEIGHT:
                return ""
    return f"{at_its_limit(this, sensor, limits[0])} be below the noise"


def not_observable_by_hand(selection: by_hand.SelectionByHand, configured: Sequence[str]) -> dict[str, str]:
    """Return the reason for each effect that rests and moves cannot show, without those in the model."""
    model, modelled = selection.model, [*configured, *selection.names]
    return _hidden(model.sensor, modelled, lambda this: _reason_by_hand(this, selection), model.rests.kinds)


def slow_by_hand(selection: by_hand.SelectionByHand, hidden: Collection[str]) -> dict[str, str]:
    """Return the reason for each effect that is observable, but not with its least visible time constant."""
    n, rests, found = len(selection.fits[0].residual), selection.model.rests, {}
    for name, least in selection.first.slowest.items():
        score, this = selection.first.scores.get(name), effect(name)
        if name in (*hidden, *selection.names) or score is None:
            continue
        gate = min_gain(this, selection.model.sensor, score.parameters, n, len(selection.candidates))
        if least < gate:
            found[name] = f"with its longest time constant it would hide in the scatter of {len(rests.time)} rests"
    return found


def _steady(span: float) -> str:
    return f"the temperature changes by no more than {span:.2g} degC"


def _reason_by_hand(this: Effect, selection: by_hand.SelectionByHand) -> str:
    """Return why rests and moves cannot show an effect; empty if they can."""
    model, base = selection.model, selection.fits[0]
    refused = no_candidate(this, model.sensor, model.rests)
    if refused:
        return refused
    span = float(np.ptp(model.temperature))
    if "temperature" in this.needs and span < MIN_SWING_DEGC:
        return f"{_steady(span)}; it needs {this.excitation}"
    score = selection.first.scores.get(this.name)
    if score is None and model.kinds == 1 and this.needs_motion:
        after = "by hand the direction of the last move before a rest is not logged"
        moved = isinstance(this, FormulaEffect) and "direction" in this.fields(model.sensor, np.zeros(0))
        return after if moved else "at rest nothing moves, and it adds nothing"
    few = len(base.residual) - base.rank < MIN_FURTHER_EQUATIONS
    if few if score is None else selection.first.spare[this.name] == 0.0:
        return f"{len(model.rests.time)} rests are too few to distinguish it from their scatter; {MORE_RESTS}"
    if score is None:
        seen = "rests and moves by hand" if model.kinds > 1 else "rests"
        return f"in {seen} bias and matrix explain all that it would add"
    return "" if passes(score, model.sensor, len(selection.candidates)) else _faint_by_hand(this, score, selection)


def _faint_by_hand(this: Effect, score: Score, selection: by_hand.SelectionByHand) -> str:
    """Return why rests and moves would not show an effect at its limits; empty if they would."""
    n, rests = len(selection.fits[0].residual), selection.model.rests
    gate = min_gain(this, selection.model.sensor, score.parameters, n, len(selection.candidates))
    scored = selection.last if this.name in selection.last.visible else selection.first
    if scored.visible[this.name] >= gate:
        return ""
    limit = selection.limits[this.name][0]
    text = f"{at_its_limit(this, selection.model.sensor, limit)} hide in the scatter of {len(rests.time)} rests"
    spare, span = n * scored.spare[this.name], float(np.ptp(rests.time))
    if this.name != DRIFT or spare <= 0.0 or scored.visible[this.name] <= 0.0:
        return f"{text}; it needs {this.excitation}"
    longer = float(np.sqrt(np.expm1(gate / spare) / np.expm1(scored.visible[this.name] / spare)))
    return (
        f"{text} in {span / 60.0:.2g} min; as many rests within {np.ceil(span * longer / 60.0):.0f} min would show it"
    )
