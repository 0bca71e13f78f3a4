"""What is right about one case: the truth beside what was said of it.

An effect counts as named by its look-alike where the document declares that one reproduces over 95 % of the other's
signal.
"""

from __future__ import annotations

from typing import Any

JSON = dict[str, Any]
ALIKE = 0.95
EXCESS = 0.05
STANDS_OUT = 100.0
DOUBTFUL = ("reference_in_doubt", "unexplained", "floor_in_doubt")


def named(hidden: str, said: JSON, name: str) -> bool:
    """Return whether a selected effect is the hidden one or declares that it looks like it."""
    return name == hidden or said["look_alikes"].get(name, {}).get(hidden, 0.0) > ALIKE


def first_is_right(truth: JSON, said: JSON) -> bool:
    """Return whether the hidden effect, or its declared look-alike, was selected first."""
    return bool(said["selected"]) and named(next(iter(truth["hidden"])), said, said["selected"][0])


def exact(truth: JSON, said: JSON) -> bool:
    """Return whether the hidden effects, or declared look-alikes, are exactly what was selected."""
    hidden, selected = list(truth["hidden"]), list(said["selected"])
    for name in [n for n in hidden if n in selected]:
        hidden.remove(name)
        selected.remove(name)
    for name in list(hidden):
        alike = next((s for s in selected if named(name, said, s)), None)
        if alike is not None:
            hidden.remove(name)
            selected.remove(alike)
    return not hidden and not selected


def nothing_selected(truth: JSON, said: JSON) -> bool:
    """Return whether nothing was selected."""
    del truth
    return not said["selected"]


def not_seen(truth: JSON, said: JSON) -> bool:
    """Return whether an effect that cannot be seen is listed as not observable, and was not selected."""
    name = next(iter(truth["hidden"]))
    return name in said["not_observable"] and name not in said["selected"]


def warned(said: JSON) -> bool:
    """Return whether a warning is said: a doubtful verdict, beyond the data sheet, or more wander than expected."""
    return bool(said["verdict"] in DOUBTFUL or not said["plausible"] or said["inflated"])


def not_silent(truth: JSON, said: JSON) -> bool:
    """Return whether no effect was reported, or only with a warning; for what the catalogue does not hold."""
    del truth
    return not said["selected"] or warned(said)


def said_so(truth: JSON, said: JSON) -> bool:
    """Return whether physics that is not in the catalogue was called unexplained, or warned of."""
    del truth
    return warned(said)


def hard_to_replace(truth: JSON, said: JSON) -> bool:
    """Return whether the whole catalogue names the effect and no other one has a share of over 0.95 of it."""
    name = truth["left_out"][0]
    whole = said["whole"]
    return bool(whole["selected"][:1] == [name]) and max(whole["look_alikes"][name].values(), default=0.0) <= ALIKE


def excess_gone(said: JSON) -> float | None:
    """Return the share of the held-out excess over the noise floor that is gone; None where it is under 5 %."""
    held = said.get("held_out")
    if not held or held["before"] < (1.0 + EXCESS) * held["floor"]:
        return None
    return float((held["before"] - held["after"]) / (held["before"] - held["floor"]))


def stands_out(truth: JSON) -> bool:
    """Return whether each hidden effect leaves a signal of lambda >= 100 beside the others; see ``signal_left``."""
    left = truth.get("signal_left") or {}
    return bool(left) and min(left.values()) >= STANDS_OUT
