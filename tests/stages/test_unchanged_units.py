"""What is taken from the last run: units whose settings, code and files of earlier stages are as they were."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest

from pipeline.app.results_folder import repetitions
from pipeline.app.steps import batch, calibration
from pipeline.app.steps import prior as prior_stage
from pipeline.core.pack import Pack, new_pack
from pipeline.core.settings import Settings

if TYPE_CHECKING:
    from pathlib import Path

HERE = {"ingest": {}, "filter": {}, "accelerometer": {}, "gyroscope": {}, "validate": {}}


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):  # noqa: ANN201
    """Return a function that runs the diagnosis of two units, and returns the units that were computed."""
    computed: list[str] = []

    def diagnose(_: object, __: batch.Job, unit: str, settings: dict) -> dict:
        computed.append(unit)
        return {f"{unit}.json": {"found": settings.diagnosis.depth}}

    monkeypatch.setattr(batch, "_made", diagnose)
    monkeypatch.setattr(batch, "hold_as_job", lambda _: None)

    def run_job(files: dict[str, dict[str, str]] = HERE, code: str = "a", again: int = 0, **effects: int) -> list[str]:
        output = tmp_path / "results" / "batches" / "b" / "diagnose.zip"
        output.unlink(missing_ok=True)  # as Snakemake does
        (tmp_path / "results" / "configs").mkdir(parents=True, exist_ok=True)
        config = tmp_path / "results" / "configs" / "diagnose.json"
        units = {u: {"diagnosis": {"depth": "full" if effects.get(u, 0) else "standard"}} for u in ("U1", "U10")}
        config.write_text(json.dumps({"units": units, "code": code} | ({"again": again} if again else {})))
        argv = ["--config", str(config), "--output", str(output)]
        for stage, changed in files.items():
            with new_pack(tmp_path / f"{stage}.zip") as add:
                add({f"{u}.json": changed.get(u, "x").encode() for u in ("U1", "U10")})
            argv += [f"--{stage}", str(tmp_path / f"{stage}.zip")]
        computed.clear()
        batch.main("diagnose", argv)
        depths = ["full" if effects.get(u, 0) else "standard" for u in ("U1", "U10")]
        assert [Pack(output).json(f"{u}.json")["found"] for u in ("U1", "U10")] == depths
        return list(computed)

    return run_job


def test_only_units_whose_inputs_have_changed_are_computed(run, tmp_path: Path) -> None:  # noqa: ANN001
    assert run() == ["U1", "U10"]
    assert run() == []
    assert run(U10=1) == ["U10"]
    assert run(HERE | {"validate": {"U1": "y"}}, U10=1) == ["U1"]
    assert run(code="b", U10=1) == ["U1", "U10"]
    last = tmp_path / "results" / "batches" / "b" / ".diagnose.zip.last"
    last.write_bytes(last.read_bytes()[:-30])
    assert run(code="b", U10=1) == ["U1", "U10"]
    batch.forget_last_outputs(tmp_path / "results")
    assert run(code="b", U10=1) == ["U1", "U10"]


def test_an_edited_output_is_computed_again_once(run, tmp_path: Path) -> None:  # noqa: ANN001
    """The output of the last run is a link to the same file, and was edited with it."""
    results, output = tmp_path / "results", "batches/b/diagnose.zip"
    assert run() == ["U1", "U10"]
    assert repetitions(results, output) == (0, [])
    with new_pack(results / output) as add:
        add({f"{u}.json": b'{"found": 0, "edited": true}' for u in ("U1", "U10")})
    again, edited = repetitions(results, output)
    assert (again, edited) == (1, [str(results / output)])
    assert run(again=again) == ["U1", "U10"]
    assert repetitions(results, output) == (1, [])
    assert run(again=again) == []


def test_the_reference_chip_of_a_board_depends_on_the_other_chips(tmp_path: Path) -> None:
    board = {"stated": {"board": {"name": "B", "chips": ["U1", "U2"]}}}
    units = {unit: Settings.of_sections(board) for unit in ("U1", "U2", "U3")}

    def inputs(**recordings: bytes) -> dict[str, str]:
        with new_pack(tmp_path / "ingest.zip") as add:
            add({f"{unit}.parquet": recordings.get(unit, b"x") for unit in units})
        packs = {"ingest": Pack(tmp_path / "ingest.zip")}
        job = batch.Job("calibration", units, {}, packs, tmp_path / "out.zip", tmp_path, dict.fromkeys(units, board))
        return {unit: batch._inputs_of(calibration, job, unit, settings) for unit, settings in units.items()}

    before = inputs()
    assert {unit for unit, found in inputs(U2=b"y").items() if found != before[unit]} == {"U1", "U2"}
    assert {unit for unit, found in inputs(U1=b"y").items() if found != before[unit]} == {"U1"}


def test_a_unit_depends_on_the_prior_of_its_lot(tmp_path: Path) -> None:
    settings = Settings.of_sections({})

    def inputs(folder: str, prior: float) -> str:
        (tmp_path / folder).mkdir()
        with new_pack(tmp_path / folder / "lots.zip") as add:
            add({"b.json": json.dumps({"U1": {"accelerometer": prior}}).encode()})
        packs, output = {"lots": Pack(tmp_path / folder / "lots.zip")}, tmp_path / "b" / "prior.zip"
        job = batch.Job("prior", {"U1": settings}, {}, packs, output, tmp_path, {"U1": {}})
        return batch._inputs_of(prior_stage, job, "U1", settings)

    assert inputs("one", 1.0) == inputs("same", 1.0) != inputs("other", 2.0)
