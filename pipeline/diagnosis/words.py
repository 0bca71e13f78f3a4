"""A diagnosis in plain words, and what to record next."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.estimation.candidates import HELD, TILT, is_held
from pipeline.estimation.free_curves import OTHER
from pipeline.model.effects import catalogue
from pipeline.model.effects.base import Owner, largest_by_unit, unit_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.diagnosis.findings import Findings

ANSWERS = "What is missing, with 95 % probability"
IN_DOUBT = "The most probable of the sets that were tried, all of which the verdict doubts"
MOST_ANSWERS = 4  # of an answer set in a sentence
STAYS = 1.15  # times the noise floor: two standard deviations of the rms of 100 samples, 1 / sqrt(200) each
UNCHANGED = 0.005  # of an rms error: half a unit of its third digit, or less
UNKNOWN = {
    "temperature": "repeat the sequence at two steady temperatures, and while it heats and cools",
    "time": "return to the first pose at the end, and repeat the sequence once the unit is warm",
    "rate": "turn at several rates in both directions",
    "angle": "turn again with the unit remounted at another angle: errors of the table stay at the same table angles",
    "specific_force": "record rests in which all three axes are inclined, and more than 1 g if you can",
}
FAR_OFF = (
    "check the table against its log first (steps, backlash, rate, vibration) and the mounting: the residual is far "
    "above the noise and does not depend on any recorded quantity"
)
VERDICTS = {
    "nothing_missing": "Nothing that these recordings can show is missing in the model of the {sensor}.",
    "missing_effect": "The model of the {sensor} misses {effects}.",
    "unexplained": "The residual of the {sensor} exceeds noise, and no plausible effect of the catalogue explains it.",
    "not_enough_data": "The recordings cannot show whether an effect of the {sensor} is missing.",
    "reference_in_doubt": "The reference of the {sensor} is in doubt: recordings contradict each other.",
    "floor_in_doubt": "The noise estimate of the {sensor} is in doubt: it may be too large and hide an effect.",
    "left_by_method": "The model explains the {sensor}; approximations of method or filter cause errors above noise.",
}

PLUS_MINUS = (
    "+- is two standard uncertainties by the noise of these recordings, as the selection estimates it. A calibration "
    "with the effect estimates the noise anew, adds the accuracies of the bench, and states coverage factors for 95 %."
)
GIVEN_DIFFERS = "The model explains the {sensor}; the given calibration is not that of these recordings."


def in_words(part: Mapping[str, Any] | None, sensor: str, most_values: int | None = None) -> list[str]:
    """Return a sensor's part of ``diagnoses/<unit>.json``, None where it was not calibrated, as sentences.

    Effects with more than ``most_values`` parameters are stated without their values, which the page lists in a table.
    """
    if part is None:
        return [f"The {sensor} was not calibrated, so there is nothing to diagnose."]
    lines = [_verdict(part, sensor), *([part["reason"]] if part.get("reason") else [])]
    entries = {entry["effect"]: entry for entry in part["ranking"]}
    for name in part["selected"]:
        lines += _selected(entries[name], sensor, most_values, with_form=bool(part.get("suggested_effect")))
    if part["selected"]:
        lines.append(PLUS_MINUS)
    lines += _unknown(part, sensor)
    lines += [_driven(entry) for entry in part.get("influence") or [] if entry["recordings"]]
    lines += _goodness(part.get("goodness_of_fit"))
    lines += _held_out(part, sensor)
    wander = part.get("wander") or {}
    if wander.get("inflated"):
        lines.append(
            f"The fitted bias wander is {wander['standard_deviation']:.2g} {unit_of(sensor)}, against "
            f"{wander['expected']:.2g} expected: it may include a slow effect that is missing in the model."
        )
    lines += _how_sure(part)
    whose = "the given calibration" if part.get("given") else "the method"
    lines += [_method_error(error, sensor, whose) for error in part.get("method_errors") or []]
    if part["not_observable"]:
        lines.append(_hidden(part))
    if part["next_experiment"]:
        lines.append(f"Next experiment: {part['next_experiment']}.")
    return lines


def _verdict(part: Mapping[str, Any], sensor: str) -> str:
    form = GIVEN_DIFFERS if part.get("given") and part["verdict"] == "left_by_method" else VERDICTS[part["verdict"]]
    text = form.format(sensor=sensor, effects=listed([plain(n) for n in part["selected"]]))
    ratio = part["residual_over_noise"]
    if ratio is None:
        return text
    size = f"is {ratio:.3g} times the noise"
    if part["verdict"] != "missing_effect":
        return f"{text} The residual {size}."
    which = "this effect" if len(part["selected"]) == 1 else "these effects"
    return f"{text} The residual of the fit, which does not contain {which}, {size}."


def plain(name: str) -> str:
    """Return the name of an effect or covariate in words: ``bias temperature`` for ``bias_temperature``."""
    return name.replace("_", " ")


def listed(words: Sequence[str], conjunction: str = "and") -> str:
    """Return words as a list in a sentence: ``a, b and c``."""
    return f" {conjunction} ".join(filter(None, [", ".join(words[:-1]), *words[-1:]]))


def _selected(entry: Mapping[str, Any], sensor: str, most_values: int | None, *, with_form: bool) -> list[str]:
    known = catalogue().get(entry["effect"])
    meaning = entry.get("meaning") or (known.meaning if known else "")
    values = ", ".join(_value(name, p) for name, p in entry["parameters"].items())
    if most_values is not None and len(entry["parameters"]) > most_values:
        values = f"{len(entry['parameters'])} parameters, in the table below"
    share = 100 * entry["explained_share"]
    head = f"{plain(entry['effect']).capitalize()}: {f'{meaning} ' if meaning else ''}{values}."
    bic = f"(delta BIC {entry['delta_bic']:.0f})"
    lines = [f"{head} It explains {share:.0f} % of the excess over the noise {bic}."]
    if not entry["plausible"]:
        lines.append("That exceeds the limit of the sensor file; the cause may be another, similar effect.")
    if entry["look_alikes"]:
        alike = ", ".join(f"{plain(a['effect'])} ({100 * a['share']:.0f} %)" for a in entry["look_alikes"])
        lines.append(f"Its signal is similar to that of {alike}.")
    if entry["effect"] == TILT and any(is_held(name, p) for name, p in entry["parameters"].items()):
        lines.append(HELD)
    before, after = entry["held_out_error_before"], entry["held_out_error_after"]
    owner = known.owner if known else Owner.SENSOR
    of_bench = owner != Owner.SENSOR
    if of_bench:
        lines.append(f"It is a property of the {owner}, not of the sensor.")
    if of_bench and before and after is not None and abs(after - before) < UNCHANGED * before:
        lines[-1] = (
            f"{lines[-1][:-1]}, and the rms error on held-out motion ({after:.3g} {unit_of(sensor)}) is the same."
        )
    elif before is not None and after is not None:
        given = ", with the functional form below fitted too" if with_form else ""
        lines.append(
            "It changes the rms error on held-out motion (of the vector, where its direction is logged) "
            f"from {before:.4g} to {after:.4g} {unit_of(sensor)}{given}."
        )
    return lines


def _value(name: str, parameter: Mapping[str, Any]) -> str:
    unit = "" if parameter["unit"] == "1" else f" {parameter['unit']}"
    if is_held(name, parameter):
        return f"{name} = 0{unit} (held)"
    uncertainty = parameter["standard_uncertainty"]
    spread = f" +- {2 * uncertainty:.2g}" if uncertainty else ""
    return f"{name} = {parameter['value']:.4g}{spread}{unit}"


def _goodness(found: Mapping[str, Any] | None) -> list[str]:
    """Return how well the model fits, by simulations from it."""
    if not found:
        return []
    share, count = 100 * found["share_worse"], found["simulations"]
    line = f"Of {count} simulations from the fitted model, {share:.0f} % fit worse than the readings"
    if share < 1.0:
        return [f"{line}: the model is not complete."]
    return [f"{line}: a complete model gives any share, half on average; below 1 % shows that it is not complete."]


def _driven(entry: Mapping[str, Any]) -> str:
    """Return which recordings and which seconds drive a finding."""
    first = entry["recordings"][0]
    text = (
        f"{plain(entry['effect']).capitalize()} is shown mostly by {first['recording']} ({100 * first['share']:.0f} %"
    )
    if entry["seconds"]:
        stretch = entry["seconds"][0]
        where = "" if stretch["recording"] == first["recording"] else f" of {stretch['recording']}"
        text += f"; {100 * stretch['share']:.0f} % from {stretch['from_s']:.0f} to {stretch['to_s']:.0f} s{where}"
    if not entry["depends_on"]:
        return f"{text}); without any one recording the evidence for it remains."
    return f"{text}); without {listed(entry['depends_on'], 'or')} the evidence for it is gone."


def _unknown(part: Mapping[str, Any], sensor: str) -> list[str]:
    """Return the quantities on which the residual depends, the functional form, and how to try it as an effect."""
    lines = []
    for found in part["unexplained"]:
        if found.get("explained_by"):
            continue
        form = f": {found['shape']} (delta BIC {found['delta_bic']:.0f})" if found.get("shape") else ""
        p = f"p = {found['p_value']:.1g}" if found["p_value"] > 0 else "p < 1e-300"
        which = "remaining residual" if part["selected"] else "residual"
        lines.append(f"The {which} depends on {plain(found['covariate'])} ({p}){form}.")
    effect = part.get("suggested_effect")
    if part.get("not_suggested"):
        lines.append(f"This formula is not offered as an effect: {part['not_suggested']}.")
    if effect:
        file = part.get("suggested_file", f"<unit>_{sensor}_unknown.yaml")
        stability = (part.get("formulas") or [{}])[0].get("stability")
        if stability is not None:
            lines.append(
                f"It is the best of all formulas in {100 * stability:.0f} % of the resamples, each without one "
                "recording or without a fifth of every recording."
            )
        lines.append(
            f"To try that form, copy diagnoses/{file} from the results to effects/{effect['name']}.yaml in the "
            f"campaign's directory, and add {sensor}.{effect['name']}; the option --suggested of add does both."
        )
    return lines


def _held_out(part: Mapping[str, Any], sensor: str) -> list[str]:
    """Return the error that remains on held-out motion with the selected effects, where it is above the noise."""
    held = part.get("held_out")
    if not held or held["error_after"] < STAYS * held["floor"]:
        return []
    ratio = held["error_after"] / held["floor"]
    error = f"{held['error_after']:.3g} {unit_of(sensor)}"
    line = f"The remaining error on held-out motion is {error}, {ratio:.3g} times the noise."
    if held["error_after"] > held["error_before"]:
        return [line, "It is larger than without the selected effects: they are not the missing ones."]
    return [line, "Either another effect is missing too, or an effect with a similar signal is the right one."]


def _how_sure(part: Mapping[str, Any]) -> list[str]:
    """Return the answer set, what would make it smaller, and the upper limits, as sentences."""
    sets, lines = part.get("answer_set") or [], []
    if sets:
        said = [f"{_answer(each['effects'])} ({each['probability']:.2g})" for each in sets[:MOST_ANSWERS]]
        more = [f"{len(sets) - MOST_ANSWERS} more"] if len(sets) > MOST_ANSWERS else []
        answers = listed([*said, *more], "or")
        if part["verdict"] == "nothing_missing" and sets[0]["effects"]:
            lines.append(
                f"The selection decides the verdict, and {_answer(sets[0]['effects'])} does not pass its thresholds; "
                f"the probabilities, which do not decide, are {answers}: probabilities and selection disagree, and "
                "only further recordings decide."
            )
        else:
            head = IN_DOUBT if part["verdict"] in ("unexplained", "reference_in_doubt") else ANSWERS
            lines.append(f"{head}: {answers}.")
    if part.get("to_distinguish"):
        lines.append(f"To distinguish {part['to_distinguish']}.")
    if part.get("upper_limit"):
        each = []
        for name, limits in part["upper_limit"].items():
            sizes = [f"{v:.2g}{'' if unit == '1' else ' ' + unit}" for unit, v in largest_by_unit(limits).items()]
            each.append(f"{plain(name)} {', '.join(sizes)}")
        lines.append(f"Upper limits (95 %), were the effect there: {'; '.join(each)}.")
    return lines


def _answer(effects: Sequence[str]) -> str:
    """Return one answer in words."""
    names = [
        f"something else that follows the {name.removeprefix(OTHER)}" if name.startswith(OTHER) else plain(name)
        for name in effects
    ]
    return " + ".join(names) or "nothing"


def to_distinguish(sets: Sequence[Mapping[str, Any]], sensor: str, *, on_table: bool) -> str:
    """Return the two most probable answers, and the experiment that distinguishes them; empty where there is one."""
    if len(sets) < 2:
        return ""
    first, second = (each["effects"] for each in sets[:2])
    answers = " from ".join(f"{_answer(each['effects'])} ({each['probability']:.2g})" for each in sets[:2])
    different = [name for name in first if name not in second] or [name for name in second if name not in first]
    if different[0].startswith(OTHER):
        own = "specific_force" if sensor == "accelerometer" else "rate"
        return f"{answers}: {UNKNOWN[different[0].removeprefix(OTHER).replace('input', own)]}"
    return f"{answers}: {_experiment(different[0], on_table=on_table)}"


def _experiment(name: str, *, on_table: bool) -> str:
    """Return what separates an effect from its look-alikes."""
    this = catalogue()[name]
    return this.experiment if on_table else this.experiment_by_hand or this.experiment


def _method_error(error: Mapping[str, Any], sensor: str, whose: str) -> str:
    """Return one of ``pipeline.diagnosis.method_errors`` as a sentence."""
    size = f"{error['size']:.2g} {error['unit']}" if error["unit"] != "1" else f"{100 * error['size']:.2g} %"
    share = f"{100 * error['share']:.0f} % of what {whose} leaves"
    magnitude = error.get("held_out_magnitude_share")
    if magnitude is not None:
        share += f", {100 * magnitude:.0f} % of its error of the magnitude on held-out motion"
    rms = f"{error['rms']:.2g} {unit_of(sensor)} rms"
    name = plain(error["name"].replace("non_", "non-"))
    return f"An error of {whose}, not of the sensor: {name} ({size}; {rms}; {share}): {error['meaning']}."


def _hidden(part: Mapping[str, Any]) -> str:
    hidden = part["not_observable"]
    reasons = {entry["reason"] for entry in hidden}
    if not part["ranking"] and len(reasons) == 1:
        return f"No effect is observable: {hidden[0]['reason']}."
    each = "; ".join(f"{plain(e['effect'])} ({e['reason'].split('; it needs ')[0]})" for e in hidden)
    return f"Not observable: {each}."


def next_experiment(verdict: str, ranking: Sequence[Mapping[str, Any]], found: Findings) -> str:
    """Return the experiment that would show most, as one sentence."""
    if verdict == "unexplained":
        return of_unknown(found.unknown) if found.unknown else found.advice(verdict)
    if not found.selected:
        return found.advice(verdict) or "none is needed: nothing that these recordings can show is missing"
    entries = {entry["effect"]: entry for entry in ranking}

    def alike(name: str) -> list[str]:
        others = [a["effect"] for a in entries[name]["look_alikes"]]
        return [n for n in others if name not in getattr(catalogue().get(n), "contains", ())]

    name = next((n for n in found.selected if alike(n)), found.selected[0])
    experiment = _experiment(name, on_table=found.on_table)
    others = listed([plain(other) for other in alike(name)[:2]], "or")
    return f"to {f'distinguish {plain(name)} from {others}' if others else f'confirm {plain(name)}'}: {experiment}"


def of_unknown(unknown: Sequence[Mapping[str, Any]]) -> str:
    """Return the experiment that would show on which quantity the residual depends, from entries ``unexplained``."""
    if not unknown:
        return FAR_OFF
    covariate = str(unknown[0]["covariate"])
    return f"to find other quantities than {plain(covariate)} on which the residual depends: {UNKNOWN[covariate]}"
