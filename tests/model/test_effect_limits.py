import numpy as np

from pipeline.model.effect_limits import parameter_limits
from pipeline.model.effects import effect


def test_parameters_of_another_unit_have_a_limit_of_their_own() -> None:
    limits = {"warm_up": 0.01, "warm_up_time_constant": 600.0}
    assert parameter_limits(effect("warm_up"), "accelerometer", limits).tolist() == [0.01, 0.01, 0.01, 600.0]
    limits = {"bias_temperature_quadratic": 1e-3, "bias_temperature_quadratic_b_T2": 1e-5}
    found = parameter_limits(effect("bias_temperature_quadratic"), "gyroscope", limits)
    assert found.tolist() == [1e-3, 1e-5] * 3


def test_an_effect_without_a_limit_has_none() -> None:
    assert np.all(np.isinf(parameter_limits(effect("g_sensitivity"), "gyroscope", {})))
