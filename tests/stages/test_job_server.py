"""Jobs on the server behave as processes of their own: exit code, folder, streams, and an end with their command."""

import os
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from calls import imported_by

from pipeline.app.steps.job_server import COMMAND, start_server

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
