"""A sound unit and the ways in which its recordings contradict each other, as ``docs/bad_inputs.md`` numbers them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from pipeline.simulation.campaign import simulate_unit
from pipeline.simulation.description import UnitDescription, shipped_settings

if TYPE_CHECKING:
    from collections.abc import Callable

    from pipeline.core.records import Recording

    Unit = list[Recording]
    Change = Callable[[Unit], Unit]

RADIAN = np.pi / 180.0
SHIPPED = shipped_settings(sensor="mpu6050", table="acutronic")
SETTINGS = SHIPPED.replaced(procedure=SHIPPED.procedure.replaced(recordings={}))  # whose recordings are not stated


@cache
def sound(seed: int = 4, effects: str = "") -> tuple[Recording, ...]:
    """Return the recordings of a simulated unit, as if they were read from CSV files."""
    hidden = dict.fromkeys(effects.split())
    unit = UnitDescription("U", course={"rates_dps": (30.0, 60.0), "both_directions": True}, effects=hidden)
    recordings, _ = simulate_unit(unit, seed, 1)
    return tuple(replace(r, source={"file": f"{r.name}.csv", "rows": r.samples}) for r in recordings)


def at(names: str, change: Callable[[Recording], Recording]) -> Change:
    """Return a change of some recordings; of all without names."""
    chosen = names.split()
    return lambda unit: [change(r) if not chosen or r.name in chosen else r for r in unit]


def of(channel: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Recording], Recording]:
    """Return a change of one channel, where it is logged."""

    def apply(recording: Recording) -> Recording:
        values = getattr(recording, channel)
        return recording if values is None else replace(recording, **{channel: change(values.copy())})

    return apply


def without(channel: str, change: Callable[[Recording], Recording]) -> Callable[[Recording], Recording]:
    return lambda r: replace(change(r), **{channel: None})


def both(*changes: Callable[[Recording], Recording]) -> Callable[[Recording], Recording]:
    def apply(recording: Recording) -> Recording:
        for change in changes:
            recording = change(recording)
        return recording

    return apply


def times(factor: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda v: v * factor


def spike(size: float, rows: slice) -> Callable[[np.ndarray], np.ndarray]:
    def apply(values: np.ndarray) -> np.ndarray:
        values[rows] += size
        return values

    return apply


def frozen(first: int, last: int) -> Callable[[np.ndarray], np.ndarray]:
    def apply(values: np.ndarray) -> np.ndarray:
        values[first:last] = values[first]
        return values

    return apply


def late(rows: int) -> Callable[[np.ndarray], np.ndarray]:
    return lambda v: np.concatenate([np.repeat(v[:1], rows, axis=0), v[:-rows]])


def clock(factor: int) -> Callable[[Recording], Recording]:
    return lambda r: replace(r, time_ns=r.time_ns * factor)


def quaternion(row: int) -> Callable[[np.ndarray], np.ndarray]:
    def apply(q: np.ndarray) -> np.ndarray:
        q[row] = [1.0, 0.0, 0.0, 0.0]
        return q

    return apply


def table_of(seed: int) -> Change:
    """Return the change that gives the held-out motion the table's log of another unit."""

    def apply(unit: Unit) -> Unit:
        other = {r.name: r for r in sound(seed)}["validation"]
        mine = {"table_rate": other.table_rate, "table_attitude": other.table_attitude}
        return at("validation", lambda r: replace(r, **mine))(unit)

    return apply


def knocked(first: int, last: int) -> Callable[[Recording], Recording]:
    """Return a change that shakes the unit and leaves it tilted by 5 deg."""
    shaking = np.random.default_rng(1).standard_normal((last - first, 3))

    def apply(recording: Recording) -> Recording:
        assert recording.accelerometer is not None
        assert recording.gyroscope is not None
        force, rate = recording.accelerometer.copy(), recording.gyroscope.copy()
        force[first:last] += 0.2 * shaking
        rate[first:last] += 20.0 * shaking
        force[last:] += [0.09, 0.0, 0.0]
        return replace(recording, accelerometer=force, gyroscope=rate)

    return apply


def copied(name: str, rows: slice | np.ndarray, start_s: int = 0) -> Change:
    """Return the change that makes the held-out motion of samples of another recording, at other times."""

    def apply(unit: Unit) -> Unit:
        copy = next(r for r in unit if r.name == name).select(rows)
        copy = replace(copy, name="validation", role="validation", axis=None, time_ns=copy.time_ns + start_s * 10**9)
        return [copy if r.name == "validation" else r for r in unit]

    return apply


def stays(axis: int, every: int = 10**9) -> Callable[[np.ndarray], np.ndarray]:
    """Return a change by which an axis stays at one value, but for glitches."""

    def apply(values: np.ndarray) -> np.ndarray:
        values[np.arange(len(values)) % every != every - 1, axis] = 0.25
        return values

    return apply


def thousandths(values: np.ndarray) -> np.ndarray:
    return np.round(values, 3)


def same_axes(values: np.ndarray) -> np.ndarray:
    values[:, 1] = values[:, 0]
    return values


@dataclass
class Case:
    """A change, and the refusal (fault) or note (code) that has to come of it, its file and a part of its sentence."""

    change: Change
    fault: str = ""
    says: str = ""
    file: str = ""
    note: str = ""
    code: str = "N-REFERENCE"


def cases() -> dict[str, Case]:
    rate, angle = "table_rate", "table_angle"
    scale, wrong = "reference_scale", "reference_contradiction"
    gyro_radians = of("gyroscope", times(RADIAN))
    return {
        "49 rate in rad/s": Case(
            at("", of(rate, times(RADIAN))), scale, "table_rate_dps looks like rad/s declared as deg/s", "accel_x.csv"
        ),
        "49 rate in rpm": Case(at("", of(rate, times(1 / 6))), scale, "looks like rpm", "accel_x.csv"),
        "49 rate twice": Case(at("gyro_y", of(rate, times(2.0))), scale, "is twice what it should be", "gyro_y.csv"),
        "49 rate of the held-out motion": Case(
            at("validation", of(rate, times(RADIAN))), scale, "looks like rad/s", "validation.csv"
        ),
        "49 rate alone, gravity tells": Case(
            at("", without(angle, of(rate, times(RADIAN)))), scale, "by gravity", "accel_x.csv"
        ),
        "49 rate and gyroscope": Case(
            at("", both(of(rate, times(RADIAN)), gyro_radians)),
            scale,
            r"table_rate_dps and gyro_x_dps .. gyro_z_dps look like rad/s",
            "accel_x.csv",
        ),
        "49 angle": Case(at("", of(angle, times(RADIAN))), scale, "table_angle_deg looks like rad declared as deg"),
        "49 angle and rate": Case(
            at("accel_x", both(of(angle, times(RADIAN)), of(rate, times(RADIAN)))),
            scale,
            "table_angle_deg looks like rad declared as deg.* as far as gravity says",
            "accel_x.csv",
        ),
        "49 angle alone": Case(at("", without(rate, of(angle, times(2.0)))), scale, "table_angle_deg is twice"),
        "49 rate by 2 %": Case(at("", of(rate, times(1.02))), note="table_rate_dps is 1.02 times", file="gyro_x.csv"),
        "49 angle and rate by 0.5 %": Case(
            at("gyro_x", both(of(rate, times(1.005)), of(angle, times(1.005)))),
            note="table_angle_deg turns 1.005",
            file="gyro_x.csv",
        ),
        "50 ms": Case(at("", clock(1000)), "reference_time", "time_s looks like ms declared as s", "accel_x.csv"),
        "50 us of an angle": Case(at("", without(rate, clock(10**6))), "reference_time", "looks like us"),
        "50 ms of the rest": Case(
            at("static", clock(1000)), "reference_time", "0.12 s in the unit's other", "static.csv"
        ),
        "51 spike": Case(
            at("gyro_x", of(rate, spike(4000.0, slice(30, 31)))),
            wrong,
            r"table_rate_dps is 4000 deg/s in row 31 \(.* s\), while table_angle_deg and gyro_x_dps .. gyro_z_dps show",
            "gyro_x.csv",
        ),
        "51 small spike": Case(
            at("gyro_x", of(rate, spike(-30.0, slice(20, 22)))), wrong, "rows 21 to 22", "gyro_x.csv"
        ),
        "51 spike of the held-out rate": Case(
            at("validation", without("table_attitude", of(rate, spike(100.0, slice(500, 501))))), wrong, "row 501"
        ),
        "51 spike of an angle": Case(at("accel_z", of(angle, spike(20.0, slice(9, 10)))), wrong, "rows 9 to 11"),
        "51 jump of an angle": Case(at("accel_z", of(angle, spike(2.5, slice(405, None)))), note="table_angle_deg"),
        "51 quaternion": Case(at("validation", of("table_attitude", quaternion(300))), wrong, "rows 300 to 302"),
        "51 another unit's log": Case(table_of(5), wrong, "validation: table_", "validation.csv"),
        "51 conjugate attitude": Case(
            at("validation", of("table_attitude", lambda q: q * [1, -1, -1, -1])), wrong, "about other body axes"
        ),
        "51 opposite signs": Case(
            at("", of(rate, times(-1.0))),
            wrong,
            "table_rate_dps and the change of table_angle_deg have opposite signs",
            "accel_x.csv",
        ),
        "51 frozen": Case(at("validation", of(rate, frozen(300, 700))), wrong, "is it frozen", "validation.csv"),
        "51 nothing but zeros": Case(at("gyro_z", of(rate, times(0.0))), wrong, "table_rate_dps"),
        "51 reversed": Case(at("gyro_y", of(angle, lambda v: v[::-1])), wrong, "table_angle_deg"),
        "51 sections lost": Case(
            at("accel_y", of(angle, lambda v: np.append(np.delete(v, slice(300, 360)), np.repeat(v[-1], 60)))),
            wrong,
            "table_angle_deg",
        ),
        "52 rate late": Case(at("gyro_x", of(rate, late(1))), wrong, r"runs 0.12\d* s late against table_angle_deg"),
        "52 one recording late": Case(
            at("validation", both(of(rate, late(3)), of("table_attitude", late(3)))),
            wrong,
            "sensor is -0.36 s late against",
        ),
        "53 moved at the end": Case(
            at("static", knocked(850, 900)), note="only rows 1 to", file="static.csv", code="N-MOVED"
        ),
        "53 shaken all along": Case(
            at("static", knocked(0, 1001)), "not_at_rest", "is for the noise at rest", "static.csv"
        ),
        "53 a turn": Case(
            lambda unit: [replace(unit[0].select(slice(0, 400)), name="static", role="static", axis=None), *unit[1:-1]],
            "not_at_rest",
            "the table turns at up to 20 deg/s",
        ),
        "54 rounded": Case(
            lambda unit: at("validation", both(of("accelerometer", thousandths), of("gyroscope", thousandths)))(
                copied("gyro_y", slice(None))(unit)
            ),
            "shared_rows",
            "of recording gyro_y",
        ),
        "54 less one row": Case(
            copied("gyro_y", np.delete(np.arange(421), 100)),
            "shared_rows",
            r"are those of recording gyro_y, rows 1 to 421 .*; held-out motion would not be held out",
        ),
        "54 at other times": Case(copied("accel_x", slice(50, 500), 4000), "shared_rows", "of recording accel_x"),
        "54 every second row": Case(copied("accel_x", slice(None, None, 2)), "shared_rows", "of recording accel_x"),
        "55 accelerometer": Case(
            at("accel_y", of("accelerometer", stays(0))), "stuck", "accel_x stays within 0 g", "accel_y.csv"
        ),
        "55 gyroscope, with glitches": Case(
            at("gyro_z", of("gyroscope", stays(2, 50))), "stuck", "gyro_z stays within", "gyro_z.csv"
        ),
        "55 two axes alike": Case(
            at("", of("gyroscope", same_axes)), "copied_axis", "gyro_y is a copy of gyro_x in 100%", "accel_x.csv"
        ),
    }


INPUTS = {  # what each number is; docs/bad_inputs.md lists what happens
    "49": "table, gyroscope and gravity disagree in scale: another unit; by little",
    "50": "times in ms or us declared as s",
    "51": "a table's channel contradicts the others in some rows; by little",
    "52": "a table's channel is late or early",
    "53": "the static recording moves: in a part; for most of it",
    "54": "two recordings share samples",
    "55": "an axis is constant in turns; a copy of another axis",
}
