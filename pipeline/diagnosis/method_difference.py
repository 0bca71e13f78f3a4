"""A method's calibration against a free fit of the same recordings, in its parameters.

    E = M K - 1,    e_0 = M (b - b_m)

where M, b_m are the method's matrix and bias, K, b those of the free fit: ``e_0 + E u`` is the error of a calibrated
reading. Their covariance is that of both fits together, as if they were independent, which is never too small.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.estimation.design import Start
from pipeline.estimation.joint import fit_terms
from pipeline.model.effects import effect_of
from pipeline.model.effects.base import truth

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from pipeline.estimation.joint import Fit
    from pipeline.estimation.selection import Selection
    from pipeline.records import Motion, SensorCalibration

    Values = NDArray[np.float64]

SURE = 5.0  # standard uncertainties of both fits together


@dataclass(frozen=True)
class Difference:
    """A method against the free fit.

    Attributes
    ----------
    method : SensorCalibration
    bias : (3,) array, g or deg/s
        M (b - b_m).
    matrix : (3, 3) array
        M K - 1.
    uncertainty : (12,) array
        Of both, row by row.
    free : Fit
    """

    method: SensorCalibration
    bias: Values
    matrix: Values
    uncertainty: Values
    free: Fit

    def parts(self, motion: Motion) -> dict[str, Values]:
        """Return the error of the calibrated reading by its cause, but for the filter's: (n, 3) arrays.

        Parameters
        ----------
        motion : Motion
            As the filter leaves it.
        """
        u = truth(self.method.sensor, motion)
        diagonal = np.diag(np.diag(self.matrix))
        even = 0.5 * (self.matrix + self.matrix.T) - diagonal
        odd = 0.5 * (self.matrix - self.matrix.T)
        return {
            "bias": np.broadcast_to(self.bias, u.shape),
            "scale_factor": u @ diagonal.T,
            "non_orthogonality": u @ even.T,
            "rotation": u @ odd.T,
            "two_sided": self._of_effects(motion) @ self.method.matrix.T,
        }

    def _of_effects(self, motion: Motion) -> Values:
        """Return what the free fit's values of the method's effects add, less what the method's do."""
        added = np.zeros((len(motion.time), 3))
        fitted = {term.effect.name: term for term in self.free.terms}
        for effect in self.method.effects:
            this = effect_of(effect)
            if this.moves or not this.available(motion):
                continue
            K = self.free.K
            added -= this.reading(self.method.sensor, motion, K, effect.values)
            if effect.name in fitted:
                added += this.reading(self.method.sensor, motion, K, fitted[effect.name].values)
        return added

    def certain(self, selected: Sequence[str]) -> dict[str, bool]:
        """Return which parts are more than the noise leaves in the two fits."""
        u = self.uncertainty[3:].reshape(3, 3)
        E = self.matrix
        off = ~np.eye(3, dtype=bool)
        both = np.hypot(u, u.T) / 2.0
        diagonal = np.abs(np.diag(E)) > SURE * np.diag(u)
        has = {effect.name for effect in self.method.effects}
        whole = all(name in has for name in selected)
        return {
            "two_sided": whole,
            "bias": whole and bool(np.any(np.abs(self.bias) > SURE * self.uncertainty[:3])),
            "scale_factor": bool(np.any(diagonal)),
            "non_orthogonality": bool(np.any(np.abs(E + E.T)[off] / 2.0 > SURE * both[off])),
            "rotation": bool(np.any(np.abs(E - E.T)[off] / 2.0 > SURE * both[off])),
        }


def difference_of(calibration: SensorCalibration, selection: Selection) -> Difference:
    """Compare with the free fit of base, configured effects and those selected that the method has too."""
    free, names = selection.base, [effect.name for effect in calibration.effects]
    shared = [term for term in selection.fit.terms if term.effect.name in names]
    known = {term.effect.name for term in free.terms}
    if any(term.effect.name not in known for term in shared):
        terms = [*free.terms, *(term for term in shared if term.effect.name not in known)]
        start = Start(free.bias, free.K, selection.start.scale)
        free = fit_terms(selection.observations, terms, start, selection.settings)
    M = calibration.matrix
    own = np.zeros((12, 12)) if calibration.covariance is None else calibration.covariance[:12, :12]
    change = np.zeros((12, 12))
    change[:3, :3] = M
    change[3:, 3:] = np.kron(M, np.eye(3))
    theirs = np.zeros((12, 12))
    theirs[:3, :3] = M
    theirs[3:, 3:] = np.kron(np.eye(3), free.K.T)
    covariance = change @ free.covariance[:12, :12] @ change.T + theirs @ own @ theirs.T
    return Difference(
        calibration,
        M @ (free.bias - calibration.bias),
        M @ free.K - np.eye(3),
        np.sqrt(np.clip(np.diag(covariance), 0.0, None)),
        free,
    )
