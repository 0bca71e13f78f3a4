"""A Slurm of one node on loopback: ``python tests/workflow/loopback_slurm.py -- COMMAND ...`` runs a command in it.

munged, slurmctld and slurmd are started with files of their own in a temporary directory, and stopped by their process
ids; /etc/slurm/slurm.conf is a link to them meanwhile.
Debian: ``apt-get install --no-install-recommends slurm-wlm munge``.
"""

from __future__ import annotations

import getpass
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

PLACE = Path("/etc/slurm/slurm.conf")  # the executor takes SLURM_CONF out of the environment of its jobs
DAEMONS = ("munged", "slurmctld", "slurmd")
PATH = os.pathsep.join([os.environ.get("PATH", ""), "/usr/sbin", "/sbin"])
CONFIGURATION = """\
ClusterName=loopback
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={controller}
SlurmdPort={node}
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
CommunicationParameters=NoCtldInAddrAny,NoInAddrAny
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
MpiDefault=none
ReturnToService=2
MinJobAge=86400
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
NodeName=localhost NodeHostname={host} NodeAddr=127.0.0.1 CPUs={cpus} RealMemory={memory} State=UNKNOWN
PartitionName=debug Nodes=localhost Default=YES MaxTime=INFINITE State=UP
"""


def why_not() -> str:
    """Return why Slurm cannot be started here; nothing where it can."""
    missing = [name for name in DAEMONS if shutil.which(name, path=PATH) is None]
    if missing:
        return f"{', '.join(missing)} not installed (Debian: slurm-wlm, munge)"
    if PLACE.exists():
        return f"{PLACE} belongs to a Slurm that is in use here"
    return "" if os.access(PLACE.parents[1], os.W_OK) else f"{PLACE} cannot be written: not root"


@contextmanager
def slurm() -> Iterator[dict[str, str]]:
    """Run a Slurm of one node; gives the environment in which its commands find it."""
    with tempfile.TemporaryDirectory(prefix="slurm-") as name:
        folder, started = Path(name), []
        environment = os.environ | {"PATH": PATH}
        _lay_out(folder)
        munge = ["--foreground", "--force", f"--socket={folder}/munge.socket", f"--key-file={folder}/munge.key"]
        munge += [f"--{kind}-file={folder}/munge.{kind}" for kind in ("pid", "log", "seed")]
        try:
            for command in (["munged", *munge], ["slurmctld", "-D"], ["slurmd", "-D", "-N", "localhost"]):
                with (folder / f"{command[0]}.out").open("w") as log:
                    started.append(subprocess.Popen(command, env=environment, stdout=log, stderr=log))
            _wait_until_idle(environment, folder)
            yield environment
        finally:
            if PLACE.is_symlink() and PLACE.readlink() == folder / "slurm.conf":
                PLACE.unlink()
            for daemon in reversed(started):
                daemon.terminate()
            for daemon in started:
                daemon.wait(20)


def _lay_out(folder: Path) -> None:
    for name in ("state", "spool"):
        (folder / name).mkdir()
    key = folder / "munge.key"
    key.write_bytes(os.urandom(1024))
    key.chmod(0o400)
    ports = [socket.socket(), socket.socket()]
    for port in ports:
        port.bind(("127.0.0.1", 0))
    controller, node = (port.getsockname()[1] for port in ports)
    for port in ports:
        port.close()
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2**20 - 512
    host, user, cpus = socket.gethostname().split(".")[0], getpass.getuser(), os.cpu_count()
    (folder / "slurm.conf").write_text(CONFIGURATION.format(**locals()))
    PLACE.parent.mkdir(exist_ok=True)
    if PLACE.is_symlink() and not PLACE.exists():  # of a Slurm of ours that was killed
        PLACE.unlink()
    PLACE.symlink_to(folder / "slurm.conf")


def _wait_until_idle(environment: dict[str, str], folder: Path) -> None:
    for _ in range(60):
        time.sleep(0.5)
        told = subprocess.run(["sinfo", "-h", "-o", "%T"], env=environment, capture_output=True, text=True, check=False)
        if told.stdout.strip() == "idle":
            return
    logs = "\n".join(f.read_text()[-2000:] for f in folder.glob("*.out"))
    raise RuntimeError(f"Slurm did not start: {told.stdout}{told.stderr}\n{logs}")


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that what was started is stopped
    with slurm() as surroundings:
        sys.exit(subprocess.call(sys.argv[sys.argv.index("--") + 1 :], env=surroundings))
