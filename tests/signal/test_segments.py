"""One long recording cut into its parts, against the simulation's plan of it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from imu_logs.log import Log
from imu_logs.profile import Checks
from pipeline.core.errors import InputError
from pipeline.core.records import rate_of_attitude
from pipeline.core.settings import RecordingFile, Window
from pipeline.ingest.clock_alignment import unwrapped
from pipeline.ingest.read import to_recording
from pipeline.physics.signal.segments import cut
from pipeline.simulation.campaign import Streams, simulate_unit
from pipeline.simulation.description import TRANSIT, UnitDescription, course_of, plan

if TYPE_CHECKING:
    from pipeline.core.records import Recording

COURSE = {"step_deg": 30.0, "dwell_s": 2.0, "validation_s": 60.0, "static_s": 90.0, "pause_s": 10.0}
TURNS = ["accel_x", "accel_y", "accel_z", "gyro_x", "gyro_y", "gyro_z"]


@cache
def session(**course: Any) -> Recording:
    unit = UnitDescription("U", procedure="one_recording", interval_s=0.05, course={**COURSE, **dict(course)})
    return counted_on(simulate_unit(unit, 3, 0)[0][0])


def counted_on(recording: Recording) -> Recording:
    """What ingest makes of an encoder that starts again at a full turn."""
    angle = recording.table_angle
    assert angle is not None
    return replace(recording, table_angle=np.unwrap(angle, period=360.0))


def planned_times(**course: Any) -> dict[str, tuple[float, float]]:
    """When each part begins and ends by the plan, s from the first sample."""
    unit = UnitDescription("U", procedure="one_recording", interval_s=0.05, course={**COURSE, **course})
    now, out = 0.0, {}
    for part in plan("one_recording", course_of(unit), Streams(3, 0)["motion"]):
        if part.name != TRANSIT:
            out[part.name] = (now, now + part.trajectory.duration)
        now += part.trajectory.duration
    return out


def times(recordings: list[Recording], start: float) -> dict[str, tuple[float, float]]:
    return {r.name: (float(r.time[0]) - start, float(r.time[-1]) - start) for r in recordings}


@pytest.mark.parametrize("course", [{}, {"rates_dps": (30.0, 90.0), "both_directions": True, "turns": 2}])
def test_the_parts_of_a_plan_are_found_where_they_lie(course: dict[str, Any]) -> None:
    whole = session(**course)
    found = cut(whole)
    assert [r.name for r in found] == [*TURNS, "validation", "static"]
    assert [(r.role, r.axis) for r in found[:6]] == [
        *(("accelerometer", a) for a in "xyz"),
        *(("gyroscope", a) for a in "xyz"),
    ]
    planned, lie = planned_times(**course), times(found, float(whole.time[0]))
    for name in [*TURNS, "validation"]:
        (begin, end), (a, b) = planned[name], lie[name]
        inside = (whole.time - whole.time[0] >= begin) & (whole.time - whole.time[0] <= end)
        rate = whole.table_rate if name != "validation" else None
        assert whole.table_attitude is not None
        rate = rate_of_attitude(whole.time, whole.table_attitude) if rate is None else rate
        moving = (whole.time - whole.time[0])[inside & (np.abs(rate) > 1.0)]
        assert a <= moving[0], name
        assert b >= moving[-1], name
        assert a > begin - 25.0, name
        assert b < end + 25.0, name


def test_each_sample_of_a_part_is_that_of_the_recording_and_no_two_parts_share_one() -> None:
    whole = session()
    parts = cut(whole)
    stamps = np.concatenate([r.time_ns for r in parts])
    assert len(np.unique(stamps)) == len(stamps)
    for part in parts:
        rows = np.searchsorted(whole.time_ns, part.time_ns)
        np.testing.assert_array_equal(np.diff(rows), 1)
        assert part.accelerometer is not None
        assert whole.accelerometer is not None
        np.testing.assert_array_equal(part.accelerometer, whole.accelerometer[rows])
        assert [n.code for n in part.notes] == ["N-SEGMENT"]


def test_where_somebody_mounts_the_sensor_anew_no_part_reaches_over_that() -> None:
    whole = session()
    gyro, start = whole.gyroscope, float(whole.time[0])
    assert gyro is not None
    found = times(cut(whole), start)
    by_hand = found["accel_y"][1] - 3.0  # within the rest after the steps about y
    shaken = gyro.copy()
    hand = (whole.time - start > by_hand) & (whole.time - start < by_hand + 1.0)
    shaken[hand] += 50.0
    again = times(cut(replace(whole, gyroscope=shaken)), start)
    assert set(again) == set(found)
    assert all(b < by_hand or a > by_hand + 1.0 for a, b in again.values())


def test_where_an_axis_turns_in_one_way_only_the_turns_serve_both_sensors() -> None:
    whole = session(accelerometer_rates_dps=(20.0,))
    start = float(whole.time[0])
    steady = {r.name: r for r in cut(whole)}
    assert set(TURNS) <= set(steady)  # the slower turns for the accelerometer
    assert float(np.abs(steady["accel_x"].table_rate).max()) == pytest.approx(20.0)  # type: ignore[arg-type]
    assert float(np.abs(steady["gyro_x"].table_rate).max()) == pytest.approx(60.0)  # type: ignore[arg-type]
    only = whole.select(
        slice(0, int(np.searchsorted(whole.time - start, times([steady["accel_z"]], start)["accel_z"][1])))
    )
    both = {r.name: (r.role, float(r.time[0])) for r in cut(only)}
    assert {"accel_x", "gyro_x"} <= set(both)
    assert both["accel_x"][1] == both["gyro_x"][1]


def test_windows_take_the_place_of_what_is_found() -> None:
    whole = session()
    windows = [
        Window(role="gyroscope", axis="z", start_s=5.0, stop_s=9.0),
        Window(role="gyroscope", axis="z", start_s=10.0, stop_s=12.0),
        Window(role="static", start_s=0.0, stop_s=3.0),
    ]
    found = cut(whole, windows)
    assert [r.name for r in found] == ["gyro_z", "gyro_z_2", "static"]
    since = whole.time - whole.time[0]
    for part, window in zip(found, windows, strict=True):
        inside = (since >= window.start_s) & (since < window.stop_s)
        np.testing.assert_array_equal(part.time_ns, whole.time_ns[inside])
    assert "given by a window" in found[0].notes[-1].detail


def test_a_window_beyond_the_recording_is_refused() -> None:
    with pytest.raises(InputError, match=r"from 9000 to 9010 s holds 0 samples; the recording is \d+\.\d\d s long"):
        cut(session(), [Window(role="static", start_s=9000.0, stop_s=9010.0)])


def test_without_a_table_or_a_turn_the_recording_is_refused_and_windows_are_named() -> None:
    bare = replace(session(), table_angle=None, table_rate=None, table_attitude=None)
    with pytest.raises(InputError, match="no log of the table; give windows"):
        cut(bare)
    still = next(r for r in cut(session()) if r.name == "static")
    with pytest.raises(InputError, match="no turns about one axis were found in 0 moves"):
        cut(replace(still, role="session"))


def test_the_rate_of_held_out_motion_is_that_of_all_gimbals() -> None:
    whole = session()
    assert whole.table_rate is not None
    free = next(r for r in cut(whole) if r.name == "validation")
    here = np.isin(whole.time_ns, free.time_ns)
    one_gimbal = replace(whole, table_rate=np.where(here, 0.5, 1.0) * whole.table_rate)
    for recording in (whole, one_gimbal):
        part = next(r for r in cut(recording) if r.name == "validation")
        assert part.table_attitude is not None
        exact = rate_of_attitude(part.time, part.table_attitude)
        assert part.table_rate is not None
        np.testing.assert_allclose(part.table_rate, exact, atol=0.02)


def test_an_attitude_alone_gives_the_rate_of_held_out_motion() -> None:
    part = next(r for r in cut(session()) if r.name == "validation")
    assert part.table_attitude is not None
    values = {f"table_q{c}": part.table_attitude[:, i] for i, c in enumerate("wxyz")}
    table = Log("log", part.time_ns, values, {"file": "log"})
    entry = RecordingFile(file="validation", role="validation", axis=None, optional=False)
    read = to_recording("validation", entry, unwrapped(table), None, Checks())
    assert read.table_rate is not None
    assert part.table_rate is not None
    np.testing.assert_allclose(read.table_rate, part.table_rate, atol=0.02)
