"""Which effects rests and moves cannot show, and what to record next.

An effect is not observable where only a table shows it, where it needs what the recordings do not hold, where it adds
nothing at rest (or in the moves) that bias and matrix do not, where too few rests are left to judge it, or where even
at the sensor's limits the mean gain,

    f n log(1 + lambda / n),   lambda = sum_j limit_j^2 |column_j|^2,   f the factor of the gain,

stays below the gate ``v log n + 10`` (see ``pipeline.estimation.multi_position.likelihood``). lambda of a drift of the
bias grows as the square of the time between the first rest and the last, so that the time that shows it is known.
(With 20 rests of an MPU-6050 in 110 s lambda is 12, of 167 that the gate asks for. Of simulated drifts of half the
limit, 0 of 4 are found in 4 minutes, 14 of 16 in 8, and 16 of 16 in 11.)
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.diagnosis.observability import LEAST_SPAN_DEGC
from pipeline.diagnosis.words import UNKNOWN
from pipeline.estimation.multi_position.model import refusal
from pipeline.estimation.selection import GATE_BIC
from pipeline.model.effects import catalogue

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.estimation.multi_position.selection import Selection
    from pipeline.estimation.ranking import Score
    from pipeline.model.effects.base import Effect

DRIFT = "bias_drift"
FEWEST = 3  # equations beyond bias and matrix, from which on an effect of one coefficient can be judged
WORTH = 0.25  # share of the residual's mean square, of what could be its cause
MOST_NAMED = 3
FIRM = 2.0  # times the noise, above which the scatter of the rests is worth a word
ENOUGH = 40  # rests that leave room for what the catalogue holds
EXPERIMENTS = {  # where that of the effect asks for a table
    "g_sensitivity": "repeat the rests on another day and facing another way: Earth's rotation turns with the heading, "
    "the sensitivity stays with the unit",
    "g_squared_sensitivity": "record more rests in which two axes are inclined alike, and some with one axis upright",
    "cross_axis_nonlinearity": "record more rests in which all three axes are inclined, such as body diagonals up",
}
MORE = f"record {ENOUGH} rests or more, each in another orientation, all three axes inclined in most of them"


def hidden_effects(selection: Selection, configured: Sequence[str]) -> dict[str, str]:
    """Return the effects that these recordings cannot show, each with the reason.

    Parameters
    ----------
    selection : Selection
    configured : sequence of str
        Effects of the model, which are not asked for.
    """
    found = {}
    for name, this in catalogue().items():
        if selection.model.sensor in this.sensors and name not in (*configured, *selection.names):
            reason = _reason(this, selection)
            if reason:
                found[name] = reason
    return found


def _reason(this: Effect, selection: Selection) -> str:
    model = selection.model
    refused = refusal(this, model.sensor, model.rests)
    if refused:
        return refused
    span = float(np.ptp(model.rests.temperature))
    if "temperature" in this.needs and span < LEAST_SPAN_DEGC:
        return f"the temperature changes by no more than {span:.2g} degC; it needs {this.excitation}"
    score = selection.first.scores.get(this.name)
    if score is None and model.kinds == 1 and this.needs_motion:
        return "at rest nothing moves, and it adds nothing"
    base = selection.fits[0]
    few = len(base.residual) - base.rank < FEWEST
    if few if score is None else selection.first.spare[this.name] == 0.0:
        return f"{len(model.rests.time)} rests are too few to tell it from their scatter; {MORE}"
    if score is None:
        seen = "rests and moves by hand" if model.kinds > 1 else "rests"
        return f"in {seen} bias and matrix explain all that it would add"
    return "" if score.delta_bic > GATE_BIC else _faint(this, score, selection)


def _faint(this: Effect, score: Score, selection: Selection) -> str:
    """Return why an effect that did not show would not have; empty where it would."""
    n, rests = len(selection.fits[0].residual), selection.model.rests
    gate = score.parameters * float(np.log(n)) + GATE_BIC
    scored = selection.last if this.name in selection.last.visible else selection.first
    if scored.visible[this.name] >= gate:
        return ""
    limit, unit = selection.limits[this.name][0], this.parameters(selection.model.sensor)[0].unit
    size = f"{limit:.2g}{'' if unit == '1' else ' ' + unit}"
    text = f"even at its limit of {size} it would hide in the scatter of {len(rests.time)} rests"
    spare, span = n * scored.spare[this.name], float(np.ptp(rests.time))
    if this.name != DRIFT or spare <= 0.0 or scored.visible[this.name] <= 0.0:
        return f"{text}; it needs {this.excitation}"
    longer = float(np.sqrt(np.expm1(gate / spare) / np.expm1(scored.visible[this.name] / spare)))
    return (
        f"{text} in {span / 60.0:.2g} min; as many rests within {np.ceil(span * longer / 60.0):.0f} min would show it"
    )


def next_experiment(
    selection: Selection,
    verdict: str,
    ranking: Sequence[Mapping[str, Any]],
    hidden: Mapping[str, str],
    *,
    unknown: Sequence[Mapping[str, Any]],
    over_noise: float,
) -> str:
    """Return the experiment that would tell most, as one sentence.

    Parameters
    ----------
    selection : Selection
    verdict : str
    ranking : sequence of mapping
        Entries of the diagnosis.
    hidden : mapping
        Effect that is not observable to the reason.
    unknown : sequence of mapping
        Entries of ``unexplained``.
    over_noise : float
        Residual of the rests over that of noise.
    """
    if verdict == "unexplained" and unknown:
        covariate = str(unknown[0]["covariate"])
        return f"to find out on what the residual depends beside {_plain(covariate)}: {UNKNOWN[covariate]}"
    if selection.names:
        return _of_selected({entry["effect"]: entry for entry in ranking}, selection.names)
    if verdict == "not_enough_data":
        return MORE
    if over_noise > FIRM or verdict == "unexplained":
        return _of_scatter(suspects(selection, hidden), over_noise)
    if "bias_temperature" in hidden:
        return f"to see bias temperature: record {catalogue()['bias_temperature'].excitation}"
    return "none is needed: nothing that these recordings can show is missing"


def suspects(selection: Selection, hidden: Mapping[str, str]) -> list[str]:
    """Return the effects that these recordings cannot tell, and that could be what the residual holds.

    Such an effect shows in the equations, and at its limits it brings at least the share ``WORTH`` of the mean square
    that is left; or it goes with the temperature, which was not recorded or did not change enough.
    """
    first, n = selection.first, len(selection.fits[0].residual)

    def could(name: str) -> bool:
        if "temperature" in catalogue()[name].needs:
            return bool(np.isnan(selection.model.rests.temperature).any()) or name in first.scores
        return name in first.scores and first.visible[name] >= first.spare[name] * n * float(np.log1p(WORTH))

    def brings(name: str) -> float:
        return -first.scores[name].delta_bic if name in first.scores else float("inf")

    return sorted((name for name in hidden if could(name)), key=brings)


def _of_scatter(names: Sequence[str], over_noise: float) -> str:
    """Return what to record where the rests scatter more than the noise, and nothing that can be seen explains it."""
    many = f"the rests scatter {over_noise:.2g} times the noise"
    if not names:
        return f"set the unit down firmly for each rest: {many} and follow nothing that is recorded"
    listed = [_plain(name) for name in names[:MOST_NAMED]]
    alike = " or ".join([", ".join(listed[:-1]), listed[-1]] if len(listed) > 1 else listed)
    warm = any("temperature" in catalogue()[name].needs for name in names)
    beside = ", with the temperature of the sensor beside them" if warm else ""
    return (
        f"{MORE}{beside}: {many}, and an unsteady hand explains that no better than {alike}, which "
        "these rests do not tell"
    )


def _of_selected(entries: Mapping[str, Mapping[str, Any]], selected: Sequence[str]) -> str:
    name = next((n for n in selected if entries[n]["look_alikes"]), selected[0])
    alike = entries[name]["look_alikes"]
    experiment = EXPERIMENTS.get(name, catalogue()[name].experiment)
    if not alike:
        return f"to confirm {_plain(name)}: {experiment}"
    others = " or ".join(_plain(a["effect"]) for a in alike[:2])
    return f"to tell {_plain(name)} from {others}: {experiment}"


def not_enough_data(sensor: str, configured: list[str], reason: str, experiment: str = MORE) -> dict[str, Any]:
    """Return the diagnosis of recordings that show no effect.

    Parameters
    ----------
    sensor : str
    configured : list of str
        Effects that the configuration already models.
    reason : str
        Why no other effect is observable.
    experiment : str
        The recording that would show effects; by default that of rests and moves.
    """
    names = [n for n, this in catalogue().items() if sensor in this.sensors and n not in configured]
    return {
        "verdict": "not_enough_data",
        "residual_over_noise": None,
        "selected": [],
        "ranking": [],
        "not_observable": [{"effect": name, "reason": reason} for name in names],
        "unexplained": [],
        "suggested_effect": None,
        "method_errors": [],
        "next_experiment": experiment,
        "override": "",
        "configured": configured,
        "wander": None,
    }


def _plain(name: str) -> str:
    return name.replace("_", " ")
