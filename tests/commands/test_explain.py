"""A diagnosis in plain words, on the terminal."""

import json
from pathlib import Path
from typing import Any

import pytest

from pipeline.commands.explain import main
from pipeline.errors import InputError, MissingInputError


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
        "override": "effects.gyroscope=[g_sensitivity]" if selected else "",
    }


@pytest.fixture
def results(tmp_path: Path) -> Path:
    folder = tmp_path / "results" / "bench" / "diagnoses"
    folder.mkdir(parents=True)
    for unit, selected in (("U1", []), ("U2", ["g_sensitivity"])):
        document = {"unit": unit, "accelerometer": None, "gyroscope": part(selected)}
        (folder / f"{unit}.json").write_text(json.dumps(document))
    return tmp_path / "results"


def test_the_missing_effect_is_named_with_its_size_and_its_override(
    results: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(results / "bench"), "U2"]) == 0
    said = capsys.readouterr().out
    assert said.startswith("U2\n")
    for expected in ("misses g sensitivity", "9.1 times the noise", "0.101", "effects.gyroscope=[g_sensitivity]"):
        assert expected in said
    assert "The accelerometer was not calibrated" in said


def test_a_campaign_is_found_by_its_name_and_told_unit_by_unit(
    results: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["bench", "--results", str(results)]) == 0
    said = capsys.readouterr().out
    assert said.index("U1\n") < said.index("U2\n")


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
    assert "errs by 0.022 deg/s rms of the magnitude, 2 times what noise alone leaves" in capsys.readouterr().out
