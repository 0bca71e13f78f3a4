"""A text log read as a whole: what is wrong is named by its line, or repaired with a note where the profile says so."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from pipeline.errors import IngestError
from pipeline.io.csv_fault import KIND_OF_SETTING, find_faults, quoted_numbers, refusal, with_parted_rows
from pipeline.io.csv_layout import find_layout
from pipeline.io.csv_parse import all_finite, parse
from pipeline.io.csv_rows import Rows
from pipeline.io.csv_time import EXACT_BELOW_S, LONGEST_S, exact_times, seconds_per_unit
from pipeline.io.ingest_settings import DROP, GAP
from pipeline.io.text_file import load_text
from pipeline.records import Note

if TYPE_CHECKING:
    from pathlib import Path

    from pipeline.io.csv_fault import Fault
    from pipeline.io.csv_layout import Layout
    from pipeline.io.ingest_settings import Checks, CsvFormat


def read_carefully(path: Path, settings: CsvFormat, checks: Checks) -> Rows:
    """Read the rows of a log as a whole, name what is wrong, drop what may be dropped."""
    text = load_text(path, keep_nul=settings.bad_rows == DROP)
    layout = find_layout(text, settings)
    notes, repaired, restarts = list(layout.notes), 0, tuple[int, ...]()
    table = _numbers(layout)
    if table is None:
        layout, repaired, restarts = _without_faults(layout, settings, checks, notes)
        table = _numbers(layout)
        if table is None:
            raise refusal(layout, find_faults(layout), "its rows cannot be told apart")
    numbers = {i: table.column(str(i)).to_numpy() for i in {index for _, index in layout.columns}}
    clock = next(((c, i) for c, i in layout.columns if c.channel == "time"), None)
    exact = None
    if clock is not None and settings.tick_ns is None:
        largest = float(np.abs(numbers[clock[1]]).max()) * seconds_per_unit(clock[0].unit)
        if largest >= EXACT_BELOW_S:
            arguments = ((layout.delimiter, layout.decimal), len(layout.names), clock[1], clock[0].unit)
            exact = exact_times(layout.body, *arguments) if largest < LONGEST_S else None
    return Rows(
        text.path, text.sha256, layout.names, layout.columns, numbers, exact, layout.line_of, tuple(notes), repaired,
        restarts,
    )  # fmt: skip


def _numbers(layout: Layout) -> Any:  # noqa: ANN401  (pyarrow has no types)
    """Return the wanted columns as doubles, None where a line is not as it should be."""
    wanted = sorted({index for _, index in layout.columns})
    if b"\0" in layout.body or quoted_numbers(layout, layout.body):
        return None
    try:
        types = dict.fromkeys(wanted, pa.float64())
        table = parse(layout.body, layout.delimiter, layout.decimal, len(layout.names), types)
    except pa.ArrowInvalid:
        return None
    return table if table.num_rows == layout.body.count(b"\n") and all_finite(table) else None


def _without_faults(
    layout: Layout, settings: CsvFormat, checks: Checks, notes: list[Note]
) -> tuple[Layout, int, tuple[int, ...]]:
    """Return the layout without its bad lines, how many rows were given up, and where the log was restarted."""
    faults = with_parted_rows(find_faults(layout), layout)
    rows = layout.body.count(b"\n")
    cut = {f.row for f in faults if f.short and f.row == rows - 1}
    tail = [f for f in faults if f.row in cut or f.parted_before in cut]
    headers = [f for f in faults if f.kind == "restarted"]
    others = [f for f in faults if f not in tail and f not in headers]
    allowed = {"bad_rows": settings.bad_rows == DROP, "nan": settings.nan == GAP}
    refused = [f for f in others if not allowed[KIND_OF_SETTING.get(f.kind, "bad_rows")]]
    if refused or (headers and settings.session is None) or not faults:
        raise refusal(layout, refused + headers if refused or headers else faults, "its rows cannot be told apart")
    if len(others) > checks.repaired_rows * rows:
        raise over_budget(refusal(layout, others, ""), len(others), rows, checks)
    for fault in tail:
        detail = f"the last line is cut, so it was dropped: {fault.text[:200]!r}"
        notes.append(Note("N-TAIL", 1, fault.line, fault.line, detail))
    for code, kinds, what in (
        ("N-BADROW", ("bad_row", "nul", "not_a_number", "decimal_comma"), "rows that cannot be read were dropped"),
        ("N-NAN", ("not_finite",), "rows without a finite number were dropped"),
    ):
        dropped = [f for f in others if f.kind in kinds]
        if dropped:
            rows_in_a_run = _longest_run([f.row for f in dropped])
            detail = f"{what}, each a gap; the longest run is {rows_in_a_run} long; the first: {dropped[0].message}"
            notes.append(Note(code, len(dropped), dropped[0].line, dropped[-1].line, detail))
    starts = tuple(h.row - sum(f.row < h.row for f in faults) for h in headers)
    return _without_lines(layout, faults, rows), len(others), starts


def _longest_run(rows: list[int]) -> int:
    """Return how many of some rows, in order, follow each other directly at most."""
    ends = np.flatnonzero(np.diff([*rows, rows[-1] + 2]) > 1)
    return int(np.diff(ends, prepend=-1).max())


def over_budget(error: IngestError, touched: int, rows: int, checks: Checks) -> IngestError:
    """Return a refusal for more repairs than the profile allows."""
    hint = (
        f"{touched} of {rows} rows would have to be repaired, more than the share of {checks.repaired_rows:g} that "
        "ingest.checks.repaired_rows allows"
    )
    return IngestError(error.fact, error.file, fault=error.code, hint=hint)


def _without_lines(layout: Layout, faults: list[Fault], rows: int) -> Layout:
    keep = np.ones(rows, bool)
    keep[[f.row for f in faults]] = False
    index = np.flatnonzero(keep)
    parts = layout.body.split(b"\n")
    body = b"".join(parts[i] + b"\n" for i in index)
    if not body:
        raise refusal(layout, faults, "no row can be read")
    return replace(layout, body=body, line_of=layout.line_of.select(index))
