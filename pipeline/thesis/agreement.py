"""Agreement of the parameters on the precise table with the printed and the simulated ones, and their scatter.

Of each quantity, over devices, procedures and elements,

    largest |ours - other|,    and how many of them lie within the bound

where

other : the median of the printed biases (accelerometer: they differ between procedures by up to 0.006 g), the true
    scale factors (O M S), the printed row (gyroscope), or the staged method on the same recordings (Cholesky and LU, as
    a share of the expanded uncertainty of the difference)

The share of the printed scatter of O and S that follows from picking the largest samples: of a device, over its printed
rows and the axes y and z (x is the reference of O),

    D_O = sqrt(mean (1 - O)^2),    D_S = sqrt(mean (S M - S_0)^2)

of the printed values and over all seeds; S_0 is the true scale factor, and S that of readings multiplied by M: as
printed M holds the bias (see the errata), which shifts S and is no scatter. What noise and lost samples do not explain
is ``sqrt(max(0, D_printed^2 - D_seeds^2))``. A table that shakes as the home-made one does is the upper bound of what
vibration can do on the precise one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from pipeline.thesis.results import AXES, DEVICES, RATES, matrix_of, read_printed, values
from pipeline.thesis.seeds import CAUSES, LOST
from pipeline.thesis.tables import ACCELEROMETER, GYROSCOPE

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from pipeline.records import Values
    from pipeline.thesis.results import JSON, Results


# least-squares rows of table 5.23
TRUE_SCALE = {
    "mpu6050-1": (1.001, 0.994, 0.980),
    "mpu6050-2": (0.993, 0.996, 0.986),
    "stim300": (1.002, 1.003, 0.998),
}
BIAS = [f"b_{a}_g" for a in AXES]


def agreements(printed: Path, results: Results) -> pd.DataFrame:
    """Return how near the parameters come, a row a quantity and method.

    Columns: ``what``, ``method``, ``bound`` (in the quantity's unit), ``largest`` (NaN where no unit was calibrated),
    ``within`` (how many differences lie within the bound) and ``count``.
    """
    found: list[tuple[str, str, float, list[Values]]] = []
    rows = _on_precise_table(printed, "accel_parameters")
    median = rows.groupby("device")[BIAS].median()
    for title, method in reversed(ACCELEROMETER.items()):
        fits = list(_fits(rows, results, "accelerometer", method))
        bias = [np.array(fit["bias"]) - median.loc[row["device"]].to_numpy() for row, fit in fits]
        product = [np.diag(fit["matrix"]) - TRUE_SCALE[row["device"]] for row, fit in fits]
        found.append(("Bias of the accelerometer, g, from the median of the printed", title, 0.002, bias))
        found.append(("O M S of the accelerometer, from the truth", title, 0.005, product))
    rows = _on_precise_table(printed, "gyro_parameters")
    for title, method in reversed(GYROSCOPE.items()):
        fits = list(_fits(rows, results, "gyroscope", method))
        bias = [np.array(fit["bias"]) - values(row, "b_{}_dps") for row, fit in fits]
        matrix = [np.transpose(fit["matrix"]) - matrix_of(row, "M") for row, fit in fits]
        found.append(("Bias of the gyroscope, deg/s, from the printed", title, 0.02, bias))
        found.append(("Matrix of the gyroscope, from the printed", title, 0.002, matrix))
    what = "Cholesky and LU from the stages, over the expanded uncertainty of the difference"
    found.append((what, "inverted", 1.0, list(_cholesky(results))))
    out = []
    for what, title, bound, differences in found:
        size = np.abs(np.ravel(differences))
        largest = size.max() if size.size else np.nan
        within = int(np.sum(size <= bound))
        out.append(
            {"what": what, "method": title, "bound": bound, "largest": largest, "within": within, "count": size.size}
        )
    return pd.DataFrame(out)


def _on_precise_table(printed: Path, name: str) -> pd.DataFrame:
    rows = read_printed(printed, name)
    return rows[rows["rate_table"] == "acutronic"]


def _fits(rows: pd.DataFrame, results: Results, sensor: str, method: str) -> Iterator[tuple[JSON, JSON]]:
    for row in rows.to_dict("records"):
        fit = results.fit(f"{row['set']}-{method}", sensor)
        if fit is not None:
            yield row, fit


def _cholesky(results: Results) -> Iterator[Values]:
    for name in (f"{device}-{rate}" for device in DEVICES for rate in RATES):
        staged, cholesky = (results.fit(f"{name}-{method}", "gyroscope") for method in ("staged", "cholesky"))
        if staged and cholesky:
            expanded = np.hypot(*(fit["expanded_uncertainty"]["matrix"] for fit in (staged, cholesky)))
            yield (np.array(staged["matrix"]) - cholesky["matrix"]) / expanded


def scatters(printed: Path, seeds: pd.DataFrame) -> pd.DataFrame:
    """Return the scatter of O, S and b of each device on the precise table.

    Columns: ``device``, ``quantity``, ``printed``, one for each of ``CAUSES`` (each includes those before it), and
    ``unexplained``.
    """
    rows = _on_precise_table(printed, "accel_parameters")
    seeds = seeds[seeds["method"] == "printed"]
    out = []
    for device in DEVICES:
        own = rows[rows["device"] == device]
        by_cause = seeds[seeds["set"].isin(own["set"])].groupby("cause")
        for quantity, centre in (
            ("O", {"y": 1.0, "z": 1.0}),
            ("S", dict(zip(AXES, TRUE_SCALE[device], strict=True))),
            ("b", dict(zip(AXES, own[BIAS].median(), strict=True))),
        ):
            unit = "_g" if quantity == "b" else ""
            columns = [f"{quantity}_{a}" for a in centre]
            told = own[[f"{c}{unit}" for c in columns]].mul(own["M_x"] if quantity == "S" else 1.0, axis=0)
            row: JSON = {"device": device, "quantity": quantity, "printed": _size(told, centre)}
            for cause, drawn in by_cause:
                found = drawn[columns].mul(drawn["M"] if quantity == "S" else 1.0, axis=0)
                row[CAUSES[cause]] = _size(found, centre)
            row["unexplained"] = np.sqrt(max(0.0, row["printed"] ** 2 - row[LOST] ** 2))
            out.append(row)
    return pd.DataFrame(out)


def _size(found: pd.DataFrame, centre: dict[str, float]) -> float:
    return float(np.sqrt(np.mean((found.to_numpy() - list(centre.values())) ** 2)))
