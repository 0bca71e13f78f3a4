"""Scores of a study: which diagnoses are right, and shares with n and a 95 % interval (Wilson's, of scipy).

A *case* here is a dict with the truth of a unit and what the diagnosis said of one of its sensors. An effect counts as
named by its look-alike where the document declares that one reproduces over 95 % of the other's signal.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

JSON = dict[str, Any]
Z = 1.96  # standard normal quantile of a 95 % interval
OF_WHICH = "... of those in which each stands out (lambda >= 100)"
IN_THE_CATALOGUE = ("single", "pairs", "triples", "one_axis")
MAY_HIDE = ("single", "small", "tiny", "one_axis", "pairs", "pairs_wander", "triples")
ALIKE = 0.95  # share of a signal from which one effect stands for another, as the pages call look-alikes
EXCESS = 0.05  # of the noise floor: from which a held-out excess is counted
STANDS_OUT = 100.0  # lambda: the most that a selection asks for
DOUBTFUL = ("reference_in_doubt", "unexplained", "floor_in_doubt")


def cases_of(truth: Iterable[JSON], results: Iterable[JSON]) -> list[JSON]:
    """Return the cases whose truth and result are both there."""
    known = {line["key"]: line for line in truth}
    return [{**known[line["key"]], **line} for line in results if line["key"] in known]


def named(case: JSON, hidden: str, name: str) -> bool:
    """Return whether a selected effect is the hidden one or declares that it looks like it."""
    return name == hidden or case["look_alikes"].get(name, {}).get(hidden, 0.0) > ALIKE


def first_is_right(case: JSON) -> bool:
    """Return whether the hidden effect, or its declared look-alike, was selected first."""
    return bool(case["selected"]) and named(case, next(iter(case["hidden"])), case["selected"][0])


def exact(case: JSON) -> bool:
    """Return whether the hidden effects, or declared look-alikes, are exactly what was selected."""
    hidden = [name for name in case["hidden"] if name not in case["selected"]]
    selected = [name for name in case["selected"] if name not in case["hidden"]]
    for name in hidden:
        alike = next((s for s in selected if named(case, name, s)), None)
        if alike is None:
            return False
        selected.remove(alike)
    return not selected


def nothing_selected(case: JSON) -> bool:
    """Return whether nothing was selected."""
    return not case["selected"]


def not_seen(case: JSON) -> bool:
    """Return whether an effect that cannot be seen is listed as not observable, and was not selected."""
    name = next(iter(case["hidden"]))
    return name in case["not_observable"] and name not in case["selected"]


def warned(case: JSON) -> bool:
    """Return whether there is a warning: a doubtful verdict, beyond the data sheet, or more wander than expected."""
    return bool(case["verdict"] in DOUBTFUL or not case["plausible"] or case["inflated"])


def not_silent(case: JSON) -> bool:
    """Return whether no effect was reported, or only with a warning; for what the catalogue does not hold."""
    return not case["selected"] or warned(case)


def hard_to_replace(case: JSON) -> bool:
    """Return whether the whole catalogue names the effect and no other one has a share of over 0.95 of it."""
    name, whole = case["left_out"][0], case["whole"]
    return bool(whole["selected"][:1] == [name]) and max(whole["look_alikes"][name].values(), default=0.0) <= ALIKE


def excess_gone(case: JSON) -> float | None:
    """Return the share of the held-out excess over the noise floor that is gone; None where it is under 5 %."""
    held = case.get("held_out")
    if not held or held["before"] < (1.0 + EXCESS) * held["floor"]:
        return None
    return float((held["before"] - held["after"]) / (held["before"] - held["floor"]))


def stands_out(case: JSON) -> bool:
    """Return whether each hidden effect leaves a signal of lambda >= 100 beside the others; see ``signal_left``."""
    left = case.get("signal_left") or {}
    return bool(left) and min(left.values()) >= STANDS_OUT


# Family, what is counted, how it is judged, goal.
PLAN: list[tuple[str, str, Callable[[JSON], bool], str]] = [
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


class Figure(NamedTuple):
    """A share of some cases; ``misses`` names the cases that do not belong to it, in order."""

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
    from scipy.stats import binomtest  # noqa: PLC0415  (0.5 s, needed at the end of a study)

    found = binomtest(hits, total).proportion_ci(0.95, method="wilson")
    return float(found.low), float(found.high)


def share(name: str, cases: Iterable[JSON], right: Callable[[JSON], bool], goal: str) -> Figure:
    """Return the share of cases for which ``right`` holds; a fault never is."""
    judged = [(_name(case), "error" not in case and right(case)) for case in cases]
    misses = tuple(case for case, good in judged if not good)
    return Figure(name, len(judged) - len(misses), len(judged), goal, misses)


def _name(case: JSON) -> str:
    """Return what names a case; with its sensor where both are judged."""
    return f"{case['key']} {case['sensor']}" if is_null(case) and "error" not in case else str(case["key"])


def is_null(case: JSON) -> bool:
    """Return whether nothing is hidden in a case."""
    return str(case["family"]).startswith("null")


def all_figures(cases: Sequence[JSON]) -> list[Figure]:
    """Return the figures of every family that was run."""
    found = []
    for family, name, right, goal in PLAN:
        own = [c for c in cases if c["family"] == family]
        if family == "removed":
            own = [c for c in own if "error" in c or hard_to_replace(c)]
        found.append(share(name, own, right, goal))
        able = [c for c in own if stands_out(c)]
        if family in MAY_HIDE and len(able) < len(own):
            found.append(share(OF_WHICH, able, right, ""))
    for family in sorted({c["family"] for c in cases if is_null(c)}):
        own = [c for c in cases if c["family"] == family]
        name = f"nothing hidden, {family.removeprefix('null_')}: nothing selected"
        found.append(share(name, own, nothing_selected, ">= 99 %"))
    return [figure for figure in found if figure.total]


class Mean(NamedTuple):
    """The mean share of the held-out excess that is gone, its standard error, the least share, and of how many."""

    value: float
    error: float
    least: float
    total: int


def mean_excess_gone(cases: Iterable[JSON]) -> Mean:
    """Return the mean over the units whose held-out excess is over 5 % of the noise floor."""
    gone = [excess_gone(case) for case in cases if "error" not in case]
    values = np.array([value for value in gone if value is not None])
    if len(values) < 2:
        return Mean(float("nan"), float("nan"), float("nan"), len(values))
    error = float(values.std(ddof=1) / np.sqrt(len(values)))
    return Mean(float(values.mean()), error, float(values.min()), len(values))


def in_the_catalogue(cases: Iterable[JSON]) -> list[JSON]:
    """Return the cases in which effects of the catalogue are hidden at their usual size, at the usual wander."""
    return [case for case in cases if case["family"] in IN_THE_CATALOGUE]
