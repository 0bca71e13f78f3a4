"""The figures of a study, each with n and a 95 % interval (Wilson, Journal of the ASA 22, 1927).

    interval = (p + z^2 / 2n -+ z sqrt(p (1 - p) / n + z^2 / 4n^2)) / (1 + z^2 / n),   z = 1.96

where p is the share of n cases. An effect counts as named by its look-alike where the document declares that one
reproduces over 95 % of the other's signal.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

JSON = dict[str, Any]
ALIKE = 0.95
EXCESS = 0.05
Z = 1.96


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


def joined(truth: Iterable[JSON], results: Iterable[JSON]) -> list[tuple[JSON, JSON]]:
    """Return each result beside its truth."""
    known = {line["key"]: line for line in truth}
    return [(known[line["key"]], line) for line in results if line["key"] in known]


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


def silent(truth: JSON, said: JSON) -> bool:
    """Return whether another effect was reported without a warning where the true one is not in the catalogue."""
    del truth
    warned = said["verdict"] == "unexplained" or not said["plausible"] or said["inflated"]
    return bool(said["selected"]) and not warned


def hard_to_replace(truth: JSON, said: JSON) -> bool:
    """Return whether the whole catalogue names the effect and no other one has a share of over 0.95 of it."""
    name = truth["left_out"][0]
    whole = said["whole"]
    return whole["selected"][:1] == [name] and max(whole["look_alikes"][name].values(), default=0.0) <= ALIKE


def excess_gone(said: JSON) -> float | None:
    """Return the share of the held-out excess over the noise floor that is gone; None where it is under 5 %."""
    held = said.get("held_out")
    if not held or held["before"] < (1.0 + EXCESS) * held["floor"]:
        return None
    return float((held["before"] - held["after"]) / (held["before"] - held["floor"]))


def share(
    name: str,
    cases: Iterable[tuple[JSON, JSON]],
    right: Callable[[JSON, JSON], bool],
    goal: str,
) -> Figure:
    """Return the share of cases for which ``right`` holds; a fault never is."""
    pairs = list(cases)
    good = ["error" not in said and right(truth, said) for truth, said in pairs]
    misses = tuple(truth["key"] for (truth, _), ok in zip(pairs, good, strict=True) if not ok)
    return Figure(name, sum(good), len(pairs), goal, misses)


def nothing_selected(truth: JSON, said: JSON) -> bool:
    """Return whether nothing was selected."""
    del truth
    return not said["selected"]


def not_seen(truth: JSON, said: JSON) -> bool:
    """Return whether an effect that cannot be seen is listed as not observable, and was not selected."""
    name = next(iter(truth["hidden"]))
    return name in said["not_observable"] and name not in said["selected"]


def warned_or_named(truth: JSON, said: JSON) -> bool:
    """Return whether physics that is not in the catalogue was called unexplained, or was warned of."""
    return said["verdict"] == "unexplained" or (bool(said["selected"]) and not silent(truth, said))


def all_figures(cases: list[tuple[JSON, JSON]]) -> list[Figure]:
    """Return the figures of every family that was run."""

    def of(family: str) -> list[tuple[JSON, JSON]]:
        return [pair for pair in cases if pair[0]["family"] == family]

    removed = [p for p in of("removed") if "error" in p[1] or hard_to_replace(*p)]
    nulls = sorted({t["family"] for t, _ in cases if t["family"].startswith("null")})
    shapes = sorted({t["family"] for t, _ in cases if t["family"].startswith("shape")})
    plan: list[Figure] = [
        share("one effect, data-sheet size: named first", of("single"), first_is_right, ">= 98 %"),
        share("one effect, data-sheet size: nothing else named", of("single"), exact, ""),
        share("one effect, x0.3: named first", of("small"), first_is_right, ""),
        share("one effect, x0.1: named first", of("tiny"), first_is_right, ""),
        share("one effect on one axis: named first", of("one_axis"), first_is_right, ""),
        share("two effects: exactly these", of("pairs"), exact, ">= 95 %"),
        share("two effects, five times the wander: exactly these", of("pairs_wander"), exact, ">= 85 %"),
        share("three effects: exactly these", of("triples"), exact, ""),
        share("a tenth of the samples lost: named first", of("lost"), first_is_right, ""),
        share("temperature in steps of 0.5 degC: named first", of("coarse"), first_is_right, ""),
        share("no temperature: named first", of("cold"), first_is_right, ""),
        *(share(f"nothing hidden, {f[5:]}: nothing selected", of(f), nothing_selected, ">= 99 %") for f in nulls),
        share("cannot be seen: said so, and not selected", of("unseen"), not_seen, "100 %"),
        share("not in the catalogue: nothing else said without a warning", removed, _not_silent, ">= 95 %"),
        *(share(f"not in the catalogue, {f[6:]}: said so", of(f), warned_or_named, "") for f in shapes),
    ]
    return [figure for figure in plan if figure.total]


def _not_silent(truth: JSON, said: JSON) -> bool:
    return not silent(truth, said)


def mean_excess_gone(cases: Iterable[tuple[JSON, JSON]]) -> tuple[float, float, int]:
    """Return the mean share of the held-out excess that is gone, its standard error, and the number of units."""
    values = np.array([v for _, said in cases if "error" not in said and (v := excess_gone(said)) is not None])
    if len(values) < 2:
        return float("nan"), float("nan"), len(values)
    return float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values))), len(values)


def confusions(cases: Iterable[tuple[JSON, JSON]]) -> dict[tuple[str, str, str], int]:
    """Return how often one hidden effect was called something else: (sensor, hidden, said) to the number."""
    found: dict[tuple[str, str, str], int] = {}
    for truth, said in cases:
        if "error" in said or len(truth["hidden"]) != 1 or truth["left_out"]:
            continue
        name = next(iter(truth["hidden"]))
        if said["selected"] != [name]:
            key = (truth["sensor"], name, " + ".join(said["selected"]) or "nothing")
            found[key] = found.get(key, 0) + 1
    return found


def found_at(cases: Iterable[tuple[JSON, JSON]]) -> Mapping[tuple[str, str], Mapping[str, tuple[int, int]]]:
    """Return for each sensor and effect in how many of how many cases of each size it was selected first."""
    table: dict[tuple[str, str], dict[str, tuple[int, int]]] = {}
    for truth, said in cases:
        if truth["family"] not in ("single", "small", "tiny") or truth["model"] != "mpu6050" or "error" in said:
            continue
        row = table.setdefault((truth["sensor"], next(iter(truth["hidden"]))), {})
        hits, total = row.get(truth["family"], (0, 0))
        row[truth["family"]] = (hits + first_is_right(truth, said), total + 1)
    return dict(sorted(table.items()))
