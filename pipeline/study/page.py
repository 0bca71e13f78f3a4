"""A study as a Markdown page: its scores, and tables of what the diagnosis said of which hidden effect and size."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any

import pandas as pd

from pipeline.model.effects import effect
from pipeline.study.cases import FAINT, SIZES
from pipeline.study.scores import (
    Score,
    answer_scores,
    family_scores,
    first_is_right,
    mean_excess_gone,
    named,
    outside_answered,
    reliability,
    warned,
    wilson,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence


JSON = dict[str, Any]
Rows = list[list[Any]]
LISTED = 40  # cases on the page that miss a goal
OF_SIZE = ("single", "small", "tiny")
BOUNDS = (0.0, 30.0, 60.0, 100.0, 200.0, 500.0, float("inf"))  # of lambda, around the 40 to 100 that a selection asks
HEAD = """\
# The blind study: how often the diagnosis is right

Written by `{command}`, the product's code being {code}.

Each case is a simulated unit, drawn at random: sensor model, sensor, procedure, effects, their sizes within 30 % of
those in the last table with random signs, and every random number of the simulation, which turns the table with exact
geometry. The truth stands in a file of its own; the diagnosis gets the recordings and the configuration of a unit, and
every step is the function that the stage of a run calls. Shares have 95 % intervals (Wilson), means two standard errors
to either side. A look-alike counts where the diagnosis itself declares that it reproduces over 95 % of the hidden
signal. What each family hides: `pipeline/study/cases.py`; how: `pipeline/study/bench.py`.

"Nothing hidden" counts each sensor of a unit by itself. "Taken out of the catalogue" counts the units of which the
whole catalogue names the hidden effect and knows none with over 95 % of its signal.
"""
SIZE_TEXT = "Selected first, of n, on the MPU-6050 at the size of its data sheet and at shares of it."
SIGNAL_TEXT = """\
Every hidden effect by lambda: what a perfect diagnosis, to which noise and equation are known, would gain in 2 log L by
it beside the others (`pipeline/study/bench.py`). A selection asks for 40 to 100, by its number of parameters."""
FIGURE_HEAD = ["figure", "n", "share", "95 % interval", "goal"]
ANSWER_TEXT = """\
A case counts where one answer of the 95 % answer set is exactly the hidden effects, by their own names (nothing, where
nothing is hidden or nothing can be seen). Limits do not depend on what is selected. They are counted where they are
stated: for effects that were not selected, each parameter by itself."""
DIAGRAM = "reliability.svg"
RELIABLE_TEXT = f"""\
The probability of every effect in the same cases, against the share of them in which it was there.

![Probabilities of effects against the share of them that is there](images/{DIAGRAM})"""
RELIABLE_HEAD = ["said, mean", "n", "true", "95 % interval"]
MISS_TEXT = "In brackets lambda."
SHAPE_HEAD = [
    "hidden",
    "n",
    "unexplained",
    "other warning",
    "answered",
    "silent",
    "nothing",
    "most often said",
    "excess gone",
]
SHAPE_TEXT = """\
Where the temperature only rises, a curve of the temperature and one of the time are the same. "Answered": no warning,
but an answer of the answer set follows something outside the catalogue. What is said silently is a substitute, whose
worth is the share of the held-out excess that it takes away (last column)."""
DATA_SHEET = "Median of the size drawn; one number is for all parameters. A warm-up's time constant is 90 to 400 s."


def page(cases: Sequence[JSON], command: str) -> str:
    """Return the page; ``command`` makes it again."""
    code = " and ".join(sorted({f"`{case['code']}`" for case in cases if "code" in case})) or "unknown"
    said = table_of(cases)
    faults = [[case["key"], case["error"]] for case in cases if "error" in case]
    families, answers = family_scores(cases), [score.cells for score in answer_scores(cases)]
    reliable = [[f"{float(name):.2g}", *cells] for name, *cells, _ in (bin_.cells for bin_ in reliability(cases))]
    parts = [
        HEAD.format(command=command, code=code),
        _table(FIGURE_HEAD, [score.cells for score in families]),
        _section("Answer sets, probabilities and upper limits", ANSWER_TEXT, FIGURE_HEAD, answers),
        _section("Are probabilities right?", RELIABLE_TEXT, RELIABLE_HEAD, reliable),
        _section("Detection by size", SIZE_TEXT, ["sensor", "effect", "x1", "x0.3", "x0.1"], found_at(said)),
        _section("Detection by signal", SIGNAL_TEXT, ["lambda", "n", "selected", "95 % interval"], by_signal(cases)),
        _section("Called something else", "", ["sensor", "hidden", "said", "cases"], confusions(said)),
        _section("Taken out of the catalogue", "", ["sensor", "hidden", "said", "warning", "cases"], instead(said)),
        _section("Physics in another form than the catalogue's", SHAPE_TEXT, SHAPE_HEAD, of_shapes(cases)),
        _section("Cases that miss a goal", MISS_TEXT, ["case", "unit", "hidden", "said"], _misses(cases, families)),
        _section("Faults", "", ["case", "error"], faults),
        _section(
            "What data-sheet size is", DATA_SHEET, ["model", "sensor", "effect", "size", "unit"], _sensor_file_sizes()
        ),
    ]
    return "\n".join(part for part in parts if part)


def _table(head: Sequence[str], rows: Rows) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(map(str, line))} |\n" for line in lines)


def _section(title: str, text: str, head: Sequence[str], rows: Rows) -> str:
    if not rows:
        return ""
    return "\n".join([f"## {title}\n", *([f"{text}\n"] if text else []), _table(head, rows)])


def table_of(cases: Iterable[JSON]) -> pd.DataFrame:
    """Return a row for each diagnosis of a unit with one hidden effect, or with effects left out of the catalogue."""
    rows = [
        {
            "family": case["family"],
            "model": case["model"],
            "sensor": case["sensor"],
            "hidden": (case["left_out"] or list(case["hidden"]))[0],
            "said": _said(case),
            "left_out": bool(case["left_out"]),
            "alone": case["selected"] == list(case["hidden"]),
            "first": first_is_right(case),
            "warned": "yes" if warned(case) else "no",
        }
        for case in cases
        if "error" not in case and (case["left_out"] or len(case["hidden"]) == 1)
    ]
    columns = ["family", "model", "sensor", "hidden", "said", "left_out", "alone", "first", "warned"]
    return pd.DataFrame(rows, columns=columns).astype({"left_out": bool, "alone": bool})


def _said(case: JSON) -> str:
    return " + ".join(case["selected"]) or "nothing"


def found_at(said: pd.DataFrame) -> Rows:
    """Return for each sensor and effect in how many of how many cases of each size it was selected first."""
    own = said[said["family"].isin(OF_SIZE) & (said["model"] == "mpu6050")]
    rows: dict[tuple[str, str], dict[str, str]] = {}
    for (sensor, name, size), first in own.groupby(["sensor", "hidden", "family"])["first"]:
        row = rows.setdefault((sensor, name), dict.fromkeys(OF_SIZE, ""))
        row[size] = f"{first.sum()} of {len(first)}"
    return [[sensor, f"`{name}`", *row.values()] for (sensor, name), row in rows.items()]


def confusions(said: pd.DataFrame) -> Rows:
    """Return how often one hidden effect was called something else, the most frequent first."""
    own = said[~said["left_out"] & (said["family"] != "unseen") & ~said["alone"]]
    counts = own.groupby(["sensor", "hidden", "said"]).size().sort_values(ascending=False, kind="stable")
    return [[sensor, f"`{name}`", other, count] for (sensor, name, other), count in counts.items()]


def instead(said: pd.DataFrame) -> Rows:
    """Return what was said of effects that the catalogue was left without, and whether with a warning."""
    counts = said[said["left_out"]].groupby(["sensor", "hidden", "said", "warned"]).size()
    return [[sensor, f"`{name}`", *rest, count] for (sensor, name, *rest), count in counts.items()]


def by_signal(cases: Iterable[JSON]) -> Rows:
    """Return how many effects were selected, of how many, by the signal that each leaves beside the others."""
    found = pd.DataFrame(
        [
            (left, any(named(case, name, selected) for selected in case["selected"]))
            for case in cases
            if "error" not in case and not case["left_out"] and case["family"] != "unseen"
            for name, left in (case.get("signal_left") or {}).items()
        ],
        columns=["left", "selected"],
    )
    rows = []
    for bin_, hits in found.groupby(pd.cut(found["left"], BOUNDS, right=False), observed=True)["selected"]:
        low, high = bin_.left, bin_.right
        text = f"{low:g} to {high:g}" if high < BOUNDS[-1] else f"{low:g} and more"
        least, most = wilson(int(hits.sum()), len(hits))
        rows.append([text, len(hits), f"{100 * hits.mean():.0f} %", f"{100 * least:.0f} to {100 * most:.0f} %"])
    return rows


def of_shapes(cases: Sequence[JSON]) -> Rows:
    """Return a row for each form of unknown physics: what was said of it, and what that does to held-out motion."""
    rows = []
    for family in sorted({case["family"] for case in cases if case["shape"]}):
        own = [case for case in cases if case["family"] == family and "error" not in case]
        if not own:
            continue
        unexplained = sum(case["verdict"] == "unexplained" for case in own)
        with_warning = sum(case["verdict"] != "unexplained" and warned(case) for case in own)
        unwarned = [outside_answered(case) for case in own if case["selected"] and not warned(case)]
        answered, silent = sum(unwarned), len(unwarned) - sum(unwarned)
        name, count = Counter(map(_said, own)).most_common(1)[0]
        gone = "".join(f"{100 * mean.value:.0f} % (n = {mean.total})" for mean in mean_excess_gone(own))
        nothing = len(own) - unexplained - with_warning - len(unwarned)
        counts = [len(own), unexplained, with_warning, answered, silent, nothing]
        rows.append([family.replace("_", " "), *counts, f"{name} ({count})", gone])
    return rows


def _misses(cases: Sequence[JSON], scores: Sequence[Score]) -> Rows:
    by_key = {key: case for case in cases for key in (case["key"], f"{case['key']} {case['sensor']}")}
    keys = [key for score in scores if score.goal for key in score.misses]
    rows = []
    for key in keys[:LISTED]:
        case = by_key[key]
        left = case.get("signal_left") or {}
        hidden = " + ".join(f"{n} ({left[n]:.0f})" if n in left else n for n in case["hidden"]) or "nothing"
        unit = f"{case['model']} {case['sensor']} {case['procedure']}"
        rows.append([key, unit, hidden, case.get("error") or (" + ".join(case["selected"]) or case["verdict"])])
    more = len(keys) - len(rows)
    return [*rows, *([[f"and {more} more", "", "", ""]] if more else [])]


def _sensor_file_sizes() -> Rows:
    rows = []
    for model, sensors in SIZES.items():
        for sensor, sizes in sensors.items():
            for name, size in sizes.items():
                values = size if isinstance(size, tuple) else (size,)
                text = ", ".join(dict.fromkeys(f"{value:.3g}" for value in values))
                units = ", ".join(dict.fromkeys(p.unit for p in effect(name).parameters(sensor)))
                faint = " (hides in the noise)" if name in FAINT[model][sensor] else ""
                rows.append([model, sensor, f"`{name}`{faint}", text, units])
    return rows
