"""``python -m pipeline check``: files in, what ingest makes of them out."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from pipeline.__main__ import main
from pipeline.app.recording_facts import facts
from pipeline.core.records import Recording
from pipeline.ingest.arrow import write_recording
from pipeline.simulation.campaign import write_campaign
from pipeline.simulation.description import description_from

REPOSITORY = Path(__file__).parents[2]
REFERENCE = REPOSITORY.parent / "shared" / "data"
DEMO = REPOSITORY / "data" / "demo" / "raw"


def make_log(samples: int = 1000) -> Recording:
    generator = np.random.default_rng(4)
    force = np.array([0.0, 0.0, 1.0]) + 1e-3 * generator.standard_normal((samples, 3))
    rate = 0.1 * generator.standard_normal((samples, 3))
    return Recording("log", "rests", None, 10_000_000 * np.arange(samples), accelerometer=force, gyroscope=rate)


@pytest.fixture
def log(tmp_path: Path) -> Path:
    write_recording(tmp_path / "log.csv", make_log())
    return tmp_path / "log.csv"


class Checked:
    """What a call of the command gave back and printed."""

    def __init__(self, capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> None:
        self.code = main(["check", *map(str, arguments)])
        captured = capsys.readouterr()
        self.out, self.err = captured.out, captured.err
        self.words = " ".join(self.out.split())


def test_a_sound_log_is_told_in_numbers(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    checked = Checked(capsys, log)
    assert (checked.code, checked.err) == (0, "")
    assert "1,000 rows over 9.99 s at 100 Hz (median interval 10 ms), from 0 s; no gaps" in checked.words
    assert re.search(r"at rest \|a\| = 1(\.\d+)? g, noise 0\.00(1|09\d) a sample", checked.words)
    assert "notes none" in checked.words
    assert max(map(len, checked.out.splitlines())) <= 120


def test_a_refused_log_gives_exit_code_2_its_line_and_code(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = log.read_text().splitlines()
    lines[6] = lines[6].replace(",", ",ERR", 1)
    log.write_text("\n".join(lines) + "\n")
    checked = Checked(capsys, log)
    assert checked.code == 2
    assert "REFUSED line 7: column accel_x_g (accel_x) is 'ERR" in checked.words
    assert "code not_a_number" in checked.words
    assert checked.err == f"python -m pipeline check: {log}:7: refused (not_a_number)\n"
    assert "PROPOSED" not in checked.out


def test_one_bad_file_does_not_hide_the_others(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    empty, missing = tmp_path / "empty.csv", tmp_path / "missing.csv"
    empty.touch()
    checked = Checked(capsys, empty, missing, log)
    assert checked.code == 2
    assert "the file is empty (0 bytes)" in checked.words
    assert "No such file" in checked.words
    assert "1,000 rows" in checked.words
    assert len(checked.err.splitlines()) == 2


def test_notes_are_shown_with_code_and_line(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log.write_bytes(b"\xef\xbb\xbf" + log.read_bytes() + b"10.0,0.1")
    checked = Checked(capsys, log)
    assert checked.code == 0
    assert "N-BOM" in checked.out
    assert "N-TAIL, line 1002: the last line does not end in a newline" in checked.words


def test_a_log_of_ros_messages_is_told_with_its_topics_and_its_proof(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_recording(tmp_path / "log.mcap", make_log())
    checked = Checked(capsys, tmp_path / "log.mcap")
    assert checked.code == 0
    assert "1,000 messages in 1 chunk, written by imu-calibration; every checksum and count verified" in checked.words
    assert "topic /imu/data (sensor_msgs/msg/Imu, cdr): 1,000 messages" in checked.words


def test_a_damaged_mcap_file_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "log.mcap"
    write_recording(file, make_log())
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 4
    file.write_bytes(bytes(data))
    checked = Checked(capsys, file)
    assert checked.code == 2
    assert "checksum" in checked.words


def test_a_self_describing_log_needs_no_profile(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = "".join(f"{10 * i},0,0,0,0,0,{2048 + i % 3}\n" for i in range(200))
    head = "GYROFLOW IMU LOG\nversion,1.3\norientation,XYZ\ntscale,0.001\ngscale,0.001\nascale,0.00048828125\n"
    (tmp_path / "log.gcsv").write_text(head + "t,gx,gy,gz,ax,ay,az\n" + rows)
    checked = Checked(capsys, tmp_path / "log.gcsv")
    assert checked.code == 0
    assert "200 rows over 1.99 s at 100 Hz" in checked.words


def test_a_file_of_a_campaign_is_read_as_the_campaign_says(capsys: pytest.CaptureFixture[str]) -> None:
    checked = Checked(capsys, DEMO / "mpu6050-1" / "gyro_z.csv", DEMO / "mpu6050-1-mcap" / "gyro_z.mcap")
    assert checked.code == 0
    assert "unit mpu6050-1 of campaign demo, recording gyro_z: ingest=canonical_csv, sensor=mpu6050" in checked.words
    assert "unit mpu6050-1-mcap of campaign demo, recording gyro_z" in checked.words
    assert "of 250 deg/s; none at full scale" in checked.words
    assert re.search(r"the gyroscope's z reads 1\.0\d\d of it, correlation 1\.0000", checked.words)


def test_nothing_is_written_or_applied_unasked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("log.csv").write_text("t,ax,ay,az\n" + "".join(f"{0.01 * i:.2f},0,0,1\n" for i in range(100)))
    checked = Checked(capsys, "log.csv")
    assert checked.code == 2
    assert "PROPOSED PROFILE for log.csv" in checked.out
    assert [p.name for p in tmp_path.iterdir()] == ["log.csv"]


def test_a_saved_proposal_is_used_when_it_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("log.csv").write_text("t,ax,ay,az\n" + "".join(f"{0.01 * i:.2f},0,0,1\n" for i in range(100)))
    assert Checked(capsys, "log.csv", "--save", "mine.yaml").code == 2
    assert yaml.safe_load(Path("mine.yaml").read_text())["name"] == "mine"
    bench = tmp_path / "bench" / "configs" / "ingest"
    bench.mkdir(parents=True)
    for named in ("mine.yaml", "mine"):
        checked = Checked(capsys, "log.csv", "--ingest", named)
        assert checked.code == 0
        assert "ingest=mine" in checked.out
    shutil.move("mine.yaml", bench / "mine.yaml")
    shutil.copy("log.csv", "bench/log.csv")
    for folder, file in ((tmp_path, "log.csv"), (tmp_path, "bench/log.csv"), (bench.parent, "../log.csv")):
        monkeypatch.chdir(folder)
        assert Checked(capsys, file, "--ingest", "mine").code == 0
    monkeypatch.chdir(tmp_path)
    assert main(["check", "log.csv", "--ingest", "yours"]) == 2
    assert "no such ingest" in capsys.readouterr().err
    Path("mine.yaml").write_text((bench / "mine.yaml").read_text() + "# another\n")
    assert main(["check", "log.csv", "--ingest", "mine"]) == 2
    assert "--ingest mine is one of" in capsys.readouterr().err


def test_the_advice_after_saving_leads_to_the_saved_file_beside_others_of_its_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("my log.csv").write_text("t,ax,ay,az\n" + "".join(f"{0.01 * i:.2f},0,0,1\n" for i in range(100)))
    for bench in ("one", "two"):
        folder = tmp_path / bench / "configs" / "ingest"
        folder.mkdir(parents=True)
        (folder / "mine.yaml").write_text(f"name: {bench}\n")
    checked = Checked(capsys, "my log.csv", "--save", "two/configs/ingest/mine.yaml")
    assert "save it" not in checked.out
    (advice,) = re.findall(r"^python -m pipeline (check .*)$", checked.out, re.MULTILINE)
    assert main(shlex.split(advice)) == 0
    assert "ingest=mine" in capsys.readouterr().out
    assert main(["check", "my log.csv", "--save", "mine"]) == 2
    assert "ends in .yaml" in capsys.readouterr().err


def test_files_of_one_recording_are_calibrated_where_the_advice_places_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    description = {"units": [{"unit": "U1", "procedure": "multi_position", "table": "hand"}]}
    write_campaign(description_from(description, "bench"), tmp_path / "bench")
    monkeypatch.chdir(tmp_path)
    folder = Path("bench", "raw", "U1")
    (whole,) = folder.glob("recording.*")
    table = np.genfromtxt(whole, delimiter=",", names=True)
    data = np.column_stack([table[name] for name in table.dtype.names])
    for name, columns in (("acc.txt", [0, 1, 2, 3]), ("gyr.txt", [0, 4, 5, 6])):
        np.savetxt(folder / name, data[:, columns], fmt="%.9f")
    whole.unlink()
    names = [str(folder / name) for name in ("acc.txt", "gyr.txt")]
    checked = Checked(capsys, *names, "--ingest", "canonical_csv", "--save", "bench/configs/ingest/mine.yaml")
    assert "place both in raw/<unit>/ under these names" in checked.words
    units = Path("bench", "units.csv")
    header, row = units.read_text().splitlines()
    units.write_text(f"{header},ingest\n{row},mine\n")
    checked = Checked(capsys, "--campaign", "bench")
    assert checked.code == 0, checked.out
    assert "unit U1: 1 recording, no refusal" in checked.out


def test_files_alike_share_one_proposal_which_is_printed_last(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    names = [f"log{i}.csv" for i in range(5)]
    for name in names:
        Path(name).write_text("t,ax,ay,az,state\n" + "".join(f"{0.01 * i:.2f},0,0,1,A\n" for i in range(100)))
    checked = Checked(capsys, *names)
    assert checked.out.count("REFUSED  ") == 1
    assert "REFUSED as log0.csv: log1.csv, log2.csv, log3.csv, log4.csv" in checked.out
    assert checked.err == "python -m pipeline check: 5 files, for example log0.csv:1: refused (missing_column)\n"
    assert "REFUSED the file needs another profile, see below: line 1: column" in checked.words
    assert f"check {' '.join(names)} --ingest" in checked.words
    assert checked.words.count("read with the proposed profile") == 3
    assert "no column that the profile assigns to the gyroscope" in checked.words
    listed = ", ".join(names)
    order = ["WITH THE PROFILE", f"PROPOSED PROFILE for {listed}", "# not used: state", "NOT FOUND: the gyroscope"]
    places = [checked.out.index(text) for text in [*order, "If every line is right"]]
    assert places == sorted(places)
    assert checked.out.count("PROPOSED PROFILE") == 1


def test_a_profile_with_something_left_to_fill_in_is_refused_by_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("log.csv").write_text("ax,ay,az\n" + "0,0,1\n" * 100)
    Checked(capsys, "log.csv", "--save", "mine.yaml")
    assert main(["check", "log.csv", "--ingest", "mine.yaml"]) == 2
    assert "rate_hz" in capsys.readouterr().err


def test_parts_of_one_recording_are_read_together(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = REFERENCE / "xsens_mti_multi_position"
    if not source.is_dir():
        pytest.skip("reference data not beside the repository")
    for name in ("accelerometer.txt", "gyroscope.txt"):
        shutil.copy(source / name, tmp_path)
    checked = Checked(capsys, tmp_path / "gyroscope.txt", "--ingest", "xsens_mti_multi_position")
    assert checked.code == 0
    assert "51,175 rows over 511.7 s" in checked.words
    assert "the rates agree with the rotation of gravity" in checked.words


def in_counts(folder: Path, names: tuple[str, str]) -> None:
    """Write a log in two files, as the shipped profile of an Xsens states them."""
    log = make_log()
    for name, readings, scale in zip(names, (log.accelerometer, log.gyroscope), (4070.0, 83.2), strict=True):
        assert readings is not None
        counts = 32768.0 + np.rint(scale * readings)
        np.savetxt(folder / name, np.column_stack([log.time, counts]), fmt="%.6e")


def test_a_shipped_profile_that_fits_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    in_counts(tmp_path, ("accelerometer.txt", "gyroscope.txt"))
    checked = Checked(capsys, *sorted(tmp_path.iterdir()))
    assert "SHIPPED PROFILE: xsens_mti_multi_position reads" in checked.words
    assert "check by --ingest xsens_mti_multi_position" in checked.words
    assert Checked(capsys, *sorted(tmp_path.iterdir()), "--ingest", "xsens_mti_multi_position").code == 0


@pytest.mark.parametrize("names", [("accelerometer.txt", "gyroscope.txt"), ("{file}_a.txt", "{file}_g.txt")])
def test_of_a_log_in_two_files_the_sheet_has_one_row_and_the_only_profile_is_used_and_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], names: tuple[str, str]
) -> None:
    folder, profile = tmp_path / "raw" / "U1", tmp_path / "configs" / "ingest" / "mine.yaml"
    folder.mkdir(parents=True)
    profile.parent.mkdir(parents=True)
    text = (REPOSITORY / "configs" / "ingest" / "xsens_mti_multi_position.yaml").read_text()
    profile.write_text(text.replace("accelerometer.txt", f"'{names[0]}'").replace("gyroscope.txt", f"'{names[1]}'"))
    (tmp_path / "units.csv").write_text("unit,sensor,table,procedure\nU1,generic,hand,listed\n")
    in_counts(folder, (names[0].replace("{file}", "s"), names[1].replace("{file}", "s")))
    (folder / "recordings.csv").write_text("file,kind\n")
    row = f"{'s' if '{file}' in names[0] else 'log'},rest"
    proposed = Checked(capsys, "--campaign", tmp_path)
    assert row in proposed.out.splitlines()
    assert f"read with {profile}: no setting names it, write ingest=mine into campaign.yaml" in proposed.words
    (tmp_path / "campaign.yaml").write_text("overrides: [ingest=mine]\n")
    assert "read with" not in Checked(capsys, "--campaign", tmp_path).words
    (folder / "recordings.csv").write_text(f"file,kind\n{row}\n")
    assert Checked(capsys, folder / names[0].replace("{file}", "s")).code == 0
    (folder / "recordings.csv").write_text("file,kind\na,rest\nb,rest\n")
    if row.startswith("log"):
        assert main(["check", "--campaign", str(tmp_path)]) == 2
        assert "this one requires a, b: write {file} where" in capsys.readouterr().err


@pytest.mark.parametrize(
    "file", ["mpu6050_multi_position/example_data_calibration.csv", "mpu6050_multi_position/imu_90_x_rot.csv"]
)
def test_published_logs_are_read_with_their_profile(file: str, capsys: pytest.CaptureFixture[str]) -> None:
    if not (REFERENCE / file).is_file():
        pytest.skip("reference data not beside the repository")
    checked = Checked(capsys, REFERENCE / file, "--ingest", "mpu6050_multi_position", "--sensor", "mpu6050")
    assert checked.code == 0
    assert "N-SYNTHTIME" in checked.out


def test_an_unknown_profile_is_refused_with_those_that_are_known(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(log), "--ingest", "canonical"]) == 2
    assert "canonical_csv" in capsys.readouterr().err


def test_prose_is_no_table_of_numbers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    prose = tmp_path / "notes.txt"
    prose.write_text(
        "\n".join(f"In {2000 + k} we mounted 3 sensors , 20 cm apart , on 2 plates" for k in range(2)) + "\n"
    )
    checked = Checked(capsys, prose)
    assert checked.code == 2
    assert "no table of numbers was found in it" in checked.words
    assert "PROPOSED" not in checked.out
    rows = [f"{k},{k % 7},{k % 5},{k % 3}" for k in range(300)]
    prose.write_text("\n".join(["Fs,100,,", *rows, "n,ax,ay,az", *rows]) + "\n")  # a second header
    assert "does not increase at 1 rows: several sessions" in Checked(capsys, prose).words


def test_one_long_recording_is_told_with_its_segments(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    course = {"step_deg": 30.0, "validation_s": 30.0, "static_s": 90.0}
    unit = {"unit": "U", "procedure": "one_recording", "course": course}
    write_campaign(description_from({"units": [unit]}, "test"), tmp_path)
    checked = Checked(capsys, tmp_path / "raw" / "U" / "recording.csv")
    assert checked.code == 0
    assert "segments accel_x: 12 steps about x at" in checked.words
    assert "static: a long rest, from" in checked.words


@pytest.fixture
def linked(tmp_path: Path) -> Path:
    """Return a campaign of one unit whose recordings are links to files elsewhere."""
    (tmp_path / "bench" / "raw" / "U").mkdir(parents=True)
    (tmp_path / "bench" / "units.csv").write_text("unit,sensor,overrides\nU,mpu6050,sensor.gyroscope.range=500\n")
    for file in (DEMO / "mpu6050-1").iterdir():
        (tmp_path / "bench" / "raw" / "U" / file.name).symlink_to(file)
    return tmp_path / "bench"


def test_a_link_in_a_campaign_and_a_file_elsewhere_are_read_as_the_campaign_says(
    linked: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    checked = Checked(capsys, linked / "raw" / "U" / "gyro_x.csv")
    assert checked.code == 0
    assert "unit U of campaign bench, recording gyro_x: ingest=canonical_csv, sensor=mpu6050" in checked.words
    assert "of 500 deg/s" in checked.words
    elsewhere = Checked(capsys, DEMO / "mpu6050-2" / "gyro_x.csv", "--campaign", linked)
    assert elsewhere.code == 0
    assert "campaign bench, as no recording of a unit: ingest=canonical_csv, sensor=mpu6050" in elsewhere.words
    assert "of 500 deg/s" in elsewhere.words
    alone = Checked(capsys, DEMO / "mpu6050-2" / "gyro_x.csv", "--sensor", "mpu6050", "--range", "4", "500")
    assert "of 4 g; gyroscope" in alone.words
    assert "of 500 deg/s" in alone.words


def test_a_unit_is_refused_for_what_its_recordings_show_together(
    linked: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "unit U: 8 recordings, no refusal" in Checked(capsys, "--campaign", linked).out
    copy = linked / "raw" / "U" / "static.csv"
    copy.unlink()
    lines = (DEMO / "mpu6050-1" / "validation.csv").read_text().splitlines()
    copy.write_text("\n".join(lines[:1000]) + "\n")
    for checked in (Checked(capsys, "--campaign", linked), Checked(capsys, linked / "raw" / "U" / "gyro_x.csv")):
        assert checked.code == 2
        assert "unit U of campaign bench" in checked.out
        assert "code shared_rows" in checked.words
    copy.unlink()
    (linked / "raw" / "U" / "validation.csv").unlink()
    checked = Checked(capsys, linked / "raw" / "U" / "gyro_x.csv")
    assert checked.code == 0
    assert "a run needs more recordings of unit U" in checked.words
    assert Checked(capsys, "--campaign", linked, "--unit", "U").code == 2


def test_equal_notes_of_recordings_are_one_and_others_are_told_apart(
    linked: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, shift, sign in (("gyro_y", 10.0, 1), ("gyro_z", 20.0, 1)):  # of the encoder
        file = linked / "raw" / "U" / f"{name}.csv"
        header, *rows = file.read_text().splitlines()
        place = header.split(",").index("table_angle_deg")
        cells = [row.split(",") for row in rows]
        for row in cells:
            row[place] = f"{sign * float(row[place]) + shift:.6f}"
        file.unlink()
        file.write_text("\ufeff" + "\n".join([header, *(",".join(row) for row in cells)]) + "\n", encoding="utf-8")
    alone = Checked(capsys, linked / "raw" / "U" / "gyro_y.csv")
    assert "N-FOUND x 421: used as found, body +z up at a table angle of 10.0 deg" in alone.words
    assert "state it in devices/U.yaml" in alone.words
    checked = Checked(capsys, "--campaign", linked)
    assert re.search(r"N-BOM gyro_y: [^;]*; likewise gyro_z", checked.words)
    assert "gravity shows another one than stated in gyro_y, gyro_z of U, and it is used as found" in checked.words
    assert "state it in campaign.yaml" in checked.words
    assert checked.out.count("N-FOUND") == 1
    block = checked.out[checked.out.index("overrides:") :]
    assert yaml.safe_load(block) == {
        "overrides": ["procedure.recordings.gyro_y.zero_deg=10.00", "procedure.recordings.gyro_z.zero_deg=20.00"]
    }
    (linked / "campaign.yaml").write_text(block)
    pasted = Checked(capsys, "--campaign", linked)
    assert pasted.code == 0
    assert "N-FOUND" not in pasted.out
    assert re.search(r"N-MOUNTING gyro_y: as stated, body \+z up at a table angle of 10.0 deg", pasted.words)


def test_a_profile_that_the_campaign_holds_is_named_where_its_settings_do_not_name_it(
    linked: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for file in (linked / "raw" / "U").iterdir():
        text = file.read_text().replace("time_s,", "t_ms,", 1).replace("accel_", "a_").replace("gyro_", "w_")
        header, *rows = text.splitlines()
        rows = [f"{1e3 * float(row.partition(',')[0]):.3f},{row.partition(',')[2]}" for row in rows]
        file.unlink()
        file.write_text("\n".join([header, *rows]) + "\n")
    columns: dict[str, dict[str, str | bool]] = {"time": {"column": "t_ms", "unit": "ms"}}
    columns |= {f"accel_{a}": {"column": f"a_{a}_g", "unit": "g"} for a in "xyz"}
    columns |= {f"gyro_{a}": {"column": f"w_{a}_dps", "unit": "deg/s"} for a in "xyz"}
    others = {"temperature": "degC", "table_angle": "deg", "table_rate": "deg/s"}
    for channel, unit in (others | {f"table_q{a}": "1" for a in "wxyz"}).items():
        suffix = {"deg/s": "_dps", "1": ""}.get(unit, f"_{unit.lower()}")
        columns[channel] = {"column": channel + suffix, "unit": unit, "optional": True}
    profile = linked / "configs" / "ingest" / "my_logger.yaml"
    profile.parent.mkdir(parents=True)
    entries = {"name": "my_logger", "csv": {"columns": columns}}
    columns["time"]["unit"] = "???"
    profile.write_text(yaml.safe_dump(entries))
    shutil.copy(linked / "raw" / "U" / "gyro_x.csv", linked / "loose.csv")
    incomplete = Checked(capsys, linked / "loose.csv")
    assert f"saved profile {profile} cannot be used:" in incomplete.words
    assert "PROPOSED PROFILE" in incomplete.out
    columns["time"]["unit"] = "ms"
    profile.write_text(yaml.safe_dump(entries))
    for arguments in (("--campaign", linked), (linked / "loose.csv",)):
        checked = Checked(capsys, *arguments)
        assert checked.code == 2
        assert "the profile that the settings name does not describe it (missing_column)" in checked.words
        assert f"SAVED PROFILE: {profile} describes the files of" in checked.words
        assert "PROPOSED" not in checked.out
        assert "???" not in checked.out
    assert "ingest=my_logger" in checked.words
    (linked / "campaign.yaml").write_text(checked.out[checked.out.index("overrides:") :])
    used = Checked(capsys, "--campaign", linked)
    assert (used.code, used.out) == (0, "unit U: 8 recordings, no refusal up to the calibration\n\n")


def test_slow_full_turns_of_a_table_are_no_rests_and_no_contradiction(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng, rate, bias = np.random.default_rng(5), 125.0, np.array([0.04, -0.03, 0.02])
    turned = np.concatenate([np.zeros(1000), np.cumsum(np.full(5625, 8.0 / rate)), np.full(1000, 360.0)])
    angle, n = np.radians(turned), len(turned)
    force = np.column_stack([np.cos(angle), -np.sin(angle), np.zeros(n)]) + bias + 3e-3 * rng.standard_normal((n, 3))
    speed = np.gradient(turned, 1.0 / rate)
    gyro = np.column_stack([np.zeros(n), np.zeros(n), speed]) + 0.04 * rng.standard_normal((n, 3))
    slow = Recording("slow", "rests", None, 8_000_000 * np.arange(n), accelerometer=force, gyroscope=gyro)
    write_recording(tmp_path / "slow.csv", slow)
    words = Checked(capsys, tmp_path / "slow.csv").words
    assert "no move between rests turns gravity" in words
    assert re.search(r"rests 2, 7\.9\d* to 7\.9\d* s long", words)


def test_a_wrong_unit_of_few_moves_and_swapped_axes_are_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng, rate = np.random.default_rng(6), 100.0
    axes = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [0, 1, 1], [1, 0, 1]], float)
    rotation, force, gyro = Rotation.identity(), [], []
    for axis in axes / np.linalg.norm(axes, axis=1, keepdims=True):
        for speed, samples in ((0.0, 200), (80.0, 100)):
            for _ in range(samples):
                force.append(rotation.inv().apply([0.0, 0.0, 1.0]))
                gyro.append(speed * axis)
                rotation *= Rotation.from_rotvec(np.radians(speed / rate) * axis)
    force += [rotation.inv().apply([0.0, 0.0, 1.0])] * 200
    f = np.array(force) + 2e-3 * rng.standard_normal((len(force), 3))
    w = np.concatenate([gyro, np.zeros((200, 3))])

    def words(rates: np.ndarray, rows: int) -> str:
        times = 10_000_000 * np.arange(rows)
        log = Recording("log", "rests", None, times, accelerometer=f[:rows], gyroscope=rates[:rows])
        write_recording(tmp_path / "log.csv", log)
        return Checked(capsys, tmp_path / "log.csv").words

    w += 0.05 * rng.standard_normal(w.shape)
    assert "the rates agree with the rotation of gravity to within 0." in words(w, len(f))
    assert "check the unit of the rates: multiplied by 57.3 they turn gravity to within" in words(w / 57.29578, 800)
    assert "contradict each other" in words(w[:, [1, 0, 2]], len(f))


def test_an_encoder_that_is_not_connected_is_told_and_refused_where_a_run_needs_it(
    linked: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for file in [f for f in (linked / "raw" / "U").iterdir() if f.stem not in {"validation", "static"}]:
        lines = file.read_text().splitlines()
        names = lines[0].split(",")
        angle, rate = names.index("table_angle_deg"), names.index("table_rate_dps")
        rows = [line.split(",") for line in lines[1:]]
        for row in rows:
            row[angle] = row[rate] = "0"
        file.unlink()
        file.write_text("\n".join([lines[0], *(",".join(row) for row in rows)]) + "\n")
    checked = Checked(capsys, linked / "raw" / "U" / "gyro_z.csv", "--ingest", "canonical_csv")
    assert checked.code == 0
    assert "the table did not turn, or its encoder is not connected" in checked.words
    assert "the sensor did not move" not in checked.words
    assert Checked(capsys, linked / "raw" / "U" / "gyro_z.csv").code == 2


def test_the_parts_of_a_log_whose_clock_fell_back_are_used_by_the_settings_that_check_prints(
    linked: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = linked / "raw" / "U" / "accel_x.csv"
    header, *rows = log.read_text().splitlines()
    again = [f"{float(row.partition(',')[0]) - 75.0:.3f},{row.partition(',')[2]}" for row in rows[440:]]
    log.unlink()
    log.write_text("\n".join([header, *rows[:430], "rst cause:2", *again]) + "\n")
    (linked / "raw" / "U" / "gyro_y.csv").unlink()
    (linked / "raw" / "U" / "gyro_y.csv").write_text(f"{header}\n")
    refused = Checked(capsys, "--campaign", linked)
    assert refused.code == 2
    assert "accel_x.csv:432: refused (bad_row)" in refused.err
    assert "gyro_y.csv: refused (no_rows)" in refused.err
    assert f"the log has 2 parts, lines 2 to 431; 433 to {432 + len(again)}" in refused.words
    (linked / "raw" / "U" / "gyro_y.csv").unlink()
    (linked / "raw" / "U" / "gyro_y.csv").symlink_to(DEMO / "mpu6050-1" / "gyro_y.csv")
    recipe = refused.out[refused.out.index("overrides:") :].partition("\n\n")[0]
    (linked / "devices").mkdir()
    (linked / "devices" / "U.yaml").write_text(recipe + "\n")
    assert "unit U: 9 recordings, no refusal" in Checked(capsys, "--campaign", linked).out
    both = Checked(capsys, log)
    assert f"session 2 of 2: lines 433 to {432 + len(again)} were read" in both.words


def test_the_parts_of_a_log_by_hand_are_used_by_the_settings_that_check_prints(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """``axis`` of a recording of rests is null, and an override that leaves it out is refused."""
    assert main(["new", str(tmp_path / "bench"), "--sensor", "generic", "--procedure", "multi_position"]) == 0
    folder = tmp_path / "bench" / "raw" / "U1"
    folder.mkdir(parents=True, exist_ok=True)
    rows = [f"{0.02 * (i % 600):.2f},0,0,{(-1) ** (i // 600)},0.1,0.2,0.3" for i in range(1200)]
    names = ",".join(["time_s", *(f"accel_{a}_g" for a in "xyz"), *(f"gyro_{a}_dps" for a in "xyz")])
    (folder / "recording.csv").write_text("\n".join([names, *rows]) + "\n")
    capsys.readouterr()
    refused = Checked(capsys, "--campaign", tmp_path / "bench")
    recipe = refused.out[refused.out.index("overrides:") :].partition("\n\n")[0]
    (tmp_path / "bench" / "devices").mkdir(exist_ok=True)
    (tmp_path / "bench" / "devices" / "U1.yaml").write_text(recipe + "\n")
    checked = Checked(capsys, "--campaign", tmp_path / "bench")
    assert "the configuration is refused" not in checked.out + checked.err
    assert "2 orientations determine neither" in checked.out  # one of each part


def test_a_command_that_cannot_read_a_log_names_the_one_that_proposes_a_profile(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "log.csv").write_text("t,ax,ay,az\n" + "".join(f"{0.01 * i:.2f},0,0,1\n" for i in range(100)))
    assert main(["guide", str(tmp_path / "log.csv")]) == 2
    assert "pipeline check FILE --save PROFILE.yaml proposes how to read it" in capsys.readouterr().err


def test_what_rests_by_hand_do_not_determine_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    unit = {"unit": "U", "table": "hand", "procedure": "six_positions", "interval_s": 0.05}
    write_campaign(description_from({"seed": 5, "units": [unit]}, "test"), tmp_path)
    checked = Checked(capsys, "--campaign", tmp_path)
    assert checked.code == 0
    assert "accelerometer the rests do not determine misalignment_yx, misalignment_zx, misalignment_zy" in checked.words


def test_the_kind_of_a_log_that_is_cut_short_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "log.h5"
    log.write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(40))
    checked = Checked(capsys, log, "--ingest", "array_file")
    assert checked.code == 2
    assert "kind an HDF5 file, by its first bytes" in checked.words


def test_rests_that_a_run_does_not_use_are_counted() -> None:
    rng = np.random.default_rng(1)
    up = np.repeat(np.vstack([np.eye(3), -np.eye(3)] * 5), 80, axis=0)  # 0.8 s each
    time_ns = np.arange(len(up)) * 10_000_000
    readings = up + 1e-3 * rng.standard_normal(up.shape), 0.05 * rng.standard_normal(up.shape)
    rests = dict(facts(Recording("recording", "rests", None, time_ns, *readings)))["rests"]
    assert "of them are shorter than 1 s, and a run does not use them" in rests


def test_rates_at_rest_that_no_sensor_reads_are_doubted() -> None:
    rng = np.random.default_rng(1)
    force = np.tile([0.0, 0.0, 1.0], (2000, 1)) + 1e-3 * rng.standard_normal((2000, 3))
    rate = np.array([166.0, -938.0, -444.0]) + 50.0 * rng.standard_normal((2000, 3))  # mdps, read as deg/s
    lines = dict(facts(Recording("log", "rests", None, np.arange(2000) * 10_000_000, force, rate)))
    assert "more than the 20 deg/s of consumer sensors: check the unit" in lines["gyroscope"]
