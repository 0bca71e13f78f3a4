"""A gyroscope against an encoder of coarse steps, on a motor that ripples: the rounding shows no effect."""

import numpy as np
from scipy.integrate import cumulative_trapezoid
from unit_settings import settings_of

from pipeline.core.records import Noise, Recording
from pipeline.estimation.observations import observe, weighted
from pipeline.estimation.selection import select

WHITE = 0.03  # deg/s
NOISE = Noise(np.full(3, WHITE), np.full(3, 1e-3), 100.0, "static")
LIMITS = {"scale_factor_asymmetry": 1e-3, "g_sensitivity": 0.1, "table_encoder_error": 0.02, "time_offset": 0.01}
SHEET = {"full_scale": 500.0, "bias": 20.0, "scale_factor": 0.03, "cross_axis": 0.02, "effects": LIMITS}


def turns(axis: str, first: int, rng: np.random.Generator) -> Recording:
    """Rests and turns at 60 and 240 deg/s in both directions, 0.4 % of random ripple, logged in steps of 0.01 deg."""
    rate = np.zeros(0)
    for speed in (60.0, -60.0, 240.0, -240.0):
        length = round(360.0 / abs(speed) / 0.01)
        rate = np.concatenate(
            [rate, np.zeros(500), np.linspace(0, speed, 60), np.full(length, speed), np.linspace(speed, 0, 60)]
        )
    rate = np.append(rate, np.zeros(500))
    ripple = np.zeros(len(rate))
    for i in range(1, len(rate)):  # correlated over 0.1 s
        ripple[i] = 0.9 * ripple[i - 1] + np.sqrt(1.0 - 0.9**2) * rng.normal()
    rate *= 1.0 + 0.004 * ripple
    angle = cumulative_trapezoid(rate, dx=0.01, initial=0.0)
    reading = 0.5 + rng.normal(0.0, WHITE, (len(rate), 3))
    reading[:, "xyz".index(axis)] += 1.01 * rate
    stamps = (np.arange(len(rate)) + first) * 10_000_000
    return Recording(
        f"gyro_{axis}", "gyroscope", axis, stamps, gyroscope=reading, table_angle=np.rint(angle / 0.01) * 0.01
    )


def recordings() -> list[Recording]:
    rng = np.random.default_rng(11)
    return [turns(axis, 20_000 * k, rng) for k, axis in enumerate("xyz")]


def test_rows_of_a_turn_weigh_less_by_the_noise_of_the_rate() -> None:
    observations = observe("gyroscope", recordings(), settings_of().table)
    reduced = weighted(observations, NOISE)
    assert weighted(reduced, NOISE) is reduced  # a selection with a formula starts from reduced weights
    for plain, part in zip(observations.parts, reduced.parts, strict=True):
        assert part.rounding is not None
        resting = part.rounding == 0.0
        share = part.weight / plain.weight
        assert np.ptp(share[resting]) < 1e-12
        expected = share[resting][0] / (1.0 + part.rounding / WHITE**2)
        np.testing.assert_allclose(share, expected)
        assert share[~resting].max() < share[resting][0]
        np.testing.assert_allclose(np.sqrt(plain.scatter / np.sum(plain.weight - 1.0)), WHITE, rtol=0.1)
        np.testing.assert_array_equal(part.scatter, plain.scatter)


def test_rounding_and_ripple_are_no_effect_of_the_sensor() -> None:
    observations = observe("gyroscope", recordings(), settings_of().table)
    selection = select(observations, (), NOISE, settings_of(sensor={"gyroscope": SHEET}).sensor.gyroscope)
    assert selection.names == []
    expected = WHITE * np.sqrt(selection.observations.less_stop_errors.expected_square)
    assert 0.95 * expected < selection.fit.residual_rms < 1.15 * expected
