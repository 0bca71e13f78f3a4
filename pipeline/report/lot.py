"""Calibrations with the prior of their lot (``combine=lot``): siblings of a unit, its document, the part of its page.

A lot is the units of a sensor model with one value of the column ``lot``. Siblings have the same table, procedure,
method, axes and parameters: so their parameters have the same meaning in the same frame, and contain the same error of
the table. Effects of the recording, the mounting and the table have no prior. ``pipeline.estimation.lot_prior``
computes the estimate.
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pipeline.estimation.lot_prior import FEWEST, LotPrior, Prediction, lot_priors, with_prior
from pipeline.estimation.uncertainty_budget import NOISE, own_and_bench
from pipeline.model.effects import owner_of
from pipeline.model.effects.base import Owner
from pipeline.records import NORMAL, SENSORS, Contribution, Index, Mask, SensorCalibration, StageResult, Values
from pipeline.report.combined import BENCH, kinds_of, values_of, with_values
from pipeline.report.numbers import number, plain
from pipeline.report.pages import template
from pipeline.report.parameters import fitted_parameters
from pipeline.report.run_section import MARK

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping


JSON = dict[str, Any]
LINE = "prior of the lot"
LACK_OF_FIT = "lack of fit"  # errors of a table are part of it: siblings may have it in common
SHARED = f"{BENCH}, and {LACK_OF_FIT}"
NONE = np.empty(0)
MOST_FREEDOM = 1e12  # instead of infinitely many degrees of freedom, for which JSON has no number
DOUBTFUL = ("reference_in_doubt", "missing_effect", "unexplained")  # verdicts: the uncertainty is too small


class Estimate(NamedTuple):
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
    def read(cls, data: JSON) -> Estimate:
        """Return the estimate of an entry of a file; equal texts of all units share their memory."""
        texts = {k: sys.intern(data[k]) for k in ("sensor", "lot", "comparable")}
        arrays = {k: np.array(data[k]) for k in ("values", "own", "freedom", "shared", "kind", "known")}
        return cls(**{**data, **texts, **arrays})


class Prior(NamedTuple):
    """The prior of a sensor of a unit, or why it has none."""

    lot: str
    siblings: int = 0
    refused: str | None = None
    outlier: bool = False
    probability: float | None = None
    worst: str = ""  # the parameter with the largest difference of an outlier
    predicted: Prediction = Prediction(NONE, NONE, NONE)
    known: Mask = NONE.astype(bool)
    shared: Values = NONE  # mean standard uncertainty of the siblings by errors that they may have in common

    @classmethod
    def read(cls, data: JSON) -> Prior:
        """Return the prior of an entry of a file."""
        known, predicted = np.array(data["known"], bool), Prediction(*map(np.array, data["predicted"]))
        return cls(**{**data, "known": known, "predicted": predicted, "shared": np.array(data["shared"])})


def estimates(row: Mapping[str, Any], calibration: JSON, diagnosis: JSON) -> list[Estimate]:
    """Return the estimate of each sensor of a calibrated unit for the prior of its lot.

    ``row``: of ``units.csv``; ``calibration``, ``diagnosis``: as published.
    """
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
        x = values_of(fit)
        found.append(
            Estimate(
                unit=calibration["unit"],
                sensor=sensor,
                lot=calibration["sensor"] + (f", lot {lot}" if lot else ""),
                comparable=json.dumps([*same, (calibration.get("log") or {}).get("axis_map"), fit.parameter_names()]),
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

    The degrees of freedom of the readings follow from the effective ones by Welch and Satterthwaite, because the bench
    has infinitely many.
    """
    readings, _ = own_and_bench(fit)
    own, shared = own_and_bench(fit, LACK_OF_FIT)
    total = np.maximum(np.diag(own + shared), 1e-300)
    of_readings, of_own = np.diag(readings) / total, np.diag(own) / total
    freedom, lack = fit.effective_freedom() * of_readings**2, of_readings - of_own
    of_shared = np.divide(freedom * (1.0 - of_own) ** 2, lack**2, out=np.full(len(lack), np.inf), where=lack > 1e-6)
    return own, shared, (freedom, of_shared)


def priors_of(found: Iterable[Estimate]) -> tuple[dict[tuple[str, str], Prior], list[JSON]]:
    """Return the prior of each unit and sensor, and the description of each lot and sensor in ``fleet.json``."""
    lots: dict[tuple[str, str], dict[str, list[Estimate]]] = {}
    for estimate in found:
        lots.setdefault((estimate.lot, estimate.sensor), {}).setdefault(estimate.comparable, []).append(estimate)
    priors: dict[tuple[str, str], Prior] = {}
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


def _priors(kind: list[Estimate], kinds: int) -> list[Prior]:
    """Return the priors of units that may be siblings; ``kinds``: number of such groups in the lot."""
    able, known = np.array([e.refused is None for e in kind]), np.all([e.known for e in kind], axis=0)
    names = {device: i for i, device in enumerate(dict.fromkeys(e.device for e in kind))}
    device = np.array([names[e.device] for e in kind])
    count, lot = len(set(device[able])), kind[0].lot
    if not known.any():
        return [Prior(lot, refused=f"the method states no uncertainty of the {e.sensor}") for e in kind]
    if count <= FEWEST:
        others = "; the other units of the lot differ in table, procedure, method, axes or effects" if kinds > 1 else ""
        few = f"{count} devices of the lot can be compared, {FEWEST + 1} or more are needed{others}"
        return [Prior(lot, refused=e.refused or few) for e in kind]
    x, own = np.stack([e.values[known] for e in kind]), np.stack([e.own[np.ix_(known, known)] for e in kind])
    lots = lot_priors(x, own, np.stack([e.freedom[known] for e in kind]), able, (device, kind[0].kind[known]))
    shared = np.mean([e.shared for e, a in zip(kind, able, strict=True) if a], axis=0)
    return [_prior(e, lots, i, known, shared) for i, e in enumerate(kind)]


def _prior(estimate: Estimate, lots: LotPrior, i: int, known: Mask, shared: Values) -> Prior:
    siblings, p, refused, worst = int(lots.siblings[i]), float(lots.probability[i]), estimate.refused, ""
    outlier = not refused and bool(lots.outlier[i])
    if outlier:
        names = np.array(json.loads(estimate.comparable)[-1])[known]
        most = int(np.argmax(np.abs(lots.deviation[i])))
        worst = f"{plain(str(names[most]))} by {number(abs(float(lots.deviation[i, most])), 2)}"
        refused = f"it differs from its {siblings} siblings (p = {number(p, 2)})"
    elif not refused and siblings < FEWEST:
        refused = f"without outliers {siblings} siblings are left, {FEWEST} or more are needed"
    predicted = Prediction(*(values[i] for values in lots.predicted))
    return Prior(estimate.lot, siblings, refused, outlier, p, worst, predicted, known, shared)


def calibration_with_prior(calibration: JSON, priors: Mapping[str, Prior]) -> JSON | None:
    """Return a calibration with the priors of its sensors, in the form of ``calibrations/<unit>.json``.

    ``lot_prior`` states the prior of each sensor, or the reason why it has none. Returns None if no sensor has a prior.
    """
    if all(prior.refused for prior in priors.values()):
        return None
    document = {**calibration, "lot_prior": {}}
    for sensor, prior in priors.items():
        document["lot_prior"][sensor] = {"lot": prior.lot, "siblings": prior.siblings, "refused": prior.refused}
        if not prior.refused:
            document[sensor], added = _sensor(sensor, calibration[sensor], prior)
            document["lot_prior"][sensor] |= added
    return document


def _sensor(sensor: str, part: JSON, prior: Prior) -> tuple[JSON, JSON]:
    fit = SensorCalibration.from_json(sensor, part)
    own, shared, (freedom, of_shared) = _divided(fit)
    known, u = prior.known, np.sqrt(np.diag(shared))
    found = with_prior(values_of(fit), own, prior.predicted, known)
    growth = np.divide(np.maximum(u, prior.shared), u, out=np.ones(len(u)), where=u > 0.0)
    remark = f"of {prior.lot}: mean and spread of {prior.siblings} siblings"
    lines = [
        Contribution(NOISE, "A", "Student's t", found.own, freedom),
        Contribution(LINE, "A", "Student's t", found.lot, found.lot_freedom, remark=remark),
        Contribution(SHARED, "B", NORMAL, shared * np.outer(growth, growth), of_shared),
    ]
    stage = StageResult("lot_prior", {}, None, None, {"lot": prior.lot, "siblings": prior.siblings})
    after = with_values(replace(fit, stages=(*fit.stages, stage)), found.values, lines)
    budget = {**(after.budget or {}), "not_included": (part.get("uncertainty_budget") or {}).get("not_included", [])}
    added = {
        "parameters": [name for name, k in zip(fit.parameter_names(), known, strict=True) if k],
        "mean": prior.predicted.mean.tolist(),
        "standard_deviation": np.sqrt(prior.predicted.variance).tolist(),
        "share": found.share[known].tolist(),
        "probability": prior.probability,
    }
    return replace(after, budget=budget).to_json() | {
        key: value for key, value in part.items() if key.startswith("implausible")
    }, added


def with_card(page: str, calibration: JSON, document: JSON | None, priors: Mapping[str, Prior]) -> str:
    """Return a unit's page with the section on its prior, before the section on its runs."""
    rows: dict[str, list[Any]] = {}
    with_priors = document or {"lot_prior": {}}
    for sensor, added in with_priors["lot_prior"].items():
        both = [{p.name: p for p in fitted_parameters(d[sensor])} for d in (calibration, with_priors)]
        shown = (added.get(key, []) for key in ("parameters", "mean", "standard_deviation", "share"))
        rows[sensor] = [(*(d[name] for d in both), *rest) for name, *rest in zip(*shown, strict=True)]
    section = template("lot.html").render(calibration=calibration, document=document, priors=priors, rows=rows)
    return page.replace(MARK, section + MARK, 1)
