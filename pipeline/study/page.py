"""A study as a Markdown page."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.model.effects import effect
from pipeline.study import figures, tables
from pipeline.study.sizes import FAINT, SIZES

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

JSON = dict[str, Any]
Pair = tuple[JSON, JSON]
LISTED = 40
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
        _section(
            "Detection by signal", SIGNAL_TEXT, ["lambda", "n", "selected", "95 % interval"], tables.by_signal(cases)
        ),
        _section("Called something else", "", ["sensor", "hidden", "said", "cases"], _confusions(cases)),
        _section("Taken out of the catalogue", "", ["sensor", "hidden", "said", "warning", "cases"], _instead(cases)),
        _section("Physics in another form than the catalogue's", SHAPE_TEXT, SHAPE_HEAD, tables.of_shapes(cases)),
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
    for (sensor, name), row in tables.found_at(cases).items():
        cells = [f"{row[size][0]} of {row[size][1]}" if size in row else "" for size in tables.OF_SIZE]
        rows.append([sensor, f"`{name}`", *cells])
    return rows


def _confusions(cases: Sequence[Pair]) -> list[list[str]]:
    found = sorted(tables.confusions(cases).items(), key=lambda item: (-item[1], item[0]))
    return [[sensor, f"`{name}`", said, str(number)] for (sensor, name, said), number in found]


def _instead(cases: Sequence[Pair]) -> list[list[str]]:
    found = sorted(tables.instead(cases).items())
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


SIZE_TEXT = "Selected first, of n, on the MPU-6050 at the size of its data sheet and at shares of it."
SIGNAL_TEXT = """\
Every hidden effect by lambda: what a perfect diagnosis, to which noise and equation are known, would gain in 2 log L by
it beside the others (`pipeline/study/signal_left.py`). A selection asks for 40 to 100, by its number of parameters."""
MISS_TEXT = "In brackets lambda."
SHAPE_HEAD = ["hidden", "n", "unexplained", "other warning", "silent", "nothing", "most often said", "excess gone"]
SHAPE_TEXT = """\
Where the temperature only rises, a curve of the temperature and one of the time are the same: what is said silently is
then a substitute, whose worth is the share of the held-out excess that it takes away (last column)."""
DATA_SHEET = "Median of the size drawn; one number is for all parameters. A warm-up's time constant is 90 to 400 s."
