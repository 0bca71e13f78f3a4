"""Each of the 48 bad files is refused with its facts, or repaired with a note; see docs/bad_inputs.md."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from bad_logs import FILE, RATE, TABLE_ANGLE, VALUES, Case, cases, table
from sample_logs import SENSOR, procedure
from stage_files import load_recordings, save_recordings
from unit_settings import ingest_of, settings_of

from imu_logs import text_lines as text_log
from imu_logs.text_layout import TextLayout
from pipeline.app.config.compose import check_ingest
from pipeline.app.steps.gather import same_files
from pipeline.checks.checks import check_recordings
from pipeline.core.errors import ConfigurationError, InputError, MissingInputError
from pipeline.ingest.read import read_recordings
from pipeline.output.pages.campaign_page import render
from pipeline.physics.statements import left_out

if TYPE_CHECKING:
    from pipeline.core.records import Recording

CASES = cases()
OF_LINES = ("05", "07", "08", "09", "10", "12", "13", "15", "17", "24", "25", "34", "35")
PAGE = Path(__file__).parents[2] / "docs" / "bad_inputs.md"


@pytest.mark.parametrize("number", CASES)
def test_the_page_tells_the_codes_of_each_bad_input(number: str) -> None:
    rows = dict(re.findall(r"^\| (\d+) (\|.*)$", PAGE.read_text(), re.MULTILINE))
    assert list(rows) == [str(i + 1) for i in range(len(rows))]
    told = rows[number.split(maxsplit=1)[0].lstrip("0")]
    told += rows["10"] if "as 10" in told else ""
    case = CASES[number]
    codes = {case.fault} if case.fault else set(case.notes) - {"N-IGNORED"}  # of row 19: a column that is not used
    assert codes <= set(re.findall(r"`([\w-]+)`", told))


def write(folder: Path, case: Case, number: str) -> None:
    if number == "01":
        (folder / FILE).mkdir()
    for name, content in case.files.items():
        (folder / name).write_bytes(content)


def read(folder: Path, case: Case) -> Recording:
    names = [Path(f).stem for f in case.files if f != "table.csv"] or ["log"]
    check_ingest(ingest_of(case.ingest()))
    settings = settings_of(procedure=procedure(*names), ingest=ingest_of(case.ingest()), sensor=SENSOR)
    return check_recordings(read_recordings(settings.procedure, settings.ingest, SENSOR, folder), settings)[0]


@pytest.mark.parametrize("number", [n for n, c in CASES.items() if c.fault])
def test_bad_input_is_refused_by_its_code_with_its_facts(
    tmp_path: Path, number: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    case = CASES[number]
    write(tmp_path, case, number)
    if number == "43":
        _write_while_it_is_read(monkeypatch, tmp_path / FILE)
    with pytest.raises((InputError, ConfigurationError)) as caught:
        read(tmp_path, case)
    assert caught.value.code == case.fault
    assert re.search(case.says, caught.value.message), caught.value.message
    if case.line:
        assert caught.value.file == f"{tmp_path / FILE}:{case.line}"


def _write_while_it_is_read(monkeypatch: pytest.MonkeyPatch, file: Path) -> None:
    parse = TextLayout.parse

    def parse_and_write(*arguments: Any) -> Any:
        with file.open("ab") as stream:
            stream.write(b"30.0,0,0,1,0,0,0\n")
        return parse(*arguments)

    monkeypatch.setattr(TextLayout, "parse", parse_and_write)


@pytest.mark.parametrize("number", [n for n, c in CASES.items() if not c.fault])
def test_bad_input_is_repaired_with_a_note_that_travels(tmp_path: Path, number: str) -> None:
    case = CASES[number]
    write(tmp_path, case, number)
    found = read(tmp_path, case)
    assert [n.code for n in found.notes] == list(case.notes)
    save_recordings(tmp_path / "unit.parquet", [found])
    assert load_recordings(tmp_path / "unit.parquet")[0].notes == found.notes
    if case.kept is not None:
        assert found.accelerometer is not None
        assert found.gyroscope is not None
        np.testing.assert_array_equal(found.accelerometer, VALUES[case.kept, 1:4])
        np.testing.assert_array_equal(found.gyroscope, VALUES[case.kept, 4:7])
        if not number.startswith("37"):
            steps = np.diff(found.time_ns)
            np.testing.assert_array_equal(steps, np.diff(np.rint(VALUES[case.kept, 0] * 100)) * 10_000_000)
    for row, bit in case.flags.items():
        assert found.flags is not None
        assert found.flags[row] & bit, (row, bit)


@pytest.mark.parametrize("number", [n for n in CASES if n[:2] in OF_LINES])
def test_the_size_of_the_blocks_changes_nothing(tmp_path: Path, number: str, monkeypatch: pytest.MonkeyPatch) -> None:
    case = CASES[number]
    write(tmp_path, case, number)
    results = []
    for size in (1 << 20, 20_011):
        monkeypatch.setattr(text_log, "BLOCK_BYTES", size)
        try:
            found = read(tmp_path, case)
            results.append((found.notes, found.time_ns.tolist(), str(found.accelerometer), str(found.gyroscope)))
        except (InputError, ConfigurationError) as error:
            results.append((error.code, error.message, error.file))
    assert results[0] == results[1]


def test_notes_on_rows_name_their_lines_and_times(tmp_path: Path) -> None:
    case = CASES["34"]
    write(tmp_path, case, "34")
    (note,) = read(tmp_path, case).notes
    assert (note.count, note.first, note.last, note.start_s, note.end_s) == (2, 702, 703, 7.0, 7.01)


def test_channels_that_stand_still_together_have_one_note_for_each_stretch(tmp_path: Path) -> None:
    values = VALUES.copy()
    values[1400:1500, 1:] = values[1400, 1:]  # the table turns a quarter meanwhile
    values[1398:1400, 4], values[1500:1503, 6] = values[1400, [4, 6]]  # neighbours that are equal by chance
    values[2600:2700, 5] = values[2600, 5]
    temperature = 25.0 + np.round(0.05 * np.random.default_rng(3).standard_normal(len(values)), 2)
    temperature[1400:1500] = temperature[1400]
    logged = {"table_angle_deg": TABLE_ANGLE, "table_rate_dps": RATE, "temperature_degc": temperature}
    case = Case({FILE: table(values, **logged)})
    write(tmp_path, case, "38")
    both, one = read(tmp_path, case).notes
    assert [(n.code, n.count, n.first, n.last) for n in (both, one)] == [
        ("N-STUCK", 100, 1402, 1501),
        ("N-STUCK", 100, 2602, 2701),
    ]
    assert both.detail.startswith("accel_x, accel_y, accel_z, gyro_x, gyro_y, gyro_z stay at one value")
    assert "for 0.99 s while the table turns by 89.1 deg, and the temperature with them" in both.detail
    assert "temperature" not in one.detail
    assert one.detail.startswith(f"gyro_y stays at {values[2600, 5]:.6g} deg/s")
    entry = {"recording": "x", "rows": 3000, "rate_hz": 100.0, "notes": [vars(both), vars(one)]}
    assert left_out([entry]) == ["200 of 3,000 rows of x (2 s stuck)"]


def test_offset_and_drift_of_a_tables_own_clock_are_found_within_their_uncertainty(tmp_path: Path) -> None:
    case = CASES["41"]
    write(tmp_path, case, "41")
    found = read(tmp_path, case)
    clock = found.source["table_clock"]
    assert abs(clock["offset_s"] - 5.25) < 3 * clock["offset_uncertainty_s"] < 0.01
    assert abs(clock["drift_ppm"] - 40.0) < 3 * clock["drift_uncertainty_ppm"]
    assert found.table_angle is not None
    assert np.abs(found.table_angle - TABLE_ANGLE).max() < 0.5


def test_the_same_recording_in_two_units_is_noted_on_the_page_of_the_campaign() -> None:
    recordings = {unit: {f"raw/{unit}/log.csv": "s"} for unit in ("U1", "U2")}
    recordings["U3"] = {"raw/U1/log.csv": "s", "raw/U3/a.csv": "t"}
    twins = same_files(recordings)
    assert twins == [(["U1", "U2"], [["raw/U1/log.csv", "raw/U2/log.csv"]])]
    page = render("campaign", [], [], twins=twins)
    assert "raw/U1/log.csv and raw/U2/log.csv" in page


def test_a_missing_file_is_an_error_of_its_own(tmp_path: Path) -> None:
    with pytest.raises(MissingInputError):
        read(tmp_path, CASES["01 missing"])


def test_all_numbers_of_the_table_have_a_case() -> None:
    """Number 42 is a model's matter: without a temperature that varies its effects are not observable."""
    assert {n[:2] for n in CASES} | {"42"} == {f"{i:02d}" for i in range(1, 49)}
