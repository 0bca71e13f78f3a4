"""The order of the verdicts: what the selection found, against held-out errors and what the recordings' checks say."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bench_session import Session, record
from hand_simulator import Hand
from hand_simulator import draw as draw_hand

sys.path.insert(0, str(Path(__file__).parents[1] / "study"))
from bench_units import of_accelerometer

from imu_research.study.bench import recordings_of
from imu_research.study.cases import draw
from pipeline.app.one_unit import unit_of_recordings
from pipeline.core.records import (
    BIAS_NAMES,
    Agreement,
    Dependence,
    MovesError,
    Note,
    Recording,
    SelectionErrors,
    SensorCalibration,
    SensorDiagnosis,
    StageResult,
    StepErrors,
)
from pipeline.core.verdicts import Verdict
from pipeline.estimation.stages import StageInput, StageOutput, declared, fit_stage, last_fit
from pipeline.evaluation.diagnosis.diagnose import diagnose, doubts_of, held_out_of
from pipeline.evaluation.diagnosis.verdict import HeldOutError, VerdictInput, decide, judged, verdict_of_selection
from pipeline.output.outcome import commands_of
from pipeline.output.pages.parameters import summary_row
from tests.published import TESTED, candidate
from tests.unit_settings import with_noise

INSIDE, ABOVE, BELOW = HeldOutError(1.0, 0.9, 1.2), HeldOutError(9.0, 0.9, 1.2), HeldOutError(0.5, 0.9, 1.2)
REFERENCE, OF_STAGED, OF_HAND = (
    {"method": method, "fit": declared("gyroscope", stage)}
    for method, stage in [
        ("reference_least_squares", "reference_least_squares"),
        ("staged", "scale_factor"),
        ("rests_and_moves", "rests_and_moves"),
    ]
)
NOTHING = VerdictInput("gyroscope", "nothing_missing", over_noise=1.0, published=INSIDE, **REFERENCE)
BY_HAND = replace(NOTHING, **OF_HAND, on_table=False)
# its bias by a stage that keeps the matrix; free fits after known effects
KEEPS = replace(BY_HAND, method="bias_of_rests", fit=declared("gyroscope", "bias"), moves=MovesError(0.79, 4.25, 31.2))
OF_KNOWN = {
    "method": "known_temperature",
    "fit": last_fit(
        SensorCalibration(
            "gyroscope", stages=tuple(StageResult(n, {}) for n in ("known_temperature", "rests_and_moves", "effects"))
        )
    ),
}
MISSING = replace(NOTHING, found="missing_effect", selected=("g_sensitivity",), over_noise=9.0, left_over_noise=1.0)
STAGED = replace(NOTHING, published=ABOVE, free=INSIDE, **OF_STAGED)


OFF = Agreement(p_value=1e-5, reads="x", of="y", error=3e-4, expanded_uncertainty=1e-4)
BEYOND = replace(MISSING, implausible=("g_sensitivity",))


def held_out(after: float) -> SelectionErrors:
    return SelectionErrors(1.0, after, 0.3)


@pytest.mark.parametrize(
    ("evidence", "verdict", "words"),
    [
        (NOTHING, "nothing_missing", ""),
        (replace(NOTHING, published=None), "nothing_missing", ""),
        (replace(NOTHING, published=ABOVE), "reference_in_doubt", "contradict each other"),
        (replace(NOTHING, published=ABOVE, free=INSIDE), "reference_in_doubt", "contradict each other"),
        (replace(BY_HAND, published=ABOVE), "reference_in_doubt", "held-out rests are of this unit"),
        (replace(BY_HAND, doubts=("face +x is 9.0 deg off",)), "reference_in_doubt", "reference: face +x"),
        (
            replace(BY_HAND, moves=MovesError(2.9, 0.5)),
            "unexplained",
            "2.9 deg (rms); noise and stated uncertainties explain at",
        ),
        (replace(BY_HAND, moves=MovesError(2.9, 3.5)), "nothing_missing", ""),
        (replace(BY_HAND, moves=MovesError(2.9, 3.5, 4.9)), "nothing_missing", ""),
        (replace(BY_HAND, moves=MovesError(2.9, 0.5, 1.0, 0.9)), "nothing_missing", ""),
        (replace(BY_HAND, moves=MovesError(2.9, 3.5, 1.0, 1.2)), "unexplained", "1.2 times the most that noise"),
        (
            replace(BY_HAND, moves=MovesError(2.9, 3.5, 5.1)),
            "unexplained",
            "direction of gravity by 5.1 times the noise",
        ),
        (replace(NOTHING, likely=("g_sensitivity",)), "not_enough_data", "most probable one, g sensitivity, does not"),
        (replace(MISSING, likely=("g_sensitivity",)), "missing_effect", ""),
        (KEEPS, "left_by_method", "which the uncertainty of what the method bias_of_rests keeps explains"),
        (replace(KEEPS, held_by_limit="the method does not estimate the matrix: why"), "not_enough_data", "the matrix"),
        (replace(KEEPS, found="not_enough_data"), "not_enough_data", ""),
        (replace(KEEPS, moves=MovesError(2.9, 0.5, 31.2)), "unexplained", "2.9 deg (rms)"),
        (replace(KEEPS, method="given"), "left_by_method", "which the uncertainty of the given calibration explains"),
        (
            replace(KEEPS, method="given", approximations=("bias",), moves=MovesError(2.9, 0.5, 31.2)),
            "left_by_method",
            "differs from a free fit of these recordings in bias",
        ),
        (replace(BY_HAND, **OF_KNOWN, moves=MovesError(2.9, 3.5, 5.1)), "unexplained", "5.1 times the noise"),
        (replace(NOTHING, published=ABOVE, over_noise=4.0), "unexplained", "4 times its noise"),
        (replace(NOTHING, published=BELOW), "floor_in_doubt", "estimate is too large"),
        (replace(NOTHING, static=ABOVE), "reference_in_doubt", "static"),
        (replace(NOTHING, agreement=OFF), "reference_in_doubt", "x reads +0.0003 of the truth along y"),
        (replace(NOTHING, agreement=replace(OFF, p_value=1e-3)), "nothing_missing", ""),
        (replace(MISSING, agreement=OFF), "missing_effect", ""),
        (replace(NOTHING, over_noise=0.1), "floor_in_doubt", "0.1 times its noise"),
        (replace(MISSING, published=ABOVE, free=ABOVE, full=INSIDE), "missing_effect", ""),
        (
            replace(MISSING, published=ABOVE, free=ABOVE, full=ABOVE),
            "reference_in_doubt",
            "with the selected effects, 7.5 times",
        ),
        (replace(MISSING, published=ABOVE, full=ABOVE, left_over_noise=3.0), "unexplained", "3 times its noise"),
        (replace(MISSING, published=BELOW), "missing_effect", ""),
        (replace(MISSING, doubts=("validation: off",)), "reference_in_doubt", "validation: off"),
        (replace(MISSING, doubts=("off",), published=ABOVE, full=INSIDE), "reference_in_doubt", "reference: off"),
        (replace(NOTHING, doubts=("off",), found="unexplained"), "reference_in_doubt", "reference: off"),
        (
            replace(NOTHING, found="unexplained", published=ABOVE),
            "unexplained",
            "7.5 times what noise and stated uncertainties explain",
        ),
        (replace(NOTHING, found="unexplained"), "unexplained", "1 times its noise"),
        (replace(NOTHING, found="unexplained", unknown=("time",)), "unexplained", "depends on time"),
        (
            replace(NOTHING, found="unexplained", selected=("lever_arm", "g_sensitivity", "bias_drift", "cross_axis")),
            "unexplained",
            "It takes 4 effects together",
        ),
        (replace(BEYOND, held_out=held_out(after=0.99)), "unexplained", "sensor file"),
        (replace(BEYOND, held_out=held_out(after=0.99), published=ABOVE, full=INSIDE), "unexplained", "sensor file"),
        (replace(BEYOND, held_out=held_out(after=0.3)), "missing_effect", "sensor file"),
        (replace(BEYOND, held_out=held_out(after=0.3), published=ABOVE, full=INSIDE), "missing_effect", "sensor file"),
        (STAGED, "left_by_method", "the method staged causes the rest"),
        (replace(STAGED, filtered=True), "left_by_method", "the method staged and the filter cause the rest"),
        (replace(STAGED, filtered=True, **REFERENCE), "left_by_method", "delay and smoothing by the filter"),
        (replace(NOTHING, **OF_STAGED, approximations=("rotation", "bias")), "left_by_method", "rotation, bias"),
        (replace(MISSING, **OF_STAGED, approximations=("rotation",)), "missing_effect", ""),
        (replace(STAGED, free=ABOVE, as_printed=True), "left_by_method", "as_printed"),
        (replace(STAGED, free=ABOVE), "reference_in_doubt", "contradict each other"),
        (replace(NOTHING, found="not_enough_data", published=BELOW), "floor_in_doubt", "too large"),
    ],
)
def test_the_first_that_applies_is_said_with_its_numbers(evidence: VerdictInput, verdict: str, words: str) -> None:
    found, reason, figure = decide(evidence)
    assert found == verdict
    assert words in reason
    assert bool(words) == bool(reason)
    assert bool(figure) == (found != evidence.found or bool(reason) or found == "missing_effect")
    diagnosis = SensorDiagnosis(
        evidence.found,
        [],
        selected=evidence.selected,
        ranking=[candidate("g_sensitivity")],
        next_experiment="none is needed",
        override="effects.gyroscope=[g_sensitivity]",
    )
    said = judged(diagnosis, evidence)
    step = said.next_experiment
    assert (step == "none is needed") == (verdict in {"nothing_missing", "missing_effect"} or verdict == evidence.found)
    assert bool(said.override) == (verdict == "missing_effect")
    if not evidence.on_table:
        assert "table" not in step + reason
        assert (verdict != "left_by_method") or "(method=rests_and_moves)" in step
    if evidence.method == "reference_least_squares":
        assert "reference_least_squares" not in step + reason


UNKNOWN = [Dependence("time", 1e-9, 50.0)]
BETTER, SAME = map(held_out, (0.3, 0.5))


@pytest.mark.parametrize(
    ("names", "unknown", "share", "gain", "changes", "verdict"),
    [
        ([], [], 0.0, 0.0, {}, "nothing_missing"),
        ([], [], 0.0, 0.0, {"above_noise": True}, "unexplained"),
        ([], UNKNOWN, 0.0, 0.0, {}, "unexplained"),
        (["a"], [], 0.2, 900.0, {}, "missing_effect"),
        (["a"], [], 0.2, 900.0, {"above_noise": True}, "unexplained"),
        (["a"], [], 0.8, 900.0, {"above_noise": True}, "missing_effect"),
        (["a"], UNKNOWN, 0.8, 900.0, {}, "unexplained"),
        (["a"], UNKNOWN, 0.8, 9000.0, {}, "missing_effect"),
        (["a"], [], 0.8, 900.0, {"held_out": SAME, "beyond": 0.6}, "unexplained"),
        (["a"], [], 0.8, 900.0, {"held_out": BETTER, "beyond": 0.6}, "missing_effect"),
        (["a"], [], 0.8, 900.0, {"held_out": BETTER, "beyond": 0.95}, "unexplained"),
        (["a", "b", "c", "d"], [], 1.0, 900.0, {"held_out": BETTER}, "unexplained"),
    ],
)
def test_a_selection_that_leaves_a_residual_is_no_explanation(  # noqa: PLR0917  (what a selection found)
    names: list[str], unknown: list[Dependence], share: float, gain: float, changes: dict[str, Any], verdict: str
) -> None:
    given: dict[str, Any] = {"above_noise": False, "held_out": None} | changes
    assert verdict_of_selection(names, unknown, share, gain, **given) == verdict


def test_a_recording_of_another_unit_is_unexplained_with_a_reason_and_nothing_is_offered() -> None:
    own, other = (recordings_of(draw("null_normal", number, 31)) for number in (1, 3))
    recordings = [next(o for o in other if o.name == "gyro_y") if r.name == "gyro_y" else r for r in own]
    found = (of_accelerometer(unit_of_recordings(recordings, ["sensor=mpu6050"])).diagnosis or {})["accelerometer"]
    assert found["verdict"] == "unexplained"
    assert "sensor file" in found["reason"]
    assert (found["override"], commands_of(found, "accelerometer", "U1", {"campaign": "c"})) == ("", {})
    named = {*found["selected"], *(entry["effect"] for entry in found["candidates"])}
    assert any(not entry["plausible"] for entry in found["ranking"] if entry["effect"] in named)
    row = summary_row("U1", {}, None, {"accelerometer": found}, {})
    assert (row["accelerometer_verdict"], row["accelerometer_selected"]) == ("unexplained", None)


@pytest.mark.parametrize(
    ("after", "implausible", "offered"),
    [(0.2, (), True), (0.2, ("g_sensitivity",), False), (0.99, (), False), (None, (), False)],
)
def test_of_an_unexplained_sensor_only_what_held_out_motion_confirms_is_offered(
    after: float | None, implausible: Any, offered: Any
) -> None:
    entry = candidate("g_sensitivity", held_out_error_before=1.0, held_out_error_after=after)
    override = "effects.gyroscope=[g_sensitivity]"
    diagnosis = SensorDiagnosis(Verdict.UNEXPLAINED, [], selected=["g_sensitivity"], ranking=[entry], override=override)
    said = judged(diagnosis, replace(MISSING, found="unexplained", implausible=implausible))
    assert (said.verdict, bool(said.override)) == ("unexplained", offered)


def test_only_held_out_errors_with_an_interval_decide() -> None:
    part = replace(TESTED, steps=(StepErrors("calibrated", rms_error=2.0),), expected_rms_error=(0.5, 1.5))
    found = held_out_of(part)
    assert found is not None
    assert found.above
    assert held_out_of(replace(part, held_out=False)) is held_out_of(replace(part, expected_rms_error=None)) is None


def test_a_note_on_the_turns_of_one_sensor_does_not_concern_the_other() -> None:
    def noted(recording: Recording) -> Recording:
        return replace(recording, notes=(Note("N-REFERENCE", 1, 0, 0, "angle and rate differ"),))

    turn, held_out = (
        next(noted(r) for r in record(Session(1)) if r.role == role) for role in ("gyroscope", "validation")
    )
    assert doubts_of("gyroscope", [turn]) == [f"{turn.name}: angle and rate differ"]
    assert doubts_of("accelerometer", [turn]) == []
    assert len(doubts_of("accelerometer", [held_out])) == 1


def test_a_stage_that_keeps_the_matrix_is_not_blamed_on_the_sensor() -> None:
    hand = draw_hand(Hand(rests=12, rest_s=2.0, rate_hz=50.0), 1)
    recordings = with_noise([hand.recording], hand.settings)
    accelerometer = fit_stage("accelerometer", "nonlinear_least_squares", recordings, None, hand.settings)
    given = StageInput("gyroscope", recordings, None, hand.settings, "bias")
    rests = given.rests
    each = np.tile(np.eye(3), (len(rests.time), 1))
    kept = StageOutput(
        estimated=BIAS_NAMES, bias=(bias := rests.reading.mean(axis=0)), rests=rests, jacobian=-each, by_reading=each,
        residual=(rests.reading - bias).ravel(), row=np.repeat(np.arange(len(rests.time)), 3),
    ).calibration(given)  # fmt: skip
    noise, moves = recordings.noises["gyroscope"], MovesError(0.79, 4.25, 31.2)
    found = diagnose(kept, recordings.filtered, noise, hand.settings, accelerometer, moves=moves)
    assert found.verdict == "not_enough_data"
    assert "the method does not estimate the matrix, known by the limit" in found.reason
    assert "choose a method that estimates it" in found.next_experiment
