"""The page of the thesis: its tables and figures beside ours, its errata, and a verdict on each conclusion.

Each cell that differs from the printed one by more than a quarter has a letter that stands for the reason.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.records import Noise
from pipeline.report.numbers import MINUS, NOTHING, number, percent
from pipeline.report.pages import template
from pipeline.thesis.agreement import agreements, scatters
from pipeline.thesis.conclusions import KINDS, conclusions
from pipeline.thesis.errata import errata
from pipeline.thesis.figures import all_figures
from pipeline.thesis.method_tables import method_tables, paper_tables
from pipeline.thesis.results import DEVICES, Results
from pipeline.thesis.seeds import CAUSES, LOST, read_rows
from pipeline.thesis.tables import error_tables, parameter_tables

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from pipeline.report.comparison import Estimate
    from pipeline.thesis.conclusions import Conclusion
    from pipeline.thesis.tables import Cell, Table

JSON = dict[str, Any]


def all_tables(printed: Path, results: Results) -> list[Table]:
    """Return tables 5.1 to 5.26, then those of the paper."""
    tables = parameter_tables(printed, results) + error_tables(printed, results) + method_tables(printed, results)
    return sorted(tables, key=lambda t: int(t.number.split(".")[1])) + paper_tables(printed, results)


def render(campaign: Path, folder: Path) -> str:
    """Return ``thesis.html``.

    Parameters
    ----------
    campaign : Path
        With ``printed/`` and ``seeds.csv``.
    folder : Path
        Results of a run of it.
    """
    printed, results = campaign / "printed", Results(folder)
    rows = read_rows(campaign / "seeds.csv")
    scatter = scatters(printed, rows)
    silent = Noise(np.zeros(3), np.zeros(3), 100.0, "none")
    tables = [_table(t) for t in all_tables(printed, results)]
    page: str = template("thesis.html").render(
        tables=tables,
        figures=all_figures(printed, results, rows, scatter, silent),
        errata=errata(printed, results, rows),
        conclusions=[_conclusion(c) for c in conclusions(rows)],
        agreements=[
            {
                "what": a.what,
                "method": a.method,
                "bound": number(a.bound),
                "largest": number(a.largest),
                "within": f"{a.within} of {a.differences.size}",
                "kind": "good" if a.within == a.differences.size else "warn",
            }
            for a in agreements(printed, results)
        ],
        explanations=sorted((e for e in EXPLANATIONS if any(e.key in t["keys"] for t in tables)), key=lambda e: e.key),
        scatter=[
            {
                "device": DEVICES[s.device],
                "quantity": s.quantity,
                "printed": number(s.printed, 2),
                "causes": [number(v, 2) for v in s.seeds.values()],
                "unexplained": number(s.unexplained, 2),
                "share": percent(min(1.0, (s.seeds[LOST] / s.printed) ** 2)),
            }
            for s in scatter
        ],
        causes=CAUSES,
        seeds=rows["seed"].nunique(),
        cells=sum(t["cells"] for t in tables),
        large=sum(t["large"] for t in tables),
    )
    return page


def _table(table: Table) -> JSON:
    blocks, keys = [], set()
    for block in table.blocks:
        rows = []
        for row in block.rows:
            cells = []
            for cell, column in zip(row.cells, table.columns, strict=True):
                key = key_of(table.number, block.title, row.label, column) if cell.large else ""
                keys.add(key)
                cells.append(_cell(cell, key))
            rows.append({"label": row.label, "cells": cells})
        blocks.append({"title": block.title, "rows": rows})
    count = sum(len(row.cells) for block in table.blocks for row in block.rows)
    return {
        "id": table.number.replace(".", "-").replace(" ", "-"),
        "number": table.number,
        "title": table.title,
        "columns": table.columns,
        "blocks": blocks,
        "keys": keys - {""},
        "cells": count,
        "large": table.large,
    }


def _cell(cell: Cell, key: str) -> JSON:
    digits = cell.digits

    def text(value: float | None, *, sign: bool = False) -> str:
        if value is None:
            return NOTHING
        rounded = f"{value:{'+' if sign else ''}.{digits}f}"
        return rounded.lstrip("+-") if float(rounded) == 0.0 else rounded.replace("-", MINUS)

    return {
        "printed": text(cell.printed),
        "ours": text(cell.ours),
        "difference": text(cell.difference, sign=True),
        "key": key,
    }


def _conclusion(conclusion: Conclusion) -> JSON:
    scale = 1000.0 if conclusion.unit == "mg" else 1.0
    return {
        "says": conclusion.says,
        "caption": f"{conclusion.compared}, {conclusion.unit}",
        "verdict": conclusion.verdict,
        "kind": conclusion.kind,
        "remark": conclusion.remark,
        "lines": [
            {
                "what": line.what,
                "first": number(scale * line.first.value),
                "second": number(scale * line.second.value),
                **_difference(line.difference, scale),
                "count": line.difference.count,
                "verdict": line.verdict,
                "kind": KINDS[line.verdict],
            }
            for line in conclusion.lines
        ],
    }


def _difference(estimate: Estimate, scale: float) -> dict[str, str]:
    """Return a difference and its interval, to the decimals that two digits of the interval's half need."""
    low, high = estimate.interval
    half = scale * (high - low) / 2.0
    decimals = max(0, 1 - math.floor(math.log10(half))) if half > 0.0 else 3

    def text(value: float) -> str:
        return f"{scale * value:+.{decimals}f}".replace("-", MINUS)

    return {"difference": text(estimate.value), "interval": f"{text(low)} to {text(high)}"}


def unexplained(tables: Sequence[Table]) -> list[str]:
    """Return the cells whose difference is large and has no explanation."""
    return [
        f"table {t.number}, {block.title}, {row.label}, {column}"
        for t in tables
        for block in t.blocks
        for row in block.rows
        for cell, column in zip(row.cells, t.columns, strict=True)
        if cell.large and not key_of(t.number, block.title, row.label, column)
    ]


@dataclass(frozen=True)
class Explanation:
    """One reason.

    Attributes
    ----------
    key : str
    text : str
    where : str
        Regular expression of ``table|block|row|column``.
    """

    key: str
    text: str
    where: str


ACCELEROMETER = r"^5\.(8|9|10|11|12|13|24)\|"
GYROSCOPE = r"^5\.(19|20|21|22|26)\|"
EXPLANATIONS = (
    Explanation(
        "a",
        "The printed matrix of Cholesky and LU is the forward one (erratum 4); here stands its inverse, the "
        "correction, and what that leaves.",
        r"^5\.2[56]\|inverted.*\|.*, Cholesky and LU$",
    ),
    Explanation(
        "p",
        "b of y on the home-made table: a misprint of −0.014 (see the errata).",
        r"^5\.7\|.*\|by",
    ),
    Explanation(
        "b",
        "As printed, b is what an axis reads at the samples where another axis reads most and least. Noise moves "
        "these samples by some degrees from the true level, and a degree is 0.017 g. The printed b do not scatter "
        "like that: they cannot have been read off single samples (see the table of scatter).",
        r"^5\.([1-7]|23)\|.*as printed.*\|b",
    ),
    Explanation(
        "c",
        "What is simulated is the median over the procedures; the printed b of this one lies some thousandths of a "
        "g beside it.",
        r"^5\.([1-7]|23)\|.*\|b",
    ),
    Explanation(
        "d",
        "A bias of a few hundredths of a deg/s or less: that of the rests is uncertain by bias wander and noise of "
        "thousandths. It is within 0.02 deg/s of the printed one.",
        r"^5\.(15|16|17|18|25)\|.*\|b",
    ),
    Explanation(
        "e",
        "A misprint of the thesis, or one element of some thousandths that varies so from rate to rate; what is "
        "simulated is the median over the rates (erratum 5).",
        r"^5\.(15|16|17|25)\|",
    ),
    Explanation(
        "f",
        "What the home-made table's crossed axes and the mounting on it add to each other is not printed apart; the "
        "simulated ones are of the same size.",
        r"^5\.18\|",
    ),
    Explanation(
        "g",
        "The largest and the smallest of thousands of errors are matters of the tails of the noise and of the "
        "fastest part of a motion that is not printed.",
        r"(largest|smallest) e",
    ),
    Explanation(
        "h",
        "With errata corrected, what is left is hardly more than the noise of the held-out motion, and at 30 deg/s "
        "what the filter takes of the turn. The printed parameters leave more even on this motion: see the block in "
        "which they are applied to it.",
        ACCELEROMETER + r".*(corrected|least squares$)",
    ),
    Explanation(
        "i",
        "What picked peaks leave depends on how far the largest sample lies above the peak, so on the noise, the "
        "number of samples and the filter, of which only the second is printed.",
        ACCELEROMETER + r".*as printed",
    ),
    Explanation(
        "j",
        "The printed parameters on this campaign's held-out motion. Where more is left than was printed, the "
        "printed motion was kinder to them; where less is left, it held something else, noise or accelerations.",
        r"^5\.(8|9|1[0-4]|19|2[0-2])\|by the printed parameters",
    ),
    Explanation(
        "k",
        "How the home-made table shakes is not printed; what is simulated, 0.05 g at 7.3 Hz while it moves, is of the "
        "size of the printed errors of S. Samples picked in motion hold it, a sinusoid fitted to the rests does not: "
        "with errata corrected the home-made table is hardly worse than the precise one.",
        r"^5\.14\|",
    ),
    Explanation(
        "l",
        "The held-out motion of the gyroscope is not printed and was not isotropic (erratum 12); the noise of the "
        "recordings is not printed either. Of the STIM300 what is left is noise alone, before as after.",
        GYROSCOPE,
    ),
    Explanation(
        "m",
        "Angles of some thousandths of a degree: the noise of 24 rests of 10 s makes each uncertain by some "
        "hundredths.",
        r"^paper 1\|.*α",
    ),
    Explanation(
        "n",
        "What 24 means of 10 s leave is their noise; how long the paper's rests were, and how still, is not printed.",
        r"^paper 1\|.*RMSE",
    ),
    Explanation(
        "o",
        "The printed table of errors is symmetric, which errors of turns about different axes are not, and its 5.3 "
        "deg about x does not follow from the printed S, T and M: they make 0.1 deg over 45 deg. Unexplained. "
        "After, ours is what the noise integrates to.",
        r"^paper 4\|",
    ),
)


def key_of(table: str, block: str, row: str, column: str) -> str:
    """Return the key of the first explanation that holds for a cell, or nothing."""
    place = f"{table}|{block}|{row}|{column}"
    return next((e.key for e in EXPLANATIONS if re.search(e.where, place)), "")
