"""Rests that ``guide`` proposes against random attitudes and ``orientations_24``, for the same expanded uncertainty.

    python tests/study/guided_rests.py --units 200 --seed 7         (three minutes)

Each unit (MPU-6050: bias, scale factors, cross-axis sensitivity, white noise and bias wander by its sensor file) is
drawn once for each of the three: rests of equal length at 20 Hz, moves of 2.5 s, reading = bias + K f + wander +
noise, nothing of the product's own simulation. ``orientations_24`` sets the goal, the unit's largest expanded
uncertainty of bias (g) and matrix. The other two stop at the first rest with which the published fit reaches it. A hand
sets an attitude to 1 deg (standard deviation of each of two tilts). The intervals (95 %) are of the ratio of the mean
numbers, by bootstrap over the units.
"""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

import numpy as np
from scipy.signal import lfilter

from pipeline.app.guide import fitted_by_hand, progress_of, propose
from pipeline.core.records import Recording, coverage_factor
from pipeline.simulation.description import shipped_settings

if TYPE_CHECKING:
    from pipeline.app.guide import GuideProgress

RATE_HZ, MOVE_S, SETTLES_S = 20.0, 2.5, 0.5  # a rest is found half a second late
HAND_DEG = 1.0  # as configs/table/hand.yaml
MOST = 90  # rests, after which a unit counts as never reaching the goal
TRIALS = 4000  # of the bootstrap: its limits are then stable to 0.1 %
BY_HAND = shipped_settings(sensor="mpu6050", table="hand")
SHEET = BY_HAND.sensor.accelerometer

Array = np.ndarray


class Unit:
    """One unit that is moved by hand, and the log so far."""

    def __init__(self, seed: tuple[int, ...], dwell: float) -> None:
        rng = np.random.default_rng(seed[:2])
        self.bias = 0.5 * SHEET.bias * rng.uniform(-1, 1, 3)
        self.gain = np.eye(3) + np.diag(0.5 * SHEET.scale_factor * rng.uniform(-1, 1, 3))
        self.gain += (1 - np.eye(3)) * 0.5 * SHEET.cross_axis * rng.uniform(-1, 1, (3, 3))
        self.rng, self.dwell = np.random.default_rng(seed), dwell
        self.wander = SHEET.bias_wander * self.rng.standard_normal(3)
        self.log: list[Array] = []
        self.up: Array | None = None

    def rest(self, wanted: Array) -> None:
        """Move to an attitude, as a hand does, and rest there."""
        up = wanted / np.linalg.norm(wanted) + np.radians(HAND_DEG) * self.rng.standard_normal(3)
        up /= np.linalg.norm(up)
        force = np.tile(up, (round((self.dwell + SETTLES_S) * RATE_HZ), 1))
        if self.up is not None:
            count = round(MOVE_S * RATE_HZ)
            share = (np.arange(count) + 0.5) / count
            across = up - (up @ self.up) * self.up
            size = np.linalg.norm(across)
            angle = np.arctan2(size, up @ self.up) * (share**2 * (3 - 2 * share))[:, None]
            move = np.cos(angle) * self.up + np.sin(angle) * across / max(size, 1e-9)
            shake = 0.05 * np.sin(np.pi * share)[:, None] * self.rng.standard_normal((count, 3))
            force = np.concatenate([move + shake, force])
        keep = np.exp(-1 / RATE_HZ / SHEET.wander_time_s)
        steps = SHEET.bias_wander * np.sqrt(1 - keep**2) * self.rng.standard_normal(force.shape)
        wander, _ = lfilter([1.0], [1.0, -keep], steps, axis=0, zi=keep * self.wander[None])
        self.wander = wander[-1]
        white = SHEET.noise_density * np.sqrt(RATE_HZ / 2) * self.rng.standard_normal(force.shape)
        reading = self.bias + force @ self.gain.T + wander + white
        self.log.append(np.round(reading * SHEET.counts_per_unit) / SHEET.counts_per_unit)
        self.up = up

    def inside(self, progress: GuideProgress) -> float:
        """Return how many of the nine parameters are inside their expanded uncertainty."""
        product = np.linalg.inv(self.gain @ self.gain.T)  # L^T L, of the lower triangular L with the same lengths
        L = np.linalg.cholesky(product[::-1, ::-1])[::-1, ::-1].T
        error = progress.values - np.concatenate([self.bias, L[np.tril_indices(3)]])
        u = np.sqrt(progress.inflation * np.diag(np.linalg.inv(progress.information)))
        return float(np.count_nonzero(np.abs(error) <= coverage_factor(progress.freedom) * u))

    def recording(self) -> Recording:
        force = np.concatenate(self.log)
        time = np.round(np.arange(len(force)) / RATE_HZ * 1e9).astype(np.int64)
        return Recording("recording", "rests", None, time, accelerometer=force)


def of_unit(seed: int, number: int, dwell: float, held_out: int) -> dict[str, float]:
    """Return the goal that orientations_24 sets, in g, and the rests by which the other two reach it."""
    settings = BY_HAND.replaced(procedure=BY_HAND.procedure.replaced(holdout_every=held_out))
    fixed, guided, random = (Unit((seed, number, k), dwell) for k in range(3))
    angles = np.radians(np.arange(8) * 45.0)
    for axis in range(3):
        for angle in angles:
            fixed.rest(np.roll([0.0, np.cos(angle), np.sin(angle)], axis))
    of_fixed = progress_of(fitted_by_hand([fixed.recording()], settings), settings, dwell)
    goal = of_fixed.expanded
    found = {"goal": goal, "guided": float(MOST), "random": float(MOST), "inside fixed": fixed.inside(of_fixed)}
    wanted = np.array([0.0, 0.0, 1.0])
    for count in range(1, MOST):
        guided.rest(wanted)
        progress = progress_of(fitted_by_hand([guided.recording()], settings), settings, dwell)
        if progress.expanded <= goal:
            found |= {"guided": float(count), "inside guided": guided.inside(progress)}
            break
        wanted = propose(progress, goal).up
    attitudes = np.random.default_rng((seed, number, 3)).standard_normal((MOST, 3))
    for count, wanted in enumerate(attitudes, start=1):
        random.rest(wanted)
        progress = progress_of(fitted_by_hand([random.recording()], settings), settings, dwell)
        if progress.expanded <= goal:
            found |= {"random": float(count), "inside random": random.inside(progress)}
            break
    return found


def interval(one: Array, two: Array | float, rng: np.random.Generator) -> tuple[float, float, float]:
    """Return the ratio of the means and its 95 % interval over the units."""
    two = np.broadcast_to(two, one.shape)
    pick = rng.integers(len(one), size=(TRIALS, len(one)))
    ratios = one[pick].mean(axis=1) / two[pick].mean(axis=1)
    low, high = np.quantile(ratios, [0.025, 0.975])
    return float(one.mean() / two.mean()), float(low), float(high)


def say(text: str) -> None:
    sys.stdout.write(f"{text}\n")


def main() -> None:
    """Print the mean numbers of rests, their ratios with intervals, and how many units reach no goal."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--units", type=int, default=200)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--dwell", type=float, default=4.0)
    parser.add_argument("--held-out", type=int, default=3, help="every k-th rest, as the procedures do; 0: none")
    arguments = parser.parse_args()
    rows = [of_unit(arguments.seed, k, arguments.dwell, arguments.held_out) for k in range(arguments.units)]
    goal, guided, random = (np.array([row[name] for row in rows]) for name in ("goal", "guided", "random"))
    rng = np.random.default_rng(0)
    say(f"n = {len(rows)} units, dwell {arguments.dwell:g} s, every {arguments.held_out}. rest held out")
    say(f"expanded uncertainty of orientations_24: median {1e3 * np.median(goal):.3f} mg")
    for name, values in (("guided", guided), ("random", random)):
        low, middle, high = np.quantile(values, [0.05, 0.5, 0.95])
        never = int(np.count_nonzero(values >= MOST))
        say(f"{name}: mean {values.mean():.1f} rests, median {middle:.0f}, 5 to 95 % {low:.0f} to {high:.0f}; "
              f"{never} units need {MOST} or more")  # fmt: skip
    for name in ("fixed", "guided", "random"):
        inside = np.array([row[f"inside {name}"] for row in rows if f"inside {name}" in row])
        share, low, high = interval(inside, 9.0, rng)
        say(f"{name}: {100 * share:.1f} % of the parameters inside U ({100 * low:.1f} to {100 * high:.1f} %)")
    for name, other in (("random attitudes", random), ("orientations_24", 24.0)):
        ratio, low, high = interval(guided, other, rng)
        worse = int(np.count_nonzero(guided > other))
        say(f"guided / {name}: {100 * ratio:.1f} % of the rests ({100 * low:.1f} to {100 * high:.1f} %); "
              f"more rests in {worse} units")  # fmt: skip


if __name__ == "__main__":
    main()
