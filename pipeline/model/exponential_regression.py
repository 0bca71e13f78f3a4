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
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import InputError
from pipeline.model.effects.base import REFERENCE_TEMPERATURE

if TYPE_CHECKING:
    from numpy.typing import NDArray

STRETCH = 4.0  # memories: exp(4) costs two digits of the sums; shorter stretches cost time
FARTHEST = 50.0  # memories that time may go back: exp(50) of the sums is still far from overflow
DEGENERATE = 1e-15  # determinant over its scale, below which a double holds no slope


class ExponentialRegression:
    """Exponential regression of a temperature log with a memory in s."""

    def __init__(self, memory: float) -> None:
        self.memory = memory
        self._stretch = float("nan")
        self._sums = np.zeros(5)

    def apply(self, time: NDArray[np.float64], temperature: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the line at each sample: (n,) array, degC; a row without a temperature (NaN) is given the line's.

        Raises
        ------
        InputError
            If time goes back by more than the line can bear.
        """
        stretch = np.floor(time / (STRETCH * self.memory))
        cuts = np.flatnonzero(stretch[1:] != stretch[:-1]) + 1
        out = np.empty(len(time))
        for start, end in itertools.pairwise([0, *cuts.tolist(), len(time)]):
            self._move(float(stretch[start]), float(time[start]))
            out[start:end] = self._along(time[start:end], temperature[start:end])
        return out

    def _move(self, stretch: float, time: float) -> None:
        """Carry the sums over to the start of another stretch."""
        step = (stretch - self._stretch) * (STRETCH * self.memory)
        self._stretch = stretch
        if not abs(step) > 0.0 or not self._sums[0]:  # NaN: nothing is known yet
            return
        if step < -FARTHEST * self.memory:
            raise InputError(f"time goes back by {-step:.6g} s or so to {time:.6f} s; sort the log, or cut it there")
        s0, s1, s2, r0, r1 = self._sums
        moved = (s0, s1 - step * s0, s2 - 2.0 * step * s1 + step * step * s0, r0, r1 - step * r0)
        self._sums = np.exp(-step / self.memory) * np.array(moved)

    def _along(self, time: NDArray[np.float64], temperature: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the line within a stretch; of one known sample, its temperature."""
        at = time - self._stretch * (STRETCH * self.memory)
        missing = np.isnan(temperature)
        above = np.where(missing, 0.0, temperature - REFERENCE_TEMPERATURE)
        weight = np.where(missing, 0.0, np.exp(at / self.memory))
        leaned = weight * at
        terms = np.array([weight, leaned, leaned * at, weight * above, leaned * above])
        sums = np.add.accumulate(np.column_stack([self._sums, terms]), axis=1)[:, 1:]
        self._sums = sums[:, -1]
        s0, s1, s2, r0, r1 = sums
        first, second = s1 - at * s0, s2 - 2.0 * at * s1 + at * at * s0
        determinant = s0 * second - first * first
        sloping = determinant > DEGENERATE * s0 * s0 * self.memory * self.memory
        value = np.divide(r0, s0, out=np.full(len(at), np.nan), where=s0 > 0)
        np.divide(second * r0 - first * (r1 - at * r0), determinant, out=value, where=sloping)
        return np.asarray(value + REFERENCE_TEMPERATURE, np.float64)
