"""How often a stated 95 % interval holds the truth, over simulated calibrations of every method.

    nice python benchmarks/coverage.py [--n 1000] [--seed 1] [--conditions white,wander,table] [--methods ...]

A unit is drawn by the product's own simulator (MPU-6050, quantised), recorded, and calibrated by each method and by the
stage ``effects``; then the truth of each parameter lies within its expanded uncertainty or not. Conditions:

    white   white noise alone, and a data sheet that states no bias wander
    wander  with the sensor file's bias wander; in both, a table without errors, which states none
    table   with wander and with a table whose errors have the sizes that its configuration states

The truth of the staged method, which is an approximation by design, is its own output without noise and table errors.
Prints the share over all parameters with its standard error over units, that of the worst and best parameter, and
seconds. A study of some hours is cut into several of ``--n`` units each, from unit ``--first`` on.
"""

from __future__ import annotations

import argparse
import os
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from imu_research.figures import clustered_share, write_figures
from pipeline.core.records import SENSORS, NotCalibrated
from pipeline.output.exports.sensors import rotation_times_lower
from pipeline.physics.effects.base import truth
from pipeline.physics.kinematics import reference_motion
from pipeline.simulation.campaign import simulate_unit
from pipeline.simulation.description import UnitDescription, shipped_settings
from pipeline.unit import run_checked

if TYPE_CHECKING:
    from pipeline.core.records import Recording, SensorCalibration
    from pipeline.core.settings import Settings

COURSE = {
    "step_deg": 15.0,
    "dwell_s": 1.2,
    "rates_dps": [60.0],
    "both_directions": True,
    "warm_up_rest_s": 10.0,
    "static_s": 0.0,
    "validation_s": 0.0,
    "pause_s": 10.0,
}
FAULTLESS = {"angle_accuracy_deg": 0.0, "rate_error": [0.0] * 3, "direction_deg": np.zeros((3, 2)).tolist()}
JSON = dict[str, Any]
BENCH, HAND = "three_axis_turns", "multi_position"
METHODS: dict[str, tuple[str, str, tuple[str, ...]]] = {  # procedure, sensor, stages
    "reference accelerometer": (BENCH, "accelerometer", ("reference_least_squares",)),
    "reference gyroscope": (BENCH, "gyroscope", ("reference_least_squares",)),
    "staged accelerometer": (BENCH, "accelerometer", ("orthogonality", "misalignment", "bias", "scale_factor")),
    "staged gyroscope": (BENCH, "gyroscope", ("bias", "orthogonality_and_misalignment", "scale_factor")),
    "nonlinear accelerometer": (BENCH, "accelerometer", ("nonlinear_least_squares",)),
    "cholesky gyroscope": (BENCH, "gyroscope", ("bias", "cholesky_lu")),
    "effects accelerometer": (BENCH, "accelerometer", ("effects",)),
    "effects gyroscope": (BENCH, "gyroscope", ("effects",)),
    "nonlinear accelerometer by hand": (HAND, "accelerometer", ("nonlinear_least_squares",)),
    "rests and moves gyroscope by hand": (HAND, "gyroscope", ("rests_and_moves",)),
}
EFFECTS = {"accelerometer": ["scale_factor_asymmetry"], "gyroscope": ["g_sensitivity"]}  # fitted; no unit has them
ACCURACIES = ("angle_accuracy_deg", "rate_accuracy", "orthogonality_deg", "levelling_deg")
CONDITIONS = ("white", "wander", "table")
APPROXIMATIONS: dict[tuple[Any, ...], np.ndarray] = {}


def settings_of(condition: str, table: str, procedure: str) -> Settings:
    shipped = shipped_settings(sensor="mpu6050", table="hand" if procedure == HAND else table, procedure=procedure)
    sensor, stated = shipped.sensor, shipped.table
    if condition == "white":
        sensor = sensor.replaced(**{s: sensor.of(s).replaced(bias_wander=0.0) for s in SENSORS})
    if condition != "table":
        stated = stated.replaced(**dict.fromkeys(ACCURACIES, 0.0))
    fitted = shipped.procedure.replaced(holdout_every=0)
    return shipped.replaced(sensor=sensor, table=stated, procedure=fitted, effects=shipped.effects.replaced(**EFFECTS))


def simulated(condition: str, table: str, procedure: str, seed: int, number: int) -> tuple[list[Recording], JSON]:
    still = {"bias_wander": 0.0} if condition == "white" else {}
    unit = UnitDescription(
        "U",
        table="hand" if procedure == HAND else table,
        procedure=procedure,
        course=COURSE if procedure == BENCH else {"static_s": 0.0},
        accelerometer=still,
        gyroscope=still,
        imperfections={} if condition == "table" else FAULTLESS,
    )
    return simulate_unit(unit, seed, number)


def calibrated(
    sensor: str, stages: tuple[str, ...], recordings: list[Recording], settings: Settings
) -> SensorCalibration:
    """Run the steps filter and fit, with these stages."""
    found = run_checked(recordings, {sensor: stages}, settings).fits[sensor]
    if isinstance(found, NotCalibrated):
        raise TypeError(found.reason)
    return found


def noise_free(recordings: list[Recording], sensor: str, hidden: JSON) -> list[Recording]:
    """Return the recordings with what the sensor would read in the commanded motion."""
    K, out = np.linalg.solve(np.array(hidden[sensor]["matrix"]), np.eye(3)), []
    for recording in recordings:
        motion = reference_motion(recording)
        if recording.role == sensor and motion is not None:
            reading = np.array(hidden[sensor]["bias"]) + truth(sensor, motion) @ K.T
            out.append(replace(recording, **{sensor: reading}))
    return out


def true_values(method: str, recordings: list[Recording], settings: Settings, hidden: JSON) -> np.ndarray:
    _, sensor, stages = METHODS[method]
    matrix = np.array(hidden[sensor]["matrix"])
    if "staged" in method:
        unit = (method, *hidden["seed"])  # the same in every condition
        if unit not in APPROXIMATIONS:
            found = calibrated(sensor, stages, noise_free(recordings, sensor, hidden), settings)
            APPROXIMATIONS[unit] = np.concatenate([found.bias, found.matrix.ravel()])
        return APPROXIMATIONS[unit]
    if method.endswith("by hand") or "nonlinear" in method:
        frame, _ = rotation_times_lower(np.array(hidden["accelerometer"]["matrix"]))  # of a fit without a table
        matrix = frame.T @ matrix
    return np.concatenate([hidden[sensor]["bias"], matrix.ravel()])


def judged(method: str, recordings: list[Recording], settings: Settings, hidden: JSON) -> np.ndarray:
    """Return error over expanded uncertainty of each parameter; NaN where a parameter is not estimated."""
    _, sensor, stages = METHODS[method]
    part = calibrated(sensor, stages, recordings, settings).to_json()
    value = np.concatenate([part["bias"], np.ravel(part["matrix"])])
    expanded = part["expanded_uncertainty"]
    U = np.concatenate([expanded["bias"], np.ravel(expanded["matrix"])])
    error = value - true_values(method, recordings, settings, hidden)
    if "effects" in method:
        added = [p for effect in part["effects"] for p in effect["parameters"].values()]
        error = np.append(error, [p["value"] for p in added])
        U = np.append(U, [p["expanded_uncertainty"] for p in added])
    return np.where(U > 0.0, error / np.where(U > 0.0, U, 1.0), np.nan)


def study(methods: list[str], condition: str, number: int, seed: int, table: str) -> dict[str, np.ndarray]:
    """Return error over expanded uncertainty of each parameter of a unit, by method."""
    found = {}
    for procedure in (BENCH, HAND):
        wanted = [name for name in methods if METHODS[name][0] == procedure]
        if wanted and not (procedure == HAND and condition == "table"):
            recordings, hidden = simulated(condition, table, procedure, seed, number)
            settings = settings_of(condition, table, procedure)
            found |= {name: judged(name, recordings, settings, hidden) for name in wanted}
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=1000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--conditions", default=",".join(CONDITIONS))
    parser.add_argument("--methods", default="", help="words that a method's name holds, with commas; all by default")
    parser.add_argument("--table", default="acutronic", help="table whose stated errors the condition table has")
    parser.add_argument("--figures", type=Path, help="file for the shares with their 99 % intervals, clustered by unit")
    arguments = parser.parse_args()
    figures = []
    words = arguments.methods.split(",")
    methods = [name for name in METHODS if any(word in name for word in words)]
    for condition in arguments.conditions.split(","):
        start = time.monotonic()
        units = range(arguments.first, arguments.first + arguments.n)
        of_unit = partial(study, methods, condition, seed=arguments.seed, table=arguments.table)
        with ProcessPoolExecutor(arguments.processes, get_context("spawn")) as pool:
            found = list(pool.map(of_unit, units, chunksize=4))
        print(f"{condition}, n = {arguments.n}, seed {arguments.seed}, {time.monotonic() - start:.0f} s")
        for name in found[0]:
            ratios = np.array([unit[name] for unit in found])
            known = ~np.all(np.isnan(ratios), axis=0)
            inside = np.abs(ratios[:, known]) <= 1.0
            figures += clustered_share(f"{name}, {condition}", list(inside), "contains 95 %")
            each = 100.0 * inside.mean(axis=0)
            units = 100.0 * inside.mean(axis=1)
            print(
                f"  {name:<36} pooled {each.mean():5.2f} % +- {units.std() / np.sqrt(len(units)):.2f}, "
                f"parameters {each.min():5.1f} to {each.max():5.1f} %: {' '.join(f'{e:.1f}' for e in each)}",
                flush=True,
            )
    write_figures(arguments.figures, figures)


if __name__ == "__main__":
    main()
