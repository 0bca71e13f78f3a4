"""Scores of a study: which diagnoses are right, and shares with n and a 95 % interval.

The interval of a share is that of Wilson (Journal of the ASA 22, 1927):

    interval = (p + z^2 / 2n -+ z sqrt(p (1 - p) / n + z^2 / 4n^2)) / (1 + z^2 / n),   z = 1.96

where p is the share of n cases; that of a mean is z standard errors to either side.

An effect counts as named by its look-alike where the document declares that one reproduces over 95 % of the other's
signal.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

JSON = dict[str, Any]
Pair = tuple[JSON, JSON]
Z = 1.96
OF_WHICH = "... of those in which each stands out (lambda >= 100)"
IN_THE_CATALOGUE = ("single", "pairs", "triples", "one_axis")
MAY_HIDE = ("single", "small", "tiny", "one_axis", "pairs", "pairs_wander", "triples")
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


# Family, what is counted, how it is judged, goal.
PLAN: list[tuple[str, str, Callable[[JSON, JSON], bool], str]] = [
    ("single", "one effect at its data sheet's size: named first", first_is_right, ">= 98 %"),
    ("single", "... and nothing else named", exact, ""),
    ("small", "one effect, x0.3: named first", first_is_right, ""),
    ("tiny", "one effect, x0.1: named first", first_is_right, ""),
    ("one_axis", "one effect on one axis: named first", first_is_right, ""),
    ("staged", "one effect, base calibrated stage by stage: named first", first_is_right, ""),
    ("lost", "one effect, a tenth of the samples lost: named first", first_is_right, ""),
    ("coarse", "one effect, temperature in steps of 0.5 degC: named first", first_is_right, ""),
    ("cold", "one effect, no temperature: named first", first_is_right, ""),
    ("pairs", "two effects: exactly these", exact, ">= 95 %"),
    ("pairs_wander", "two effects, five times the wander: exactly these", exact, ">= 85 %"),
    ("triples", "three effects: exactly these", exact, ""),
    ("unseen", "cannot be seen: said so, and not selected", not_seen, "100 %"),
    ("removed", "taken out of the catalogue: no other one without a warning", not_silent, ">= 95 %"),
]


@dataclass(frozen=True)
class Figure:
    """A share of some cases.

    Attributes
    ----------
    name : str
    hits, total : int
    goal : str
    misses : tuple of str
        Keys of the cases that do not belong to the share, in order.
    """

    name: str
    hits: int
    total: int
    goal: str
    misses: tuple[str, ...] = ()

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % interval of the share."""
        return wilson(self.hits, self.total)


def wilson(hits: int, total: int) -> tuple[float, float]:
    """Return the 95 % interval of a share."""
    if total == 0:
        return 0.0, 1.0
    p, z2 = hits / total, Z * Z / total
    half = Z * np.sqrt(p * (1.0 - p) / total + z2 / (4.0 * total))
    low, high = (p + z2 / 2.0 - half) / (1.0 + z2), (p + z2 / 2.0 + half) / (1.0 + z2)
    return float(np.clip(low, 0.0, p)), float(np.clip(high, p, 1.0))


def joined(truth: Iterable[JSON], results: Iterable[JSON]) -> list[Pair]:
    """Return each result beside its truth."""
    known = {line["key"]: line for line in truth}
    return [(known[line["key"]], line) for line in results if line["key"] in known]


def share(name: str, cases: Iterable[Pair], right: Callable[[JSON, JSON], bool], goal: str) -> Figure:
    """Return the share of cases for which ``right`` holds; a fault never is."""
    pairs = list(cases)
    good = ["error" not in said and right(truth, said) for truth, said in pairs]
    misses = tuple(key_of(pair) for pair, ok in zip(pairs, good, strict=True) if not ok)
    return Figure(name, sum(good), len(pairs), goal, misses)


def key_of(pair: Pair) -> str:
    """Return what names a case; with its sensor where both are judged."""
    truth, said = pair
    return f"{truth['key']} {said['sensor']}" if is_null(truth) and "error" not in said else str(truth["key"])


def is_null(truth: JSON) -> bool:
    """Return whether nothing is hidden in a case."""
    return str(truth["family"]).startswith("null")


def all_figures(cases: Sequence[Pair]) -> list[Figure]:
    """Return the figures of every family that was run."""
    by_family = families(cases)
    found = []
    for family, name, right, goal in PLAN:
        pairs = by_family.get(family, [])
        if family == "removed":
            pairs = [p for p in pairs if "error" in p[1] or hard_to_replace(*p)]
        found.append(share(name, pairs, right, goal))
        able = [pair for pair in pairs if stands_out(pair[0])]
        if family in MAY_HIDE and len(able) < len(pairs):
            found.append(share(OF_WHICH, able, right, ""))
    for family, pairs in by_family.items():
        if is_null(pairs[0][0]):
            noise = family.removeprefix("null_")
            found.append(share(f"nothing hidden, {noise}: nothing selected", pairs, nothing_selected, ">= 99 %"))
    return [figure for figure in found if figure.total]


def families(cases: Iterable[Pair]) -> dict[str, list[Pair]]:
    """Return the cases of each family, in alphabetical order."""
    found: dict[str, list[Pair]] = {}
    for pair in cases:
        found.setdefault(pair[0]["family"], []).append(pair)
    return dict(sorted(found.items()))


@dataclass(frozen=True)
class Mean:
    """The mean share of the held-out excess that is gone, its standard error, the least share, and of how many."""

    value: float
    error: float
    least: float
    total: int


def mean_excess_gone(cases: Iterable[Pair]) -> Mean:
    """Return the mean over the units whose held-out excess is over 5 % of the noise floor."""
    gone = [excess_gone(said) for _, said in cases if "error" not in said]
    values = np.array([value for value in gone if value is not None])
    if len(values) < 2:
        return Mean(float("nan"), float("nan"), float("nan"), len(values))
    error = float(values.std(ddof=1) / np.sqrt(len(values)))
    return Mean(float(values.mean()), error, float(values.min()), len(values))


def in_the_catalogue(cases: Iterable[Pair]) -> list[Pair]:
    """Return the cases in which effects of the catalogue are hidden at their usual size, at the usual wander."""
    return [pair for pair in cases if pair[0]["family"] in IN_THE_CATALOGUE]
