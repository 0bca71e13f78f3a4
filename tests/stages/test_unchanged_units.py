"""What is taken from the last run: units whose settings, code and files of earlier stages are as they were."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest

from pipeline.pack import Pack, new_pack
from pipeline.results_folder import repetitions
from pipeline.stages import batch

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
        config.write_text(json.dumps({"units": units} | ({"again": again} if again else {})))
        argv = ["--config", str(config), "--output", str(output), "--code", code]
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
