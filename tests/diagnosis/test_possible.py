from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from unit_settings import settings_of

from pipeline.core.records import Candidate, Estimate, Noise, Recording, SensorCalibration, SensorDiagnosis
from pipeline.core.verdicts import Verdict
from pipeline.estimation import harm
from pipeline.estimation.harm import harmful
from pipeline.evaluation.diagnosis.diagnose import _longest_by_chance, without_harmful, without_impossible
from pipeline.evaluation.diagnosis.findings import DiagnosisInput
from pipeline.evaluation.diagnosis.verdict import MAX_SCATTER_BY_HAND, VerdictInput, decide
from pipeline.physics.kinematics import EARTH_RATE_DPS

if TYPE_CHECKING:
    from collections.abc import Mapping

SETTINGS = settings_of(sensor="mpu6050")
WHITE = SETTINGS.sensor.gyroscope.noise_density * np.sqrt(0.5 / 0.02)


def case_of(temperature: np.ndarray | None = None, white: float = WHITE, **settings: Any) -> DiagnosisInput:
    time = 20_000_000 * np.arange(500)
    warm = np.linspace(20.0, 30.0, 500).round(2) if temperature is None else temperature
    recording = Recording("rests", "rests", None, time, np.ones((500, 3)), np.ones((500, 3)), warm)
    noise = Noise(np.full(3, white), np.zeros(3), 100.0, "rests")
    found = settings_of(SETTINGS, **settings)
    return DiagnosisInput(SensorCalibration("gyroscope"), [recording], noise, found, None, [])


def missing(name: str, values: Mapping[str, float], u: float) -> SensorDiagnosis:
    estimates = {symbol: Estimate(value, "1", u) for symbol, value in values.items()}
    entry = Candidate(name, 100.0, 1e-9, estimates, 0.9, None, None, {}, plausible=False)
    return SensorDiagnosis(
        Verdict.MISSING_EFFECT, [], 1.5, [name], [entry], override=f"effects.gyroscope=[{name}]",
        decided_by=f"evidence for {name}, delta BIC 100",
    )  # fmt: skip


def bias_temperature(factor: float, u: float = 0.001) -> SensorDiagnosis:
    limit = SETTINGS.sensor.gyroscope.effects["bias_temperature"]
    return missing("bias_temperature", {f"b_T_{axis}": factor * limit for axis in "xyz"}, u)


def assert_no_cause(found: SensorDiagnosis, name: str, words: str) -> None:
    assert (found.verdict, list(found.selected), found.override) == (Verdict.UNEXPLAINED, [], "")
    assert found.decided_by == "misfit of the fit, 1.5 x noise"
    assert list(found.candidates) == [name]
    assert words in found.candidates[name]
    assert words in found.reason
    assert found.to_json()["candidates"] == [{"effect": name, "reason": found.candidates[name]}]


@pytest.mark.parametrize(("factor", "possible"), [(0.9, True), (2.9, True), (3.2, False)])
def test_an_effect_beyond_three_times_its_limit_is_no_cause(factor: float, *, possible: bool) -> None:
    before = bias_temperature(factor)
    found = without_impossible(before, case_of())
    if possible:
        assert found is before
    else:
        assert_no_cause(found, "bias_temperature", "3.2 times the data sheet's limit")


def test_an_interval_that_reaches_three_times_the_limit_is_possible() -> None:
    before = bias_temperature(3.2, u=0.04)
    assert without_impossible(before, case_of()) is before


def test_a_sensor_that_is_accepted_as_implausible_may_exceed_its_limits() -> None:
    before = bias_temperature(9.0)
    assert without_impossible(before, case_of(**{"sensor.gyroscope.accept_implausible": True})) is before


def test_a_temperature_that_does_not_change_contradicts_an_effect_of_temperature() -> None:
    steady = np.full(500, 25.0)
    assert_no_cause(
        without_impossible(bias_temperature(0.5), case_of(steady)), "bias_temperature", "temperature changes"
    )


def test_an_estimate_of_earths_rate_exceeds_it_by_chance_in_one_of_a_thousand_units() -> None:
    u, rng = 4e-4, np.random.default_rng(5)
    estimates = np.array([0.0, 0.0, EARTH_RATE_DPS]) + rng.normal(0.0, u, (200_000, 3))
    beyond = np.linalg.norm(estimates, axis=1) > _longest_by_chance(EARTH_RATE_DPS, u)
    assert 0.0008 < np.mean(beyond) < 0.0012  # 4.5 standard deviations of 1e-3
    found = missing("earth_rotation", {"E_x": 0.0048, "E_y": 0.0, "E_z": 0.0}, u)
    assert without_impossible(found, case_of()) is found


def test_no_unit_turns_faster_than_the_earth() -> None:
    found = missing("earth_rotation", {"E_x": 0.006, "E_y": 0.0, "E_z": 0.0}, 1e-4)
    assert_no_cause(without_impossible(found, case_of()), "earth_rotation", "more than the Earth turns")
    slower = missing("earth_rotation", {"E_x": 0.003, "E_y": 0.0, "E_z": 0.0}, 1e-4)
    assert without_impossible(slower, case_of()) is slower


def test_noise_far_beyond_the_sensor_file_is_no_cause_but_another_sensor() -> None:
    found = without_impossible(bias_temperature(0.5), case_of(white=10.0 * WHITE))
    assert_no_cause(found, "bias_temperature", "not that of this sensor")
    on_table = case_of(white=10.0 * WHITE)
    turns = [replace(r, name="gyro_x", role="gyroscope") for r in on_table.recordings]
    slower = bias_temperature(0.5)
    assert (
        without_impossible(slower, replace(on_table, recordings=turns)) is slower
    )  # its rests hold the table's motion


def test_moves_that_scatter_far_beyond_the_noise_are_unexplained() -> None:
    e = VerdictInput("gyroscope", Verdict.NOTHING_MISSING, on_table=False, scatter=1.1 * MAX_SCATTER_BY_HAND)
    verdict, reason, figure = decide(e)
    assert figure == "scatter of the moves, 6.6 x noise"
    assert verdict == Verdict.UNEXPLAINED
    assert "6.6 times the noise" in reason
    steady = VerdictInput("gyroscope", Verdict.NOTHING_MISSING, on_table=False, scatter=0.9 * MAX_SCATTER_BY_HAND)
    assert decide(steady)[0] == Verdict.NOTHING_MISSING


def test_effects_that_raise_the_error_of_units_of_exchange_are_not_offered() -> None:
    rng = np.random.default_rng(1)
    noise = 1.0 + 0.1 * rng.standard_normal(20)
    better, worse = 0.5 * noise, noise + 0.2 + 0.1 * rng.standard_normal(20)
    assert harmful(["a"], [noise, better], "") == {}
    assert list(harmful(["a"], [noise, worse], "")) == ["a"]
    assert list(harmful(["a", "b"], [worse, better, noise], "")) == ["b"]
    assert harmful(["a", "b"], [noise, worse, better], "") == {}  # worse only while b is missing
    assert harmful(["a"], [noise[:3], worse[:3]], "") == {}  # too few
    slow = np.cumsum(rng.standard_normal(20))  # successive units that rise and fall together show little
    assert harmful(["a"], [noise, noise + slow - slow.mean() + 0.3 * slow.std()], "") == {}
    assert harmful(["a"], [noise, worse], "", lambda _before, _after: 0.2**2) == {}  # shared by all units


def test_the_change_of_a_held_out_error_by_wander_has_the_stated_variance(monkeypatch: pytest.MonkeyPatch) -> None:
    rng, time, rows = np.random.default_rng(2), 0.4 * np.arange(150), 800
    bias, rate = np.array([0.03, -0.01, 0.02]), np.array([1e-3, 0.0, -1e-3])
    change = bias + rate * np.sin(time / 20.0)[:, None]  # between two calibrations
    wander, tau = np.array([0.01, 0.02, 0.03]), 30.0
    factor = np.linalg.cholesky(np.exp(-np.abs(time[:, None] - time) / tau) + 1e-12 * np.eye(len(time)))
    drawn = wander * np.einsum("ij,rjc->ric", factor, rng.standard_normal((rows, len(time), 3)))
    rises = [np.mean(np.sum((m + change) ** 2 - m**2, axis=1)) for m in drawn]
    seen: list[float] = []
    monkeypatch.setattr(harm, "harmful", lambda _names, _squares, _what, shared: seen.append(shared(0, 1)))
    errors = [harm.InPieces.of(each) for each in (drawn[0], drawn[0] + change)]
    noise = Noise(0.01 * np.ones(3), wander, tau, "static")
    harm.harmful_on_held_out(["a"], errors, time, noise)
    assert np.sqrt(seen[0]) == pytest.approx(np.std(rises), rel=3.0 / np.sqrt(2 * rows))


def test_an_effect_that_harms_is_a_candidate_and_the_others_stay() -> None:
    one, other = bias_temperature(0.5), missing("bias_drift", {"d_x": 0.001}, 1e-4)
    both = replace(one, selected=["bias_temperature", "bias_drift"], ranking=[*one.ranking, *other.ranking],
                   override="effects.gyroscope=[bias_temperature,bias_drift]")  # fmt: skip
    found = without_harmful(both, {"bias_drift": "it makes the error 1.2 times as large"})
    assert (found.verdict, list(found.selected)) == (Verdict.MISSING_EFFECT, ["bias_temperature"])
    assert found.override == "effects.gyroscope=[bias_temperature]"
    assert "bias drift fits" in found.reason.lower()
    assert_no_cause(
        without_harmful(one, {"bias_temperature": "it makes the error larger"}), "bias_temperature", "larger"
    )
