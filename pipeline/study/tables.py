"""The tables of a study beside its figures: what was said of what, and at which sizes."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from pipeline.study.figures import families, mean_excess_gone, wilson
from pipeline.study.verdicts import first_is_right, named, warned

if TYPE_CHECKING:
    from collections.abc import Iterable

JSON = dict[str, Any]
Pair = tuple[JSON, JSON]
OF_SIZE = ("single", "small", "tiny")
BOUNDS = (0.0, 30.0, 60.0, 100.0, 200.0, 500.0, float("inf"))


def confusions(cases: Iterable[Pair]) -> Counter[tuple[str, str, str]]:
    """Return how often one hidden effect was called something else: (sensor, hidden, said) to the number."""
    found: Counter[tuple[str, str, str]] = Counter()
    for truth, said in cases:
        if "error" in said or len(truth["hidden"]) != 1 or truth["left_out"] or truth["family"] == "unseen":
            continue
        name = next(iter(truth["hidden"]))
        if said["selected"] != [name]:
            found[truth["sensor"], name, _names(said)] += 1
    return found


def instead(cases: Iterable[Pair]) -> Counter[tuple[str, str, str, bool]]:
    """Return what was said of effects that the catalogue was left without: (sensor, hidden, said, warned)."""
    found: Counter[tuple[str, str, str, bool]] = Counter()
    for truth, said in cases:
        if truth["left_out"] and "error" not in said:
            found[truth["sensor"], truth["left_out"][0], _names(said), warned(said)] += 1
    return found


def found_at(cases: Iterable[Pair]) -> dict[tuple[str, str], dict[str, tuple[int, int]]]:
    """Return for each sensor and effect in how many of how many cases of each size it was selected first."""
    table: dict[tuple[str, str], dict[str, tuple[int, int]]] = {}
    for truth, said in cases:
        if truth["family"] not in OF_SIZE or truth["model"] != "mpu6050" or "error" in said:
            continue
        row = table.setdefault((truth["sensor"], next(iter(truth["hidden"]))), {})
        hits, total = row.get(truth["family"], (0, 0))
        row[truth["family"]] = (hits + first_is_right(truth, said), total + 1)
    return dict(sorted(table.items()))


def by_signal(cases: Iterable[Pair]) -> list[list[str]]:
    """Return how many effects were selected, of how many, by the signal that each leaves beside the others."""
    found = [
        (left, any(named(name, said, selected) for selected in said["selected"]))
        for truth, said in cases
        if "error" not in said and not truth["left_out"] and truth["family"] != "unseen"
        for name, left in (truth.get("signal_left") or {}).items()
    ]
    rows = []
    for low, high in pairwise(BOUNDS):
        within = [hit for left, hit in found if low <= left < high]
        if within:
            least, most = wilson(sum(within), len(within))
            text = f"{low:g} to {high:g}" if high < BOUNDS[-1] else f"{low:g} and more"
            value = f"{100 * sum(within) / len(within):.0f} %"
            rows.append([text, str(len(within)), value, f"{100 * least:.0f} to {100 * most:.0f} %"])
    return rows


def of_shapes(cases: Iterable[Pair]) -> list[list[str]]:
    """Return a row for each form of unknown physics: what was said of it, and what that does to held-out motion."""
    rows = []
    for family, pairs in families(cases).items():
        said = [s for t, s in pairs if t["shape"] and "error" not in s]
        if not said:
            continue
        unexplained = sum(s["verdict"] == "unexplained" for s in said)
        with_warning = sum(s["verdict"] != "unexplained" and warned(s) for s in said)
        silent = sum(bool(s["selected"]) and not warned(s) for s in said)
        names, number = Counter(_names(s) for s in said).most_common(1)[0]
        mean = mean_excess_gone(pairs)
        gone = f"{100 * mean.value:.0f} % (n = {mean.total})" if mean.total > 1 else ""
        counts = [len(said), unexplained, with_warning, silent, len(said) - unexplained - with_warning - silent]
        rows.append([family.replace("_", " "), *map(str, counts), f"{names} ({number})", gone])
    return rows


def _names(said: JSON) -> str:
    return " + ".join(said["selected"]) or "nothing"
