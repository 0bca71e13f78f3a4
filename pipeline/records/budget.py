"""One line of an uncertainty budget: what one source contributes to the uncertainty of every parameter of a fit."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

NORMAL, RECTANGULAR = "normal", "rectangular"


@dataclass(frozen=True)
class Contribution:
    """What one source contributes (JCGM 100:2008, 8 and annex H).

    Attributes
    ----------
    source : str
    kind : str
        ``A`` (from the scatter of these recordings) or ``B`` (from anything else).
    distribution : str
        That is assumed of the input.
    covariance : (p, p) array
        Of the parameters, by this source alone.
    degrees_of_freedom : (p,) array
    input_uncertainty : float or None
        Standard uncertainty of the input; None where the source is no single quantity.
    input_unit : str
    independent : int
        How many independent quantities of this uncertainty the input stands for (stops of a table, axes).
    parts : dict of str to (p,) array
        Standard uncertainties of which the contribution consists, where they can be told apart.
    remark : str
    """

    source: str
    kind: str
    distribution: str
    covariance: NDArray[np.float64]
    degrees_of_freedom: NDArray[np.float64]
    input_uncertainty: float | None = None
    input_unit: str = ""
    independent: int = 1
    parts: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    remark: str = ""

    @property
    def standard_uncertainty(self) -> NDArray[np.float64]:
        """What it contributes to each parameter's standard uncertainty: (p,) array."""
        return np.sqrt(np.clip(np.diag(self.covariance), 0.0, None))

    def with_freedom(self, degrees_of_freedom: NDArray[np.float64]) -> Contribution:
        """Return the contribution with degrees of freedom of each parameter."""
        return replace(self, degrees_of_freedom=degrees_of_freedom)

    def of(self, kept: slice) -> Contribution:
        """Return the contribution to some of the parameters."""
        parts = {name: values[kept] for name, values in self.parts.items()}
        freedom = self.degrees_of_freedom[kept]
        return replace(self, covariance=self.covariance[kept, kept], degrees_of_freedom=freedom, parts=parts)

    def placed(self, place: NDArray[np.float64]) -> Contribution:
        """Return the contribution to q parameters, some of which are these: ``place`` is (q, p), zeros and ones."""
        parts = {name: place @ values for name, values in self.parts.items()}
        freedom = np.full(len(place), np.inf)
        freedom[np.argmax(place, axis=0)] = self.degrees_of_freedom
        return replace(self, covariance=place @ self.covariance @ place.T, degrees_of_freedom=freedom, parts=parts)

    def to_json(self) -> dict[str, Any]:
        """Return the line of the budget; the sensitivity is the contribution over the input's uncertainty."""
        contribution, u = self.standard_uncertainty, self.input_uncertainty
        return {
            "source": self.source,
            "type": self.kind,
            "distribution": self.distribution,
            "standard_uncertainty": u,
            "unit": self.input_unit,
            "independent_inputs": self.independent,
            "sensitivity": (contribution / u).tolist() if u else None,
            "contribution": contribution.tolist(),
            "degrees_of_freedom": finite(self.degrees_of_freedom),
            "parts": {name: values.tolist() for name, values in self.parts.items()},
            "remark": self.remark,
        }


def finite(values: NDArray[np.float64]) -> list[float | None]:
    """Return a list that JSON can hold: None for what is infinite."""
    return [float(v) if np.isfinite(v) else None for v in values]
