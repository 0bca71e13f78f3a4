"""Scores of the posterior: whether its answer sets, probabilities and upper limits are right.

The truth of a case is the set of its hidden effects, or the empty set where nothing is hidden or nothing can be seen.
It counts only under its own name: no look-alike stands for it here. An upper limit is judged by each parameter of the
hidden effect where that was not selected.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pipeline.report.chart import Dots, Line, Panel, chart
from pipeline.report.chart import Figure as Chart
from pipeline.study.scores import Figure, exact, is_null, share, wilson

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

JSON = dict[str, Any]
SETS = (
    "single", "one_axis", "staged", "lost", "coarse", "cold", "pairs", "pairs_wander", "triples", "unseen", "null",
)  # fmt: skip  # families whose truth is a set of effects of the catalogue that the recordings can show
LIMITS = {"limit_30": "0.3", "limit_60": "0.6", "limit_100": "1"}  # family to the share of the detection size
EDGES = (0.0, 0.01, 0.03, 0.1, 0.3, 0.5, 0.7, 0.9, 0.97, 1.0)  # of said probabilities
GOAL, FAMILY_GOAL, SIZE_GOAL = ">= 93.6 %", ">= 90 %", 3.0
STYLE = (
    "<style>.chart{background:#fff}text{font:12px sans-serif;fill:#57606a}.e{text-anchor:end}.m{text-anchor:middle}"
    "path{fill:none;stroke:currentColor;stroke-width:1.5;vector-effect:non-scaling-stroke}.grid{stroke:#d0d7de}"
    ".dots{stroke-width:6;stroke-linecap:round}.dashed{stroke-dasharray:4}.c2{color:#1d5fbf}.c5{color:#8b949e}</style>"
)
RATIO_GOAL = {"limit_30": 4.0, "limit_60": 2.2, "limit_100": 1.6}  # of the median limit over the truth


def family_of(case: JSON) -> str:
    """Return the family of a case, all noises of "nothing hidden" together."""
    return "null" if is_null(case) else str(case["family"])


def true_set(case: JSON) -> list[str]:
    """Return the effects that a perfect answer names."""
    return [] if family_of(case) == "unseen" else sorted(case["hidden"])


def in_the_set(case: JSON) -> bool:
    """Return whether the truth is one of the answers."""
    return true_set(case) in [sorted(answer["effects"]) for answer in case["answer_set"]]


def best_is_exact(case: JSON) -> bool:
    """Return whether the most probable answer is the truth or its declared look-alikes."""
    best = case["answer_set"][0]["effects"] if case["answer_set"] else []
    return exact({**case, "selected": best, "hidden": true_set(case)})


def answered(cases: Iterable[JSON]) -> list[JSON]:
    """Return the cases whose truth an answer set can hold, and the faults among them."""
    return [c for c in cases if family_of(c) in SETS and ("error" in c or "answer_set" in c)]


def figures(cases: Sequence[JSON]) -> list[Figure]:
    """Return the shares of answer sets that hold the truth, and of upper limits that hold it."""
    known = answered(cases)
    found = [share("truth in the 95 % answer set", known, in_the_set, GOAL)]
    for family in SETS:
        own = [c for c in known if family_of(c) == family]
        found.append(share(f"... {family}", own, in_the_set, "" if family == "triples" else FAMILY_GOAL))
    found += [share("most probable answer: exactly the truth", known, best_is_exact, "")]
    found += [share("... selected: exactly the truth", known, _selected_is_exact, "")]
    for family, size in LIMITS.items():
        over = ratios(cases, family)
        name = f"upper limits at {size} x the detection size: above the truth"
        found.append(Figure(name, int(np.sum(over >= 1.0)), len(over), GOAL))
    return [figure for figure in found if figure.total]


def _selected_is_exact(case: JSON) -> bool:
    return exact({**case, "hidden": true_set(case)})


def ratios(cases: Iterable[JSON], family: str) -> np.ndarray:
    """Return the upper limits over the true parameters of the hidden effects that were not selected: (n,) array."""
    over = []
    for case in cases:
        if case["family"] == family and "error" not in case:
            (name, values), *_ = case["hidden"].items()
            limits = list((case["upper_limit"].get(name) or {}).values())
            over += [limit["value"] / abs(value) for limit, value in zip(limits, values, strict=False) if value]
    return np.array(over)


class Number(NamedTuple):
    """A mean or median that has a goal."""

    name: str
    value: float
    total: int
    goal: str


def numbers(cases: Sequence[JSON]) -> list[Number]:
    """Return the mean size of the answer sets, and the median of the upper limits over the truth."""
    sizes = [len(case["answer_set"]) for case in answered(cases) if "error" not in case]
    found = [Number("answers in a set, mean", float(np.mean(sizes)), len(sizes), f"<= {SIZE_GOAL:g}")] if sizes else []
    for family, size in LIMITS.items():
        over = ratios(cases, family)
        name = f"upper limit at {size} x the detection size over the truth, median"
        if len(over):
            found.append(Number(name, float(np.median(over)), len(over), f"<= {RATIO_GOAL[family]:g}"))
    return found


class Bin(NamedTuple):
    """Probabilities that were said, and how many of their effects are there."""

    said: float  # mean
    hits: int
    total: int

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % interval of the true share."""
        return wilson(self.hits, self.total)


def reliability(cases: Sequence[JSON]) -> list[Bin]:
    """Return the said probabilities of all effects of the cases in bins, the smallest first."""
    pairs = [
        (probability, name in true_set(case))
        for case in answered(cases)
        if "error" not in case
        for name, probability in case["probability"].items()
    ]
    said, there = (np.array(column) for column in zip(*pairs, strict=True)) if pairs else (np.zeros(0), np.zeros(0))
    place = np.clip(np.searchsorted(EDGES, said, side="right") - 1, 0, len(EDGES) - 2)
    return [
        Bin(float(said[place == k].mean()), int(there[place == k].sum()), int(np.sum(place == k)))
        for k in np.unique(place)
    ]


def reliability_diagram(cases: Sequence[JSON]) -> str:
    """Return the said probabilities against the true shares as an SVG file; empty where none was said."""
    bins = reliability(cases)
    if not bins:
        return ""
    said, true = np.array([b.said for b in bins]), np.array([b.hits / b.total for b in bins])
    low, high = np.array([b.interval for b in bins]).T
    ends = np.array([0.0, 1.0])
    total = sum(b.total for b in bins)
    figure = Chart("reliability", f"Probabilities of effects against the share of them that is there (n = {total})")
    points = "; ".join(f"said {b.said:.2g}: {b.hits} of {b.total}" for b in bins)
    panel = Panel([Line(ends, ends, 5, "dashed"), Dots(said, true, 2, low, high)], "true share", 300, limits=(0.0, 1.0))
    drawn = chart(figure, points, [panel], "said probability; bars: 95 % intervals", margin=0.02)
    head, tail = str(drawn.svg).replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" ', 1).split("</title>", 1)
    return f"{head}</title>{STYLE}{tail}\n"
