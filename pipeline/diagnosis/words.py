"""A diagnosis in plain words."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.diagnosis import method_words
from pipeline.model.effects import catalogue

if TYPE_CHECKING:
    from collections.abc import Mapping

STAYS = 1.15  # times the noise of held-out motion, above which more than noise is left
UNITS = {"accelerometer": "g", "gyroscope": "deg/s"}


def in_words(part: Mapping[str, Any] | None, sensor: str) -> list[str]:
    """Return a sensor's diagnosis as sentences.

    Parameters
    ----------
    part : mapping or None
        The sensor's part of ``diagnoses/<unit>.json``; None where the sensor was not calibrated.
    sensor : str

    Returns
    -------
    list of str
    """
    if part is None:
        return [f"The {sensor} was not calibrated, so there is nothing to diagnose."]
    lines = [_verdict(part, sensor), *([part["reason"]] if part.get("reason") else [])]
    entries = {entry["effect"]: entry for entry in part["ranking"]}
    for name in part["selected"]:
        lines += _selected(entries[name], sensor, with_shape=bool(part.get("suggested_effect")))
    lines += _unknown(part, sensor)
    if len(part["selected"]) > 3 and part["verdict"] == "unexplained":
        lines.append(
            f"It takes {len(part['selected'])} effects together to explain this, more than a unit usually has: "
            "the true one may not be in the catalogue."
        )
    lines += _held_out(part, sensor)
    wander = part.get("wander") or {}
    if wander.get("inflated"):
        lines.append(
            f"The bias seems to wander by {wander['standard_deviation']:.2g} {UNITS[sensor]}, against "
            f"{wander['expected']:.2g} expected: something slow may be missing that the noise model has swallowed."
        )
    lines += method_words.in_words(part.get("method_errors") or [], sensor)
    if part["not_observable"]:
        lines.append(_hidden(part))
    if part["next_experiment"]:
        lines.append(f"Next experiment: {part['next_experiment']}.")
    return lines


def _held_out(part: Mapping[str, Any], sensor: str) -> list[str]:
    """Say where held-out motion speaks against what was selected."""
    held = part.get("held_out")
    if not held or held["error_after"] < STAYS * held["floor"]:
        return []
    ratio = held["error_after"] / held["floor"]
    lines = [f"On held-out motion {held['error_after']:.3g} {UNITS[sensor]} stay, {ratio:.3g} times the noise."]
    if held["error_after"] > held["error_before"]:
        return [*lines, "That is more than without it: what was selected is not what is missing."]
    return [*lines, "So it is not the whole of it, or one that looks like it is meant."]


def _unknown(part: Mapping[str, Any], sensor: str) -> list[str]:
    """Say what the residual depends on, in which shape, and how to try that as an effect."""
    lines = []
    for found in part["unexplained"]:
        if found.get("explained_by"):
            continue
        shape = f": {found['shape']} (delta BIC {found['delta_bic']:.0f})" if found.get("shape") else ""
        p = f"p = {found['p_value']:.1g}" if found["p_value"] > 0 else "p < 1e-300"
        beyond = " beyond that" if part["selected"] else ""
        lines.append(f"The residual depends on {plain(found['covariate'])} ({p}){beyond}{shape}.")
    effect = part.get("suggested_effect")
    if effect:
        file = part.get("suggested_file", f"<unit>_{sensor}_unknown.yaml")
        lines.append(
            f"To try that shape, copy diagnoses/{file} from the results to effects/{effect['name']}.yaml in the "
            f"campaign's directory, and add {sensor}.{effect['name']}."
        )
    return lines


def plain(name: str) -> str:
    """Return the name of an effect or covariate in words: ``bias temperature`` for ``bias_temperature``."""
    return name.replace("_", " ")


def _verdict(part: Mapping[str, Any], sensor: str) -> str:
    text = {
        "nothing_missing": f"Nothing that these recordings can show is missing in the model of the {sensor}.",
        "missing_effect": f"The model of the {sensor} misses {_names(part['selected'])}.",
        "unexplained": f"The {sensor} does something that no effect of the catalogue explains.",
        "not_enough_data": f"The recordings cannot tell whether an effect of the {sensor} is missing.",
        "reference_in_doubt": f"The reference of the {sensor} is in doubt: recordings contradict each other.",
        "floor_in_doubt": f"The noise of the {sensor} is in doubt: it may be taken for too large and hide an effect.",
        "left_by_method": f"The {sensor} is explained; approximations of its method or filter leave more than noise.",
    }[part["verdict"]]
    ratio = part["residual_over_noise"]
    if ratio is None:
        return text
    subject = "Without it, the residual" if part["verdict"] == "missing_effect" else "The residual"
    return f"{text} {subject} is {ratio:.3g} times the noise."


def _names(names: list[str]) -> str:
    words = [plain(name) for name in names]
    return " and ".join(filter(None, [", ".join(words[:-1]), *words[-1:]]))


def _selected(entry: Mapping[str, Any], sensor: str, *, with_shape: bool) -> list[str]:
    known = catalogue().get(entry["effect"])
    meaning = entry.get("meaning") or (known.meaning if known else "")
    values = ", ".join(_value(name, p) for name, p in entry["parameters"].items())
    share = 100 * entry["explained_share"]
    head = f"{plain(entry['effect']).capitalize()}: {f'{meaning} ' if meaning else ''}{values}."
    bic = f"(delta BIC {entry['delta_bic']:.0f})"
    lines = [f"{head} It explains {share:.0f} % of the excess over the noise {bic}."]
    if not entry["plausible"]:
        lines.append("That is beyond the sensor's data sheet: take it as a sign of something else.")
    if entry["look_alikes"]:
        alike = ", ".join(f"{plain(a['effect'])} ({100 * a['share']:.0f} %)" for a in entry["look_alikes"])
        lines.append(f"It looks much like {alike} of the same signal.")
    before, after = entry["held_out_error_before"], entry["held_out_error_after"]
    if before is not None and after is not None:
        beside = ", the shape below fitted with it" if with_shape else ""
        lines.append(f"On held-out motion the rms error goes from {before:.4g} to {after:.4g} {UNITS[sensor]}{beside}.")
    return lines


def _value(name: str, parameter: Mapping[str, Any]) -> str:
    unit = "" if parameter["unit"] == "1" else f" {parameter['unit']}"
    uncertainty = parameter["standard_uncertainty"]
    spread = f" +- {2 * uncertainty:.2g}" if uncertainty else ""
    return f"{name} = {parameter['value']:.4g}{spread}{unit}"


def _hidden(part: Mapping[str, Any]) -> str:
    hidden = part["not_observable"]
    reasons = {entry["reason"] for entry in hidden}
    if not part["ranking"] and len(reasons) == 1:
        return f"No effect can be seen: {hidden[0]['reason']}."
    listed = "; ".join(f"{plain(e['effect'])} ({e['reason'].split('; it needs ')[0]})" for e in hidden)
    return f"Not observable: {listed}."
