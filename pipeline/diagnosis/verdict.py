"""The verdict on one sensor: what its selection found, against the error on held-out motion.

The first that applies:

    reference_in_doubt  a check of the recordings found a contradiction (notes ``N-REFERENCE``, ``N-SEATS``), a face or
                        turn by hand departs from what is stated, or the residual of the fit is noise alone and the
                        held-out error is above its interval
    missing_effect      effects were selected, and with them the held-out error lies in its interval; effects beyond
                        the sensor's limits only where they lower the held-out error
    unexplained         the residual of the fit, or the held-out error, is above what noise leaves, unexplained
    floor_in_doubt      the held-out error is below its interval, or the residual far below the noise
    left_by_method      the error is above, but that of a free fit of the same recordings is not; or the method's matrix
                        or bias differs from that of a free fit by more than both fits' noise
    not_enough_data, nothing_missing

The interval is the 99 % one of ``pipeline.validation.expected_error``; where it is not known, it decides nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from pipeline.diagnosis.words import listed, of_unknown, plain
from pipeline.estimation.something_else import OTHER
from pipeline.model.effects import effect
from pipeline.model.effects.base import unit_of
from pipeline.validation.heldout import last_error

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from pipeline.diagnosis.findings import Findings
    from pipeline.records import Noise, Recording, SensorCalibration

IN_DOUBT = "N-REFERENCE"
SEATS = "N-SEATS"  # the note that one mounting does not explain the turns
EXPLAINED = 1.5  # times the noise: a residual of a fit up to it is noise; 0.92 to 1.14 in 140 sensors of null families
MOSTLY = 0.5  # share of the residual's excess that selected effects must explain where something else is left
BELIEVED = 3  # effects at once; more are what the catalogue makes of physics that it does not hold
UNKNOWN_SHARE = 0.03  # of the gain in 2 log L by what was selected, above which what is left is worth naming
LIKELY = 0.5  # probability of something outside the catalogue, above which what was selected is no explanation
SURE = 0.9  # the same where the held-out error is at the noise floor with what was selected (thermal_ramp, long-004)
WORSE = 0.3  # of the noise's mean square, by which what was selected may raise the held-out error's at most
HELPFUL = 0.1  # share of the held-out error's mean square that each effect worth a try takes away
LEFT_OVER = 1.05  # times the noise floor: four standard deviations of the rms of 3 x 1000 samples
QUIET = 0.6  # times the noise: a residual below it contradicts the noise of the rests
COMPARED = ("bias", "scale_factor", "non_orthogonality", "rotation")  # parts compared with the uncertainty of both fits
GIVEN = "given"  # the method that takes an existing calibration; nothing is fitted, and effects cannot be added to it
FREE = ("reference_least_squares", "nonlinear_least_squares", "cholesky_lu")  # methods that leave bias and matrix free


@dataclass(frozen=True)
class HeldOut:
    """A held-out rms error and the interval in which it is expected, g or deg/s."""

    error: float
    low: float
    high: float

    @property
    def above(self) -> bool:
        """Whether more is left than noise and stated uncertainties explain."""
        return self.error > self.high

    @property
    def below(self) -> bool:
        """Whether less is left than the noise would leave."""
        return self.error < self.low


@dataclass(frozen=True)
class Evidence:
    """What decides the verdict on a sensor."""

    sensor: str
    found: str  # verdict of the selection alone
    selected: Sequence[str] = ()
    over_noise: float | None = None  # residual of the fit over the noise, without what was selected
    left_over_noise: float | None = None  # and with it
    published: HeldOut | None = None  # of the unit's calibration
    moves: tuple[float, float] | None = None  # rms error of held-out moves, and the largest that is expected, deg
    free: HeldOut | None = None  # of a free fit of the same recordings; filtered ones against the filtered reference
    full: HeldOut | None = None  # of the free fit with the selected effects
    doubts: Sequence[str] = ()  # what the recordings' checks say of the reference
    approximations: Sequence[str] = ()  # what the method's matrix and bias lack (``pipeline.diagnosis.method_errors``)
    unknown: Sequence[str] = ()  # covariates on which the residual depends, given what was selected
    beyond: Sequence[str] = ()  # covariates on which something outside the catalogue is likely to depend
    implausible: Sequence[str] = ()  # selected effects beyond the sensor's limits, where that is not accepted
    held_out: Mapping[str, float] | None = None  # ``error_before, error_after, floor`` of the selection's own fits
    method: str = ""
    as_printed: bool = False  # whether the method takes the equations of the founding document as printed
    filtered: bool = False
    on_table: bool = True  # a few rests by hand may leave a small residual by chance


def verdict_of_selection(
    names: Sequence[str],
    unknown: Sequence[Mapping[str, Any]],
    share: float,
    gain: float,
    *,
    above_noise: bool,
    held_out: Mapping[str, float] | None,
    beyond: float = 0.0,
) -> str:
    """Return the verdict of a selection alone.

    What is selected must explain most of the excess, unless nothing else is left. A residual that still depends on
    something beyond the catalogue is unexplained where that is worth naming; next to a much
    larger effect it may be the small error of its linear equation. ``share`` of the residual's excess and ``gain`` in
    2 log L are what the selected effects explain; ``above_noise``: the residual stays far above the noise with them;
    ``beyond``: probability of physics outside the catalogue; it counts less where held-out motion shows noise alone.
    """
    if _made_worse(held_out) or len(names) > BELIEVED:
        return "unexplained"
    at_floor = held_out is not None and held_out["error_after"] <= held_out["floor"]
    if names and beyond > (SURE if at_floor else LIKELY):
        return "unexplained"
    if (unknown or above_noise) and (not names or share < MOSTLY):
        return "unexplained"
    if unknown and max(float(found["delta_bic"]) for found in unknown) > UNKNOWN_SHARE * gain:
        return "unexplained"
    return "missing_effect" if names else "nothing_missing"


def _made_worse(held_out: Mapping[str, float] | None) -> bool:
    """Return whether what was selected raises the held-out error: then it is not what is missing."""
    if held_out is None:
        return False
    more = held_out["error_after"] ** 2 - held_out["error_before"] ** 2
    return more > WORSE * held_out["floor"] ** 2


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
    codes = {IN_DOUBT, SEATS} if seats else {IN_DOUBT}
    own = [r for r in recordings if r.role not in {"accelerometer", "gyroscope"} or r.role == sensor]
    return [f"{r.name}: {note.detail}" for r in own for note in r.notes if note.code in codes]


def evidence_of(
    document: Mapping[str, Any],
    sensor: str,
    recordings: Sequence[Recording],
    noise: Noise | None,
    settings: Mapping[str, Any],
    *,
    validation: Mapping[str, Any] | None,
    found: Findings | None = None,
) -> Evidence:
    """Return what decides; the held-out error of further fits only where that of the calibration is above its interval.

    ``document`` is the diagnosis of the selection alone, and ``found`` what it was made of; without a ``validation``, a
    free fit stands for the calibration.
    """
    method = settings.get("method") or {}
    free, full = (found.free, found.full) if found else (None, None)

    def error_of(fit: Callable[[], SensorCalibration] | None, *, smoothed: bool) -> HeldOut | None:
        if fit is None or noise is None or found is None:
            return None
        error = last_error(fit(), recordings, noise, settings, other=found.other, smoothed=smoothed)
        return None if error is None else HeldOut(error[0], *error[1])

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


def decide(e: Evidence) -> tuple[str, str]:
    """Return the verdict and its reason as one or two sentences; empty where the selection is the reason."""
    if e.doubts:
        return "reference_in_doubt", f"A check of the recordings contradicts the reference: {'; '.join(e.doubts)}."
    if e.published and e.published.above:
        return _above(e, e.published)
    if e.found == "unexplained" or (e.found == "missing_effect" and _unconfirmed(e)):
        return "unexplained", _why_unexplained(e)
    if e.moves and e.moves[0] > e.moves[1] and e.found != "missing_effect":
        return "unexplained", (
            f"After the held-out moves, the integrated rate misses the direction of gravity by {e.moves[0]:.3g} deg "
            f"(rms); noise and stated uncertainties explain at most {e.moves[1]:.3g} deg. Check that the unit rested "
            "before and after each of them, without sliding, and that no samples are missing."
        )
    return (e.found, _beyond(e)) if e.found == "missing_effect" else _within(e)


def _unconfirmed(e: Evidence) -> bool:
    """Return whether effects beyond the sensor's limits were selected that do not lower the held-out error."""
    if not e.implausible or e.held_out is None:
        return False
    return e.held_out["error_after"] ** 2 > (1.0 - HELPFUL) * e.held_out["error_before"] ** 2


def _beyond(e: Evidence) -> str:
    """Return which selected effects exceed the limits of the sensor, as a sentence."""
    if not e.implausible:
        return ""
    beyond = listed([plain(name) for name in e.implausible])
    return (
        f"To explain the residual, {beyond} would have to exceed the limits of the sensor's data sheet. Possible "
        "causes: a recording of another unit, a wrong range, an effect that is not in the catalogue. If the sensor is "
        f"known to exceed its data sheet, set sensor.{e.sensor}.accept_implausible=true."
    )


def _why_unexplained(e: Evidence) -> str:
    """Return why no effect of the catalogue explains the residual, as sentences."""
    names, unit = listed([plain(name) for name in e.selected]), unit_of(e.sensor)
    found = []
    if e.implausible:
        found.append(_beyond(e))
    if _made_worse(e.held_out) and e.held_out:
        before, after = e.held_out["error_before"], e.held_out["error_after"]
        found.append(f"With {names} the error on held-out motion rises from {before:.3g} to {after:.3g} {unit}.")
    if len(e.selected) > BELIEVED:
        found.append(
            f"It takes {len(e.selected)} effects together to explain the residual, more than a unit usually has: the "
            "true one may not be in the catalogue."
        )
    given = f" with {names}" if e.selected else ""
    if e.unknown:
        depends = listed([plain(n) for n in e.unknown])
        found.append(f"The residual{given} depends on {depends} in a form that no effect of the catalogue has.")
    if e.beyond and e.selected and not e.unknown:
        follows = listed([plain(n) for n in e.beyond])
        found.append(f"Beside {names}, something outside the catalogue is likely to depend on {follows}.")
    left = e.left_over_noise if e.selected else e.over_noise
    if left is not None and (left > EXPLAINED or not found):
        found.append(f"The residual of the fit{given} is {left:.3g} times the noise.")
    return " ".join(found) or "No effect of the catalogue explains the residual."


def _within(e: Evidence) -> tuple[str, str]:
    """Return the verdict where no effect was found and the held-out error is not above its interval."""
    if e.published and e.published.below:
        unit, held = unit_of(e.sensor), e.published
        return "floor_in_doubt", (
            f"On held-out motion the error is {held.error:.3g} {unit}, less than by the noise estimate "
            f"({held.low:.3g} to {held.high:.3g} {unit}): this estimate is too large, and may hide an effect. "
            "Check that the unit did not move in the recording that the noise is taken from."
        )
    if e.on_table and e.found == "nothing_missing" and e.over_noise is not None and e.over_noise < QUIET:
        return "floor_in_doubt", (
            f"The residual of the fit is {e.over_noise:.2g} times the noise estimate. Noise cannot be larger at "
            "rest than in turns: check that the unit did not move in the static recording, and record it again."
        )
    if e.found == "nothing_missing" and e.approximations and e.method == GIVEN:
        differs = listed([name.replace("_", " ") for name in e.approximations])
        return "left_by_method", f"The given calibration differs from a free fit of these recordings in {differs}."
    if e.found == "nothing_missing" and e.approximations:
        return "left_by_method", (
            f"The method {e.method} causes errors that a free fit of the same recordings does not have: "
            f"{', '.join(name.replace('_', ' ') for name in e.approximations)}."
        )
    return e.found, ""


def _above(e: Evidence, published: HeldOut) -> tuple[str, str]:
    unit = unit_of(e.sensor)
    text = (
        f"On held-out motion the error is {published.error:.3g} {unit}; noise and stated uncertainties explain at "
        f"most {published.high:.3g} {unit}"
    )
    if e.found == "missing_effect" and not (_unconfirmed(e) or (e.full and e.full.above)):
        return "missing_effect", _beyond(e)
    if e.found == "unexplained" or _unconfirmed(e):
        return "unexplained", f"{text}. {_why_unexplained(e)}"
    free = e.free or published
    same = e.method == "reference_least_squares" and not e.filtered  # the calibration is the free fit
    if e.as_printed or not (free.above or same):
        return "left_by_method", f"{text}. {_of_method(e)}"
    left = e.left_over_noise if e.selected else e.over_noise
    if e.method == GIVEN and e.free is None and left is not None and left <= EXPLAINED:
        return (
            "left_by_method",
            f"{text}. A fit of these recordings leaves noise alone: the given calibration causes it.",
        )
    if e.full and e.selected:
        text += f"; with the selected effects it is {e.full.error:.3g} {unit}, against at most {e.full.high:.3g}"
    if left is not None and left > EXPLAINED:
        return "unexplained", f"{text}. The residual of the fit is {left:.3g} times the noise, too."
    return "reference_in_doubt", (
        f"{text}. The residual of the fit is noise alone, so fit and held-out recording contradict each other: check "
        "that the held-out recording is of this unit in the same mounting, and check the rate, attitude and clock that "
        "the table logged in it. The cause may also be an effect that the recordings of the fit cannot show (not "
        "observable)."
    )


def _of_method(e: Evidence) -> str:
    if e.as_printed:
        return f"The method {e.method} uses the equations as printed, with their errata (as_printed)."
    if e.free is None:
        return f"The method {e.method} causes it."
    found = f"The error of a free fit of the same recordings is {e.free.error:.3g} {unit_of(e.sensor)}"
    if e.method == GIVEN:
        return f"{found}: the given calibration causes the rest."
    if e.filtered and e.method in FREE:
        return f"{found} against the filtered reference: delay and smoothing by the filter cause the rest."
    causes = f"the method {e.method} and the filter cause" if e.filtered else f"the method {e.method} causes"
    against = " against the filtered reference" if e.filtered else ""
    return f"{found}{against}: {causes} the rest."


def judged(document: dict[str, Any], e: Evidence) -> dict[str, Any]:
    """Return the diagnosis of a selection with the verdict by the evidence, its reason, and what to do next."""
    verdict, reason = decide(e)
    given, step = {"given": True} if e.method == GIVEN else {}, _next_step(verdict, document, e)
    if given and verdict == "missing_effect":
        effects = ", ".join(document["selected"])
        step = f"calibrate these recordings by a method that fits, with effects.{e.sensor}=[{effects}]"
    decided = {
        "verdict": verdict,
        "reason": reason,
        "next_experiment": step or document["next_experiment"],
        "override": document["override"] if _offered(verdict, document, e) else "",
    }
    return document | given | decided


def may_be_unknown(verdict: str, e: Evidence) -> bool:
    """Return whether physics outside the catalogue may be the cause: no check of the recordings names another.

    That includes selected effects with which the held-out error stays above the noise floor.
    """
    if verdict == "missing_effect" and e.held_out is not None:
        return e.held_out["error_after"] > LEFT_OVER * e.held_out["floor"]
    return verdict == "unexplained" or (verdict == "reference_in_doubt" and not e.doubts)


def _offered(verdict: str, document: Mapping[str, Any], e: Evidence) -> bool:
    """Return whether to offer the selected effects.

    Where the verdict is ``unexplained``, only plausible effects are offered that each reduce the held-out error.
    """
    if e.method == GIVEN:
        return False
    if verdict != "unexplained" or e.implausible or len(e.selected) > BELIEVED:
        return verdict == "missing_effect"
    entries = [entry for entry in document["ranking"] if entry["effect"] in document["selected"]]
    errors = [(entry["held_out_error_before"], entry["held_out_error_after"]) for entry in entries]
    return bool(errors) and all(None not in pair and pair[1] ** 2 < (1.0 - HELPFUL) * pair[0] ** 2 for pair in errors)


def _next_step(verdict: str, document: Mapping[str, Any], e: Evidence) -> str:
    """Return what to do next where that is not what the selection says; empty otherwise."""
    if verdict == "unexplained" and e.implausible:
        step = "check that every recording is of this unit in one mounting, and check its range and units"
        return f"{step}; then {of_unknown(document['unexplained'])}" if document["unexplained"] else step
    if verdict == "unexplained" != e.found:
        return of_unknown(document["unexplained"])
    if verdict == "reference_in_doubt":
        return "check the table's log and the mounting as said above, and record the recordings concerned again"
    if verdict == "floor_in_doubt":
        return "record static again: ten minutes or more at rest, on a base that does not shake"
    if verdict != "left_by_method":
        return ""
    changes = ["the equations as corrected (method.as_printed=false)"] if e.as_printed else []
    free = [
        "the default method" if e.method == GIVEN else "a method that fits the full matrix (reference_least_squares)"
    ]
    changes += [] if e.method in FREE else free
    changes += ["no filter (filter=none)"] if e.filtered else []
    return f"calibrate the same recordings with {' and '.join(changes)}" if changes else ""
