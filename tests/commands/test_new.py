"""An empty campaign: it names the table whose accuracy it takes, and says how to set other ranges."""

from pathlib import Path

import pytest

from pipeline.commands.new import main
from pipeline.config import load_campaign


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
    assert "docs/mounting.md" in (directory / "raw" / "U1" / "README.md").read_text()
    settings = directory / "campaign.yaml"
    text = settings.read_text()
    first = text.index("# models:")
    last = text.index("\n\n", first)
    uncommented = "\n".join(line.removeprefix("# ") for line in text[first:last].splitlines())
    settings.write_text(text[:first] + uncommented + text[last:])
    sensor = load_campaign({"campaign": str(directory)}).units["U1"].config["sensor"]
    assert [sensor["accelerometer"][k] for k in ("full_scale", "counts_per_unit")] == [4, 8192]
    assert [sensor["gyroscope"][k] for k in ("full_scale", "counts_per_unit")] == [500, 65.5]


def test_without_a_choice_the_table_of_the_procedure_is_written_down(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(tmp_path / "a")]) == 0
    assert "table acutronic: accuracy of its angles 0.00028 deg" in capsys.readouterr().out
    assert main([str(tmp_path / "b"), "--procedure", "multi_position"]) == 0
    assert "table hand: there is no table" in capsys.readouterr().out
    assert load_campaign({"campaign": str(tmp_path / "b")}).units["U1"].config["table"]["name"] == "hand"
