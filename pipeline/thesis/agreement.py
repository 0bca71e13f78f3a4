"""Agreement of the parameters on the precise table with the printed and the simulated ones, and their scatter.

Of each quantity, over devices, procedures and elements,

    largest |ours - other|,    and how many of them lie within the bound

where

other : the median of what was printed (accelerometer's bias: the printed ones differ between procedures by up to
    0.006 g), the true scale factors (O M S), the printed row (gyroscope), or the staged method on the same recordings
    (Cholesky and LU, as a share of the expanded uncertainty of the difference)

The share of the printed scatter of O and S that follows from picking the largest samples: of a device, over its printed
rows and the axes y and z (x is the reference of O),

    D_O = sqrt(mean (1 - O)^2),    D_S = sqrt(mean (S M - S_0)^2)

once of the printed values, once over all seeds; S_0 is the true scale factor, and S that of readings multiplied by M:
as printed M holds the bias (see the errata), which shifts S and is no scatter. What remains beside noise
and lost samples is ``sqrt(max(0, D_printed^2 - D_seeds^2))``. A table that shakes as the home-made one does is the
bound beyond which vibration cannot go on the precise one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.thesis.results import DEVICES, RATES, procedure_of, set_of
from pipeline.thesis.seeds import CAUSES, LOST
from pipeline.thesis.tables import ACCELEROMETER, GYROSCOPE, read_printed

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    import pandas as pd
    from numpy.typing import NDArray

    from pipeline.thesis.results import JSON, Results

    Floats = NDArray[np.float64]
    from collections.abc import Mapping


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


# least-squares rows of table 5.23
TRUE_SCALE = {
    "mpu6050-1": (1.001, 0.994, 0.980),
    "mpu6050-2": (0.993, 0.996, 0.986),
    "stim300": (1.002, 1.003, 0.998),
}
QUANTITIES = ("O", "S", "b")


@dataclass(frozen=True)
class Scatter:
    """One quantity of one device.

    Attributes
    ----------
    device, quantity : str
    printed : float
    seeds : dict of str to float
        By cause of disturbance, each added to those before it.
    """

    device: str
    quantity: str
    printed: float
    seeds: dict[str, float]

    @property
    def unexplained(self) -> float:
        """What remains of the printed scatter beside noise and lost samples."""
        return float(np.sqrt(max(0.0, self.printed**2 - self.seeds[LOST] ** 2)))


def scatters(printed: Path, rows: pd.DataFrame) -> list[Scatter]:
    """Return the scatter of O, S and b of each device on the precise table.

    Parameters
    ----------
    printed : Path
    rows : DataFrame
        Of the study over seeds.
    """
    tables = [row for table in read_printed(printed / "accel_parameters.csv").values() for row in table]
    out = []
    for device in DEVICES:
        own = [r for r in tables if r["device"].lower() == device and r["rate_table"] == "acutronic"]
        sets = {set_of(r["device"], r["rate_table"], procedure_of(r)) for r in own}
        found = rows[rows["set"].isin(sets) & (rows["method"] == "printed")]
        for quantity in QUANTITIES:
            centre = _centre(device, quantity, own)
            unit = "_g" if quantity == "b" else ""
            values = [
                [float(r[f"{quantity}_{a}{unit}"]) * (float(r["M_x"]) if quantity == "S" else 1.0) for a in centre]
                for r in own
            ]
            by_cause = {cause: _size(_values(found, quantity, centre, k), centre) for k, cause in enumerate(CAUSES)}
            out.append(Scatter(device, quantity, _size(values, centre), by_cause))
    return out


def _centre(device: str, quantity: str, printed: Sequence[Mapping[str, str]]) -> dict[str, float]:
    """Return what the values would be without scatter, by axis; of b the median of what was printed."""
    if quantity == "O":
        return {"y": 1.0, "z": 1.0}
    if quantity == "b":
        return {a: float(np.median([float(r[f"b_{a}_g"]) for r in printed])) for a in "xyz"}
    return dict(zip("xyz", TRUE_SCALE[device], strict=True))


def _values(rows: pd.DataFrame, quantity: str, centre: Mapping[str, float], cause: int) -> Floats:
    own = rows[rows["cause"] == cause]
    values = own[[f"{quantity}_{a}" for a in centre]].to_numpy()
    return np.asarray(values * own[["M"]].to_numpy() if quantity == "S" else values)


def _size(values: Sequence[Sequence[float]] | Floats, centre: Mapping[str, float]) -> float:
    deviation = np.array(values, float) - np.array(list(centre.values()))
    return float(np.sqrt(np.mean(deviation**2)))
