"""Residuals on the pages: what is missing shows at its place and size, and a filter's lag is none."""

import numpy as np
import pytest
from unit_settings import settings_of

from pipeline.output.pages.residual_section import _binned_mean, _of_errors, harmonics, residuals
from pipeline.physics.signal.filters import apply_filter

from .conftest import EFFECT, SIGMA, Unit, build_unit


@pytest.fixture(scope="module")
def unit() -> Unit:
    return build_unit()


def test_a_hidden_quadratic_shows_as_a_constant_and_two_cycles_a_turn(unit: Unit) -> None:
    found = residuals(unit.fit, unit.recordings, unit.settings.table)
    assert [r.recording.name for r in found] == ["accel_x", "accel_y", "accel_z"]
    amplitudes = harmonics(found[0])
    assert amplitudes is not None
    scatter = 4.0 * SIGMA["accelerometer"] * np.sqrt(2.0 / found[0].recording.samples)
    expected = np.zeros((13, 3))
    expected[0, 1:] = expected[2, 1:] = EFFECT / 2.0  # f^2 = (1 + cos 2A) / 2
    np.testing.assert_allclose(amplitudes[1:], expected[1:], atol=scatter)
    np.testing.assert_allclose(amplitudes[0], expected[0], atol=scatter)


def test_a_filters_lag_is_no_residual(unit: Unit) -> None:
    lag = 1.0
    settings = settings_of(**{"filter.name": "rc_low_pass", "filter.time_constant_s": lag}).filter
    turns = [apply_filter(r, settings) for r in unit.recordings[:3]]
    for residual in residuals(unit.fit, turns, unit.settings.table):
        amplitudes = harmonics(residual)
        assert amplitudes is not None
        of_the_lag = np.radians(lag * residual.motion.angular_rate.max())  # 1 g turns by this angle in the lag
        assert of_the_lag > 0.03
        assert amplitudes[1].max() < 0.02 * of_the_lag


def test_binned_means_find_the_covariate_that_matters() -> None:
    rng = np.random.default_rng(11)
    x = rng.uniform(0, 1, 9000)
    white = rng.standard_normal((9000, 3))
    nothing = _binned_mean(x, *_of_errors(white))
    slope = _binned_mean(x, *_of_errors(white + 0.5 * x[:, None]))
    assert nothing is not None
    assert slope is not None
    assert nothing.excess(np.zeros(3)) < 2.0
    assert slope.excess(np.zeros(3)) > 10.0
    assert _binned_mean(np.full(9000, 3.0), *_of_errors(white)) is None
