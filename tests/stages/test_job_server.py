"""Jobs on the server behave as processes of their own: exit code, folder, streams, and an end with their command."""

import os
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from calls import imported_by

from pipeline.app.steps.job_server import COMMAND, start_server
from pipeline.app.steps.unit_files import ResultsInMemory
from pipeline.core.pack import Pack, new_pack

VERDICT = [*COMMAND, "verdict", "--results", "results", "--output", "done.json", "--failures"]


@pytest.fixture(scope="module")
def _server() -> Iterator[None]:
    end = start_server()
    folder = Path(os.environ["IMU_CALIBRATION_JOB_SERVER"]).parent
    assert folder.is_dir()
    yield
    end()
    assert not folder.exists()


@pytest.mark.usefixtures("_server")
def test_a_job_writes_in_its_folder_and_to_its_streams(tmp_path: Path) -> None:
    (tmp_path / "none.json").write_text("[]")
    failure = '{"unit": "A1", "stage": "ingest", "code": "bad_input", "message": "is empty", "file": "a.csv"}'
    (tmp_path / "one.json").write_text(f"[{failure}]")
    done = subprocess.run([*VERDICT, "none.json"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr, (tmp_path / "done.json").is_file()) == (0, "", True)
    failed = subprocess.run([*VERDICT, "one.json"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert failed.returncode == 1
    assert "a.csv: is empty" in failed.stderr
    refused = subprocess.run([*VERDICT, "absent.json"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert refused.returncode == 2
    assert "absent.json" in refused.stderr


@pytest.mark.usefixtures("_server")
def test_a_job_ends_with_its_command_and_the_command_with_its_job(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")  # reading it waits for ever
    for victim, code in (("command", -signal.SIGKILL), ("job", 137)):
        with subprocess.Popen([*VERDICT, "pipe"], cwd=tmp_path) as command:
            processes = {"command": command.pid, "job": 0}
            while not processes["job"]:
                processes["job"] = _process_in(tmp_path, but=command.pid)
            os.kill(processes[victim], signal.SIGKILL)
            assert command.wait(30) == code
        while _process_in(tmp_path):
            time.sleep(0.05)


@pytest.mark.usefixtures("_server")
def test_the_jobs_of_a_batch_share_a_process_until_one_fails_or_is_killed(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "settings")  # reading it waits for ever
    (tmp_path / "absent").mkdir()
    job = [*COMMAND, *["filter", "--ingest", "batches/1/ingest.zip", "--output", "batches/1/filter.zip", "--config"]]

    def refused() -> None:
        done = subprocess.run([*job, "absent/settings.json"], cwd=tmp_path, capture_output=True, text=True, check=False)
        assert (done.returncode, "settings.json" in done.stderr) == (2, True)

    refused()  # its process ends with it: the next job gets another
    refused()
    while _process_in(tmp_path):  # that of the job before, which ends
        time.sleep(0.01)
    with subprocess.Popen([*job, "settings"], cwd=tmp_path) as command:
        while not (process := _process_in(tmp_path, but=command.pid)):
            time.sleep(0.01)
        refused()  # beside a job that runs
        os.kill(process, signal.SIGKILL)
        assert command.wait(30) == 137
    refused()


def test_a_process_keeps_results_as_long_as_their_pack_is_the_same(tmp_path: Path) -> None:
    path, results = tmp_path / "fit.zip", ResultsInMemory()
    results.keeps = True

    def written(text: str) -> Pack:
        with new_pack(path) as add:
            add({"U1.json": text.encode()})
        return Pack(path)

    pack = written("1")
    results.made("U1", "fits", "the fit")
    results.made("U1", "pages", "a page, which no step reads")
    results.written(pack)
    assert results.get(Pack(path), "U1", "fits", lambda: "read") == "the fit"
    assert results.get(Pack(path), "U1", "pages", lambda: "read") == "read"
    assert results.get(written("2"), "U1", "fits", lambda: "read") == "read"
    assert results.get(Pack(path), "U1", "fits", lambda: "read again") == "read"


def test_a_process_keeps_no_recordings_beyond_its_memory(tmp_path: Path) -> None:
    pack, results = Pack(tmp_path / "ingest.zip"), ResultsInMemory()
    with new_pack(pack.path) as add:
        add({})
    results.keeps = True
    for unit, samples, kept in (("U1", 1_000_000, True), ("U2", 1_000_000, False), ("U3", 10, True)):
        found = [SimpleNamespace(samples=samples)]
        assert results.get(pack, unit, "checked", lambda found=found: found) is found
        assert (results.get(pack, unit, "checked", list) is found) is kept


def test_without_a_server_the_command_runs_the_stage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "none.json").write_text("[]")
    for address in (None, str(tmp_path / "absent")):
        if address:
            monkeypatch.setenv("IMU_CALIBRATION_JOB_SERVER", address)
        done = subprocess.run([*VERDICT, "none.json"], cwd=tmp_path, check=False)
        assert done.returncode == 0


def test_the_server_imports_no_pandas() -> None:
    code = "from pipeline.app.steps.job_server import _prepare; _prepare()"
    assert imported_by(code, "pandas", "matplotlib", "hydra", "snakemake") == []


def _process_in(folder: Path, but: int = 0) -> int:
    """Return a process that works in a folder, 0 for none."""
    for link in Path("/proc").glob("[0-9]*/cwd"):
        try:
            if link.readlink() == folder and int(link.parent.name) != but:
                return int(link.parent.name)
        except OSError:
            continue
    return 0
