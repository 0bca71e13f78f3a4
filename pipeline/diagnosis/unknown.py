"""What the residual depends on beside the catalogue.

Generic bases in one covariate at a time are scored like effects, beside base, configured and selected effects:

    temperature, time : Chebyshev polynomials of degree 1 to 5 over their span
    rate              : those of |omega|, over the moving samples
    angle             : cos and sin of 3 to 8 periods a turn
    specific_force    : Chebyshev polynomials of degree 3 to 5 of each component

They never take part in the selection: a flexible curve would win against physics in the first round.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.estimation.design import Term
from pipeline.estimation.ranking import Ranking
from pipeline.model.effects.base import Effect, Layout, Owner, Parameter

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from pipeline.estimation.observations import Observations
    from pipeline.estimation.selection import Selection
    from pipeline.records import Motion

GATE_BIC = 10.0
GATE_P = 1e-3


class Basis(Effect):
    """Curves in one covariate, each with coefficients of its own in every axis."""

    owner = Owner.RECORDING
    layout = Layout.EVERY_AXIS
    excitation = "recordings in which the covariate changes"
    source = "Chebyshev polynomials and harmonics"

    def __init__(self, name: str, curves: Callable[[Motion], NDArray[np.float64]], count: int) -> None:
        self._name, self._curves, self._count = name, curves, count

    @property
    def name(self) -> str:  # type: ignore[override]  # a basis is named after its covariate
        """Name of the covariate."""
        return self._name

    def parameters(self, sensor: str) -> tuple[Parameter, ...]:
        """Return the coefficients."""
        del sensor
        return tuple(Parameter(f"{a}_{j}", "1", "coefficient") for a in "xyz" for j in range(self._count))

    def regressors(
        self, sensor: str, motion: Motion, K: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the curves."""
        del sensor, K, values
        return self._curves(motion)


def unexplained(selection: Selection) -> list[dict[str, object]]:
    """Return the covariates on which the residual still depends, with their p-values, smallest first.

    Parameters
    ----------
    selection : Selection
    """
    observations = selection.observations
    bases = bases_of(observations)
    terms = [Term(t.effect, t.values, full=True) for t in selection.fit.terms]
    candidates = [Term(basis, np.zeros(len(basis.parameters(observations.sensor)))) for basis in bases]
    ranking = Ranking(observations, terms, candidates, selection.fit.K, selection.start.scale, selection.settings)
    found = [s for s in ranking.scores([], {}) if s.delta_bic > GATE_BIC and s.p_value * len(bases) < GATE_P]
    return [{"covariate": s.name, "p_value": s.p_value} for s in sorted(found, key=lambda s: s.p_value)]


def bases_of(observations: Observations) -> list[Basis]:
    """Return the bases whose covariates the recordings hold."""
    motions = [part.motion for part in observations.parts]
    bases = [Basis("specific_force", _force, 9)]
    if observations.clock_shared:
        bases.append(Basis("time", _chebyshev(lambda m: m.time, motions, range(1, 6)), 5))
    if all(m.temperature is not None for m in motions):
        bases.append(Basis("temperature", _chebyshev(lambda m: m.temperature, motions, range(1, 6)), 5))
    if any(np.any(~m.still) for m in motions):
        bases.append(Basis("rate", _chebyshev(_speed, motions, range(1, 6)), 5))
    if any(m.axis is not None for m in motions):
        bases.append(Basis("angle", _harmonics, 12))
    return bases


def _speed(motion: Motion) -> NDArray[np.float64]:
    speed: NDArray[np.float64] = np.linalg.norm(motion.angular_rate, axis=1)
    return speed


def _chebyshev(
    of: Callable[[Motion], NDArray[np.float64] | None], motions: list[Motion], degrees: range
) -> Callable[[Motion], NDArray[np.float64]]:
    values = np.concatenate([v for m in motions if (v := of(m)) is not None])
    low, high = float(values.min()), float(values.max())
    width = max(high - low, 1e-12)

    def curves(motion: Motion) -> NDArray[np.float64]:
        value = of(motion)
        assert value is not None  # noqa: S101
        scaled = np.asarray(2.0 * (value - low) / width - 1.0, np.float64)
        powers = np.polynomial.chebyshev.chebvander(scaled, degrees.stop - 1)
        return np.asarray(powers[:, degrees.start :], np.float64)

    return curves


def _harmonics(motion: Motion) -> NDArray[np.float64]:
    if motion.angle is None:
        return np.zeros((len(motion.time), 12))
    argument = np.radians(motion.angle)[:, None] * np.arange(3, 9)
    return np.concatenate([np.cos(argument), np.sin(argument)], axis=1)


def _force(motion: Motion) -> NDArray[np.float64]:
    scaled = motion.specific_force / max(float(np.abs(motion.specific_force).max()), 1.0)
    return np.asarray(np.polynomial.chebyshev.chebvander(scaled, 5)[:, :, 3:].reshape(len(scaled), 9), np.float64)
