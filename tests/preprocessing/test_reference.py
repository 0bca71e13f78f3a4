"""Recordings of a unit that contradict each other are refused with the cause, or marked; sound ones are left alone."""

from __future__ import annotations

import itertools
import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from bad_units import SETTINGS, cases, sound
from scipy.spatial.transform import Rotation
from unit_settings import settings_of

from imu_research.study.bench import recordings_of
from imu_research.study.cases import FAMILIES, draw
from pipeline.app.one_unit import unit_row
from pipeline.checks.at_rest import check_axes, check_static
from pipeline.checks.checks import check_recordings
from pipeline.checks.reference import _interval, check_motion
from pipeline.core.errors import IngestError
from pipeline.core.records import Recording
from pipeline.evaluation.diagnosis.diagnose import doubts_of
from pipeline.simulation.campaign import simulate_unit
from pipeline.simulation.description import read_description

if TYPE_CHECKING:
    from pipeline.core.records import Note

CASES = cases()
PAGE = Path(__file__).parents[2] / "docs" / "bad_inputs.md"
NOISY = {f"sensor.{s}.noise_density": 1.0 for s in ("accelerometer", "gyroscope")}  # beyond what is tested


def notes_of(before: list[Recording], after: list[Recording]) -> dict[str, tuple[Note, ...]]:
    return {a.name: a.notes[len(b.notes) :] for b, a in zip(before, after, strict=True) if a.notes != b.notes}


@pytest.mark.parametrize("number", [n for n, c in CASES.items() if c.fault])
def test_a_contradiction_is_refused_by_its_code_with_file_rows_and_cause(number: str) -> None:
    case = CASES[number]
    with pytest.raises(IngestError) as caught:
        check_recordings(case.change(list(sound())), SETTINGS)
    assert caught.value.code == case.fault, caught.value.message
    assert re.search(case.says, caught.value.message), caught.value.message
    assert caught.value.message != caught.value.fact, "no hint"
    if case.file:
        assert caught.value.file == case.file


@pytest.mark.parametrize("number", [n for n, c in CASES.items() if c.note])
def test_what_an_effect_may_explain_is_noted(number: str) -> None:
    case = CASES[number]
    unit = case.change(list(sound()))
    found = notes_of(unit, check_recordings(unit, SETTINGS))
    assert found
    if case.file:
        assert case.file.removesuffix(".csv") in found
    assert all(note.code == case.code and case.note in note.detail for notes in found.values() for note in notes)


@pytest.mark.parametrize("number", CASES)
def test_the_page_tells_the_codes_of_each_bad_unit(number: str) -> None:
    rows = dict(re.findall(r"^\| (\d+) (\|.*)$", PAGE.read_text(), re.MULTILINE))
    assert f"`{CASES[number].fault or CASES[number].code}`" in rows[number.split(maxsplit=1)[0]]


@pytest.mark.parametrize("effects", ["", "gyroscope.time_offset gyroscope.low_pass_lag", "gyroscope.clock_rate"])
def test_sound_units_are_left_alone_whatever_is_hidden_in_them(effects: str) -> None:
    unit = list(sound(6, effects))
    assert not notes_of(unit, check_recordings(unit, SETTINGS))


@pytest.mark.parametrize("name", ["sweep_rates", "sweep_duration", "sweep_sampling", "thermal_ramp"])
def test_slow_short_and_warm_turns_of_the_shipped_campaigns_are_not_refused(name: str) -> None:
    description = read_description(Path(__file__).parents[2] / "data" / name / "simulation.yaml")
    for number, unit in list(enumerate(description.units, 1))[::6]:
        settings = settings_of(SETTINGS, sensor=unit.sensor, table=unit.table)
        recordings, _ = simulate_unit(unit, description.seed, number)
        check_recordings([replace(r, source={"file": r.name}) for r in recordings], settings)


def test_no_family_of_the_blind_study_is_refused_or_noted_but_for_its_coarse_log() -> None:
    coarse = {"coarse": {"N-STEPS"}, "null_sensors": {"N-RESOLUTION"}}  # the ADIS16448 logs steps of 0.04 deg/s
    for family in FAMILIES:
        unit = recordings_of(draw(family, 3, 20))
        notes = notes_of(unit, check_recordings(unit, SETTINGS))
        codes = {note.code for of_one in notes.values() for note in of_one}
        assert codes == coarse.get(family, set()), family


@pytest.mark.parametrize(
    ("times", "codes"), [(1.0, []), (1.5, []), (0.7, []), (3.0, ["N-REFERENCE"]), (0.3, ["N-REFERENCE"])]
)
def test_a_static_recording_louder_or_quieter_than_the_rests_by_hand_is_in_doubt(
    times: float, codes: list[str]
) -> None:
    rng = np.random.default_rng(8)
    turning = np.repeat(np.arange(40) % 2, 100)[:, None] * [30.0, 0.0, 0.0]
    noise = 0.05 * rng.standard_normal((4000, 3))
    by_hand = Recording("recording", "rests", None, np.arange(4000) * 10**7, gyroscope=turning + noise)
    own = times * 0.05 * rng.standard_normal((3000, 3))
    static = Recording("static", "static", None, (5000 + np.arange(3000)) * 10**7, gyroscope=own)
    found = check_static([by_hand, static], settings_of(**NOISY, **{"sensor.gyroscope.bias_wander": 0.01}))[1]
    assert [n.code for n in found.notes] == codes


@pytest.mark.parametrize(("number", "doubts"), [(1, 0), (0, 2), (3, 1)])
def test_a_static_recording_of_another_unit_is_in_doubt(number: int, doubts: int) -> None:
    """Case 0 is of a STIM300, which is quieter; case 3 of another MPU-6050, whose gyroscope has another bias."""
    own, other = (recordings_of(draw("null_normal", n, 31)) for n in (1, number))
    static = next(r for r in other if r.role == "static")
    checked = check_static([static if r.role == "static" else r for r in own], unit_row(["sensor=mpu6050"]).config)
    assert len(doubts_of("accelerometer", checked)) == doubts


def test_of_a_static_recording_that_tilts_slowly_only_what_rests_is_used() -> None:
    """No second of it is louder than another: 0.05 deg/s turns gravity by 0.9 mg in one, and by 87 mg in the end."""
    time = 0.1 * np.arange(3000)
    tilt = np.radians(0.05 * np.clip(time - 200.0, 0.0, None))
    force = np.column_stack([np.sin(tilt), np.zeros(3000), np.cos(tilt)])
    force += 2e-3 * np.random.default_rng(4).standard_normal(force.shape)
    static = Recording("static", "static", None, (time * 1e9).astype(np.int64), force)
    (found,) = check_static(
        [static], settings_of(**{"sensor.accelerometer.bias_wander": 1e-4, "sensor.accelerometer.noise_density": 9e-4})
    )
    assert [note.code for note in found.notes] == ["N-MOVED"]
    assert found.time[0] == 0.0
    assert 190.0 < found.time[-1] < 220.0  # 12 mg, six standard deviations, are reached after 14 s


def test_gravity_that_was_left_at_1_g_is_noted_with_that_of_the_latitude() -> None:
    placed = settings_of(SETTINGS, **{"table.latitude_deg": 52.2946, "table.azimuth_deg": 0.0})
    details = [n.detail for r in check_recordings(list(sound()), placed) for n in r.notes if n.code == "N-GRAVITY"]
    (stated,) = (float(g) for g in re.findall(r"table.gravity_g=([\d.]+)", *details))
    assert stated == pytest.approx(9.81252 / 9.80665, abs=5e-5)  # PTB Braunschweig, 80 m above the sea
    here = settings_of(placed, **{"table.gravity_g": stated})
    assert not [n for r in check_recordings(list(sound()), here) for n in r.notes if n.code == "N-GRAVITY"]


def test_the_azimuth_of_a_shaft_is_told_as_that_of_each_body_axis_on_a_left_handed_encoder() -> None:
    turned = [
        r if r.axis is None else replace(r, table_angle=-r.table_angle, table_rate=-r.table_rate) for r in sound()
    ]
    place = {"latitude_deg": 52.0, "azimuth_deg": 352.0, "azimuth_of": "turn_axis", "gravity_g": 1.0007, "sense": -1}
    checked = check_recordings(turned, settings_of(SETTINGS, **{f"table.{k}": v for k, v in place.items()}))
    (note,) = (n for r in checked for n in r.notes if n.code == "N-AZIMUTH")
    assert "body x to 172 deg in accel_x, body y to 172 deg in accel_y" in note.detail


def test_a_turn_about_another_axis_is_not_told_as_a_wrong_unit_of_the_angle() -> None:
    pause = [np.zeros(75)]
    turns = [part for rate in (60.0, -60.0, 120.0, -120.0) for part in (np.full(150, rate), *pause)]
    rate = np.concatenate([np.zeros(500), *turns])
    angle, generator = np.cumsum(rate) / 25.0, np.random.default_rng(1)
    a, bias = np.radians(angle), np.full(len(rate), 0.5)
    force = np.column_stack([0.03 - np.sin(a), np.full(len(a), 0.02), 0.05 + np.cos(a)])
    recording = Recording(
        "gyro_x",
        "gyroscope",
        "x",
        40_000_000 * np.arange(len(a)),
        accelerometer=force + 5e-4 * generator.standard_normal((len(a), 3)),
        gyroscope=np.column_stack([bias, rate - 0.8, bias]) + 0.02 * generator.standard_normal((len(a), 3)),
        table_angle=angle,
        source={"file": "gyro_x.csv"},
    )
    (found,) = check_recordings([recording], settings_of(SETTINGS, **{"table.seat_deg": 2.0}))
    assert found.axis == "y"
    assert [n.code for n in found.notes] == ["N-FOUND"]


@pytest.mark.parametrize(
    ("axis", "kind"), [*itertools.product(range(3), ["body to level", "level to body"]), (1, "scalar last")]
)
def test_the_attitude_of_a_turn_is_compared_with_the_gyroscope(axis: int, kind: str) -> None:
    along = np.eye(3)[axis]
    rate = np.concatenate([np.zeros(200), np.full(400, 45.0), np.zeros(100), np.full(200, -90.0), np.zeros(100)])
    angle, rng = np.cumsum(rate) / 50.0, np.random.default_rng(axis)
    start = Rotation.from_rotvec([0.3, -1.1, 0.7])  # of the body at angle 0 against level
    rotation = start * Rotation.from_rotvec(np.radians(angle)[:, None] * along)
    down = -rotation.inv().apply([0.0, 0.0, 1.0])
    q = (rotation.inv() if kind == "level to body" else rotation).as_quat(scalar_first=kind != "scalar last")
    gyroscope = np.outer(rate, along) + [1.0, -2.0, 0.5] + 0.05 * rng.standard_normal((len(rate), 3))
    source, ns = {"file": "turn.csv"}, 20_000_000 * np.arange(len(rate))
    name = "gyro_" + "xyz"[axis]
    turn = Recording(name, "gyroscope", "xyz"[axis], ns, -down, gyroscope, table_attitude=q, source=source)
    if kind == "body to level":
        assert not check_motion([turn], {}, SETTINGS)[0].notes
        return
    with pytest.raises(IngestError, match="other body axes") as caught:
        check_motion([turn], {}, SETTINGS)
    assert caught.value.code == "reference_contradiction"


def test_a_delay_without_any_residual_excludes_all_others() -> None:
    squares = 1e6 * np.abs(np.arange(21.0) - 10.0)
    assert _interval(squares, 0.0, 20) == (10.0, 10.0, 10.0)


def rounded_rest(seed: int, samples: int, noise: float) -> Recording:
    """Return a rest in steps of 0.01 g with all axes level or nearly so, and noise in parts of a step."""
    rng = np.random.default_rng(seed)
    force = 0.01 * np.round(rng.uniform(-1.0, 1.0, 3) + noise * rng.standard_normal((samples, 3)))
    return Recording("rests", "rests", None, np.arange(samples) * 10_000_000, accelerometer=force)


@pytest.mark.parametrize("noise", [0.2, 0.3])
def test_a_log_of_few_digits_is_not_taken_for_a_copied_axis(noise: float) -> None:
    alike = []
    for seed in range(100):
        recording = rounded_rest(seed, 100 + 20 * seed, noise)
        x, y, _ = np.asarray(recording.accelerometer).T
        alike.append(np.mean((x == y)[1:][np.diff(x) != 0.0]))
        check_axes([recording])
    assert np.max(alike) > 0.5  # of the rows in which the first axis changes


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_copied_axis_is_refused_in_a_log_of_few_digits(sign: float) -> None:
    for seed in range(20):
        recording = rounded_rest(seed, 400, 0.5)
        force = np.array(recording.accelerometer)
        force[100:, 2] = sign * force[100:, 1]  # the first quarter is not copied
        with pytest.raises(IngestError, match=r"accel_z is (a copy|the negative) of accel_y") as refused:
            check_axes([replace(recording, accelerometer=force)])
        assert refused.value.code == "copied_axis"


def test_a_step_that_hides_the_noise_is_noted_with_its_digits() -> None:
    def rounded(recording: Recording) -> Recording:
        rate = np.array(recording.gyroscope)
        rate[:, :2] = 0.5 * np.round(rate[:, :2] / 0.5)
        return replace(recording, gyroscope=rate)

    notes = [n for r in check_recordings([rounded(r) for r in sound()], SETTINGS) for n in r.notes]
    (detail,) = [n.detail for n in notes if n.code == "N-RESOLUTION"]
    assert detail.startswith("gyro_x, gyro_y: steps of 0.5 deg/s, 1 decimal, and noise of less than half a step")
    assert "off by up to 0.25 deg/s" in detail
    assert not [n for r in check_recordings(list(sound()), SETTINGS) for n in r.notes if n.code == "N-RESOLUTION"]
