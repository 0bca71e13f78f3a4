"""Which physical effect is missing: a sensor's part of ``diagnoses/<unit>.json``.

The selection (``pipeline.estimation.selection``, or ``...multi_position.selection`` without a table) finds the effects;
``turntable`` and ``multi_position`` state its ``Findings`` in the same terms. These become a document (``findings``),
whose verdict follows from it and from the error on held-out motion (``verdict``).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.diagnosis import multi_position, turntable
from pipeline.diagnosis.findings import Case, Findings, document_of
from pipeline.diagnosis.verdict import EXPLAINED, LIKELY, Evidence, HeldOut, judged, may_be_unknown
from pipeline.errors import ConvergenceError, NotObservableError
from pipeline.estimation.candidates import AUTO, MOUNTING, TILT, configured_effects
from pipeline.estimation.effects import mountings_by_gravity, of_the_angle
from pipeline.estimation.free_curves import OTHER
from pipeline.estimation.rest_means import is_multi_position
from pipeline.model.effects import catalogue, effect
from pipeline.records import Noise, Recording, SensorCalibration, coverage_factor
from pipeline.validation.heldout import last_error, static_error
from pipeline.validation.samples import HeldOutCase

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence


IN_DOUBT = ("reference_in_doubt", "unexplained")  # verdicts on an accelerometer whose mountings may be wrong
REFERENCE, SEATS = (
    "N-REFERENCE",
    "N-SEATS",
)  # notes: the reference contradicts itself; one mounting does not explain all
LEANING = ("mounting", "table_axis_nonorthogonality")  # effects that move a turn axis in the body
COMPARED = ("bias", "scale_factor", "non_orthogonality", "rotation")  # parts compared with the uncertainty of both fits
FULL = "full"  # ``diagnosis.depth`` at which everything is computed, whatever the verdict


def diagnose(
    calibration: SensorCalibration,
    recordings: Sequence[Recording],
    noise: Noise | None,
    settings: Mapping[str, Any],
    accelerometer: SensorCalibration | None = None,
    *,
    validation: Mapping[str, Any] | None = None,
    gravity: Mapping[str, Any] | None = None,
    moves: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Return a sensor's part of ``diagnoses/<unit>.json``.

    ``calibration``: its effects are starts for those that are configured. ``recordings``: all of the unit; those of
    role ``validation`` judge, and take no part in the selection. ``settings``: sections ``sensor``, ``table`` and
    ``effects``; ``procedure`` for recordings by hand. ``accelerometer``: for a gyroscope; by hand it needs the
    direction of gravity, and without it, it is calibrated again. ``gravity``: diagnosis of the accelerometer, which
    determines the mountings or shows that the turn axes of the gyroscope lean. ``moves``: part
    ``gravity_direction`` of ``validations/<unit>.json``, for a gyroscope by hand. ``validation``: the sensor's part
    of ``validations/<unit>.json``; without it, a free fit stands for the calibration.

    Returns ``verdict, reason`` (``pipeline.diagnosis.verdict``), ``residual_over_noise, selected, ranking, probability,
    answer_set, upper_limit`` (``pipeline.estimation.posterior``), ``to_distinguish, not_observable, unexplained,
    next_experiment, override``; in addition ``configured, suggested_effect``
    (``pipeline.diagnosis.functional_form_search``), ``wander`` (``ratio, time_s, standard_deviation, expected,
    inflated``), ``pictures`` (``...residual_plots``), ``method_errors`` (``...method_errors``), on a table ``held_out``
    (``error_before, error_after, floor``), without one ``cross_validation``.
    """
    sensor = calibration.sensor
    by_hand = is_multi_position(sensor, recordings)
    procedure = multi_position if by_hand else turntable
    configured = configured_effects(sensor, settings, [] if by_hand else recordings)
    by_gravity = sensor == "gyroscope" and MOUNTING in configured
    leaning = {} if by_hand or sensor == "accelerometer" else _leaning(gravity, accelerometer)
    if by_gravity:
        accelerometer = mountings_by_gravity(recordings, settings)
    elif not by_hand:  # its own mountings are no prior
        accelerometer = None
    case = Case(calibration, recordings, noise, settings, accelerometer, configured)
    full = (settings.get("diagnosis") or {}).get("depth") == FULL

    def judge(found: Findings | None, document: dict[str, Any]) -> tuple[dict[str, Any], bool]:
        evidence = evidence_of(document, case, validation, found)
        if moves and "largest_expected_rms_deg" in moves:
            evidence = replace(evidence, moves=(moves["rms_deg"]["after"], moves["largest_expected_rms_deg"]))
        if by_gravity and gravity:
            evidence = replace(evidence, doubts=[*evidence.doubts, *_doubts_of_gravity(gravity, case)])
        elif leaning and not leaning.keys() & {*configured, *document["selected"]}:
            evidence = replace(evidence, doubts=[*evidence.doubts, *_doubts_of_axes(leaning, calibration)])
        verdict = judged(document, evidence)
        return verdict, full or may_be_unknown(verdict["verdict"], evidence)

    try:
        found = procedure.findings(case)
    except NotObservableError as reason:
        return judge(None, _not_enough_data(sensor, configured, reason.message, procedure.NEEDED))[0]
    document, unknown = judge(found, document_of(found, case))
    if unknown and found.search:
        found = found.search() or found
        document, _ = judge(found, document_of(found, case))
    if found.deeper and (full or document["verdict"] != "nothing_missing"):
        document |= found.deeper()
    return document


def held_out_of(part: Mapping[str, Any] | None) -> HeldOut | None:
    """Return the last error of a sensor's validation; None where nothing is held out or no interval is known."""
    if not part or not part.get("held_out") or not part.get("expected_rms_error"):
        return None
    return HeldOut(float(part["steps"][-1]["rms_error"]), *map(float, part["expected_rms_error"]))


def doubts_of(sensor: str, recordings: Sequence[Recording], *, seats: bool = True) -> list[str]:
    """Return what the notes on the recordings say of the reference of a sensor.

    A note on turns of the other sensor concerns that one alone. ``seats``: whether the note counts that one mounting
    does not explain the turns.
    """
    codes = {REFERENCE, SEATS} if seats else {REFERENCE}
    own = [r for r in recordings if r.role not in {"accelerometer", "gyroscope"} or r.role == sensor]
    return [f"{r.name}: {note.detail}" for r in own for note in r.notes if note.code in codes]


def evidence_of(
    document: Mapping[str, Any], case: Case, validation: Mapping[str, Any] | None, found: Findings | None
) -> Evidence:
    """Return what decides; the held-out error of further fits only where that of the calibration is above its interval.

    ``document`` is the diagnosis of the selection alone, and ``found`` what it was made of; without a ``validation``, a
    free fit stands for the calibration.
    """
    sensor, recordings, settings = case.sensor, case.recordings, case.settings
    method = settings.get("method") or {}
    free, full = (found.free, found.full) if found else (None, None)

    def error_of(fit: Callable[[], SensorCalibration] | None, *, smoothed: bool) -> HeldOut | None:
        if fit is None or case.noise is None or found is None:
            return None
        try:
            judged_on = HeldOutCase(fit(), recordings, case.noise, settings, found.other)
            error = last_error(judged_on, judged_on.held_out_samples(smoothed=smoothed))
        except ConvergenceError:  # the fit's effects cannot be subtracted from the held-out readings
            return None
        return None if error is None else HeldOut(error[0], *error[1])

    static = None
    if case.noise is not None:
        static = static_error(HeldOutCase(case.calibration, recordings, case.noise, settings, case.accelerometer))
    accepted = ((settings.get("sensor") or {}).get(sensor) or {}).get("accept_implausible")
    implausible = [
        e["effect"] for e in document["ranking"] if e["effect"] in document["selected"] and not e["plausible"]
    ]
    published = held_out_of(validation) if validation else error_of(free, smoothed=False)
    contradicted = published is not None and published.above
    return Evidence(
        sensor,
        str(document["verdict"]),
        tuple(document["selected"]),
        document["residual_over_noise"],
        found.left_over_noise if found else None,
        published=published,
        static=HeldOut(static[0], *static[1]) if static else None,
        agreement=(validation or {}).get("agreement"),
        free=error_of(free, smoothed=True) if contradicted else None,
        full=error_of(full, smoothed=True) if contradicted else None,
        doubts=[
            *doubts_of(sensor, recordings, seats=not _seats_explained(document, sensor, found)),
            *(found.departures if found else ()),
        ],
        approximations=[error["name"] for error in document["method_errors"] if error["name"] in COMPARED],
        unknown=[entry["covariate"] for entry in document["unexplained"] if not entry.get("explained_by")],
        beyond=[
            name.removeprefix(OTHER)
            for name, probability in document["probability"].items()
            if name.startswith(OTHER) and probability > LIKELY
        ],
        implausible=() if accepted else implausible,
        held_out=document.get("held_out"),
        method=str(method.get(sensor) or ""),
        as_printed=bool(method.get("as_printed")),
        filtered=any(r.filter["name"] != "none" for r in recordings if r.role == "validation"),
        on_table=found is None or found.on_table,
    )


def _seats_explained(document: Mapping[str, Any], sensor: str, found: Findings | None) -> bool:
    """Return whether the fit explains that turns look as if they were mounted differently.

    Mountings or zeros are in the model or selected. Or they were candidates of the accelerometer, were not selected,
    and what is left is noise: an effect that the checks of the recordings do not know looked like a mounting.
    """
    if any(effect(name).of_turns for name in (*document["configured"], *document["selected"])):
        return True
    left = None if found is None else found.left_over_noise
    return sensor == "accelerometer" and left is not None and left <= EXPLAINED


def _doubts_of_gravity(accelerometer: Mapping[str, Any], case: Case) -> list[str]:
    """Return why the mountings that an accelerometer determines may be wrong.

    A tilt that the accelerometer misses is no doubt where fitting it shifts no mounting by more than its uncertainty.
    """
    who = "the accelerometer, which determines the mountings,"
    if accelerometer["verdict"] in IN_DOUBT:
        return [f"{who} has the verdict {accelerometer['verdict']}"]
    missing = [name for name in accelerometer["selected"] if of_the_angle(name)]
    if missing == [TILT] and _tilt_is_within_uncertainty(case):
        return []
    fault = "an error of the table that shifts the mountings: add it to effects.accelerometer"
    return [f"{who} misses {' and '.join(missing)}, {fault}"] if missing else []


def _leaning(diagnosis: Mapping[str, Any] | None, fit: SensorCalibration | None) -> dict[str, float]:
    """Return by how much turn axes lean at most by the effects that an accelerometer has or misses, deg."""
    selected = (diagnosis or {}).get("selected", ())
    found = {e["effect"]: e["parameters"] for e in (diagnosis or {}).get("ranking", ()) if e["effect"] in selected}
    found |= {e.name: e.parameters for e in (fit.effects if fit else ())}
    return {name: max(abs(p["value"]) for p in found[name].values()) for name in LEANING if name in found}


def _doubts_of_axes(leaning: Mapping[str, float], calibration: SensorCalibration) -> list[str]:
    """Return why a matrix is wrong whose turn axes lean: no gyroscope tells that from a misalignment of its own."""
    if calibration.covariance is None:
        return []
    U = np.degrees(2.0 * np.sqrt(float(np.max(np.diag(calibration.covariance)[3:12]))))
    return [
        f"by the accelerometer's {name} the turn axes lean by up to {size:.2g} deg, and the matrix of the gyroscope is "
        f"off by as much ({np.radians(size):.2g}), beyond its uncertainty"
        for name, size in leaning.items()
        if size > U
    ]


def _tilt_is_within_uncertainty(case: Case) -> bool:
    """Return whether the mountings by gravity with a tilt of the table are those without it, within their U."""
    effects, known = case.settings["effects"], case.accelerometer
    listed = effects["accelerometer"]
    with_tilt = [*([] if listed == AUTO else listed), TILT]
    settings = {**case.settings, "effects": {**effects, "accelerometer": with_tilt}}
    other = mountings_by_gravity(case.recordings, settings)
    if known is None or other is None or known.covariance is None:
        return False
    before, after = ({e.name: e.values for e in found.effects}[MOUNTING] for found in (known, other))
    first = known.parameter_names().index(next(n for n in known.parameter_names() if n.startswith(f"{MOUNTING}.")))
    u = np.sqrt(np.diag(known.covariance)[first : first + len(before)])
    return bool(np.all(np.abs(after - before) < coverage_factor(known.effective_freedom()[first]) * u))


def _not_enough_data(sensor: str, configured: list[str], reason: str, needed: str) -> dict[str, Any]:
    """Return the diagnosis of recordings that show no effect, and what to record."""
    names = [n for n, this in catalogue().items() if sensor in this.sensors and n not in configured]
    return {
        "verdict": "not_enough_data",
        "residual_over_noise": None,
        "selected": [],
        "ranking": [],
        "probability": {},
        "answer_set": [],
        "upper_limit": {},
        "to_distinguish": "",
        "not_observable": [{"effect": name, "reason": reason} for name in names],
        "unexplained": [],
        "suggested_effect": None,
        "method_errors": [],
        "next_experiment": needed,
        "override": "",
        "configured": configured,
        "wander": None,
    }
