"""The joint estimate of a device that was calibrated several times: units that share a serial (``combine=serial``).

    x_i = theta + d_i + e_i + b,    cov(e_i) = A_i,  cov(d_i) = diag(r^2),  cov(b) = B
    theta = (sum W_i)^-1 sum W_i x_i,    W_i = (A_i + diag(r^2))^-1,    cov(theta) = (sum W_i)^-1 + B

x_i contains bias, matrix and effects of calibration i. A_i is the part of its covariance by its readings (type A), B
the part by stated accuracies of the bench (type B), which is assumed common to all. The calibrations have different
recordings, so that none is used twice. r is the standard deviation between calibrations in addition to A_i, one for
each kind of parameter (bias, scale factors, cross-axis elements, effect):

    sum_i sum_kind (x_i - mean)^2 / (A_i + r^2) = k (n - 1),    r = 0 where the sum is smaller at 0

with k parameters of the kind.

In its next use the device has another d. The contribution of r to the covariance, in theta and in the next use, is the
line ``repeatability`` of the budget, with k (n - 1) degrees of freedom.

Source: Paule & Mandel, Consensus values and weighting factors, J. Res. NBS 87 (1982) 377.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.estimation.engine import scaled_inverse
from pipeline.estimation.uncertainty_budget import NOISE, own_and_bench
from pipeline.estimation.uncertainty_budget import combined as budget_of
from pipeline.io.files import wrong_name
from pipeline.records import (
    NORMAL,
    SENSORS,
    Contribution,
    Index,
    SensorCalibration,
    StageResult,
    Values,
    files_of_readings,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence


JSON = dict[str, Any]
KIND = np.array([0, 0, 0, 1, 2, 2, 2, 1, 2, 2, 2, 1])  # of bias, diagonal and other elements of the matrix
BENCH = "stated accuracies of the bench"
SAME = ("sensor", "method", "table")  # equal in the calibrations of one estimate


def combined_calibrations(
    rows: Sequence[Mapping[str, Any]], read: Callable[[str], JSON]
) -> tuple[dict[str, JSON], list[JSON]]:
    """Return the calibration of each serial with several calibrations, and a list of these serials for ``fleet.json``.

    Its entries have ``serial, units, refused``. ``rows``: ``unit``, ``serial`` and ``status`` of each unit; ``read``
    returns ``calibrations/<unit>.json`` of a unit.
    """
    devices: dict[str, list[str]] = {}
    for row in rows:
        if row.get("serial") and row["status"] == "ok":
            devices.setdefault(str(row["serial"]), []).append(row["unit"])
    found, entries = {}, []
    for serial, units in devices.items():
        if len(units) > 1:
            documents = [read(unit) for unit in units]
            reason = f"the serial {wrong}" if (wrong := wrong_name(serial)) else _refused(documents)
            entries.append({"serial": serial, "units": units, "refused": reason})
            if not reason:
                found[serial] = _combined(serial, documents)
    return found, entries


def _refused(documents: Sequence[JSON]) -> str | None:
    """Return why calibrations have no joint estimate."""
    files: dict[str, str] = {}
    for document in documents:
        for file in (file for entry in document["inputs"] for file in files_of_readings(entry)):
            other = files.setdefault(file["sha256"], document["unit"])
            if other != document["unit"]:
                return f"{other} and {document['unit']} use the same recording, {file['file']}"
    for key in SAME:
        if len({str(document[key]) for document in documents}) > 1:
            return f"the calibrations differ in {key}: {', '.join(str(d[key]) for d in documents)}"
    for sensor in SENSORS:
        names = [d[sensor] and d[sensor]["covariance"]["parameters"] for d in documents]
        if any(other != names[0] for other in names):
            return f"the calibrations of the {sensor} have different parameters; configure the same effects for all"
    return None


def _combined(serial: str, documents: Sequence[JSON]) -> JSON:
    """Return the document of a device, in the form of ``calibrations/<unit>.json``."""
    units = [document["unit"] for document in documents]
    inputs = [entry for document in documents for entry in document["inputs"]]
    sensors = {s: _sensor(s, [d[s] for d in documents]) if documents[0][s] else None for s in SENSORS}
    ranges, union = [document.get("calibrated_range") or {} for document in documents], {}
    for key in sorted({key for known in ranges for key in known}):
        values = [known[key] for known in ranges if key in known]
        is_pair = isinstance(values[0], list)
        union[key] = [min(v[0] for v in values), max(v[1] for v in values)] if is_pair else max(values)
    return {**documents[0], "unit": serial, "combined": units, "inputs": inputs, "calibrated_range": union, **sensors}


def _sensor(sensor: str, parts: Sequence[JSON]) -> JSON:
    each = [SensorCalibration.from_json(sensor, part) for part in parts]
    x, kind = np.stack([values_of(c) for c in each]), kinds_of(each[0])
    by_readings, by_bench = zip(*(own_and_bench(c) for c in each), strict=True)
    r2 = repeatability(x, np.stack([np.diag(A) for A in by_readings]), kind) ** 2
    weights = [scaled_inverse(A + np.diag(r2)) for A in by_readings]
    covariance = scaled_inverse(np.sum(weights, axis=0))
    mean = x.mean(axis=0)  # a parameter that all calibrations state exactly is not changed
    theta = mean + covariance @ np.sum([W @ (xi - mean) for W, xi in zip(weights, x, strict=True)], axis=0)
    freedom = np.sum([c.effective_freedom() for c in each], axis=0)
    alone = scaled_inverse(np.sum([scaled_inverse(A) for A in by_readings], axis=0))
    scatter = np.where(r2 > 0.0, np.bincount(kind)[kind] * (len(x) - 1.0), np.inf)
    lines = [
        Contribution(NOISE, "A", "Student's t", alone, freedom),
        Contribution(BENCH, "B", NORMAL, np.mean(by_bench, axis=0), np.full(len(theta), np.inf)),
        Contribution("repeatability", "A", "Student's t", covariance - alone + np.diag(r2), scatter),
    ]
    result = StageResult("combined", {}, None, None, {"calibrations": len(each), "repeatability": np.sqrt(r2).tolist()})
    first = replace(each[0], stages=(result,), converged=all(c.converged for c in each), convergence=None)
    return with_values(first, theta, lines).to_json()


def values_of(calibration: SensorCalibration) -> Values:
    """Return bias, matrix and effects of a sensor, in the order of the covariance's rows."""
    return np.concatenate([calibration.bias, calibration.matrix.ravel(), *(e.values for e in calibration.effects)])


def kinds_of(calibration: SensorCalibration) -> Index:
    """Return the kind of each parameter, 0 ..: bias, scale factors, cross-axis elements, then each effect."""
    return np.concatenate([KIND, *(np.full(len(e.values), 3 + k) for k, e in enumerate(calibration.effects))])


def with_values(calibration: SensorCalibration, theta: Values, lines: Sequence[Contribution]) -> SensorCalibration:
    """Return a calibration with other values, in the order of ``values_of``, and a budget of these contributions."""
    effects, at = [], 12
    for effect in calibration.effects:
        values = theta[at : at + len(effect.parameters)].tolist()
        described = {n: {**p, "value": v} for (n, p), v in zip(effect.parameters.items(), values, strict=True)}
        effects.append(replace(effect, parameters=described))
        at += len(described)
    changed = replace(calibration, bias=theta[:3], matrix=theta[3:12].reshape(3, 3), effects=tuple(effects))
    return budget_of(changed, lines, {})


def repeatability(x: Values, variance: Values, kind: Index) -> Values:
    """Return r, the standard deviation in addition to the stated variances, of (n, p) values: (p,) array.

    ``variance``: (n, p). ``kind``: (p,), 0 ..; parameters of one kind have one r. The sum decreases with r, which
    is found by bisection.
    """
    n = len(x)

    def excess(r2: Values) -> Values:
        w = 1.0 / np.maximum(variance + r2[kind], 1e-300)
        mean = np.sum(w * x, axis=0) / np.sum(w, axis=0)
        return np.asarray(np.bincount(kind, np.sum(w * (x - mean) ** 2, axis=0) - (n - 1.0)))

    low = np.zeros(int(kind.max()) + 1)
    high = np.maximum(np.bincount(kind, np.sum((x - x.mean(axis=0)) ** 2, axis=0)), 1e-300)
    scattered = excess(low) > 0.0
    for _ in range(60):  # to the rounding of a double
        middle = (low + high) / 2.0
        above = excess(middle) > 0.0
        low, high = np.where(above, middle, low), np.where(above, high, middle)
    return np.where(scattered, np.sqrt(high), 0.0)[kind]
