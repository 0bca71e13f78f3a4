"""``python -m pipeline plan``: options in, tables or JSON out."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest

from pipeline.__main__ import main
from pipeline.physics.effects import forget

if TYPE_CHECKING:
    from pathlib import Path

QUICK = ["--step", "15", "--validation", "0", "--static", "60"]
OWN = """\
name: gear_mesh
owner: table
sensors: [gyroscope]
meaning: The gear of the table pushes five times a turn.
terms:
  A: {formula: "cos(5 * radians(angle))", unit: deg/s}
limits: {A: 0.1}
"""


def _out(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert main(["plan", *arguments]) == 0
    return capsys.readouterr().out


def test_a_plan_is_printed_with_sizes_and_reasons(capsys: pytest.CaptureFixture[str]) -> None:
    lines = _out(capsys, *QUICK, "--no-extra").splitlines()
    assert lines[0].startswith("mpu6050 on acutronic, three_axis_turns: ")
    assert "min at the table" in lines[0]
    lever = next(line.split() for line in lines if line.strip().startswith("lever_arm"))
    assert lever[2] == "m"
    assert 0.0 < float(lever[1]) < 0.1
    assert any(line.startswith("  scale_factor_asymmetry") and "one direction" in line for line in lines)
    assert max(line.index("of limit") for line in lines if "of limit" in line) < 80


def test_two_procedures_stand_side_by_side(capsys: pytest.CaptureFixture[str]) -> None:
    lines = _out(capsys, *QUICK, "--against", "--both-directions").splitlines()
    assert lines[0].startswith("A: mpu6050")
    assert lines[1].startswith("B: mpu6050")
    asymmetry = [line.split() for line in lines if line.strip().startswith("scale_factor_asymmetry")]
    assert asymmetry[1][1] == "-"
    assert float(asymmetry[1][2]) < 4e-3
    tilt = next(line.split() for line in lines if line.strip().startswith("table_tilt"))
    assert float(tilt[-1]) < 1.0


def test_a_machine_reads_the_same_plan_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    plan = json.loads(_out(capsys, *QUICK, "--sensor", "stim300", "--no-extra", "--json"))
    assert plan["sensor"] == "stim300"
    assert plan["extra"] == []
    entry = next(e for e in plan["accelerometer"]["effects"] if e["effect"] == "lever_arm")
    assert entry["smallest"] == pytest.approx(0.2 * entry["share_of_limit"])
    assert entry["smallest"] < entry["almost_sure"]


def test_an_effect_of_the_users_own_is_planned(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    file = tmp_path / "gear_mesh.yaml"
    file.write_text(OWN, encoding="utf-8")
    try:
        plan = json.loads(_out(capsys, *QUICK, "--no-extra", "--json", "--effect", str(file)))
    finally:
        forget()
    entry = next(e for e in plan["gyroscope"]["effects"] if e["effect"] == "gear_mesh")
    assert 0.0 < entry["smallest"] < 0.1
    assert entry["unit"] == "deg/s"


@pytest.mark.parametrize("procedure", [QUICK, ["--procedure", "multi_position"]])
def test_an_effect_without_limits_is_planned_in_its_unit(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, procedure: list[str]
) -> None:
    file = tmp_path / "sag.yaml"
    terms = 'terms: {d: {formula: "fz ** 3 - 0.6 * fz", unit: g}}'
    file.write_text(
        f"name: sag\nowner: sensor\nsensors: [accelerometer]\nmeaning: It sags.\n{terms}\n", encoding="utf-8"
    )
    try:
        lines = _out(capsys, *procedure, "--no-extra", "--effect", str(file)).splitlines()
    finally:
        forget()
    words = next(line.split() for line in lines if line.strip().startswith("sag "))
    assert words[2:5] == ["g", "no", "limit"]
    assert 1e-5 < float(words[1]) < 1e-2


def test_a_campaigns_description_is_planned(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    course = "course: {step_deg: 15.0, validation_s: 0.0, static_s: 60.0, both_directions: true}"
    text = f"defaults: {{sensor: stim300, {course}}}\nunits:\n- unit: A\n- unit: B\n  sensor: mpu6050\n"
    (tmp_path / "simulation.yaml").write_text(text, encoding="utf-8")
    plan = json.loads(_out(capsys, "--campaign", str(tmp_path), "--unit", "B", "--no-extra", "--json"))
    given = json.loads(_out(capsys, *QUICK, "--both-directions", "--no-extra", "--json"))
    assert plan == given


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--sensor", "mpu9999"], "no sensor is called 'mpu9999'; known: adis16448, adis16470"),
        (["--procedure", "dance"], "no procedure is called 'dance'"),
        (["--rate", "0"], "rates_dps.0 is 0.0; it must be greater than 0"),
        (["--samples", "100"], "cannot be recorded in 100 samples"),
        (["--unit", "A"], "--unit chooses a unit of a description"),
        (["--against", "--frobnicate"], "--frobnicate is not known"),
        (["--against", "--rate fast"], "invalid float value: 'fast'"),
        (["--campaign", "."], "has no simulation.yaml"),
        (["--from", "nowhere.yaml"], "nowhere.yaml: this file does not exist"),
    ],
)
def test_wrong_options_are_one_line_and_exit_code_2(
    capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    assert main(["plan", "--no-extra", *QUICK[:2], *arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith("python -m pipeline plan: ")
    assert message in error
    assert error.count("\n") == 1


def test_simulate_warns_of_the_hidden_effects_that_the_plan_cannot_show_and_writes_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    course = ["--step", "30", "--validation", "0", "--static", "20"]
    hidden = ["gyroscope.scale_factor_asymmetry=0.002", "gyroscope.g_sensitivity", "table_tilt", "gyroscope.table_tilt"]
    words = [word for effect in hidden for word in ("--effect", effect)]
    assert main(["simulate", str(tmp_path), "--quiet", *course, *words]) == 0
    warned = dict(
        line.removeprefix("warning: the recordings cannot show ").split(": ", 1)
        for line in capsys.readouterr().err.splitlines()
    )
    assert list(warned) == ["gyroscope.scale_factor_asymmetry", "gyroscope.table_tilt"]
    plan = json.loads(_out(capsys, *course, "--no-extra", "--json"))
    reasons = {entry["effect"]: entry["reason"] for entry in plan["gyroscope"]["not_observable"]}
    assert warned == {f"gyroscope.{name}": reasons[name] for name in ("scale_factor_asymmetry", "table_tilt")}
    truth = json.loads((tmp_path / "truth" / "U001.json").read_text(encoding="utf-8"))
    assert set(truth["gyroscope"]["effects"]) == {"scale_factor_asymmetry", "g_sensitivity", "table_tilt"}
    assert main(["simulate", str(tmp_path), "--quiet", "--effect", "gyro.table_tilt"]) != 0


def test_a_plan_fits_100_columns(capsys: pytest.CaptureFixture[str]) -> None:
    for more in ([], ["--against", "--both-directions"]):
        lines = _out(capsys, *QUICK, *more).splitlines()
        assert max(map(len, lines)) <= 100
        assert any("warm_up" in line for line in lines)
