"""The printed tables of the thesis, each cell beside what the campaign found."""

from __future__ import annotations

import csv
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING

from pipeline.thesis.results import DEVICES, TABLES, in_words, procedure_of, set_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from pipeline.thesis.results import Results

Printed = list[dict[str, str]]
AXES = "xyz"
LARGE = 0.25  # of the printed value, from which a difference is explained
ACCELEROMETER = {
    "as printed: the largest and smallest samples": "printed",
    "errata corrected: fitted sinusoids": "staged",
}
GYROSCOPE = {"as printed": "printed", "errata corrected": "staged"}
METRICS = {
    "mean_abs_error": "mean |e|",
    "sum_abs_error": "sum |e|",
    "max_error": "largest e",
    "min_error": "smallest e",
}
APPLIED = "by the printed parameters, applied to our held-out motion"
STEPS = {"before": "raw", "after": "last"}
STAGES = {"O": "orthogonality", "M": "misalignment", "b": "bias", "S": "scale_factor"}


@dataclass(frozen=True)
class Cell:
    """A printed value and ours; ``digits`` are the decimals that were printed."""

    printed: float | None
    ours: float | None
    digits: int = 3

    @property
    def difference(self) -> float | None:
        """Ours less the printed value."""
        return None if self.printed is None or self.ours is None else self.ours - self.printed

    @property
    def large(self) -> bool:
        """Whether the difference is beyond ``LARGE`` of the printed value, and beyond its rounding."""
        if self.difference is None or self.printed is None:
            return False
        return abs(self.difference) > max(LARGE * abs(self.printed), 1.0001 * 10.0**-self.digits)


@dataclass(frozen=True)
class Row:
    """One quantity in every column of a table."""

    label: str
    cells: list[Cell]


@dataclass(frozen=True)
class Block:
    """The rows of one method."""

    title: str
    rows: list[Row]


@dataclass(frozen=True)
class Table:
    """A printed table.

    Attributes
    ----------
    number : str
        As printed; those of the paper ``paper 1`` and so on.
    title : str
    columns : list of str
    blocks : list of Block
    notes : list of str
        Keys of the explanations that its large differences have.
    """

    number: str
    title: str
    columns: list[str]
    blocks: list[Block]
    notes: list[str] = field(default_factory=list)

    @property
    def large(self) -> int:
        """Number of cells with a large difference."""
        return sum(cell.large for block in self.blocks for row in block.rows for cell in row.cells)


def read_printed(path: Path) -> dict[str, Printed]:
    """Return the rows of a file of printed figures by the table that they stand in."""
    tables: dict[str, Printed] = {}
    with path.open(encoding="utf-8", newline="") as stream:
        for row in csv.DictReader(stream):
            tables.setdefault(row["table"], []).append(row)
    return tables


def parameter_tables(printed: Path, results: Results) -> list[Table]:
    """Return tables 5.1 to 5.7 and 5.15 to 5.18."""
    tables = []
    for number, rows in read_printed(printed / "accel_parameters.csv").items():
        blocks = [
            Block(title, _accelerometer_rows(rows, partial(_accelerometer_value, results, method)))
            for title, method in ACCELEROMETER.items()
        ]
        tables.append(Table(number, _title("Accelerometer: parameters", rows), _columns(rows), blocks))
    for number, rows in read_printed(printed / "gyro_parameters.csv").items():
        blocks = [
            Block(title, _gyroscope_rows(rows, partial(_gyroscope_value, results, method)))
            for title, method in GYROSCOPE.items()
        ]
        tables.append(Table(number, _title("Gyroscope: parameters", rows), _columns(rows), blocks))
    return tables


def error_tables(printed: Path, results: Results) -> list[Table]:
    """Return tables 5.8 to 5.14 and 5.19 to 5.22."""
    tables = []
    parameters = {
        key_of_row(row): row
        for name in ("accel_parameters.csv", "gyro_parameters.csv")
        for rows in read_printed(printed / name).values()
        for row in rows
    }
    for number, rows in read_printed(printed / "errors.csv").items():
        sensor, unit = rows[0]["sensor"], rows[0]["unit"]
        by_procedure: dict[str, dict[str, dict[str, str]]] = {}
        for row in rows:
            by_procedure.setdefault(procedure_of(row), {})[row["metric"]] = row
        blocks = []
        for title, method in (ACCELEROMETER if sensor == "accelerometer" else GYROSCOPE).items():
            units = [f"{_set(rows[0], procedure)}-{method}" for procedure in by_procedure]
            blocks.append(Block(title, _error_rows(list(by_procedure.values()), units, sensor, unit, results)))
        by_metric = [row["mean_abs_error"] for row in by_procedure.values()]
        applied = [results.with_printed(_set(r, procedure_of(r)), sensor, parameters[key_of_row(r)]) for r in by_metric]
        blocks.append(Block(APPLIED, [_applied_row(by_metric, applied, unit)]))
        columns = [in_words(p) for p in by_procedure]
        tables.append(Table(number, _title(f"{sensor.capitalize()}: held-out error", rows), columns, blocks))
    return tables


def key_of_row(row: Mapping[str, str]) -> tuple[str, str, str]:
    """Return device, table and procedure of a printed row."""
    return row["device"], row["rate_table"], procedure_of(row)


def _applied_row(rows: Sequence[dict[str, str]], ours: Sequence[float | None], unit: str) -> Row:
    cells = [Cell(float(row["after"]), value) for row, value in zip(rows, ours, strict=True)]
    return Row(f"mean |e|, {unit}: after", cells)


def change(before: float | None, after: float | None) -> float | None:
    """Return the change in percent, ``100 (before - after) / before``."""
    return None if not before or after is None else 100.0 * (before - after) / before


def _title(what: str, rows: Printed) -> str:
    return f"{what} of {DEVICES[rows[0]['device'].lower()]}, {TABLES[rows[0]['rate_table']]}"


def _columns(rows: Printed) -> list[str]:
    return [in_words(procedure_of(row)) for row in rows]


def _set(row: Mapping[str, str], procedure: str) -> str:
    return set_of(row["device"], row["rate_table"], procedure)


def _accelerometer_rows(rows: Printed, ours: Callable[[dict[str, str], str, str], float | None]) -> list[Row]:
    out = []
    for quantity in STAGES:
        unit = "_g" if quantity == "b" else ""
        for axis in AXES:
            cells = [Cell(float(r[f"{quantity}_{axis}{unit}"]), ours(r, quantity, axis)) for r in rows]
            out.append(Row(f"{quantity}{axis}{', g' if unit else ''}", cells))
    return out


def _accelerometer_value(results: Results, method: str, row: dict[str, str], quantity: str, axis: str) -> float | None:
    """Return what a stage found; of a factor that differs between the sides, the mean of both."""
    unit = f"{_set(row, procedure_of(row))}-{method}"
    names = [f"b_{axis}"] if quantity == "b" else [f"{quantity}_{side}_{axis}" for side in "PN"]
    values = [results.parameter(unit, "accelerometer", STAGES[quantity], name) for name in names]
    return sum(v for v in values if v is not None) / len(values) if None not in values else None


def _gyroscope_rows(rows: Printed, ours: Callable[[dict[str, str], str, str], float | None]) -> list[Row]:
    names = [("bias", f"b_{a}", f"b_{a}_dps", f"b{a}, deg/s") for a in AXES]
    names += [
        ("orthogonality_and_misalignment", f"M_{i}{j}", f"M{i}{j}", f"M{i}{j}")
        for i in range(1, 4)
        for j in range(1, 4)
    ]
    names += [("scale_factor", f"S_{a}", f"S_{a}", f"S{a}") for a in AXES]
    return [
        Row(label, [Cell(float(r[column]), ours(r, stage, name)) for r in rows]) for stage, name, column, label in names
    ]


def _gyroscope_value(results: Results, method: str, row: dict[str, str], stage: str, name: str) -> float | None:
    return results.parameter(f"{_set(row, procedure_of(row))}-{method}", "gyroscope", stage, name)


def _error_rows(
    columns: Sequence[dict[str, dict[str, str]]], units: Sequence[str], sensor: str, unit: str, results: Results
) -> list[Row]:
    out = []
    for metric, label in METRICS.items():
        found = [[results.step(u, sensor, step).get(metric) for step in STEPS.values()] for u in units]
        for k, when in enumerate(STEPS):
            cells = [Cell(float(c[metric][when]), ours[k]) for c, ours in zip(columns, found, strict=True)]
            out.append(Row(f"{label}, {unit}: {when}", cells))
        changes = [
            Cell(float(c[metric]["change_percent"]), change(*ours)) for c, ours in zip(columns, found, strict=True)
        ]
        out.append(Row(f"{label}: change, %", changes))
    return out
