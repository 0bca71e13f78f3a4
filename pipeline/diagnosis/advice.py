"""What to record next: what would separate look-alikes, show what was hidden, or confirm what was found."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.model.effects import catalogue

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.diagnosis.observability import Facts

UNKNOWN = {
    "temperature": "repeat the sequence at two steady temperatures, and while it heats and cools",
    "time": "return to the first pose at the end, and repeat the sequence once the unit is warm",
    "rate": "turn at several rates in both directions",
    "angle": "turn a second time with the unit remounted at another angle: an error of the table stays with the table",
    "specific_force": "record rests in which all three axes are inclined, and more than 1 g if you can",
}
FAR_OFF = (
    "check the table against its log first (steps, play, rate, vibration) and the mounting: the residual is far above "
    "the noise and follows nothing that is recorded"
)


def next_experiment(
    verdict: str,
    *,
    ranking: Sequence[Mapping[str, Any]],
    selected: Sequence[str],
    hidden: Mapping[str, str],
    unknown: Sequence[Mapping[str, Any]],
    facts: Facts,
) -> str:
    """Return the experiment that would tell most, as one sentence.

    Parameters
    ----------
    verdict : str
    ranking : sequence of mapping
        Entries of the diagnosis.
    selected : sequence of str
    hidden : mapping
        Effect that is not observable to the reason.
    unknown : sequence of mapping
        Entries of ``unexplained``.
    facts : Facts
        What the recordings did.
    """
    if verdict == "unexplained":
        return of_unknown(unknown)
    if selected:
        return _of_selected({entry["effect"]: entry for entry in ranking}, selected)
    if facts.one_way:
        return "make every turn in the other direction too: it shows five effects that one direction hides"
    shown = next((name for name in ("bias_temperature", "lever_arm", "time_offset") if name in hidden), None)
    if shown:
        return f"to see {_plain(shown)}: record {catalogue()[shown].excitation}"
    return "none is needed: nothing that these recordings can show is missing"


def of_unknown(unknown: Sequence[Mapping[str, Any]]) -> str:
    """Return what would tell on what the residual depends.

    Parameters
    ----------
    unknown : sequence of mapping
        Entries of ``unexplained``.
    """
    if not unknown:
        return FAR_OFF
    covariate = str(unknown[0]["covariate"])
    return f"to find out on what the residual depends beside {_plain(covariate)}: {UNKNOWN[covariate]}"


def _of_selected(entries: Mapping[str, Mapping[str, Any]], selected: Sequence[str]) -> str:
    for name in selected:
        alike = entries[name]["look_alikes"]
        if alike:
            others = " or ".join(_plain(a["effect"]) for a in alike[:2])
            return f"to tell {_plain(name)} from {others}: {catalogue()[name].experiment}"
    return f"to confirm {_plain(selected[0])}: {catalogue()[selected[0]].experiment}"


def _plain(name: str) -> str:
    return name.replace("_", " ")
