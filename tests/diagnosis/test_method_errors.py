"""A method's own approximations are named as what they are; what is the sensor's or the noise's is not put on them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from bench_session import BIAS, CONTINUOUS, STOP_AND_GO, Course, K, Session, record, values_of
from unit_settings import filter_of, settings_of, with_noise

from pipeline.estimation.noise import estimate_noise
from pipeline.estimation.stages import fit_stage
from pipeline.evaluation.diagnosis.words import in_words
from pipeline.evaluation.held_out.validation import validate
from pipeline.physics.signal.filters import apply_filter
from pipeline.simulation.description import shipped_settings
from tests.published import diagnose

if TYPE_CHECKING:
    from pipeline.core.records import Recording, SensorCalibration

CONFIGS = Path(__file__).parents[2] / "configs"
SHEET = shipped_settings(sensor="mpu6050").sensor
TABLE = settings_of().table
RC = filter_of("rc_low_pass", cutoff_hz=None, time_constant_s=0.24, zero_phase=False)
MAGNITUDE = "held_out_magnitude_share"


def recordings_of(
    seed: int = 1, course: Course = STOP_AND_GO, effects: dict[str, Any] | None = None
) -> list[Recording]:
    return record(Session(seed, replace(course, validation_s=60.0), effects or {}))


def diagnosed(
    method: str, sensor: str, recordings: list[Recording], *, as_printed: bool = False
) -> tuple[SensorCalibration, dict[str, Any]]:
    """The calibration by a method, and the diagnosis of it."""
    settings = settings_of(sensor=SHEET, method=method, **{"method.as_printed": as_printed})
    calibration = None
    for stage in settings.method.stages.of(sensor):
        calibration = fit_stage(sensor, stage, with_noise(recordings, settings), calibration, settings)
    assert calibration is not None
    noise = estimate_noise(sensor, recordings, SHEET.of(sensor))
    validation = validate(calibration, recordings, noise, settings)
    return calibration, diagnose(calibration, recordings, noise, settings, validation=validation)


def by_name(part: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {error["name"]: error for error in part["method_errors"]}


def test_the_diagonal_matrix_of_the_staged_method_leaves_mounting_and_non_orthogonality() -> None:
    calibration, part = diagnosed("staged", "accelerometer", recordings_of())
    E = calibration.matrix @ K["accelerometer"] - np.eye(3)
    found = by_name(part)
    assert part["verdict"] == "left_by_method"
    assert "That of a free fit of the same recordings is" in part["reason"]
    assert "reference_least_squares" in part["next_experiment"]
    assert set(found) == {"rotation", "non_orthogonality"}
    assert found["rotation"]["size"] == pytest.approx(np.degrees(np.abs(E - E.T).max() / 2.0), rel=0.05)
    skew = np.degrees(np.abs(E + E.T)[~np.eye(3, dtype=bool)].max() / 2.0)
    assert found["non_orthogonality"]["size"] == pytest.approx(skew, rel=0.05)
    assert sum(error["share"] for error in found.values()) == pytest.approx(1.0, abs=0.02)
    assert "multiply readings by cosines" in found["rotation"]["meaning"]
    rotation = np.radians(found["rotation"]["size"])
    assert 0.5 * rotation < found["rotation"]["rms"] < 2.0 * rotation


def test_a_rotation_does_not_change_a_magnitude_so_the_held_out_error_is_of_the_angles_between_axes() -> None:
    found = by_name(diagnosed("staged", "accelerometer", recordings_of())[1])
    assert found["rotation"][MAGNITUDE] < 0.02
    assert found["non_orthogonality"][MAGNITUDE] > 0.9


def test_nine_parameters_from_gravity_leave_the_mounting_open_and_nothing_else() -> None:
    _, part = diagnosed("nonlinear_least_squares", "accelerometer", recordings_of())
    assert [error["name"] for error in part["method_errors"]] == ["rotation"]
    assert "do not determine the mounting" in part["method_errors"][0]["meaning"]


@pytest.mark.parametrize("sensor", ["accelerometer", "gyroscope"])
def test_a_free_fit_leaves_nothing_of_its_own(sensor: str) -> None:
    assert diagnosed("reference_least_squares", sensor, recordings_of())[1]["method_errors"] == []


@pytest.mark.parametrize("method", ["staged", "cholesky_lu"])
def test_a_full_matrix_by_stages_is_not_blamed_for_what_noise_does(method: str) -> None:
    for seed in range(6):
        _, part = diagnosed(method, "gyroscope", recordings_of(seed, replace(STOP_AND_GO, dwell_s=1.0)))
        assert part["method_errors"] == [], seed


def test_the_delay_of_a_filter_in_continuous_turns_is_named_with_the_angle_by_which_it_is_late() -> None:
    filtered = [apply_filter(r, RC) for r in recordings_of(course=CONTINUOUS)]
    for sensor, fastest in (("accelerometer", 30.0), ("gyroscope", 100.0)):
        _, part = diagnosed("staged", sensor, filtered)
        first = part["method_errors"][0]
        assert part["selected"] == []
        assert first["name"] == "filter_delay"
        assert (first["size"], first["unit"]) == (pytest.approx(fastest * 0.24, rel=1e-6), "deg")
        assert first["share"] > 0.8
        assert "delays readings by 0.24 s" in first["meaning"]


def test_the_printed_forward_matrix_is_named_as_what_it_is() -> None:
    calibration, part = diagnosed("cholesky_lu", "gyroscope", recordings_of(), as_printed=True)
    twice = calibration.matrix @ K["gyroscope"] - np.eye(3)
    found = by_name(part)
    assert found["scale_factor"]["size"] == pytest.approx(np.abs(np.diag(twice)).max(), rel=0.02)
    assert all("forward matrix" in error["meaning"] for error in found.values())


def test_what_is_missing_in_the_sensor_is_not_put_on_the_method() -> None:
    effects = {"gyroscope": {"bias_temperature": values_of("gyroscope", "bias_temperature", np.random.default_rng(1))}}
    _, part = diagnosed("staged", "gyroscope", recordings_of(effects=effects))
    assert part["selected"] == ["bias_temperature"]
    assert part["method_errors"] == []


def test_a_bias_that_a_method_gets_wrong_is_told_with_its_size() -> None:
    recordings = recordings_of()
    calibration, _ = diagnosed("staged", "gyroscope", recordings)
    wrong = replace(calibration, bias=BIAS["gyroscope"] + np.array([0.0, 0.3, 0.0]))
    settings = settings_of(sensor=SHEET)
    part = diagnose(wrong, recordings, estimate_noise("gyroscope", recordings, SHEET.gyroscope), settings)
    assert [error["name"] for error in part["method_errors"]] == ["bias"]
    assert part["method_errors"][0]["size"] == pytest.approx(0.3, rel=0.05)
    assert part["method_errors"][0]["unit"] == "deg/s"


def test_words_put_the_errors_on_the_method_and_not_on_the_sensor() -> None:
    _, part = diagnosed("staged", "accelerometer", recordings_of())
    text = "\n".join(in_words(part, "accelerometer"))
    assert "The model explains the accelerometer; approximations of method" in text
    assert "of the method, not of the sensor: rotation (" in text
    assert "eqs 3.15-3.37" in text
