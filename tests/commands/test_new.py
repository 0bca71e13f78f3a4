"""An empty campaign: it names the table whose accuracy it takes, sets other ranges, and says how to record."""

import re
from pathlib import Path
from typing import Any

import pytest

from pipeline.app.commands import new
from pipeline.app.commands.new import main
from pipeline.app.config import load_campaign
from pipeline.core.errors import ConfigurationError


def test_the_table_is_named_with_its_accuracy_and_other_ranges_are_set_as_the_comments_say(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    directory = tmp_path / "my bench"
    assert main([str(directory), "--sensor", "mpu6050", "--table", "mark2"]) == 0
    said = capsys.readouterr().out
    assert "table mark2: accuracy of its angles 0.3 deg, of its rates 1 %" in said
    assert said.splitlines()[-1] == f"then: snakemake --cores 2 --config 'campaign={directory}'"
    assert (directory / "units.csv").read_text().splitlines() == [
        "unit,serial,lot,date,sensor,table,procedure,overrides",
        "U1,,,,mpu6050,mark2,three_axis_turns,",
    ]
    settings = directory / "campaign.yaml"
    text = settings.read_text()
    first = text.index("# models:")
    last = text.index("\n\n", first)
    uncommented = "\n".join(line.removeprefix("# ") for line in text[first:last].splitlines())
    settings.write_text(text[:first] + uncommented + text[last:])
    sensor = load_campaign({"campaign": str(directory)}).units["U1"].config.sensor
    assert [sensor.accelerometer.full_scale, sensor.accelerometer.counts_per_unit] == [4, 8192]
    assert [sensor.gyroscope.full_scale, sensor.gyroscope.counts_per_unit] == [500, 65.5]


def test_outside_a_clone_the_command_is_one_that_runs_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["bench", "--sensor", "mpu6050"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "then: python -m pipeline run bench"


def test_without_a_choice_the_table_of_the_procedure_is_written_down(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(tmp_path / "a")]) == 0
    assert "table acutronic: accuracy of its angles 0.00028 deg" in capsys.readouterr().out
    assert main([str(tmp_path / "b"), "--procedure", "six_positions"]) == 0
    assert "table hand: there is no table" in capsys.readouterr().out
    assert load_campaign({"campaign": str(tmp_path / "b")}).units["U1"].config.table.name == "hand"


@pytest.mark.parametrize("procedure", ["multi_position", "orientations_24", "ferraris"])
def test_a_campaign_by_hand_calibrates_both_sensors(tmp_path: Path, procedure: str) -> None:
    assert main([str(tmp_path / "a"), "--procedure", procedure]) == 0
    method = load_campaign({"campaign": str(tmp_path / "a")}).units["U1"].config.method
    assert (method.accelerometer, method.gyroscope) == ("nonlinear_least_squares", "rests_and_moves")


def test_other_ranges_need_no_overrides_by_hand(tmp_path: Path) -> None:
    assert main([str(tmp_path / "a"), "--sensor", "mpu6050", "--range", "8"]) == 0
    sensor = load_campaign({"campaign": str(tmp_path / "a")}).units["U1"].config.sensor
    assert [sensor.accelerometer.full_scale, sensor.accelerometer.counts_per_unit] == [8, 4096]
    assert sensor.gyroscope.full_scale == 250
    assert "campaign.yaml states the ranges" in (tmp_path / "a" / "README.md").read_text()
    with pytest.raises(ConfigurationError, match="in g, then of the gyroscope in deg/s"):
        main([str(tmp_path / "b"), "--range", "8", "500", "2"])


def test_the_readme_says_how_to_mount_and_record_and_what_stays_unseen(tmp_path: Path) -> None:
    main([str(tmp_path / "bench"), "--sensor", "mpu6050"])
    text = (tmp_path / "bench" / "README.md").read_text()
    rows = {line.split("`")[1]: line for line in text.splitlines() if line.startswith("| `")}
    assert list(rows) == [f"{k}_{a}.csv" for k in ("accel", "gyro") for a in "xyz"] + ["validation.csv", "static.csv"]
    # 72 steps of 5 deg with 1 s of rest, ramps of 0.2 s at 100 deg/s^2 to 20 deg/s: 0.45 s each, and the first rest
    assert rows["accel_z.csv"].startswith(
        "| `accel_z.csv` | +x up at angle 0; turn about z by 360 deg in steps of 5 deg"
    )
    assert rows["accel_z.csv"].endswith(f"| {72 * 1.45 + 1:.0f} s |")
    assert "| lever_arm | " in text
    unseen = text.partition("## What the recordings cannot show")[2]
    assert "- gyroscope, table_tilt: the direction of gravity does not change a rate" in unseen


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (
            ["--procedure", "multi_position"],
            ["python -m pipeline guide raw/U1/recording.csv --follow", "one of 3 rests"],
        ),
        (
            ["--procedure", "ferraris"],
            [
                "by hand, ferraris",
                "six faces",
                "one of 2 turns about an axis is held out",
                "No missing effect would show",
            ],
        ),
        (["--procedure", "listed"], ["| `label` | any text |", "judge.csv,turn,z,360,,yes", "check --campaign ."]),
        (["--procedure", "six_positions"], ["nothing is held out"]),
        (["--table", "single_axis"], ["Mount the unit anew for each turn axis, to 2 deg", "askew on the turn axis"]),
        (["--table", "mark2"], ["does not log its motion"]),
        (["--procedure", "thermal_ramp"], ["heat and cool the unit by 15 degC"]),
        (["--procedure", "one_recording"], ["one after the other, with rests between: +z up at angle 0"]),
    ],
)
def test_each_bench_gets_its_own_instructions(tmp_path: Path, options: list[str], said: list[str]) -> None:
    assert main([str(tmp_path / "bench"), *options]) == 0
    text = (tmp_path / "bench" / "README.md").read_text()
    assert all(words in text for words in said)
    assert not re.search(r"\|---\|\n(?!\|)", text)  # no table is empty
    load_campaign({"campaign": str(tmp_path / "bench")})


def test_on_a_terminal_it_asks_what_is_not_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    answers = iter(["mpu6050", "4 500", "six_positions", ""])
    asked: list[Any] = []

    def answer(question: str) -> str:
        asked.append(question)
        return next(answers)

    monkeypatch.setattr(new.sys.stdin, "isatty", lambda: True, raising=False)
    monkeypatch.setattr("builtins.input", answer)
    assert main([str(tmp_path / "bench")]) == 0
    assert asked == [
        "sensor [generic]: ",
        "ranges, g and deg/s [2 250]: ",
        "procedure [three_axis_turns]: ",
        "table [hand]: ",
    ]
    assert (tmp_path / "bench" / "units.csv").read_text().splitlines()[1] == "U1,,,,mpu6050,hand,six_positions,"
    asked.clear()
    main([str(tmp_path / "b"), "--sensor", "stim300", "--range", "10", "400", "--procedure", "six_positions",
          "--table", "hand"])  # fmt: skip
    assert asked == []


def test_a_table_and_a_procedure_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="three_axis_turns does not fit table hand"):
        main([str(tmp_path / "bench"), "--table", "hand"])
    assert not (tmp_path / "bench").exists()
