"""Read the printed figures and the results of a run; compare the tables of thesis and paper with them, value by value.

All tables are one DataFrame with a row for each cell: ``table`` (as printed; ``paper 1`` and so on for the paper),
``title``, ``block`` (how ours was computed), ``row``, ``column``, ``printed``, ``ours`` (NaN where a unit failed),
``digits`` (printed decimals), ``difference``, and ``large``: whether the difference exceeds both ``LARGE`` of the
printed value and its rounding.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.integrate import cumulative_trapezoid

from pipeline.app.steps.unit_files import recordings_of
from pipeline.core.files import JSON
from pipeline.core.pack import Pack, read_published
from pipeline.core.records import Noise, Recording, Values
from pipeline.evaluation.held_out.samples import samples_of_motion
from pipeline.physics.signal.rests import find_rests
from pipeline.simulation.description import shipped_settings

Cells = Iterator[tuple[Any, ...]]

AXES = "xyz"
DEVICES = {"mpu6050-1": "MPU6050 (1)", "mpu6050-2": "MPU6050 (2)", "stim300": "STIM300"}
TABLE_WORDS = {"acutronic": "precise table", "mark2": "home-made table"}
STOPS = ("stop-1s", "stop-5s", "stop-10s")
CONTINUOUS = tuple(f"continuous-{rate}dps" for rate in ("0.5", "1", "5", "10", "30"))
RATES = tuple(f"gyro-{rate}dps" for rate in (20, 60, 80, 100, 200))
SILENT = Noise(np.zeros(3), np.zeros(3), 100.0, "none")  # mean errors do not depend on the noise
TABLE_COLUMNS = ("table", "title", "block", "row", "column", "printed", "ours", "digits")
LARGE = 0.25  # of the printed value: the page explains a larger difference
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
STAGE_OF_LETTER = {"O": "orthogonality", "M": "misalignment", "b": "bias", "S": "scale_factor"}
CHOLESKY_AS_PRINTED = "as printed: Cholesky and LU's forward matrix applied as if it were the correction"
# The comparison of methods: its two methods, for the thesis as printed and with errata corrected.
COMPARED_FIGURES = {
    "accelerometer": {
        "by the staged method as printed": ("printed", "least-squares"),
        "by the staged method with its errata corrected": ("staged", "least-squares"),
    },
    "gyroscope": {
        CHOLESKY_AS_PRINTED: ("staged", "cholesky-printed"),
        "inverted: Cholesky and LU's matrix as it is meant": ("staged", "cholesky"),
    },
}
CHANGES = ("before", "after", "change_percent")  # columns of printed errors
SHORT = {"staged": "staged", "nonlinear_least_squares": "least squares", "cholesky_lu": "Cholesky and LU"}
PAPER = "gy-521"
SEGMENT_DEG = 45.0  # the paper turns in steps of 45 deg


# By sensor: file of the printed parameters, our methods, and rows. A row: label, column of the file, stage, and the
# parameters whose mean is compared (both sides of a factor).
PARAMETER_TABLES: dict[str, tuple[str, dict[str, str], list[tuple[str, str, str, list[str]]]]] = {
    "accelerometer": ("accel_parameters", ACCELEROMETER, [
        (f"{q}{a}{', g' if q == 'b' else ''}", f"{q}_{a}{'_g' if q == 'b' else ''}", stage,
         [f"b_{a}"] if q == "b" else [f"{q}_P_{a}", f"{q}_N_{a}"])
        for q, stage in STAGE_OF_LETTER.items() for a in AXES
    ]),
    "gyroscope": ("gyro_parameters", GYROSCOPE, [
        *((f"b{a}, deg/s", f"b_{a}_dps", "bias", [f"b_{a}"]) for a in AXES),
        *((f"M{i}{j}", f"M{i}{j}", "orthogonality_and_misalignment", [f"M_{i}{j}"]) for i in "123" for j in "123"),
        *((f"S{a}", f"S_{a}", "scale_factor", [f"S_{a}"]) for a in AXES),
    ]),
}  # fmt: skip


def read_printed(folder: Path, name: str) -> pd.DataFrame:
    """Read a file of printed figures, with a row for each line of a printed table.

    Devices are named as in the campaign; ``procedure`` and ``set`` name the recordings of a row.
    """
    rows = pd.read_csv(folder / f"{name}.csv", dtype={"table": str, "error_table": str})
    if "device" in rows:
        rows["device"] = rows["device"].str.lower()
    if "rate_table" in rows:
        kinds = rows["procedure"] if "procedure" in rows else ["gyro_rate"] * len(rows)
        rows["procedure"] = [
            f"stop-{row['dwell_s']:g}s" if kind == "stop" else f"{kind.removesuffix('_rate')}-{row['speed_dps']:g}dps"
            for kind, row in zip(kinds, rows.to_dict("records"), strict=True)
        ]
        table = rows["rate_table"].map({"acutronic": "-", "mark2": "-mark2-"})
        rows["set"] = rows["device"] + table + rows["procedure"]
    return rows


def in_words(procedure: str) -> str:
    """Return a procedure in words."""
    kind, _, value = procedure.partition("-")
    return f"{kind} {value.removesuffix('dps')} deg/s" if value.endswith("dps") else f"{kind} {value[:-1]} s"


@dataclass(frozen=True)
class Results:
    """The results of one run, in ``folder``. A unit is named ``<set of recordings>-<method>``."""

    folder: Path

    def fit(self, unit: str, sensor: str) -> JSON | None:
        """Return a sensor's part of a unit's calibration; None where the unit failed."""
        part: JSON | None = _read(self.folder / "calibrations" / f"{unit}.json").get(sensor)
        return part

    def calibration(self, unit: str, sensor: str) -> tuple[Values, Values]:
        """Return bias and matrix of a sensor, NaN where the unit failed."""
        fit = self.fit(unit, sensor) or {"bias": [np.nan] * 3, "matrix": [[np.nan] * 3] * 3}
        return np.array(fit["bias"]), np.array(fit["matrix"])

    def parameter(self, unit: str, sensor: str, stage: str, name: str) -> float:
        """Return a parameter that a stage estimated, or NaN."""
        for found in (self.fit(unit, sensor) or {}).get("stages", ()):
            if found["name"] == stage and name in found["parameters"]:
                return float(found["parameters"][name]["value"])
        return np.nan

    def correction(self, unit: str, sensor: str) -> JSON | None:
        """Return the correction of readings after the last stage of a fit."""
        stages = (self.fit(unit, sensor) or {}).get("stages", ())
        return stages[-1]["correction"] if stages else None

    def errors(self, unit: str, sensor: str, metric: str = "mean_abs_error") -> tuple[float, float, float]:
        """Return a held-out error before calibration, after the last stage, and the change in percent, or NaN."""
        steps = (_read(self.folder / "validations" / f"{unit}.json").get(sensor) or {}).get("steps", ())
        before, after = (
            float(np.array([np.nan, *(s[metric] for s in steps if s["name"].startswith(kind))], float)[-1])
            for kind in ("raw", "stage:")
        )
        return before, after, 100.0 * (before - after) / before

    def recordings(self, unit: str, role: str) -> list[Recording]:
        """Return the filtered recordings of a role; none where the unit failed."""
        for file in self.folder.glob("batches/*/filter.zip"):
            packs = {stage: Pack(file.with_name(f"{stage}.zip")) for stage in ("ingest", "filter")}
            if f"{unit}.noise.json" in packs["filter"]:
                return [r for r in recordings_of(packs, unit) if r.role == role]
        return []

    def with_printed(self, name: str, sensor: str, parameters: Mapping[str, float]) -> float:
        """Return the mean |e| on the held-out motion of a set of recordings with printed parameters, or NaN.

        ``S (O M a - b)`` for the accelerometer (eq. 3.2), ``(g - b) M S`` for the gyroscope (3.45).
        """
        held_out = self.recordings(f"{name}-printed", "validation")
        if not held_out:
            return np.nan
        samples = samples_of_motion(sensor, held_out[0], SILENT, shipped_settings().table)
        assert samples is not None  # noqa: S101  (the table logs its rate)
        if sensor == "accelerometer":
            O, M, S, b = (values(parameters, pattern) for pattern in ("O_{}", "M_{}", "S_{}", "b_{}_g"))
            corrected = S * (O * M * samples.reading - b)
        else:
            matrix, S, b = matrix_of(parameters, "M"), values(parameters, "S_{}"), values(parameters, "b_{}_dps")
            corrected = (samples.reading - b) @ matrix * S
        return float(np.mean(np.abs(np.linalg.norm(corrected, axis=1) - samples.magnitude)))


def values(row: Mapping[str, float], pattern: str) -> Values:
    """Return the printed values of x, y and z from the columns ``pattern``: (3,) array."""
    return np.array([row[pattern.format(axis)] for axis in AXES])


def matrix_of(row: Mapping[str, float], letter: str) -> Values:
    """Return a printed matrix from the columns ``<letter>11`` to ``<letter>33``: (3, 3) array."""
    return np.array([[row[f"{letter}{i}{j}"] for j in (1, 2, 3)] for i in (1, 2, 3)])


@cache
def _read(path: Path) -> JSON:
    try:
        found: JSON = json.loads(read_published(path))
    except FileNotFoundError:
        return {}
    return found


def all_tables(printed: Path, results: Results) -> pd.DataFrame:
    """Return the cells of tables 5.1 to 5.26, then of the paper's tables."""
    tables = (_parameter_tables, _error_tables, _method_tables)
    cells = sorted((c for t in tables for c in t(printed, results)), key=lambda c: int(c[0].partition(".")[2]))
    return with_differences(pd.DataFrame([*cells, *_paper_tables(printed, results)], columns=list(TABLE_COLUMNS)))


def with_differences(cells: pd.DataFrame) -> pd.DataFrame:
    """Return cells with ``difference`` and ``large``."""
    difference = cells["ours"] - cells["printed"]
    least = np.maximum(LARGE * cells["printed"].abs(), 1.0001 * 10.0 ** -cells["digits"])
    return cells.assign(difference=difference, large=difference.abs() > least)


def _cells(
    place: tuple[str, str, str, str],
    columns: Iterable[str],
    printed: Iterable[float],
    ours: Iterable[float],
    digits: int = 3,
) -> Cells:
    """Yield the cells of one row; ``place``: table, title, block and row."""
    for column, printed_value, our_value in zip(columns, printed, ours, strict=True):
        yield (*place, column, float(printed_value), float(our_value), digits)


def _title(what: str, rows: pd.DataFrame) -> str:
    return f"{what} of {DEVICES[rows['device'].iloc[0]]}, {TABLE_WORDS[rows['rate_table'].iloc[0]]}"


def _parameter_tables(printed: Path, results: Results) -> Cells:
    """Yield the cells of tables 5.1 to 5.7 and 5.15 to 5.18."""
    for sensor, (file, methods, quantities) in PARAMETER_TABLES.items():
        for table, rows in read_printed(printed, file).groupby("table", sort=False):
            title, columns = _title(f"{sensor.capitalize()}: parameters", rows), rows["procedure"].map(in_words)
            for block, method in methods.items():
                for label, column, stage, names in quantities:
                    found = [[results.parameter(f"{s}-{method}", sensor, stage, n) for n in names] for s in rows["set"]]
                    yield from _cells((table, title, block, label), columns, rows[column], np.mean(found, axis=1))


def _error_tables(printed: Path, results: Results) -> Cells:
    """Yield the cells of tables 5.8 to 5.14 and 5.19 to 5.22."""
    files = (read_printed(printed, name).to_dict("records") for name, *_ in PARAMETER_TABLES.values())
    parameters = {row["set"]: row for rows in files for row in rows}
    for table, rows in read_printed(printed, "errors").groupby("table", sort=False):
        sensor, unit = rows["sensor"].iloc[0], rows["unit"].iloc[0]
        title, by_metric = _title(f"{sensor.capitalize()}: held-out error", rows), dict(iter(rows.groupby("metric")))
        sets = by_metric["mean_abs_error"]["set"]
        columns = by_metric["mean_abs_error"]["procedure"].map(in_words)
        for block, method in PARAMETER_TABLES[sensor][1].items():
            for metric, label in METRICS.items():
                found = [results.errors(f"{s}-{method}", sensor, metric) for s in sets]
                names = (f"{label}, {unit}: before", f"{label}, {unit}: after", f"{label}: change, %")
                for row, column, ours in zip(names, CHANGES, np.transpose(found), strict=True):
                    yield from _cells((table, title, block, row), columns, by_metric[metric][column], ours)
        applied = [results.with_printed(s, sensor, parameters[s]) for s in sets]
        place = (table, title, APPLIED, f"mean |e|, {unit}: after")
        yield from _cells(place, columns, by_metric["mean_abs_error"]["after"], applied)


def _method_tables(printed: Path, results: Results) -> Cells:
    """Yield the cells of tables 5.23 to 5.26."""
    for table, rows in read_printed(printed, "method_comparison").groupby("table", sort=False):
        sensor, unit = rows["sensor"].iloc[0], rows["bias_unit"].iloc[0]
        columns = [f"{DEVICES[d]}, {SHORT[m]}" for d, m in zip(rows["device"], rows["method"], strict=True)]
        head = f"{sensor.capitalize()}: {{}} by two methods"
        procedure = "stop-1s" if sensor == "accelerometer" else "gyro-20dps"
        # the STIM300's errors are from continuous 0.5 deg/s (erratum 5)
        other = {"stim300": "continuous-0.5dps"} if sensor == "accelerometer" else {}
        for block, (staged, method) in COMPARED_FIGURES[sensor].items():
            units = [
                (d, staged if m == "staged" else method) for d, m in zip(rows["device"], rows["method"], strict=True)
            ]
            fits = [results.calibration(f"{device}-{procedure}-{m}", sensor) for device, m in units]
            # readings are row vectors in the thesis, whose matrix is the transpose of ours
            found = {
                f"R{i + 1}{j + 1}": (f"R{i + 1}{j + 1}", [matrix[j, i] for _, matrix in fits])
                for i in range(3)
                for j in range(3)
                if i == j or sensor == "gyroscope"
            }
            found |= {f"b{a}, {unit}": (f"b_{a}", [bias[k] for bias, _ in fits]) for k, a in enumerate(AXES)}
            for row, (column, ours) in found.items():
                yield from _cells((table, head.format("parameters"), block, row), columns, rows[column], ours)
            errors = [results.errors(f"{d}-{other.get(d, procedure)}-{m}", sensor) for d, m in units]
            names = (f"mean |e|, {unit}: before", f"mean |e|, {unit}: after", "mean |e|: change, %")
            printed_values = ("mean_error_before", "mean_error_after", "change_percent")
            for row, column, ours in zip(names, printed_values, np.transpose(errors), strict=True):
                place = (rows["error_table"].iloc[0], head.format("held-out error"), block, row)
                yield from _cells(place, columns, rows[column], ours)


def _paper_tables(printed: Path, results: Results) -> Cells:
    """Yield the cells of tables 1 to 4 of the conference paper."""
    by_table = dict(iter(read_printed(printed, "conference_paper").groupby("table")))
    positions = read_printed(printed, "conference_paper_six_positions")
    turns = "GY-521, gyroscope: error of the integrated angle, row i in the turn about axis i"
    for table, title, rows in (
        ("paper 1", "GY-521, 24 orientations: nonlinear least squares", _paper_1(by_table["1"], results)),
        ("paper 2", "GY-521, 24 orientations, judged in six positions", _paper_2(positions, results)),
        ("paper 3", "GY-521, gyroscope: Cholesky and LU", _paper_3(by_table["3"], results)),
        ("paper 4", turns, _paper_4(by_table["4"], results)),
    ):
        columns = AXES if table == "paper 4" else ["GY-521"]
        for row, printed_values, ours, digits in rows:
            yield from _cells((table, title, "", row), columns, np.ravel(printed_values), np.ravel(ours), digits)


def _paper_1(rows: pd.DataFrame, results: Results) -> Iterator[tuple[str, float, float, int]]:
    unit, method = f"{PAPER}-orientations", "nonlinear_least_squares"
    names = {
        "scale_factor_diagonal_S_a": [(f"S{a}", f"scale_factor_{a}", 1.0) for a in AXES],
        "non_orthogonality_alpha": [
            (f"α{p}, deg", f"misalignment_{p}", float(np.degrees(1.0))) for p in ("yx", "zx", "zy")
        ],
        "bias": [(f"b{a}, g", f"bias_{a}", 1.0) for a in AXES],
    }
    rmse = dict(zip(("before", "after"), results.errors(unit, "accelerometer", "rms_error"), strict=False))
    for row in rows.to_dict("records"):
        for axis, (label, name, factor) in zip(AXES, names.get(row["quantity"], ()), strict=False):
            yield label, row[axis], factor * results.parameter(unit, "accelerometer", method, name), 4
        if row["quantity"].startswith("rmse"):
            when = row["quantity"].removeprefix("rmse_")
            yield f"RMSE {when}, g", row["x"], rmse[when], 6


def _paper_2(positions: pd.DataFrame, results: Results) -> Iterator[tuple[str, float, float, int]]:
    """Yield the mean reading of the vertical axis, before and after calibration by the 24 orientations."""
    rests = [(r, rest) for r in results.recordings(f"{PAPER}-six-positions", "rests") for rest in find_rests(r)]
    means = [np.asarray(r.accelerometer)[rest.start : rest.stop].mean(axis=0) for r, rest in rests]
    mean_readings = np.array(means or [np.full(3, np.nan)])
    bias, matrix = results.calibration(f"{PAPER}-orientations", "accelerometer")
    for row in positions.to_dict("records"):
        ideal = values(row, "{}_ideal_g")
        reading = mean_readings[np.argmax(mean_readings @ ideal)]
        yield f"{row['axis']} up: before, g", row["mean_before_g"], reading @ np.abs(ideal), 3
        yield f"{row['axis']} up: after, g", row["mean_after_g"], (matrix @ (reading - bias)) @ np.abs(ideal), 3


def _paper_3(rows: pd.DataFrame, results: Results) -> Iterator[tuple[str, float, float, int]]:
    for row in rows.to_dict("records"):
        names = {
            "scale_factor_diagonal_S_g": [f"S_{a}" for a in AXES],
            "non_orthogonality_alpha_xy_xz_yz": ["T_yx", "T_zx", "T_zy"],
            "alignment_M_g": [f"M_{AXES[int(np.nan_to_num(row['row'], nan=1.0)) - 1]}{a}" for a in AXES],
        }[row["quantity"]]
        for axis, name in zip(AXES, names, strict=True):
            ours = results.parameter(f"{PAPER}-gyro-20dps", "gyroscope", "cholesky_lu", name)
            yield name.replace("_", ""), row[axis], ours, 4


def _paper_4(rows: pd.DataFrame, results: Results) -> Iterator[tuple[str, Values, Values, int]]:
    bias, matrix = results.calibration(f"{PAPER}-gyro-20dps", "gyroscope")
    turns = {r.axis: r for r in results.recordings(f"{PAPER}-gyro-20dps", "gyroscope")}
    for row in rows.to_dict("records"):
        about, when = AXES[int(row["row"]) - 1], row["quantity"].rpartition("_")[2]
        used = matrix if when == "after" else np.eye(3)
        ours = _angle_errors(turns[about], bias, used) if about in turns else np.full(3, np.nan)
        yield f"about {about}: {when}, deg", values(row, "{}"), ours, 4


def _angle_errors(recording: Recording, bias: Values, matrix: Values) -> Values:
    """Return the rms error of the angle integrated over each 45 deg of a turn: (3,) array, deg."""
    error = (np.asarray(recording.gyroscope) - bias) @ matrix.T
    error[:, AXES.index(str(recording.axis))] -= np.asarray(recording.table_rate)
    angle = cumulative_trapezoid(error, recording.time, axis=0, initial=0)
    turned = np.asarray(recording.table_angle)
    edges = np.arange(turned[0], turned[-1] + 1e-6, SEGMENT_DEG)
    samples = np.searchsorted(turned, np.maximum(edges, turned[0] + 1e-9))
    samples[0] = np.flatnonzero(turned > turned[0] + 1e-9)[0] - 1
    return np.asarray(np.sqrt(np.mean(np.diff(angle[np.minimum(samples, len(turned) - 1)], axis=0) ** 2, axis=0)))
