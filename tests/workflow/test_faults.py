"""The table of faults in docs/fleet.md, row by row: what a run that is disturbed leaves, what it says, what recovers.

After recovery every file of the results has the bytes of a run that nothing disturbed.
"""

from __future__ import annotations

import hashlib
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from stage_files import documents, write_pack

ROOT = Path(__file__).parents[2]
pytestmark = [pytest.mark.workflow, pytest.mark.faults]

# Found by the process whose copies run the jobs: disturbs the first report before it renames its first file.
# A shell that starts a job in the background ignores SIGINT for it, and children inherit that: Ctrl-C is set here.
DISTURB = """
import os, signal, sys, time

signal.signal(signal.SIGINT, signal.default_int_handler)

def snakemake():
    pid = os.getppid()
    while b"snakemake" not in open(f"/proc/{pid}/cmdline", "rb").read():
        pid = int(open(f"/proc/{pid}/stat").read().rsplit(")", 1)[1].split()[1])
    return pid

def disturbed(source, target, replace=os.replace):
    if "report" not in sys.argv or not any("-0001/report" in argument for argument in sys.argv):
        return replace(source, target)
    fault = os.environ["FAULT"]
    os.replace = replace
    if fault == "kill job":
        os.kill(os.getpid(), signal.SIGKILL)
    if fault == "kill snakemake":
        os.kill(snakemake(), signal.SIGKILL)
        time.sleep(3)
    if fault == "hold":
        open("held", "w").close()
        while os.path.exists("held"):
            time.sleep(0.1)
    replace(source, target)

if "FAULT" in os.environ and "job-server" in sys.orig_argv:  # the jobs are copies of it
    os.replace = disturbed
"""


@dataclass
class Disk:
    """A working directory on a small disk of its own, with a campaign of two batches in it."""

    directory: Path
    mounted: bool
    trees: dict[str, dict[str, str]]
    place: str = "There"  # of the results as they are

    def turn(self) -> str:
        """Return a setting other than the one that the results are made with: reports are made again."""
        self.place = {"Here": "There", "There": "Here"}[self.place]
        return self.place

    def start(self, place: str, *config: str, fault: str = "", cwd: str = ".") -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "snakemake", "--cores", "2", "-p", "-s", str(ROOT / "Snakefile"), "--config"]
        command += [
            f"campaign={self.directory / 'pair'}",
            f"overrides=[batch_size=1, method.gyroscope=null, certificate.place={place}]",
            *config,
        ]
        return self.popen(command, fault, cwd)

    def popen(self, command: list[str], fault: str = "", cwd: str = ".") -> subprocess.Popen[str]:
        environment = os.environ | {"PYTHONPATH": str(self.directory / "own"), "PYTHONWARNINGS": ""}
        environment |= {"FAULT": fault} if fault else {}
        (self.directory / cwd).mkdir(exist_ok=True)
        # Pages tell of earlier runs: without a history they depend on recordings and settings alone.
        shutil.rmtree(self.directory / "results" / "pair" / "history", ignore_errors=True)
        pipe = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "start_new_session": True}
        return subprocess.Popen(command, cwd=self.directory / cwd, env=environment, text=True, **pipe)  # type: ignore[call-overload,no-any-return]

    def run(self, place: str, *config: str, fault: str = "", cwd: str = ".") -> tuple[int, str]:
        process = self.start(place, *config, fault=fault, cwd=cwd)
        return process.communicate(timeout=300)[0], process.returncode

    def recover(self, told: str) -> str:
        """Run the last command that was printed, as a person would."""
        line = told.strip().splitlines()[-1].strip()
        assert line.startswith("snakemake "), told
        said = ""
        for part in line.split(" && "):
            process = self.popen([sys.executable, "-m", *shlex.split(part)])
            said += process.communicate(timeout=300)[0]
            assert process.returncode == 0, said
        return said

    def tree(self) -> dict[str, str]:
        """Return the digest of every file of the results but logs, history, locks, configurations, owner, kept."""
        results = self.directory / "results" / "pair"
        files = [f for f in sorted(results.rglob("*")) if f.is_file()]
        named = {str(f.relative_to(results)): f for f in files}
        left_out = ("logs/", "configs/", "history/", "replaced-", ".owner.json", ".run.lock", ".jobs.lock")
        return {n: hashlib.sha256(f.read_bytes()).hexdigest() for n, f in named.items() if not n.startswith(left_out)}

    def remount(self, how: str) -> None:
        subprocess.run(["mount", "-o", f"remount,{how}", str(self.directory)], check=True)


@pytest.fixture(scope="module")
def disk(tmp_path_factory: pytest.TempPathFactory, simulated: Path) -> Iterator[Disk]:
    directory = tmp_path_factory.mktemp("disk")
    mount = ["mount", "-t", "tmpfs", "-o", "size=64m", "none", str(directory)]
    mounted = subprocess.run(mount, check=False, capture_output=True).returncode == 0
    for unit in ("U1", "U2"):
        shutil.copytree(simulated, directory / "pair" / "raw" / unit)
    (directory / "pair" / "units.csv").write_text("unit\nU1\nU2\n")
    (directory / "own").mkdir()
    (directory / "own" / "sitecustomize.py").write_text(DISTURB)
    made = Disk(directory, mounted, {})
    for place in ("Here", "There"):
        said, code = made.run(place)
        assert code == 0, said
        made.trees[place] = made.tree()
    yield made
    if mounted:
        subprocess.run(["umount", "--lazy", str(directory)], check=False)


def test_a_job_that_is_killed_is_done_again(disk: Disk) -> None:
    assert disk.trees["Here"] != disk.trees["There"]
    said, code = disk.run(disk.turn(), fault="kill job")
    assert code != 0
    assert "report: killed at unit U1" in said
    batches = disk.directory / "results" / "pair" / "batches"
    assert [d.parent.name[-4:] for d in batches.glob("*/report.zip")] == ["0002"]
    assert disk.recover(said).count("rule report:") == 1
    assert disk.tree() == disk.trees[disk.place]


def test_snakemake_that_is_killed_leaves_a_lock_and_jobs_that_end_by_themselves(disk: Disk) -> None:
    said, code = disk.run(disk.turn(), fault="kill snakemake")
    assert code == -9
    said, code = disk.run(disk.place)
    assert code != 0
    assert "or one was killed here" in said
    assert "snakemake --unlock" in said
    disk.recover(said)
    assert disk.tree() == disk.trees[disk.place]


def test_files_that_were_changed_or_deleted_are_made_again(disk: Disk) -> None:
    results = disk.directory / "results" / "pair"
    (fit,) = results.glob("batches/*-0002/fit/accelerometer/*.zip")
    with (results / "calibrations" / "U1.json").open("a") as stream:
        stream.write(" ")
    (results / "reports" / "U1.html").unlink()
    (results / "summary.csv").write_text("by hand")
    shutil.rmtree(results / "exports" / "U2")
    write_pack(fit, {name: str(found).replace("1", "2") for name, found in documents(fit).items()})
    said, code = disk.run(disk.place)
    assert code == 0, said
    told = said[said.index("Changed or deleted since the last run") :].splitlines()[1:8]
    for path in ("calibrations", "reports", "summary.csv", "exports", str(fit.relative_to(results))):
        assert f"  results/pair/{path}" in told
    (kept,) = results.glob("replaced-*")  # what was changed by hand is not lost
    assert (kept / "summary.csv").read_text() == "by hand"
    assert (kept / "calibrations" / "U1.json").read_text() == (results / "calibrations" / "U1.json").read_text() + " "
    assert disk.tree() == disk.trees[disk.place]
    again, code = disk.run(disk.place)
    assert "Nothing to be done" in again
    assert code == 0


def test_the_same_command_makes_a_damaged_file_again_whose_size_and_time_are_as_they_were(disk: Disk) -> None:
    (file,) = (disk.directory / "results" / "pair").glob("batches/*-0001/ingest.zip")
    was, content = file.stat(), bytearray(file.read_bytes())
    for byte in range(1000, 1100):
        content[byte] ^= 255
    file.write_bytes(content)
    os.utime(file, ns=(was.st_atime_ns, was.st_mtime_ns))
    said, code = disk.run(disk.turn())
    assert code != 0
    assert "ingest.zip: U1.parquet cannot be read, it is missing or damaged (" in said
    assert "run the same command again: snakemake writes the file anew [damaged_file in report]" in said
    said, code = disk.run(disk.place)
    assert code == 0, said
    assert disk.tree() == disk.trees[disk.place]


def test_a_run_is_left_alone_by_others_and_once_interrupted_goes_on_with_the_same_command(disk: Disk) -> None:
    run = disk.start(disk.turn(), fault="hold")
    while not (disk.directory / "held").exists():
        assert run.poll() is None, run.communicate()[0]
        time.sleep(0.1)
    other, code = disk.run(disk.place)
    assert code != 0
    assert "Another run uses this directory" in other
    elsewhere, code = disk.run(disk.place, f"results={disk.directory / 'results'}", cwd="elsewhere")
    assert code != 0
    assert f"another run works on these results (process {run.pid} on" in elsewhere
    os.killpg(run.pid, signal.SIGINT)  # as Ctrl-C does
    said = run.communicate(timeout=300)[0]
    (disk.directory / "held").unlink()
    assert run.returncode != 0
    assert "The run was interrupted. Finished jobs are kept, the others start again. To continue:" in said
    assert "incomplete output" not in said
    disk.recover(said)
    assert disk.tree() == disk.trees[disk.place]


def test_a_full_disk_stops_the_run_and_the_same_command_goes_on_when_there_is_room(disk: Disk) -> None:
    if not disk.mounted:
        pytest.skip("a small disk cannot be mounted here: not root")
    filler = disk.directory / "filler"
    room = shutil.disk_usage(disk.directory).free
    filler.write_bytes(bytes(room))
    said, code = disk.run(disk.turn())
    assert code != 0
    assert "No space left on device" in said
    filler.unlink()
    again, code = disk.run(disk.place)
    if code:
        disk.recover(again)
    assert disk.tree() == disk.trees[disk.place]


def test_results_that_cannot_be_written_are_refused_before_any_job(disk: Disk) -> None:
    if not disk.mounted:
        pytest.skip("a small disk cannot be mounted here: not root")
    results = f"results={disk.directory / 'results'}"
    disk.remount("ro")
    try:
        command = [sys.executable, "-m", "snakemake", "--cores", "2", "-p", "-s", str(ROOT / "Snakefile")]
        command += ["--forcerun", "gather", "--config", f"campaign={disk.directory / 'pair'}", results]
        done = subprocess.run(command, cwd=disk.directory.parent, capture_output=True, text=True, check=False)
    finally:
        disk.remount("rw")
    assert done.returncode != 0
    assert "results/pair cannot be written; make it writable, then:\n  snakemake --cores 2" in done.stderr
    assert "rule ingest:" not in done.stderr
    assert disk.tree() == disk.trees[disk.place]
