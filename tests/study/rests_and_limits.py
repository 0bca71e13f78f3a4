"""Whether U covers the truth where few rests leave misalignments to the limit of the sensor file.

    python tests/study/rests_and_limits.py --units 300

Each axis reads up to ``cross_axis`` of each other, uniformly. Simulated by its own equations, without the package.
"""

from __future__ import annotations

import argparse
import sys
from typing import Any

import numpy as np
from unit_settings import settings_of, with_noise

from pipeline.core.errors import NotObservableError
from pipeline.core.records import Recording
from pipeline.estimation.accelerometer.nonlinear_least_squares import fit
from pipeline.estimation.stages import StageInput

LOWER = [0, 1, 2, 3, 6, 7, 9, 10, 11]  # of bias and matrix
KINDS = {"bias": [0, 1, 2], "scale factor": [3, 5, 8], "misalignment": [4, 6, 7]}  # of these nine
LEAN_DEG = {"six positions": 2.0, "near the faces": 5.0, "poor": 15.0}  # rms of each component; else at random
NOISE_G, WANDER_G, TAU_S = 4e-3, 1e-4, 100.0


def attitudes(kind: str, rng: np.random.Generator) -> np.ndarray:
    """Directions of the vertical in the body: six positions, or 8 to 12."""
    count = 6 if kind == "six positions" else int(rng.integers(8, 13))
    faces = np.concatenate([np.eye(3), -np.eye(3)])
    up = np.concatenate([faces, faces[rng.integers(0, 6, count - 6)]])
    up = up + np.radians(LEAN_DEG[kind]) * rng.normal(size=up.shape) if kind in LEAN_DEG else rng.normal(size=up.shape)
    return up / np.linalg.norm(up, axis=1, keepdims=True)


def recorded(up: np.ndarray, K: np.ndarray, bias: np.ndarray, rng: np.random.Generator) -> Recording:
    """Rests of 4 s with shaken moves of 1.5 s between them, at 50 Hz."""
    force, offset, wander = [], [], WANDER_G * rng.normal(size=3)
    blend, shake, keep = np.linspace(0, 1, 75)[:, None], 0.1 * np.sin(np.arange(75) / 2)[:, None], np.exp(-5.5 / TAU_S)
    for direction, following in zip(up, [*up[1:], up[-1]], strict=True):
        force += [np.tile(direction, (200, 1)), direction * (1 - blend) + following * blend + shake]
        wander = keep * wander + WANDER_G * np.sqrt(1 - keep**2) * rng.normal(size=3)
        offset.append(np.tile(wander, (275, 1)))
    truth = np.concatenate(force)
    reading = bias + truth @ K.T + np.concatenate(offset) + NOISE_G * rng.normal(size=truth.shape)
    return Recording("recording", "rests", None, np.arange(len(truth)) * 20_000_000, accelerometer=reading)


def coverage(kind: str, limit: float, units: int, seed: int) -> dict[str, Any]:
    """Return the share of parameters within U, and how many units were refused or have a misalignment by its limit."""
    sensor = {"bias_wander": WANDER_G, "wander_time_s": TAU_S, "cross_axis": limit}
    settings = settings_of(sensor={"accelerometer": sensor})
    inside, by_limit = [], 0
    for unit in range(units):
        rng = np.random.default_rng([seed, unit])
        up = attitudes(kind, rng)
        K = np.diag(1 + 0.03 * rng.uniform(-1, 1, 3)) + limit * rng.uniform(-1, 1, (3, 3)) * (1 - np.eye(3))
        bias, M = 0.05 * rng.uniform(-1, 1, 3), np.linalg.inv(K)
        try:
            found = fit(StageInput("accelerometer", with_noise([recorded(up, K, bias, rng)], settings), None, settings))
        except NotObservableError:
            continue
        L = np.linalg.cholesky((M.T @ M)[::-1, ::-1])[::-1, ::-1].T  # L^T L = M^T M
        error = np.concatenate([found.bias - bias, (found.matrix - L).ravel()])[LOWER]
        inside.append(np.abs(error) < np.array(found.to_json()["uncertainty_budget"]["expanded_uncertainty"])[LOWER])
        by_limit += bool(found.stages[-1].details["known_by_limit"])
    shares = {name: float(np.mean(np.array(inside)[:, own])) for name, own in KINDS.items()}
    return {"units": units, "refused": units - len(inside), "by limit": by_limit} | shares


def main() -> None:
    """Print a line for each kind of attitudes and each limit."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--units", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    for limit in (0.003, 0.02, 0.1):
        for kind in ("random", *LEAN_DEG):
            found = coverage(kind, limit, arguments.units, arguments.seed)
            sys.stdout.write(f"cross_axis {limit}, {kind}: {found}\n")


if __name__ == "__main__":
    main()
