"""Errors of bias and matrix with one effect at its limit, against U and U with the open effects, in-process.

    nice python benchmarks/open_effects.py [--units 2] [--procedure ferraris ...] [--none] [--figures FILE]

Every unit has one effect of its sensor file at the limit, with random signs; ``--none``: no effect. Prints for each
procedure the share of the parameters within U, within ``uncertainty_with_open``, and the largest error over the latter,
with the verdict, of units that are said to lack nothing.
"""

from __future__ import annotations

import argparse
import os
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import pandas as pd

from imu_research.figures import MeasuredFigure, clustered_share, share, write_figures
from pipeline.app.one_unit import unit_of_recordings, unit_row
from pipeline.core.records import SENSORS, Recording
from pipeline.estimation.uncertainty_budget import limited_effects
from pipeline.output.exports.sensors import rotation_times_lower
from pipeline.physics.effects.base import REFERENCE_TEMPERATURE
from pipeline.simulation.campaign import simulate_unit
from pipeline.simulation.description import UnitDescription

SILENT = {"nothing_missing", "not_enough_data"}  # verdicts
MOST_OVER_WIDE = 5.0  # times the uncertainty with the open effects
WITHOUT_CASE = ("six_positions", "orientations_24", "multi_position")
PROCEDURES = {
    "ferraris": {"interval_s": 0.02},
    "six_positions": {"interval_s": 0.02},
    "orientations_24": {"interval_s": 0.02},
    "multi_position": {"interval_s": 0.02},
    "three_axis_turns": {"table": "acutronic"},
}


def _at_mean_temperature(truth: dict, effect: str, slope: list[float], recordings: list[Recording]) -> dict:
    """Return the truth of the matrix at the recordings' mean temperature, which a fit without its slope determines."""
    sensor, _, name = effect.partition(".")
    if name != "scale_factor_temperature":
        return truth
    warmer = np.mean(np.concatenate([r.temperature for r in recordings])) - REFERENCE_TEMPERATURE
    K = np.linalg.inv(truth[sensor]["matrix"]) + warmer * np.diag(slope)
    return truth | {sensor: truth[sensor] | {"matrix": np.linalg.inv(K).tolist()}}


def errors_of(procedure: str, effect: str, limit: np.ndarray | None, seed: int) -> list[dict]:
    """Return for each sensor the errors of bias and matrix, both uncertainties and the verdict of one unit."""
    rng = np.random.default_rng([seed, 38])
    hidden = {} if limit is None else {effect: (limit * rng.choice([-1.0, 1.0], len(limit))).tolist()}
    described = {"table": "hand", **PROCEDURES[procedure]}
    unit = UnitDescription("U", procedure=procedure, effects=hidden, **described)
    recordings, truth = simulate_unit(unit, seed, 0)
    if limit is not None:
        truth = _at_mean_temperature(truth, effect, hidden[effect], recordings)
    layers = [f"table={unit.table}", f"procedure={procedure}", "sensor=mpu6050"]
    layers += ["method=rests_and_moves"] if procedure == "multi_position" else []
    began = time.process_time()
    state = unit_of_recordings(recordings, layers).run_to("calibration")
    spent = time.process_time() - began
    found = []
    for sensor in SENSORS:
        part, true = state.calibration[sensor], truth[sensor]
        if part is None:
            continue
        if procedure in WITHOUT_CASE:
            frame, _ = rotation_times_lower(np.array(truth["accelerometer"]["matrix"]))  # of the method
            true = true | {"matrix": frame.T @ np.array(true["matrix"])}
        flat = [np.append(p["bias"], np.ravel(p["matrix"])) for p in (part, true, part["expanded_uncertainty"])]
        wide = part["uncertainty_with_open"]
        wide = np.append(wide["bias"], np.ravel(wide["matrix"]))
        own = {entry["effect"]: entry["up_to"] for entry in part["open"]}
        name = effect.partition(".")[2] if effect.startswith(sensor) else effect
        line = own.get(name)
        up_to = np.zeros(12) if line is None else np.append(line["bias"], np.ravel(line["matrix"]))
        kept = flat[2] > 0.0
        verdict = state.diagnosis[sensor]["verdict"]
        found.append({
            "sensor": sensor, "effect": effect, "error": np.abs(flat[0] - flat[1])[kept], "U": flat[2][kept],
            "wide": wide[kept], "line": up_to[kept], "verdict": str(verdict), "open": sorted(own), "cpu_s": spent,
            "selected": list(state.diagnosis[sensor]["selected"]),
        })  # fmt: skip
    return found


def rows_of(procedure: str, effect: str, limit: np.ndarray | None, seed: int) -> list[dict]:
    """Return ``errors_of`` a unit; empty, and a line, where it is refused."""
    try:
        return errors_of(procedure, effect, limit, seed)
    except Exception as error:  # noqa: BLE001
        print(procedure, effect, type(error).__name__, str(error)[:150])
        return []


def at_limits() -> dict[str, np.ndarray]:
    """Return the parameters of each effect of an MPU-6050 at the sensor file's limit, by ``<sensor>.<effect>``."""
    settings = unit_row(["sensor=mpu6050"]).config.sensor
    return {
        f"{s}.{this.name}": np.where(limits > 0.0, limits, start)
        for s in SENSORS
        for this, start, limits in limited_effects(s, (), settings.of(s))
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--units", type=int, default=1, help="of each effect")
    parser.add_argument("--procedure", nargs="+", default=list(PROCEDURES), choices=list(PROCEDURES))
    parser.add_argument("--none", action="store_true")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--cores", type=int, default=1)
    parser.add_argument("--told", action="store_true", help="list the units that are not said to lack nothing")
    parser.add_argument("--figures", type=Path, help="file for the shares with their 99 % intervals, clustered by unit")
    options = parser.parse_args()
    effects = at_limits()
    figures: list[MeasuredFigure] = []
    for procedure in options.procedure:
        tasks = [
            (procedure, name, None if options.none else limit, 1000 * options.seed + 50 * number + k)
            for number, (name, limit) in enumerate(effects.items())
            for k in range(options.units)
        ]
        with ProcessPoolExecutor(options.cores) as pool:
            by_unit = [found for found in pool.map(rows_of, *zip(*tasks, strict=True)) if found]
        rows = [row for found in by_unit for row in found]
        silent, told = ([r for r in rows if (r["verdict"] in SILENT) == unsaid] for unsaid in (True, False))
        of_silent = [
            np.concatenate([r["error"] <= r["U"] + r["line"] for r in found if r["verdict"] in SILENT] or [np.ones(0)])
            for found in by_unit
        ]
        figures += clustered_share(f"{procedure}: within U and the line of its effect", of_silent, ">= 95 %")
        far = pd.Series([bool(np.max(r["error"] / r["wide"]) <= MOST_OVER_WIDE) for r in silent], dtype=bool)
        figures += share(f"{procedure}: none off by more than 5 times U with the open effects", far, ">= 100 %")
        within = np.mean(np.concatenate([r["error"] <= r["U"] for r in silent]))
        wide = np.mean(np.concatenate([r["error"] <= r["wide"] for r in silent]))
        cpu, ratio = np.mean([r["cpu_s"] for r in rows]), np.median(np.concatenate([r["wide"] / r["U"] for r in rows]))
        print(f"{procedure}: {len(silent)} of {len(rows)} silent; CPU {cpu:.2f} s a unit; U with open {ratio:.2f} U")
        print(f"   within U {within:.3f}, U with open {wide:.3f};", figures[-2].cells)
        for r in sorted(silent, key=lambda r: -np.max(r["error"] / r["wide"]))[:6]:
            over = [np.max(r["error"] / r[key]) for key in ("U", "wide")]
            said = f"{over[0]:.1f} U, {over[1]:.2f} of U with open, {r['verdict']}"
            print(f"   {r['sensor']} with {r['effect']}: {said}, line {'yes' if r['line'].any() else 'no'}")
        causes = sorted({(r["sensor"][:4], r["effect"], r["verdict"], ",".join(r["selected"])) for r in told})
        print("   told:", causes if options.told else len(told), flush=True)
    write_figures(options.figures, figures)


if __name__ == "__main__":
    main()
