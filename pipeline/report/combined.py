"""The joint estimate of a device that was calibrated several times: units that share a serial (``combine=serial``).

    x_i = theta + d_i + e_i + b,    cov(e_i) = A_i,  cov(d_i) = diag(r^2),  cov(b) = B
    theta = (sum W_i)^-1 sum W_i x_i,    W_i = (A_i + diag(r^2))^-1,    cov(theta) = (sum W_i)^-1 + B

where x_i holds bias, matrix and effects of calibration i; A_i is the part of its covariance by its own readings
(type A), and B that by stated accuracies of the bench (type B), taken as common to all. The recordings of the
calibrations are different, so that none is used twice. r is the standard deviation from one calibration to the next
that the scatter shows beyond A_i, one for each kind of parameter (bias, scale factors, cross-axis elements, effect):

    sum_i sum_kind (x_i - mean)^2 / (A_i + r^2) = k (n - 1),    r = 0 where the sum is smaller at 0

with k parameters of the kind.

The calibration of the device in its next use includes one more d. What r adds to the covariance, in theta and in the
next use, is a line of the budget, ``repeatability``, of k (n - 1) degrees of freedom.

Source: Paule & Mandel, Consensus values and weighting factors, J. Res. NBS 87 (1982) 377.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.estimation.engine import scaled_inverse
from pipeline.estimation.uncertainty_budget import effective_degrees_of_freedom
from pipeline.io.files import wrong_name
from pipeline.records import NORMAL, SENSORS, Contribution, SensorCalibration, StageResult

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    Values = NDArray[np.float64]

JSON = dict[str, Any]
KIND = np.array([0, 0, 0, 1, 2, 2, 2, 1, 2, 2, 2, 1])  # of bias, diagonal and other elements of the matrix
SAME = ("sensor", "method", "table")  # what the calibrations of one estimate have in common


def combined_calibrations(
    rows: Sequence[Mapping[str, Any]], calibrations: Mapping[str, JSON]
) -> tuple[dict[str, JSON], list[JSON]]:
    """Return a calibration for each serial with several calibrations, and what was combined or why it was not.

    ``rows``: ``unit`` and ``serial`` of each unit. ``calibrations``: unit to ``calibrations/<unit>.json``.
    """
    devices: dict[str, list[str]] = {}
    for row in rows:
        if row.get("serial") and calibrations[row["unit"]]["status"] == "ok":
            devices.setdefault(str(row["serial"]), []).append(row["unit"])
    found, told = {}, []
    for serial, units in devices.items():
        if len(units) > 1:
            documents = [calibrations[unit] for unit in units]
            reason = f"the serial {wrong}" if (wrong := wrong_name(serial)) else _refused(documents)
            told.append({"serial": serial, "units": units, "refused": reason})
            if not reason:
                found[serial] = _combined(serial, documents)
    return found, told


def _refused(documents: Sequence[JSON]) -> str | None:
    """Return why calibrations have no joint estimate."""
    files: dict[str, str] = {}
    for document in documents:
        for entry in document["inputs"]:
            other = files.setdefault(entry["sha256"], document["unit"])
            if other != document["unit"]:
                return f"{other} and {document['unit']} use the same recording, {entry['file']}"
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
    known = _ranges([document.get("calibrated_range") or {} for document in documents])
    return {**documents[0], "unit": serial, "combined": units, "inputs": inputs, "calibrated_range": known, **sensors}


def _ranges(ranges: Sequence[JSON]) -> JSON:
    """Return the range that all calibrations together contain."""
    found: JSON = {}
    for key in sorted({key for known in ranges for key in known}):
        values = [known[key] for known in ranges if key in known]
        together = isinstance(values[0], list)
        found[key] = [min(v[0] for v in values), max(v[1] for v in values)] if together else max(values)
    return found


def _sensor(sensor: str, parts: Sequence[JSON]) -> JSON:
    each = [SensorCalibration.from_json(sensor, part) for part in parts]
    x = np.stack([np.concatenate([c.bias, c.matrix.ravel(), *(e.values for e in c.effects)]) for c in each])
    own, common = _covariances(each, parts)
    kind = np.concatenate([KIND, *(np.full(len(e.values), 3 + k) for k, e in enumerate(each[0].effects))])
    r2 = repeatability(x, np.stack([np.diag(A) for A in own]), kind) ** 2
    weights = [scaled_inverse(A + np.diag(r2)) for A in own]
    covariance = scaled_inverse(np.sum(weights, axis=0))
    mean = x.mean(axis=0)  # a parameter that all state exactly stays as it is
    theta = mean + covariance @ np.sum([W @ (xi - mean) for W, xi in zip(weights, x, strict=True)], axis=0)
    freedom = np.sum([c.effective_freedom() for c in each], axis=0)
    alone = scaled_inverse(np.sum([scaled_inverse(A) for A in own], axis=0))
    scatter = np.where(r2 > 0.0, np.bincount(kind)[kind] * (len(x) - 1.0), np.inf)
    lines = [
        Contribution("noise of the readings", "A", "Student's t", alone, freedom),
        Contribution("stated accuracies of the bench", "B", NORMAL, common, np.full(len(theta), np.inf)),
        Contribution("repeatability", "A", "Student's t", covariance - alone + np.diag(r2), scatter),
    ]
    total = np.sum([line.covariance for line in lines], axis=0)
    effective = effective_degrees_of_freedom(
        np.stack([line.standard_uncertainty for line in lines]), np.stack([line.degrees_of_freedom for line in lines])
    )
    effects, at = [], 12
    for effect in each[0].effects:
        values = theta[at : at + len(effect.parameters)].tolist()
        described = {n: {**p, "value": v} for (n, p), v in zip(effect.parameters.items(), values, strict=True)}
        effects.append(replace(effect, parameters=described))
        at += len(described)
    first = each[0]
    result = StageResult("combined", {}, None, None, {"calibrations": len(each), "repeatability": np.sqrt(r2).tolist()})
    names = first.parameter_names()
    budget = {"parameters": names, "contributions": [line.to_json() for line in lines], "not_included": []}
    joint = replace(
        first,
        bias=theta[:3],
        matrix=theta[3:12].reshape(3, 3),
        effects=tuple(effects),
        stages=(result,),
        covariance=total,
        degrees_of_freedom=float(effective.min()),
        freedom=effective,
        converged=all(c.converged for c in each),
        convergence=None,
        budget=budget,
    )
    return joint.to_json()


def _covariances(each: Sequence[SensorCalibration], parts: Sequence[JSON]) -> tuple[list[Values], Values]:
    """Return the covariance of each calibration by its own readings, and the mean of those by the bench."""
    own, common = [], []
    for calibration, part in zip(each, parts, strict=True):
        C = calibration.covariance
        assert C is not None  # noqa: S101  (from_json)
        total = np.maximum(np.diag(C), 1e-300)
        lines = (part.get("uncertainty_budget") or {}).get("contributions", [])
        stated = np.sum([np.square(c["contribution"]) for c in lines if c["type"] == "B"] or [0.0 * total], axis=0)
        share = np.clip(stated / total, 0.0, 1.0)
        own.append(C * np.sqrt(np.outer(1.0 - share, 1.0 - share)))
        common.append(C * np.sqrt(np.outer(share, share)))
    return own, np.asarray(np.mean(common, axis=0))


def repeatability(x: Values, variance: Values, kind: NDArray[np.intp]) -> Values:
    """Return r, the standard deviation beyond the stated variances, of (n, p) values: (p,) array.

    ``variance``: (n, p). ``kind``: (p,), 0 ..; parameters of one kind have one r. The sum falls as r grows, so that
    bisection finds it.
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
