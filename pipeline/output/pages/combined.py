"""Estimates from several calibrations: of a device (``combine=serial``), or with the prior of a lot (``combine=lot``).

The joint estimate of a device from the units that share its serial is

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

A lot is the units of a sensor model with one value of the column ``lot``. Siblings have the same table, procedure,
method, axes and parameters: so their parameters have the same meaning in the same frame, and contain the same error of
the table. Effects of the recording, the mounting and the table have no prior. ``pipeline.estimation.lot_prior``
computes the estimate.

Source: Paule & Mandel, Consensus values and weighting factors, J. Res. NBS 87 (1982) 377.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from pipeline.core.files import JSON
from pipeline.core.records import (
    BASE_COUNT,
    BIAS,
    LACK_OF_FIT,
    NORMAL,
    SENSORS,
    Contribution,
    Index,
    Mask,
    SensorCalibration,
    StageDetails,
    StageResult,
    Values,
    files_of_readings,
    matrix_of,
    with_arrays,
)
from pipeline.core.verdicts import Verdict
from pipeline.estimation.engine import scaled_inverse
from pipeline.estimation.lot_prior import MIN_SIBLINGS, LotPrior, Prediction, lot_priors, with_prior
from pipeline.estimation.uncertainty_budget import NOISE_SOURCE, own_and_bench
from pipeline.estimation.uncertainty_budget import combined as budget_of
from pipeline.evaluation.diagnosis.words import plain
from pipeline.ingest.files import wrong_name
from pipeline.output.pages.pages import MARK, number, template
from pipeline.output.pages.parameters import fitted_parameters
from pipeline.physics.effects import owner_of
from pipeline.physics.effects.base import Owner

KIND = np.array([0, 0, 0, 1, 2, 2, 2, 1, 2, 2, 2, 1])  # of bias, diagonal and other elements of the matrix
STATED_ACCURACIES = "stated accuracies of the bench"
EQUAL_SETTINGS = ("sensor", "method", "table")  # equal in the calibrations of one estimate
LINE = "prior of the lot"
SHARED_SOURCES = f"{STATED_ACCURACIES}, and {LACK_OF_FIT}"  # errors of a table: siblings may have them in common
NO_VALUES = np.empty(0)
MOST_FREEDOM = 1e12  # instead of infinitely many degrees of freedom, for which JSON has no number
# U is too small
DOUBTFUL = Verdict.REFERENCE_IN_DOUBT, Verdict.MISSING_EFFECT, Verdict.UNEXPLAINED


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
    for key in EQUAL_SETTINGS:
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
    x, kind = np.stack([c.parameters.values for c in each]), kinds_of(each[0])
    by_readings, by_bench = zip(*(own_and_bench(c) for c in each), strict=True)
    r2 = repeatability(x, np.stack([np.diag(A) for A in by_readings]), kind) ** 2
    weights = [scaled_inverse(A + np.diag(r2)) for A in by_readings]
    covariance = scaled_inverse(np.sum(weights, axis=0))
    mean = x.mean(axis=0)  # a parameter that all calibrations state exactly is not changed
    theta = mean + covariance @ np.sum([W @ (xi - mean) for W, xi in zip(weights, x, strict=True)], axis=0)
    freedom = np.sum([c.parameters.degrees_of_freedom for c in each], axis=0)
    alone = scaled_inverse(np.sum([scaled_inverse(A) for A in by_readings], axis=0))
    scatter = np.where(r2 > 0.0, np.bincount(kind)[kind] * (len(x) - 1.0), np.inf)
    lines = [
        Contribution(NOISE_SOURCE, "A", "Student's t", alone, freedom),
        Contribution(STATED_ACCURACIES, "B", NORMAL, np.mean(by_bench, axis=0), np.full(len(theta), np.inf)),
        Contribution("repeatability", "A", "Student's t", covariance - alone + np.diag(r2), scatter),
    ]
    result = StageResult("combined", details=StageDetails(calibrations=len(each), repeatability=np.sqrt(r2).tolist()))
    first = replace(each[0], stages=(result,), converged=all(c.converged for c in each), convergence=None)
    return with_values(first, theta, lines).to_json()


def kinds_of(calibration: SensorCalibration) -> Index:
    """Return the kind of each parameter, 0 ..: bias, scale factors, cross-axis elements, then each effect."""
    return np.concatenate([KIND, *(np.full(len(e.values), 3 + k) for k, e in enumerate(calibration.effects))])


def with_values(calibration: SensorCalibration, theta: Values, lines: Sequence[Contribution]) -> SensorCalibration:
    """Return a calibration with other values, in the order of ``parameters``, and a budget of these contributions."""
    effects, at = [], BASE_COUNT
    for effect in calibration.effects:
        effects.append(effect.at(theta[at : at + len(effect.parameters)].tolist()))
        at += len(effect.parameters)
    changed = replace(calibration, bias=theta[BIAS], matrix=matrix_of(theta), effects=tuple(effects))
    return budget_of(changed, lines, {})


def repeatability(x: Values, variance: Values, kind: Index) -> Values:
    """Return r, the standard deviation in addition to the stated variances, of (n, p) values: (p,) array.

    ``variance``: (n, p). ``kind``: (p,), 0 ..; parameters of one kind have one r. The sum decreases with r: bisection.
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


class UnitEstimate(NamedTuple):
    """The estimate of a sensor of a unit, from which the prior of a lot is computed.

    Units with the same ``comparable`` may be siblings. In a file the arrays are lists.
    """

    unit: str
    sensor: str
    lot: str
    comparable: str
    device: str
    refused: str | None
    values: Values
    own: Values
    freedom: Values
    shared: Values
    kind: Index
    known: Mask  # parameters of the sensor itself with a stated uncertainty

    @classmethod
    def read(cls, data: JSON) -> UnitEstimate:
        """Return the estimate of an entry of a file; equal texts of all units share their memory."""
        texts = {k: sys.intern(data[k]) for k in ("sensor", "lot", "comparable")}
        return cls(**{**with_arrays(data), **texts})


class UnitPrior(NamedTuple):
    """The prior of a sensor of a unit, or why it has none."""

    lot: str
    siblings: int = 0
    refused: str | None = None
    outlier: bool = False
    probability: float | None = None
    worst: str = ""  # the parameter with the largest difference of an outlier
    predicted: Prediction = Prediction(NO_VALUES, NO_VALUES, NO_VALUES)
    known: Mask = NO_VALUES.astype(bool)
    shared: Values = NO_VALUES  # mean standard uncertainty of the siblings by errors that they may have in common

    @classmethod
    def read(cls, data: JSON) -> UnitPrior:
        """Return the prior of an entry of a file."""
        known, predicted = np.array(data["known"], bool), Prediction(*map(np.array, data["predicted"]))
        return cls(**{**data, "known": known, "predicted": predicted, "shared": np.array(data["shared"])})


def estimates(row: Mapping[str, Any], calibration: JSON, diagnosis: JSON) -> list[UnitEstimate]:
    """Return the estimate of each sensor of a calibrated unit for the prior of its lot; ``row``: of ``units.csv``."""
    found, lot = [], row.get("lot")
    for sensor in [s for s in SENSORS if calibration[s]]:
        part = calibration[sensor]
        fit = SensorCalibration.from_json(sensor, part)
        own, shared, (freedom, _) = _divided(fit)
        of_sensor = [True] * 12 + [owner_of(e) == Owner.SENSOR for e in fit.effects for _ in e.parameters]
        same = [calibration[key] for key in ("table", "procedure")] + [calibration["methods"][sensor]]
        verdict = (diagnosis.get(sensor) or {}).get("verdict")
        refused = f"the diagnosis of its {sensor}: {plain(verdict)}" if verdict in DOUBTFUL else None
        refused = refused if fit.converged else f"the fit of its {sensor} did not converge"
        x = fit.parameters.values
        found.append(
            UnitEstimate(
                unit=calibration["unit"],
                sensor=sensor,
                lot=calibration["sensor"] + (f", lot {lot}" if lot else ""),
                comparable=json.dumps([*same, (calibration.get("log") or {}).get("axis_map"), fit.parameters.names]),
                device=str(row.get("serial") or x.tobytes()),  # one recording in two units is one device
                refused=refused,
                values=x,
                own=own,
                freedom=np.minimum(freedom, MOST_FREEDOM),
                shared=np.sqrt(np.diag(shared)),
                kind=kinds_of(fit),
                known=np.array(of_sensor) & (np.diag(own) > 0.0),
            )
        )
    return found


def _divided(fit: SensorCalibration) -> tuple[Values, Values, tuple[Values, Values]]:
    """Return the covariance by the noise of the unit, the one by errors that siblings may share, and both freedoms.

    That of the readings follows from the effective one by Welch and Satterthwaite: the bench has infinitely many.
    """
    readings, _ = own_and_bench(fit)
    own, shared = own_and_bench(fit, with_lack_of_fit=True)
    total = np.maximum(np.diag(own + shared), 1e-300)
    of_readings, of_own = np.diag(readings) / total, np.diag(own) / total
    effective, lack = fit.parameters.degrees_of_freedom, of_readings - of_own
    fixed = np.full(len(effective), np.inf)  # elements that a method does not estimate
    freedom = np.multiply(effective, of_readings**2, out=fixed, where=of_readings > 0.0)
    of_shared = np.divide(freedom * (1.0 - of_own) ** 2, lack**2, out=np.full(len(lack), np.inf), where=lack > 1e-6)
    return own, shared, (freedom, of_shared)


def priors_of(found: Iterable[UnitEstimate]) -> tuple[dict[tuple[str, str], UnitPrior], list[JSON]]:
    """Return the prior of each unit and sensor, and the description of each lot and sensor in ``fleet.json``."""
    lots: dict[tuple[str, str], dict[str, list[UnitEstimate]]] = {}
    for estimate in found:
        lots.setdefault((estimate.lot, estimate.sensor), {}).setdefault(estimate.comparable, []).append(estimate)
    priors: dict[tuple[str, str], UnitPrior] = {}
    described = []
    for (lot, sensor), kinds in lots.items():
        of_lot = {e.unit: p for kind in kinds.values() for e, p in zip(kind, _priors(kind, len(kinds)), strict=True)}
        priors |= {(unit, sensor): prior for unit, prior in of_lot.items()}
        without = {unit: p.refused for unit, p in of_lot.items() if p.refused}
        outliers = [unit for unit, p in of_lot.items() if p.outlier]
        described.append(
            {"lot": lot, "sensor": sensor, "units": list(of_lot), "with_prior": len(of_lot) - len(without),
             "outliers": outliers, "without": without}
        )  # fmt: skip
    return priors, described


def _priors(kind: list[UnitEstimate], kinds: int) -> list[UnitPrior]:
    """Return the priors of units that may be siblings; ``kinds``: number of such groups in the lot."""
    able, known = np.array([e.refused is None for e in kind]), np.all([e.known for e in kind], axis=0)
    names = {device: i for i, device in enumerate(dict.fromkeys(e.device for e in kind))}
    device = np.array([names[e.device] for e in kind])
    count, lot = len(set(device[able])), kind[0].lot
    if not known.any():
        return [UnitPrior(lot, refused=f"the method states no uncertainty of the {e.sensor}") for e in kind]
    if count <= MIN_SIBLINGS:
        others = "; the other units of the lot differ in table, procedure, method, axes or effects" if kinds > 1 else ""
        few = f"{count} devices of the lot can be compared, {MIN_SIBLINGS + 1} or more are needed{others}"
        return [UnitPrior(lot, refused=e.refused or few) for e in kind]
    x, own = np.stack([e.values[known] for e in kind]), np.stack([e.own[np.ix_(known, known)] for e in kind])
    lots = lot_priors(x, own, np.stack([e.freedom[known] for e in kind]), able, (device, kind[0].kind[known]))
    shared = np.mean([e.shared for e, a in zip(kind, able, strict=True) if a], axis=0)
    return [_prior(e, lots, i, known, shared) for i, e in enumerate(kind)]


def _prior(estimate: UnitEstimate, lots: LotPrior, i: int, known: Mask, shared: Values) -> UnitPrior:
    siblings, p, refused, worst = int(lots.siblings[i]), float(lots.probability[i]), estimate.refused, ""
    outlier = not refused and bool(lots.outlier[i])
    if outlier:
        names = np.array(json.loads(estimate.comparable)[-1])[known]
        most = int(np.argmax(np.abs(lots.deviation[i])))
        worst = f"{plain(str(names[most]))} by {number(abs(float(lots.deviation[i, most])), 2)}"
        refused = f"it differs from its {siblings} siblings (p = {number(p, 2)})"
    elif not refused and siblings < MIN_SIBLINGS:
        refused = f"without outliers {siblings} siblings remain, {MIN_SIBLINGS} or more are needed"
    predicted = Prediction(*(values[i] for values in lots.predicted))
    return UnitPrior(estimate.lot, siblings, refused, outlier, p, worst, predicted, known, shared)


def calibration_with_prior(calibration: JSON, priors: Mapping[str, UnitPrior]) -> JSON | None:
    """Return a calibration with the priors of its sensors, in the form of ``calibrations/<unit>.json``.

    ``lot_prior`` states the prior of each sensor, or the reason why it has none. Returns None if no sensor has a prior.
    """
    if all(prior.refused for prior in priors.values()):
        return None
    document = {**calibration, "lot_prior": {}}
    for sensor, prior in priors.items():
        document["lot_prior"][sensor] = {"lot": prior.lot, "siblings": prior.siblings, "refused": prior.refused}
        if not prior.refused:
            document[sensor], added = _sensor_with_prior(sensor, calibration[sensor], prior)
            document["lot_prior"][sensor] |= added
    return document


def _sensor_with_prior(sensor: str, part: JSON, prior: UnitPrior) -> tuple[JSON, JSON]:
    fit = SensorCalibration.from_json(sensor, part)
    own, shared, (freedom, of_shared) = _divided(fit)
    known, u = prior.known, np.sqrt(np.diag(shared))
    found = with_prior(fit.parameters.values, own, prior.predicted, known)
    growth = np.divide(np.maximum(u, prior.shared), u, out=np.ones(len(u)), where=u > 0.0)
    remark = f"of {prior.lot}: mean and spread of {prior.siblings} siblings"
    lines = [
        Contribution(NOISE_SOURCE, "A", "Student's t", found.own, freedom),
        Contribution(LINE, "A", "Student's t", found.lot, found.lot_freedom, remark=remark),
        Contribution(SHARED_SOURCES, "B", NORMAL, shared * np.outer(growth, growth), of_shared),
    ]
    stage = StageResult("lot_prior", details=StageDetails(lot=prior.lot, siblings=prior.siblings))
    after = with_values(replace(fit, stages=(*fit.stages, stage)), found.values, lines)
    not_included = fit.budget.not_included if fit.budget else ()
    budget = after.budget and replace(after.budget, not_included=not_included)
    added = {
        "parameters": [name for name, k in zip(fit.parameters.names, known, strict=True) if k],
        "mean": prior.predicted.mean.tolist(),
        "standard_deviation": np.sqrt(prior.predicted.variance).tolist(),
        "share": found.share[known].tolist(),
        "probability": prior.probability,
    }
    return replace(after, budget=budget).to_json() | {
        key: value for key, value in part.items() if key.startswith(("implausible", "beyond"))
    }, added


def with_card(page: str, calibration: JSON, document: JSON | None, priors: Mapping[str, UnitPrior]) -> str:
    """Return a unit's page with the section on its prior, before the section on its runs."""
    rows: dict[str, list[Any]] = {}
    with_priors = document or {"lot_prior": {}}
    for sensor, added in with_priors["lot_prior"].items():
        both = [{p.name: p for p in fitted_parameters(d[sensor])} for d in (calibration, with_priors)]
        shown = (added.get(key, []) for key in ("parameters", "mean", "standard_deviation", "share"))
        rows[sensor] = [(*(d[name] for d in both), *rest) for name, *rest in zip(*shown, strict=True)]
    section = template("lot.html").render(calibration=calibration, document=document, priors=priors, rows=rows)
    return page.replace(MARK, section + MARK, 1)
