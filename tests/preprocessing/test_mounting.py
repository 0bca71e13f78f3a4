"""The mounting of each turn is found, refused where it is otherwise than stated, and applied where it is stated."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
import unit_settings
from benches import BIAS, INTERVAL_S, RATE, Setup, entry_of, recordings_of, settings_of, stating
from benches import K as TRUE_K
from scipy.spatial.transform import Rotation

from pipeline.checks.checks import check_recordings
from pipeline.checks.mounting import check_mounting, words
from pipeline.core.errors import IngestError
from pipeline.core.records import Recording
from pipeline.estimation.reference_least_squares import fit
from pipeline.estimation.stages import StageInput
from pipeline.physics.kinematics import reference_motion

LEVEL = [
    (a, s + u) for a in "xyz" for u in "xyz" for s in "+-" if u != a
]  # 12 faces; with both senses, 24 orientations
SHEET = {"noise_density": 4e-4, "bias_wander": 1e-4, "wander_time_s": 100.0}
ZEROS = (0.0, 37.0, -151.0)


@pytest.mark.parametrize(("axis", "up"), LEVEL)
def test_every_stated_orientation_sense_and_zero_gives_the_true_sensor(axis: str, up: str) -> None:
    for sense, zero in product((1, -1), ZEROS):
        setups = {axis: Setup(axis, up, sense, zero)}
        recordings = recordings_of(setups)
        checked = check_mounting(recordings, settings_of(recordings, setups))
        for sensor, sigma in (("accelerometer", 8e-4), ("gyroscope", 0.01)):
            own = [r for r in checked if r.role == sensor]
            truth, reading = (np.concatenate(rows) for rows in zip(*[_pair(r, sensor) for r in own], strict=True))
            design = np.column_stack([np.ones(len(truth)), truth])
            found = np.linalg.lstsq(design, reading, rcond=None)[0]
            error = found - np.vstack([BIAS[sensor], TRUE_K[sensor].T])
            standard = sigma * np.sqrt(np.diag(np.linalg.inv(design.T @ design)))[:, None]
            assert np.all(np.abs(error) < 5.0 * standard)


def test_where_turns_have_mountings_a_sense_that_is_found_leaves_the_stated_zero() -> None:
    setups = {"y": Setup("y", sense=-1, seat=(0.4, 1.6, -0.5))}
    recordings = recordings_of(setups)
    checked = check_mounting(recordings, settings_of(recordings, seat_deg=2.0))
    for before, after in zip(recordings, checked, strict=True):
        assert before.table_angle is not None
        assert np.array_equal(after.table_angle, (-1.0 if before.axis == "y" else 1.0) * before.table_angle)


def _pair(recording: Recording, sensor: str) -> tuple[np.ndarray, np.ndarray]:
    motion = reference_motion(recording)
    reading = recording.reading(sensor)
    assert motion is not None
    assert reading is not None
    return (motion.specific_force if sensor == "accelerometer" else motion.angular_rate), reading


def test_a_stated_bench_calibrates_within_the_expanded_uncertainty() -> None:
    setups = {"x": Setup("x", "-y", -1, 37.0), "y": Setup("y", "+x", 1, -151.0), "z": Setup("z", "-y", -1, 12.5)}
    sensors = {"accelerometer": SHEET, "gyroscope": SHEET | {"noise_density": 5e-3, "bias_wander": 3e-3}}
    settings = unit_settings.settings_of(sensor=sensors)
    outside = 0
    for seed in range(10):
        recordings = recordings_of(setups, seed)
        checked = check_mounting(recordings, settings_of(recordings, setups))
        for sensor in ("accelerometer", "gyroscope"):
            found = fit(StageInput(sensor, unit_settings.with_noise(checked, settings), None, settings))
            error = found.matrix - np.linalg.inv(TRUE_K[sensor])
            expanded = np.array(found.to_json()["expanded_uncertainty"]["matrix"])
            outside += int(np.sum(np.abs(error) > expanded))
    assert outside <= 18  # of 180, each with probability 0.05: 18 or fewer with 0.998


@pytest.mark.parametrize(("axis", "up"), LEVEL)
def test_what_is_found_is_used_with_a_note_that_names_the_setting_which_describes_it(axis: str, up: str) -> None:
    for sense, zero in product((1, -1), (0.0, 37.0)):
        setup = Setup(axis, up, sense, zero)
        recordings = recordings_of({axis: setup})
        if (sense, zero) == (1, 0.0) and up == {"x": "+z", "y": "+z", "z": "+x"}[axis]:
            assert not [n for r in check_mounting(recordings, settings_of(recordings)) for n in r.notes]
            continue
        found = check_mounting(recordings, settings_of(recordings))
        notes = {r.name: n.detail for r in found for n in r.notes if n.code == "N-FOUND"}
        assert set(notes) == {f"accel_{axis}", f"gyro_{axis}"}
        entries = {r.name: entry_of(r.axis or "x") for r in recordings}
        for setting in notes[f"accel_{axis}"].split("set ")[1].split(" (")[0].split(", "):
            if setting.startswith("procedure."):
                name, key, value = setting.removeprefix("procedure.recordings.").replace("=", ".", 1).split(".", 2)
                entries[name] = entries[name].replaced(
                    **{key: value if key == "up" else int(value) if key == "sense" else float(value)}
                )
        checked = check_mounting(recordings, stating(entries))
        for before, stated, used in zip(recordings_of({}), checked, found, strict=True):
            right = reference_motion(setup_free(before, setup, recordings))
            assert right is not None
            for after in (stated, used):
                motion = reference_motion(after)
                assert motion is not None
                assert np.max(np.abs(motion.specific_force - right.specific_force)) < np.radians(0.1)


def setup_free(recording: Recording, setup: Setup, logged: list[Recording]) -> Recording:
    """Return the recording with the angle of the convention by the exact settings."""
    if recording.axis != setup.axis:
        return recording
    own = next(r for r in logged if r.name == recording.name)
    return check_mounting([own], settings_of([own], {own.axis or "": setup}))[0]


def test_the_table_states_sense_and_zero_for_all_recordings() -> None:
    setups = {a: Setup(a, sense=-1, zero=20.0) for a in "xyz"}
    recordings = recordings_of(setups)
    found = check_recordings(recordings, settings_of(recordings))
    assert all("set table.sense=-1, table.zero_deg=20.0" in r.notes[0].detail for r in found)
    checked = check_recordings(recordings, settings_of(recordings, sense=-1, zero_deg=20.0))
    assert {n.code for r in checked for n in r.notes} == {"N-MOUNTING"}
    for usual, stated, used in zip(recordings_of({}), checked, found, strict=True):
        assert np.allclose(usual.table_angle, stated.table_angle)
        assert np.allclose(usual.table_angle, used.table_angle, atol=0.1)
        assert np.allclose(usual.table_rate, stated.table_rate)
        assert np.allclose(usual.table_rate, used.table_rate)


def test_another_turn_axis_is_used_where_gravity_shows_it_and_else_refused() -> None:
    recordings = recordings_of({})
    exchanged = [replace(r, axis={"x": "y", "y": "x"}.get(str(r.axis), r.axis)) for r in recordings]
    found = check_mounting(exchanged, settings_of(exchanged))
    assert [r.axis for r in found] == [r.axis for r in recordings]
    fast = [r for r in exchanged if r.role == "gyroscope"]
    assert [r.axis for r in check_recordings(fast, settings_of(fast))] == ["x", "y", "z"]
    said = next(n.detail for r in found for n in r.notes if r.name == "accel_x" and n.code == "N-FOUND")
    assert "said to turn about y, and gravity turns about x" in said
    assert "accel_x.axis=x" in said
    assert "sense" not in said
    left_handed = recordings_of({"x": Setup("x", sense=-1)})
    exchanged = [replace(r, axis={"x": "y", "y": "x"}.get(str(r.axis), r.axis)) for r in left_handed]
    found = check_mounting(exchanged, settings_of(exchanged))
    said = next(n.detail for r in found for n in r.notes if r.name == "accel_x" and n.code == "N-FOUND")
    assert "accel_x.axis=x, procedure.recordings.accel_x.sense=-1" in said
    blind = [replace(r, accelerometer=None) for r in exchanged if r.role == "gyroscope"]
    with pytest.raises(IngestError, match="said to turn about y, and the gyroscope turns about x") as caught:
        check_mounting(blind, settings_of(blind))
    assert caught.value.code == "wrong_axis"


def test_a_unit_turned_as_a_whole_is_told_the_axis_map_that_may_be_right() -> None:
    recordings = [_mapped(r, [[0, -1, 0], [1, 0, 0], [0, 0, 1]]) for r in recordings_of({})]
    found = check_mounting(recordings, settings_of(recordings))
    assert any("or sensor.axis_map=[-y,+x,+z]" in n.detail for r in found for n in r.notes)


@pytest.mark.parametrize("turned", [[[0, -1, 0], [1, 0, 0], [0, 0, 1]], [[0, 0, 1], [1, 0, 0], [0, 1, 0]]])
def test_held_out_attitudes_are_turned_to_the_axes_of_a_unit_that_is_turned_as_a_whole(turned: Any) -> None:
    turns = [_mapped(r, turned) for r in recordings_of({})]
    time = np.arange(400) * INTERVAL_S
    angles = np.column_stack([80.0 * np.sin(0.4 * time), 60.0 * np.sin(0.3 * time + 1.0), 90.0 * np.sin(0.21 * time)])
    attitude = Rotation.from_euler("xyz", angles, degrees=True)  # of the axes as stated
    force = attitude.inv().apply([0.0, 0.0, 1.0]) @ np.array(turned, float).T
    held_out = Recording(
        "validation", "validation", None, (time * 1e9).astype(np.int64), force,
        table_attitude=attitude.as_quat(scalar_first=True),
    )  # fmt: skip
    *_, found = check_mounting([*turns, held_out], settings_of(turns))
    assert found.table_attitude is not None
    up = Rotation.from_quat(found.table_attitude, scalar_first=True).inv().apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(up, force, atol=1e-9)


@pytest.mark.parametrize("sense", [1, -1])
def test_a_unit_turned_over_is_used_and_a_negated_accelerometer_is_refused(sense: int) -> None:
    turns = [r for r in recordings_of({a: Setup(a, sense=sense) for a in "xyz"}) if r.role == "accelerometer"]
    over = [_mapped(r, np.diag([-1.0, 1.0, -1.0])) for r in turns]  # by half a turn about y: each face is the opposite
    right = recordings_of({})
    for used, by_convention in zip(check_mounting(over, settings_of(over)), right, strict=False):
        motion, usual = reference_motion(used), reference_motion(by_convention)
        assert motion is not None
        assert usual is not None
        turned = usual.specific_force @ np.diag([-1.0, 1.0, -1.0])
        assert np.max(np.abs(motion.specific_force - turned)) < np.radians(0.1)
    negated = [replace(_mapped(r, -np.eye(3)), gyroscope=None) for r in turns]
    with pytest.raises(IngestError, match="is mounted otherwise than stated"):
        check_mounting(negated, settings_of(negated))


def _mapped(recording: Recording, accelerometer: Any, gyroscope: Any = None) -> Recording:
    """Return a recording as a sensor reads it whose axes are turned or mirrored by a signed permutation."""
    maps = np.array(accelerometer, float), np.array(accelerometer if gyroscope is None else gyroscope, float)
    force, rate = recording.accelerometer, recording.gyroscope
    assert force is not None
    assert rate is not None
    return replace(recording, accelerometer=force @ maps[0].T, gyroscope=rate @ maps[1].T)


@pytest.mark.parametrize(
    ("lean_deg", "cross_axis", "refused"), [(6.0, 0.02, False), (7.5, 0.02, True), (7.5, 0.1, False)]
)
def test_a_turn_axis_may_lean_by_the_tolerance_and_what_the_sensor_file_states(
    lean_deg: float, cross_axis: float, *, refused: bool
) -> None:
    turned = Rotation.from_euler("x", lean_deg, degrees=True).as_matrix()
    recordings = [_mapped(r, turned) for r in recordings_of({})]
    settings = unit_settings.settings_of(settings_of(recordings), sensor={"accelerometer": {"cross_axis": cross_axis}})
    if refused:  # 5 deg, and 1.6 deg of two cross-axis sensitivities of 2 %
        with pytest.raises(IngestError, match=r"deg off body y; 6.62 deg are allowed"):
            check_mounting(recordings, settings)
    else:
        check_mounting(recordings, settings)


STRAIGHT, MIRROR_Z, REFLECTION = np.eye(3), np.diag([1.0, 1.0, -1.0]), -np.eye(3)


@pytest.mark.parametrize(
    ("accelerometer", "gyroscope", "says"),
    [
        (MIRROR_Z, STRAIGHT, r"the accelerometer is mirrored: set sensor\.accelerometer\.axis_map=\[\+x,\+y,-z\]"),
        (STRAIGHT, MIRROR_Z, r"the gyroscope is mirrored: set sensor\.gyroscope\.axis_map=\[\+x,\+y,-z\]"),
        (STRAIGHT, REFLECTION, r"the gyroscope is mirrored: set sensor\.gyroscope\.axis_map=\[-x,-y,-z\]"),
        (MIRROR_Z, MIRROR_Z, r"both sensors are mirrored: set sensor\.axis_map=\[\+x,\+y,-z\]"),
        (REFLECTION, REFLECTION, r"both sensors are mirrored: set sensor\.axis_map=\[-x,-y,-z\]"),
        (STRAIGHT, np.diag([-1.0, -1.0, 1.0]), r"read in other axes: set sensor\.gyroscope\.axis_map=\[-x,-y,\+z\]"),
        (REFLECTION, STRAIGHT, r"sensor\.accelerometer\.axis_map=\[-x,-y,-z\]"),
    ],
)
def test_frames_that_contradict_each_other_are_refused_with_the_map_that_is_right(
    accelerometer: np.ndarray, gyroscope: np.ndarray, says: str
) -> None:
    recordings = [_mapped(r, accelerometer, gyroscope) for r in recordings_of({})]
    with pytest.raises(IngestError, match=says):
        check_mounting(recordings, settings_of(recordings))


def test_by_hand_gravity_and_the_gyroscope_belong_in_one_frame() -> None:
    recording = _by_hand()
    assert check_mounting([recording], unit_settings.settings_of()) == [recording]
    assert check_mounting(
        [_mapped(recording, -np.eye(3), np.eye(3))], unit_settings.settings_of()
    )  # gravity's opposite turns alike
    with pytest.raises(IngestError, match=r"gyroscope is mirrored: .*sensor\.gyroscope\.axis_map=\[\+x,\+y,-z\]"):
        check_mounting([_mapped(recording, np.eye(3), MIRROR_Z)], unit_settings.settings_of())
    exchanged = np.eye(3)[[1, 0, 2]]
    with pytest.raises(IngestError, match=r"agrees with sensor\.accelerometer\.axis_map=\[\+y,\+x,\+z\] or "):
        check_mounting([_mapped(recording, exchanged, np.eye(3))], unit_settings.settings_of())
    with pytest.raises(IngestError, match=r"contradict each other: in \d+ of 1\d moves"):
        check_mounting([_mapped(recording, -np.eye(3))], unit_settings.settings_of())


def _by_hand() -> Recording:
    """Return rests between moves of 75 deg about random axes."""
    rng = np.random.default_rng(3)
    axes = rng.standard_normal((12, 3))
    rest, move = np.zeros((100, 3)), np.ones((50, 1))
    turns = [75.0 * move * a / np.linalg.norm(a) for a in axes]
    rate = np.concatenate([rest, *[part for turn in turns for part in (turn, rest)]])
    attitude, force = Rotation.identity(), []
    for w in rate:
        attitude *= Rotation.from_rotvec(np.radians(w) * 0.02)
        force.append(attitude.inv().apply([0.0, 0.0, 1.0]))
    time = (np.arange(len(rate)) * 20_000_000).astype(np.int64)
    noisy = np.array(force) + 1e-3 * rng.standard_normal(rate.shape)
    return Recording("recording", "rests", None, time, noisy, rate + 0.05 * rng.standard_normal(rate.shape))


def test_a_vertical_turn_axis_is_stated_or_refused() -> None:
    upright = {a: Setup(a, f"{s}{a}") for a, s in zip("xyz", "+-+", strict=True)}
    level = recordings_of({})[:3]
    recordings = level + recordings_of(upright)[3:]
    with pytest.raises(IngestError, match=r"gravity stays along body \+x .*gyro_x\.up=\+x, .*gyro_y\.up=-y"):
        check_mounting(recordings, settings_of(recordings))
    entries = {r.name: entry_of(r.axis or "x") for r in recordings}
    entries |= {
        r.name: entries[r.name].replaced(up=upright[str(r.axis)].up) for r in recordings if r.role == "gyroscope"
    }
    checked = check_mounting(recordings, stating(entries))
    for recording in checked[3:]:
        force, reading = _pair(recording, "accelerometer")
        assert np.max(np.abs(reading - BIAS["accelerometer"] - force @ TRUE_K["accelerometer"].T)) < 5 * 8e-4
    with pytest.raises(IngestError, match="about a vertical axis gravity does not turn"):
        check_mounting(recordings_of(upright)[:1], stating({"accel_x": entry_of("x").replaced(up="+x")}))


@pytest.mark.parametrize("up", ["+x", ""])
@pytest.mark.parametrize("sense", [1, -1])
def test_where_gravity_does_not_turn_the_gyroscope_tells_the_sense(up: str, sense: int) -> None:
    recording = Setup("x", up, sense).recording("gyroscope")
    if not up:
        recording = replace(recording, accelerometer=None)
    (checked,) = check_mounting([recording], stating({"gyro_x": entry_of("x").replaced(up=up, sense=sense)}))
    assert checked.table_rate == pytest.approx(RATE)
    with pytest.raises(IngestError, match=f"gyro_x.sense={sense}") as caught:
        check_mounting([recording], stating({"gyro_x": entry_of("x").replaced(up=up, sense=-sense)}))
    assert caught.value.code == "wrong_sense"


def test_what_a_short_arc_does_not_tell_is_said_and_not_guessed() -> None:
    recording = Setup("x", "+z").recording("accelerometer")
    assert recording.table_angle is not None
    short = recording.select(recording.table_angle < 40.0)
    note = check_mounting([short], settings_of([short]))[0].notes[0]
    assert note.code == "N-MOUNTING"
    assert "taken as stated: the table angle covers 30 deg only" in note.detail


@pytest.mark.parametrize("rate_dps", [0.5, 1.0, 2.0, 5.0])
def test_a_slow_turn_is_followed_although_the_bias_is_as_large_as_its_rate(rate_dps: float) -> None:
    rests = np.zeros(25)  # 3 s
    rate = np.concatenate([rests, np.full(round(360.0 / rate_dps / INTERVAL_S), rate_dps), rests])
    bias = (-1.292, -1.973, -0.348)  # deg/s, MPU6050 (2) of Sudsanguan 2019, table 5.16
    noise = 0.01 * np.random.default_rng(7).standard_normal((len(rate), 3))
    reading = bias + np.outer(rate, TRUE_K["gyroscope"][:, 1]) + noise
    time = (np.arange(len(rate)) * 120_000_000).astype(np.int64)
    recording = Recording("gyro_y", "gyroscope", "y", time, gyroscope=reading, table_rate=rate)
    assert check_mounting([recording], unit_settings.settings_of())
    if rate_dps > 1.0:
        with pytest.raises(IngestError, match="said to turn about z, and the gyroscope turns about y"):
            check_mounting([replace(recording, axis="z")], unit_settings.settings_of())


def test_a_bench_is_told_in_words() -> None:
    from pipeline.checks.bench import TurnMounting  # noqa: PLC0415

    assert words(TurnMounting("x", "-y", -1, 37.04)) == (
        "body -y up at a table angle of 37.0 deg, the angle counted left-handed about x"
    )
