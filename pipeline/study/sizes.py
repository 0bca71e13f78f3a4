"""What is hidden: the effects of each sensor at the size of its data sheet, and what a procedure shows of them.

Sizes of the MPU-6050 are those of the MPU-6000/6050 product specification 3.4, of the STIM300 those of its data sheet
TS1524 and of the STIM210's gyroscopes, both as far as they say; the others are engineering assumptions. One number is
for all parameters, with random signs. A lag is at least the shortest that the register map knows.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.model.effects import effect

if TYPE_CHECKING:
    from numpy.typing import NDArray

TABLE = {
    "table_tilt": 0.2,
    "table_axis_nonorthogonality": 0.1,
    "table_encoder_error": 0.1,
    "table_rate_ripple": 5e-3,
    "table_backlash": 0.1,
}
SIZES: dict[str, dict[str, dict[str, float | tuple[float, ...]]]] = {
    "mpu6050": {
        "accelerometer": {
            "bias_temperature": 5e-4,
            "bias_temperature_quadratic": (5e-4, 3e-5) * 3,
            "warm_up": (5e-3, 5e-3, 5e-3, 180.0),
            "bias_drift": 3e-6,
            "scale_factor_temperature": 2e-4,
            "scale_factor_asymmetry": 3e-3,
            "quadratic_nonlinearity": 5e-3,
            "cubic_nonlinearity": 5e-3,
            "cross_axis_nonlinearity": 3e-3,
            "vibration_rectification": 2e-3 / 30.0,
            "hysteresis": 1e-3,
            "rate_dependence": 5e-5,
            "lever_arm": 0.05,
            "inner_lever_arms": 3e-3,
            "time_offset": 0.02,
            "low_pass_lag": (0.019,),
            "clock_rate": 200.0,
            **TABLE,
        },
        "gyroscope": {
            "bias_temperature": 0.16,
            "bias_temperature_quadratic": (0.16, 5e-3) * 3,
            "warm_up": (0.3, 0.3, 0.3, 180.0),
            "bias_drift": 2e-4,
            "scale_factor_temperature": 3e-4,
            "scale_factor_asymmetry": 2e-3,
            "quadratic_nonlinearity": 1.6e-5,
            "cubic_nonlinearity": 1.3e-7,
            "vibration_rectification": 0.05 / 100.0,
            "g_sensitivity": 0.1,
            "g_squared_sensitivity": 0.02,
            "earth_rotation": 0.0042,
            "time_offset": 0.02,
            "low_pass_lag": (0.019,),
            "clock_rate": 200.0,
            **TABLE,
        },
    },
    "stim300": {
        "accelerometer": {
            "bias_temperature": 4e-5,
            "warm_up": (1e-3, 1e-3, 1e-3, 180.0),
            "scale_factor_asymmetry": 1e-4,
            "quadratic_nonlinearity": 1e-4,
            "cubic_nonlinearity": 1e-4,
            "cross_axis_nonlinearity": 1e-4,
            "lever_arm": 0.05,
            "inner_lever_arms": 0.012,
            "time_offset": 2e-3,
            "table_tilt": 0.02,
            "table_axis_nonorthogonality": 0.01,
            "table_encoder_error": 0.01,
        },
        "gyroscope": {
            "bias_temperature": 2.0 / 3600.0,
            "warm_up": (5e-3, 5e-3, 5e-3, 180.0),
            "scale_factor_asymmetry": 1e-4,
            "g_sensitivity": 8.0 / 3600.0,
            "earth_rotation": 0.0042,
            "time_offset": 2e-3,
            "table_rate_ripple": 5e-4,
        },
    },
}

# Cells in which a procedure shows nothing, or less than a detection takes (the theory of each: the effect's own page).
UNSEEN_GYROSCOPE = ("table_tilt", "table_backlash", "table_axis_nonorthogonality")
SAME_GYROSCOPE = ("table_encoder_error",)  # to a gyroscope the derivative of an angle's error is a ripple of the rate
ONE_WAY = {
    "accelerometer": {"vibration_rectification", "rate_dependence", "table_backlash"},
    "gyroscope": {"scale_factor_asymmetry", "vibration_rectification"},
}
# Where the noise is known, its square signal over base and noise, whitened, is below 150; a detection takes 40 to 100.
FAINT = {
    "mpu6050": {"accelerometer": {"scale_factor_temperature"}, "gyroscope": {"scale_factor_temperature"}},
    "stim300": {
        "accelerometer": {"bias_temperature", "quadratic_nonlinearity", "cubic_nonlinearity"},
        "gyroscope": {"bias_temperature"},
    },
}
AT_REST = (
    "lever_arm", "inner_lever_arms", "time_offset", "low_pass_lag", "clock_rate", "vibration_rectification",
    "rate_dependence",
)  # fmt: skip


def observable(model: str, sensor: str, procedure: str) -> list[str]:
    """Return the effects that a procedure shows at their size."""
    hidden = set(FAINT[model][sensor])
    if sensor == "gyroscope":
        hidden |= {*UNSEEN_GYROSCOPE, *SAME_GYROSCOPE}
    if procedure == "one_way":
        hidden |= ONE_WAY[sensor]
    return [name for name in SIZES[model][sensor] if name not in hidden]


def drawn(model: str, sensor: str, name: str, rng: np.random.Generator, factor: float = 1.0) -> NDArray[np.float64]:
    """Return the parameters of an effect at its size times ``factor``, within 30 %, with random signs."""
    count = len(effect(name).parameters(sensor))
    size = SIZES[model][sensor][name]
    values = np.broadcast_to(np.atleast_1d(np.array(size, float)), count) * factor * rng.uniform(0.7, 1.3)
    values = values * rng.choice([-1.0, 1.0], count)
    if name == "low_pass_lag":
        values = np.abs(values)
    if name == "warm_up":
        values[3] = np.exp(rng.uniform(np.log(90.0), np.log(400.0)))
    return np.asarray(values, np.float64)
