"""A fault in any stage up to the calibration fails one unit: its page names the cause, all others are complete.

A fault in a stage after it leaves the calibration published, and is stated wherever the unit is.
"""

import csv
import html
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import pytest
from whole_run import run_campaign, run_jobs

import pipeline
from pipeline.app import results_folder
from pipeline.app.commands import add, apply, convert, explain, unpack
from pipeline.app.config import load_campaign, settings_of_jobs
from pipeline.app.config.campaign import Campaign
from pipeline.app.one_unit import try_unit, unit_of_campaign
from pipeline.app.results_folder import release_locks
from pipeline.app.steps import batch, diagnose, gather, report
from pipeline.app.steps.unit_files import StoredUnit
from pipeline.core.errors import ConfigurationError, DamagedFileError, InputError
from pipeline.core.files import json_text
from pipeline.core.pack import Batch, Pack
from pipeline.core.settings import Settings
from pipeline.evaluation.diagnosis.words import in_words
from pipeline.output.outcome import outcome
from pipeline.unit import Task, run_step

from .schemas import violations

FAILING = ("ingest", "filter", "fit", "validate", "calibration", "gather")
AFTER_FIT = ("diagnose", "export", "report", "summary")
STAGES = (*FAILING, *AFTER_FIT)
FOLDERS = ("calibrations", "validations", "diagnoses", "reports", "certificates", "exports")


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory, simulated: Path) -> tuple[Campaign, Path]:
    """A campaign of a good unit and, for each stage, one at which this stage fails after it has written its files."""
    directory = tmp_path_factory.mktemp("faults") / "bench"
    names = ["good", *(f"at_{stage}" for stage in STAGES)]
    for name in names:
        shutil.copytree(simulated, directory / "raw" / name)
    (directory / "units.csv").write_text("unit\n" + "\n".join(names) + "\n")
    campaign = load_campaign({"campaign": str(directory), "results": str(directory.parent / "results")})
    made_of, failure, render = batch._made, Batch.failure, report.render

    def faulty(module: Any, job: batch.Job, unit: str, settings: dict[str, Any]) -> Any:
        made = made_of(module, job, unit, settings)
        if unit == f"at_{job.stage}":
            raise MemoryError(f"no room for {unit}") if job.stage == "export" else RuntimeError(f"fault at {unit}")
        return made

    def faulty_gather(packs: Batch, unit: str) -> Any:
        if unit == "at_gather":
            raise RuntimeError("fault at at_gather")
        return failure(packs, unit)

    def faulty_render(document: dict[str, Any], *rest: Any, **more: Any) -> str:
        if document["unit"] == "at_filter" and document["status"] == "failed":
            raise ValueError("the template fails too")
        return render(document, *rest, **more)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(batch, "_made", faulty)
        patch.setattr(Batch, "failure", faulty_gather)
        patch.setattr(report, "render", faulty_render)
        assert run_jobs(campaign) == 1
    return campaign, campaign.results


def test_a_fault_in_any_stage_fails_its_unit_alone(published: tuple[Campaign, Path]) -> None:
    _, results = published
    rows = {r["unit"]: r for r in csv.DictReader((results / "summary.csv").read_text().splitlines())}
    assert list(rows) == ["good", *(f"at_{stage}" for stage in STAGES)]
    assert rows["good"]["status"] == "ok"
    assert (results / "validations" / "good.json").is_file()
    assert len(list((results / "exports" / "good").iterdir())) > 10
    index = (results / "index.html").read_text()
    failures = {f["unit"]: f for f in json.loads((results / "failures.json").read_text())}
    assert failures == {f["unit"]: f for f in json.loads((results / "batches" / "gathered.json").read_text())}
    assert failures.keys() == {f"at_{stage}" for stage in FAILING}
    for stage in FAILING:
        unit = f"at_{stage}"
        assert failures[unit]["stage"].startswith(stage), failures[unit]
        assert f"fault at {unit}" in failures[unit]["message"]
        assert rows[unit]["status"] == "failed"
        assert json.loads((results / "calibrations" / f"{unit}.json").read_text())["status"] == "failed"
        assert f"fault at {unit}" in (results / "reports" / f"{unit}.html").read_text()
        assert unit in index
        assert not any((results / f / f"{unit}.json").exists() for f in ("validations", "diagnoses", "certificates"))
        assert not (results / "exports" / unit).exists()


def test_a_fault_after_the_fit_leaves_the_calibration_and_is_stated_everywhere(
    published: tuple[Campaign, Path],
) -> None:
    campaign, results = published
    rows = {r["unit"]: r for r in csv.DictReader((results / "summary.csv").read_text().splitlines())}
    index, said = (results / "index.html").read_text(), outcome(results, campaign.settings, of_this_run=True)
    good = json.loads((results / "calibrations" / "good.json").read_text())
    for stage in AFTER_FIT:
        unit = f"at_{stage}"
        document = json.loads((results / "calibrations" / f"{unit}.json").read_text())
        of_diagnosis = {"open", "uncertainty_with_open"} if stage == "diagnose" else set()
        parts = [{k: v for k, v in d["gyroscope"].items() if k not in of_diagnosis} for d in (document, good)]
        assert document["status"] == "ok"
        assert parts[0] == parts[1]
        cause = f"no room for {unit}" if stage == "export" else f"fault at {unit}"
        assert (rows[unit]["status"], rows[unit]["error"]) == ("ok", "")
        assert rows[unit]["incomplete"].startswith(f"{stage}: ")
        assert cause in rows[unit]["incomplete"]
        assert f"{unit}, not complete: {rows[unit]['incomplete']}" in said
        assert html.escape(rows[unit]["incomplete"]) in index
        page = (results / "reports" / f"{unit}.html").read_text()
        assert (cause in page) == (stage != "summary")  # the page is made before the summary
        diagnosis = json.loads((results / "diagnoses" / f"{unit}.json").read_text())
        verdicts = {diagnosis[s]["verdict"] for s in ("accelerometer", "gyroscope")}
        assert (verdicts == {"not_enough_data"}) == (stage == "diagnose")
        assert all((cause in diagnosis[s]["reason"]) == (stage == "diagnose") for s in ("accelerometer", "gyroscope"))
        assert (results / "exports" / unit).is_dir() == (stage != "export")
        assert (results / "certificates" / f"{unit}.json").is_file() == (stage != "report")
    assert violations(results) == []
    assert rows["good"]["incomplete"] == ""
    assert f", {len(AFTER_FIT)} not complete, " in said
    assert f" {len(FAILING)} failed; look at {results}/index.html" in said


def test_a_diagnosis_of_one_sensor_that_fails_does_not_stop_the_other(
    published: tuple[Campaign, Path], monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    campaign, results = published
    (name,) = campaign.batches
    content = batch.merge_common(json.loads(settings_of_jobs(campaign)[name]["diagnose"].content))
    folder = results / "batches" / name
    packs = {stage: Pack(folder / f"{stage}.zip") for stage in ("ingest", "filter", "validate")}
    packs |= {s: Pack(folder / "fit" / s / f"{campaign.chains[name][s][-1]}.zip") for s in batch.FITS}
    whole = json.loads((results / "diagnoses" / "good.json").read_text())

    works = diagnose.diagnose

    def fails_for_the_gyroscope(calibration: Any, *arguments: Any, **keywords: Any) -> Any:
        if calibration.sensor == "gyroscope":
            raise np.linalg.LinAlgError("Singular matrix")
        return works(calibration, *arguments, **keywords)

    monkeypatch.setattr(diagnose, "diagnose", fails_for_the_gyroscope)
    stored = StoredUnit(batch.Job("diagnose", {}, {}, packs, folder, results), "good")
    settings = Settings.of_sections(content["units"]["good"])
    found = run_step(Task("diagnose"), stored, settings)
    assert json.loads(json_text(found.document["accelerometer"])) == whole["accelerometer"]
    part = found.document["gyroscope"]
    assert (part["verdict"], part["selected"], part["override"]) == ("not_enough_data", [], "")
    assert "LinAlgError: Singular matrix" in part["reason"]
    assert in_words(part, "gyroscope")[0].startswith("The diagnosis of the gyroscope failed")
    assert [record["stage"] for record in found.omissions] == ["diagnose/gyroscope"]
    assert "Traceback" in capfd.readouterr().err
    monkeypatch.setattr(diagnose, "diagnose", lambda *_, **__: (_ for _ in ()).throw(DamagedFileError("damaged", "x")))
    with pytest.raises(DamagedFileError):  # the next run writes the file anew, and diagnoses the unit
        run_step(Task("diagnose"), stored, settings)


def test_calibrate_unit_raises_the_error_that_a_run_publishes(tmp_path: Path, simulated: Path) -> None:
    """Of units that fail in ingest and in a fit: code, message and file are the same."""
    directory = tmp_path / "bench"
    for unit in ("text", "folder", "still"):
        shutil.copytree(simulated, directory / "raw" / unit)
    (directory / "raw" / "text" / "accel_x.csv").write_text("time_s,accel_x_g\n0,none\n")
    (directory / "raw" / "folder" / "accel_y.csv").unlink()
    (directory / "raw" / "folder" / "accel_y.csv").mkdir()
    (directory / "raw" / "still" / "static.csv").rename(directory / "raw" / "still" / "recording.csv")
    rows = ["absent,,", "text,,", "folder,,", "still,multi_position,"]
    (directory / "units.csv").write_text("unit,procedure,overrides\n" + "\n".join(rows) + "\n")
    (directory / "campaign.yaml").write_text("overrides: [sensor=mpu6050]\n")
    campaign = load_campaign({"campaign": str(directory), "results": str(tmp_path / "results")})
    assert run_jobs(campaign) == 1
    failures = {f["unit"]: f for f in json.loads((campaign.results / "failures.json").read_text())}
    assert set(failures) == {"absent", "text", "folder", "still"}
    for unit, published in failures.items():
        with pytest.raises(pipeline.PipelineError) as raised:
            pipeline.calibrate_unit(directory, unit)
        assert [getattr(raised.value, key) for key in ("code", "message", "file")] == [
            published[key] for key in ("code", "message", "file")
        ]
    assert failures["still"]["stage"].startswith("fit/accelerometer")


def test_a_run_with_failed_units_ends_with_1_and_names_each(
    published: tuple[Campaign, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mark = tmp_path / "complete.json"
    given = ["--results", str(published[1]), "--output", str(mark), "--failures"]
    assert batch.verdict([*given, str(published[1] / "batches" / "gathered.json")]) == 1
    said = capsys.readouterr().err
    assert all((f"  at_{stage}: " in said) == (stage in FAILING) for stage in STAGES)
    assert "good" not in said
    assert not mark.exists()
    (tmp_path / "none.json").write_text("[]")
    assert batch.verdict([*given, str(tmp_path / "none.json")]) == 0
    assert mark.exists()


def contents(results: Path) -> dict[str, bytes]:
    """Return every published file."""
    files = [results / name for name in results_folder.PUBLISHED_PATHS if "." in name]
    files += [f for folder in FOLDERS for f in (results / folder).rglob("*") if f.is_file()]
    return {str(f.relative_to(results)): f.read_bytes() for f in files}


def test_the_published_files_are_those_of_one_run_wherever_it_is_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def make(name: str, folder: Path) -> None:
        for published in results_folder.PUBLISHED_PATHS:
            path = folder / published / "U1.json" if "." not in published else folder / published
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(f"{name} {published}")

    class StoppedError(Exception):
        pass

    for stop in range(40):
        results = tmp_path / str(stop)
        make("old", results)
        make("new", results / ".new")
        old, new = contents(results), contents(results / ".new")
        calls = iter(range(stop))

        def stopping(do: Callable[..., Any], calls: Any = calls) -> Callable[..., Any]:
            def step(*arguments: Any) -> Any:
                if next(calls, None) is None:
                    raise StoppedError
                return do(*arguments)

            return step

        with monkeypatch.context() as patch:
            patch.setattr(results_folder, "exchange", stopping(results_folder.exchange))
            patch.setattr(Path, "rename", stopping(Path.rename))
            patch.setattr(Path, "unlink", stopping(Path.unlink))
            try:
                results_folder.publish(results / ".new", results)
                break
            except StoppedError:
                pass
        now = contents(results)
        assert now.keys() == old.keys()
        assert all(now[k] in (old[k], new[k]) for k in now)
        begun = (results / results_folder.COMPLETE).exists()
        results_folder.finish_publishing(results)
        assert contents(results) == (new if begun else old)
        assert not (results / results_folder.COMPLETE).exists()
    assert contents(results) == new
    assert stop > len(results_folder.PUBLISHED_PATHS)


def keep_the_first_rest(file: Path) -> None:
    file.write_text("\n".join(file.read_text().splitlines()[:8]) + "\n")


def test_other_failures_are_named_too(tmp_path: Path, simulated: Path) -> None:
    for unit in ("good", "incomplete", "short", "in_stages"):
        shutil.copytree(simulated, tmp_path / "bench" / "raw" / unit)
    (tmp_path / "bench" / "units.csv").write_text("unit,method\ngood,\nincomplete,\nshort,\nin_stages,staged\n")
    (tmp_path / "bench" / "raw" / "incomplete" / "accel_z.csv").unlink()
    for unit in ("short", "in_stages"):
        for file in (tmp_path / "bench" / "raw" / unit).glob("accel_*.csv"):
            keep_the_first_rest(file)
    campaign, code = run_campaign(tmp_path / "bench")
    assert code == 1
    failures = json.loads((campaign.results / "failures.json").read_text())
    assert [(f["unit"], f["code"], f["stage"]) for f in failures] == [
        ("incomplete", "missing_file", "ingest"),
        ("short", "not_observable", "fit/accelerometer/reference_least_squares"),
        ("in_stages", "not_observable", "fit/accelerometer/orthogonality"),  # the first of four stages
    ]
    assert "accel_z" in failures[0]["message"]
    assert "accelerometer" in failures[1]["message"]
    assert "does not show a sinusoid" in failures[2]["message"]
    page, index = (campaign.results / name for name in ("reports/in_stages.html", "index.html"))
    assert all("does not show a sinusoid" in file.read_text() for file in (page, index))
    assert try_unit(unit_of_campaign(campaign, "in_stages"), "calibration")[1] == failures[2]
    assert json.loads((campaign.results / "calibrations" / "good.json").read_text())["status"] == "ok"


def test_what_a_killed_gather_leaves_is_the_old_set(published: tuple[Campaign, Path]) -> None:
    campaign, results = published
    before = contents(results)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gather, "render", lambda *_, **__: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            run_gather(campaign)
    assert contents(results) == before
    run_gather(campaign)
    assert (results / "reports" / "at_export.html").is_file()
    assert not (results / ".new").exists()


def test_units_beyond_the_limit_are_published_on_request_with_the_same_bytes(
    published: tuple[Campaign, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    campaign, results = published
    run_gather(campaign)
    apart = shutil.copytree(results, tmp_path / "results" / results.name)
    packed = load_campaign(dict(campaign.settings) | {"results": str(apart.parent), "overrides": "publish_limit=0"})
    run_gather(packed)
    files = {file.relative_to(apart).parts[0] for file in apart.rglob("*") if file.is_file()}
    assert files.isdisjoint(FOLDERS)
    assert (apart / "summary.csv").read_bytes() == (results / "summary.csv").read_bytes()
    assert f"imu-calibration unpack {apart.name}" in (apart / "index.html").read_text()
    found, ordinary = (pipeline.load_campaign(folder) for folder in (apart, results))
    assert [vars(found.unit(u)) for u in packed.units] == [vars(ordinary.unit(u)) for u in packed.units]
    assert links(apart / "index.html") == {"summary.csv", "parameters.parquet", "fleet.json"}
    check_commands(apart, results, tmp_path, capsys)
    for unit in packed.units:
        unpack.main([str(apart), unit])
        release_locks()
        assert f"reports/{unit}.html" in capsys.readouterr().out
    unpacked = contents(apart)
    assert {f"reports/{unit}.html" for unit in packed.units} < links(apart / "index.html")
    assert all(links(page) for page in apart.glob("*/*.html"))
    assert {k for k, v in contents(results).items() if unpacked.get(k) != v} == {"index.html"}
    assert results_folder.repetitions(apart, "") == (0, [])
    run_gather(packed)
    assert contents(apart) == unpacked
    pack = next(apart.glob("packs/*/calibration.zip"))
    pack.write_bytes(pack.read_bytes().replace(b"PK", b"KP"))
    shutil.rmtree(apart / "calibrations")
    with pytest.raises(DamagedFileError, match=r"calibration\.zip"):
        pipeline.load_campaign(apart).unit("good")


def links(page: Path) -> set[str]:
    """Return where the links of a page lead, each to a file that exists."""
    found = set(re.findall(r'href="([^"#:]+)"', html.unescape(page.read_text()).replace('\\"', '"')))
    assert all((page.parent / unquote(link)).is_file() for link in found), page
    return found


def check_commands(packed: Path, ordinary: Path, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Check that what takes a unit of results prints and writes the same where its files are in packs."""
    bench = ordinary.parents[1] / ordinary.name
    log = bench / "raw" / "good" / "accel_x.csv"
    said, written = [], []
    for name, results in {"packed": packed, "ordinary": ordinary}.items():
        made = folder / name
        made.mkdir()
        calibration, exported = results / "calibrations" / "good.json", results / "exports" / "good" / "kalibr.yaml"
        assert explain.main([str(results)]) == 0
        assert explain.main([str(results), "good", "at_fit"]) == 0
        assert explain.main([str(results / "diagnoses" / "good.json")]) == 0
        assert explain.main([str(calibration)]) == 0
        assert explain.main([str(exported)]) == 0
        assert apply.main(["--calibration", str(calibration), str(log), "-o", str(made / "applied.csv")]) == 0
        assert convert.main([str(calibration), str(made / "px4.params")]) == 0
        with pytest.raises(ConfigurationError, match="suggests no formula"):
            add.main([str(bench), "good", "--suggested", "--results", str(results.parent)])
        with pytest.raises(InputError, match="failed"):
            pipeline.load_calibration(results / "calibrations" / "at_ingest.json")
        said.append(capsys.readouterr().out.replace(str(results.parent), "RESULTS").replace(str(made), "MADE"))
        written.append({file.name: file.read_bytes() for file in made.iterdir()})
    assert said[0] == said[1]
    assert "at_fit\n  failed in stage fit" in said[0]
    assert written[0] == written[1]
    assert set(written[0]) == {"applied.csv", "px4.params"}


def run_gather(campaign: Campaign) -> None:
    file = settings_of_jobs(campaign)["campaign"]["gather"]
    part = campaign.results / "configs" / file.name
    part.write_bytes(file.content)
    try:
        batch.main("gather", ["--config", str(part), "--output", str(campaign.results / "batches" / "gathered.json")])
    finally:
        release_locks()  # a job is a process of its own
