"""A study as a Markdown page."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.study.figures import all_figures, confusions, found_at, mean_excess_gone

if TYPE_CHECKING:
    from collections.abc import Sequence

JSON = dict[str, Any]
HEAD = """\
# The blind study: how often the diagnosis is right

Written by `{command}`.

Each case is a simulated unit of about 10,000 samples, drawn at random: sensor model, sensor, procedure, effects, their
sizes within 30 % of the data sheet's with random signs, and every random number of the simulation. The simulator turns
the table with exact geometry; the diagnosis gets the recordings and the data sheet alone. Shares have 95 % intervals
(Wilson). A look-alike counts where the diagnosis itself declares that it reproduces over 95 % of the other's signal.
What a family hides is described in `pipeline/study/cases.py`.
"""


def page(cases: Sequence[tuple[JSON, JSON]], command: str) -> str:
    """Return the page.

    Parameters
    ----------
    cases : sequence of (dict, dict)
        Truth and result of each case.
    command : str
        That makes the page again.
    """
    lines = [HEAD.format(command=command), "| figure | n | share | 95 % interval | goal |", "|---|---:|---:|---|---|"]
    for figure in all_figures(list(cases)):
        low, high = figure.interval
        value = f"{100 * figure.hits / figure.total:.1f} %"
        lines.append(
            f"| {figure.name} | {figure.total} | {value} | {100 * low:.1f} to {100 * high:.1f} % | {figure.goal} |"
        )
    mean, error, count = mean_excess_gone(cases)
    if count > 1:
        spread = f"{100 * (mean - 1.96 * error):.1f} to {100 * (mean + 1.96 * error):.1f} %"
        lines.append(
            f"| held-out excess over the noise floor that is gone, mean | {count} | {100 * mean:.1f} % | {spread} "
            "| >= 98 % |"
        )
    lines += ["", "## Detection by size", "", "Selected first, of n, on the MPU-6050 at the data sheet's size:", ""]
    lines += ["| sensor | effect | x1 | x0.3 | x0.1 |", "|---|---|---|---|---|"]
    for (sensor, name), row in found_at(cases).items():
        cells = [f"{h} of {n}" if (n := row.get(f, (0, 0))[1]) and (h := row[f][0]) is not None else "" for f in SIZES]
        lines.append(f"| {sensor} | `{name}` | {' | '.join(cells)} |")
    lines += ["", "## What was called something else", "", "| sensor | hidden | said | cases |", "|---|---|---|---:|"]
    for (sensor, name, said), number in sorted(confusions(cases).items(), key=lambda item: -item[1]):
        lines.append(f"| {sensor} | `{name}` | {said} | {number} |")
    faults = [f"{truth['key']}: {said['error']}" for truth, said in cases if "error" in said]
    if faults:
        lines += ["", "## Faults", "", *(f"* {fault}" for fault in faults)]
    return "\n".join(lines) + "\n"


SIZES = ("single", "small", "tiny")
