"""A table's log with a clock of its own, against the clock that the simulation hid."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from simulated_logs import as_table, beside_a_table, clock_errors
from test_mcap_logs import header, imu, write_ros2
from unit_settings import ingest_of, settings_of

from imu_logs.mcap_write import IMU, JOINT_STATE
from imu_logs.profile import Checks
from pipeline.core.errors import IngestError, InputError
from pipeline.core.records import rate_of_attitude
from pipeline.core.settings import RecordingFile
from pipeline.ingest.clock_alignment import align
from pipeline.ingest.read import read_recordings, to_recording
from pipeline.physics.kinematics import reference_motion

if TYPE_CHECKING:
    from pathlib import Path

    from imu_logs.log import Log
    from pipeline.core.records import Recording

STANDARD_GRAVITY = 9.80665


def aligned(recordings: dict[str, Recording], name: str) -> Log:
    return align(as_table(recordings[name]), as_table(recordings[f"{name}_table"]))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", ["accel_y", "gyro_z", "validation"])
def test_offset_and_drift_are_found_within_their_uncertainty(name: str, seed: int) -> None:
    recordings, truth = beside_a_table(seed, wrapped=True)
    offset, u_offset, drift, u_drift = clock_errors(aligned(recordings, name), recordings[name], truth)
    assert abs(offset) < 3.5 * u_offset
    assert u_offset < 0.3e-3
    assert abs(drift) < 3.5 * u_drift
    assert u_drift < 50.0


def test_a_clock_that_is_minutes_off_and_fast_by_a_thousandth_is_found() -> None:
    recordings, truth = beside_a_table(4, offset_s=-431.7, drift_ppm=1000.0)
    offset, u_offset, drift, u_drift = clock_errors(aligned(recordings, "accel_x"), recordings["accel_x"], truth)
    assert abs(offset) < 3.5 * u_offset
    assert abs(drift) < 3.5 * u_drift


def test_the_log_is_at_the_sensors_times_then() -> None:
    unit = beside_a_table(1)[0]
    rows = {r.name: r for r in rows_of(1)}
    for name in ("accel_x", "gyro_y"):
        off = aligned(unit, name).values["table_angle"] - rows[name].table_angle
        assert float(np.sqrt(np.mean(off**2))) < 0.01  # deg: at 60 deg/s, 0.17 ms
    found = aligned(unit, "validation").values
    q = np.column_stack([found[f"table_q{c}"] for c in "wxyz"])
    twin = rows["validation"].table_attitude
    assert twin is not None
    turn = 2.0 * np.degrees(np.arccos(np.clip(np.abs(np.sum(q * twin, axis=1)), 0.0, 1.0)))
    assert float(turn.max()) < 0.05


def test_the_rate_of_held_out_motion_is_that_of_its_attitude_by_the_tables_own_clock() -> None:
    sensor = aligned(beside_a_table(1, drift_ppm=8000.0)[0], "validation")
    q = np.column_stack([sensor.values[f"table_q{c}"] for c in "wxyz"])
    by_sensor = rate_of_attitude(sensor.time_ns / 1e9, q)
    entry = RecordingFile(file="validation", role="validation", axis=None, optional=False)
    found = to_recording("validation", entry, sensor, None, Checks()).table_rate
    assert found is not None
    assert float(np.sum(found) / np.sum(by_sensor)) == pytest.approx(1.0 / 1.008, abs=1e-4)


def rows_of(seed: int) -> list[Recording]:
    return list(beside_a_table(seed, kind="rows")[0].values())


def test_an_encoder_that_starts_again_at_a_full_turn_is_counted_on() -> None:
    wrapped, counted = (beside_a_table(2, wrapped=w)[0] for w in (True, False))
    log = wrapped["accel_z_table"].table_angle
    assert log is not None
    assert log.max() < 360.0
    one, two = (aligned(r, "accel_z").values["table_angle"] for r in (wrapped, counted))
    np.testing.assert_allclose(one, two, atol=1e-6)
    assert "N-UNWRAP" in {n.code for n in aligned(wrapped, "accel_z").notes}


def test_rows_that_the_tables_log_does_not_cover_are_left_out_and_noted() -> None:
    recordings, truth = beside_a_table(0)
    log, whole = recordings["validation_table"], recordings["validation"]
    late = log.select(slice(log.samples // 3, None))
    found = align(as_table(whole), as_table(late))
    cut = next(n for n in found.notes if n.code == "N-CUT")
    assert len(found.time_ns) + cut.count == whole.samples
    assert cut.count > whole.samples // 4
    offset, uncertainty, *_ = clock_errors(found, whole, truth)
    assert abs(offset) < 3.5 * uncertainty


def test_equal_steps_of_which_the_log_lacks_some_are_refused() -> None:
    recordings, _ = beside_a_table(0)
    log = recordings["accel_x_table"]
    with pytest.raises(IngestError, match="log the table during the whole recording"):
        align(as_table(recordings["accel_x"]), as_table(log.select(slice(log.samples // 4, None))))


def test_a_log_that_begins_and_ends_with_the_recording_is_aligned() -> None:
    recordings, truth = beside_a_table(0, offset_s=0.0, drift_ppm=0.0)
    one, log = recordings["accel_x"], recordings["accel_x_table"]
    same = log.select((log.time_ns >= one.time_ns[0]) & (log.time_ns <= one.time_ns[-1]))
    offset, uncertainty, *_ = clock_errors(align(as_table(one), as_table(same)), one, truth)
    assert abs(offset) < 3.5 * uncertainty


def test_the_log_of_another_recording_is_refused() -> None:
    recordings, _ = beside_a_table(0)
    with pytest.raises(IngestError, match=r"does not show the motion|fits at"):
        align(as_table(recordings["accel_x"]), as_table(recordings["validation_table"]))


def test_a_motion_that_repeats_itself_is_refused() -> None:
    recordings, _ = beside_a_table(0)
    one, log = recordings["gyro_x"], recordings["gyro_x_table"]
    twice = np.concatenate([log.time_ns, log.time_ns + (log.time_ns[-1] - log.time_ns[0]) + 10_000_000])
    angle, rate = log.table_angle, log.table_rate
    assert angle is not None
    assert rate is not None
    again = replace(log, time_ns=twice, table_angle=np.tile(angle, 2), table_rate=np.tile(rate, 2))
    with pytest.raises(IngestError, match="repeats itself"):
        align(as_table(one), as_table(again))


def test_a_sensor_without_a_gyroscope_is_refused() -> None:
    recordings, _ = beside_a_table(0)
    bare = as_table(replace(recordings["accel_x"], gyroscope=None))
    with pytest.raises(IngestError, match="needs a gyroscope"):
        align(bare, as_table(recordings["accel_x_table"]))


def write_topics(path: Path, one: Recording, log: Recording) -> None:
    """Write Imu and JointState messages, each with stamps of its own clock, as they would be recorded together."""
    assert one.accelerometer is not None
    assert one.gyroscope is not None
    assert log.table_angle is not None
    assert log.table_rate is not None
    stamp = lambda t: header(*divmod(int(t) + 10**9, 10**9))  # noqa: E731
    messages = []
    for t, f, w in zip(one.time_ns, one.accelerometer * STANDARD_GRAVITY, np.radians(one.gyroscope), strict=True):
        force, rate = (dict(zip("xyz", map(float, v), strict=True)) for v in (f, w))
        values = imu(0, header=stamp(t), linear_acceleration=force, angular_velocity=rate)
        messages.append((float(t), ("/imu/data", IMU, values)))
    offset = float(log.time_ns[0] - one.time_ns[0])
    for t, a, r in zip(log.time_ns, np.radians(log.table_angle), np.radians(log.table_rate), strict=True):
        state = {"name": ["table"], "position": [float(a)], "velocity": [float(r)], "effort": []}
        messages.append((float(t) - offset, ("/table", JOINT_STATE, {"header": stamp(t), **state})))
    write_ros2(path, *(m for _, m in sorted(messages, key=lambda m: m[0])))


def test_topics_of_another_clock_are_aligned_where_the_profile_says_so(tmp_path: Path) -> None:
    recordings, truth = beside_a_table(3, interval_s=0.04)
    one, log = recordings["gyro_x"], recordings["gyro_x_table"]
    write_topics(tmp_path / "gyro_x.mcap", one, log)
    entry = RecordingFile(file="gyro_x", role="gyroscope", axis="x", optional=False)
    ideal = settings_of()
    procedure, sensor = ideal.procedure.replaced(recordings={"gyro_x": entry}), ideal.sensor
    settings = {"clock_difference_s": None}
    with pytest.raises(InputError, match="table_clock=own"):
        read_recordings(procedure, ingest_of({"mcap": settings}), sensor, tmp_path)
    own = {"mcap": {**settings, "table_clock": "own"}}
    found = read_recordings(procedure, ingest_of(own), sensor, tmp_path)[0]
    assert "joined" not in found.source  # no second file
    offset, uncertainty, *_ = clock_errors(found, one, truth)
    assert abs(offset) < 3.5 * uncertainty
    motion = reference_motion(found)
    assert motion is not None
    assert found.gyroscope is not None
    calibrated = (found.gyroscope - truth["gyroscope"]["bias"]) @ np.array(truth["gyroscope"]["matrix"]).T
    assert float(np.sqrt(np.mean((calibrated - motion.angular_rate)[:, 0] ** 2))) < 0.05
