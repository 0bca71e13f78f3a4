"""Physics outside the catalogue as free curves, so that the posterior need not call it an effect of the catalogue.

    other_temperature : sum over n = 1 to 5 of c_n P_n(x), x the temperature over its span
    other_rate        : the same of |omega|, and d_x omega_x^2 + d_y omega_y^2, which differ with the axis of the turn
    other_input       : sum over n = 2 to 5 of c_n P_n(x), x the axis' own input over its largest value
    other_angle       : sum over n = 1 to 8 of a_n cos(n A) + b_n sin(n A), A the table's angle

with Legendre polynomials P_n and coefficients for each axis. A curve has no limit by the data sheet: its coefficients
have the size of the noise, times the scales of ``pipeline.estimation.evidence``. That many coefficients cost evidence,
so that a curve is more probable than an effect only where that effect leaves more than noise.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.polynomial.legendre import legvander

from pipeline.model.effects.base import Effect, Layout, Owner, Parameter, length, truth

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from pipeline.records import Motion

    Values = NDArray[np.float64]

OTHER = "other_"  # how the names of free curves begin
DEGREE, CYCLES = 5, 8  # as in the tests that find a dependence (pipeline.diagnosis.residual_dependence)


class FreeCurve(Effect):
    """A curve of one covariate with free coefficients."""

    owner = Owner.RECORDING
    meaning, excitation, experiment, source = "Physics outside the catalogue.", "", "", ""

    def __init__(self, covariate: str, low: float, high: float) -> None:
        self.covariate, self.name = covariate, f"{OTHER}{covariate}"
        self.middle, self.half = 0.5 * (low + high), 0.5 * (high - low)
        self.layout = Layout.PER_AXIS if covariate == "input" else Layout.EVERY_AXIS
        self.count = {"input": DEGREE - 1, "angle": 2 * CYCLES, "rate": DEGREE + 2}.get(covariate, DEGREE)

    def parameters(self, sensor: str) -> tuple[Parameter, ...]:
        """Return a coefficient for each curve and axis."""
        unit = "g" if sensor == "accelerometer" else "deg/s"
        return tuple(Parameter(f"c{k}_{axis}", unit, "coefficient") for axis in "xyz" for k in range(self.count))

    def regressors(self, sensor: str, motion: Motion, K: Values, values: Values) -> Values:
        """Return the curves; zeros in a recording without the covariate."""
        del K, values
        if self.covariate == "input":
            return np.asarray(legvander(truth(sensor, motion) / self.half, DEGREE)[..., 2:])
        known = {"temperature": motion.temperature, "angle": motion.angle, "rate": length(motion.angular_rate)}
        covariate = known[self.covariate]
        if covariate is None:
            return np.zeros((len(motion.time), self.count))
        if self.covariate == "angle":
            turns = np.radians(covariate)[:, None] * np.arange(1, CYCLES + 1)
            return np.concatenate([np.cos(turns), np.sin(turns)], axis=1)
        found = legvander((covariate - self.middle) / self.half, DEGREE)[:, 1:]
        if self.covariate == "rate":
            found = np.concatenate([found, (motion.angular_rate[:, :2] / self.half) ** 2], axis=1)
        return np.asarray(found)


def free_curves(sensor: str, motions: Sequence[Motion]) -> list[Effect]:
    """Return the free curves of what changes in some motions."""
    spans: dict[str, list[Values | None]] = {
        "temperature": [m.temperature for m in motions],
        "rate": [length(m.angular_rate) for m in motions],
        "angle": [m.angle for m in motions],
    }
    found: list[Effect] = []
    for covariate, values in spans.items():
        known = [v for v in values if v is not None and len(v)]
        low, high = (min(v.min() for v in known), max(v.max() for v in known)) if known else (0.0, 0.0)
        if high > low and (covariate != "temperature" or len(known) == len(values)):
            found.append(FreeCurve(covariate, float(low), float(high)))
    largest = max(float(np.abs(truth(sensor, m)).max()) for m in motions)
    return [*found, *([FreeCurve("input", -largest, largest)] if largest > 0.0 else [])]
