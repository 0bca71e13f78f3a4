"""Run the jobs of a run in forks of one process that has imported the stages; this saves 0.2 to 0.6 s per job.

The command ``job_command.py`` sends its arguments, folder and standard streams through a Unix socket, and waits for the
exit code. One process runs the jobs of a batch one after the other: they find in memory what earlier ones returned
(``pipeline.app.steps.unit_files``).
"""

from __future__ import annotations

import os
import socket
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, NoReturn

from pipeline.app.steps import MODULES
from pipeline.app.steps.batch import INPUTS
from pipeline.app.steps.job_command import ADDRESS
from pipeline.unit import STEPS

if TYPE_CHECKING:
    import threading

COMMAND = [sys.executable, "-PS", str(Path(__file__).with_name("job_command.py"))]  # imports no package
# glibc returns freed memory to the system by default, which clears it when it is used again: 8 % of the stages' time.
# Large pages save another 2 %, where the system lets a program ask for them.
KEEP_FREED_MEMORY = dict.fromkeys(("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_"), "500000000")
KEEP_FREED_MEMORY |= {"GLIBC_TUNABLES": "glibc.malloc.hugetlb=1"}
# Arrow's own pool keeps what it frees beside that: an hour at 1 kHz, unexplained, then needed 0.2 GB more.
KEEP_FREED_MEMORY |= {"ARROW_DEFAULT_MEMORY_POOL": "system"}
# Containers that are made and not freed until Python searches them for cycles. With 700, its default, this takes 5 ms a
# unit, with 10,000 2 ms; without it 100 units need 630 MB in place of 440.
NEW_OBJECTS = 10_000
LAST = [*STEPS][-1]  # of a batch: its process ends
# Of memory with which a process ends after its job; the rules state 1 GB for a job. With 600 MB, batches of 160 units
# read their recordings from files again for the page, in 6 ms a unit.
MOST_BYTES = 750_000_000


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
    """Serve until the standard input is closed, also by a killed run; run the commands in forked processes."""
    import gc  # noqa: PLC0415
    import shutil  # noqa: PLC0415
    import signal  # noqa: PLC0415

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the jobs receive it too
    gc.disable()  # imports leave nothing to collect, which takes a tenth of their time
    _prepare()
    gc.freeze()
    gc.enable()
    gc.set_threshold(NEW_OBJECTS)
    job = _next_job(listener)
    listener.close()
    if job:
        _run_jobs(run_command, *job)
    shutil.rmtree(os.path.dirname(os.environ[ADDRESS]), ignore_errors=True)  # noqa: PTH120
    return 0


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


class Request(NamedTuple):
    """A command that waits for the end of its job."""

    connection: socket.socket
    message: bytes  # folder and arguments
    streams: list[int]

    @property
    def words(self) -> list[str]:
        """Folder and arguments."""
        return os.fsdecode(self.message).split("\0")

    @property
    def batch(self) -> str:
        """Folder of the batch of a job that reads or writes results of steps; else empty."""
        _, stage, *options = self.words
        if stage not in STEPS:
            return ""
        inputs = INPUTS[stage]
        option = f"--{inputs[0]}" if inputs else "--output"
        return os.path.dirname(options[options.index(option) + 1]) if option in options[:-1] else ""  # noqa: PTH120

    def close(self) -> None:
        """Close what the process of the job has got."""
        self.connection.close()
        for stream in self.streams:
            os.close(stream)


# What a new process runs, with the channel by which it gets the next jobs of its batch.
NewProcess = tuple[Request, socket.socket | None]


class Processes:
    """The processes of the server: one for each batch, and one for a job whose batch has a job that runs."""

    def __init__(self) -> None:
        self.children: set[int] = set()
        self.channels: dict[str, socket.socket] = {}  # to the processes of batches; the last used is the last
        self.busy: set[str] = set()  # batches with a job that runs

    def listen(self, batch: str) -> None:
        """Take note that the process of a batch waits for a job, or has ended."""
        self.busy.discard(batch)
        if not self.channels[batch].recv(1):
            self.channels.pop(batch).close()

    def run(self, request: Request) -> NewProcess | None:
        """Give a request to the process of its batch, or to a new one; return in a new process what it runs.

        A job that gets a process of its own reads from files what earlier jobs returned.
        """
        batch, theirs = request.batch, None
        if batch and batch not in self.busy:
            self.busy.add(batch)
            channel = self.channels.pop(batch, None)
            if channel and _sent(channel, request):
                self.channels[batch] = channel
                request.close()
                return None
            self.channels[batch], theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        child = os.fork()
        if child == 0:
            for channel in self.channels.values():  # so that the end of the server ends every process
                channel.close()
            return request, theirs
        self.children.add(child)
        request.close()
        if theirs:
            theirs.close()
        return None

    def end_others(self) -> None:
        """Collect the processes that have ended; end those that wait, beyond one for each core."""
        self.children -= {child for child in self.children if os.waitpid(child, os.WNOHANG)[0]}
        idle = [batch for batch in self.channels if batch not in self.busy]
        for batch in idle[: max(len(idle) - (os.cpu_count() or 1), 0)]:
            self.channels.pop(batch).close()


def _next_job(listener: socket.socket) -> NewProcess | None:
    """Serve requests; return what a new process runs, in the process, or None in the server at its end."""
    import select  # noqa: PLC0415

    processes = Processes()
    while True:
        batches = {channel: batch for batch, channel in processes.channels.items()}
        ready, _, _ = select.select([listener, sys.stdin, *batches], [], [])
        if sys.stdin in ready:
            return None
        for channel in batches.keys() & ready:
            processes.listen(batches[channel])
        if listener in ready:
            connection = listener.accept()[0]
            job = processes.run(Request(connection, *socket.recv_fds(connection, 1 << 18, 3)[:2]))
            if job:
                return job
        processes.end_others()


def _sent(channel: socket.socket, request: Request) -> bool:
    """Send a request to the process of a batch; return whether it was sent."""
    try:
        socket.send_fds(channel, [request.message], [request.connection.fileno(), *request.streams])
    except OSError:
        return False
    return True


def _run_jobs(run_command: Callable[[list[str]], int], request: Request, channel: socket.socket | None) -> NoReturn:
    """Run a job and, with ``channel``, those that follow, until one fails or the channel is closed."""
    from pipeline.app.results_folder import release_locks  # noqa: PLC0415
    from pipeline.app.steps.unit_files import RESULTS  # noqa: PLC0415

    RESULTS.keeps = channel is not None
    while True:
        code = _run_job(run_command, request)
        last = not channel or code != 0 or request.words[1] == LAST or _resident_bytes() > MOST_BYTES
        if channel and not last:
            release_locks()
            channel.send(b".")  # before the command ends: the next one may follow at once
        request.connection.sendall(bytes([code]))
        if last or not channel:
            os._exit(code)
        message, descriptors, _, _ = socket.recv_fds(channel, 1 << 18, 4)
        if not descriptors:  # closed
            os._exit(0)
        request = Request(socket.socket(fileno=descriptors[0]), message, descriptors[1:])


def _run_job(run_command: Callable[[list[str]], int], request: Request) -> int:
    """Run a job in this process, with the folder and the streams of its command, and send it the exit code."""
    import signal  # noqa: PLC0415
    import threading  # noqa: PLC0415
    import traceback  # noqa: PLC0415

    for number, stream in enumerate(request.streams):
        os.dup2(stream, number)
        os.close(stream)
    directory, *argv = request.words
    os.chdir(directory)
    sys.argv[1:] = argv
    done = threading.Event()
    threading.Thread(target=_end_with_command, args=(request.connection, done), daemon=True).start()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    code = 1
    try:
        code = run_command(argv)
    except SystemExit as error:
        code = error.code if isinstance(error.code, int) else 1
    except BaseException:  # noqa: BLE001  (as the interpreter does at its end)
        traceback.print_exc()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    sys.stdout.flush()
    sys.stderr.flush()
    done.set()
    nothing = os.open(os.devnull, os.O_RDWR)
    for number in range(3):
        os.dup2(nothing, number)
    os.close(nothing)
    return code


def _resident_bytes() -> int:
    pages = Path("/proc/self/statm").read_text(encoding="ascii").split()[1]
    return int(pages) * os.sysconf("SC_PAGE_SIZE")


def _end_with_command(connection: socket.socket, done: threading.Event) -> None:
    connection.recv(1)  # returns when the command of this job has ended
    if not done.is_set():
        os._exit(1)
    connection.close()
