"""A study as a Markdown page: its scores, and tables of what the diagnosis said of which hidden effect and size."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from pipeline.model.effects import effect
from pipeline.study import figures
from pipeline.study.cases import FAINT, SIZES
from pipeline.study.figures import families, first_is_right, mean_excess_gone, named, warned, wilson

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

JSON = dict[str, Any]
Pair = tuple[JSON, JSON]
LISTED = 40
OF_SIZE = ("single", "small", "tiny")
BOUNDS = (0.0, 30.0, 60.0, 100.0, 200.0, 500.0, float("inf"))
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
MISS_TEXT = "In brackets lambda."
SHAPE_HEAD = ["hidden", "n", "unexplained", "other warning", "silent", "nothing", "most often said", "excess gone"]
SHAPE_TEXT = """\
Where the temperature only rises, a curve of the temperature and one of the time are the same: what is said silently is
then a substitute, whose worth is the share of the held-out excess that it takes away (last column)."""
DATA_SHEET = "Median of the size drawn; one number is for all parameters. A warm-up's time constant is 90 to 400 s."


def page(cases: Sequence[Pair], command: str) -> str:
    """Return the page.

    Parameters
    ----------
    cases : sequence of (dict, dict)
        Truth and result of each case.
    command : str
        That makes the page again.
    """
    code = " and ".join(sorted({f"`{said['code']}`" for _, said in cases if "code" in said})) or "unknown"
    parts = [
        HEAD.format(command=command, code=code),
        table(["figure", "n", "share", "95 % interval", "goal"], _figures(cases)),
        _section("Detection by size", SIZE_TEXT, ["sensor", "effect", "x1", "x0.3", "x0.1"], _sizes(cases)),
        _section("Detection by signal", SIGNAL_TEXT, ["lambda", "n", "selected", "95 % interval"], by_signal(cases)),
        _section("Called something else", "", ["sensor", "hidden", "said", "cases"], _confusions(cases)),
        _section("Taken out of the catalogue", "", ["sensor", "hidden", "said", "warning", "cases"], _instead(cases)),
        _section("Physics in another form than the catalogue's", SHAPE_TEXT, SHAPE_HEAD, of_shapes(cases)),
        _section("Cases that miss a goal", MISS_TEXT, ["case", "unit", "hidden", "said"], _misses(cases)),
        _section("Faults", "", ["case", "error"], [[t["key"], s["error"]] for t, s in cases if "error" in s]),
        _section("What data-sheet size is", DATA_SHEET, ["model", "sensor", "effect", "size", "unit"], _data_sheet()),
    ]
    return "\n".join(part for part in parts if part)


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _section(title: str, text: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    if not rows:
        return ""
    return "\n".join([f"## {title}\n", *([f"{text}\n"] if text else []), table(head, rows)])


def _figures(cases: Sequence[Pair]) -> list[list[str]]:
    rows = []
    for figure in figures.all_figures(cases):
        low, high = figure.interval
        value = f"{100 * figure.hits / figure.total:.1f} %"
        rows.append([figure.name, str(figure.total), value, f"{100 * low:.1f} to {100 * high:.1f} %", figure.goal])
    mean = figures.mean_excess_gone(figures.in_the_catalogue(cases))
    if mean.total > 1:
        low, high = mean.value - figures.Z * mean.error, mean.value + figures.Z * mean.error
        name = "held-out excess over the noise floor that is gone with what was selected, mean"
        rows.append(
            [name, str(mean.total), f"{100 * mean.value:.1f} %", f"{100 * low:.1f} to {100 * high:.1f} %", ">= 98 %"]
        )
    return rows


def _sizes(cases: Sequence[Pair]) -> list[list[str]]:
    rows = []
    for (sensor, name), row in found_at(cases).items():
        cells = [f"{row[size][0]} of {row[size][1]}" if size in row else "" for size in OF_SIZE]
        rows.append([sensor, f"`{name}`", *cells])
    return rows


def _confusions(cases: Sequence[Pair]) -> list[list[str]]:
    found = sorted(confusions(cases).items(), key=lambda item: (-item[1], item[0]))
    return [[sensor, f"`{name}`", said, str(number)] for (sensor, name, said), number in found]


def _instead(cases: Sequence[Pair]) -> list[list[str]]:
    found = sorted(instead(cases).items())
    return [
        [sensor, f"`{name}`", said, "yes" if warned else "no", str(number)]
        for (sensor, name, said, warned), number in found
    ]


def _misses(cases: Sequence[Pair]) -> list[list[str]]:
    by_key = {figures.key_of(pair): pair for pair in cases}
    keys = [key for figure in figures.all_figures(cases) if figure.goal for key in figure.misses]
    rows = []
    for key in keys[:LISTED]:
        truth, said = by_key[key]
        left = truth.get("signal_left") or {}
        hidden = " + ".join(f"{n} ({left[n]:.0f})" if n in left else n for n in truth["hidden"]) or "nothing"
        unit = f"{truth['model']} {truth['sensor']} {truth['procedure']}"
        rows.append([key, unit, hidden, said.get("error") or (" + ".join(said["selected"]) or said["verdict"])])
    more = len(keys) - len(rows)
    return [*rows, *([[f"and {more} more", "", "", ""]] if more else [])]


def _data_sheet() -> list[list[str]]:
    rows = []
    for model, sensors in SIZES.items():
        for sensor, sizes in sensors.items():
            for name, size in sizes.items():
                parameters = effect(name).parameters(sensor)
                values = size if isinstance(size, tuple) else (size,)
                units = dict.fromkeys(p.unit for p in parameters)
                text = ", ".join(dict.fromkeys(f"{value:.3g}" for value in values))
                faint = " (hides in the noise)" if name in FAINT[model][sensor] else ""
                rows.append([model, sensor, f"`{name}`{faint}", text, ", ".join(units)])
    return rows


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
