"""Decide the verdict on one sensor, from the result of its selection and the error on held-out motion.

The first rule of ``RULES`` that applies decides; if none applies, the verdict is that of the selection. A held-out
error is compared with its 99 % interval (``pipeline.evaluation.held_out.error_breakdown``). Without an interval it has
no effect.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from pipeline.core.records import Agreement, Dependence, MovesError, SelectionErrors, SensorDiagnosis
from pipeline.core.verdicts import MARK_AFTER_MOVES, Verdict, decided_words
from pipeline.estimation.stages import FitStage
from pipeline.evaluation.diagnosis.words import listed, of_unknown, plain, template
from pipeline.evaluation.held_out.validation import HeldOutError
from pipeline.physics.effects import catalogue
from pipeline.physics.effects.base import unit_of

EXPLAINED = 1.5  # times the noise: largest residual that is noise; it was 0.92 to 1.14 in 140 sensors without an effect
# least share of the residual's excess that selected effects explain if the residual has another cause too
MIN_EXPLAINED_EXCESS = 0.5
BELIEVED = 3  # most effects at once; a selection takes more only to imitate physics outside the catalogue
UNKNOWN_SHARE = 0.03  # of the gain in 2 log L by the selected effects: least delta BIC of a covariate that counts
# probability of physics outside the catalogue above which the selected effects are no explanation
MAX_UNKNOWN_PROBABILITY = 0.5
# the same if the held-out error with the selected effects is at the noise floor (thermal_ramp, long-004)
LIKELY_AT_FLOOR = 0.9
HELPFUL = 0.1  # least relative reduction of the held-out mean square by an effect that is offered
LEFT_OVER = 1.05  # times the noise floor: four standard deviations of the rms of 3 x 1000 samples
DISAGREES = 1e-4  # probability by chance; the smallest of 842 sensors of null families was 0.006
MIN_RESIDUAL_OVER_NOISE = 0.6  # times the noise: a smaller residual contradicts the noise of the rests
FAR_ABOVE_BY_HAND = 10.0  # times the noise: nobody sets down or holds a unit so badly
# times the noise: a good hand scatters the directions of the published wearable by 5.1, scale factors that drift by
# 1 to 3 % in a recording by 6.8 to 21
MAX_SCATTER_BY_HAND = 6.0
GIVEN = "given"  # the method that takes an existing calibration; nothing is fitted, and effects cannot be added to it
STATIC_AGAIN = "record static again: ten minutes or more at rest, on a base that does not shake"
SAME_SESSION = "record static in the session of the other recordings, without switching the unit off in between"
# Verdict, its reason (a macro of ``templates/reasons.txt``), and the condition. ``e.above``: the held-out error of the
# calibration is above its interval.
RULES: tuple[tuple[Verdict, str, Callable[[VerdictInput], object]], ...] = (
    (Verdict.REFERENCE_IN_DOUBT, "doubts", lambda e: e.doubts),
    (Verdict.MISSING_EFFECT, "missing", lambda e: e.above and e.missing and not (e.full and e.full.above)),
    (Verdict.UNEXPLAINED, "above_and_unexplained", lambda e: e.above and e.unexplained),
    (Verdict.LEFT_BY_METHOD, "above_by_method", lambda e: e.above and e.of_method),
    (Verdict.REFERENCE_IN_DOUBT, "static", lambda e: e.static_differs),
    (Verdict.UNEXPLAINED, "above_as_the_residual", lambda e: e.above and e.at_noise is False),
    (Verdict.REFERENCE_IN_DOUBT, "contradiction", lambda e: e.above),
    (Verdict.UNEXPLAINED, "unexplained", lambda e: e.unexplained),
    (Verdict.UNEXPLAINED, "moves", lambda e: e.beyond_moves and not e.missing),
    (Verdict.UNEXPLAINED, "far_moves", lambda e: e.far_after_moves and e.fit.free and not e.missing),
    (Verdict.UNEXPLAINED, "scatter", lambda e: e.scatter > MAX_SCATTER_BY_HAND and not e.missing),
    (Verdict.MISSING_EFFECT, "missing", lambda e: e.missing),
    (Verdict.REFERENCE_IN_DOUBT, "disagreement", lambda e: e.disagrees),
    (Verdict.FLOOR_IN_DOUBT, "below", lambda e: e.published and e.published.below),
    (Verdict.FLOOR_IN_DOUBT, "too_quiet", lambda e: e.too_quiet),
    (Verdict.LEFT_BY_METHOD, "approximations", lambda e: e.nothing_missing and e.approximations),
    (Verdict.LEFT_BY_METHOD, "kept", lambda e: e.nothing_missing and e.far_after_moves and not e.held_by_limit),
    (Verdict.NOT_ENOUGH_DATA, "held", lambda e: e.nothing_missing and e.held_by_limit),
    (Verdict.NOT_ENOUGH_DATA, "undecided", lambda e: e.nothing_missing and e.likely),
)


@dataclass(frozen=True)
class VerdictInput:
    """The evidence for the verdict on a sensor."""

    sensor: str
    found: Verdict  # of the selection alone
    selected: Sequence[str] = ()
    delta_bic: float | None = None  # largest of the selected effects
    over_noise: float | None = None  # residual over the noise, of the fit without the selected effects
    left_over_noise: float | None = None  # the same with them
    published: HeldOutError | None = None  # of the unit's calibration
    moves: MovesError | None = None  # of held-out moves by hand
    scatter: float = 0.0  # of moves or directions by hand that the fit found, over the noise
    # of a free fit of the same recordings; filtered ones against the filtered reference
    free: HeldOutError | None = None
    full: HeldOutError | None = None  # of the free fit with the selected effects
    agreement: Agreement | None = None
    static: HeldOutError | None = None  # mean of the static recording, by the unit's calibration
    doubts: Sequence[str] = ()  # contradictions of the reference, from the checks of the recordings
    # errors of the method's bias and matrix (``pipeline.evaluation.diagnosis.method_errors``)
    approximations: Sequence[str] = ()
    unknown: Sequence[str] = ()  # covariates on which the residual with the selected effects depends
    beyond: Sequence[str] = ()  # covariates of physics that is likely and outside the catalogue
    implausible: Sequence[str] = ()  # selected effects beyond the sensor's limits, unless the settings accept that
    held_out: SelectionErrors | None = None  # of the selection's own fits
    method: str = ""
    fit: FitStage = field(default_factory=FitStage)  # last stage of the method
    as_printed: bool = False  # whether the method uses the equations of the thesis as printed
    filtered: bool = False
    likely: Sequence[str] = ()  # the most probable effects, if the 95 % answer set lacks that nothing is missing
    # parameters that the sensor file's limits determine, and what would; of a sheet, or of a stage that keeps them
    held_by_limit: str = ""
    on_table: bool = True  # a few rests by hand may have a small residual by chance

    @property
    def above(self) -> bool:
        """Whether the held-out error of the calibration is above its interval."""
        return self.published is not None and self.published.above

    @property
    def nothing_missing(self) -> bool:
        """Whether the selection found nothing."""
        return self.found == Verdict.NOTHING_MISSING

    @property
    def beyond_moves(self) -> bool:
        """Whether held-out moves miss by more than noise, uncertainties and errors of a given calibration explain."""
        of_given = self.given and self.nothing_missing and self.approximations
        return self.moves is not None and self.moves.over_largest > 1.0 and not of_given

    @property
    def far_after_moves(self) -> bool:
        """Whether held-out moves by hand show far more than noise; the uncertainty of what a method keeps may do so."""
        return self.moves is not None and self.moves.over_noise > MARK_AFTER_MOVES

    @property
    def left(self) -> float | None:
        """The residual of the fit with the selected effects, over the noise."""
        return self.left_over_noise if self.selected else self.over_noise

    @property
    def at_noise(self) -> bool | None:
        """Whether the residual of the fit is noise; None if that is unknown."""
        return None if self.left is None else self.left <= EXPLAINED

    @property
    def missing(self) -> bool:
        """Whether effects were selected; those beyond the sensor's limits must lower the held-out error."""
        return self.found == Verdict.MISSING_EFFECT and not self._unconfirmed

    @property
    def unexplained(self) -> bool:
        """Whether no plausible effect explains the residual."""
        return self.found == Verdict.UNEXPLAINED or self._unconfirmed

    @property
    def _unconfirmed(self) -> bool:
        if not self.implausible or self.held_out is None:
            return False
        return self.held_out.error_after**2 > (1.0 - HELPFUL) * self.held_out.error_before**2

    @property
    def too_many(self) -> bool:
        """Whether more effects were selected than a unit usually has."""
        return len(self.selected) > BELIEVED

    @property
    def too_quiet(self) -> bool:
        """Whether the residual is too small for the noise estimate."""
        small = self.over_noise is not None and self.over_noise < MIN_RESIDUAL_OVER_NOISE
        return small and self.on_table and self.nothing_missing

    @property
    def disagrees(self) -> bool:
        """Whether held-out motion contradicts the matrix and the selection found nothing."""
        return bool(self.agreement and self.nothing_missing and self.agreement.p_value < DISAGREES)

    @property
    def given(self) -> bool:
        """Whether the calibration is given, not fitted."""
        return self.method == GIVEN

    @property
    def unit(self) -> str:
        """The unit of the sensor."""
        return unit_of(self.sensor)

    @property
    def static_differs(self) -> bool:
        """Whether the static recording contradicts a fit that neither a missing effect nor the method makes wrong."""
        explained = self.found in {Verdict.NOTHING_MISSING, Verdict.NOT_ENOUGH_DATA} and self.fit.free
        return explained and not self.approximations and self.static is not None and self.static.above

    @property
    def of_method(self) -> bool:
        """Whether the method causes a held-out error above its interval: a free fit is within its own interval."""
        same = self.fit.reference and not self.filtered  # the calibration is the free fit
        free = self.free or self.published
        within = not (same or (free and free.above))
        return self.as_printed or within or bool(self.given and self.free is None and self.at_noise)


def verdict_of_selection(
    names: Sequence[str],
    unknown: Sequence[Dependence],
    share: float,
    gain: float,
    *,
    above_noise: bool,
    held_out: SelectionErrors | None,
    beyond: float = 0.0,
) -> Verdict:
    """Return the verdict by the selection on a table alone.

    If the residual has another cause too, selected effects must explain most of its excess. A dependence of the
    residual (``unknown``) that is small next to a large effect may be the error of that effect's linear equation.
    ``share`` of the excess and ``gain`` in 2 log L are those of the selected effects. ``above_noise``: whether the
    residual with them is far above the noise. ``beyond``: probability of physics outside the catalogue; its threshold
    is higher if held-out motion shows noise alone.
    """
    if len(names) > BELIEVED:
        return Verdict.UNEXPLAINED
    at_floor = held_out is not None and held_out.error_after <= held_out.floor
    if names and beyond > (LIKELY_AT_FLOOR if at_floor else MAX_UNKNOWN_PROBABILITY):
        return Verdict.UNEXPLAINED
    if (unknown or above_noise) and (not names or share < MIN_EXPLAINED_EXCESS):
        return Verdict.UNEXPLAINED
    if unknown and max(entry.delta_bic or 0.0 for entry in unknown) > UNKNOWN_SHARE * gain:
        return Verdict.UNEXPLAINED
    return Verdict.MISSING_EFFECT if names else Verdict.NOTHING_MISSING


def verdict_of_selection_by_hand(
    names: Sequence[str], unknown: Sequence[Dependence], left_over_noise: float | None
) -> Verdict:
    """Return the verdict by the selection in rests and moves alone; parameters as of ``verdict_of_selection``.

    ``left_over_noise``: residual with the selected effects over the noise.
    """
    if (unknown and not names) or (left_over_noise or 0.0) > FAR_ABOVE_BY_HAND:
        return Verdict.UNEXPLAINED
    return Verdict.MISSING_EFFECT if names else Verdict.NOTHING_MISSING


def _of_residual(e: VerdictInput) -> str:
    if e.unknown and e.at_noise is not False:
        return decided_words("dependence", named=listed([plain(name) for name in e.unknown]))
    return decided_words("misfit", e.left)


def _over(error: HeldOutError | None, limit: str) -> float | None:
    return error.error / getattr(error, limit) if error and getattr(error, limit) > 0.0 else None


FIGURE_OF: dict[str, Callable[[VerdictInput], str]] = {  # by the reason; of all others it is the held-out error
    "doubts": lambda _: decided_words("check"),
    "missing": lambda e: decided_words("evidence", e.delta_bic, listed([plain(name) for name in e.selected])),
    "static": lambda e: decided_words("static", _over(e.static, "high")),
    "unexplained": _of_residual,
    "moves": lambda e: decided_words("angle_expected", e.moves.over_largest if e.moves else None),
    "far_moves": lambda e: decided_words("angle", e.moves.over_noise if e.moves else None),
    "scatter": lambda e: decided_words("scatter", e.scatter),
    "kept": lambda e: decided_words("angle", e.moves.over_noise if e.moves else None),
    "disagreement": lambda e: decided_words(
        "agreement", abs(e.agreement.error) / e.agreement.expanded_uncertainty if e.agreement else None
    ),
    "below": lambda e: decided_words("below", _over(e.published, "low")),
    "too_quiet": lambda e: decided_words("misfit", e.over_noise),
    "approximations": lambda _: decided_words("method"),
    "held": lambda _: decided_words("held"),
    "undecided": lambda e: decided_words("probability", named=listed([plain(name) for name in e.likely])),
}


def decide(e: VerdictInput) -> tuple[Verdict, str, str]:
    """Return the verdict, its reason in one or two sentences, and the figure that decided it.

    Both texts are empty if the selection decides.
    """
    for verdict, reason, applies in RULES:
        if applies(e):
            figure = FIGURE_OF[reason](e) if reason in FIGURE_OF else decided_words("held_out")
            return verdict, " ".join(getattr(template("reasons.txt").module, reason)(e).split()), figure
    return e.found, "", ""


def judged(diagnosis: SensorDiagnosis, e: VerdictInput) -> SensorDiagnosis:
    """Return the diagnosis of a selection with the verdict by the evidence, its reason and the next experiment."""
    verdict, reason, figure = decide(e)
    step = _next_step(verdict, diagnosis, e)
    if e.given and verdict == Verdict.MISSING_EFFECT:
        effects = ", ".join(diagnosis.selected)
        step = f"calibrate these recordings by a method that fits, with effects.{e.sensor}=[{effects}]"
    told: dict[str, Any] = {"verdict": verdict, "reason": reason, "decided_by": figure, "given": e.given}
    override = diagnosis.override if _offered(verdict, diagnosis, e) else ""
    return replace(diagnosis, **told, next_experiment=step or diagnosis.next_experiment, override=override)


def may_be_unknown(verdict: Verdict, e: VerdictInput) -> bool:
    """Return whether physics outside the catalogue may be the cause, as no check of the recordings names another one.

    Also true if the held-out error with the selected effects is above the noise floor.
    """
    if verdict == Verdict.MISSING_EFFECT and e.held_out is not None:
        return e.held_out.error_after > LEFT_OVER * e.held_out.floor
    return verdict == Verdict.UNEXPLAINED or (verdict == Verdict.REFERENCE_IN_DOUBT and not e.doubts)


def _offered(verdict: Verdict, diagnosis: SensorDiagnosis, e: VerdictInput) -> bool:
    """Return whether to offer the selected effects: if ``unexplained``, each must be plausible and help on held-out."""
    if e.given:
        return False
    if verdict != Verdict.UNEXPLAINED or e.implausible or e.too_many:
        return verdict == Verdict.MISSING_EFFECT
    errors = [(entry.held_out_error_before, entry.held_out_error_after) for entry in diagnosis.chosen]
    lower = [a is not None and b is not None and b**2 < (1.0 - HELPFUL) * a**2 for a, b in errors]
    return bool(lower) and all(lower)


def _next_step(verdict: Verdict, diagnosis: SensorDiagnosis, e: VerdictInput) -> str:
    """Return the next step if it differs from the one that the selection proposes; empty otherwise."""
    experiment = of_unknown(diagnosis.unexplained, on_table=e.on_table)
    if verdict == Verdict.UNEXPLAINED and e.implausible:
        step = "check that every recording is of this unit in one mounting, and check its range and units"
        return f"{step}; then {experiment}" if diagnosis.unexplained else step
    if verdict == Verdict.UNEXPLAINED != e.found:
        return experiment
    if verdict == Verdict.REFERENCE_IN_DOUBT:
        suspect = "the table's log and the mounting" if e.on_table else "the rests and turns"
        check = f"check {suspect} as said above, and record the recordings concerned again"
        return SAME_SESSION if e.static_differs and not e.doubts else check
    if verdict != Verdict.LEFT_BY_METHOD:
        held = e.held_by_limit.rpartition(": ")[2] if verdict == Verdict.NOT_ENOUGH_DATA else ""
        if verdict == Verdict.NOT_ENOUGH_DATA and e.nothing_missing and not held:
            known = [f": {catalogue()[name].excitation}" for name in e.likely if name in catalogue()]
            held = f"record as much again{''.join(known[:1])}"
        return STATIC_AGAIN if verdict == Verdict.FLOOR_IN_DOUBT else held
    changes = ["the equations as corrected (method.as_printed=false)"] if e.as_printed else []
    method = "reference_least_squares" if e.on_table else "rests_and_moves"
    free = ["the default method" if e.given and e.on_table else f"a method that fits the full matrix (method={method})"]
    changes += [] if e.fit.free else free
    changes += ["no filter (filter=none)"] if e.filtered else []
    return f"calibrate the same recordings with {' and '.join(changes)}" if changes else ""
