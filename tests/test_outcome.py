"""Commands that a user pastes: bash hands over what was meant, and Snakemake reads it so."""

import json
import shlex
import subprocess
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from snakemake.cli import parse_config

from pipeline.core.verdicts import Problem
from pipeline.output.outcome import (
    _reasons,
    add_command,
    as_overrides,
    command_of,
    commands_of,
    found_mountings,
    once_command,
    outcome,
    run_command,
)

TEXT = st.text(
    st.characters(codec="utf-8", exclude_characters="\0\n\r\x85\u2028\u2029", exclude_categories=("Cc", "Cs"))
)


def words(command: str) -> list[str]:
    """Return what a program gets that bash starts by a command."""
    script = 'python() { printf "%s\\0" "$@"; }; snakemake() { python "$@"; }; ' + command
    out = subprocess.run(["bash", "-c", script], check=True, capture_output=True).stdout.decode()
    return out.split("\0")[:-1]


@pytest.mark.parametrize(
    "settings",
    [
        {"campaign": "demo"},
        {"campaign": "my bench's $HOME"},
        {"campaign": "c", "overrides": ["filter=rc_low_pass", "effects.gyroscope=[a,b]"], "python_effects": ["x y.py"]},
        {"campaign": "c", "unit_overrides": {"001": ["filter.order=1"], "on": ["a.b='x, y'"]}},
    ],
)
def test_bash_and_snakemake_read_the_settings_that_were_written(settings: dict[str, object]) -> None:
    command = words(run_command(settings))
    assert command[:3] == ["--cores", "2", "--config"]
    assert parse_config(command[3:]) == settings


@given(st.lists(TEXT, min_size=1, max_size=3))
def test_any_override_survives_the_quoting(overrides: list[str]) -> None:
    command = run_command({"campaign": "c", "overrides": overrides})
    (*_, last) = shlex.split(command)
    assert parse_config([last]) == {"overrides": overrides}


def test_effects_that_one_run_had_are_kept_by_the_command_that_adds_more() -> None:
    settings = {
        "campaign": "my bench",
        "unit_overrides": {"U1": ["filter.order=1", "effects.gyroscope=[a,b]"], "U2": ["filter.order=3"]},
    }
    command = words(add_command({**settings, "results": "/out"}, "U1", ["gyroscope.c"]))
    assert command[:8] == ["-m", "pipeline", "add", "my bench", "U1", "gyroscope.a", "gyroscope.b", "gyroscope.c"]
    assert command[8:11] == ["--results", "/out", "--config"]
    assert parse_config(command[11:]) == {"unit_overrides": {"U2": ["filter.order=3"], "U1": ["filter.order=1"]}}
    once = words(once_command(settings, "U1", ["effects.gyroscope=[a,b,c]"]))
    assert parse_config(once[3:])["unit_overrides"]["U1"] == ["filter.order=1", "effects.gyroscope=[a,b,c]"]
    settings["unit_overrides"] = {"U1": ["effects.gyroscope=auto"]}
    command = words(add_command(settings, "U1", ["gyroscope.c"]))
    assert command[3:] == ["my bench", "U1", "gyroscope.c"]


def test_where_an_override_of_all_units_sets_the_effects_the_command_is_for_one_run() -> None:
    settings = {
        "campaign": "c",
        "overrides": ["filter.order=1", "effects.gyroscope=[a]"],
        "unit_overrides": {"U1": ["effects.accelerometer=[d]"]},
    }
    command = words(add_command(settings, "U1", ["gyroscope.c", "accelerometer.e"]))
    own = {"U1": ["effects.accelerometer=[d,e]", "effects.gyroscope=[a,c]"]}
    assert parse_config(command[3:]) == settings | {"unit_overrides": own}
    of_two = command_of(Problem("missing_effect", "", ["U1", "U2"], None, "", ("gyroscope.c",)), settings)
    assert parse_config(words(of_two)[-2:])["overrides"] == ["filter.order=1"]
    alone = words(add_command(settings, "U2", ["accelerometer.e"]))
    assert alone[:6] == ["-m", "pipeline", "add", "c", "U2", "accelerometer.e"]


def test_a_setting_of_zero_stays_in_the_command() -> None:
    assert words(run_command({"campaign": "c", "publish_limit": 0, "lot": None}))[3:] == [
        "campaign=c",
        "publish_limit=0",
    ]


@pytest.mark.parametrize(
    ("verdict", "names", "verb"),
    [
        ("missing_effect", ["a"], "add it"),
        ("missing_effect", ["a", "b"], "add them"),
        ("unexplained", ["a"], "try it"),
        ("unexplained", ["a", "b"], "try them"),
    ],
)
def test_effects_that_do_not_explain_the_residual_are_offered_as_a_trial(
    verdict: str, names: list[str], verb: str
) -> None:
    part = {"verdict": verdict, "selected": names, "override": f"effects.gyroscope=[{','.join(names)}]"}
    offered = commands_of(part, "gyroscope", "U1", {"campaign": "c"})
    assert offered["verb"] == verb
    assert words(offered["add"])[2:] == ["add", "c", "U1", *(f"gyroscope.{name}" for name in names)]


def test_the_closing_lines_name_a_sensor_that_has_no_calibration(tmp_path: Path) -> None:
    document = {"accelerometer": {}, "gyroscope": None, "not_calibrated": {"gyroscope": "6 moves are needed"}}
    (tmp_path / "calibrations").mkdir()
    (tmp_path / "calibrations" / "U1.json").write_text(json.dumps(document))
    assert _reasons(tmp_path, ["U1", "U2"]) == ["gyroscope, not calibrated: 6 moves are needed: U1"]


def test_the_closing_lines_name_a_fit_that_did_not_converge(tmp_path: Path) -> None:
    folder = tmp_path / "calibrations"
    folder.mkdir()
    (folder / "U1.json").write_text(json.dumps({"accelerometer": {"converged": False}, "gyroscope": None}))
    (folder / "U2.json").write_text(json.dumps({"accelerometer": {"converged": True}, "gyroscope": {}}))
    (line,) = _reasons(tmp_path, ["U1", "U2"])
    assert line.startswith("accelerometer, the fit did not converge")
    assert line.endswith(": U1")


def test_units_of_one_bench_share_the_settings_of_their_mounting_with_the_mean_of_their_zeros() -> None:
    def of_table(zero: str) -> dict[str, tuple[tuple[str, ...], ...]]:
        way = ("table.sense=-1", f"table.zero_deg={zero}")
        return dict.fromkeys(("accel_x", "gyro_x"), (way, ("sensor.axis_map=[-y,+x,+z]",)))

    faces = {"accel_x": (("procedure.recordings.accel_x.up=-y",),)}
    found = [("U1", of_table("-44.20")), ("U2", {}), ("U3", of_table("-44.26")), ("U4", of_table("-44.60"))]
    groups = found_mountings([*found, ("U5", faces), ("U6", faces)])
    assert [(group.units, group.recordings) for group in groups] == [
        (["U1", "U3"], ["accel_x", "gyro_x"]),
        (["U4"], ["accel_x", "gyro_x"]),
        (["U5", "U6"], ["accel_x"]),
    ]
    zeros = ["-44.23", "-44.60"]
    assert [group.ways for group in groups[:2]] == [[[*way] for way in of_table(z)["accel_x"]] for z in zeros]
    text = as_overrides(groups[0].ways)
    assert yaml.safe_load(text) == {"overrides": ["table.sense=-1", "table.zero_deg=-44.23"]}
    assert yaml.safe_load(text.partition("or, in place of these:\n")[2].replace("  # - ", "- ")) == [
        "sensor.axis_map=[-y,+x,+z]"
    ]


@pytest.mark.parametrize("units", [1, 10, 11, 300])
def test_the_last_15_lines_name_each_unit_with_a_missing_effect_or_what_lists_them(tmp_path: Path, units: int) -> None:
    results = tmp_path / "fleet"
    results.mkdir()
    head = "unit,status,gyroscope_verdict,gyroscope_selected,gyroscope_not_in_uncertainty"
    rows = [f"U{i},ok,missing_effect,effect_{i % 4},source {i}" for i in range(units)]
    (results / "summary.csv").write_text("\n".join([head, *rows, *(f"V{i},ok,unexplained,,x{i}" for i in range(30))]))
    last = outcome(results, {"campaign": "fleet"}, of_this_run=False).splitlines()[-15:]
    if units <= 10:
        for i in range(units):
            assert any(f"U{i}" in line.replace(";", ",") and f"effect {i % 4}" in line for line in last)
    else:
        assert f"effect missing: {units} units; to list them:" in last
        assert f"  python -m pipeline explain fleet --all --results {tmp_path}" in last
    assert last[-2].startswith("  python -m pipeline add fleet ")
    assert last[-1].endswith("look at " + str(results / "index.html"))
