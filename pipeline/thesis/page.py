"""The page of the thesis: its tables and figures beside ours, its errata, and a verdict on each conclusion.

Each cell that differs from the printed one by more than a quarter has a letter that stands for the reason.
"""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Any, NamedTuple

import pandas as pd

from pipeline.report.numbers import MINUS, NOTHING
from pipeline.report.pages import template
from pipeline.thesis.conclusions import KINDS, conclusions
from pipeline.thesis.errata import agreements, errata, scatters
from pipeline.thesis.figures import all_figures
from pipeline.thesis.results import DEVICES, Results
from pipeline.thesis.seeds import CAUSES, LOST
from pipeline.thesis.tables import all_tables

if TYPE_CHECKING:
    from pathlib import Path

    from pipeline.report.comparison import Estimate

JSON = dict[str, Any]


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
    rows = pd.read_csv(campaign / "seeds.csv")
    scatter = scatters(printed, rows)
    cells = all_tables(printed, results)
    cells["key"] = [
        key_of(c["table"], c["block"], c["row"], c["column"]) if c["large"] else "" for c in cells.to_dict("records")
    ]
    page: str = template("thesis.html").render(
        tables=[_table(number, own) for number, own in cells.groupby("table", sort=False)],
        figures=all_figures(printed, results, rows, scatter),
        errata=errata(printed, results, rows),
        conclusions=conclusions(rows),
        kinds=KINDS,
        difference=_difference,
        agreements=agreements(printed, results).to_dict("records"),
        explanations=sorted(e for e in EXPLANATIONS if e.key in set(cells["key"])),
        scatter=[
            {
                "device": DEVICES[row["device"]],
                "quantity": row["quantity"],
                "printed": row["printed"],
                "causes": [row[cause] for cause in CAUSES],
                "unexplained": row["unexplained"],
                "share": min(1.0, (row[LOST] / row["printed"]) ** 2),
            }
            for row in scatter.to_dict("records")
        ],
        causes=CAUSES,
        seeds=rows["seed"].nunique(),
        cells=len(cells),
        large=cells["large"].sum(),
    )
    return page


def _table(number: str, cells: pd.DataFrame) -> JSON:
    blocks = [
        {
            "title": title,
            "rows": [
                {"label": label, "cells": [_cell(cell) for cell in row.to_dict("records")]}
                for label, row in block.groupby("row", sort=False)
            ],
        }
        for title, block in cells.groupby("block", sort=False)
    ]
    return {
        "id": number.replace(".", "-").replace(" ", "-"),
        "number": number,
        "title": cells["title"].iloc[0],
        "columns": list(cells["column"].unique()),
        "blocks": blocks,
    }


def _cell(cell: JSON) -> JSON:
    def text(value: float, sign: str = "") -> str:
        if math.isnan(value):
            return NOTHING
        rounded = f"{value:{sign}.{cell['digits']}f}"
        return rounded.lstrip("+-") if float(rounded) == 0.0 else rounded.replace("-", MINUS)

    texts = {"printed": text(cell["printed"]), "ours": text(cell["ours"]), "difference": text(cell["difference"], "+")}
    return {**texts, "key": cell["key"]}


def _difference(estimate: Estimate) -> tuple[str, str]:
    """Return a difference and its interval, to the decimals that two digits of the interval's half need."""
    half = estimate.expanded_uncertainty or 0.0
    decimals = max(0, 1 - math.floor(math.log10(half))) if half > 0.0 else 3
    value, low, high = (f"{v:+.{decimals}f}".replace("-", MINUS) for v in (estimate.value, *estimate.interval))
    return value, f"{low} to {high}"


class Explanation(NamedTuple):
    """A reason for large differences; ``where``: regular expression of ``table|block|row|column`` of the cells."""

    key: str
    text: str
    where: str


ACCELEROMETER = r"^5\.(8|9|10|11|12|13|24)\|"
GYROSCOPE = r"^5\.(19|20|21|22|26)\|"
EXPLANATIONS = (  # the first that holds for a cell
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
