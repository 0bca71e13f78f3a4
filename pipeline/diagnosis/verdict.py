"""The verdict on one sensor: what its selection found, against the error on held-out motion.

The first of ``RULES`` that applies decides; where none does, it is the verdict of the selection. A held-out error is
compared with its 99 % interval (``pipeline.validation.expected_error``); where that is not known, it decides nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from pipeline.diagnosis.words import of_unknown, template
from pipeline.model.effects.base import unit_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

EXPLAINED = 1.5  # times the noise: a residual of a fit up to it is noise; 0.92 to 1.14 in 140 sensors of null families
MOSTLY = 0.5  # share of the residual's excess that selected effects must explain where something else is left
BELIEVED = 3  # effects at once; more are what the catalogue makes of physics that it does not hold
UNKNOWN_SHARE = 0.03  # of the gain in 2 log L by what was selected, above which what is left is worth naming
LIKELY = 0.5  # probability of something outside the catalogue, above which what was selected is no explanation
SURE = 0.9  # the same where the held-out error is at the noise floor with what was selected (thermal_ramp, long-004)
WORSE = 0.3  # of the noise's mean square, by which what was selected may raise the held-out error's at most
HELPFUL = 0.1  # share of the held-out error's mean square that each effect worth a try takes away
LEFT_OVER = 1.05  # times the noise floor: four standard deviations of the rms of 3 x 1000 samples
DISAGREES = 1e-4  # probability by chance; the smallest of 842 sensors of null families was 0.006
QUIET = 0.6  # times the noise: a residual below it contradicts the noise of the rests
GIVEN = "given"  # the method that takes an existing calibration; nothing is fitted, and effects cannot be added to it
FREE = ("reference_least_squares", "nonlinear_least_squares", "rests_and_moves", "cholesky_lu")  # bias and matrix free
SAME_SESSION = "record static in the session of the other recordings, without switching the unit off in between"


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
    agreement: Mapping[str, Any] | None = None  # of matrix and held-out motion (``pipeline.validation.heldout``)
    static: HeldOut | None = None  # mean of the static recording, by the unit's calibration
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

    @property
    def above(self) -> bool:
        """Whether the held-out error of the calibration is above its interval."""
        return self.published is not None and self.published.above

    @property
    def left(self) -> float | None:
        """The residual of the fit over the noise, with what was selected."""
        return self.left_over_noise if self.selected else self.over_noise

    @property
    def at_noise(self) -> bool | None:
        """Whether the fit leaves noise alone; None where that is not known."""
        return None if self.left is None else self.left <= EXPLAINED

    @property
    def missing(self) -> bool:
        """Whether effects were selected; those beyond the sensor's limits must lower the held-out error."""
        return self.found == "missing_effect" and not self._unconfirmed

    @property
    def unexplained(self) -> bool:
        """Whether no plausible effect explains the residual."""
        return self.found == "unexplained" or self._unconfirmed

    @property
    def _unconfirmed(self) -> bool:
        if not self.implausible or self.held_out is None:
            return False
        return self.held_out["error_after"] ** 2 > (1.0 - HELPFUL) * self.held_out["error_before"] ** 2

    @property
    def made_worse(self) -> bool:
        """Whether what was selected raises the held-out error."""
        return _made_worse(self.held_out)

    @property
    def too_many(self) -> bool:
        """Whether more effects were selected than a unit usually has."""
        return len(self.selected) > BELIEVED

    @property
    def too_quiet(self) -> bool:
        """Whether the residual is below what the noise estimate makes possible."""
        quiet = self.on_table and self.found == "nothing_missing" and self.over_noise is not None
        return quiet and float(self.over_noise or 0.0) < QUIET

    @property
    def disagrees(self) -> bool:
        """Whether held-out motion contradicts the matrix, and nothing else is found."""
        known = self.agreement is not None and self.found == "nothing_missing"
        return known and (self.agreement or {})["p_value"] < DISAGREES

    @property
    def given(self) -> bool:
        """Whether the calibration is given, not fitted."""
        return self.method == GIVEN

    @property
    def of_free_method(self) -> bool:
        """Whether the method leaves bias and matrix free."""
        return self.method in FREE

    @property
    def unit(self) -> str:
        """The unit of the sensor."""
        return unit_of(self.sensor)

    @property
    def static_differs(self) -> bool:
        """Whether the static recording contradicts a fit that no missing effect or method makes wrong."""
        explained = self.found in {"nothing_missing", "not_enough_data"} and self.of_free_method
        return explained and not self.approximations and self.static is not None and self.static.above

    @property
    def of_method(self) -> bool:
        """Whether the method causes a held-out error above its interval: a free fit is within its own."""
        same = self.method == "reference_least_squares" and not self.filtered  # the calibration is the free fit
        free = self.free or self.published
        within = not (same or (free and free.above))
        return self.as_printed or within or bool(self.given and self.free is None and self.at_noise)


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


# Verdict, its reason (a macro of ``templates/reasons.txt``), and where it applies; ``e.above``: the held-out error of
# the calibration is above its interval.
RULES: tuple[tuple[str, str, Callable[[Evidence], object]], ...] = (
    ("reference_in_doubt", "doubts", lambda e: e.doubts),
    ("missing_effect", "beyond", lambda e: e.above and e.missing and not (e.full and e.full.above)),
    ("unexplained", "above_and_unexplained", lambda e: e.above and e.unexplained),
    ("left_by_method", "above_by_method", lambda e: e.above and e.of_method),
    ("reference_in_doubt", "static", lambda e: e.static_differs),
    ("unexplained", "above_as_the_residual", lambda e: e.above and e.at_noise is False),
    ("reference_in_doubt", "contradiction", lambda e: e.above),
    ("unexplained", "unexplained", lambda e: e.unexplained),
    ("unexplained", "moves", lambda e: e.moves and e.moves[0] > e.moves[1] and not e.missing),
    ("missing_effect", "beyond", lambda e: e.missing),
    ("reference_in_doubt", "disagreement", lambda e: e.disagrees),
    ("floor_in_doubt", "below", lambda e: e.published and e.published.below),
    ("floor_in_doubt", "too_quiet", lambda e: e.too_quiet),
    ("left_by_method", "approximations", lambda e: e.found == "nothing_missing" and e.approximations),
)


def decide(e: Evidence) -> tuple[str, str]:
    """Return the verdict and its reason as one or two sentences; empty where the selection is the reason."""
    for verdict, reason, applies in RULES:
        if applies(e):
            return verdict, " ".join(getattr(template("reasons.txt").module, reason)(e).split())
    return e.found, ""


def judged(document: dict[str, Any], e: Evidence) -> dict[str, Any]:
    """Return the diagnosis of a selection with the verdict by the evidence, its reason, and what to do next."""
    verdict, reason = decide(e)
    given, step = {"given": True} if e.given else {}, _next_step(verdict, document, e)
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
    if e.given:
        return False
    if verdict != "unexplained" or e.implausible or e.too_many:
        return verdict == "missing_effect"
    entries = [entry for entry in document["ranking"] if entry["effect"] in document["selected"]]
    errors = [(entry["held_out_error_before"], entry["held_out_error_after"]) for entry in entries]
    return bool(errors) and all(None not in pair and pair[1] ** 2 < (1.0 - HELPFUL) * pair[0] ** 2 for pair in errors)


def _next_step(verdict: str, document: Mapping[str, Any], e: Evidence) -> str:
    """Return what to do next where that is not what the selection says; empty otherwise."""
    if verdict == "unexplained" and e.implausible:
        step = "check that every recording is of this unit in one mounting, and check its range and units"
        return (
            f"{step}; then {of_unknown(document['unexplained'], on_table=e.on_table)}"
            if document["unexplained"]
            else step
        )
    if verdict == "unexplained" != e.found:
        return of_unknown(document["unexplained"], on_table=e.on_table)
    if verdict == "reference_in_doubt":
        what = "the table's log and the mounting" if e.on_table else "the rests and turns"
        again = f"check {what} as said above, and record the recordings concerned again"
        return SAME_SESSION if e.static_differs and not e.doubts else again
    if verdict == "floor_in_doubt":
        return "record static again: ten minutes or more at rest, on a base that does not shake"
    if verdict != "left_by_method":
        return ""
    changes = ["the equations as corrected (method.as_printed=false)"] if e.as_printed else []
    free = ["the default method" if e.given else "a method that fits the full matrix (reference_least_squares)"]
    changes += [] if e.of_free_method else free
    changes += ["no filter (filter=none)"] if e.filtered else []
    return f"calibrate the same recordings with {' and '.join(changes)}" if changes else ""
