"""A case of a study with its result: the truth of a unit, and what is scored of the diagnosis of one of its sensors."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from typing import NamedTuple, Self

from pipeline.core.files import JSON


class HeldOut(NamedTuple):
    """Held-out error before and after the selected effects are added, and the noise floor, g or deg/s."""

    before: float
    after: float
    floor: float
    raised: bool = False  # whether the error rises significantly where no step saw it


@dataclass(frozen=True, kw_only=True)
class Diagnosed:
    """What is scored of a diagnosis; without one, nothing is selected."""

    selected: list[str] = field(default_factory=list)
    offered: bool = False  # whether there is an override that adds the selected effects
    look_alikes: dict[str, dict[str, float]] = field(default_factory=dict)  # of selected effects, with their share
    verdict: str = ""
    plausible: bool = True
    inflated: bool = False  # more bias wander than expected
    not_observable: list[str] = field(default_factory=list)
    answer_set: list[list[str]] | None = None  # effects of each answer, the most probable first; None: not computed
    answer_probability: list[float] = field(default_factory=list)  # of each answer
    probability: dict[str, float] = field(default_factory=dict)
    upper_limit: dict[str, list[float]] = field(default_factory=dict)  # of the parameters of an effect

    @classmethod
    def from_json(cls, line: JSON) -> Self:
        """Return the part of a line of ``truth.jsonl`` or ``results.jsonl``, or of both joined."""
        found = {key.name: line[key.name] for key in fields(cls) if key.name in line}
        if "answer_set" in found:
            found["answer_probability"] = [answer["probability"] for answer in found["answer_set"]]
            found["answer_set"] = [answer["effects"] for answer in found["answer_set"]]
        limits = {name: of.values() for name, of in found.get("upper_limit", {}).items() if of}
        found["upper_limit"] = {name: [limit["value"] for limit in of] for name, of in limits.items()}
        if "held_out" in found:
            found["held_out"] = HeldOut(**found["held_out"])
        if "whole" in found:
            found["whole"] = Diagnosed.from_json(found["whole"])
        return cls(**found)


@dataclass(frozen=True, kw_only=True)
class ScoredCase(Diagnosed):
    """The truth of a unit, and the diagnosis of one of its sensors."""

    key: str
    family: str
    model: str
    sensor: str  # that was diagnosed
    procedure: str
    hidden: dict[str, list[float]]
    left_out: list[str] = field(default_factory=list)
    shape: str = ""
    rests: int = 0
    noise: str = "normal"
    signal_left: dict[str, float] = field(default_factory=dict)  # lambda of hidden effects
    gains: dict[str, float] | None = None  # delta BIC of each effect where nothing is hidden
    held_out: HeldOut | None = None
    whole: Diagnosed | None = None  # by the complete catalogue, where an effect is left out of it
    error: str = ""  # of a case without a diagnosis
    refused: str = ""  # code, where a step of a run refused the unit
    code: str = ""  # digest of the code


def cases_of(truth: Iterable[JSON], results: Iterable[JSON]) -> list[ScoredCase]:
    """Return the cases that have both a truth and a result."""
    known = {line["key"]: line for line in truth}
    return [ScoredCase.from_json({**known[line["key"]], **line}) for line in results if line["key"] in known]
