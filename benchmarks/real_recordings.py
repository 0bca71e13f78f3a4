"""Calibrate public recordings and state the errors on what no fit has seen.

    python benchmarks/real_recordings.py [--xsens FOLDER] [--sets FOLDER] [--figures FILE]

Those of data/published; with --xsens, ``accelerometer.txt`` and ``gyroscope.txt`` of Tedaldi, Pretto & Menegatti (ICRA
2014); with --sets, those of ``benchmarks/sets`` (FOLDER/UNIT: a clone of the repository in ``sources.yaml``). Held-out
error before and after calibration, noise floor, and the 99 % interval in which the error is expected; angle between
predicted and measured gravity after held-out moves; error of held-out turns. Of a set also, on the same samples
(``method=given``), what its authors publish for the whole recording, and own least squares:

    means, slow   b and lower triangular M with the least sum of rho((|M (a - b)| - 1 g) / 3 mg), rho: soft L1
    soak          a cubic over temperature for each axis; the accelerometer reads 1 g at 25 degC
    turns         M (integral of w - b during turn i) = 720 deg e_i, b: mean of the rest
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import yaml
from scipy.optimize import least_squares

import imu_logs
from imu_research.figures import MeasuredFigure, write_figures
from pipeline import calibrate_unit

if TYPE_CHECKING:
    from pipeline.app.one_unit import UnitResult

ROOT = Path(__file__).resolve().parents[1]
SETS = ROOT / "benchmarks" / "sets"
GRAVITY_G = 9.81744 / 9.80665  # of the place of the recording, as its authors state
EFFECT = "effects.gyroscope=[g_sensitivity]"  # that the diagnosis names
XSENS = """\
unit,sensor,table,procedure,method,ingest,overrides
xsens,generic,hand,multi_position,rests_and_moves,xsens_mti_multi_position,{}
"""
SENSORS = {"accelerometer": (1000.0, "mg"), "gyroscope": (1.0, "deg/s")}
OUTLIER_G = 3e-3  # beyond which a reading counts linearly
TURNED_DEG, RATE_HZ, AXIS_SIGNS = 720.0, 99.4, np.array([-1.0, 1.0, 1.0])  # as in the sheet, profile and units.csv
HELD_OUT = {"x_up": 0, "x_before": 0, "y_before": 1, "z_before": 2}  # turns and their axes
Entry = dict[str, Any]  # of a sensor in calibrations/<unit>.json


def ellipsoid(folder: Path) -> dict[str, Entry]:
    """Fit the magnitude of the readings."""
    a = np.loadtxt((folder / "fit.csv").read_text().replace(",", "\t").lstrip("axyz\t\n").splitlines())

    def residual(p: np.ndarray) -> np.ndarray:
        return np.linalg.norm((a - p[:3]) @ np.tril(p[3:].reshape(3, 3)).T, axis=1) - 1.0

    p = least_squares(residual, [*np.zeros(3), *np.eye(3).ravel()], loss="soft_l1", f_scale=OUTLIER_G).x
    return {"accelerometer": {"bias": p[:3].tolist(), "matrix": np.tril(p[3:].reshape(3, 3)).tolist()}}


def cubics(folder: Path) -> dict[str, Entry]:
    """Fit the readings of each axis over temperature."""
    rows = np.loadtxt(folder / "fit.csv", delimiter="\t", skiprows=1)
    fitted = np.polynomial.polynomial.polyfit(rows[:, 8] - 25.0, rows[:, 1:7] / np.repeat([1.0, 9.80665], 3), 3)
    found = {}
    for sensor, unit, values in (("gyroscope", "deg/s", fitted[:, :3]), ("accelerometer", "g", fitted[:, 3:])):
        units = ["", f"{unit}/degC", f"{unit}/degC^2", f"{unit}/degC^3"]
        powers = [(f"b_T{k}_{axis}", values[k, i], units[k]) for i, axis in enumerate("xyz") for k in (1, 2, 3)]
        named = {name: {"value": value, "unit": unit_of} for name, value, unit_of in powers}
        gravity = values[0] / np.linalg.norm(values[0]) if sensor == "accelerometer" else 0.0
        effect = {"name": "bias_temperature_cubic", "parameters": named}
        found[sensor] = {"bias": (values[0] - gravity).tolist(), "matrix": np.eye(3).tolist(), "effects": [effect]}
    return found


def rates(folder: Path, name: str) -> np.ndarray:
    """Return the rates of a turn or rest: (n, 3), deg/s."""
    log = imu_logs.read(folder / f"{name}.mat", SETS / "configs" / "ingest" / "turns.yaml").to_pandas()
    return AXIS_SIGNS * log.filter(like="gyro").to_numpy()


def turns(folder: Path) -> dict[str, Entry]:
    """Solve the three turns that are fitted."""
    bias = rates(folder, "still").mean(axis=0)
    turned = np.stack([(rates(folder, axis) - bias).sum(axis=0) / RATE_HZ for axis in "xyz"], axis=1)
    return {"gyroscope": {"bias": bias.tolist(), "matrix": (TURNED_DEG * np.linalg.inv(turned)).tolist()}}


def turn_error(folder: Path, entry: Entry) -> float:
    """Return the rms error of the angles of the held-out turns, deg."""
    bias, matrix = np.array(entry["bias"]), np.array(entry["matrix"])
    angles = np.array([((rates(folder, n) - bias) @ matrix[i]).sum() / RATE_HZ for n, i in HELD_OUT.items()])
    return float(np.sqrt(np.mean((angles - TURNED_DEG) ** 2)))


LEAST_SQUARES = {"means": ellipsoid, "slow": ellipsoid, "soak": cubics, "turns": turns}


def place(sets: Path, folder: Path, unit: str, source: dict[str, Any]) -> None:
    """Copy the files of a set into a campaign; raises ``SystemExit`` where one is absent."""
    for name, (path, digest) in source["files"].items():
        file, target = sets / unit / path, folder / "raw" / unit / name
        if not file.is_file() or hashlib.sha256(file.read_bytes()).hexdigest() != digest:
            clone = f"clone {source['repository']} at {source['commit']} into {sets / unit}"
            raise SystemExit(f"{file} is absent or another one: {clone}; SHA-256 {digest}")
        shutil.copy(file, target)
        if size := source.get("split"):
            lines, header = file.read_bytes().splitlines(keepends=True), source.get("header", 0)
            for k, part in enumerate((target, target.with_name("other.csv"))):
                rows = [line for i, line in enumerate(lines[header:]) if i // size % 2 == k]
                part.write_bytes(b"".join(lines[:header] + rows))


def figures_of_set(campaign: Path, unit: str, authors: dict[str, Entry] | None) -> list[MeasuredFigure]:
    """Return the figures of a set, with those of other methods on the same samples."""
    folder, began = campaign / "raw" / unit, time.process_time()
    result = calibrate_unit(campaign, unit)
    found, spent = figures_of(result, unit), {unit: time.process_time() - began}
    others = {"authors": authors} if authors else {}
    if unit in LEAST_SQUARES:
        began = time.process_time()
        others["least squares"] = LEAST_SQUARES[unit](folder)
        spent[f"{unit}, least squares"] = time.process_time() - began
    for name, entries in others.items():
        parts = {s: {**result.calibration[s], "effects": [], **entries[s]} if s in entries else None for s in SENSORS}
        file = campaign / "other.json"
        file.write_text(json.dumps({**result.calibration, **parts}), encoding="utf-8")
        settings = ["method=given", f"method.file={file}", *(f"effects.{sensor}=[]" for sensor in SENSORS)]
        for figure in figures_of(calibrate_unit(campaign, unit, overrides=settings), unit):
            if figure.name.endswith((", calibrated", ", after")):
                found.append(figure._replace(name=f"{figure.name.rpartition(', ')[0]}, {name}", interval=None))
    if unit == "turns":
        entries = {"raw": {"bias": np.zeros(3), "matrix": np.eye(3)}, "calibrated": result.calibration["gyroscope"]}
        entries |= {name: entry["gyroscope"] for name, entry in others.items()}
        found += [MeasuredFigure(f"turns turn, {n}", turn_error(folder, e), 4, unit="deg") for n, e in entries.items()]
    return [*found, *(MeasuredFigure(f"CPU of {name}", seconds, 1, unit="s") for name, seconds in spent.items())]


def figures_of(result: UnitResult, unit: str) -> list[MeasuredFigure]:
    validation: dict[str, Any] = result.validation
    found = []
    for sensor, (scale, measured_in) in SENSORS.items():
        part = validation[sensor]
        if part is None:
            continue
        first, last = (scale * part["steps"][k]["rms_error"] for k in (0, -1))
        ends = part["expected_rms_error"]
        expected = ends and (scale * ends[0], scale * ends[1])
        name = f"{unit} {sensor}"
        found += [
            MeasuredFigure(f"{name}, raw", first, part["samples"], unit=measured_in),
            MeasuredFigure(f"{name}, calibrated", last, part["samples"], interval=expected, unit=measured_in),
            MeasuredFigure(f"{name}, noise floor", scale * part["noise_floor"], part["samples"], unit=measured_in),
        ]
    moves = validation.get("gravity_direction")
    if moves and "rms_deg" in moves:
        for name, value in (*moves["rms_deg"].items(), ("noise floor", moves["noise_floor_deg"])):
            found.append(MeasuredFigure(f"{unit} move, {name}", value, moves["moves"], unit="deg"))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--xsens", type=Path, help="folder of the recording")
    parser.add_argument("--sets", type=Path, help="folder of clones, see benchmarks/sets/sources.yaml")
    parser.add_argument("--figures", type=Path, help="file for the figures")
    options = parser.parse_args()
    published = ROOT / "data" / "published"
    found = [f for unit in ("mpu6050", "wearable") for f in figures_of(calibrate_unit(published, unit), unit)]
    if options.xsens:
        if not (options.xsens / "gyroscope.txt").is_file():
            raise SystemExit(f"{options.xsens}: no gyroscope.txt; see the head of this file")
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            (folder / "units.csv").write_text(
                XSENS.format(f"procedure.folder={options.xsens.resolve()}; table.gravity_g={GRAVITY_G}; {EFFECT}")
            )
            found += figures_of(calibrate_unit(folder, "xsens"), "xsens")
    if options.sets:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(shutil.copytree(SETS, Path(name) / "sets"))
            for unit, source in yaml.safe_load((SETS / "sources.yaml").read_text(encoding="utf-8")).items():
                place(options.sets, folder, unit, source)
                found += figures_of_set(folder, unit, source.get("authors"))
    for figure in found:
        print(*figure.cells)
    write_figures(options.figures, found)


if __name__ == "__main__":
    main()
