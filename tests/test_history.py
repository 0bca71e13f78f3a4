"""The history of runs: it grows with what changes, and with nothing else."""

import json
from pathlib import Path
from typing import Any

import pytest

from pipeline.core.errors import InputError
from pipeline.output.history import difference, digest, dropped, flat, of_units, read_history, record, unit_state
from pipeline.output.outcome import outcome

SETTINGS = {"campaign": "bench"}


def state(effects: list[str], error: float, **overrides: str) -> dict[str, Any]:
    """Return the state of a unit whose gyroscope is calibrated."""
    calibration = {
        "status": "ok",
        "config_sha256": json.dumps([effects, overrides]),
        "inputs": [{"file": "raw/U/gyro_x.csv", "sha256": "ab"}],
        "accelerometer": None,
        "gyroscope": {"effects": [{"name": name} for name in effects]},
    }
    validation = {"gyroscope": {"noise_floor": 0.01, "steps": [{"rms_error": 3.0}, {"rms_error": error}]}}
    return unit_state(calibration, validation, {"gyroscope": {"verdict": "unexplained"}}, overrides)


def test_a_recording_is_another_where_a_joined_file_is() -> None:
    def recordings(**joined: Any) -> dict[str, str]:
        inputs = [{"file": "acc.txt", "sha256": "ab", **joined}]
        return unit_state({"inputs": inputs, "accelerometer": None, "gyroscope": None}, None, None, {})["recordings"]

    found = [recordings(), *(recordings(joined=[{"file": "gyr.txt", "sha256": text}]) for text in ("cd", "ef"))]
    assert all(set(names) == {"acc.txt"} for names in found)
    assert len({names["acc.txt"] for names in found}) == 3


def test_a_run_is_recorded_with_the_units_that_it_changed_and_only_then(tmp_path: Path) -> None:
    units = {f"U{i}": state([], 0.12) for i in range(3)}
    assert [e["run"] for e in record(tmp_path, units, SETTINGS)] == [1]
    assert [e["run"] for e in record(tmp_path, units, SETTINGS)] == [1]
    units["U1"] = state(["g_sensitivity"], 0.011)
    record(tmp_path, units, SETTINGS)
    del units["U2"]
    record(tmp_path, units, SETTINGS)
    record(tmp_path, units, SETTINGS)
    entries = read_history(tmp_path)
    assert [sorted(e["units"]) for e in entries] == [["U0", "U1", "U2"], ["U1"], []]
    assert [e["gone"] for e in entries] == [[], [], ["U2"]]
    assert [(run, s["gyroscope"]["error"]) for run, s in of_units(entries)["U1"]] == [(1, 0.12), (2, 0.011)]
    assert sorted(f.name for f in (tmp_path / "history").iterdir()) == ["0001.json", "0002.json", "0003.json"]


def test_what_differs_is_told_in_words() -> None:
    before, after = state(["a"], 0.1, **{"filter.order": "1"}), state(["a", "b"], 0.1, **{"filter.order": "2"})
    assert difference(before, after).words("gyroscope") == ["+ b", "filter.order: 1 → 2"]
    assert difference(after, before).words() == ["− gyroscope.b", "filter.order: 2 → 1"]
    assert difference(before, before | {"recordings": "cd"}).words() == ["other recordings"]  # of an older version
    assert difference(before, before | {"recordings": {"raw/U/gyro_x.csv": "cd"}}).words() == [
        "other recordings: raw/U/gyro_x.csv"
    ]
    failed = unit_state({"status": "failed", "error": {"code": "bad_input"}}, None, None, {"filter.order": "1"})
    assert difference(before, failed).words() == ["not calibrated: bad_input"]
    assert difference(failed, before).words()[-1] == "calibrated again"
    assert difference(before, before | {"config_sha256": "x"}).words() == [
        "other values in the files of the configuration"
    ]
    assert difference(before, before | {"recordings": "cd", "config_sha256": "x"}).words() == [
        "other recordings",
        "other values in the files of the configuration",
    ]


def test_a_value_that_a_file_changes_is_named(tmp_path: Path) -> None:
    tables = [{"name": "bench", "seat_deg": seat, "zeros": [0.0] * 40} for seat in (0.5, 2.0)]
    for table in tables:
        found = state([], 0.1) | {"config": {"table": digest(table)}, "config_sha256": digest(table)}
        record(tmp_path, {"U1": found}, SETTINGS, {digest(table): flat(table), "other": {}})
    entries = read_history(tmp_path)
    assert [list(e["sections"]) for e in entries] == [[digest(t)] for t in tables]
    (_, before), (_, after) = of_units(entries)["U1"]
    words = ["other values in the files of the configuration: table.seat_deg: 0.5 → 2.0"]
    assert difference(before, after).words() == words
    assert record(tmp_path, {"U1": found}, SETTINGS) == entries


def test_a_run_that_drops_an_effect_is_told_with_what_it_cost_and_how_to_keep_it(tmp_path: Path) -> None:
    results = tmp_path / "bench"
    for units in (state([], 0.12), state(["g_sensitivity"], 0.011), state([], 0.12)):
        entries = record(results, {"U1": units}, SETTINGS)
    assert dropped(entries) == {("U1", 2): ["gyroscope.g_sensitivity"]}
    columns = "unit,status,accelerometer_verdict,accelerometer_selected,gyroscope_verdict,gyroscope_selected"
    columns += ",gyroscope_not_in_uncertainty"
    row = 'U1,ok,,,missing_effect,g_sensitivity,"time base, up to 1 % of the matrix"'
    (results / "summary.csv").write_text(f"{columns}\n{row}\nU2,failed,,,,,\n")
    (results / "validations").mkdir()
    reason = "no held-out recording holds readings of the gyroscope and a reference for them"
    (results / "validations" / "U1.json").write_text(
        json.dumps({"accelerometer": None, "gyroscope": {"reason": reason}})
    )
    (results / "calibrations").mkdir()
    lack = {"accelerometer": {"not_determined": "the rests do not determine it"}, "gyroscope": {"not_determined": ""}}
    (results / "calibrations" / "U1.json").write_text(json.dumps(lack))
    add = f"python -m pipeline add bench U1 gyroscope.g_sensitivity --results {tmp_path}"
    told = outcome(results, SETTINGS, of_this_run=True).splitlines()
    assert told[:3] == [
        f"gyroscope, {reason}: U1",
        "accelerometer, the rests do not determine it: U1",
        "gyroscope, U does not include time base, up to 1 % of the matrix: U1",
    ]
    assert told[3:] == [
        "U1, gyroscope: - g_sensitivity; held-out error of the magnitude 0.011 -> 0.12 deg/s, 12 times the noise floor",
        "U1: this run no longer has gyroscope.g_sensitivity, which run 2 had; to have it in every run:",
        f"  {add}",
        "effect missing: U1; gyroscope: g sensitivity",
        f"  {add}",
        f"2 units: 0 ready, 1 effect missing, 1 failed; look at {results}/index.html",
    ]
    assert len(outcome(results, SETTINGS, of_this_run=False).splitlines()) == len(told) - 3


@pytest.mark.parametrize("content", ["", "[]", '{"run": "one", "units": {}}'])
def test_a_file_that_is_no_history_is_refused_by_name(tmp_path: Path, content: str) -> None:
    (tmp_path / "history").mkdir()
    (tmp_path / "history" / "0001.json").write_text(content)
    with pytest.raises(InputError, match=r"0001\.json: is no history of runs: remove it"):
        read_history(tmp_path)


def test_the_unit_that_a_run_changed_most_is_told_first(tmp_path: Path) -> None:
    results = tmp_path / "bench"
    record(results, {f"U{i}": state([], 0.1) for i in range(3)}, SETTINGS)
    record(results, {f"U{i}": state(["a"], error) for i, error in enumerate((0.08, 0.5, 0.04))}, SETTINGS)
    (results / "summary.csv").write_text("unit,status\n" + "".join(f"U{i},ok\n" for i in range(3)))
    told = [line for line in outcome(results, SETTINGS, of_this_run=True).splitlines() if "held-out error" in line]
    assert [line.partition(",")[0] for line in told] == ["U1", "U2", "U0"]  # factors 5, 2.5 and 1.25
