"""This product beside imucal and imu_tk: the same recordings, errors against the truth or on held-out stretches.

    pip install imucal
    git clone https://github.com/Kyle-ak/imu_tk /tmp/imu_tk          # needs g++, Ceres Solver and Eigen
    nice python benchmarks/peers.py --units 60 --imu-tk /tmp/imu_tk [--xsens FOLDER] [--out peers.md]

Simulated MPU-6050 units with the errors of a hand: faces and turns for imucal, forty rests for imu_tk. imucal gets its
sections from the rests and turns found here, in place of a person's marks. With the true reading K u + b, the estimate
M (reading - bias), and R the rotation nearest to M_a K_a,

    accelerometer       rms over directions u of |R^T M_a (K_a u + b_a - bias_a) - u|, 1 g
    gyroscope           likewise with the same R, |u| = 100 deg/s, so in the axes of the accelerometer
    gyroscope's scale   rms of the diagonal of M_g K_g - 1
    case                angle of R

Public recordings: magnitude of gravity at held-out rests, and the angle of gravity after held-out moves, from rest to
rest. Ratios are this product's error over the other's, geometric means with 95 % intervals (Student's t over units).
FOLDER holds ``accelerometer.txt`` and ``gyroscope.txt`` of Tedaldi, Pretto & Menegatti (ICRA 2014).
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import tempfile
import time
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from scipy import stats
from scipy.linalg import polar
from scipy.spatial.transform import Rotation

from imu_research.figures import MeasuredFigure, write_figures
from pipeline.app.config import load_campaign
from pipeline.app.one_unit import unit_of_campaign, unit_row
from pipeline.core.records import SENSORS
from pipeline.ingest.read import read_recordings
from pipeline.physics.signal.rests import find_rests
from pipeline.physics.signal.segments import cut
from pipeline.simulation.campaign import simulate_unit
from pipeline.simulation.description import UnitDescription, shipped_settings
from pipeline.unit import run_checked

if TYPE_CHECKING:
    from collections.abc import Callable

    from pipeline.core.records import Recording
    from pipeline.core.settings import Settings

METHOD = {"accelerometer": ["nonlinear_least_squares"], "gyroscope": ["rests_and_moves"]}
FEWEST = 250.0  # deg by the raw rate, its bias included: a move that counts as a turn by 360 deg
HAND = {
    "ferraris": {"interval_s": 0.02, "course": {"dwell_s": 4.0}},
    "multi_position": {"interval_s": 0.01, "course": {"dwell_s": 4.0, "positions": 40, "static_s": 0.0}},
}
# Sections of imucal's example, as its example_ferraris_session_list.json states them: first sample, one after the last
SECTIONS = {
    "x_p": (540, 1271), "x_a": (1620, 2361), "y_p": (2814, 3298), "y_a": (3740, 4152), "z_p": (4522, 4975),
    "z_a": (5376, 5983), "x_rot": (6770, 7093), "y_rot": (8081, 8405), "z_rot": (9205, 9512),
}  # fmt: skip
XSENS_FIT_S, XSENS_REST_S = 340.0, 50.0  # two thirds of the recording; its first rest
IMU_TK_MAIN = """
#include "imu_tk/io_utils.h"
#include "imu_tk/calibration.h"
#include <cstdlib>
void write(const imu_tk::CalibratedTriad &c) {
  std::cout << "RESULT " << (c.getMisalignmentMatrix() * c.getScaleMatrix()).format(Eigen::IOFormat(17, 1, " ", " "))
            << " " << c.getBiasVector().transpose().format(Eigen::IOFormat(17)) << std::endl;
}
int main(int argc, char **argv) {
  std::vector<imu_tk::TriadData> acc, gyro;
  imu_tk::importAsciiData(argv[1], acc, imu_tk::TIMESTAMP_UNIT_SEC);
  imu_tk::importAsciiData(argv[2], gyro, imu_tk::TIMESTAMP_UNIT_SEC);
  imu_tk::MultiPosCalibration calibration;
  calibration.setInitStaticIntervalDuration(std::atof(argv[3]));
  calibration.setGravityMagnitude(1.0);
  if (!calibration.calibrateAccGyro(acc, gyro)) return 2;
  write(calibration.getAccCalib());
  write(calibration.getGyroCalib());
}
"""
# In place of its windows: none is opened, and Qt is not needed
NO_WINDOWS = """
#pragma once
namespace imu_tk {
struct Plot { template <class A, class B> void plotIntervals(const A &, const B &) {} };
inline void waitForKey() {}
}
"""


class Estimate(NamedTuple):
    """What a program found: calibrated = M (reading - bias - G f), g and deg/s, and its CPU time in s."""

    bias: tuple[np.ndarray, np.ndarray]
    matrix: tuple[np.ndarray, np.ndarray]
    sensitivity: np.ndarray
    cpu_s: float

    def force(self, reading: np.ndarray) -> np.ndarray:
        return (reading - self.bias[0]) @ self.matrix[0].T

    def rate(self, reading: np.ndarray, force: np.ndarray) -> np.ndarray:
        return (reading - self.bias[1] - force @ self.sensitivity.T) @ self.matrix[1].T


def ours(recordings: list[Recording], settings: Settings) -> Estimate:
    began = time.process_time()
    fits = run_checked(recordings, METHOD, settings).fits
    cpu = time.process_time() - began
    found = [fits[sensor] for sensor in SENSORS]
    return Estimate(tuple(f.bias for f in found), tuple(f.matrix for f in found), np.zeros((3, 3)), cpu)


def imucal(sections: dict[str, Recording], rate_hz: float) -> Estimate:
    """Return imucal's result of six rests and three turns, each by 360 deg in the direction in which it was made."""
    from imucal import FerrarisCalibration  # noqa: PLC0415  (an optional peer)
    from imucal.ferraris_calibration import FerrarisSignalRegions  # noqa: PLC0415

    regions = FerrarisSignalRegions(
        **{f"acc_{name}": part.accelerometer for name, part in sections.items()},
        **{f"gyr_{name}": part.gyroscope for name, part in sections.items()},
    )
    turned = [sections[f"{a}_rot"].gyroscope[:, i].sum() for i, a in enumerate("xyz")]
    signs = np.sign(turned)
    if abs(signs.sum()) < 3:
        raise ValueError("imucal has one sign for all turns; these differ")
    began = time.process_time()
    found = FerrarisCalibration(grav=1.0, expected_angle=360.0 * signs[0]).compute(regions, rate_hz, "g", "deg/s")
    cpu = time.process_time() - began
    matrix = [np.linalg.inv(found.K_a @ found.R_a), np.linalg.inv(found.K_g @ found.R_g)]
    return Estimate((found.b_a, found.b_g), tuple(matrix), found.K_ga, cpu)


def build_imu_tk(source: Path, folder: Path) -> Path:
    """Return the compiled imu_tk, without its windows."""
    (folder / "imu_tk").mkdir()
    (folder / "imu_tk" / "visualization.h").write_text(NO_WINDOWS)
    (folder / "main.cpp").write_text(IMU_TK_MAIN)
    head = (source / "include" / "imu_tk" / "calibration.h").read_text()
    # three setters are declared to return a value and return none, at which optimised code ends
    head = re.sub(r"\b(?:_T|int|bool) ((?:set|enable)\w+ ?\([^)]*\) ?\{ \w+ = \w+; \})", r"void \1", head)
    (folder / "imu_tk" / "calibration.h").write_text(head)
    sources = [
        folder / "main.cpp",
        *(source / "src" / f"{name}.cpp" for name in ("calibration", "filters", "io_utils")),
    ]
    include = [f"-I{folder}", f"-I{source / 'include'}", "-I/usr/include/eigen3"]
    program = folder / "imu_tk_calibrate"
    flags = ["-std=c++17", "-O2", "-w", *include]
    subprocess.run(
        ["/usr/bin/env", "g++", *flags, *map(str, sources), "-lceres", "-lglog", "-o", str(program)], check=True
    )
    return program


def imu_tk(program: Path, recording: Recording, rest_s: float) -> Estimate | None:
    """Return imu_tk's result, or None where it refuses; readings in g and rad/s, so that its start is the identity."""
    with tempfile.TemporaryDirectory() as folder:
        files = []
        for name, values in (("a", recording.accelerometer), ("g", np.radians(recording.gyroscope))):
            files.append(f"{folder}/{name}.txt")
            np.savetxt(files[-1], np.column_stack([recording.time, values]), fmt="%.9f")
        before = os.times().children_user
        done = subprocess.run([str(program), *files, str(rest_s)], capture_output=True, text=True, check=False)
        cpu = os.times().children_user - before
    rows = [np.array(line.split()[1:], float) for line in done.stdout.splitlines() if line.startswith("RESULT")]
    if len(rows) != 2 or not np.isfinite(rows).all():
        return None
    biases = rows[0][9:], np.degrees(rows[1][9:])
    return Estimate(biases, (rows[0][:9].reshape(3, 3), rows[1][:9].reshape(3, 3)), np.zeros((3, 3)), cpu)


def against_truth(found: Estimate, truth: dict[str, Any]) -> dict[str, float]:
    """Return the errors that the head of this file defines."""
    K, b = zip(*((np.linalg.inv(truth[s]["matrix"]), np.array(truth[s]["bias"])) for s in truth), strict=True)
    R, _ = polar(found.matrix[0] @ K[0])
    directions = np.random.default_rng(0).standard_normal((2, 1000, 3))
    u, w = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in directions)
    force = found.force(u @ K[0].T + b[0])
    rate = found.rate(100.0 * w @ K[1].T + b[1], force)
    return {
        "accelerometer, mg": 1000.0 * np.sqrt(np.mean(np.sum((force @ R - u) ** 2, axis=1))),
        "gyroscope, deg/s": np.sqrt(np.mean(np.sum((rate @ R - 100.0 * w) ** 2, axis=1))),
        "gyroscope's scale, %": 100.0 * np.sqrt(np.mean((np.diag(found.matrix[1] @ K[1]) - 1.0) ** 2)),
        "case, deg": np.degrees(Rotation.from_matrix(R).magnitude()),
        "CPU, s": found.cpu_s,
    }


def settings_of(procedure: str, sensor: str) -> Settings:
    shipped = shipped_settings(sensor=sensor, table="hand", procedure=procedure)
    return shipped.replaced(procedure=shipped.procedure.replaced(holdout_every=0))  # all rests are for the fit


def sections_of(whole: Recording) -> dict[str, Recording]:
    """Return six rests and the first positive turn about each axis, as a person would mark them."""
    rests = [r for r in find_rests(whole) if r.accepted]
    out: dict[str, Recording] = {}
    for rest in rests:
        mean = whole.accelerometer[rest.start : rest.stop].mean(axis=0)
        axis = int(np.argmax(np.abs(mean)))
        out.setdefault(f"{'xyz'[axis]}_{'p' if mean[axis] > 0 else 'a'}", whole.select(slice(rest.start, rest.stop)))
    for before, after in pairwise(rests):
        part = whole.select(slice(before.stop, after.start))
        angle = np.trapezoid(part.gyroscope, part.time, axis=0)
        if angle.max() > FEWEST:  # of the turns in both directions those that imucal's protocol asks for
            out.setdefault(f"{'xyz'[int(np.argmax(angle))]}_rot", part)
    return out


def simulated(units: int, procedure: str, peer: Callable[[Recording], Estimate | None]) -> list[tuple[Any, Any]]:
    """Return the errors of this product and of a peer, unit by unit; None where the peer gives no result."""
    pairs = []
    for number in range(units):
        unit = UnitDescription("U", sensor="mpu6050", table="hand", procedure=procedure, **HAND[procedure])
        recordings, truth = simulate_unit(unit, 1000 + number, number)
        truth = {s: truth[s] for s in ("accelerometer", "gyroscope")}
        other = peer(recordings[0])
        found = ours(recordings, settings_of(procedure, "mpu6050"))
        pairs.append((against_truth(found, truth), other and against_truth(other, truth)))
    return pairs


def held_out(found: Estimate, recordings: list[Recording]) -> tuple[np.ndarray, np.ndarray]:
    """Return | |f| - 1 | of each rest in mg, and the angle of gravity after each move between rests in deg."""
    sizes, angles = [], []
    for part in recordings:
        rests = [r for r in find_rests(part) if r.accepted]
        force = found.force(np.array([part.accelerometer[r.start : r.stop].mean(axis=0) for r in rests]))
        sizes += list(1000.0 * np.abs(np.linalg.norm(force, axis=1) - 1.0))
        rate = np.radians(found.rate(part.gyroscope, found.force(part.accelerometer)))
        for k, (before, after) in enumerate(pairwise(rests)):
            span = slice(before.stop - 1, after.start + 1)
            mean, step = (rate[span][1:] + rate[span][:-1]) / 2.0, np.diff(part.time[span])[:, None]
            g = force[k] / np.linalg.norm(force[k])
            for turn in Rotation.from_rotvec(mean * step):
                g = turn.inv().apply(g)
            cosine = g @ force[k + 1] / np.linalg.norm(force[k + 1])
            angles.append(np.degrees(np.arccos(min(cosine, 1.0))))
    return np.array(sizes), np.array(angles)


def ratio(mine: np.ndarray, theirs: np.ndarray) -> str:
    mean, low, high = ratio_of(mine, theirs)
    return f"{mean:.2f} ({low:.2f} to {high:.2f})"


def ratio_of(mine: np.ndarray, theirs: np.ndarray) -> tuple[float, float, float]:
    """Return the geometric mean of a ratio, with its 95 % interval over pairs."""
    logs = np.log(mine / theirs)
    half = stats.t.ppf(0.975, len(logs) - 1) * logs.std(ddof=1) / np.sqrt(len(logs))
    return tuple(map(float, np.exp([logs.mean(), logs.mean() - half, logs.mean() + half])))


def figures_of(peer: str, pairs: list[tuple[Any, Any]]) -> list[MeasuredFigure]:
    """Return median errors of both programs and their ratios, where both have a result."""
    both = [(mine, theirs) for mine, theirs in pairs if theirs is not None]
    found = [MeasuredFigure(f"{peer}: units with a result", len(both) / len(pairs), len(pairs), unit="of all")]
    for name in both[0][0]:
        mine, theirs = (np.array([pair[k][name] for pair in both]) for k in (0, 1))
        quantity, _, unit = name.rpartition(", ")
        mean, low, high = ratio_of(mine, theirs)
        of = f"{peer}: {quantity}"
        found += [
            MeasuredFigure(f"{of}, this product", float(np.median(mine)), len(both), unit=unit),
            MeasuredFigure(f"{of}, peer", float(np.median(theirs)), len(both), unit=unit),
            MeasuredFigure(f"{of}, ratio", mean, len(both), interval=(low, high), unit="times"),
        ]
    return found


def table(title: str, pairs: list[tuple[Any, Any]], hidden: tuple[str, ...] = ()) -> list[str]:
    both = [(mine, theirs) for mine, theirs in pairs if theirs is not None]
    lines = [f"{title}: n = {len(both)}, and {len(pairs) - len(both)} without a result of the peer", ""]
    lines += ["| error, median | this product | peer | ratio (95 % interval) | smaller in |", "|---|---|---|---|---|"]
    for name in both[0][0]:
        if name not in hidden:
            mine, theirs = (np.array([pair[k][name] for pair in both]) for k in (0, 1))
            values = f"{np.median(mine):.3g} | {np.median(theirs):.3g} | {ratio(mine, theirs)}"
            lines.append(f"| {name} | {values} | {np.sum(mine < theirs)} of {len(both)} |")
    return [*lines, ""]


def public(title: str, recordings: list[Recording], estimates: dict[str, Estimate | None]) -> list[str]:
    lines = [
        f"{title}, held out",
        "",
        "| program | rests | rms, mg | moves | mean, deg | largest, deg |",
        "|---|---|---|---|---|---|",
    ]
    errors = {name: held_out(found, recordings) for name, found in estimates.items() if found is not None}
    for name in estimates:
        if name not in errors:
            lines.append(f"| {name} | no result | | | | |")
            continue
        size, angle = errors[name]
        rms = np.sqrt(np.mean(size**2))
        lines.append(f"| {name} | {len(size)} | {rms:.3f} | {len(angle)} | {angle.mean():.3f} | {angle.max():.3f} |")
    first, *others = errors
    for name in others:
        if len(errors[name][1]) > 1:
            lines += ["", f"Angle after a move, ratio to {name}: {ratio(errors[first][1], errors[name][1])}"]
    return [*lines, ""]


def read(config: Settings, folder: Path) -> list[Recording]:
    return read_recordings(config.procedure, config.ingest, config.sensor, folder)


def published(unit: str) -> tuple[Settings, list[Recording]]:
    """Return the settings of a unit of the campaign, and its recordings uncut."""
    found = unit_of_campaign(load_campaign({"campaign": "published"}), unit)
    return found.row.config, read(found.row.config, found.files.folder)


def wearable(program: Path | None) -> list[str]:
    config, (whole,) = published("wearable")
    own = config.procedure
    parts = cut(whole, own.recordings["recording"].windows)
    fitted, kept = ([p for p in parts if (p.role == "validation") == out] for out in (False, True))
    settings = settings_of("ferraris", "generic")
    settings = settings.replaced(procedure=settings.procedure.replaced(turns=own.turns, faces=own.faces))
    found: dict[str, Estimate | None] = {"this product": ours(fitted, settings)}
    found["imucal"] = imucal({name: whole.select(slice(*span)) for name, span in SECTIONS.items()}, 102.4)
    if program:
        found["imu_tk"] = imu_tk(program, fitted[0], 10.0)
    return public("`wearable` (published)", kept, found)


def mpu6050(program: Path | None) -> list[str]:
    _, recordings = published("mpu6050")
    kept = [r for r in recordings if r.role == "validation"]
    fitted = [r for r in recordings if r.role != "validation"]
    found: dict[str, Estimate | None] = {"this product": ours(recordings, settings_of("multi_position", "mpu6050"))}
    if program:
        found["imu_tk"] = imu_tk(program, fitted[0], 36.0)
    return public("`mpu6050` (published)", kept, found)


def xsens(folder: Path, program: Path) -> list[str]:
    layers = ["sensor=generic", "table=hand", "procedure=multi_position", "ingest=xsens_mti_multi_position"]
    (whole,) = read(unit_row(layers).config, folder)
    split = int(np.searchsorted(whole.time - whole.time[0], XSENS_FIT_S))
    first, last = whole.select(slice(0, split)), whole.select(slice(split, None))
    found = {"this product": ours([first], settings_of("multi_position", "generic"))}
    return public("Xsens MTi (Tedaldi 2014)", [last], found | {"imu_tk": imu_tk(program, first, XSENS_REST_S)})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--units", type=int, default=60, help="simulated; 0: the public recordings alone")
    parser.add_argument("--imu-tk", type=Path, help="folder of its source; without it, imu_tk is left out")
    parser.add_argument("--xsens", type=Path, help="folder of the recording")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--figures", type=Path, help="file for medians and ratios on simulated recordings")
    options = parser.parse_args()
    if find_spec("imucal") is None:
        raise SystemExit("imucal 2.6.0 is not installed: pip install imucal==2.6.0")
    if options.imu_tk and not (options.imu_tk / "src" / "calibration.cpp").is_file():
        raise SystemExit(
            f"{options.imu_tk}: no source of imu_tk; git clone https://github.com/Kyle-ak/imu_tk (7780270)"
        )
    with tempfile.TemporaryDirectory() as folder:
        program = build_imu_tk(options.imu_tk, Path(folder)) if options.imu_tk else None
        lines, figures = [], []
        if options.units:
            pairs = simulated(options.units, "ferraris", lambda r: imucal(sections_of(r), 50.0))
            lines += table("imucal, simulated faces and turns", pairs)
            figures += figures_of("imucal 2.6.0", pairs)
        if options.units and program:
            pairs = simulated(options.units, "multi_position", lambda r: imu_tk(program, r, 28.0))
            lines += table("imu_tk, simulated rests in 40 attitudes", pairs, hidden=("case, deg",))
            figures += figures_of("imu_tk 7780270", pairs)
        lines += [*wearable(program), *mpu6050(program)]
        if program and options.xsens:
            lines += xsens(options.xsens, program)
    text = "\n".join(lines)
    print(text)
    if options.out:
        options.out.write_text(text + "\n")
    write_figures(options.figures, figures)


if __name__ == "__main__":
    main()
