"""Filters against their equations and scipy, and the smoothed temperature, also at the corners of a ramp."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from pydantic import ValidationError
from unit_settings import filter_of

from pipeline.core.errors import ConfigurationError, InputError
from pipeline.core.records import Recording
from pipeline.core.settings import Filter
from pipeline.physics.signal.filters import apply_filter, heats_and_cools, smooth_temperature, temperature_rate_of

CONFIGS = Path(__file__).parents[2] / "configs/filter"
FILTERS = ["rc_low_pass", "low_pass", "high_pass", "band_pass", "band_stop"]


def _recording(accelerometer: Any, interval: float = 0.12, time: Any = None) -> Recording:
    values = np.asarray(accelerometer, float)
    if values.ndim == 1:
        values = np.stack([values, 2.0 * values, -values], axis=1)
    time = np.arange(len(values)) * interval if time is None else np.asarray(time)
    return Recording(
        name="accel_x",
        role="accelerometer",
        axis="x",
        time_ns=np.round(time * 1e9).astype(np.int64),
        accelerometer=values,
        gyroscope=10.0 * values,
        temperature=np.full(len(values), 25.0),
        table_angle=np.arange(len(values), dtype=float),
    )


def test_no_filter_returns_the_recording_itself() -> None:
    recording = _recording(np.arange(5.0))
    assert apply_filter(recording, filter_of("none")) is recording


def test_the_rc_filter_is_equation_3_14_step_by_step() -> None:
    rng = np.random.default_rng(1)
    time = np.cumsum(rng.choice([0.12, 0.12, 0.12, 0.24, 0.36], 3000))  # lost samples
    reading = rng.normal(size=(3000, 3))
    rc = 0.5
    expected = np.empty_like(reading)
    expected[0] = reading[0]
    for n in range(1, 3000):
        dt = time[n] - time[n - 1]
        k = dt / (dt + rc)
        expected[n] = expected[n - 1] + k * (reading[n] - expected[n - 1])
    out = apply_filter(_recording(reading, time=time), filter_of("rc_low_pass", time_constant_s=rc))
    assert out.accelerometer == pytest.approx(expected, abs=1e-9)  # times are rounded to ns
    assert out.gyroscope == pytest.approx(10.0 * expected, abs=1e-8)


@pytest.mark.parametrize("rc", [1e-4, 0.1, 50.0, 1e6])
def test_the_rc_filter_keeps_its_digits_at_any_time_constant(rc: float) -> None:
    reading = np.random.default_rng(2).normal(size=4000)
    settings = filter_of("rc_low_pass", time_constant_s=rc)
    out = apply_filter(_recording(reading), settings).accelerometer
    k = 0.12 / (0.12 + rc)
    level, expected = reading[0], [reading[0]]
    for value in reading[1:]:
        level += k * (value - level)
        expected.append(level)
    assert out is not None
    assert out[:, 0] == pytest.approx(np.array(expected), abs=1e-11)


def test_a_cutoff_stands_for_the_time_constant() -> None:
    reading = np.random.default_rng(3).normal(size=200)
    by_cutoff = apply_filter(_recording(reading), filter_of("rc_low_pass", cutoff_hz=1 / (2 * np.pi * 0.3)))
    by_time = apply_filter(_recording(reading), filter_of("rc_low_pass", time_constant_s=0.3))
    assert by_cutoff.accelerometer == pytest.approx(by_time.accelerometer, rel=1e-12)


@pytest.mark.parametrize("zero_phase", [False, True])
@pytest.mark.parametrize(("name", "gain"), [(f, 0.0 if f in {"high_pass", "band_pass"} else 1.0) for f in FILTERS])
def test_a_constant_passes_without_a_start_up(name: str, gain: float, zero_phase: bool) -> None:  # noqa: FBT001
    out = apply_filter(_recording(np.full(400, 0.98)), filter_of(name, zero_phase=zero_phase))
    assert out.accelerometer is not None
    assert out.accelerometer[:, 0] == pytest.approx(np.full(400, gain * 0.98), abs=1e-9)


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("rc_low_pass", {}),
        ("rc_low_pass", {"cutoff_hz": 0.2}),
        ("low_pass", {"order": 1}),
        ("low_pass", {"order": 4, "cutoff_hz": 0.5}),
        ("band_stop", {}),
    ],
)
def test_a_ramp_comes_out_late_by_delay_s(name: str, changes: dict[str, Any]) -> None:
    rate = 0.7  # g/s
    ramp = rate * np.arange(4000) * 0.12
    out = apply_filter(_recording(ramp), filter_of(name, **changes))
    assert out.accelerometer is not None
    late = (ramp[3000:] - out.accelerometer[3000:, 0]) / rate
    assert late == pytest.approx(np.full(1000, out.filter["delay_s"]), rel=1e-6)
    assert out.filter["delay_s"] > 0.01


def test_the_rc_filter_is_late_by_its_time_constant() -> None:
    assert apply_filter(_recording(np.zeros(50)), filter_of("rc_low_pass")).filter["delay_s"] == pytest.approx(0.24)


def test_a_band_pass_delays_the_envelope_at_its_middle_by_delay_s() -> None:
    time = np.arange(6000) * 0.01
    settings = filter_of("band_pass", low_hz=4.0, high_hz=9.0)
    middle = np.arctan(np.sqrt(np.tan(np.pi * 0.04) * np.tan(np.pi * 0.09))) / (np.pi * 0.01)
    envelope = np.exp(-0.5 * ((time - 30.0) / 3.0) ** 2)
    out = apply_filter(_recording(envelope * np.cos(2 * np.pi * middle * time), interval=0.01), settings)
    assert out.accelerometer is not None
    power = out.accelerometer[:, 0] ** 2
    assert power @ time / power.sum() - 30.0 == pytest.approx(out.filter["delay_s"], rel=1e-2)


@pytest.mark.parametrize("name", FILTERS)
def test_zero_phase_has_no_delay(name: str) -> None:
    bump = np.exp(-0.5 * ((np.arange(2001) - 1000.0) / 40.0) ** 2)
    out = apply_filter(_recording(bump), filter_of(name, zero_phase=True))
    assert out.filter["delay_s"] == 0.0
    assert out.accelerometer is not None
    assert out.accelerometer[:, 0] == pytest.approx(out.accelerometer[::-1, 0], abs=1e-7)


@pytest.mark.parametrize("zero_phase", [False, True])
@pytest.mark.parametrize("name", FILTERS)
def test_noise_gain_is_what_white_noise_shows(name: str, zero_phase: bool) -> None:  # noqa: FBT001
    noise = np.random.default_rng(4).normal(size=(200_000, 3))
    out = apply_filter(_recording(noise), filter_of(name, zero_phase=zero_phase))
    assert out.accelerometer is not None
    assert np.std(out.accelerometer) == pytest.approx(out.filter["noise_gain"], rel=0.01)


def test_noise_gain_of_the_rc_filter_has_its_closed_form() -> None:
    out = apply_filter(_recording(np.zeros(50)), filter_of("rc_low_pass"))  # k = 1/3: sqrt(k / (2 - k))
    assert out.filter["noise_gain"] == pytest.approx(np.sqrt(0.2), rel=1e-13)


def test_noise_gain_is_the_root_of_the_squared_impulse_response() -> None:
    impulse = np.zeros(5000)
    impulse[1] = 1.0
    out = apply_filter(_recording(impulse), filter_of("low_pass", cutoff_hz=0.05, order=3))
    assert out.accelerometer is not None
    assert out.filter["noise_gain"] == pytest.approx(np.sqrt(np.sum(out.accelerometer[:, 0] ** 2)), rel=1e-9)


def test_a_cutoff_has_half_the_power() -> None:
    time = np.arange(20_000) * 0.01
    out = apply_filter(_recording(np.sin(2 * np.pi * 3.0 * time), 0.01), filter_of("low_pass", cutoff_hz=3.0, order=5))
    assert out.accelerometer is not None
    assert np.std(out.accelerometer[5000:, 0]) == pytest.approx(0.5, rel=1e-6)


def test_only_readings_are_filtered() -> None:
    recording = _recording(np.random.default_rng(5).normal(size=100))
    out = apply_filter(recording, filter_of("low_pass"))
    assert out.temperature is recording.temperature
    assert out.table_angle is recording.table_angle
    assert out.filter["name"] == "low_pass"
    assert out.filter["cutoff_hz"] == 1.0


def test_a_butterworth_filter_starts_anew_after_a_gap_and_says_so() -> None:
    time = np.arange(200) * 0.12 + np.where(np.arange(200) >= 100, 30.0, 0.0)
    step = np.where(np.arange(200) >= 100, 5.0, 1.0)
    out = apply_filter(_recording(step, time=time), filter_of("low_pass"))
    assert out.accelerometer is not None
    assert out.accelerometer[:, 0] == pytest.approx(step, abs=1e-12)
    assert [(n.code, n.count) for n in out.notes] == [("N-FILTER-RESTART", 1)]


def test_uneven_samples_are_noted() -> None:
    time = np.cumsum(np.random.default_rng(6).uniform(0.1, 0.14, 300))
    assert [n.code for n in apply_filter(_recording(np.zeros(300), time=time), filter_of("low_pass")).notes] == [
        "N-FILTER-JITTER"
    ]


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        ("low_pass", {"cutoff_hz": 5.0}, r"filter\.cutoff_hz is 5 Hz.*every 0\.12 s.*4\.167 Hz"),
        ("rc_low_pass", {"cutoff_hz": 4.5}, r"filter\.cutoff_hz is 4\.5 Hz"),
        ("low_pass", {"cutoff_hz": None}, r"filter\.cutoff_hz is null"),
        ("band_pass", {"high_hz": None}, r"filter\.high_hz is null"),
        ("band_stop", {"low_hz": 3.0}, r"filter\.low_hz is 3 Hz; it must be below filter\.high_hz, 2\.1 Hz"),
        ("low_pass", {"order": None}, r"filter\.order is null"),
        ("rc_low_pass", {"time_constant_s": None}, r"needs filter\.cutoff_hz"),
    ],
)
def test_an_impossible_setting_is_refused_with_the_numbers(name: str, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        apply_filter(_recording(np.zeros(20)), filter_of(name, **changes))


@pytest.mark.parametrize("changes", [{"cutoff_hz": 0.0}, {"order": 0}, {"name": "median"}, {"time_constant_s": -1.0}])
def test_the_settings_refuse_what_no_filter_can_do(changes: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        Filter.model_validate({**filter_of("low_pass").json_value, **changes})


def test_a_single_sample_cannot_be_filtered() -> None:
    with pytest.raises(InputError, match="accel_x has 1 samples"):
        apply_filter(_recording(np.zeros(1)), filter_of("low_pass"))


def test_all_options_have_the_same_keys_each_with_a_comment() -> None:
    keys = [*yaml.safe_load((CONFIGS / "none.yaml").read_text(encoding="utf-8"))]
    for name in ["none", *FILTERS]:
        assert [*yaml.safe_load((CONFIGS / f"{name}.yaml").read_text(encoding="utf-8"))] == keys
        lines = (CONFIGS / f"{name}.yaml").read_text(encoding="utf-8").splitlines()
        assert all("#" in line for line in lines)


TIME = np.arange(0.0, 120.0, 0.12)
NOISE = 0.03


def read(truth: np.ndarray, seed: int) -> np.ndarray:
    return truth + NOISE * np.random.default_rng(seed).standard_normal(len(truth))


@pytest.mark.parametrize("slope", [0.0, 0.12, -2.0])
def test_a_straight_ramp_loses_most_of_its_noise_at_the_ends_too(slope: float) -> None:
    truth = 25.0 + slope * TIME
    errors = [smooth_temperature(TIME, read(truth, seed)) - truth for seed in range(30)]
    assert np.sqrt(np.mean(np.square(errors))) < NOISE / 8.0  # of 1/sqrt(2 sqrt(pi) 10 s / 0.12 s) = 1/17 in the middle
    assert np.sqrt(np.mean(np.square(np.array(errors)[:, [0, -1]]))) < NOISE / 4.0


def test_a_corner_is_rounded_by_no_more_than_the_noise_hides() -> None:
    truth = 25.0 + 0.12 * np.minimum(TIME, 120.0 - TIME)  # 10 s wide, the kernel would round it by 0.96 degC
    for seed in range(30):
        assert np.abs(smooth_temperature(TIME, read(truth, seed)) - truth).max() < 0.2


def test_without_noise_a_slow_curve_is_followed() -> None:
    truth = 25.0 + 3.0 * np.sin(TIME / 60.0)
    assert np.abs(smooth_temperature(TIME, truth) - truth).max() < 3e-3


def test_coarse_counts_are_not_taken_for_corners() -> None:
    truth = 25.0 + 0.01 * TIME
    coarse = np.round(truth / 0.0625) * 0.0625
    assert np.abs(smooth_temperature(TIME, coarse) - truth).max() < 0.05
    constant = np.full_like(TIME, 21.5)
    np.testing.assert_allclose(smooth_temperature(TIME, constant), constant, rtol=1e-12)


def test_the_rate_of_the_temperature_is_that_of_the_smoothed_one() -> None:
    truth, rate = 25.0 + 3.0 * np.sin(TIME / 60.0), 0.05 * np.cos(TIME / 60.0)
    recording = replace(_recording(np.zeros(len(TIME)), time=TIME), temperature=read(truth, 1))
    off = temperature_rate_of(recording) - rate
    assert np.sqrt(np.mean(off[100:-100] ** 2)) < 0.1 * np.abs(rate).max()


@pytest.mark.parametrize(
    ("temperatures", "expected"),
    [
        ([[20.0, 21.5, 20.2]], True),
        ([[20.0, 22.0], [22.0, 20.0]], True),  # each in a recording of its own
        ([[20.0, 25.0, 24.5]], False),  # cools by half a degree
        ([[20.0, 25.0], None, []], False),
        ([[25.0, 20.0], [20.0, 15.0]], False),
    ],
)
def test_a_temperature_heats_and_cools_by_a_degree_or_it_does_not(temperatures: Any, *, expected: bool) -> None:
    assert heats_and_cools(None if t is None else np.array(t) for t in temperatures) is expected
