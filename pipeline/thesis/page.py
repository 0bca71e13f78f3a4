"""The page of the thesis: its tables and figures beside ours, its errata, and a verdict on each conclusion."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.records import Noise
from pipeline.report.numbers import MINUS, NOTHING, number, percent
from pipeline.report.templating import template
from pipeline.thesis.agreement import agreements
from pipeline.thesis.conclusions import KINDS, conclusions
from pipeline.thesis.errata import errata
from pipeline.thesis.explanations import EXPLANATIONS, key_of
from pipeline.thesis.figures import all_figures
from pipeline.thesis.method_tables import method_tables, paper_tables
from pipeline.thesis.recorded import CAUSES, LOST
from pipeline.thesis.results import DEVICES, Results
from pipeline.thesis.scatter import scatters
from pipeline.thesis.seeds import read_rows
from pipeline.thesis.tables import error_tables, parameter_tables

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from pipeline.report.comparison_statistics import Estimate
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
        seeds=len({r["seed"] for r in rows}),
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
