"""Export files that hold less than the model, against the best file of the same format.

    nice python benchmarks/reduced_exports.py [--units 20] [--processes 1] [--figures FILE]

Every unit (an MPU-6050, three-axis turns on a table) has one effect of its sensor file at the limit, with random signs,
and a calibration with this effect fitted. Each file that cannot hold the effect is compared with two least-squares fits
of what its format holds (offset alone, with scale factors, with the matrix): to the noise-free readings over the motion
of the fit, which no calibration can know, and to the noisy readings of the fit's recordings. Errors: rms of the
calibrated noise-free reading, over the motion of the fit and over held-out motion; the smaller of both ratios counts.
"""

from __future__ import annotations

import argparse
import os
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import pandas as pd
from open_effects import at_limits

from imu_research.figures import share, write_figures
from pipeline.app.one_unit import unit_of_recordings
from pipeline.core.errors import NotObservableError
from pipeline.core.records import Recording
from pipeline.physics.effects import effect
from pipeline.physics.effects.base import Owner
from pipeline.physics.effects.base import truth as true_quantity
from pipeline.physics.kinematics import reference_motion
from pipeline.simulation.campaign import simulate_unit
from pipeline.simulation.description import UnitDescription

MOST_WORSE = 1.05  # issue 38: times the best of the format
WORDS = {"file": "files", "best": "the best of their format", "of_recordings": "least squares of the recordings"}
QUIET = {"noise_density": 0.0, "bias_wander": 0.0}


def _readings(recordings: list[Recording], sensor: str, role: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the readings and the true field, (N, 3) each, of the recordings with this role."""
    pairs = [(r, reference_motion(r)) for r in recordings if r.role == role]
    moved = [(getattr(r, sensor), true_quantity(sensor, motion)) for r, motion in pairs if motion is not None]
    readings, truth = zip(*moved, strict=True)
    return np.concatenate(readings), np.concatenate(truth)


def _best(
    part: str, readings: np.ndarray, truth: np.ndarray, noise: float | np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return matrix and bias of the least squares of ``M (r - b)`` to the truth; ``noise``: std. of r, of each axis.

    The white noise of the readings is taken out of their second moments, where it would make the matrix too small.
    """
    middle, true_middle = readings.mean(axis=0), truth.mean(axis=0)
    centred = readings - middle
    moments = centred.T @ centred - len(readings) * np.diag(np.broadcast_to(np.square(noise), 3))
    crossed = centred.T @ (truth - true_middle)
    if part == "full":
        M = np.linalg.solve(moments, crossed).T
    else:
        M = np.diag(np.diag(crossed) / np.diag(moments)) if part == "diagonal" else np.eye(3)
    return M, middle - np.linalg.solve(M, true_middle)


def _rms(M: np.ndarray, b: np.ndarray, readings: np.ndarray, truth: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(((readings - b) @ M.T - truth) ** 2, axis=1))))


def errors_of(name: str, limit: np.ndarray, seed: int) -> list[dict]:
    """Return for each file without the effect its errors and those of both fits, on the fit's and held-out motion."""
    sensor, _, hidden = name.partition(".")
    size = (limit * np.random.default_rng([seed, 3]).choice([-1.0, 1.0], len(limit))).tolist()
    unit = UnitDescription("U", table="acutronic", effects={name: size})
    quiet = UnitDescription("U", table="acutronic", effects={name: size}, accelerometer=QUIET, gyroscope=QUIET)
    recordings, drawn = simulate_unit(unit, seed, 0)
    noise_free, drawn_again = simulate_unit(quiet, seed, 0)
    if any(drawn[sensor][key] != drawn_again[sensor][key] for key in ("bias", "matrix")):
        raise RuntimeError("a unit without noise must be the same unit")
    layers = ["table=acutronic", "sensor=mpu6050", f"effects.{sensor}=[{hidden}]"]
    try:
        held_files = unit_of_recordings(recordings, layers).run_to("validate").validation[sensor]["reduced"]
    except NotObservableError as error:
        print(name, str(error).partition(" do not ")[0], "do not determine it")
        return []
    noisy, _ = _readings(recordings, sensor, sensor)
    fitted, held_out = (_readings(noise_free, sensor, role) for role in (sensor, "validation"))
    white = np.std(np.diff(noisy - fitted[0], axis=0), axis=0) / np.sqrt(2.0)
    found = []
    for file in held_files:
        if file["effects"]:
            continue
        fits = {
            "file": (np.array(file["matrix"]), np.array(file["bias"])),
            "best": _best(file["part"], *fitted, 0.0),
            "of_recordings": _best(file["part"], noisy, fitted[1], white),
        }
        row = {"effect": name, "part": file["part"], "seed": seed}
        for key, (M, b) in fits.items():
            row |= {f"{key}_fit": _rms(M, b, *fitted), f"{key}_held_out": _rms(M, b, *held_out)}
        found.append(row)
    return found


def may_be_left_out(name: str) -> bool:
    """Return whether a file of another program can lack an effect, which the table's recordings may determine."""
    this = effect(name.partition(".")[2])
    return this.name != "temperature_lag" and this.owner == Owner.SENSOR


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--units", type=int, default=2, help="of each effect")
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--figures", type=Path)
    options = parser.parse_args()
    effects = {name: limit for name, limit in at_limits().items() if may_be_left_out(name)}
    tasks = [
        (name, limit, 1000 * options.seed + 50 * number + k)
        for number, (name, limit) in enumerate(effects.items())
        for k in range(options.units)
    ]
    with ProcessPoolExecutor(options.processes) as pool:
        table = pd.DataFrame([row for rows in pool.map(errors_of, *zip(*tasks, strict=True)) for row in rows])
    figures = []
    for ours, best in (("file", "best"), ("of_recordings", "best"), ("file", "of_recordings")):
        ratios = pd.concat([table[f"{ours}_{on}"] / table[f"{best}_{on}"] for on in ("fit", "held_out")], axis=1)
        name = f"{WORDS[ours]} within 5 % of {WORDS[best]}"
        table[name] = ratios.min(axis=1)
        figures += share(name, table[name] <= MOST_WORSE)
        median, most = table[name].median(), table[name].max()
        print(" | ".join(map(str, figures[-1].cells)), f"| ratio of errors: median {median:.4f}, largest {most:.3f}")
    over_best, fit_over_best, over_fit = (table[figure.name] for figure in figures)
    shown = table[["effect", "part", "seed", "file_fit", "best_fit"]].assign(
        over_best=over_best, fit_over_best=fit_over_best, over_fit=over_fit
    )
    far = shown[(over_best > MOST_WORSE) | (over_fit > MOST_WORSE)]
    print(far.sort_values("over_best").to_string(index=False))
    write_figures(options.figures, figures)


if __name__ == "__main__":
    main()
