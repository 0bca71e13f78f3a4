"""Correct readings by the steps of a method, each of which acts on the output of the step before.

The steps act on row vectors v. Published is ``{"steps": [...]}`` with one entry for each:

    {"subtract": b}                                          v - b
    {"matrix": M}                                            v M^T, that is M v as a column
    {"two_sided": {"positive": p, "negative": n, "switch_at": s}}   p_i v_i if v_i > s_i, else n_i v_i

where b, p, n, s are (3,) and M is (3, 3).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from pipeline.core.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from imu_logs.log import Values

STEP_KINDS = "subtract, matrix, two_sided"


@dataclass(frozen=True)
class Subtract:
    """The step ``v - b``."""

    offset: Values  # (3,)

    def apply(self, readings: Values) -> Values:
        """Apply the step to (n, 3) readings."""
        return readings - self.offset

    def to_json(self) -> dict[str, Any]:
        """Return the step as published."""
        return {"subtract": self.offset.tolist()}


@dataclass(frozen=True)
class Multiply:
    """The step ``v M^T``."""

    matrix: Values  # (3, 3)

    def apply(self, readings: Values) -> Values:
        """Apply the step to (n, 3) readings."""
        return readings @ self.matrix.T

    def to_json(self) -> dict[str, Any]:
        """Return the step as published."""
        return {"matrix": self.matrix.tolist()}


@dataclass(frozen=True)
class TwoSided:
    """The step that multiplies each axis by one of two factors."""

    # each (3,)
    positive: Values
    negative: Values
    switch_at: Values

    def apply(self, readings: Values) -> Values:
        """Apply the step to (n, 3) readings."""
        return np.asarray(readings * np.where(readings > self.switch_at, self.positive, self.negative))

    def to_json(self) -> dict[str, Any]:
        """Return the step as published."""
        return {"two_sided": {name: value.tolist() for name, value in vars(self).items()}}


CorrectionStep: TypeAlias = Subtract | Multiply | TwoSided


def steps_of(correction: Mapping[str, Any] | None) -> tuple[CorrectionStep, ...] | None:
    """Return the steps of a published correction; raise ``ConfigurationError`` if one is of an unknown kind."""
    return None if correction is None else tuple(_step(entry) for entry in correction["steps"])


def _step(entry: Mapping[str, Any]) -> CorrectionStep:
    match dict(entry):
        case {"subtract": offset}:
            return Subtract(np.asarray(offset, float))
        case {"matrix": matrix}:
            return Multiply(np.asarray(matrix, float))
        case {"two_sided": sides}:
            return TwoSided(*(np.asarray(sides[name], float) for name in ("positive", "negative", "switch_at")))
    raise ConfigurationError(f"a correction has a step {sorted(entry)}; known kinds are {STEP_KINDS}")


def published(steps: Sequence[CorrectionStep]) -> dict[str, Any]:
    """Return the published correction."""
    return {"steps": [step.to_json() for step in steps]}


def corrected(steps: Sequence[CorrectionStep], readings: Values) -> Values:
    """Return (n, 3) readings, g or deg/s, after the steps of a correction."""
    out = np.array(readings, float)
    for step in steps:
        out = step.apply(out)
    return out
