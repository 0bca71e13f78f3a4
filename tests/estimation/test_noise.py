from __future__ import annotations

import json
from dataclasses import replace

import bench_session
import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.signal import lfilter
from scipy.stats import norm
from unit_settings import filter_of, settings_of, with_noise

from pipeline.app.one_unit import unit_row
from pipeline.core.errors import ConfigurationError
from pipeline.core.records import Noise, Recording
from pipeline.estimation.gauss_markov import (
    STATED_WIDTH,
    TIME_FACTORS,
    TIME_PRIOR,
    block_covariance,
    variance_of_average,
)
from pipeline.estimation.noise import estimate_noise, wander_prior
from pipeline.estimation.noise_terms import allan_deviation
from pipeline.estimation.reference_least_squares import fit
from pipeline.estimation.stages import StageInput
from pipeline.physics.signal.filters import apply_filter, filter_autocovariance

SHEET = settings_of().sensor.accelerometer.replaced(noise_density=4e-4, bias_wander=1e-4, wander_time_s=100.0)
NO_WANDER = SHEET.replaced(bias_wander=0.0)
GYROSCOPE = SHEET.replaced(noise_density=0.005, bias_wander=0.003)
DT = 0.12
WHITE = 8e-4
FILTERS = {
    "none": filter_of("none"),
    "rc": filter_of("rc_low_pass", cutoff_hz=1.0, time_constant_s=None),
    "butterworth": filter_of("low_pass", cutoff_hz=1.5, order=4, zero_phase=True),
}


def gauss_markov(n: int, tau: float, rng: np.random.Generator) -> np.ndarray:
    phi = np.exp(-DT / tau)
    steps = rng.standard_normal((n, 3)) * np.sqrt(1.0 - phi**2)
    steps[0] = rng.standard_normal(3)
    return lfilter([1.0], [1.0, -phi], steps, axis=0)


def rest(
    n: int, wander: float, seed: int, *, role: str = "static", start: float = 3000.0, tau: float = 100.0
) -> Recording:
    rng = np.random.default_rng(seed)
    values = np.array([0.0, 0.0, 1.0]) + WHITE * rng.standard_normal((n, 3)) + wander * gauss_markov(n, tau, rng)
    time_ns = ((start + np.arange(n) * DT) * 1e9).astype(np.int64)
    return Recording("static", role, None, time_ns, accelerometer=values)


@pytest.mark.parametrize("name", FILTERS)
def test_white_noise_of_a_raw_sample_is_recovered_through_a_filter(name: str) -> None:
    found = [
        estimate_noise("accelerometer", [apply_filter(rest(5000, 1e-4, s), FILTERS[name])], SHEET).white
        for s in range(20)
    ]
    assert np.mean(found) == pytest.approx(WHITE, rel=0.006)
    assert np.std(found) / WHITE < 0.03


@pytest.mark.parametrize("name", ["none", "rc"])
@pytest.mark.parametrize("wander", [1e-4, 5e-4])
def test_wander_is_recovered_from_a_static_recording(name: str, wander: float) -> None:
    noises = [
        estimate_noise("accelerometer", [apply_filter(rest(10000, wander, s), FILTERS[name])], SHEET) for s in range(24)
    ]
    rms = [np.sqrt(np.mean(n.wander**2)) for n in noises]
    assert np.mean(rms) == pytest.approx(wander, rel=0.08)
    assert np.std(rms) < 0.25 * wander
    assert 50.0 <= np.median([n.correlation_time for n in noises]) <= 200.0
    assert {(n.source, n.wander_source) for n in noises} == {("static", "static")}
    copy = Noise.from_json(json.loads(json.dumps(noises[0].to_json())))
    for prior, again in zip(
        wander_prior(noises[0], SHEET).grid(WHITE), wander_prior(copy, SHEET).grid(WHITE), strict=True
    ):
        assert prior == again


def test_hypotheses_of_a_static_recording_predict_the_scatter_of_an_average() -> None:
    rng, covered, length = np.random.default_rng(3), [], 100.0
    for seed in range(100):
        wander = SHEET.bias_wander * np.exp(STATED_WIDTH * rng.standard_normal())
        tau = 100.0 * rng.choice(TIME_FACTORS, p=TIME_PRIOR)
        noise = estimate_noise("accelerometer", [rest(7500, wander, seed, tau=tau)], SHEET)
        settings = wander_prior(noise, SHEET).grid(WHITE)
        weight = np.exp(np.array([s.prior for s in settings]) - max(s.prior for s in settings))
        sigma = np.array([scatter_of_average(WHITE * s.ratio, s.time, length) for s in settings])
        x = brentq(lambda x: weight @ (2.0 * norm.cdf(x / sigma) - 1.0) - 0.95 * weight.sum(), 0.0, 4.0 * sigma.max())  # noqa: B023
        covered.append(2.0 * norm.cdf(x / scatter_of_average(wander, tau, length)) - 1.0)
    assert abs(np.mean(covered) - 0.95) < 3.0 * np.std(covered) / 10.0
    assert np.std(covered) < 0.06


def scatter_of_average(wander: float, tau: float, length: float) -> float:
    return float(np.sqrt(WHITE**2 * DT / length + wander**2 * variance_of_average(np.array(length), tau)))


def test_values_held_between_samples_do_not_hide_a_slow_wander_from_the_stated_uncertainty() -> None:
    session = bench_session.Session(seed=3, static=True, interval=0.04)
    sampled = [r for r in bench_session.record(session) if r.role != "validation"]
    held = [replace(r, accelerometer=r.accelerometer[np.arange(r.samples) // 5 * 5]) for r in sampled]
    assert estimate_noise("accelerometer", held, SHEET).correlation_time < 25.0
    config = unit_row(["sensor=mpu6050"]).config
    stated = [
        np.array(
            fit(StageInput("accelerometer", with_noise(of_unit, config), None, config)).to_json()[
                "expanded_uncertainty"
            ]["bias"]
        )
        for of_unit in (sampled, held)
    ]
    assert np.all(stated[1] > 0.7 * stated[0])


def test_no_wander_is_invented_in_white_noise() -> None:
    noises = [estimate_noise("accelerometer", [rest(10000, 0.0, s)], SHEET) for s in range(24)]
    found = [noise.wander.max() for noise in noises]
    assert np.mean(np.array(found) == 0.0) > 0.85
    assert max(found) < 1e-4
    assert {n.wander_source for n in noises if n.wander.max() == 0.0} == {
        "static"
    }  # the rest excludes the sensor file's


def test_wander_that_a_short_rest_cannot_show_is_the_data_sheets() -> None:
    noise = estimate_noise("accelerometer", [rest(100, 0.0, 0)], SHEET)
    assert noise.wander.tolist() == [1e-4] * 3
    assert noise.correlation_time == 100.0
    assert (noise.source, noise.wander_source, noise.time_source) == ("static", "data_sheet", "data_sheet")


def test_warm_up_of_a_static_recording_does_not_pass_for_wander() -> None:
    found = []
    for seed in range(12):
        cold = rest(8000, 0.0, seed, start=5.0)
        settling = 5e-3 * np.exp(-cold.time / 180.0)[:, None]
        warming = replace(cold, accelerometer=cold.accelerometer + settling)
        found.append(estimate_noise("accelerometer", [warming], NO_WANDER).wander.max())
    assert np.median(found) == 0.0
    assert max(found) < 3e-4


def test_temperature_of_a_static_recording_does_not_pass_for_wander() -> None:
    cold = rest(8000, 0.0, 3)
    temperature = 25.0 + 2.0 * np.sin(cold.time / 150.0)
    values = cold.accelerometer + 1e-3 * (temperature - 25.0)[:, None]
    noise = estimate_noise("accelerometer", [replace(cold, accelerometer=values, temperature=temperature)], NO_WANDER)
    assert noise.wander.max() < 1e-4


def stop_and_go(seed: int, steps: int = 150) -> Recording:
    """Rests of 1 s, 1 deg apart, as the table logs them."""
    rng = np.random.default_rng(seed)
    per_rest, per_move = 9, 3
    rate = np.tile(np.concatenate([np.zeros(per_rest), np.full(per_move, 1.0 / (per_move * DT))]), steps)
    angle = np.cumsum(rate) * DT
    n = len(rate)
    truth = np.stack([np.zeros(n), np.sin(np.radians(angle)), np.cos(np.radians(angle))], 1)
    values = truth + WHITE * rng.standard_normal((n, 3))
    values[rate > 0] += 0.05 * rng.standard_normal((int(np.sum(rate > 0)), 3))
    time_ns = np.arange(n) * round(DT * 1e9)
    return Recording("accel_x", "accelerometer", "x", time_ns, values, table_angle=angle, table_rate=rate)


def test_rests_of_stop_and_go_give_white_noise_without_the_shaking_of_the_moves() -> None:
    noises = [estimate_noise("accelerometer", [stop_and_go(s)], SHEET) for s in range(20)]
    assert {n.source for n in noises} == {"rests"}
    assert np.mean([n.white for n in noises]) == pytest.approx(WHITE, rel=0.02)


def test_rests_of_other_recordings_sharpen_the_white_noise_of_a_short_static_one() -> None:
    alone, together = [], []
    for seed in range(40):
        static = rest(200, 0.0, 1000 + seed)
        alone.append(estimate_noise("accelerometer", [static], NO_WANDER).white)
        both = estimate_noise("accelerometer", [static, stop_and_go(seed)], NO_WANDER)
        together.append(both.white)
        assert both.source == "static"
    assert np.std(together) < 0.6 * np.std(alone)
    assert np.mean(together) == pytest.approx(WHITE, rel=0.01)


def test_rests_that_shake_do_not_join_the_static_recording() -> None:
    shaken = stop_and_go(0)
    shaken = replace(shaken, accelerometer=3.0 * shaken.accelerometer)
    white = estimate_noise("accelerometer", [rest(3000, 0.0, 0), shaken], NO_WANDER).white
    assert white == pytest.approx(estimate_noise("accelerometer", [rest(3000, 0.0, 0)], NO_WANDER).white)


@pytest.mark.parametrize("name", ["none", "rc"])
@pytest.mark.parametrize("rate", [1.0, 10.0, 30.0])
def test_continuous_turns_without_a_rest_give_white_noise_from_their_high_frequencies(name: str, rate: float) -> None:
    found = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        n = 1200
        angle = rate * DT * np.arange(n)
        truth = np.stack([np.zeros(n), np.sin(np.radians(angle)), np.cos(np.radians(angle))], 1)
        turn = Recording(
            "accel_x", "accelerometer", "x", np.arange(n) * round(DT * 1e9),
            truth + WHITE * rng.standard_normal((n, 3)),
            table_angle=angle, table_rate=np.full(n, rate),
        )  # fmt: skip
        noise = estimate_noise("accelerometer", [apply_filter(turn, FILTERS[name])], SHEET)
        assert noise.source == "residual"
        found.append(noise.white)
    assert np.mean(found) == pytest.approx(WHITE, rel=0.02)


def test_data_sheet_is_the_last_resort() -> None:
    fast = replace(stop_and_go(0, 20), table_rate=np.full(240, 200.0))
    noise = estimate_noise("accelerometer", [fast], SHEET)
    assert noise.source == "data_sheet"
    assert noise.white == pytest.approx(np.full(3, 4e-4 / np.sqrt(2 * DT)), rel=1e-6)


def test_without_readings_of_the_sensor_there_is_no_noise() -> None:
    with pytest.raises(ConfigurationError, match="gyroscope"):
        estimate_noise("gyroscope", [stop_and_go(0, 20)], SHEET)


def held_in_a_hand(tremor: float, seed: int = 5) -> Recording:
    """Return ten rests of 2.5 s at 100 Hz whose rate trembles for about 0.07 s, with moves of 1 s between them."""
    rng = np.random.default_rng(seed)
    n, moving = 3500, np.arange(3500) % 350 >= 250
    force = np.tile([0.0, 0.0, 1.0], (n, 1)) + 3e-3 * rng.standard_normal((n, 3))
    force[moving] += 0.5 * rng.standard_normal((moving.sum(), 3))
    rate = tremor * gauss_markov(n, DT * 0.07 / 0.01, rng) + 0.07 * rng.standard_normal((n, 3))
    rate[moving] += 60.0 * np.sin(2.0 * np.pi * (np.arange(n) % 350 - 250)[moving] / 100.0)[:, None]
    return Recording("by_hand", "rests", None, np.arange(n) * 10_000_000, force, rate)


def test_the_tremor_of_a_hand_is_no_slow_wander() -> None:
    tremor, length = 0.44, 100.0
    noise = estimate_noise("gyroscope", [held_in_a_hand(tremor)], SHEET.replaced(bias_wander=3e-3))
    true = tremor * np.sqrt(2.0 * 0.07 / length)  # of the mean of a long rest, after the white noise
    said = noise.wander * np.sqrt(variance_of_average(np.array(length), noise.correlation_time))
    assert np.all((said > true / 1.5) & (said < 1.5 * true))


def test_held_out_recording_is_not_looked_at() -> None:
    loud = rest(2000, 0.0, 1, role="validation")
    loud = replace(loud, accelerometer=loud.accelerometer * 50.0, table_rate=np.zeros(2000))
    assert estimate_noise("accelerometer", [loud, stop_and_go(1)], SHEET).white == pytest.approx(WHITE, rel=0.1)


def test_clipped_and_stuck_samples_do_not_count() -> None:
    good = rest(3000, 0.0, 2)
    values, flags = good.accelerometer.copy(), np.zeros(3000, np.uint16)
    values[100:110], flags[100:105], flags[105:110] = 2.0, 0b010, 0b100
    noise = estimate_noise("accelerometer", [replace(good, accelerometer=values, flags=flags)], SHEET)
    assert noise.white == pytest.approx(WHITE, rel=0.06)


def test_autocovariance_of_the_rc_filter_is_that_of_its_equation() -> None:
    filtered = apply_filter(rest(500, 0.0, 0), FILTERS["rc"])
    k = DT / (DT + 1.0 / (2.0 * np.pi))
    expected = k / (2.0 - k) * (1.0 - k) ** np.arange(20)
    assert filter_autocovariance(filtered)[:20] == pytest.approx(expected, rel=1e-9)
    assert np.sqrt(filter_autocovariance(filtered)[0]) == pytest.approx(filtered.filter["noise_gain"], rel=1e-9)


def test_covariance_of_block_averages_is_that_of_the_averaged_process() -> None:
    fine = 0.05
    t = np.arange(0.0, 60.0, fine) + fine / 2
    R = np.exp(-np.abs(t[:, None] - t) / 20.0)
    average = np.kron(np.eye(4), np.full((1, 300), 1 / 300.0))
    start = np.array([0.0, 15.0, 30.0, 45.0])
    B = block_covariance(start, np.full(4, 15.0), 20.0)
    assert pytest.approx(average @ R @ average.T, rel=1e-5) == B
    assert variance_of_average(np.array([15.0]), 20.0)[0] == pytest.approx(B[0, 0])


def test_allan_deviation_of_white_noise_falls_with_the_root_of_time() -> None:
    values = np.random.default_rng(0).standard_normal((40000, 3))
    tau, deviation = allan_deviation(values, 0.1)
    early = tau < 20.0
    expected = 1.0 / np.sqrt(tau[early] / 0.1)
    assert deviation[early] == pytest.approx(np.repeat(expected[:, None], 3, 1), rel=0.1)


def test_allan_deviation_is_the_literal_sum() -> None:
    values = np.random.default_rng(1).standard_normal(50)
    tau, deviation = allan_deviation(values, 0.5)
    for t, found in zip(tau, deviation, strict=True):
        m = round(t / 0.5)
        means = np.array([values[i : i + m].mean() for i in range(50 - m + 1)])
        assert found == pytest.approx(np.sqrt(0.5 * np.mean((means[m:] - means[:-m]) ** 2)), rel=1e-12)


def test_allan_deviation_of_two_values_is_empty() -> None:
    tau, deviation = allan_deviation(np.zeros((2, 3)), 1.0)
    assert len(tau) == 0
    assert deviation.shape == (0, 3)


def test_what_a_filter_still_holds_of_a_turn_is_no_noise() -> None:
    turn = np.concatenate([np.zeros(250), np.full(50, 60.0), np.zeros(250)])
    rng = np.random.default_rng(12)
    readings = np.stack([turn, np.zeros(550), np.zeros(550)], 1) + rng.normal(0.0, 0.01, (550, 3))
    time_ns = np.arange(550) * 120_000_000
    recording = Recording("gyro_x", "gyroscope", "x", time_ns, gyroscope=readings, table_rate=turn)
    settings = filter_of("rc_low_pass", cutoff_hz=None, time_constant_s=0.24, zero_phase=False)
    noise = estimate_noise("gyroscope", [apply_filter(recording, settings)], GYROSCOPE)
    assert noise.source == "rests"
    assert noise.white == pytest.approx(0.01, rel=0.1)


def test_a_clock_that_is_off_by_a_sample_leaves_the_noise_of_the_rests() -> None:
    """By the log it rests, by the sensor's clock it still moves at 100 deg/s^2 at the edge of each rest."""
    off = {"clock_rate": np.array([160.0])}
    recordings = bench_session.record(bench_session.Session(9, effects={"gyroscope": off}))
    assert estimate_noise("gyroscope", recordings, GYROSCOPE).white == pytest.approx(
        np.full(3, bench_session.WHITE["gyroscope"]), rel=0.05
    )


def in_steps(step: float, white: float, seed: int = 1) -> list[Recording]:
    """Return a long rest and turns of a gyroscope in steps; the rest lies in the middle of a step."""
    rng = np.random.default_rng(seed)
    truth = np.concatenate([np.zeros((600, 3)), 60.0 * np.sin(0.05 * np.arange(300.0))[:, None] * np.ones(3)])
    rate = step * np.round((truth + white * rng.standard_normal((900, 3))) / step)
    time = (np.arange(900) * 0.02 * 1e9).astype(np.int64)
    parts = zip(("static", "gyroscope"), (None, "x"), (slice(0, 600), slice(600, 900)), strict=True)
    return [Recording(role, role, axis, time[at], gyroscope=rate[at]) for role, axis, at in parts]


@pytest.mark.parametrize("white", [0.0, 0.05, 0.3])
def test_readings_in_steps_have_at_least_the_noise_of_rounding(white: float) -> None:
    coarse = estimate_noise("gyroscope", in_steps(1.0, white), GYROSCOPE)
    assert np.all(coarse.white >= (1.0 - 1e-9) / np.sqrt(12.0))
    if white < 0.2:  # the readings at rest do not change: no wander shows
        assert coarse.white == pytest.approx(max(1.0 / np.sqrt(12.0), 0.005 * np.sqrt(0.5 / 0.02)))
        assert (coarse.wander.tolist(), coarse.wander_source, coarse.likelihood) == ([0.003] * 3, "data_sheet", None)
    fine = estimate_noise("gyroscope", in_steps(0.01, 0.05), GYROSCOPE)
    assert fine.white == pytest.approx(0.05, rel=0.1)


def test_rests_without_any_noise_leave_the_noise_to_the_sensor_file() -> None:
    found = estimate_noise("gyroscope", in_steps(1e-6, 0.0), GYROSCOPE)
    assert found.white == pytest.approx(0.005 * np.sqrt(0.5 / 0.02))
    assert found.source == "data_sheet"
