"""The tables of the thesis and of the conference paper: each printed value with the campaign's.

All tables are one DataFrame with a row a cell: ``table`` (as printed; of the paper ``paper 1`` and so on), ``title``,
``block`` (how ours was found), ``row``, ``column``, ``printed``, ``ours`` (NaN where a unit failed), ``digits``
(decimals that were printed), ``difference``, and whether it is ``large``: beyond ``LARGE`` of the printed value, and
beyond its rounding.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from scipy.integrate import cumulative_trapezoid

from pipeline.signal.rests import find_rests
from pipeline.thesis.results import AXES, DEVICES, JSON, TABLES, Results, in_words, read_printed, values

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

    from pipeline.records import Recording, Values

    Cells = Iterator[JSON]

LARGE = 0.25  # of the printed value, from which the page explains a difference
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
STAGES = {"O": "orthogonality", "M": "misalignment", "b": "bias", "S": "scale_factor"}
# Of the comparison of methods: what its two methods are, by reading of the thesis.
READINGS = {
    "accelerometer": {
        "by the staged method as printed": {"staged": "printed", "nonlinear_least_squares": "least-squares"},
        "by the staged method with its errata corrected": {
            "staged": "staged",
            "nonlinear_least_squares": "least-squares",
        },
    },
    "gyroscope": {
        "as printed: Cholesky and LU's forward matrix applied as if it were the correction": {
            "staged": "staged",
            "cholesky_lu": "cholesky-printed",
        },
        "inverted: Cholesky and LU's matrix as it is meant": {"staged": "staged", "cholesky_lu": "cholesky"},
    },
}
SHORT = {"staged": "staged", "nonlinear_least_squares": "least squares", "cholesky_lu": "Cholesky and LU"}
PAPER = "gy-521"
SEGMENT_DEG = 45.0  # the paper turns in steps of 45 deg


def all_tables(printed: Path, results: Results) -> pd.DataFrame:
    """Return the cells of tables 5.1 to 5.26, then of those of the paper."""
    cells = [
        *_parameter_tables(printed, results),
        *_error_tables(printed, results),
        *_method_tables(printed, results),
    ]
    cells.sort(key=lambda cell: int(cell["table"].partition(".")[2]))
    return with_differences(pd.DataFrame([*cells, *_paper_tables(printed, results)]).astype({"ours": float}))


def with_differences(cells: pd.DataFrame) -> pd.DataFrame:
    """Return cells with ``difference`` and ``large``."""
    difference = cells["ours"] - cells["printed"]
    least = np.maximum(LARGE * cells["printed"].abs(), 1.0001 * 10.0 ** -cells["digits"])
    return cells.assign(difference=difference, large=difference.abs() > least)


def _cells(
    place: tuple[str, str, str, str],
    columns: Iterable[str],
    printed: Iterable[float],
    ours: Iterable[float | None],
    digits: int = 3,
) -> Cells:
    """Yield the cells of one row; ``place``: table, title, block and row."""
    table, title, block, row = place
    for column, told, own in zip(columns, printed, ours, strict=True):
        yield {
            "table": table,
            "title": title,
            "block": block,
            "row": row,
            "column": column,
            "printed": float(told),
            "ours": own,
            "digits": digits,
        }


def change(before: float | None, after: float | None) -> float | None:
    """Return the change in percent, ``100 (before - after) / before``."""
    return None if not before or after is None else 100.0 * (before - after) / before


def _title(what: str, rows: pd.DataFrame) -> str:
    return f"{what} of {DEVICES[rows['device'].iloc[0]]}, {TABLES[rows['rate_table'].iloc[0]]}"


def _parameter_tables(printed: Path, results: Results) -> Cells:
    """Yield the cells of tables 5.1 to 5.7 and 5.15 to 5.18."""
    for sensor, name, methods, quantities in (
        ("accelerometer", "accel_parameters", ACCELEROMETER, _ACCELEROMETER_ROWS),
        ("gyroscope", "gyro_parameters", GYROSCOPE, _GYROSCOPE_ROWS),
    ):
        for table, rows in read_printed(printed, name).groupby("table", sort=False):
            title = _title(f"{sensor.capitalize()}: parameters", rows)
            columns = [in_words(p) for p in rows["procedure"]]
            for block, method in methods.items():
                for label, column, stage, names in quantities:
                    ours = [_mean_parameter(results, f"{s}-{method}", sensor, stage, names) for s in rows["set"]]
                    yield from _cells((table, title, block, label), columns, rows[column], ours)


# Label, column of the file, stage and names of the parameters whose mean is meant: of a factor, both sides.
_ACCELEROMETER_ROWS = [
    (f"{q}{a}{', g' if q == 'b' else ''}", f"{q}_{a}{'_g' if q == 'b' else ''}", stage,
     [f"b_{a}"] if q == "b" else [f"{q}_P_{a}", f"{q}_N_{a}"])
    for q, stage in STAGES.items()
    for a in AXES
]  # fmt: skip
_GYROSCOPE_ROWS = [
    *((f"b{a}, deg/s", f"b_{a}_dps", "bias", [f"b_{a}"]) for a in AXES),
    *((f"M{i}{j}", f"M{i}{j}", "orthogonality_and_misalignment", [f"M_{i}{j}"]) for i in (1, 2, 3) for j in (1, 2, 3)),
    *((f"S{a}", f"S_{a}", "scale_factor", [f"S_{a}"]) for a in AXES),
]


def _mean_parameter(results: Results, unit: str, sensor: str, stage: str, names: Sequence[str]) -> float | None:
    found = [results.parameter(unit, sensor, stage, name) for name in names]
    return None if None in found else sum(v for v in found if v is not None) / len(found)


def _error_tables(printed: Path, results: Results) -> Cells:
    """Yield the cells of tables 5.8 to 5.14 and 5.19 to 5.22."""
    parameters = {
        row["set"]: row
        for name in ("accel_parameters", "gyro_parameters")
        for row in read_printed(printed, name).to_dict("records")
    }
    for table, rows in read_printed(printed, "errors").groupby("table", sort=False):
        sensor, unit = rows["sensor"].iloc[0], rows["unit"].iloc[0]
        title = _title(f"{sensor.capitalize()}: held-out error", rows)
        by_metric = {metric: rows[rows["metric"] == metric] for metric in METRICS}
        sets = by_metric["mean_abs_error"]["set"]
        columns = [in_words(p) for p in by_metric["mean_abs_error"]["procedure"]]
        for block, method in (ACCELEROMETER if sensor == "accelerometer" else GYROSCOPE).items():
            for metric, label in METRICS.items():
                ours: dict[str, list[float | None]] = {
                    when: [results.step(f"{s}-{method}", sensor, step).get(metric) for s in sets]
                    for when, step in (("before", "raw"), ("after", "last"))
                }
                ours["change_percent"] = [change(*pair) for pair in zip(ours["before"], ours["after"], strict=True)]
                for column, found in ours.items():
                    row = f"{label}: change, %" if column == "change_percent" else f"{label}, {unit}: {column}"
                    yield from _cells((table, title, block, row), columns, by_metric[metric][column], found)
        applied = [results.with_printed(s, sensor, parameters[s]) for s in sets]
        place = (table, title, APPLIED, f"mean |e|, {unit}: after")
        yield from _cells(place, columns, by_metric["mean_abs_error"]["after"], applied)


def _method_tables(printed: Path, results: Results) -> Cells:
    """Yield the cells of tables 5.23 to 5.26."""
    for table, rows in read_printed(printed, "method_comparison").groupby("table", sort=False):
        sensor, unit = rows["sensor"].iloc[0], rows["bias_unit"].iloc[0]
        columns = [f"{DEVICES[d]}, {SHORT[m]}" for d, m in zip(rows["device"], rows["method"], strict=True)]
        by_parameters, by_errors = (
            f"{sensor.capitalize()}: {what} by two methods" for what in ("parameters", "held-out error")
        )
        for block, methods in READINGS[sensor].items():
            pairs = [(device, methods[m]) for device, m in zip(rows["device"], rows["method"], strict=True)]
            own = "stop-1s" if sensor == "accelerometer" else "gyro-20dps"
            fits = [results.fit(f"{device}-{own}-{method}", sensor) for device, method in pairs]
            for i, j in ((i, j) for i in range(3) for j in range(3) if i == j or sensor == "gyroscope"):
                # readings are row vectors in the thesis: its matrix is the transpose of ours
                ours = [None if fit is None else fit["matrix"][j][i] for fit in fits]
                row = f"R{i + 1}{j + 1}"
                yield from _cells((table, by_parameters, block, row), columns, rows[row], ours)
            for k, axis in enumerate(AXES):
                ours = [None if fit is None else fit["bias"][k] for fit in fits]
                yield from _cells((table, by_parameters, block, f"b{axis}, {unit}"), columns, rows[f"b_{axis}"], ours)
            # the STIM300's errors are those of continuous 0.5 deg/s (erratum 5)
            stim = "continuous-0.5dps" if sensor == "accelerometer" else own
            units = [f"{device}-{stim if device == 'stim300' else own}-{method}" for device, method in pairs]
            before = [results.error(u, sensor, "raw") for u in units]
            after = [results.error(u, sensor) for u in units]
            for row, column, ours in (
                (f"mean |e|, {unit}: before", "mean_error_before", before),
                (f"mean |e|, {unit}: after", "mean_error_after", after),
                ("mean |e|: change, %", "change_percent", [change(*p) for p in zip(before, after, strict=True)]),
            ):
                place = (rows["error_table"].iloc[0], by_errors, block, row)
                yield from _cells(place, columns, rows[column], ours)


def _paper_tables(printed: Path, results: Results) -> Cells:
    """Yield the cells of tables 1 to 4 of the conference paper."""
    made = "GY-521, 24 orientations"
    by_table = dict(iter(read_printed(printed, "conference_paper").groupby("table")))
    positions = read_printed(printed, "conference_paper_six_positions")
    for table, title, found in (
        ("paper 1", f"{made}: nonlinear least squares", _paper_1(by_table["1"], results)),
        ("paper 2", f"{made}, judged in six positions", _paper_2(positions, results)),
        ("paper 3", "GY-521, gyroscope: Cholesky and LU", _paper_3(by_table["3"], results)),
    ):
        for row, told, ours, digits in found:
            yield from _cells((table, title, "", row), ["GY-521"], [told], [ours], digits)
    title = "GY-521, gyroscope: error of the integrated angle, row i in the turn about axis i"
    for row, errors, own in _paper_4(by_table["4"], results):
        yield from _cells(("paper 4", title, "", row), AXES, errors, own, 4)


def _paper_1(rows: pd.DataFrame, results: Results) -> Iterator[tuple[str, float, float | None, int]]:
    unit, method = f"{PAPER}-orientations", "nonlinear_least_squares"
    names = {
        "scale_factor_diagonal_S_a": [(f"S{a}", f"scale_factor_{a}", 1.0) for a in AXES],
        "non_orthogonality_alpha": [
            (f"α{p}, deg", f"misalignment_{p}", float(np.degrees(1.0))) for p in ("yx", "zx", "zy")
        ],
        "bias": [(f"b{a}, g", f"bias_{a}", 1.0) for a in AXES],
    }
    for row in rows.to_dict("records"):
        for axis, (label, name, factor) in zip(AXES, names.get(row["quantity"], ()), strict=False):
            found = results.parameter(unit, "accelerometer", method, name)
            yield label, row[axis], None if found is None else factor * found, 4
        if row["quantity"].startswith("rmse"):
            when = row["quantity"].removeprefix("rmse_")
            step = results.step(unit, "accelerometer", "raw" if when == "before" else "last")
            yield f"RMSE {when}, g", row["x"], step.get("rms_error"), 6


def _paper_2(positions: pd.DataFrame, results: Results) -> Iterator[tuple[str, float, float | None, int]]:
    """Yield the mean reading of the axis that points up or down, before and after the 24 orientations' calibration."""
    means = _rest_means(results.recordings(f"{PAPER}-six-positions", "rests"))
    fit = results.fit(f"{PAPER}-orientations", "accelerometer")
    for row in positions.to_dict("records"):
        ideal = values(row, "{}_ideal_g")
        before = after = None
        if fit is not None and len(means):
            reading = means[np.argmax(means @ ideal)]
            before = float(reading @ np.abs(ideal))
            after = float((np.array(fit["matrix"]) @ (reading - fit["bias"])) @ np.abs(ideal))
        yield f"{row['axis']} up: before, g", row["mean_before_g"], before, 3
        yield f"{row['axis']} up: after, g", row["mean_after_g"], after, 3


def _rest_means(recordings: list[Recording]) -> Values:
    rests = [(r, rest) for r in recordings for rest in find_rests(r)]
    return np.array([np.asarray(r.accelerometer)[rest.start : rest.stop].mean(axis=0) for r, rest in rests])


def _paper_3(rows: pd.DataFrame, results: Results) -> Iterator[tuple[str, float, float | None, int]]:
    for row in rows.to_dict("records"):
        names = {
            "scale_factor_diagonal_S_g": [f"S_{a}" for a in AXES],
            "non_orthogonality_alpha_xy_xz_yz": ["T_yx", "T_zx", "T_zy"],
            "alignment_M_g": [f"M_{AXES[int(np.nan_to_num(row['row'], nan=1.0)) - 1]}{a}" for a in AXES],
        }[row["quantity"]]
        for axis, name in zip(AXES, names, strict=True):
            ours = results.parameter(f"{PAPER}-gyro-20dps", "gyroscope", "cholesky_lu", name)
            yield name.replace("_", ""), row[axis], ours, 4


def _paper_4(rows: pd.DataFrame, results: Results) -> Iterator[tuple[str, Values, Sequence[float | None]]]:
    fit = results.fit(f"{PAPER}-gyro-20dps", "gyroscope")
    turns = {r.axis: r for r in results.recordings(f"{PAPER}-gyro-20dps", "gyroscope")}
    for row in rows.to_dict("records"):
        about, when = AXES[int(row["row"]) - 1], row["quantity"].rpartition("_")[2]
        ours: list[float | None] = [None] * 3
        if fit is not None and about in turns:
            matrix = np.array(fit["matrix"]) if when == "after" else np.eye(3)
            ours = _angle_errors(turns[about], np.array(fit["bias"]), matrix).tolist()
        yield f"about {about}: {when}, deg", values(row, "{}"), ours


def _angle_errors(recording: Recording, bias: Values, matrix: Values) -> Values:
    """Return the rms error of the angle integrated over each 45 deg of a turn: (3,) array, deg."""
    error = (np.asarray(recording.gyroscope) - bias) @ matrix.T
    error[:, AXES.index(str(recording.axis))] -= np.asarray(recording.table_rate)
    angle = cumulative_trapezoid(error, recording.time, axis=0, initial=0)
    turned = np.asarray(recording.table_angle)
    edges = np.arange(turned[0], turned[-1] + 1e-6, SEGMENT_DEG)
    at = np.searchsorted(turned, np.maximum(edges, turned[0] + 1e-9))
    at[0] = np.flatnonzero(turned > turned[0] + 1e-9)[0] - 1
    return np.asarray(np.sqrt(np.mean(np.diff(angle[np.minimum(at, len(turned) - 1)], axis=0) ** 2, axis=0)))
