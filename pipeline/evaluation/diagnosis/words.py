"""Write a diagnosis in sentences (``templates/diagnosis.txt``), and propose the next experiment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import FileSystemLoader, Template

from pipeline.core.compiled_templates import Templates
from pipeline.core.records import Answer, Dependence
from pipeline.core.verdicts import Verdict, figure_and_size
from pipeline.estimation.candidates import FIXED_AT_ZERO, TILT, is_fixed
from pipeline.physics.effects import catalogue
from pipeline.physics.effects.base import largest_by_unit, unit_of
from pipeline.physics.effects.equations import OTHER_PREFIX

MOST_ANSWERS = 4  # answers of an answer set that a sentence lists
STAYS = 1.15  # times the noise floor: two standard deviations of the rms of 100 samples, 1 / sqrt(200) each
UNCHANGED = 0.005  # relative change of an rms error: at most half a unit of its third digit
UNKNOWN = {
    "temperature": "repeat the sequence at two steady temperatures, and while it heats and cools",
    "time": "return to the first pose at the end, and repeat the sequence once the unit is warm",
    "rate": "turn at several rates in both directions",
    "angle": "turn again with the unit remounted at another angle: errors of the table stay at the same table angles",
    "specific_force": "record rests in which all three axes are inclined, and more than 1 g if you can",
}
HYSTERESIS = "temperature_hysteresis"  # a covariate, of a soak that heats and cools
IN_WORDS = {HYSTERESIS: "heating or cooling (hysteresis)"}
UNKNOWN |= dict.fromkeys(IN_WORDS, "heat and cool at half the rate: an error by lag halves, one by hysteresis stays")
FAR_OFF = (
    "check the table against its log first (steps, backlash, rate, vibration) and the mounting: the residual is far "
    "above the noise and does not depend on any recorded quantity"
)
UNSTEADY = (
    "check that the unit rested firmly before and after each move, without sliding, and that no samples are missing: "
    "the residual is above the noise and does not depend on any recorded quantity"
)
PLUS_MINUS = (
    "+- is two standard uncertainties by the noise of these recordings; U of a calibration with the effect adds the "
    "accuracies of the bench."
)


@cache
def _environment() -> Templates:
    environment = Templates("diagnosis", FileSystemLoader(Path(__file__).parent / "templates"))  # no HTML
    environment.filters |= {"plain": plain, "listed": listed, "said": lambda answer: _said(Answer(**answer))}
    environment.globals |= {f.__name__: f for f in (is_fixed, figure_and_size, largest_by_unit, times_of)}
    environment.globals |= {"heating_and_cooling": tuple(IN_WORDS), "plus_minus": PLUS_MINUS}
    environment.globals |= {"stays": STAYS, "unchanged": UNCHANGED, "Verdict": Verdict}
    return environment


def template(name: str) -> Template:
    """Return a template of sentences by its file name."""
    return _environment().get_template(name)


def in_words(part: Mapping[str, Any] | None, sensor: str, most_values: int | None = None) -> list[str]:
    """Return a sensor's part of ``diagnoses/<unit>.json`` as sentences; ``part`` is None if it was not calibrated.

    Effects with more than ``most_values`` parameters are stated without values, which the page lists in a table.
    """
    if part is None:
        return [f"The {sensor} was not calibrated, so there is nothing to diagnose."]
    sets = [Answer(**answer) for answer in part.get("answer_set") or []]
    more = [f"{len(sets) - MOST_ANSWERS} more"] if len(sets) > MOST_ANSWERS else []
    by_reason: dict[str, list[str]] = {}
    for hidden in part["not_observable"]:
        by_reason.setdefault(hidden["reason"].split("; it needs ")[0], []).append(hidden["effect"])
    answers = listed([*map(_said, sets[:MOST_ANSWERS]), *more], "or")
    about = {"part": part, "sensor": sensor, "unit": unit_of(sensor), "most_values": most_values, "answers": answers}
    about |= {"catalogue": catalogue(), "entries": {entry["effect"]: entry for entry in part["ranking"]}}
    text = template("diagnosis.txt").render(**about, by_reason=by_reason.items(), fixed=FIXED_AT_ZERO, tilt=TILT)
    return [line for line in text.splitlines() if line]


def plain(name: str) -> str:
    """Return the name of an effect, verdict, setting or covariate in words: ``bias temperature``."""
    return IN_WORDS.get(name) or name.replace("_", " ")


def times_of(entry: Mapping[str, Any], entries: Mapping[str, Mapping[str, Any]]) -> list[tuple[float, float]]:
    """Return the time constant of an effect that scales with another one, and its standard uncertainty, s; or nothing.

    ``entry``, ``entries``: of the ranking. The weighted mean of the axes' ratios; each weight is by the uncertainty of
    the effect itself, which is larger than that of the other.
    """
    this = catalogue().get(entry["effect"])
    other = entries.get(this.scales_with) if this else None
    if other is None or not other["parameters"] or len(other["parameters"]) != len(entry["parameters"]):
        return []
    pairs = list(zip(entry["parameters"].values(), other["parameters"].values(), strict=True))
    if not all(own["standard_uncertainty"] for own, _ in pairs):
        return []
    weight = sum((scale["value"] / own["standard_uncertainty"]) ** 2 for own, scale in pairs)
    mean = sum(own["value"] * scale["value"] / own["standard_uncertainty"] ** 2 for own, scale in pairs) / weight
    return [(mean, weight**-0.5)]


def listed(words: Sequence[str], conjunction: str = "and") -> str:
    """Return words joined as in a sentence: ``a, b and c``."""
    return f" {conjunction} ".join(filter(None, [", ".join(words[:-1]), *words[-1:]]))


def _said(answer: Answer) -> str:
    """Return an answer of an answer set in words, with its probability."""
    pairs = [(name, name.removeprefix(OTHER_PREFIX)) for name in answer.effects]
    names = [plain(name) if name == own else f"something else that follows the {own}" for name, own in pairs]
    return f"{' + '.join(names) or 'nothing'} ({answer.probability:.2g})"


def to_distinguish(sets: Sequence[Answer], sensor: str, *, on_table: bool) -> str:
    """Return the two most probable answers and the experiment that distinguishes them; empty if there is one only."""
    if len(sets) < 2:
        return ""
    first, second = (each.effects for each in sets[:2])
    answers = " from ".join(map(_said, sets[:2]))
    different = [name for name in first if name not in second] or [name for name in second if name not in first]
    if different[0].startswith(OTHER_PREFIX):
        measured = "specific_force" if sensor == "accelerometer" else "rate"
        return f"{answers}: {UNKNOWN[different[0].removeprefix(OTHER_PREFIX).replace('input', measured)]}"
    return f"{answers}: {experiment_of(different[0], on_table=on_table)}"


def experiment_of(name: str, *, on_table: bool) -> str:
    """Return the experiment that separates an effect from its look-alikes."""
    this = catalogue()[name]
    return this.experiment if on_table else this.experiment_by_hand or this.experiment


def of_unknown(unknown: Sequence[Dependence], *, on_table: bool) -> str:
    """Return the experiment that shows on which quantity the residual depends."""
    if not unknown:
        return FAR_OFF if on_table else UNSTEADY
    covariate = unknown[0].covariate
    if covariate in IN_WORDS:
        return UNKNOWN[covariate]
    return f"to find other quantities than {plain(covariate)} on which the residual depends: {UNKNOWN[covariate]}"
