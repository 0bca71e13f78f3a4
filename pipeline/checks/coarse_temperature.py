"""Estimate the temperature between the steps of a coarse thermometer, from all recordings of a unit.

A thermometer that reads in steps h has an error of up to h / 2 as long as the temperature stays between two steps.
Smoothing cannot remove so long an error of a regressor: a warm-up, which needs no thermometer, would then explain a
bias that follows the temperature better than the temperature does. But the time of each step is known, and

    q_i = h round((T(t_i) + s e_i) / h),    T(t) = c exp(-t / theta) + m(t),    m'' white noise of density lambda

with readings q, white noise e, and a body that settles after power-on in a room that changes slowly. T maximises the
posterior; s, lambda and theta (or c = 0) maximise its evidence by Laplace's approximation.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.core.records import Note

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.core.records import Recording, Values

CELL_S = 10.0  # between the nodes of T, a line between them: of 5 degC with theta = 300 s it misses 1e-3 degC
CELL_PARTS = 4  # parts of a cell; equal readings in a part become one
MAX_TEMPERATURE_NODES = 4000  # 11 h; a longer log is left as it is
ONE_STEP = 0.99  # least share of the changes that are of one step: larger noise dithers the steps, and averages out
NOISE_GRID = (0.02, 0.04, 0.07, 0.12, 0.2)  # s over h
DRIFT_DENSITIES = tuple(10.0 ** np.arange(-12.0, -3.0))  # lambda, degC^2 / s^3: 0.03 to 30 degC in an hour
THERMAL_TIME_CONSTANTS_S = (None, *np.geomspace(50.0, 1600.0, 21))  # theta: of packages on boards to that of housings
AMPLITUDE_DEGC = 10.0  # standard deviation of c and of the level, about the mean
FEWEST_CHANGES = 2  # of the reading: without them nothing is known between the steps
# of Newton's method; change of the log posterior; share of a step
MAX_NEWTON_ITERATIONS, SETTLED_LOG_POSTERIOR, MIN_STEP_SHARE = 40, 1e-3, 1e-3
DOUBLE_ROUNDING = 1e-12  # relative: some thousand roundings of a double


def refined(recordings: Sequence[Recording]) -> list[Recording]:
    """Return the recordings of a unit; with a coarse thermometer, with the estimated temperature and a note."""
    known = [r for r in recordings if r.temperature is not None and np.isfinite(r.temperature).all()]
    step = _step(known)
    if step == 0.0 or len(known) < len(recordings) or not all(r.clock_shared for r in known):
        return list(recordings)
    first = min(float(r.time[0]) for r in known)
    if max(float(r.time[-1]) for r in known) - first > MAX_TEMPERATURE_NODES * CELL_S:
        return list(recordings)
    time, reading = (np.concatenate([getattr(r, name) for r in known]) for name in ("time", "temperature"))
    curve = _Curve(time - first, reading, step).best()
    nodes = first + CELL_S * np.arange(len(curve))
    detail = f"the thermometer reads in steps of {step:.3g} degC; between them the temperature is estimated"
    out = []
    for r in recordings:
        note = Note("N-STEPS", r.samples, 0, r.samples, f"{r.name}: {detail}")
        fine = np.interp(r.time, nodes, curve)
        out.append(replace(r, temperature=fine, notes=(*r.notes, note)))
    return out


def _step(recordings: Sequence[Recording]) -> float:
    """Return the step of a thermometer with a smaller noise, degC; 0 for others and for a constant temperature."""
    changes = [np.abs(np.diff(np.asarray(r.temperature))) for r in recordings]
    each = np.concatenate([np.zeros(1), *changes])
    moved = each[each > 0.0]
    if len(moved) < FEWEST_CHANGES or 2 * len(moved) > len(each):
        return 0.0
    step = float(moved.min())
    return step if np.mean(moved < 1.5 * step) >= ONE_STEP else 0.0


class _Curve:
    """The curve T through nodes, fitted to readings; equal readings in a quarter of a cell are one with a count."""

    def __init__(self, time: Values, reading: Values, step: float) -> None:
        place, self.mean, self.step = time / CELL_S, float(reading.mean()), step
        keys = np.stack([np.floor(place * CELL_PARTS), np.rint(reading / step)], axis=1)
        _, inverse, count = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
        place, value = (np.bincount(inverse.ravel(), v) / count for v in (place, reading - self.mean))
        self.value, self.count, self.k = value, count.astype(float), place.astype(int)
        self.shares = 1.0 - place + self.k, place - self.k  # weights of the nodes k and k + 1
        self.nodes = int(self.k.max()) + 2
        self.last: tuple[Values, float] = np.interp(np.arange(self.nodes), self.k, value), 0.0
        self.known: dict[tuple[float, float, float | None], tuple[float, Values]] = {}

    def best(self) -> Values:
        """Return T at the nodes with the most probable noise, density and time of settling, by cyclic search."""
        noise, density, settling, before = NOISE_GRID[2], DRIFT_DENSITIES[4], THERMAL_TIME_CONSTANTS_S[12], None
        while (noise, density, settling) != before:
            before = noise, density, settling
            pairs = [(d, s) for d in DRIFT_DENSITIES for s in dict.fromkeys([settling, *THERMAL_TIME_CONSTANTS_S[::4]])]
            density, settling = max(pairs, key=lambda pair: self._evidence(noise, *pair))
            settling = max(THERMAL_TIME_CONSTANTS_S, key=lambda each: self._evidence(noise, density, each))
            noise = max(NOISE_GRID, key=lambda each: self._evidence(each, density, settling))
        return self.mean + self.known[noise, density, settling][1]

    def _evidence(self, *key: Any) -> float:  # noqa: ANN401
        if key not in self.known:
            self.known[key] = self._posterior(*key)
        return self.known[key][0]

    def _posterior(self, noise: float, density: float, settling: float | None) -> tuple[float, Values]:
        """Return the log evidence up to a constant, and T minus the mean, by Newton's method from the last result."""
        from scipy.linalg import cholesky_banded, solveh_banded  # noqa: PLC0415  (0.1 s that only this log pays)

        n, stiff, least = self.nodes, 1.0 / (density * CELL_S**3), AMPLITUDE_DEGC**-2
        prior = np.zeros((3, n))  # of m, by diagonals
        for node, weights in enumerate(((1.0, -2.0, 1.0), (4.0, -2.0, 0.0), (1.0, 0.0, 0.0))):
            prior[:, node : n - 2 + node] += stiff * np.array(weights)[:, None]
        prior[0] += least
        decay = np.zeros(n) if settling is None else np.exp(-CELL_S * np.arange(n) / settling)
        at_decay = self._at(decay)

        def objective(m: Values, c: float) -> tuple[float, Values, Values]:
            log, first, second = self._likelihood(self._at(m) + c * at_decay, noise * self.step)
            return log - 0.5 * (stiff * float(np.sum(np.diff(m, 2) ** 2)) + least * float(m @ m + c * c)), first, second

        m, c = self.last
        gained = float("inf")
        value, first, second = objective(m, c)
        for _ in range(MAX_NEWTON_ITERATIONS):
            band, (left, right) = prior.copy(), self.shares
            band[0] += np.bincount(self.k, second * left**2, n) + np.bincount(self.k + 1, second * right**2, n)
            band[1] += np.bincount(self.k, second * left * right, n)
            cross = self._back(second * at_decay)
            bent = stiff * np.diff(m, 2)
            slope = self._back(first) - least * m - np.convolve(bent, [1.0, -2.0, 1.0])
            solved = solveh_banded(band, np.stack([slope, cross], axis=1), lower=True)
            of_c = float(second @ at_decay**2 + least - cross @ solved[:, 1])  # the Schur complement
            to_c = float(first @ at_decay - least * c - cross @ solved[:, 0]) / of_c
            to_m: Values = solved[:, 0] - to_c * solved[:, 1]
            share = 1.0
            if gained < SETTLED_LOG_POSTERIOR:
                break
            while (new := objective(m + share * to_m, c + share * to_c))[0] < value and share > MIN_STEP_SHARE:
                share *= 0.5
            gained = new[0] - value
            if gained > 0.0:
                m, c, (value, first, second) = m + share * to_m, c + share * to_c, new
        self.last = m, c
        logarithms = [2.0 * float(np.sum(np.log(cholesky_banded(b, lower=True)[0]))) for b in (band, prior)]
        return value - 0.5 * (logarithms[0] - logarithms[1] + float(np.log(of_c / least))), m + c * decay

    def _at(self, nodes: Values) -> Values:
        """Return the values of a curve through the nodes at the readings."""
        return np.asarray(self.shares[0] * nodes[self.k] + self.shares[1] * nodes[self.k + 1])

    def _back(self, values: Values) -> Values:
        """Return the transpose of ``_at``: the weighted sums of values at the readings, by node."""
        left, right = (share * values for share in self.shares)
        return np.asarray(np.bincount(self.k, left, self.nodes) + np.bincount(self.k + 1, right, self.nodes))

    def _likelihood(self, curve: Values, noise: float) -> tuple[float, Values, Values]:
        """Return log L of a curve at the readings, and its first and negative second derivatives there."""
        from scipy.special import log_ndtr  # noqa: PLC0415  (as above)

        a, b = ((self.value + side * self.step - curve) / noise for side in (-0.5, 0.5))
        above = a > 0.0  # there the other tail, in which the difference keeps its digits
        a, b = np.where(above, -b, a), np.where(above, -a, b)
        low, high = log_ndtr(a), log_ndtr(b)
        log = high + np.log1p(-np.exp(np.minimum(low - high, -DOUBLE_ROUNDING)))
        at_a, at_b = (np.exp(-0.5 * x * x - 0.5 * np.log(2.0 * np.pi) - log) for x in (a, b))
        first = (at_a - at_b) / noise
        second = np.maximum((at_b * b - at_a * a) / noise**2 + first**2, 0.0)
        return float(self.count @ log), self.count * np.where(above, -first, first), self.count * second
