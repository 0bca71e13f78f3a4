"""Ticks stand at round values, and thinning keeps what the eye would see."""

import numpy as np
import pytest

from pipeline.report.axes import Scale, log_ticks, span, thin, tick_label, tick_step, ticks
from pipeline.report.numbers import measured, number, typeset


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (0.0, 1.0, [0.0, 0.2, 0.4, 0.6, 0.8, 1.0]),
        (-0.7, 1.1, [-0.5, 0.0, 0.5, 1.0]),
        (3.0, 4.2, [3.0, 3.25, 3.5, 3.75, 4.0]),
    ],
)
def test_ticks_stand_at_round_values(low: float, high: float, expected: list[float]) -> None:
    assert ticks(low, high) == pytest.approx(expected)


def test_an_axis_of_angles_is_divided_by_parts_of_a_turn() -> None:
    assert ticks(0.0, 360.0, 6, angle=True) in (
        [0.0, 45 * 1.0] + [45.0 * k for k in range(2, 9)],
        [0.0, 90.0, 180.0, 270.0, 360.0],
    )
    assert tick_step(-720.0, 720.0, 6, angle=True) == 180.0


@pytest.mark.parametrize(
    ("value", "step", "text"),
    [(0.25, 0.25, "0.25"), (-0.5, 0.5, "−0.5"), (0.0, 1e-9, "0"), (1.5e-4, 5e-5, "1.5e-4"), (2e6, 1e6, "2e6")],
)
def test_a_tick_has_the_decimals_that_its_step_needs(value: float, step: float, text: str) -> None:
    assert tick_label(value, step) == text.replace("-", "−")


def test_a_logarithmic_axis_has_at_least_two_ticks_within_a_decade() -> None:
    assert log_ticks(0.001, 1.0) == pytest.approx([0.001, 0.01, 0.1, 1.0])
    assert log_ticks(0.012, 0.06) == pytest.approx([0.02, 0.05])


def test_a_scale_takes_its_ends_to_the_ends_of_the_panel() -> None:
    linear, decades = Scale(-1.0, 3.0, 50.0, 450.0), Scale(0.01, 100.0, 0.0, 400.0, logarithmic=True)
    assert [linear.pixels(v) for v in (-1.0, 1.0, 3.0)] == [50.0, 250.0, 450.0]
    assert linear.units(np.array([-9.0, 1.0, 9.0])).tolist() == [500, 2500, 4500]
    assert decades.pixels(1.0) == pytest.approx(200.0)


def test_a_constant_series_still_has_an_axis() -> None:
    assert span([np.full(5, 2.0)]) == (1.0, 3.0)
    assert span([np.zeros(5)]) == (-0.5, 0.5)
    assert span([np.array([np.nan])]) == (0.0, 1.0)


@pytest.mark.parametrize("n", [10, 400, 401, 1234, 99_999])
def test_thinning_keeps_both_extremes_in_order_and_no_more_than_asked(n: int) -> None:
    values = np.random.default_rng(4).standard_normal(n)
    kept = thin(values, 400)
    assert len(kept) <= 400 + 2
    assert (np.diff(kept) > 0).all()
    assert values[kept].max() == values.max()
    assert values[kept].min() == values.min()


def test_a_measured_value_has_two_digits_of_its_uncertainty() -> None:
    assert measured(0.0312345, 0.00123) == "0.0312 ± 0.0012"
    assert measured(-12.3456, 3.7) == "−12.3 ± 3.7"
    assert measured(0.5, None) == "0.50000"
    assert number(None) == number(float("nan")) == "–"


def test_sentences_of_a_terminal_get_the_signs_of_print_and_keep_hyphens() -> None:
    said = "b_x = -0.1 +- 0.02 deg/s, p = 1e-12, G_xy = -3e-05 (delta BIC -8.9), on 2019-03-12, in warm-up 3-4"
    assert (
        typeset(said) == "b_x = −0.1 ± 0.02 deg/s, p = 1e−12, G_xy = −3e−05 (ΔBIC −8.9), on 2019-03-12, in warm-up 3-4"
    )
