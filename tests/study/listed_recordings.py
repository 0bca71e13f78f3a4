"""Whether U covers the truth for recordings that a sheet lists, kind by kind; by a simulation of its own.

    python tests/study/listed_recordings.py --kind turns --units 30 --seed 1

The simulation uses no code of the package. It writes ``recordings.csv`` and its files, which are calibrated as by
``pipeline.calibrate``. A parameter is inside where the published value is within the published U of the truth.
Parameters that the recordings determine and those held by the sensor file are counted apart. With ``--diagnose`` units
are counted in which no effect is selected that is not hidden, and nothing is unexplained.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import pandas as pd
import scipy

from imu_research.figures import MeasuredFigure, clustered_share, share, write_figures
from pipeline.app.one_unit import unit_without_campaign

RATE_HZ = 100.0
# As the sensor file mpu6050: white noise of a sample, bias wander, its time; limits of bias, scale factor, cross-axis.
WHITE = {"accelerometer": 4e-4 * np.sqrt(RATE_HZ / 2.0), "gyroscope": 5e-3 * np.sqrt(RATE_HZ / 2.0)}
WANDER = {"accelerometer": 1e-4, "gyroscope": 3e-3}
TAU_S = 100.0
LIMITS = {"accelerometer": (0.08, 0.03, 0.02), "gyroscope": (20.0, 0.03, 0.02)}
BETWEEN = 0.01  # deg/s, of the gyroscope's bias between files
CONTAINED = {"bias_temperature", "bias_temperature_quadratic"}  # in bias_temperature_cubic, whose third power may hide


if TYPE_CHECKING:
    from collections.abc import Iterable


class Unit:
    """A simulated unit: its truth, and the files that were recorded with it."""

    def __init__(self, folder: Path, rng: np.random.Generator) -> None:
        self.folder, self.rng, self.rows = folder, rng, ["file,kind,axis,angle_deg,angle_accuracy_deg,held_out"]
        self.bias, self.K = {}, {}
        for sensor, (bias, scale, cross) in LIMITS.items():
            self.bias[sensor] = bias * rng.uniform(-1.0, 1.0, 3) * (0.2 if sensor == "gyroscope" else 1.0)
            K = cross * rng.uniform(-1.0, 1.0, (3, 3))
            np.fill_diagonal(K, 1.0 + scale * rng.uniform(-1.0, 1.0, 3))
            self.K[sensor] = K
        self.effects: dict[str, dict[str, float]] = {}  # of the gyroscope: the parameters of each

    def frame(self) -> np.ndarray:
        """Rotation from the case to the frame of the accelerometer, in which its matrix is lower triangular."""
        M = np.linalg.inv(self.K["accelerometer"])
        Q = np.linalg.qr(M[:, ::-1])[0][:, ::-1]
        return (Q * np.sign(np.diag(Q.T @ M))).T

    def truth(self, sensor: str, *, in_case: bool) -> np.ndarray:
        """Bias and matrix: (12,), in the frame of the accelerometer or that of the case."""
        M = np.linalg.inv(self.K[sensor])
        return np.concatenate([self.bias[sensor], (M if in_case else self.frame() @ M).ravel()])

    def read(self, sensor: str, true: np.ndarray, offset: np.ndarray, hz: float) -> np.ndarray:
        """Readings of the true motion (n, 3), ``hz`` times a second."""
        n, rng = len(true), self.rng
        keep = np.exp(-1.0 / (hz * TAU_S))
        drive = rng.normal(size=(n, 3)) * np.sqrt(1.0 - keep**2)
        start = keep * rng.normal(size=(1, 3))
        wander = scipy.signal.lfilter([1.0], [1.0, -keep], drive, axis=0, zi=start)[0]
        noise = WHITE[sensor] * np.sqrt(hz / RATE_HZ) * rng.normal(size=(n, 3)) + WANDER[sensor] * wander
        return self.bias[sensor] + offset + true @ self.K[sensor].T + noise

    def write(
        self,
        name: str,
        row: str,
        force: np.ndarray,
        rate: np.ndarray,
        sensors: str = "ag",
        *,
        warmth: np.ndarray | None = None,
        hz: float = RATE_HZ,
        between: float = BETWEEN,
    ) -> None:
        """Record a file; ``warmth``: (n,), degC, a further column."""
        header, columns = "time_s", [np.arange(len(rate)) / hz]
        if "a" in sensors:
            header += ",accel_x_g,accel_y_g,accel_z_g"
            columns.append(self.read("accelerometer", force, np.zeros(3), hz))
        if "g" in sensors:
            header += ",gyro_x_dps,gyro_y_dps,gyro_z_dps"
            columns.append(self.read("gyroscope", rate, between * self.rng.normal(size=3), hz))
        if warmth is not None:
            header += ",temperature_degc"
            columns.append(warmth[:, None] + 0.02 * self.rng.normal(size=(len(warmth), 1)))
        table = np.column_stack(columns)
        np.savetxt(self.folder / f"{name}.csv", table, fmt="%.9g", delimiter=",", header=header, comments="")
        self.rows.append(f"{name}.csv,{row}")

    def sheet(self) -> None:
        (self.folder / "recordings.csv").write_text("\n".join(self.rows) + "\n")


def rotation(axis: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Rotations by angles (n,), rad, about a unit axis: (n, 3, 3)."""
    k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    s, c = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    return np.eye(3) + s * k + (1 - c) * (k @ k)


def at_rest(seconds: float, up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Force and rate at rest."""
    n = round(seconds * RATE_HZ)
    return np.tile(up, (n, 1)), np.zeros((n, 3))


def turned(angle_deg: float, peak: float, axis: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Force and rate of a smooth turn about an axis of the body: the force is ``up`` turned by -a."""
    n = round(2.0 * abs(angle_deg) / peak * RATE_HZ)
    phase = (np.arange(n) + 0.5) / n
    rate = angle_deg / n * (1.0 - np.cos(2.0 * np.pi * phase)) * RATE_HZ
    angle = angle_deg * (phase - np.sin(2.0 * np.pi * phase) / (2.0 * np.pi))
    force = rotation(axis, -np.radians(angle)) @ up
    return force, rate[:, None] * axis


def joined(*parts: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Parts of a recording, one after the other."""
    return np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])


def sphere(rng: np.random.Generator) -> np.ndarray:
    """A direction at random."""
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)


def turns(unit: Unit, sensors: str) -> None:
    """Turns by hand about x, y and z, in one or two files an axis, some with rests; rests in one to four attitudes."""
    rng = unit.rng
    accuracy = float(np.exp(rng.uniform(np.log(0.1), np.log(5.0))))
    for k in range(int(rng.integers(1, 5))):
        unit.write(f"rest_{k}", "rest,,,,", *at_rest(rng.uniform(3.0, 20.0), sphere(rng)), sensors)
    for i, axis in enumerate("xyz"):
        off = np.radians(1.5) * rng.normal(size=3) * (np.arange(3) != i)
        e = np.eye(3)[i] + off
        e /= np.linalg.norm(e)
        for k in range(int(rng.integers(1, 3))):
            stated = float(rng.choice([360.0, -360.0, 720.0, 361.338]))
            up, angle = sphere(rng), stated + accuracy * rng.normal()
            turn = turned(angle, rng.uniform(40.0, 150.0), e, up)
            parts = [turn]
            if rng.uniform() < 0.7:
                end = rotation(e, np.array([-np.radians(angle)]))[0] @ up
                parts = [at_rest(rng.uniform(2.0, 8.0), up), turn, at_rest(rng.uniform(2.0, 8.0), end)]
            shown = "" if stated in (360.0, -360.0, 720.0) and rng.uniform() < 0.3 else f"{stated:g}"
            unit.write(f"turn_{axis}_{k}", f"turn,{axis},{shown},{accuracy:.3g},", *joined(*parts), sensors)


def on_table(unit: Unit, sensors: str, axis: int, logged: str) -> None:
    """Steps by 45 deg about a body axis, with rests, and back at once, on a table that logs ``angle`` or ``rate``."""
    e, up = np.eye(3)[axis], np.eye(3)[0 if axis == 2 else 2]
    e = e + np.radians(0.1) * unit.rng.normal(size=3) * (np.arange(3) != axis)
    e /= np.linalg.norm(e)
    parts, angles, reached = [at_rest(4.0, up)], [np.zeros(round(4.0 * RATE_HZ))], 0.0
    for step in (*[45.0] * 7, -315.0):
        start = rotation(e, np.array([-np.radians(reached)]))[0] @ up
        parts.append(turned(step, 90.0 if step < 0.0 else 30.0, e, start))
        phase = (np.arange(len(parts[-1][1])) + 0.5) / len(parts[-1][1])
        angles.append(reached + step * (phase - np.sin(2.0 * np.pi * phase) / (2.0 * np.pi)))
        reached += step
        parts.append(at_rest(4.0, rotation(e, np.array([-np.radians(reached)]))[0] @ up))
        angles.append(np.full(len(parts[-1][1]), reached))
    force, rate = joined(*parts)
    name = f"table_{'xyz'[axis]}"
    unit.write(name, f"table,{'xyz'[axis]},,,", force, rate, sensors)
    path = unit.folder / f"{name}.csv"
    column = np.concatenate(angles) if logged == "angle" else rate @ e
    header, *lines = path.read_text().splitlines()
    named = "table_angle_deg" if logged == "angle" else "table_rate_dps"
    rows = [f"{header},{named}", *(f"{line},{v:.7g}" for line, v in zip(lines, column, strict=True))]
    path.write_text("\n".join(rows) + "\n")


def table(unit: Unit, sensors: str, logged: str) -> None:
    """Turns on a table about x, y and z, and a turn and a rest by hand."""
    for axis in range(3):
        on_table(unit, sensors, axis, logged)
    up, stop = np.eye(3)[2], 360.0 + 0.5 * unit.rng.normal()
    unit.write("still", "rest,,,,", *at_rest(20.0, up), sensors)
    end = rotation(np.eye(3)[0], np.array([-np.radians(stop)]))[0] @ up
    turn = joined(at_rest(4.0, up), turned(stop, 90.0, np.eye(3)[0], up), at_rest(4.0, end))
    unit.write("hand", "turn,x,360,0.5,", *turn, sensors)


def attitudes(unit: Unit) -> None:
    """Means of 12 to 50 attitudes of the accelerometer, one row each, averaged over half a second to ten."""
    rng, count = unit.rng, int(unit.rng.integers(12, 51))
    up = np.array([sphere(rng) for _ in range(count)])
    seconds = rng.uniform(0.5, 10.0)
    noise = WHITE["accelerometer"] / np.sqrt(RATE_HZ * seconds), WANDER["accelerometer"]
    mean = unit.bias["accelerometer"] + up @ unit.K["accelerometer"].T + np.hypot(*noise) * rng.normal(size=(count, 3))
    np.savetxt(
        unit.folder / "means.csv", mean, fmt="%.9g", delimiter=",", header="accel_x_g,accel_y_g,accel_z_g", comments=""
    )
    unit.rows.append("means.csv,attitudes,,,,")


def slow(unit: Unit) -> None:
    """Slow movement through all attitudes for one to four minutes, with accelerations of 2 to 20 mg."""
    rng, n = unit.rng, round(unit.rng.uniform(60.0, 240.0) * RATE_HZ)
    time = np.arange(n) / RATE_HZ
    swings = [sum(rng.uniform(0.5, 1.0) * np.sin(2.0 * np.pi * rng.uniform(0.02, 0.06) * time + p) for p in phase)
              for phase in rng.uniform(0.0, 2.0 * np.pi, (2, 3))]  # fmt: skip
    around, above = np.pi * swings[0], 1.2 * swings[1]
    force = np.column_stack([np.cos(above) * np.cos(around), np.cos(above) * np.sin(around), np.sin(above)])
    keep = np.exp(-1.0 / (RATE_HZ * 0.3))
    shaken = scipy.signal.lfilter([np.sqrt(1.0 - keep**2)], [1.0, -keep], rng.normal(size=(n, 3)), axis=0)
    unit.write("slow", "slow,,,,", force + rng.uniform(0.002, 0.02) * shaken, np.zeros((n, 3)), "a")


def soak(unit: Unit) -> None:
    """Soaks of 40 to 90 min in one attitude or two; the gyroscope's bias is linear or cubic, or lags."""
    rng, hz = unit.rng, 5.0
    shape = str(rng.choice(["linear", "cubic", "lag"]))
    b1, b3 = (rng.uniform(low, high, 3) * rng.choice([-1.0, 1.0], 3) for low, high in ((0.005, 0.03), (1e-6, 3e-6)))
    b3, tau = b3 * (shape == "cubic"), rng.uniform(20.0, 60.0) * (shape == "lag")
    for number in range(int(rng.integers(1, 3))):
        n, swing, up = round(rng.uniform(2400.0, 5400.0) * hz), rng.uniform(15.0, 35.0), sphere(rng)
        phase = 2.0 * np.pi * np.arange(n) / n
        warm = swing * np.sin(phase)
        late = (
            warm - tau * swing * np.cos(phase) * 2.0 * np.pi * hz / n
        )  # of a slow sine: the die after the thermometer
        added = late[:, None] * b1 + late[:, None] ** 3 * b3
        rate = added @ np.linalg.inv(unit.K["gyroscope"]).T  # whose reading is what is added
        unit.write(f"soak_{number}", "soak,,,,", np.tile(up, (n, 1)), rate, warmth=25.0 + warm, hz=hz, between=0.0)
    of = {"b_T": b1, "b_T1": b1, "b_T2": np.zeros(3), "b_T3": b3, "b_tau": -tau * b1}
    effects = {
        "bias_temperature": ["b_T"],
        "temperature_lag": ["b_tau"],
        "bias_temperature_cubic": ["b_T1", "b_T2", "b_T3"],
    }
    hidden = {"linear": [0], "cubic": [2], "lag": [0, 1]}[shape]
    for name in np.array([*effects])[hidden].tolist():
        unit.effects[name] = {f"{p}_{a}": float(v) for p in effects[name] for a, v in zip("xyz", of[p], strict=True)}


KINDS = {
    "soak": soak,
    "turns": lambda unit: turns(unit, "ag"),
    "turns_gyroscope": lambda unit: turns(unit, "g"),
    "table": lambda unit: table(unit, "ag", "angle"),
    "table_gyroscope": lambda unit: table(unit, "g", "rate"),
    "attitudes": attitudes,
    "slow": slow,
}


def run(number: int, *, kind: str, seed: int, diagnose: bool = False) -> dict[str, list[tuple[str, float, bool]]]:
    """Calibrate a unit; returns for each sensor parameter, error over U, and whether recordings determine it."""
    with tempfile.TemporaryDirectory() as name:
        unit = Unit(Path(name), np.random.default_rng([seed, number]))
        KINDS[kind](unit)
        unit.sheet()
        overrides = ["diagnosis.depth=standard"]
        where = "single_axis" if kind.startswith("table") else "hand"
        overrides += ["table.seat_deg=null"] if where != "hand" else []
        overrides += ["effects.gyroscope=auto"] if kind == "soak" else []
        chosen = {"sensor": "mpu6050", "table": where, "procedure": "listed", "method": None}
        configured = unit_without_campaign(unit.folder, chosen, overrides, ())
        state = configured.run_to("diagnose" if diagnose else "validate")
        state.diagnosed = state.diagnosed if diagnose else SimpleNamespace(document={}, omissions=[])
        document = state.diagnosed.document
        found = configured.run_to(first="calibration", state=state).calibration
    assert found is not None
    out: dict[str, list[tuple[str, float, bool]]] = {}
    if diagnose:
        hidden = {*unit.effects} | (CONTAINED if "bias_temperature_cubic" in unit.effects else set())
        parts = [(part, hidden if sensor == "gyroscope" else set()) for sensor in LIMITS if (part := document[sensor])]
        more = [n for part, known in parts for n in {*part["selected"]} - known | {*map(str, part["unexplained"])}]
        out["invented"] = [(name, np.inf, True) for name in more] or [("nothing", 0.0, True)]
    names = [f"bias_{a}" for a in "xyz"] + [f"matrix_{i}{j}" for i in "xyz" for j in "xyz"]
    for sensor in LIMITS:
        part = found[sensor]
        if part is None:
            continue
        value = np.concatenate([part["bias"], np.ravel(part["matrix"])])
        U = np.concatenate([part["expanded_uncertainty"]["bias"], np.ravel(part["expanded_uncertainty"]["matrix"])])
        by = np.concatenate([part["determined_by"]["bias"], np.ravel(part["determined_by"]["matrix"])])
        error = value - unit.truth(sensor, in_case=found["accelerometer"] is None)
        out[sensor] = [
            (n, float(e / u), d == "recordings") for n, e, u, d in zip(names, error, U, by, strict=True) if u > 0.0
        ]
        if sensor == "gyroscope" and kind == "soak":
            found_effects = {e["name"]: e["parameters"] for e in part["effects"]}
            right = found_effects.keys() == unit.effects.keys()
            out["effects"] = [("named", 0.0 if right else np.inf, True)]
            for name in found_effects.keys() & unit.effects.keys():
                for p, true in unit.effects[name].items():
                    stated = found_effects[name][p]
                    out[sensor].append((p, (stated["value"] - true) / stated["expanded_uncertainty"], True))
    return out


def main(argv: list[str]) -> int:
    """Print the coverage of each sensor and group of parameters."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kind", required=True, help=f"{', '.join(KINDS)}; several separated by commas, or all")
    parser.add_argument("--units", type=int, default=30)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--diagnose", action="store_true", help="also count what the diagnosis invents")
    parser.add_argument("--figures", type=Path, help="file for the shares with their 99 % intervals, clustered by unit")
    arguments = parser.parse_args(argv)
    kinds = [*KINDS] if arguments.kind == "all" else arguments.kind.split(",")
    options = {"seed": arguments.seed, "diagnose": arguments.diagnose}
    with ProcessPoolExecutor(arguments.processes) as pool:
        figures = [
            figure
            for kind in kinds
            for figure in told(kind, pool.map(partial(run, kind=kind, **options), range(arguments.units)))
        ]
    write_figures(arguments.figures, figures)
    return 0


def told(kind: str, units: Iterable[dict[str, list[tuple[str, float, bool]]]]) -> list[MeasuredFigure]:
    """Print the shares of a kind by sensor and group of parameters; returns those of all parameters."""
    counts: dict[tuple[str, str, str], list[float]] = {}
    by_unit: dict[bool, list[list[bool]]] = {True: [], False: []}
    named: list[bool] = []  # whether the effects of a soak are named, and no other
    sound: list[bool] = []  # whether a diagnosis invents nothing
    for number, found in enumerate(units):
        invented = found.pop("invented", [])
        sound += [not any(ratio for _, ratio, _ in invented)] if invented else []
        for name in (name for name, ratio, _ in invented if ratio):
            sys.stdout.write(f"{kind:16} unit {number} invents {name}\n")
        named += [ratio == 0.0 for _, ratio, _ in found.pop("effects", [])]
        for recorded, each in by_unit.items():
            each.append([abs(ratio) <= 1.0 for rows in found.values() for _, ratio, by in rows if by is recorded])
        for sensor, rows in found.items():
            for name, ratio, recorded in rows:
                group = "bias" if name.startswith("bias") else "scale" if name[-1] == name[-2] else "cross"
                group = "effect" if name.startswith("b_") else group
                counts.setdefault((sensor, group, "recordings" if recorded else "sensor_file"), []).append(ratio)
    for (sensor, group, by), ratios in sorted(counts.items()):
        inside = np.abs(ratios) <= 1.0
        sys.stdout.write(
            f"{kind:16} {sensor:13} {group:6} {by:12} {inside.sum():4d} of {len(ratios):4d} = {inside.mean():.3f}, "
            f"rms error/U {np.sqrt(np.mean(np.square(ratios))):.2f}\n"
        )
    if named:
        sys.stdout.write(f"{kind:16} effects named and no other: {sum(named)} of {len(named)}\n")
    if sound:
        sys.stdout.write(f"{kind:16} nothing invented: {sum(sound)} of {len(sound)}\n")
    return [
        *share(f"{kind}: nothing invented", pd.Series(sound, dtype=bool), ">= 99 %"),
        *share(f"{kind}: effects named, and no other", pd.Series(named, dtype=bool), ">= 95 %"),
        *clustered_share(f"{kind}: determined by the recordings", by_unit[True], "contains 95 %"),
        *clustered_share(f"{kind}: held by the sensor file", by_unit[False], ">= 95 %"),
    ]


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
