"""The command of a job: ``job_command.py STAGE ...`` runs a stage in a process of the job server, else in a new one.

It is started for every job and imports one module in C, nothing of the package. So it takes 15 ms instead of the
38 ms of ``python -m pipeline``, which it runs where there is no server (a job on another machine, or not on Linux).
"""

from __future__ import annotations

import os
import sys

ADDRESS = "IMU_CALIBRATION_JOB_SERVER"  # environment variable: path of the socket
KILLED = 137  # exit code of a process that was killed, as shells return it


def run_on_server(argv: list[str]) -> int | None:
    """Run a stage on the server and return its exit code; None if no server answers."""
    import _socket  # noqa: PLC0415  (absent from some systems; ``socket`` imports a dozen modules)

    request = "\0".join([os.getcwd(), *argv])  # noqa: PTH109
    numbers = b"".join(number.to_bytes(4, sys.byteorder) for number in (0, 1, 2))  # C integers
    streams = [(_socket.SOL_SOCKET, _socket.SCM_RIGHTS, numbers)]
    try:
        connection = _socket.socket(_socket.AF_UNIX, _socket.SOCK_SEQPACKET)
        connection.connect(os.environ[ADDRESS])
        connection.sendmsg([os.fsencode(request)], streams)
        answer = connection.recv(1)
    except OSError:
        return None
    return answer[0] if answer else KILLED


if __name__ == "__main__":
    code = run_on_server(sys.argv[1:]) if ADDRESS in os.environ else None
    if code is None:
        os.execv(sys.executable, [sys.executable, "-m", "pipeline", *sys.argv[1:]])  # noqa: S606
    os._exit(code)  # nothing is left to write or to close
