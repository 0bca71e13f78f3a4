"""A given calibration is compared with what these recordings show, and blamed for no more than that."""

from dataclasses import replace

import numpy as np
import pytest
from hand_simulator import Hand, draw
from scipy.spatial.transform import Rotation
from unit_settings import settings_of, with_noise

from pipeline.core.errors import CannotCalibrateError
from pipeline.core.records import Recording, SensorCalibration, SensorDiagnosis, StageResult
from pipeline.core.verdicts import Verdict
from pipeline.estimation.multi_position.gyroscope import GyroscopeModel
from pipeline.estimation.stages import fit_stage
from pipeline.evaluation.diagnosis.findings import DiagnosisInput
from pipeline.evaluation.diagnosis.method_errors import given_differences
from pipeline.evaluation.diagnosis.multi_position import _model_of_all_rests
from pipeline.evaluation.diagnosis.verdict import HeldOutError, VerdictInput, decide, judged

ABOVE = HeldOutError(0.5, 0.01, 0.1)
GIVEN = VerdictInput("gyroscope", "nothing_missing", over_noise=0.9, published=ABOVE, method="given", on_table=False)
FREE = SensorCalibration(
    "gyroscope", np.array([1.0, -2.0, 0.5]), np.diag([1.01, 0.99, 1.02]), covariance=np.eye(12) * 1e-8
)
SETTINGS = settings_of(sensor={"gyroscope": {"bias_wander": 0.01}})
SHIFT = np.array([0.0, 0.3, 0.0])
RATE = np.tile([[30.0, 0.0, 0.0]], (50, 1))
MOVES = [Recording("recording", "rests", None, np.arange(50) * 10**7, None, RATE)]
MISSING = SensorDiagnosis(
    Verdict.MISSING_EFFECT, [], selected=["g_sensitivity"], override="effects.gyroscope=[g_sensitivity]"
)


def given(**changes: np.ndarray) -> SensorCalibration:
    return replace(FREE, stages=(StageResult("given", {}),), covariance=None, **changes)


def test_a_shift_of_the_bias_is_named_with_its_size() -> None:
    (found,) = given_differences(given(bias=FREE.bias + SHIFT), lambda: FREE, MOVES, SETTINGS)
    assert (found.name, found.unit, found.share) == ("bias", "deg/s", 1.0)
    assert found.size == pytest.approx(0.3 * 0.99)


def test_a_scale_factor_is_named_and_a_rotation_of_the_mounting_is_not() -> None:
    (found,) = given_differences(given(matrix=FREE.matrix @ np.diag([1.02, 1.0, 1.0])), lambda: FREE, MOVES, SETTINGS)
    assert found.name == "scale_factor"
    assert found.size == pytest.approx(0.02)
    assert found.rms == pytest.approx(30.0 * 0.02 / np.sqrt(3.0))
    angle = np.radians(2.0)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    named = [e.name for e in given_differences(given(matrix=turn @ FREE.matrix), lambda: FREE, MOVES, SETTINGS)]
    assert "rotation" not in named
    assert "non_orthogonality" not in named


def test_what_the_uncertainties_of_both_explain_is_not_named() -> None:
    near = given(bias=FREE.bias + 0.04)  # four times the wander of the sensor file, as the file states no uncertainty
    assert given_differences(near, lambda: FREE, MOVES, SETTINGS) == []
    wide = replace(given(bias=FREE.bias + SHIFT), covariance=np.eye(12) * 0.1**2)
    assert given_differences(wide, lambda: FREE, MOVES, SETTINGS) == []


def test_a_method_that_fits_is_not_compared() -> None:
    assert (
        given_differences(replace(FREE, stages=(StageResult("rests_and_moves", {}),)), lambda: FREE, MOVES, SETTINGS)
        == []
    )


def test_the_given_calibration_is_blamed_where_a_fit_of_the_recordings_leaves_noise_alone() -> None:
    verdict, reason, _ = decide(GIVEN)
    assert verdict == "left_by_method"
    assert reason.endswith("the given calibration causes the error.")
    assert decide(replace(GIVEN, method="rests_and_moves"))[0] == "reference_in_doubt"
    assert decide(replace(GIVEN, over_noise=4.0))[0] == "unexplained"
    inside = replace(GIVEN, published=HeldOutError(0.05, 0.01, 0.1))
    assert decide(inside) == ("nothing_missing", "", "")
    assert decide(replace(inside, approximations=("bias",)))[0] == "left_by_method"


def test_a_gyroscope_by_hand_refers_to_the_given_accelerometer() -> None:
    """Seven rests do not determine the accelerometer; a given one does, here in a frame 3 deg off that of the rests."""
    hand = draw(Hand(rests=7, rest_s=2.0, rate_hz=50.0), 2)
    settings = settings_of(hand.settings, procedure={"holdout_every": 0})
    with pytest.raises(CannotCalibrateError, match="the 7 orientations are nearly degenerate"):
        fit_stage("gyroscope", "rests_and_moves", with_noise([hand.recording], settings), None, settings)
    frame = Rotation.from_rotvec([2.0, -2.0, 1.0], degrees=True).as_matrix()
    known = SensorCalibration(
        "accelerometer", hand.bias["accelerometer"], frame @ hand.matrix["accelerometer"], covariance=np.eye(12) * 1e-12
    )
    part = known.to_json() | {"stages": [], "uncertain": True, "of_the_bench": []}
    file = {"source": "known.json", "sha256": "0" * 64, "notes": [], "accelerometer": part}
    settings = settings_of(settings, method={"given": file})
    found = fit_stage("gyroscope", "rests_and_moves", with_noise([hand.recording], settings), None, settings)
    expanded = np.array(found.to_json()["expanded_uncertainty"]["matrix"])
    assert np.all(np.abs(found.matrix - frame @ hand.matrix["gyroscope"]) < 2.0 * expanded)
    assert np.abs(found.matrix - hand.matrix["gyroscope"]).max() > 5.0 * expanded.max()
    settings = settings_of(settings, method={"given": file | {"accelerometer": None}})
    with pytest.raises(CannotCalibrateError, match=r"known\.json holds nothing of the accelerometer"):
        fit_stage("gyroscope", "rests_and_moves", with_noise([hand.recording], settings), None, settings)


def test_the_diagnosis_of_a_gyroscope_by_hand_keeps_the_given_accelerometer() -> None:
    hand = draw(Hand(rests=8, rest_s=2.0, rate_hz=50.0), 1)
    frame = Rotation.from_rotvec([2.0, -2.0, 1.0], degrees=True).as_matrix()
    known = SensorCalibration("accelerometer", hand.bias["accelerometer"], frame @ hand.matrix["accelerometer"])
    gyroscope = SensorCalibration("gyroscope", hand.bias["gyroscope"], frame @ hand.matrix["gyroscope"])
    settings = settings_of(hand.settings, method={"given": {"accelerometer": known.to_json()}})
    noise = with_noise([hand.recording], settings).noises["gyroscope"]
    assert noise is not None
    model = _model_of_all_rests(DiagnosisInput(gyroscope, [hand.recording], noise, settings, known, []))
    spans = np.split(np.arange(len(hand.still)), np.flatnonzero(np.diff(hand.still.astype(int))) + 1)
    assert hand.recording.accelerometer is not None
    rests = [hand.recording.accelerometer[span].mean(axis=0) for span in spans if hand.still[span[0]]]
    force = (np.array(rests) - known.bias) @ known.matrix.T
    assert isinstance(model, GyroscopeModel)
    np.testing.assert_allclose(model.at_rests.force, force, rtol=0, atol=2e-3)  # noise of 100 samples: 3e-4 g


def test_no_effect_is_offered_where_nothing_is_fitted() -> None:
    missing = replace(GIVEN, found="missing_effect", selected=("g_sensitivity",), published=None)
    said = judged(MISSING, missing)
    assert said.verdict == "missing_effect"
    assert said.override == ""
    assert "by a method that fits, with effects.gyroscope=[g_sensitivity]" in said.next_experiment
    assert judged(MISSING, replace(missing, method="rests_and_moves")).override
