"""A diagnosis in plain words, on the terminal."""

import json
from pathlib import Path
from typing import Any

import pytest

from pipeline.app.commands.explain import find, main
from pipeline.core.errors import InputError, MissingInputError


def unwrapped(text: str) -> str:
    """Return the text of a terminal as one line."""
    return " ".join(text.split())


OVERRIDE = "effects.gyroscope=[g_sensitivity]"


def part(selected: list[str]) -> dict[str, Any]:
    entry = {
        "effect": "g_sensitivity",
        "delta_bic": 812.0,
        "p_value": 0.0,
        "parameters": {"G_xx": {"value": 0.101, "unit": "deg/s/g", "standard_uncertainty": 0.001}},
        "explained_share": 0.97,
        "held_out_error_before": 0.18,
        "held_out_error_after": 0.019,
        "look_alikes": [],
        "plausible": True,
    }
    return {
        "verdict": "missing_effect" if selected else "nothing_missing",
        "residual_over_noise": 9.1 if selected else 1.0,
        "selected": selected,
        "ranking": [entry] if selected else [],
        "not_observable": [],
        "unexplained": [],
        "next_experiment": "",
        "override": OVERRIDE if selected else "",
    }


@pytest.fixture
def results(tmp_path: Path) -> Path:
    folder = tmp_path / "results" / "bench" / "diagnoses"
    folder.mkdir(parents=True)
    for unit, selected in (("U1", []), ("U2", ["g_sensitivity"])):
        document = {"unit": unit, "accelerometer": None, "gyroscope": part(selected)}
        (folder / f"{unit}.json").write_text(json.dumps(document))
    return tmp_path / "results"


def test_units_are_told_in_the_order_of_the_campaign_without_those_that_failed(results: Path) -> None:
    folder = results / "bench"
    (folder / "diagnoses" / "U0.json").write_text((folder / "diagnoses" / "U1.json").read_text())
    (folder / "summary.csv").write_text("unit,status\nU2,ok\nU0,failed\nU1,ok\n")
    (folder / "failures.json").write_text(json.dumps([{"unit": "U0", "stage": "calibrate", "message": "no rests"}]))
    _, diagnoses, failures = find("bench", [], results)
    assert list(diagnoses) == ["U2", "U1"]
    assert list(failures) == ["U0"]


def test_a_parameter_beyond_the_data_sheet_is_told(results: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = results / "bench" / "calibrations"
    folder.mkdir()
    entry = {"parameter": "bias_x", "value": 90.0, "unit": "deg/s", "limit": 20.0, "ratio": 4.5, "likely_cause": "dust"}
    (folder / "U1.json").write_text(json.dumps({"accelerometer": None, "gyroscope": {"implausible": [entry]}}))
    main([str(results / "bench"), "U1"])
    said = "bias x is +90 deg/s, 4.5 times the data sheet's limit of 20 deg/s. Likely cause: dust."
    assert said in unwrapped(capsys.readouterr().out)


def test_what_the_rests_do_not_determine_is_told(results: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (results / "bench" / "calibrations").mkdir()
    reason = {"accelerometer": "no recording holds its readings"}
    lack = {
        "accelerometer": None,
        "not_calibrated": reason,
        "gyroscope": {"not_determined": "the rests do not determine it", "converged": False},
    }
    (results / "bench" / "calibrations" / "U1.json").write_text(json.dumps(lack))
    main([str(results / "bench"), "U1"])
    told = capsys.readouterr().out
    assert "  accelerometer\n    Not calibrated: no recording holds its readings.\n" in told
    assert "  Gyroscope: the rests do not determine it.\n" in told
    assert "  Gyroscope: the fit did not converge" in told


def test_an_error_far_above_the_noise_is_told_with_that_of_held_out_moves(
    results: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (results / "bench" / "validations").mkdir()
    judged = {"steps": [{"rms_error": 0.1}], "noise_floor": 0.01, "unit": "deg/s", "held_out": True}
    judged |= {"expected_rms_error": [0.0, 0.225]}
    moves = {"moves": 1, "rms_deg": {"before": 100.0, "after": 2.9}, "largest_expected_rms_deg": 8.8}
    document = {"accelerometer": None, "gyroscope": judged, "gravity_direction": moves}
    (results / "bench" / "validations" / "U1.json").write_text(json.dumps(document))
    main([str(results / "bench"), "U1"])
    said = unwrapped(capsys.readouterr().out)
    assert "0.1 deg/s, 10 times the noise floor." in said
    assert "explain an error of the magnitude of up to 0.225 deg/s: the uncertainty of the calibration" in said
    assert "explains an error this far above the noise, but does not show that the calibration is good" in said
    assert "direction of gravity by 2.9 deg (rms); noise and stated uncertainties explain at most 8.8 deg" in said


def test_why_the_error_is_not_that_of_held_out_motion_is_told(
    results: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = results / "bench" / "validations"
    folder.mkdir()
    judged = {"steps": [{"rms_error": 0.1}], "noise_floor": 0.05, "unit": "deg/s", "held_out": False}
    judged |= {"reason": "no reference", "notes": ["the expected error is not stated"]}
    (folder / "U1.json").write_text(json.dumps({"accelerometer": None, "gyroscope": judged}))
    main([str(results / "bench"), "U1"])
    said = capsys.readouterr().out
    assert (
        "Not judged on held-out motion: no reference.\n    Held-out error: the expected error is not stated.\n" in said
    )


def test_a_fit_that_passes_through_its_rests_states_no_error(results: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = results / "bench" / "validations"
    folder.mkdir()
    reason = "the fit passes through its 6 rests exactly"
    judged = {"unit": "deg/s", "held_out": False, "reason": reason, "noise_floor": None, "expected_rms_error": None}
    judged["steps"] = [{"name": "calibrated", "rms_error": None}]
    (folder / "U1.json").write_text(json.dumps({"unit": "U1", "gyroscope": judged}))
    assert main(["bench", "U1", "--results", str(results)]) == 0
    told = capsys.readouterr().out
    assert f"Not judged on held-out motion: {reason}." in told
    assert "The error of" not in told


def test_the_missing_effect_is_named_with_its_size_and_the_commands_that_add_it(
    results: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(results / "bench"), "U2"]) == 0
    said = capsys.readouterr().out
    assert said.startswith("U2\n")
    lines = [line.strip() for line in said.splitlines()]
    where = f"--results {results}"
    assert lines[lines.index("To add it:") + 1] == f"python -m pipeline add bench U2 gyroscope.g_sensitivity {where}"
    once = f"""snakemake --cores 2 --config campaign=bench 'unit_overrides={{U2: ["{OVERRIDE}"]}}' results={results}"""
    assert lines[lines.index("To add it for one run only:") + 1] == once
    said = unwrapped(said)
    for expected in ("misses g sensitivity", "9.1 times its noise", "0.101"):
        assert expected in said
    assert "The accelerometer was not calibrated" in said


def test_a_campaign_begins_with_its_verdicts_by_effect_and_tells_failed_units_with_their_cause(
    results: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    failure = {"unit": "U3", "stage": "ingest", "code": "bad_input", "message": "no number", "file": "raw/U3/a.csv:9"}
    (results / "bench" / "failures.json").write_text(json.dumps([failure]))
    assert main(["bench", "--results", str(results)]) == 0
    head = capsys.readouterr().out.splitlines()
    assert head == [
        "bench, 3 units: 1 ready, 1 effect missing, 1 failed",
        "failed: U3",
        "  correct the cause, then run the same command again",
        f"  snakemake --cores 2 --config campaign=bench results={results}",
        "effect missing: U2; gyroscope: g sensitivity",
        f"  python -m pipeline add bench U2 gyroscope.g_sensitivity --results {results}",
    ]
    assert main(["bench", "--all", "--results", str(results)]) == 0
    shown, *units = capsys.readouterr().out.split("\n\n")
    assert shown.splitlines() == head
    assert [text.splitlines()[0] for text in units] == ["U1", "U2", "U3"]
    assert main(["bench", "U3", "--results", str(results)]) == 0
    told = capsys.readouterr().out
    assert told == units[2]
    assert "failed in stage ingest (bad_input)" in told
    assert "raw/U3/a.csv:9: no number" in told


def test_a_unit_that_is_not_there_is_refused_with_those_that_are(results: Path) -> None:
    with pytest.raises(MissingInputError, match="no diagnosis of unit U7; there are those of U1, U2"):
        main([str(results / "bench"), "U7"])


def test_a_file_that_is_no_diagnosis_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x.json").write_text("[1, 2]")
    with pytest.raises(InputError, match="is no diagnosis"):
        main([str(tmp_path / "x.json")])


def test_the_held_out_error_of_the_run_is_told_beside_what_noise_alone_leaves(
    results: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = results / "bench" / "validations"
    folder.mkdir()
    gyroscope = {"unit": "deg/s", "noise_floor": 0.011, "steps": [{"rms_error": 4.0}, {"rms_error": 0.022}]}
    (folder / "U2.json").write_text(json.dumps({"accelerometer": None, "gyroscope": gyroscope}))
    assert main([str(results / "bench"), "U2"]) == 0
    assert "on held-out motion is 0.022 deg/s, 2 times the noise floor" in unwrapped(capsys.readouterr().out)


@pytest.mark.parametrize("units", [3, 400])
def test_a_campaign_takes_at_most_24_rows_and_a_command_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, units: int
) -> None:
    monkeypatch.setenv("COLUMNS", "70")
    verdicts = ["missing_effect", "unexplained", "left_by_method", "not_enough_data", "reference_in_doubt"]
    folder = tmp_path / "results" / "fleet"
    (folder / "diagnoses").mkdir(parents=True)
    lines = ["unit,status,gyroscope_verdict,gyroscope_selected,gyroscope_next_step,pass"]
    for i in range(units):
        effect = f"effect_{i % 13}" if i % 5 == 0 else ""
        lines.append(f"U{i},ok,{verdicts[i % 5]},{effect},record a longer turn about each axis in both senses,False")
        (folder / "diagnoses" / f"U{i}.json").write_text("{}")
    (folder / "summary.csv").write_text("\n".join(lines) + "\n")
    assert main(["fleet", "--results", str(tmp_path / "results")]) == 0
    told = capsys.readouterr().out.splitlines()
    assert len(told) <= 24
    commands = [line for line in told if line.lstrip().startswith(("python -m", "snakemake"))]
    assert len(commands) >= 3
    assert all(len(line) <= 70 for line in told if line not in commands)
    assert told[0].startswith(f"fleet, {units} units: 0 ready, ")
    if units == 400:
        assert told[-1].split()[:5] == ["python", "-m", "pipeline", "explain", "fleet"]
        assert "--all" in told[-1]


def test_the_faulty_sensor_is_told_first_without_its_upper_limits(
    results: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    limits = {"warm_up": {"b": {"value": 0.1, "unit": "g"}}}
    document = {"unit": "U2", "accelerometer": part([]) | {"upper_limit": limits}, "gyroscope": part(["g_sensitivity"])}
    (results / "bench" / "diagnoses" / "U2.json").write_text(json.dumps(document))
    said = []
    for option in ([], ["--limits"]):
        main(["bench", "U2", "--results", str(results), *option])
        said.append(capsys.readouterr().out)
        assert said[-1].index("\n  gyroscope\n") < said[-1].index("\n  accelerometer\n")
    assert ["Upper limits (95 %)" in text for text in said] == [False, True]
    assert "--limits adds the upper limits" in said[0]
