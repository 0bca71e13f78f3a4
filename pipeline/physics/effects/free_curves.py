"""Free curves, which represent physics outside the catalogue in the posterior (``pipeline.estimation.posterior``).

    other_temperature : sum over n = 1 to 5 of c_n P_n(x), x the temperature over its span
    other_rate        : the same of |omega|, and d_x omega_x^2 + d_y omega_y^2, which differ with the axis of the turn
    other_input       : sum over n = 2 to 5 of c_n P_n(x), x the axis' own input over its largest value
    other_angle       : sum over n = 1 to 8 of a_n cos(n A) + b_n sin(n A), A the table's angle

with Legendre polynomials P_n and coefficients for each axis. A curve has no limit by the sensor file: the unit of its
coefficients is the size of the noise, times the scales of ``pipeline.estimation.evidence``. The many coefficients lower
the evidence, so that a curve is more probable than an effect only if the residual of that effect is larger than noise.

The signal of an effect that depends on time is similar to that of a bend in the dependence on temperature. If an effect
of time or temperature is selected, ``other_temperature`` therefore has a second form with one coefficient for each
axis, ``c exp(-x / w)`` or ``c (1 - tanh(x / w))``, x the share of the span from one of its ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
from numpy.polynomial.legendre import legvander

from pipeline.core.records import Motion, Values
from pipeline.physics.effects.base import (
    Effect,
    EffectParameter,
    Layout,
    Owner,
    axis_parameters,
    length,
    truth,
    unit_of,
)

OTHER_PREFIX = "other_"  # prefix of the names of free curves
BEND = ":bend"  # suffix of the name of the second form; answers state it under the name of the first
BEND_WIDTHS = np.geomspace(0.1, 0.5, 12)  # of a bend, shares of the span: sharper ones are steps, wider ones parabolas
# Prior probability of a bend over that of an effect. With it, a bend was an answer in all 54 simulated units (seed 61)
# that hid one and selected a slow effect, and below 0.5 in all 34 (seed 62) that hid the slow effect.
MAX_BEND_SHARE_OF_ROOM = 0.5
CURVE_DEGREE = 5  # up to four turning points over the span; faster changes are steps
MAX_CURVE_CYCLES = 8  # periods a turn


class FreeCurve(Effect):
    """A curve of one covariate with free coefficients."""

    owner = Owner.RECORDING
    meaning, excitation, experiment, source = "Physics outside the catalogue.", "", "", ""

    def __init__(self, covariate: str, low: float, high: float) -> None:
        self.covariate, self.name = covariate, f"{OTHER_PREFIX}{covariate}"
        self.contains = (self.name + BEND,)
        self.middle, self.half = 0.5 * (low + high), 0.5 * (high - low)
        self.layout = Layout.PER_AXIS if covariate == "input" else Layout.EVERY_AXIS
        counts = {"input": CURVE_DEGREE - 1, "angle": 2 * MAX_CURVE_CYCLES, "rate": CURVE_DEGREE + 2}
        self.count = counts.get(covariate, CURVE_DEGREE)

    def parameters(self, sensor: str) -> tuple[EffectParameter, ...]:
        """Return a coefficient for each curve and axis."""
        names = [f"c{k}_{axis}" for axis in "xyz" for k in range(self.count)]
        return tuple(EffectParameter(name, unit_of(sensor), "coefficient") for name in names)

    def regressors(self, sensor: str, motion: Motion, K: Values, values: Values) -> Values:
        """Return the curves; zeros for a recording without the covariate."""
        if self.covariate == "input":
            return np.asarray(legvander(truth(sensor, motion) / self.half, CURVE_DEGREE)[..., 2:])
        known = {"temperature": motion.temperature, "angle": motion.angle, "rate": length(motion.angular_rate)}
        covariate = known[self.covariate]
        if covariate is None:
            return np.zeros((len(motion.time), self.count))
        if self.covariate == "angle":
            turns = np.radians(covariate)[:, None] * np.arange(1, MAX_CURVE_CYCLES + 1)
            return np.concatenate([np.cos(turns), np.sin(turns)], axis=1)
        found = legvander((covariate - self.middle) / self.half, CURVE_DEGREE)[:, 1:]
        if self.covariate == "rate":
            found = np.concatenate([found, (motion.angular_rate[:, :2] / self.half) ** 2], axis=1)
        return np.asarray(found)


class Bend(Effect):
    """A bend in the dependence on temperature, from one end of the span, with a coefficient for each axis."""

    name, needs = f"{OTHER_PREFIX}temperature{BEND}", ("temperature",)
    owner, layout = Owner.RECORDING, Layout.EVERY_AXIS
    meaning, excitation, experiment, source = "Physics outside the catalogue.", "", "", ""

    def __init__(self, forms: Sequence[tuple[float, float, bool]], form: int = 0) -> None:
        self.forms = forms  # end of the span, degC, signed width, degC, and whether the form is that of tanh
        self.end, self.width, self.soft = forms[form]

    def parameters(self, sensor: str) -> tuple[EffectParameter, ...]:
        """Return a coefficient for each axis."""
        return axis_parameters("c", unit_of(sensor), "coefficient")

    def regressors(self, sensor: str, motion: Motion, K: Values, values: Values) -> Values:
        """Return the bend."""
        assert motion.temperature is not None  # noqa: S101  (by ``needs``)
        x = (motion.temperature - self.end) / self.width
        return np.asarray((1.0 - np.tanh(x) if self.soft else np.exp(-x))[:, None])


def free_curves(sensor: str, motions: Sequence[Motion], *, bent: bool) -> list[Effect]:
    """Return the free curves of the covariates that vary in motions; ``bent``: also bends of the temperature."""
    spans: dict[str, list[Values | None]] = {
        "temperature": [m.temperature for m in motions],
        "rate": [length(m.angular_rate) for m in motions],
        "angle": [m.angle for m in motions],
    }
    curves: list[Effect] = []
    for covariate, values in spans.items():
        known = [v for v in values if v is not None and len(v)]
        low, high = (min(v.min() for v in known), max(v.max() for v in known)) if known else (0.0, 0.0)
        if high > low and (covariate != "temperature" or len(known) == len(values)):
            curves.append(FreeCurve(covariate, float(low), float(high)))
            if bent and covariate == "temperature":
                ends = (float(low), 1.0), (float(high), -1.0)
                forms = product(ends, (False, True), BEND_WIDTHS * (high - low))
                curves.append(Bend([(end, sign * width, soft) for (end, sign), soft, width in forms]))
    largest = max(float(np.abs(truth(sensor, m)).max()) for m in motions)
    return [*curves, *([FreeCurve("input", -largest, largest)] if largest > 0.0 else [])]
