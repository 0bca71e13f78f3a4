"""How much of the printed scatter of O and S picking the largest samples explains.

Of a device, over its printed rows and the axes y and z (x is the reference of O),

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

from pipeline.thesis.recorded import CAUSES, LOST
from pipeline.thesis.results import DEVICES, procedure_of, set_of
from pipeline.thesis.tables import read_printed

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from pipeline.thesis.seeds import Row

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


def scatters(printed: Path, rows: Sequence[Row]) -> list[Scatter]:
    """Return the scatter of O, S and b of each device on the precise table.

    Parameters
    ----------
    printed : Path
    rows : sequence of dict
        Of the study over seeds.
    """
    tables = [row for table in read_printed(printed / "accel_parameters.csv").values() for row in table]
    out = []
    for device in DEVICES:
        own = [r for r in tables if r["device"].lower() == device and r["rate_table"] == "acutronic"]
        sets = {set_of(r["device"], r["rate_table"], procedure_of(r)) for r in own}
        found = [r for r in rows if r["set"] in sets and r["method"] == "printed"]
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


def _values(rows: Sequence[Row], quantity: str, centre: Mapping[str, float], cause: int) -> list[list[float]]:
    factor = {"S": "M"}.get(quantity)
    return [
        [r[f"{quantity}_{a}"] * (r[factor] if factor else 1.0) for a in centre] for r in rows if r["cause"] == cause
    ]


def _size(values: Sequence[Sequence[float]], centre: Mapping[str, float]) -> float:
    deviation = np.array(values, float) - np.array(list(centre.values()))
    return float(np.sqrt(np.mean(deviation**2)))
