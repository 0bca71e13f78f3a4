"""One motion by hand, as loggers of many kinds write it down: other names, units, separators, preambles, counts."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache

import numpy as np

from pipeline.simulation.campaign import simulate_unit
from pipeline.simulation.description import UnitDescription

GRAVITY = 9.80665
INTERVAL_S = 0.01


@cache
def motion() -> np.ndarray:
    """Return time (s), specific force (g) and angular rate (deg/s) of 14 rests and the moves between: (n, 7) array."""
    unit = UnitDescription(
        "U",
        sensor="mpu6050",
        table="hand",
        procedure="multi_position",
        interval_s=INTERVAL_S,
        course={"positions": 14, "dwell_s": 1.5, "validation_s": 0.0, "static_s": 0.0, "warm_up_rest_s": 3.0},
    )
    (recording,), _ = simulate_unit(unit, 5, 0)
    assert recording.accelerometer is not None
    assert recording.gyroscope is not None
    return np.column_stack([recording.time - recording.time[0], recording.accelerometer, recording.gyroscope])


@dataclass(frozen=True)
class Logger:
    """How one kind of logger writes."""

    header: str  # empty where it writes none
    scales: tuple[float, float, float]  # what a second, a g and a deg/s are written as; 0 for no time
    expected: dict  # of a proposal: ``csv``, and of channels their column, unit and scale
    before: str = ""
    delimiter: str = ","
    decimal: str = "."
    order: str = "tag"  # groups of columns: t, a and g
    whole: bool = False
    reverse: bool = False  # axes in the order z, y, x
    offset: float = 0.0
    start: float = 0.0
    name: str = "log.csv"
    unknown: tuple[str, ...] = field(default=())

    def text(self) -> str:
        data = motion()
        second, g, dps = self.scales
        force, rate = (data[:, c] * s + self.offset for c, s in ((slice(1, 4), g), (slice(4, 7), dps)))
        if self.reverse:
            force, rate = force[:, ::-1], rate[:, ::-1]
        time = (data[:, :1] + self.start) * second
        columns = np.column_stack([{"t": time, "a": force, "g": rate}[c] for c in self.order if c != "t" or second])
        digits = "%.0f" if self.whole else "%.9g" if self.start == 0 else "%.6f"
        separator = " " if self.delimiter == "whitespace" else self.delimiter
        rows = (separator.join(digits % v for v in row).replace(".", self.decimal) for row in columns.tolist())
        return self.before + (self.header + "\n" if self.header else "") + "\n".join(rows) + "\n"


def triads(accelerometer: dict, gyroscope: dict) -> dict:
    return {"accel_x": accelerometer, "gyro_z": gyroscope}


LOGGERS = {
    "counts after a preamble": Logger(
        "ax,ay,az,gx,gy,gz",
        (0.0, 16384.0, 131.0),
        {"csv": {"skip_lines": 2, "rate_hz": 100.0}, **triads({"column": "ax", "counts_per_unit": 16384.0},
         {"column": "gz", "unit": "counts", "counts_per_unit": 131.0})},
        before="Fs,100\nLogging Type,0\n",
        whole=True,
    ),
    "milliseconds and m/s^2, rates in rad/s": Logger(
        "timestamp_ms;acc_x;acc_y;acc_z;gyr_x;gyr_y;gyr_z",
        (1e3, GRAVITY, np.pi / 180),
        {"csv": {"delimiter": ";", "rate_hz": None}, "time": {"column": "timestamp_ms", "unit": "ms"},
         **triads({"unit": "m/s^2"}, {"column": "gyr_z", "unit": "rad/s"})},
        delimiter=";",
    ),
    "decimal commas, units in the names": Logger(
        "t [s]\tacceleration x [mg]\tacceleration y [mg]\tacceleration z [mg]\tw_x [°/s]\tw_y [°/s]\tw_z [°/s]",
        (1.0, 1000.0, 1.0),
        {"csv": {"delimiter": "\t", "decimal": ","}, "time": {"unit": "s"},
         **triads({"column": "acceleration x [mg]", "unit": "mg"}, {"unit": "deg/s"})},
        delimiter="\t",
        decimal=",",
    ),
    "no header, blanks, no time": Logger(
        "",
        (0.0, GRAVITY, np.pi / 180),
        {"csv": {"delimiter": "whitespace", "header": False, "rate_hz": "???"},
         **triads({"column": 0, "unit": "m/s^2"}, {"column": 5, "unit": "???"})},
        delimiter="whitespace",
        unknown=("rate_hz", "gyro_x", "gyro_y", "gyro_z"),
    ),
    "a header in a comment, seconds since 1970": Logger(
        "# time wx wy wz ax ay az",
        (1.0, 1.0, np.pi / 180),
        {"csv": {"delimiter": "whitespace", "header": "commented", "comment": "#"}, "time": {"unit": "s"},
         **triads({"column": "ax", "unit": "g"}, {"column": "wz", "unit": "rad/s"})},
        delimiter="whitespace",
        order="tga",
        start=1535632344.0,
    ),
    "dotted names, microseconds, gyroscope first": Logger(
        "timestamp\timu.gyro.x\timu.gyro.y\timu.gyro.z\timu.acc.x\timu.acc.y\timu.acc.z",
        (1e6, GRAVITY, 1.0),
        {"csv": {"delimiter": "\t"}, "time": {"unit": "us"},
         **triads({"column": "imu.acc.x", "unit": "m/s^2"}, {"column": "imu.gyro.z", "unit": "deg/s"})},
        delimiter="\t",
        order="tga",
    ),
    "axes in the order z, y, x": Logger(
        "seconds_elapsed,AccZ,AccY,AccX,GyrZ,GyrY,GyrX",
        (1.0, GRAVITY, 1.0),
        {"time": {"unit": "s"}, **triads({"column": "AccX"}, {"column": "GyrZ", "unit": "deg/s"})},
        reverse=True,
    ),
    "an offset of 2^15 counts": Logger(
        "TimeUS,acc_x,acc_y,acc_z,gyr_x,gyr_y,gyr_z",
        (1e6, 4070.0, 83.2),
        {"time": {"column": "TimeUS", "unit": "us"}, **triads({"offset": 32768.0}, {"offset": 32768.0})},
        whole=True,
        offset=32768.0,
    ),
    **{
        f"an offset of 2^15 counts without names, columns {order}": Logger(
            "",
            (1e6, 4070.0, 83.2),
            {"time": {"column": 0, "unit": "us"},
             **triads({"column": force_x, "offset": 32768.0}, {"column": rate_z, "offset": 32768.0})},
            delimiter="whitespace",
            order=order,
            whole=True,
            offset=32768.0,
        )
        for order, force_x, rate_z in (("tag", 1, 6), ("tga", 4, 3))
    },
    "PX4's names": Logger(
        "timestamp,gyro_rad[0],gyro_rad[1],gyro_rad[2],accelerometer_m_s2[0],accelerometer_m_s2[1],"
        "accelerometer_m_s2[2]",
        (1e6, GRAVITY, np.pi / 180),
        {"time": {"unit": "us"}, **triads({"column": "accelerometer_m_s2[0]", "unit": "m/s^2"},
         {"column": "gyro_rad[2]", "unit": "rad/s"})},
        order="tga",
    ),
    **{
        f"a gyroscope called {name}": Logger(
            f"t_us,acc_x,acc_y,acc_z,{name}_x,{name}_y,{name}_z",
            (1e6, GRAVITY, scale),
            triads({"column": "acc_x", "unit": "m/s^2"}, {"column": f"{name}_z", "unit": unit}),
        )
        for name, scale, unit in (
            ("om", np.pi / 180, "rad/s"), ("omega", 1.0, "deg/s"), ("rate", np.pi / 180, "rad/s"), ("w", 1.0, "deg/s"),
        )
    },
}  # fmt: skip
