"""``python -m pipeline guide``: the next rest or turn by hand, from files and from a log that grows."""

from __future__ import annotations

import re
import shutil
from typing import TYPE_CHECKING

import numpy as np
import pytest

from pipeline.__main__ import main
from pipeline.app.commands import guide_recording
from pipeline.core.files import CONFIGS
from pipeline.core.records import Recording
from pipeline.core.settings import HandTurns
from pipeline.physics.signal.rests import find_rests
from pipeline.physics.signal.segments import turns_by_hand
from pipeline.simulation.campaign import write_campaign
from pipeline.simulation.description import description_from

if TYPE_CHECKING:
    from pathlib import Path


def campaign(directory: Path, procedure: str, **course: object) -> Path:
    """Write a campaign with one unit and return its recording."""
    unit = {"unit": "U1", "table": "hand", "procedure": procedure, "interval_s": 0.05, "course": course}
    directory.mkdir()
    write_campaign(description_from({"seed": 5, "units": [unit]}, "test"), directory)
    return directory / "raw" / "U1" / "recording.csv"


@pytest.fixture(scope="module")
def rests(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return campaign(tmp_path_factory.mktemp("a") / "bench", "orientations_24", static_s=0.0, warm_up_rest_s=4.0)


def readings_of(log: Path) -> tuple[str, np.ndarray]:
    """Return the header and the values of time and readings: (n, 7) array."""
    header, *rows = log.read_text().splitlines()
    return ",".join(header.split(",")[:7]), np.array([row.split(",")[:7] for row in rows], float)


def lines_of(header: str, table: np.ndarray) -> list[str]:
    return [header, *(",".join(f"{v:.6f}" for v in row) for row in table)]


def test_of_few_rests_it_says_what_they_leave_open_and_what_comes_next(
    rests: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = rests.read_text().splitlines()
    part = tmp_path / "log.csv"
    part.write_text("\n".join(text[:700]) + "\n")
    assert main(["guide", str(part), "--sensor", "mpu6050", "--goal", "0.5"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("   1  log ")
    assert "+z up" in lines[0]
    assert any(line.startswith("expanded uncertainty: not determined yet") and "goal 0.5 mg" in line for line in lines)
    assert any(line.startswith("next: ") and "rest it for 4 s" in line for line in lines)
    assert "more rests of the fit" in lines[-1]
    assert main(["guide", str(part), "--sensor", "mpu6050", "--goal", "0.5", "--gyroscope-goal", "1"]) == 0
    *as_before, last = capsys.readouterr().out.splitlines()
    assert as_before == lines
    assert last.startswith("gyroscope's matrix: not determined yet: ")
    assert last.endswith("(goal 1 %); turns for it are proposed once the accelerometer's goal is reached")


def test_a_recording_of_a_campaign_is_read_by_its_configuration(
    rests: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["guide", str(rests), "--goal", "1"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert sum("held out)" in line for line in lines) == 8
    assert "16 rests of the fit, 8 held out; goal 1 mg" in lines[-2]
    assert lines[-1] == "enough: the goal is reached"
    assert main(["guide", str(rests), "--goal", "1", "--gyroscope-goal", "1"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "enough: both goals are reached"
    assert main(["guide", str(rests), "--goal", "1", "--gyroscope-goal", "0.001"]) == 0
    assert "which stays level, rest it for 4 s again" in capsys.readouterr().out.splitlines()[-1]
    assert main(["guide", str(rests), "--goal", "0.001", "--gyroscope-goal", "1"]) == 0
    *_, expected, of_gyroscope = capsys.readouterr().out.splitlines()
    assert "the goal is out of reach" in expected
    assert re.fullmatch(r"expanded uncertainty of the gyroscope's matrix: 0\.\d+ % \(goal 1 %\)", of_gyroscope)


def test_a_growing_log_is_followed_until_it_is_enough(
    rests: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    data, log = rests.read_bytes(), tmp_path / "log.csv"
    sizes = iter(range(0, len(data) + 1, len(data) // 14))  # a log is cut anywhere, within a row too

    def grow(_: float) -> None:
        log.write_bytes(data[: next(sizes)])

    monkeypatch.setattr(guide_recording.time, "sleep", grow)
    assert main(["guide", str(log), "--sensor", "mpu6050", "--goal", "0.8", "--follow"]) == 0
    out = capsys.readouterr().out
    lines = out.splitlines()
    assert lines[0].startswith(
        "one of 3 rests is held out of the fit, to judge it: there is no recording for validation"
    )
    assert lines[1].startswith("waiting: there is no file")
    assert lines[-1] == "enough: the goal is reached"
    assert next(sizes, None) is not None  # before the log was complete
    numbers = [int(line.split()[0]) for line in lines if line.startswith("   ") and line.split()[0].isdigit()]
    assert numbers == sorted(set(numbers))  # each rest once
    assert out.count("next: ") > 3


def test_a_rest_that_is_left_out_is_told_once_and_hides_no_later_one(
    rests: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    header, table = readings_of(rests)
    leans = (table[:, 0] - table[0, 0] > 16.6) & (table[:, 0] - table[0, 0] < 20.6)
    table[leans, 1] += np.linspace(-0.1, 0.1, np.count_nonzero(leans))
    lines = lines_of(header, table)
    log, sizes = tmp_path / "log.csv", iter(range(100, len(lines), 60))
    monkeypatch.setattr(guide_recording.time, "sleep", lambda _: log.write_text("\n".join(lines[: next(sizes)]) + "\n"))
    assert main(["guide", str(log), "--sensor", "mpu6050", "--goal", "0.9", "--follow"]) == 0
    told = capsys.readouterr().out.splitlines()
    left_out = [line for line in told if "left out" in line]
    assert len(left_out) == len(set(left_out)) >= 1
    starts = [line.split()[2] for line in told if line[:4].strip().isdigit()]
    assert len(starts) == len(set(starts))
    assert len(starts) > 12  # the rests after it
    assert told[-1] == "enough: the goal is reached"


def test_the_rests_as_last_told_are_those_that_each_message_counts(
    rests: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    header, table = readings_of(rests)
    since = table[:, 0]
    table[(since >= 55.0) & (since < 59.0), 6] += 0.6
    table[(since >= 57.3) & (since < 59.0), 6] += 0.5
    lines = lines_of(header, table)
    times = iter([*np.arange(55.0, 59.6, 0.4), 64.5, 69.5, 74.5])

    def grow(_: float) -> None:
        until = next(times, None)
        if until is None:
            raise KeyboardInterrupt
        (tmp_path / "log.csv").write_text("\n".join(lines[: 1 + int(np.sum(since < until))]) + "\n")

    monkeypatch.setattr(guide_recording.time, "sleep", grow)
    options = ["--sensor", "mpu6050", "--goal", "0.001", "--dwell", "2", "--follow"]
    assert main(["guide", str(tmp_path / "log.csv"), *options]) == 0
    lines = capsys.readouterr().out.splitlines()
    uses: dict[float, str] = {}
    numbers: dict[float, int] = {}
    counted = 0
    for line in lines:
        if rest := re.match(r" *(\d+|-)  log (\d+\.\d)", line):
            near = [start for start in uses if abs(start - float(rest[2])) < 0.5]
            assert ("; before it was " in line) == bool(near)  # told again only with what was told before
            start = near[0] if near else float(rest[2])
            assert uses.get(start) != _use(line)
            uses[start], numbers[start] = _use(line), 0 if rest[1] == "-" else int(rest[1])
        for start, number in re.findall(r"\(log (\d+\.\d) s\) is now (\d+)", line):
            numbers[min(numbers, key=lambda known: abs(known - float(start)))] = int(number)
        if count := re.match(r"expanded uncertainty: .*\((\d+) rests of the fit, (\d+) held out", line):
            counted += 1
            of = list(uses.values())
            assert [of.count("in the fit"), of.count("held out")] == [int(count[1]), int(count[2])]
            accepted = [numbers[start] for start in sorted(uses) if numbers[start]]
            assert accepted == list(range(1, len(accepted) + 1))
    assert counted > 4
    assert sum("  log 55." in line for line in lines) > 1  # the rest near the limit
    assert re.fullmatch(r"ended before it was enough: expanded uncertainty: .* \(\d+ rests of the fit, .*\)", lines[-1])


def _use(line: str) -> str:
    """Return the use of a rest by its line, without what it was before."""
    now = line.partition("; before")[0]
    return "left out" if "left out" in now else "held out" if "(held out)" in now else "in the fit"


def test_an_attitude_is_proposed_again_with_the_reason(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    up = [*np.eye(3), *-np.eye(3), *np.eye(3)]
    parts = [part for v in up for part in (np.tile(v, (90, 1)), 0.5 * rng.standard_normal((10, 3)))]
    force = np.concatenate(parts) + 1e-3 * rng.standard_normal((100 * len(up), 3))
    rows = np.column_stack([0.05 * np.arange(len(force)), force, np.zeros_like(force)])
    head = "time_s,accel_x_g,accel_y_g,accel_z_g,gyro_x_dps,gyro_y_dps,gyro_z_dps"
    np.savetxt(tmp_path / "log.csv", rows, "%.6f", ",", header=head, comments="")
    reasons = set()
    for count in range(2, len(up) + 1):
        (tmp_path / "part.csv").write_text(
            "\n".join([head, *(",".join(f"{v:.6f}" for v in r) for r in rows[: 100 * count])])
        )
        assert main(["guide", str(tmp_path / "part.csv"), "--sensor", "mpu6050", "--goal", "0.2"]) == 0
        out = capsys.readouterr().out
        known = re.findall(r"part \d.*?: (.*)", out)
        proposed = re.search(r"next: (.*);", out)
        assert proposed
        again = re.search(r"\(rest (\d+) \(part .* s\) is near this attitude(.*)\)", out)
        if "to judge it: an attitude far" not in out:
            assert bool(again) == (proposed[1] in {line.replace(" (held out)", "") for line in known})
        if again:
            reasons.add("held out" in again[2])
            assert known[int(again[1]) - 1].removesuffix(" (held out)") == proposed[1]
            assert ("held out" in again[2]) == known[int(again[1]) - 1].endswith("(held out)")
    assert True in reasons


def copied(rests: Path, tmp_path: Path) -> Path:
    """Return the recording in a copy of its campaign."""
    shutil.copytree(rests.parents[2], tmp_path / "bench")
    return tmp_path / "bench" / "raw" / "U1" / "recording.csv"


def test_a_recording_for_validation_leaves_every_rest_to_the_fit(
    rests: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = copied(rests, tmp_path)
    assert main(["guide", str(recording), "--goal", "1"]) == 0
    assert "one of 3 rests is held out of the fit" in capsys.readouterr().out
    header, table = readings_of(recording)
    table += [1000.0, *np.full(6, 1e-4)]  # another recording, later
    lines = lines_of(header, table)
    recording.with_name("validation.csv").write_text("\n".join(lines) + "\n")
    assert main(["guide", str(recording), "--goal", "1"]) == 0
    said = capsys.readouterr().out
    assert "no rest is held out of the fit: the recording for validation judges it" in said
    assert "rests of the fit, 0 held out" in said


def test_the_gyroscope_is_planned_with_the_effects_of_its_configuration(
    rests: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = copied(rests, tmp_path)
    header, table = readings_of(recording)
    table[:, 4:] += 0.5 * table[:, [2, 3, 1]]  # deg/s/g, across the axes
    lines = lines_of(header, table)
    recording.write_text("\n".join(lines) + "\n")
    stated = []
    for listed in ("", "[g_sensitivity]"):
        if listed:
            (recording.parents[2] / "devices").mkdir()
            lines = [f"effects.gyroscope={listed}", "effects.accelerometer=[quadratic_nonlinearity]"]
            (recording.parents[2] / "devices" / "U1.yaml").write_text(f"overrides: {lines}\n")
        assert main(["guide", str(recording), "--goal", "1", "--gyroscope-goal", "0.001"]) == 0
        out = capsys.readouterr().out
        assert ("accelerometer is forecast without its configured effects: quadratic_nonlinearity" in out) == bool(
            listed
        )
        found = re.search(r"gyroscope's matrix: ([\d.]+) %", out)
        assert found
        stated.append(float(found[1]))
    assert stated[1] < 0.5 * stated[0]


def test_a_log_of_two_files_is_guided_by_its_profile(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(3)
    rests = [np.tile(up, (90, 1)) for up in (*np.eye(3), *-np.eye(3))]
    force = np.concatenate([part for rest in rests for part in (rest, rng.standard_normal((10, 3)))])
    force += 1e-3 * rng.standard_normal(force.shape)
    for name, counts in (("accelerometer", 32768 + 4070 * force), ("gyroscope", 32768 + 0 * force)):
        np.savetxt(tmp_path / f"{name}.txt", np.column_stack([0.05 * np.arange(len(force)), counts]), fmt="%.2f")
    profile = ["--ingest", "xsens_mti_multi_position"]
    assert main(["guide", str(tmp_path / "accelerometer.txt"), *profile]) == 0
    out = capsys.readouterr().out
    assert out.startswith("goal: 0.4 mg, what 24 rests 45 deg apart reach with the noise of the sensor file generic")
    assert "   1  accelerometer 0.5 to 4." in out
    assert main(["guide", str(tmp_path / "accelerometer.txt"), str(tmp_path / "gyroscope.txt"), *profile]) == 0
    assert capsys.readouterr().out == out


def test_faces_and_turns_that_lack_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole = campaign(tmp_path / "faces", "ferraris", static_s=0.0)
    assert main(["guide", str(whole)]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "enough for bias and matrix: all faces and turns are there"
    cut = whole.parents[2] / "configs" / "procedure" / "cut.yaml"  # a run cuts this recording into parts
    cut.parent.mkdir(parents=True)
    plain = (CONFIGS / "procedure" / "ferraris.yaml").read_text()
    cut.write_text(plain.replace("recording, role: rests,", "recording, role: session,"))
    sheet = whole.parents[2] / "units.csv"
    sheet.write_text(sheet.read_text().replace("ferraris", "cut"))
    assert main(["guide", str(whole)]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "enough for bias and matrix: all faces and turns are there"
    rows = whole.read_text().splitlines()
    seen = []
    for share in (0.2, 0.7):
        part = tmp_path / "part.csv"
        part.write_text("\n".join(rows[: int(share * len(rows))]) + "\n")
        assert main(["guide", str(part), "--procedure", "ferraris", "--sensor", "mpu6050", "--dwell", "5"]) == 0
        seen.append(capsys.readouterr().out.splitlines()[-1])
    assert seen[0].endswith(" up; rest it for 5 s")
    assert all(line.startswith("next: +") and "about the vertical" in line for line in seen[1:])


def test_the_windows_of_a_procedure_are_read_as_a_run_reads_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = campaign(tmp_path / "faces", "ferraris", static_s=0.0)
    values = np.loadtxt(whole, delimiter=",", skiprows=1, usecols=range(7))
    nanoseconds = np.round(1e9 * values[:, 0]).astype(np.int64)
    recording = Recording("r", "rests", None, nanoseconds, accelerometer=values[:, 1:4], gyroscope=values[:, 4:])
    found = find_rests(recording)
    face = [int(np.argmax(np.abs(values[r.start : r.stop, 1:4].mean(axis=0)))) for r in found]
    since = values[:, 0] - values[0, 0]
    windows = [("null", since[r.start], since[r.stop - 1]) for r in found]
    stated = HandTurns(angle_deg=360.0, accuracy_deg=1.0, axis_accuracy_deg=1.0, holdout_every=0)
    turns = {"xyz"[t.axis]: (t.before[1], t.after[0]) for t in turns_by_hand(recording, found, stated)}
    assert set(turns) == set("xyz")
    assert set(face) == {0, 1, 2}
    windows += [(axis, start, stop) for axis, (start, stop) in turns.items()]  # each without a rest before or after it
    listed = [f"{{role: rests, axis: {axis}, start_s: {start}, stop_s: {stop}}}" for axis, start, stop in windows]
    parts = whole.parents[2] / "configs" / "procedure" / "parts.yaml"
    parts.parent.mkdir(parents=True)
    plain = (CONFIGS / "procedure" / "ferraris.yaml").read_text()
    sheet = whole.parents[2] / "units.csv"
    sheet.write_text(sheet.read_text().replace("ferraris", "parts"))
    for count, said in ((0, "enough for bias and matrix: all faces and turns are there"), (1, "next: +z up; ")):
        of = f"role: session, windows: [{', '.join(listed[: len(listed) - count])}],"
        parts.write_text(plain.replace("recording, role: rests,", f"recording, {of}"))
        assert main(["guide", str(whole)]) == 0
        *_, seen, last = capsys.readouterr().out.splitlines()
        assert seen == f"turns by 360 deg: x 1, y 1, z {1 - count}"
        assert last.startswith(said)
    assert main(["guide", str(whole), "--follow"]) == 2
    assert "procedure parts states windows, so the recording must be complete" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["none.csv"], "there is no file none.csv; --follow waits for one"),
        (["none.csv", "--procedure", "three_axis_turns"], "recorded on a table"),
        (["none.csv", "--goal", "0"], "--goal is 0; it must be above 0"),
        (["none.csv", "--procedure", "ferraris", "--gyroscope-goal", "1"], "leave out --goal and --gyroscope-goal"),
    ],
)
def test_what_cannot_be_guided_is_refused(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["guide", *arguments]) == 2
    assert said in capsys.readouterr().err


def test_the_sheet_of_a_campaign_is_no_recording(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["new", str(tmp_path / "bench"), "--procedure", "listed", "--sensor", "mpu6050"]) == 0
    assert main(["guide", str(tmp_path / "bench" / "raw" / "U1" / "recordings.csv")]) == 2
    assert "recordings.csv: this is a sheet; guide needs the recordings that it lists" in capsys.readouterr().err
