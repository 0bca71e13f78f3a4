"""The comparison of methods (tables 5.23 to 5.26), and the tables of the conference paper, beside ours."""

from __future__ import annotations

import csv
from typing import TYPE_CHECKING

import numpy as np

from pipeline.signal.rests import find_rests
from pipeline.thesis.results import DEVICES
from pipeline.thesis.tables import AXES, Block, Cell, Row, Table, change, read_printed

if TYPE_CHECKING:
    from pathlib import Path

    from pipeline.records import Recording
    from pipeline.thesis.results import Results

PAPER = "gy-521"
SEGMENT_DEG = 45.0  # the paper turns in steps of 45 deg
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


def method_tables(printed: Path, results: Results) -> list[Table]:
    """Return tables 5.23 to 5.26."""
    out = []
    for number, rows in read_printed(printed / "method_comparison.csv").items():
        sensor = rows[0]["sensor"]
        columns = [f"{DEVICES[r['device'].lower()]}, {SHORT[r['method']]}" for r in rows]
        parameters, errors = [], []
        for title, methods in READINGS[sensor].items():
            parameters.append(Block(title, _parameters(rows, methods, results)))
            errors.append(Block(title, _errors(rows, methods, results)))
        out.append(Table(number, f"{sensor.capitalize()}: parameters by two methods", columns, parameters))
        number_of_errors = rows[0]["error_table"]
        out.append(Table(number_of_errors, f"{sensor.capitalize()}: held-out error by two methods", columns, errors))
    return out


def _unit(row: dict[str, str], methods: dict[str, str], *, errors: bool) -> str:
    """Return the unit of a row; the STIM300's errors stand for continuous 0.5 deg/s (erratum 5)."""
    procedure = "stop-1s" if row["sensor"] == "accelerometer" else "gyro-20dps"
    if errors and row["sensor"] == "accelerometer" and row["device"] == "STIM300":
        procedure = "continuous-0.5dps"
    return f"{row['device'].lower()}-{procedure}-{methods[row['method']]}"


def _parameters(rows: list[dict[str, str]], methods: dict[str, str], results: Results) -> list[Row]:
    sensor = rows[0]["sensor"]
    fits = [results.fit(_unit(row, methods, errors=False), sensor) for row in rows]
    # readings are row vectors in the thesis: its matrix is the transpose of ours
    matrices = [None if fit is None else np.array(fit["matrix"]).T for fit in fits]
    places = [(i, j) for i in range(3) for j in range(3) if i == j or sensor == "gyroscope"]
    out = [
        Row(
            f"R{i + 1}{j + 1}",
            [
                Cell(float(r[f"R{i + 1}{j + 1}"]), None if m is None else float(m[i, j]))
                for r, m in zip(rows, matrices, strict=True)
            ],
        )
        for i, j in places
    ]
    for k, axis in enumerate(AXES):
        cells = [
            Cell(float(r[f"b_{axis}"]), None if fit is None else fit["bias"][k])
            for r, fit in zip(rows, fits, strict=True)
        ]
        out.append(Row(f"b{axis}, {rows[0]['bias_unit']}", cells))
    return out


def _errors(rows: list[dict[str, str]], methods: dict[str, str], results: Results) -> list[Row]:
    sensor, unit = rows[0]["sensor"], rows[0]["bias_unit"]
    units = [_unit(row, methods, errors=True) for row in rows]
    before = [results.error(u, sensor, "raw") for u in units]
    after = [results.error(u, sensor) for u in units]
    found = {
        (f"mean |e|, {unit}: before", "mean_error_before"): before,
        (f"mean |e|, {unit}: after", "mean_error_after"): after,
        ("mean |e|: change, %", "change_percent"): [change(b, a) for b, a in zip(before, after, strict=True)],
    }
    return [
        Row(label, [Cell(float(r[column]), v) for r, v in zip(rows, values, strict=True)])
        for (label, column), values in found.items()
    ]


def paper_tables(printed: Path, results: Results) -> list[Table]:
    """Return tables 1 to 4 of the conference paper."""
    rows = read_printed(printed / "conference_paper.csv")
    with (printed / "conference_paper_six_positions.csv").open(encoding="utf-8", newline="") as stream:
        positions = list(csv.DictReader(stream))
    made = "GY-521, 24 orientations"
    return [
        Table("paper 1", f"{made}: nonlinear least squares", ["GY-521"], [Block("", _paper_1(rows["1"], results))]),
        Table("paper 2", f"{made}, judged in six positions", ["GY-521"], [Block("", _paper_2(positions, results))]),
        Table("paper 3", "GY-521, gyroscope: Cholesky and LU", ["GY-521"], [Block("", _paper_3(rows["3"], results))]),
        Table(
            "paper 4",
            "GY-521, gyroscope: error of the integrated angle, row i in the turn about axis i",
            list(AXES),
            [Block("", _paper_4(rows["4"], results))],
        ),
    ]


def _paper_1(rows: list[dict[str, str]], results: Results) -> list[Row]:
    unit = f"{PAPER}-orientations"

    def found(name: str, factor: float = 1.0) -> float | None:
        value = results.parameter(unit, "accelerometer", "nonlinear_least_squares", name)
        return None if value is None else factor * value

    degree = float(np.degrees(1.0))
    names = {
        "scale_factor_diagonal_S_a": [(f"S{a}", found(f"scale_factor_{a}")) for a in AXES],
        "non_orthogonality_alpha": [(f"α{p}, deg", found(f"misalignment_{p}", degree)) for p in ("yx", "zx", "zy")],
        "bias": [(f"b{a}, g", found(f"bias_{a}")) for a in AXES],
        "rmse_before": [("RMSE before, g", results.step(unit, "accelerometer", "raw").get("rms_error"))],
        "rmse_after": [("RMSE after, g", results.step(unit, "accelerometer", "last").get("rms_error"))],
    }
    return [
        Row(label, [Cell(float(row[axis]), value, 6 if "rmse" in row["quantity"] else 4)])
        for row in rows
        for axis, (label, value) in zip(AXES, names[row["quantity"]], strict=False)
    ]


def _paper_2(positions: list[dict[str, str]], results: Results) -> list[Row]:
    """Return the mean reading of the axis that points up or down, before and after the 24 orientations' calibration."""
    means = _rest_means(results.recordings(f"{PAPER}-six-positions"))
    fit = results.fit(f"{PAPER}-orientations", "accelerometer")
    out = []
    for row in positions:
        ideal = np.array([float(row[f"{a}_ideal_g"]) for a in AXES])
        before = after = None
        if fit is not None and len(means):
            reading = means[np.argmax(means @ ideal)]
            before = float(reading @ np.abs(ideal))
            after = float((np.array(fit["matrix"]) @ (reading - fit["bias"])) @ np.abs(ideal))
        out.append(Row(f"{row['axis']} up: before, g", [Cell(float(row["mean_before_g"]), before)]))
        out.append(Row(f"{row['axis']} up: after, g", [Cell(float(row["mean_after_g"]), after)]))
    return out


def _rest_means(recordings: list[Recording]) -> np.ndarray:
    found = [
        np.asarray(r.accelerometer)[rest.start : rest.stop].mean(axis=0)
        for r in recordings
        for rest in find_rests(r)
        if r.role == "rests"
    ]
    return np.array(found)


def _paper_3(rows: list[dict[str, str]], results: Results) -> list[Row]:
    unit = f"{PAPER}-gyro-20dps"

    def found(name: str) -> float | None:
        return results.parameter(unit, "gyroscope", "cholesky_lu", name)

    out = []
    for row in rows:
        names = {
            "scale_factor_diagonal_S_g": [f"S_{a}" for a in AXES],
            "non_orthogonality_alpha_xy_xz_yz": ["T_yx", "T_zx", "T_zy"],
            "alignment_M_g": [f"M_{AXES[int(row['row'] or 1) - 1]}{a}" for a in AXES],
        }[row["quantity"]]
        out += [
            Row(name.replace("_", ""), [Cell(float(row[a]), found(name), 4)])
            for a, name in zip(AXES, names, strict=True)
        ]
    return out


def _paper_4(rows: list[dict[str, str]], results: Results) -> list[Row]:
    fit = results.fit(f"{PAPER}-gyro-20dps", "gyroscope")
    turns = {r.axis: r for r in results.recordings(f"{PAPER}-gyro-20dps") if r.role == "gyroscope"}
    out = []
    for row in rows:
        about = AXES[int(row["row"]) - 1]
        ours: list[float | None] = [None] * 3
        if fit is not None and about in turns:
            matrix = np.array(fit["matrix"]) if row["quantity"].endswith("after") else np.eye(3)
            ours = _angle_errors(turns[about], np.array(fit["bias"]), matrix).tolist()
        when = row["quantity"].rpartition("_")[2]
        cells = [Cell(float(row[a]), value, 4) for a, value in zip(AXES, ours, strict=True)]
        out.append(Row(f"about {about}: {when}, deg", cells))
    return out


def _angle_errors(recording: Recording, bias: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Return the rms error of the angle integrated over each 45 deg of a turn: (3,) array, deg."""
    rate = (np.asarray(recording.gyroscope) - bias) @ matrix.T
    truth = np.zeros_like(rate)
    truth[:, AXES.index(str(recording.axis))] = recording.table_rate
    error = rate - truth
    step = np.diff(recording.time)[:, None]
    angle = np.concatenate([np.zeros((1, 3)), np.cumsum(0.5 * step * (error[1:] + error[:-1]), axis=0)])
    turned = np.asarray(recording.table_angle)
    edges = np.arange(turned[0], turned[-1] + 1e-6, SEGMENT_DEG)
    at = np.searchsorted(turned, np.maximum(edges, turned[0] + 1e-9))
    at[0] = np.flatnonzero(turned > turned[0] + 1e-9)[0] - 1
    return np.asarray(np.sqrt(np.mean(np.diff(angle[np.minimum(at, len(turned) - 1)], axis=0) ** 2, axis=0)))
