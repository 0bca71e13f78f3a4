"""Adding effects to units and removing them again: files that keep their content, and refusals that name the place."""

import json
from pathlib import Path
from typing import Any

import pytest

from pipeline.app.commands import add
from pipeline.app.commands.add import set_override
from pipeline.app.config.campaign import load_campaign
from pipeline.app.steps.diagnose import effect_file
from pipeline.core.errors import ConfigurationError, MissingInputError, PipelineError
from pipeline.physics.effects import read_effect_file

SHEET = """unit,serial,overrides
U1,S1,
U2,S2,"effects.gyroscope=[time_offset]"
U3,S3,
"""
KEY, NEW = "effects.gyroscope", "effects.gyroscope=[a,b]"


@pytest.fixture
def campaign(tmp_path: Path) -> Path:
    directory = tmp_path / "my bench"
    (directory / "devices").mkdir(parents=True)
    (directory / "units.csv").write_text(SHEET)
    (directory / "campaign.yaml").write_text('overrides: ["effects.accelerometer=[lever_arm]"]\n')
    (directory / "devices" / "S3.yaml").write_text("overrides: [filter.order=1]\n")
    return directory


def effects(campaign: Path, unit: str) -> dict[str, list[str]]:
    found: dict[str, list[str]] = load_campaign({"campaign": str(campaign)}).units[unit].config.effects.json_value
    return found


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("", f'overrides:\n  - "{NEW}"\n'),
        ("# a note\n", f'# a note\noverrides:\n  - "{NEW}"\n'),
        ("overrides:\n- filter.order=1  # why\n# end\n", f'overrides:\n- filter.order=1  # why\n- "{NEW}"\n# end\n'),
        ("overrides: [filter.order=1]  # why\n", f'overrides: [filter.order=1, "{NEW}"]  # why\n'),
        ("overrides: filter.order=1\n", f'overrides: ["filter.order=1", "{NEW}"]\n'),
        ("overrides:\n  - 'effects.gyroscope=[a]' # old\n", f'overrides:\n  - "{NEW}" # old\n'),
        ('overrides: ["effects.gyroscope=[a]", b=1]\n', f'overrides: ["{NEW}", b=1]\n'),
    ],
)
def test_an_override_is_put_into_a_file_that_keeps_the_rest(before: str, after: str) -> None:
    assert set_override(before, KEY, NEW, "U1.yaml") == after


def test_an_effect_of_the_bench_is_said_to_be_left_by_apply(campaign: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert add.main([str(campaign), "U1", "gyroscope.g_sensitivity", "gyroscope.low_pass_lag", "--no-run"]) == 0
    said = capsys.readouterr().out
    assert "note: low_pass_lag: an effect of the bench" in said
    assert "apply does not correct it in field logs" in said
    assert add.main([str(campaign), "U1", "gyroscope.g_sensitivity", "--no-run"]) == 0
    assert "note:" not in capsys.readouterr().out


def test_a_form_that_cannot_be_edited_in_place_is_refused() -> None:
    with pytest.raises(ConfigurationError, match=r"U1.yaml: cannot be edited in place: write 'eff"):
        set_override("overrides: [\n  a=1  # one\n]\n", KEY, NEW, "U1.yaml")


def test_what_was_added_is_removed_and_the_file_is_as_before(
    campaign: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = campaign / "devices" / "U1.yaml"
    words = [str(campaign), "U1", "gyroscope.g_sensitivity", "accelerometer.hysteresis", "--no-run"]
    assert add.main(words) == 0
    assert effects(campaign, "U1") == {"accelerometer": ["lever_arm", "hysteresis"], "gyroscope": ["g_sensitivity"]}
    assert effects(campaign, "U3") == {"accelerometer": ["lever_arm"], "gyroscope": []}
    assert f"then: snakemake --cores 2 --config 'campaign={campaign}'" in capsys.readouterr().out
    assert add.main(words) == 0
    assert "has g_sensitivity already" in capsys.readouterr().out
    assert add.remove(words) == 0
    assert not file.exists()
    assert (campaign / "devices").exists()  # S3.yaml is in it

    file.write_text("# the first of its lot\noverrides:\n  - filter.order=1  # as measured\n")
    before = file.read_text()
    add.main(words)
    add.remove(words)
    assert file.read_text() == before
    add.remove([str(campaign), "U1", "accelerometer.lever_arm", "--no-run"])  # of campaign.yaml
    assert effects(campaign, "U1")["accelerometer"] == []


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["U1", "gyroscope.g_sensitivit"], "no effect is called 'g_sensitivit'; nearest: g_sensitivity"),
        (["U1", "accelerometer.g_sensitivity"], "applies to the gyroscope only"),
        (["U1", "gyros.g_sensitivity"], "no sensor is called 'gyros'; nearest: gyroscope"),
        (["U1", "g_sensitivity"], "SENSOR.EFFECT is expected"),
        (["U1"], "at least one SENSOR.EFFECT"),
        (["U4", "gyroscope.g_sensitivity"], "units.csv: no unit 'U4'"),
        (["U2", "gyroscope.g_sensitivity"], "units.csv:3: the column overrides sets effects.gyroscope=[time_offset]"),
        (
            ["U1", "gyroscope.g_sensitivity", "--config", "overrides=effects.gyroscope=[hysteresis]"],
            "--config overrides=effects.gyroscope=[hysteresis] is stronger",
        ),
        (["U3", "gyroscope.g_sensitivity", "--config", "overrides=effects.gyroscope=auto"], "leave it out"),
        (["--missing"], "run the campaign first"),
    ],
)
def test_what_would_have_no_effect_is_refused_with_the_place_and_nothing_is_written(
    campaign: Path, words: list[str], told: str
) -> None:
    with pytest.raises(PipelineError) as refused:
        add.main([str(campaign), *words, "--no-run", "--results", str(campaign / "results")])
    assert told in str(refused.value)
    assert [f.name for f in (campaign / "devices").iterdir()] == ["S3.yaml"]


def test_each_unit_gets_what_its_own_diagnosis_found_missing(campaign: Path) -> None:
    results = campaign / "results"
    (results / campaign.name).mkdir(parents=True)
    columns = "unit,accelerometer_verdict,accelerometer_selected,gyroscope_verdict,gyroscope_selected\n"
    rows = "U1,nothing_missing,,missing_effect,g_sensitivity;time_offset\nU2,,,unexplained,hysteresis\n"
    rows += "U3,missing_effect,hysteresis,missing_effect,g_sensitivity\n"
    (results / campaign.name / "summary.csv").write_text(columns + rows)
    words = [str(campaign), "--no-run", "--results", str(results), "--missing"]
    assert add.main([*words, "g_sensitivity"]) == 0
    assert [effects(campaign, u)["gyroscope"] for u in ("U1", "U2", "U3")] == [
        ["g_sensitivity"],
        ["time_offset"],
        ["g_sensitivity"],
    ]
    assert add.main(words) == 0
    assert effects(campaign, "U1")["gyroscope"] == ["g_sensitivity", "time_offset"]
    assert effects(campaign, "U3")["accelerometer"] == ["lever_arm", "hysteresis"]
    with pytest.raises(ConfigurationError, match="lever_arm is missing in no unit"):
        add.main([*words, "lever_arm"])


def test_a_suggested_formula_is_written_to_the_campaign_and_added(campaign: Path) -> None:
    diagnoses = campaign / "results" / campaign.name / "diagnoses"
    diagnoses.mkdir(parents=True)
    for unit, cycles in (("U1", 5), ("U3", 7)):
        terms = {"A": {"formula": f"cos({cycles} * radians(angle))", "unit": "deg/s"}}
        definition = {"name": "unknown_angle", "owner": "table", "sensors": ["gyroscope"], "meaning": "A gear."}
        part = {"suggested_effect": definition | {"terms": terms}, "suggested_file": f"{unit}_gyroscope_unknown.yaml"}
        (diagnoses / part["suggested_file"]).write_text(effect_file(part["suggested_effect"], unit))
        (diagnoses / f"{unit}.json").write_text(json.dumps({"accelerometer": None, "gyroscope": part}))
    words = ["--suggested", "--no-run", "--results", str(campaign / "results")]
    assert add.main([str(campaign), "U1", *words]) == 0
    assert add.main([str(campaign), "U1", *words]) == 0
    assert add.main([str(campaign), "U3", *words]) == 0
    assert effects(campaign, "U1")["gyroscope"] == ["unknown_angle"]
    assert effects(campaign, "U3")["gyroscope"] == ["unknown_angle_2"]
    written = sorted(file.name for file in (campaign / "effects").iterdir())
    assert written == ["unknown_angle.yaml", "unknown_angle_2.yaml"]
    assert read_effect_file(campaign / "effects" / "unknown_angle_2.yaml").name == "unknown_angle_2"
    with pytest.raises(MissingInputError, match="run the campaign first"):
        add.main([str(campaign), "U2", *words])
    with pytest.raises(ConfigurationError, match="takes a unit and no effects"):
        add.main([str(campaign), "U1", "gyroscope.time_offset", *words])


def test_a_suggested_formula_that_cannot_be_added_leaves_no_file(campaign: Path) -> None:
    diagnoses = campaign / "results" / campaign.name / "diagnoses"
    diagnoses.mkdir(parents=True)
    definition: dict[str, Any] = {
        "name": "unknown_time",
        "owner": "recording",
        "sensors": ["gyroscope"],
        "meaning": "A step.",
    }
    definition["terms"] = {"A": {"formula": "step(time - 5)", "unit": "deg/s"}}
    (diagnoses / "U2_gyroscope_unknown.yaml").write_text(effect_file(definition, "U2"))
    part = {"suggested_effect": definition, "suggested_file": "U2_gyroscope_unknown.yaml"}
    (diagnoses / "U2.json").write_text(json.dumps({"accelerometer": None, "gyroscope": part}))
    with pytest.raises(PipelineError, match="the column overrides sets"):
        add.main([str(campaign), "U2", "--suggested", "--no-run", "--results", str(campaign / "results")])
    assert not list((campaign / "effects").glob("*"))
