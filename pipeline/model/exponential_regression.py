"""Exponential regression: the temperature of a log, smoothed by a line with exponentially decaying weights.

    T(t) = a,  (a, b) = argmin sum_i exp((t_i - t) / h) (T_i - a - b (t_i - t))^2,    t_i <= t

where h is the memory, s. A ramp passes without lag; the thermometer's noise is averaged. The line follows from five
sums, taken about the start ``o`` of the stretch of time in which the sample lies, a multiple of 4 h:

    S_k = sum_i exp((t_i - o) / h) (t_i - o)^k,   k = 0, 1, 2;    R_k likewise with T_i - 25 degC,   k = 0, 1

Each sample adds its terms in its turn; where a stretch begins, the sums are moved to its start. So single samples,
blocks and a whole log give the same numbers to the last bit.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from math import floor
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import InputError
from pipeline.model.effects.base import REFERENCE_TEMPERATURE

if TYPE_CHECKING:
    from numpy.typing import NDArray

STRETCH = 4.0  # memories: exp(4) costs two digits of the sums; shorter stretches cost time
FARTHEST = 50.0  # memories that time may go back: exp(50) of the sums is still far from overflow
DEGENERATE = 1e-15  # determinant over its scale, below which a double holds no slope


@dataclass
class ExponentialRegression:
    """Exponential regression of a temperature log.

    Attributes
    ----------
    memory : float, s
    """

    memory: float
    _stretch: float = field(default=float("nan"), init=False)
    _sums: tuple[float, ...] = field(default=(0.0,) * 5, init=False)

    def apply(self, time: NDArray[np.float64], temperature: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the line at each sample: (n,) array, degC; a row without a temperature (NaN) is given the line's.

        Raises
        ------
        InputError
            If time goes back by more than the line can bear.
        """
        if len(time) == 1:
            return np.array([self._next(float(time[0]), float(temperature[0]))])
        stretch = np.floor(time / (STRETCH * self.memory))
        cuts = np.flatnonzero(stretch[1:] != stretch[:-1]) + 1
        edges = [0, *cuts.tolist(), len(time)]
        out = np.empty(len(time))
        for start, end in itertools.pairwise(edges):
            self._move(float(stretch[start]), float(time[start]))
            out[start:end] = self._along(time[start:end], temperature[start:end])
        return out

    def _move(self, stretch: float, time: float) -> None:
        """Carry the sums over to the start of another stretch."""
        step = (stretch - self._stretch) * (STRETCH * self.memory)
        self._stretch = stretch
        if step == 0.0 or step != step or not self._sums[0]:  # noqa: PLR0124  (NaN: nothing is known yet)
            return
        if step < -FARTHEST * self.memory:
            raise InputError(f"time goes back by {-step:.6g} s or so to {time:.6f} s; sort the log, or cut it there")
        s0, s1, s2, r0, r1 = self._sums
        fade = float(np.exp(-step / self.memory))
        moved = (s0, s1 - step * s0, s2 - 2.0 * step * s1 + step * step * s0, r0, r1 - step * r0)
        self._sums = tuple(fade * s for s in moved)

    def _next(self, time: float, temperature: float) -> float:
        """Return the line at one sample: what ``_along`` does, without the cost of arrays."""
        self._move(float(floor(time / (STRETCH * self.memory))), time)
        at = time - self._stretch * (STRETCH * self.memory)
        s0, s1, s2, r0, r1 = self._sums
        if temperature == temperature:  # noqa: PLR0124  (not NaN)
            weight, above = float(np.exp(at / self.memory)), temperature - REFERENCE_TEMPERATURE
            leaned = weight * at
            s0, s1, s2 = s0 + weight, s1 + leaned, s2 + leaned * at
            r0, r1 = r0 + weight * above, r1 + leaned * above
            self._sums = (s0, s1, s2, r0, r1)
        if not s0 > 0.0:
            return float("nan")
        here1, here2 = s1 - at * s0, s2 - 2.0 * at * s1 + at * at * s0
        determinant = s0 * here2 - here1 * here1
        if determinant > DEGENERATE * s0 * s0 * self.memory * self.memory:
            return (here2 * r0 - here1 * (r1 - at * r0)) / determinant + REFERENCE_TEMPERATURE
        return r0 / s0 + REFERENCE_TEMPERATURE

    def _along(self, time: NDArray[np.float64], temperature: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the line within a stretch."""
        at = time - self._stretch * (STRETCH * self.memory)
        above = temperature - REFERENCE_TEMPERATURE
        missing = np.isnan(above)
        weight = np.exp(at / self.memory)
        if missing.any():
            weight[missing] = 0.0
            above[missing] = 0.0
        terms = np.empty((5, len(at) + 1))
        terms[:, 0] = self._sums
        terms[0, 1:] = weight
        np.multiply(weight, at, out=terms[1, 1:])
        np.multiply(terms[1, 1:], at, out=terms[2, 1:])
        np.multiply(weight, above, out=terms[3, 1:])
        np.multiply(terms[1, 1:], above, out=terms[4, 1:])
        sums = np.add.accumulate(terms, axis=1)[:, 1:]
        self._sums = tuple(sums[:, -1].tolist())
        return _line_at(sums, at, self.memory)


def _line_at(sums: NDArray[np.float64], at: NDArray[np.float64], memory: float) -> NDArray[np.float64]:
    """Return the value at ``at`` of the lines with these sums; of one known sample, its temperature."""
    s0, s1, s2, r0, r1 = sums
    here1 = s1 - at * s0
    here2 = s2 - 2.0 * at * s1 + at * at * s0
    determinant = s0 * here2 - here1 * here1
    sloping = determinant > DEGENERATE * s0 * s0 * memory * memory
    value = np.divide(r0, s0, out=np.full(len(at), np.nan), where=s0 > 0)
    line = here2 * r0 - here1 * (r1 - at * r0)
    np.divide(line, determinant, out=value, where=sloping)
    return np.asarray(value + REFERENCE_TEMPERATURE, np.float64)
