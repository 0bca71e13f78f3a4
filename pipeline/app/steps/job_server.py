"""Run the jobs of a run in forks of one process that has imported the stages; this saves 0.2 to 0.6 s per job.

The command ``job_command.py`` sends its arguments, folder and standard streams through a Unix socket, and waits for the
exit code.
"""

from __future__ import annotations

import os
import socket
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

from pipeline.app.steps import MODULES
from pipeline.app.steps.job_command import ADDRESS

COMMAND = [sys.executable, "-PS", str(Path(__file__).with_name("job_command.py"))]  # imports no package
# glibc returns freed memory to the system by default, which clears it when it is used again: 8 % of the stages' time.
# Large pages save another 2 %, where the system lets a program ask for them.
KEEP_FREED_MEMORY = dict.fromkeys(("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_"), "500000000")
KEEP_FREED_MEMORY |= {"GLIBC_TUNABLES": "glibc.malloc.hugetlb=1"}


def start_server() -> Callable[[], None]:
    """Start a server for the jobs of this process, and return the function that ends it."""
    import subprocess  # noqa: PLC0415  (this module is imported by each job)
    import tempfile  # noqa: PLC0415

    if sys.platform != "linux":
        return lambda: None
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    os.environ[ADDRESS] = f"{tempfile.mkdtemp(prefix='imu-calibration-')}/jobs"
    listener.bind(os.environ[ADDRESS])
    listener.listen(128)
    with listener:
        server = subprocess.Popen(  # noqa: S603
            [sys.executable, "-m", "pipeline", "job-server", str(listener.fileno())],
            stdin=subprocess.PIPE,
            pass_fds=[listener.fileno()],
            env=os.environ | KEEP_FREED_MEMORY,
        )

    def end() -> None:
        os.environ.pop(ADDRESS, None)
        server.communicate()  # closes its standard input, which ends the server

    return end


def serve(listener: socket.socket, run_command: Callable[[list[str]], int]) -> int:
    """Serve until the standard input is closed, also by a killed run; run one command in each forked process."""
    import gc  # noqa: PLC0415
    import shutil  # noqa: PLC0415
    import signal  # noqa: PLC0415

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the jobs receive it too
    gc.disable()  # imports leave nothing to collect, which takes a tenth of their time
    _prepare()
    gc.freeze()
    gc.enable()
    request = _next_job(listener)
    listener.close()
    if request is None:
        shutil.rmtree(os.path.dirname(os.environ[ADDRESS]), ignore_errors=True)  # noqa: PTH120
        return 0
    signal.signal(signal.SIGINT, signal.default_int_handler)
    return _run_job(run_command, *request)


def _prepare() -> None:
    """Import the modules of the stages, read the built-in effects and the compiled templates."""
    from importlib import import_module  # noqa: PLC0415

    for module in {"unit_files", *MODULES.values()} - {"gather"}:  # runs once, and imports pandas
        import_module(f"pipeline.app.steps.{module}")
    for name in ("scipy.interpolate", "scipy.spatial.transform", "imufusion", "imu_logs.text_read", "encodings.cp437"):
        import_module(name)  # stages import them inside functions

    from pipeline.core.files import use_cache  # noqa: PLC0415
    from pipeline.evaluation.diagnosis import words  # noqa: PLC0415
    from pipeline.output.exports import formats  # noqa: PLC0415
    from pipeline.output.pages.pages import compile_templates  # noqa: PLC0415
    from pipeline.physics.effects import built_in  # noqa: PLC0415

    use_cache()
    built_in()
    formats()
    compile_templates()
    for name in ("diagnosis.txt", "method_errors.txt", "reasons.txt"):
        words.template(name)


def _next_job(listener: socket.socket) -> tuple[socket.socket, bytes, list[int]] | None:
    """Fork a process for each request; return the request in the new process, None in the server at its end."""
    import select  # noqa: PLC0415

    jobs: set[int] = set()
    while True:
        ready, _, _ = select.select([listener, sys.stdin], [], [])
        jobs -= {job for job in jobs if os.waitpid(job, os.WNOHANG)[0]}
        if sys.stdin in ready:
            return None
        connection = listener.accept()[0]
        message, streams, _, _ = socket.recv_fds(connection, 1 << 18, 3)
        job = os.fork()
        if job == 0:
            return connection, message, streams
        jobs.add(job)
        for stream in streams:
            os.close(stream)
        connection.close()


def _run_job(
    run_command: Callable[[list[str]], int], connection: socket.socket, message: bytes, streams: list[int]
) -> NoReturn:
    import threading  # noqa: PLC0415
    import traceback  # noqa: PLC0415

    for number, stream in enumerate(streams):
        os.dup2(stream, number)
        os.close(stream)
    directory, *argv = os.fsdecode(message).split("\0")
    os.chdir(directory)
    sys.argv[1:] = argv
    threading.Thread(target=_end_with_command, args=(connection,), daemon=True).start()
    code = 1
    try:
        code = run_command(argv)
    except SystemExit as error:
        code = error.code if isinstance(error.code, int) else 1
    except BaseException:  # noqa: BLE001  (as the interpreter does at its end)
        traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    connection.sendall(bytes([code]))
    os._exit(code)


def _end_with_command(connection: socket.socket) -> None:
    connection.recv(1)  # returns when the command of this job has ended
    os._exit(1)
