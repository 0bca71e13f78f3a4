"""Corrupted units end refused, doubtful, marked or right, never silently wrong."""

from __future__ import annotations

import json
from argparse import Namespace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from all_ways import single_ways
from judged import DOUBTFUL, REFUSED, RIGHT, SILENT, judge
from run import drawn, run
from sheets import judged_unit
from unit_copy import Copy, NotApplicableError, Truth
from ways_of_benches import exchanged_files
from whole_run import run_campaign

if TYPE_CHECKING:
    from pathlib import Path

# Of the draw with seed 1, a class each, calibrated by one chain of stages; most of them were silent errors once.
TENTH = (
    "u0001", "u0013", "u0036", "u0037", "u0046", "u0045", "u0062", "u0076", "u0086", "u0100", "u0124", "u0145", "u0148",
    "u0177", "u0187", "u0123", "u0276",
)  # fmt: skip


def _options(**given: object) -> Namespace:
    return Namespace(**{"units": 0, "start": 0, "seed": 1, "good": 0, "only": [], "kind": "", **given})


def test_a_tenth_of_the_ways_leaves_no_silent_error_and_good_units_right(tmp_path: Path) -> None:
    copies = drawn(_options(units=len(single_ways()), only=TENTH)) + drawn(_options(good=2))
    judgements = run(copies, tmp_path, lambda campaign, results: run_campaign(campaign, results=results))
    assert len({j.kind for j in judgements}) == len(TENTH) + 1
    assert [j.line for j in judgements if j.outcome == SILENT] == []
    assert {j.outcome for j in judgements if j.unit.startswith("good")} == {RIGHT}


@pytest.mark.parametrize(
    ("number", "outcomes"), [(4, [REFUSED]), (10, [REFUSED]), (8, [DOUBTFUL, DOUBTFUL]), (19, [RIGHT])]
)
def test_corrupted_sheets_leave_no_silent_error(number: int, outcomes: list[str]) -> None:
    assert [outcome for outcome, _ in judged_unit(number, 3)] == outcomes


def test_there_are_at_least_150_ways() -> None:
    names = {(way.kind, way.name) for way in single_ways()}
    assert len(names) == len(single_ways()) >= 150


@pytest.mark.parametrize(("first", "second"), [("static", "accel_x"), ("accel_x", "static")])
def test_an_exchange_with_a_recording_that_the_unit_lacks_is_not_applicable(first: str, second: str) -> None:
    tables = {"accel_x": {"time_s": np.zeros(1)}}
    with pytest.raises(NotApplicableError, match="no static"):
        exchanged_files(Copy("C1", "U1", "mpu6050", "csv", 0.01, tables, {}), first, second)
    assert list(tables) == ["accel_x"]


@pytest.mark.parametrize(("effects", "outcome"), [([{"name": "quadratic_nonlinearity"}], RIGHT), ([], SILENT)])
def test_on_a_table_a_fit_of_effects_is_in_the_frame_of_the_turns(
    tmp_path: Path, effects: list[dict[str, str]], outcome: str
) -> None:
    matrix, U = np.eye(3) + 0.01 * np.eye(3, k=1), np.full((3, 3), 1e-4)
    part = {"bias": [0.0] * 3, "matrix": matrix.tolist(), "effects": effects}
    part["expanded_uncertainty"] = {"bias": U[0].tolist(), "matrix": U.tolist()}
    methods = {"accelerometer": "nonlinear_least_squares", "gyroscope": "staged"}
    calibration = {"status": "ok", "table": "acutronic", "methods": methods, "accelerometer": part}
    documents = {
        "calibrations": calibration,
        "diagnoses": {"accelerometer": {"verdict": "nothing_missing", "selected": []}},
    }
    for folder, document in (documents | {"validations": {}}).items():
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "C1.json").write_text(json.dumps(document), encoding="utf-8")
    truth = {"accelerometer": Truth(np.zeros(3), matrix)}
    assert [j.outcome for j in judge(Copy("C1", "U1", "mpu6050", "csv", 0.01, {}, truth), tmp_path)] == [outcome]


@pytest.mark.corruption
@pytest.mark.parametrize(("seed", "start"), [(1, 0), (2, 0), (3, 1000)])
def test_170_ways_leave_no_silent_error(tmp_path: Path, seed: int, start: int) -> None:
    judgements = run(drawn(_options(units=170, seed=seed, start=start, good=12)), tmp_path)
    assert [j.line for j in judgements if j.outcome == SILENT] == []
