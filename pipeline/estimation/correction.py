"""Readings as a staged fit corrects them, up to and including one of its stages.

A correction is ``{"steps": [...]}``; each step acts on the output of the step before, on row vectors v of readings:

    {"subtract": b}                                          v - b
    {"matrix": M}                                            v M^T, that is M v as a column
    {"two_sided": {"positive": p, "negative": n, "switch_at": s}}   p_i v_i where v_i > s_i, else n_i v_i

where b, p, n, s are (3,) and M is (3, 3).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

KINDS = "subtract, matrix, two_sided"


def apply_correction(correction: Mapping[str, Any] | None, readings: NDArray[np.float64]) -> NDArray[np.float64]:
    """Correct readings.

    ``correction``: ``StageResult.correction``; None changes nothing. ``readings``: (n, 3), g or deg/s. Returns (n, 3),
    same unit. Raises ``ConfigurationError`` if a step is of an unknown kind.
    """
    out = np.array(readings, float)
    for step in (correction or {}).get("steps", []):
        out = apply_step(step, out)
    return out


def apply_step(step: Mapping[str, Any], readings: NDArray[np.float64]) -> NDArray[np.float64]:
    """Apply one step to (n, 3) readings."""
    out: NDArray[np.float64]
    match dict(step):
        case {"subtract": offset}:
            out = readings - np.asarray(offset, float)
        case {"matrix": matrix}:
            out = readings @ np.asarray(matrix, float).T
        case {"two_sided": sides}:
            above = readings > np.asarray(sides["switch_at"], float)
            out = readings * np.where(above, sides["positive"], sides["negative"])
        case _:
            raise ConfigurationError(f"a correction has a step {sorted(step)}; known kinds are {KINDS}")
    return out


def two_sided(
    positive: NDArray[np.float64], negative: NDArray[np.float64], switch_at: NDArray[np.float64]
) -> dict[str, Any]:
    """Return a step that multiplies each axis by one of two factors."""
    sides = {"positive": positive, "negative": negative, "switch_at": switch_at}
    return {"two_sided": {name: np.asarray(value, float).tolist() for name, value in sides.items()}}
