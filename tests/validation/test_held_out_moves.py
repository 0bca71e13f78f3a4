"""By hand: held-out moves in the verdict, and a slow filter of the accelerometer, which spoils the ends of moves."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hand_session import fitted
from hand_simulator import Hand, draw

from pipeline.app.one_unit import unit_of_recordings
from pipeline.core.records import SENSORS, MovesError
from pipeline.estimation.noise import estimate_noise
from pipeline.evaluation.held_out.attitude import gravity_direction
from pipeline.evaluation.held_out.validation import validate
from tests.published import diagnose


def test_held_out_moves_beyond_noise_and_uncertainty_are_unexplained() -> None:
    drawn = draw(Hand(), 3)
    settings, good = drawn.settings, drawn.recording
    fits = [fitted(sensor, [good], settings) for sensor in SENSORS]
    noise = estimate_noise("gyroscope", [good], settings.sensor.gyroscope)
    assert good.gyroscope is not None
    # Rates read 5 % too large while the unit turns: in the held-out moves alone, as the fit is that of the good ones.
    turning = np.linalg.norm(good.gyroscope - fits[1].bias, axis=1, keepdims=True) > 20.0
    wrong = replace(good, gyroscope=np.where(turning, 1.05, 1.0) * good.gyroscope)
    verdicts = {}
    for name, recording in (("good", good), ("wrong", wrong)):
        moves = gravity_direction(*fits, [recording], noise, settings.procedure)
        errors = MovesError(moves["rms_deg"]["after"], moves["largest_expected_rms_deg"])
        assert (errors.rms_deg > errors.largest_deg) == (name == "wrong")
        held = validate(fits[1], [good], noise, settings)
        said = diagnose(fits[1], [good], noise, settings, fits[0], validation=held, moves=errors)
        verdicts[name] = said["verdict"]
    assert verdicts == {"good": "nothing_missing", "wrong": "unexplained"}
    assert "misses the direction of gravity" in said["reason"]


def few(seed: int, moves: int, wrong: float) -> dict[str, Any]:
    """Return the judged errors after a few held-out moves, whose rates are wrong by a share, and the verdict."""
    drawn = draw(Hand(rests=16 + moves), seed)
    edges = np.flatnonzero(np.diff(drawn.still.astype(int))) + 1
    ends = edges[::2][14], edges[1::2][14] + 1  # the last rest of the fit, and the first of the held-out recording
    whole, names = drawn.recording, ("recording", "validation")
    parts = [
        replace(whole.select(s), name=n) for n, s in zip(names, (slice(ends[0] - 1), slice(ends[1], None)), strict=True)
    ]
    assert parts[1].gyroscope is not None
    turning = np.linalg.norm(parts[1].gyroscope - drawn.bias["gyroscope"], axis=1, keepdims=True) > 20.0
    rates = np.where(turning, 1.0 + wrong, 1.0) * parts[1].gyroscope
    parts[1] = replace(parts[1], role="validation", gyroscope=rates)
    layers = ["table=hand", "procedure=multi_position", "sensor=mpu6050", "method=rests_and_moves"]
    unit = unit_of_recordings(parts, layers).run_to("calibration")
    return unit.validation["gravity_direction"] | {"verdict": unit.diagnosis["gyroscope"]["verdict"]}


@pytest.mark.parametrize(("seed", "moves"), [(11, 1), (12, 3), (13, 5)])
def test_few_held_out_moves_are_judged_by_their_covariance(seed: int, moves: int) -> None:
    good, wrong = few(seed, moves, 0.0), few(seed, moves, 0.02)
    assert [found["moves"] for found in (good, wrong)] == [moves, moves]
    assert good["over_expected"] < 1.0 < wrong["over_expected"]
    assert (good["verdict"], wrong["verdict"]) == ("nothing_missing", "unexplained")


@pytest.mark.parametrize(("rest_s", "code"), [(4.0, "N-SETTLING"), (2.0, "N-REFERENCE")])
def test_a_slow_filter_of_the_accelerometer_is_cut_or_named(rest_s: float, code: str) -> None:
    drawn = draw(Hand(rest_s=rest_s, slow_s=0.3), 5)
    layers = ["table=hand", "procedure=multi_position", "sensor=mpu6050", "method=rests_and_moves"]
    unit = unit_of_recordings([drawn.recording], layers).run_to("calibration")
    assert code in {note.code for note in unit.recordings.filtered[0].notes}
    within = []
    for sensor in SENSORS:
        part, found = unit.calibration[sensor], unit.diagnosis[sensor]
        assert found["verdict"] == ("nothing_missing" if code == "N-SETTLING" else "reference_in_doubt")
        for name, true in (("bias", drawn.bias[sensor]), ("matrix", drawn.matrix[sensor])):
            U = np.array(part["expanded_uncertainty"][name])
            within += (np.abs(np.array(part[name]) - true) <= U)[U > 0.0].tolist()
    if code == "N-SETTLING":
        assert np.mean(within) >= 0.85  # of 21; it was 0.94 of 420 in 20 units, and 0.95 without a filter
