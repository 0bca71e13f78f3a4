"""The figures of a study, each with n and a 95 % interval (Wilson, Journal of the ASA 22, 1927).

    interval = (p + z^2 / 2n -+ z sqrt(p (1 - p) / n + z^2 / 4n^2)) / (1 + z^2 / n),   z = 1.96

where p is the share of n cases; that of a mean is z standard errors to either side.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.study import verdicts

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

JSON = dict[str, Any]
Pair = tuple[JSON, JSON]
Z = 1.96
OF_WHICH = "... of those in which each stands out (lambda >= 100)"
IN_THE_CATALOGUE = ("single", "pairs", "triples", "one_axis")
MAY_HIDE = ("single", "small", "tiny", "one_axis", "pairs", "pairs_wander", "triples")
# Family, what is counted, how it is judged, goal.
PLAN: list[tuple[str, str, Callable[[JSON, JSON], bool], str]] = [
    ("single", "one effect at its data sheet's size: named first", verdicts.first_is_right, ">= 98 %"),
    ("single", "... and nothing else named", verdicts.exact, ""),
    ("small", "one effect, x0.3: named first", verdicts.first_is_right, ""),
    ("tiny", "one effect, x0.1: named first", verdicts.first_is_right, ""),
    ("one_axis", "one effect on one axis: named first", verdicts.first_is_right, ""),
    ("staged", "one effect, base calibrated stage by stage: named first", verdicts.first_is_right, ""),
    ("lost", "one effect, a tenth of the samples lost: named first", verdicts.first_is_right, ""),
    ("coarse", "one effect, temperature in steps of 0.5 degC: named first", verdicts.first_is_right, ""),
    ("cold", "one effect, no temperature: named first", verdicts.first_is_right, ""),
    ("pairs", "two effects: exactly these", verdicts.exact, ">= 95 %"),
    ("pairs_wander", "two effects, five times the wander: exactly these", verdicts.exact, ">= 85 %"),
    ("triples", "three effects: exactly these", verdicts.exact, ""),
    ("unseen", "cannot be seen: said so, and not selected", verdicts.not_seen, "100 %"),
    ("removed", "taken out of the catalogue: no other one without a warning", verdicts.not_silent, ">= 95 %"),
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
            pairs = [p for p in pairs if "error" in p[1] or verdicts.hard_to_replace(*p)]
        found.append(share(name, pairs, right, goal))
        able = [pair for pair in pairs if verdicts.stands_out(pair[0])]
        if family in MAY_HIDE and len(able) < len(pairs):
            found.append(share(OF_WHICH, able, right, ""))
    for family, pairs in by_family.items():
        if is_null(pairs[0][0]):
            noise = family.removeprefix("null_")
            found.append(
                share(f"nothing hidden, {noise}: nothing selected", pairs, verdicts.nothing_selected, ">= 99 %")
            )
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
    gone = [verdicts.excess_gone(said) for _, said in cases if "error" not in said]
    values = np.array([value for value in gone if value is not None])
    if len(values) < 2:
        return Mean(float("nan"), float("nan"), float("nan"), len(values))
    error = float(values.std(ddof=1) / np.sqrt(len(values)))
    return Mean(float(values.mean()), error, float(values.min()), len(values))


def in_the_catalogue(cases: Iterable[Pair]) -> list[Pair]:
    """Return the cases in which effects of the catalogue are hidden at their usual size, at the usual wander."""
    return [pair for pair in cases if pair[0]["family"] in IN_THE_CATALOGUE]
