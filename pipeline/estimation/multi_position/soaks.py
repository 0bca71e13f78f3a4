"""Equations of a soak: the attitude is fixed while the temperature changes, so readings differ by effects alone.

    y_k - y_0 = z(T_k) - z(T_0)

with the mean readings y_k of the parts of a soak, and that of the part nearest to 25 degC, y_0, which is also a rest of
the fit; z are the effects at the specific force of that part. In one attitude a change of the bias along gravity is not
distinguished from one of the scale factor; in several it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core.records import BASE_COUNT
from pipeline.estimation.multi_position.model import EquationBlock, effect_readings, motion_of
from pipeline.estimation.rest_means import Rests, nearest_to_reference

if TYPE_CHECKING:
    from pipeline.core.records import Index, Values
    from pipeline.estimation.design import EffectColumns
    from pipeline.estimation.multi_position.model import State


@dataclass(frozen=True)
class Soaks:
    """The parts of the soaks of an accelerometer, without the reference of each."""

    rests: Rests  # (k,) parts
    reference: Rests  # (s,), one a soak
    of: Index  # (k,), the soak of each part

    def equations(self, state: State, force: Values, white: Values) -> EquationBlock:
        """Return the equations; ``force``: (s, 3), g, of the references; ``white``: (3,), noise of a sample."""
        rests, first = self.rests, self.reference
        variance, of_first = (r.variance(white) for r in (rests, first))
        error = np.sqrt(variance + of_first[self.of])
        at = motion_of(rests.time, force[self.of], np.zeros_like(rests.reading), rests.temperature, still=True)
        there = motion_of(first.time, force, np.zeros_like(force), first.temperature, still=True)
        z, z_first = (effect_readings("accelerometer", state.terms, motion, state.K) for motion in (at, there))
        residual = (rests.reading - first.reading[self.of] - z + z_first[self.of]) / error
        k, s = len(rests.time), len(first.time)
        bias, number = np.zeros((3, k, 3, k + s)), np.arange(k)
        for c in range(3):
            bias[c, number, c, number] = white[c] / error[:, c]
            bias[c, number, c, k + self.of] = -white[c] / error[:, c]
        same = (self.of[:, None] == self.of) & ~np.eye(k, dtype=bool)
        common = np.zeros((k, 3, k, 3))
        for c in range(3):
            shared = of_first[self.of, c] / error[:, c]
            common[:, c, :, c] = np.where(same, shared[:, None] / error[:, c], 0.0)

        def columns(term: EffectColumns) -> Values:
            Z, Z_first = (term.effect.columns("accelerometer", motion, state.K, term.values) for motion in (at, there))
            return np.asarray(((Z - Z_first[self.of]) / error[:, :, None]).reshape(3 * k, -1))

        times = (np.concatenate([getattr(r, name) for r in (rests, first)]) for name in ("start", "length"))
        return EquationBlock(
            residual.ravel(),
            np.zeros((3 * k, BASE_COUNT)),
            columns,
            error.ravel(),
            bias.reshape(3, 3 * k, k + s),
            (*times, np.concatenate([rests.recording, first.recording])),  # type: ignore[arg-type]
            scattered=True,
            common=common.reshape(3 * k, 3 * k),
        )


def parted(rests: Rests) -> tuple[Rests, Soaks | None]:
    """Return the rests of the fit, a soak with one of its parts, and the other parts of all soaks; None without one."""
    if not rests.soaked.any():
        return rests, None
    names = np.unique(rests.recording[rests.soaked])
    chosen = np.array(
        [
            own[nearest_to_reference(rests.temperature[own])]
            for own in (np.flatnonzero(rests.recording == n) for n in names)
        ]
    )
    other = rests.soaked.copy()
    other[chosen] = False
    parts = rests.select(other)
    return rests.select(~other), Soaks(parts, rests.select(chosen), np.searchsorted(names, parts.recording))
