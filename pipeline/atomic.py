"""Files that appear whole or not at all, however a run ends.

A file is written under a temporary name, and then renamed. To have it on the disk too, should the power fail, takes
some milliseconds; a job that writes many files has them flushed together at its end.
"""

from __future__ import annotations

import os
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

TOGETHER: list[Path] = []  # folders whose files are flushed in the end, and not each by itself


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a file under a temporary name in its folder, flush it to the disk, then rename it.

    Parameters
    ----------
    path : Path
        Its folder is made if need be.
    content : str or bytes
        Text is written as UTF-8, its line ends as they are.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        stream = temporary.open("wb")
    except FileNotFoundError:
        path.parent.mkdir(parents=True, exist_ok=True)
        stream = temporary.open("wb")
    with stream:
        stream.write(content.encode() if isinstance(content, str) else content)
        if not TOGETHER:
            stream.flush()
            os.fsync(stream.fileno())
    temporary.replace(path)


def exchange(one: Path, other: Path) -> None:
    """Exchange two files or folders of one file system in a single step, so that neither name is ever without one.

    Where the system has no such step (``renameat2`` is Linux's), three renames do it.
    """
    import ctypes  # noqa: PLC0415  (some milliseconds, once a run)

    here, both = -100, 2  # AT_FDCWD, RENAME_EXCHANGE of linux/fs.h
    system = ctypes.CDLL(None, use_errno=True)
    names = os.fsencode(one), os.fsencode(other)
    if not hasattr(system, "renameat2") or system.renameat2(here, names[0], here, names[1], both) != 0:
        between = one.with_name(f".{one.name}.{os.getpid()}.tmp")
        other.rename(between)
        one.rename(other)
        between.rename(one)


@contextmanager
def flushed_together(folder: Path) -> Iterator[None]:
    """Flush what is written meanwhile at the end, all at once: what is in a folder or on the same file system.

    Raises
    ------
    OSError
        If it cannot be written to the disk.
    """
    TOGETHER.append(folder)
    try:
        yield
    finally:
        TOGETHER.pop()
    flush_file_system(folder)


def flush_file_system(folder: Path) -> None:
    """Write to the disk what the system still holds back of the file system of a folder."""
    import ctypes  # noqa: PLC0415  (some milliseconds, once a job)

    system = ctypes.CDLL(None, use_errno=True)
    if not hasattr(system, "syncfs"):  # not Linux
        os.sync()
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        if system.syncfs(descriptor) != 0:
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number), str(folder))
    finally:
        os.close(descriptor)
