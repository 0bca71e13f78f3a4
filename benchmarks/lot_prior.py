"""Errors and intervals of calibrations with the prior of their lot (``combine=lot``), over simulated lots.

    nice python benchmarks/lot_prior.py [--lots 15] [--units 40] [--seed 1] [--orthogonality 8e-4] [--outliers 200]
        [--plot FILE.svg]

A lot is drawn about the nominal MPU-6050: each parameter of the accelerometer has a standard deviation that is a
multiple of U, its expanded uncertainty by the full procedure, turns about three axes with stops every 15 deg (72
positions). The product's simulator records each unit on one table, whose axes' errors the units of a lot share, with
stops every 15, 30, 60 or 90 deg. ``reference_least_squares`` calibrates it, and the functions of ``gather`` add the
prior of the lot. The errors of a fit hardly depend on the parameters, so that those of one set of units are used for
all spreads; ``--anew`` simulates each spread by itself.

Prints, of the errors of bias and matrix over U of the full procedure, the root mean square without and with the prior,
the ratio of the two with a 95 % interval over lots, and the share inside the stated 95 % interval with its standard
error over lots. Then outliers, a tenth of each lot, that differ from the mean of the lot by 5 to 8 of its standard
deviations in one parameter: how many have no prior.
"""

from __future__ import annotations

import argparse
import os
import time
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

from pathlib import Path

import numpy as np

from pipeline.output.pages.combined import calibration_with_prior, estimates, priors_of
from pipeline.simulation.campaign import simulate_unit
from pipeline.simulation.description import UnitDescription, shipped_settings
from pipeline.unit import run_checked

JSON = dict[str, Any]
STEPS_DEG = {72: 15.0, 36: 30.0, 18: 60.0, 12: 90.0}  # positions to the angle between stops
SPREADS = (0.3, 0.5, 1.0, 3.0, 10.0)  # standard deviation of the lot over U of the full procedure
COURSE = {"dwell_s": 1.2, "warm_up_rest_s": 10.0, "static_s": 0.0, "validation_s": 0.0, "pause_s": 10.0}
NOMINAL = np.concatenate([[0.01, -0.02, 0.015], np.eye(3).ravel()])
SENSOR, METHOD = "accelerometer", "reference_least_squares"


def calibrated(
    truth: np.ndarray, positions: int, orthogonality: float, direction: np.ndarray, numbers: list[int]
) -> JSON:
    """Return the published part of a simulated unit, as far as the prior reads it."""
    unit = UnitDescription(
        f"U{numbers[1]}",
        course={**COURSE, "step_deg": STEPS_DEG[positions]},
        accelerometer={"bias": truth[:3].tolist(), "matrix": truth[3:].reshape(3, 3).tolist()},
        imperfections={"direction_deg": direction.tolist()},
        recordings=["accel_x", "accel_y", "accel_z"],
    )
    recordings, _ = simulate_unit(unit, *numbers)
    shipped = shipped_settings(sensor="mpu6050", table="acutronic")
    settings = shipped.replaced(table=shipped.table.replaced(orthogonality_deg=orthogonality))
    part = run_checked(recordings, {SENSOR: [METHOD]}, settings).fits[SENSOR].to_json()
    same = {"sensor": "mpu6050", "table": "acutronic", "procedure": "three_axis_turns", "methods": {SENSOR: METHOD}}
    return {"unit": unit.unit, **same, SENSOR: part, "gyroscope": None}


def bias_and_matrix(part: JSON) -> np.ndarray:
    return np.concatenate([part["bias"], np.ravel(part["matrix"])])


class Units:
    """Simulated units of a lot, as they are calibrated without the prior."""

    def __init__(self, truths: np.ndarray, positions: int, orthogonality: float, seed: int) -> None:
        direction = orthogonality * np.random.default_rng([seed, 7]).standard_normal((3, 2))
        self.truths = truths
        self.documents = [calibrated(t, positions, orthogonality, direction, [seed, i]) for i, t in enumerate(truths)]

    def moved(self, truths: np.ndarray) -> list[JSON]:
        """Return the documents of units with other parameters, with the same errors."""
        moved = []
        for document, change in zip(self.documents, truths - self.truths, strict=True):
            x = bias_and_matrix(document[SENSOR]) + change
            part = document[SENSOR] | {"bias": x[:3].tolist(), "matrix": x[3:].reshape(3, 3).tolist()}
            moved.append(document | {SENSOR: part})
        return moved


class Lot:
    """Errors and expanded uncertainties of the units of a lot, without and with the prior; which are outliers."""

    def __init__(self, truths: np.ndarray, documents: list[JSON]) -> None:
        priors, _ = priors_of([e for d in documents for e in estimates({}, d, {})])
        own = [{SENSOR: priors[d["unit"], SENSOR]} for d in documents]
        both = documents, [calibration_with_prior(d, p) or d for d, p in zip(documents, own, strict=True)]
        self.errors = [np.stack([bias_and_matrix(d[SENSOR]) for d in each]) - truths for each in both]
        self.U = [np.stack([bias_and_matrix(d[SENSOR]["expanded_uncertainty"]) for d in each]) for each in both]
        self.outlier = np.array([p[SENSOR].outlier for p in own])


def row(lots: list[Lot], U: np.ndarray) -> JSON:
    squares = np.array([[np.mean((e / U) ** 2) for e in lot.errors] for lot in lots])
    inside = np.array([[np.mean(np.abs(e) <= u) for e, u in zip(lot.errors, lot.U, strict=True)] for lot in lots])
    drawn = squares[np.random.default_rng(0).integers(0, len(lots), (2000, len(lots)))].mean(axis=1)
    return {
        "rms": np.sqrt(squares.mean(axis=0)),
        "ratio": np.quantile(np.sqrt(drawn[:, 1] / drawn[:, 0]), [0.025, 0.975]),
        "inside": 100.0 * inside.mean(axis=0),
        "error": 100.0 * inside.std(axis=0) / np.sqrt(len(lots)),
        "width": float(np.mean([np.mean(lot.U[1] / lot.U[0]) for lot in lots])),
        "refused": 100.0 * float(np.mean([lot.outlier.mean() for lot in lots])),
    }


def truths_of(rng: np.random.Generator, deviation: np.ndarray, units: int) -> np.ndarray:
    """Return bias and matrix of the units of a lot, whose mean is drawn, too."""
    return NOMINAL + deviation * (3.0 * rng.standard_normal(12) + rng.standard_normal((units, 12)))


def outliers(
    units: list[Units], deviation: np.ndarray, count: int, rng: np.random.Generator
) -> tuple[list[bool], list[bool]]:
    """Return which of ``count`` outliers have no prior, and which of the other units of their lots."""
    found: list[bool] = []
    others: list[bool] = []
    while len(found) < count:
        lot = units[len(found) % len(units)]
        truths = truths_of(rng, deviation, len(lot.truths))
        away = len(truths) // 10
        which, mean = rng.integers(0, 12, away), truths[away:].mean(axis=0)
        size = rng.uniform(5.0, 8.0, away) * rng.choice([-1.0, 1.0], away)
        truths[np.arange(away), which] = mean[which] + size * deviation[which]
        refused = Lot(truths, lot.moved(truths)).outlier.tolist()
        found, others = found + refused[:away], others + refused[away:]
    return found[:count], others


def drawing(curves: dict[float, list[list[float]]]) -> str:
    """Return the errors over the number of positions as SVG: a panel for each spread, dashed without the prior."""
    wide, high, left, top, gap = 150.0, 180.0, 62.0, 46.0, 14.0
    x_of = {n: 14.0 + (wide - 28.0) * k / (len(STEPS_DEG) - 1) for k, n in enumerate(STEPS_DEG)}
    largest = max(value for points in curves.values() for _, *values in points for value in values)
    top_value = np.ceil(10.0 * largest) / 10.0
    out = []
    for k, (spread, points) in enumerate(curves.items()):
        x0 = left + k * (wide + gap)
        out.append(f'<text x="{x0}" y="{top - 8}" font-weight="bold">spread {spread:g} U</text>')
        out.append(f'<rect x="{x0}" y="{top}" width="{wide}" height="{high}" fill="none" stroke="#9ca3af"/>')
        for tick in np.arange(0.0, top_value + 0.01, 0.2):
            y = top + high * (1.0 - tick / top_value)
            out.append(f'<path d="M{x0} {y:.1f}h{wide}" stroke="#e5e7eb"/>')
            if k == 0:
                out.append(f'<text x="{x0 - 6}" y="{y + 4:.1f}" text-anchor="end">{tick:.1f}</text>')
        full = top + high * (1.0 - points[0][1] / top_value)
        out.append(f'<path d="M{x0} {full:.1f}h{wide}" stroke="#1d4ed8" stroke-dasharray="1 3"/>')
        for column, style in ((1, 'stroke="#6b7280" stroke-dasharray="5 4"'), (2, 'stroke="#b45309" stroke-width="2"')):
            places = [(x0 + x_of[int(p[0])], top + high * (1.0 - p[column] / top_value)) for p in points]
            line = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
            out.append(f'<polyline points="{line}" fill="none" {style}/>')
        out += [f'<text x="{x0 + x}" y="{top + high + 16}" text-anchor="middle">{n}</text>' for n, x in x_of.items()]
    width = left + len(curves) * (wide + gap)
    out.append(
        f'<text x="{width / 2}" y="{top + high + 36}" text-anchor="middle">positions (72: the full procedure)</text>'
    )
    words = "rms error of bias and matrix over U of the full procedure; dashed: without the prior, solid: with it"
    words += "; dots: the full procedure without it"
    out.append(f'<text x="{left}" y="16">{words}</text>')
    size = f'width="{width:g}" height="{top + high + 46:g}" viewBox="0 0 {width:g} {top + high + 46:g}"'
    body = "\n".join(out)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-family="sans-serif" font-size="12" fill="#1f2937">\n'
        f'<rect width="100%" height="100%" fill="#ffffff"/>\n{body}\n</svg>\n'
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lots", type=int, default=20, help="of each row")
    parser.add_argument("--units", type=int, default=50, help="of each lot")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--orthogonality", type=float, default=8.0e-4, help="of the table, deg, standard deviation")
    parser.add_argument("--outliers", type=int, default=200, help="for each spread and two numbers of positions")
    parser.add_argument("--anew", action="store_true", help="simulate each spread by itself")
    parser.add_argument("--plot", type=Path, help="SVG file for the errors over the positions")
    a = parser.parse_args()
    start = time.process_time()
    nominal = np.tile(NOMINAL, (a.units, 1))
    seeds = range(1000 * a.seed, 1000 * a.seed + a.lots)
    known = {n: [Units(nominal, n, a.orthogonality, seed) for seed in seeds] for n in STEPS_DEG}
    U = np.mean(
        [bias_and_matrix(d[SENSOR]["expanded_uncertainty"]) for lot in known[72] for d in lot.documents], axis=0
    )
    print(f"{a.lots} lots of {a.units} units a row, seed {a.seed}, orthogonality {a.orthogonality:g} deg")
    print("spread/U, positions: rms without, with; ratio (95 %); inside without, with; U with over without; refused")
    curves: dict[float, list[list[float]]] = {}
    for spread in SPREADS:
        for positions, units in known.items():
            lots, rng = [], np.random.default_rng([a.seed, int(10 * spread), positions])
            for one, seed in zip(units, seeds, strict=True):
                truths = truths_of(rng, spread * U, a.units)
                documents = Units(truths, positions, a.orthogonality, seed).documents if a.anew else one.moved(truths)
                lots.append(Lot(truths, documents))
            f = row(lots, U)
            curves.setdefault(spread, []).append([positions, *f["rms"]])
            inside = ", ".join(f"{v:.1f} +- {e:.1f} %" for v, e in zip(f["inside"], f["error"], strict=True))
            low, high = f["ratio"]
            print(
                f"{spread:>4} {positions:>3}: {f['rms'][0]:.3f}, {f['rms'][1]:.3f}; {low:.3f} to {high:.3f}; {inside}; "
                f"{f['width']:.2f}; {f['refused']:.1f} %",
                flush=True,
            )
        for positions in (72, 18) if a.outliers else ():
            rng = np.random.default_rng([a.seed, int(10 * spread), positions, 1])
            found, others = outliers(known[positions], spread * U, a.outliers, rng)
            share = 100.0 * float(np.mean(others))
            print(
                f"     {positions:>3}: {sum(found)} of {len(found)} outliers have no prior; of others {share:.1f} %",
                flush=True,
            )
    print(f"{time.process_time() - start:.0f} s CPU")
    if a.plot:
        a.plot.write_text(drawing(curves), encoding="utf-8")


if __name__ == "__main__":
    main()
