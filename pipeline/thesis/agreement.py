"""How near the parameters come, on the precise table: to what was printed, and to what was simulated.

Of each quantity, over devices, procedures and elements,

    largest |ours - other|,    and how many of them lie within the bound

where

other : the median of what was printed (accelerometer's bias: the printed ones differ between procedures by up to
    0.006 g), the true scale factors (O M S), the printed row (gyroscope), or the staged method on the same recordings
    (Cholesky and LU, as a share of the expanded uncertainty of the difference)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.thesis.results import DEVICES, RATES, procedure_of
from pipeline.thesis.scatter import TRUE_SCALE
from pipeline.thesis.tables import ACCELEROMETER, GYROSCOPE, read_printed

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from pipeline.thesis.results import JSON, Results

    Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Agreement:
    """One quantity by one method.

    Attributes
    ----------
    what, method : str
    bound : float
        In the quantity's unit.
    differences : (n,) array
        Their sizes.
    """

    what: str
    method: str
    bound: float
    differences: Floats

    @property
    def largest(self) -> float | None:
        """The largest difference; None where no unit was calibrated."""
        return float(self.differences.max()) if self.differences.size else None

    @property
    def within(self) -> int:
        """How many differences lie within the bound."""
        return int(np.sum(self.differences <= self.bound))


def agreements(printed: Path, results: Results) -> list[Agreement]:
    """Return how near the parameters come.

    Parameters
    ----------
    printed : Path
    results : Results
    """
    accelerometer, gyroscope = (
        [r for t in read_printed(printed / file).values() for r in t if r["rate_table"] == "acutronic"]
        for file in ("accel_parameters.csv", "gyro_parameters.csv")
    )
    out = []
    for title, method in reversed(ACCELEROMETER.items()):
        bias, product = _accelerometer(accelerometer, results, method)
        out.append(Agreement("Bias of the accelerometer, g, from the median of the printed", title, 0.002, bias))
        out.append(Agreement("O M S of the accelerometer, from the truth", title, 0.005, product))
    for title, method in reversed(GYROSCOPE.items()):
        bias, matrix = _gyroscope(gyroscope, results, method)
        out.append(Agreement("Bias of the gyroscope, deg/s, from the printed", title, 0.02, bias))
        out.append(Agreement("Matrix of the gyroscope, from the printed", title, 0.002, matrix))
    what = "Cholesky and LU from the stages, over the expanded uncertainty of the difference"
    return [*out, Agreement(what, "inverted", 1.0, _cholesky(results))]


def _accelerometer(rows: Sequence[dict[str, str]], results: Results, method: str) -> tuple[Floats, Floats]:
    bias, product = [], []
    for row in rows:
        device = row["device"].lower()
        fit = results.fit(f"{device}-{procedure_of(row)}-{method}", "accelerometer")
        if fit is None:
            continue
        own = [[float(r[f"b_{a}_g"]) for a in "xyz"] for r in rows if r["device"] == row["device"]]
        bias.append(np.array(fit["bias"]) - np.median(own, axis=0))
        product.append(np.diag(fit["matrix"]) - TRUE_SCALE[device])
    return _sizes(bias), _sizes(product)


def _gyroscope(rows: Sequence[dict[str, str]], results: Results, method: str) -> tuple[Floats, Floats]:
    bias, matrix = [], []
    for row in rows:
        fit = results.fit(f"{row['device'].lower()}-{procedure_of(row)}-{method}", "gyroscope")
        if fit is None:
            continue
        bias.append(np.array(fit["bias"]) - [float(row[f"b_{a}_dps"]) for a in "xyz"])
        told = [[float(row[f"M{i}{j}"]) for j in (1, 2, 3)] for i in (1, 2, 3)]
        matrix.append(np.transpose(fit["matrix"]) - told)
    return _sizes(bias), _sizes(matrix)


def _cholesky(results: Results) -> Floats:
    out = []
    for name in (f"{device}-{rate}" for device in DEVICES for rate in RATES):
        fits = [results.fit(f"{name}-{method}", "gyroscope") for method in ("staged", "cholesky")]
        if None not in fits:
            one, other = (np.array(f["matrix"]) for f in fits if f is not None)
            out.append((one - other) / np.hypot(*(_expanded(f) for f in fits if f is not None)))
    return _sizes(out)


def _expanded(fit: JSON) -> Floats:
    return np.array(fit["expanded_uncertainty"]["matrix"])


def _sizes(differences: Sequence[Floats]) -> Floats:
    return np.abs(np.ravel(differences)) if differences else np.zeros(0)
