"""The user's cache folder: values that every start of a program would compute again, such as compiled templates.

A value is used while what it follows from is unchanged: the caller's ``state``, the code of the package, and the
interpreter. Only the user can write the folder (mode 0700), because compiled code is read from it. Without such a
folder every start computes the values. Only commands and runs use it (``use_cache``): a call of the library writes no
file that its caller did not name.
"""

from __future__ import annotations

import hashlib
import marshal
import os
import stat
import sys
from contextlib import suppress
from functools import cache
from importlib.util import MAGIC_NUMBER
from pathlib import Path
from typing import Any

from pipeline.core.files import state_of_files, write_atomically

FOLDERS = {"darwin": "~/Library/Caches", "win32": "~/AppData/Local"}  # by platform; others: XDG base directories
DIGEST_SIZE = 64  # hexadecimal digits of SHA-256


_used: list[bool] = []  # not empty in the processes of commands and runs


def use_cache() -> None:
    """Read and keep values in this process, and in those that it forks."""
    _used[:] = [True]


@cache
def cache_folder() -> Path | None:
    """Return the folder, which is created if there is none; None where it cannot be written, or others can write it."""
    named = os.environ.get("XDG_CACHE_HOME", "")
    try:
        above = Path(named if named.startswith("/") else FOLDERS.get(sys.platform, "~/.cache")).expanduser()
        folder = above / "imu-calibration"
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.lstat()
    except (OSError, RuntimeError):  # RuntimeError: a user without a home
        return None
    private = sys.platform == "win32" or (status.st_uid == os.getuid() and not status.st_mode & 0o077)
    return folder if private and stat.S_ISDIR(status.st_mode) else None


def from_cache(name: str, state: str) -> Any:  # noqa: ANN401  (what ``to_cache`` stored)
    """Return the value of a name that was stored in the same state; None if there is none."""
    if _used and (folder := cache_folder()) is not None:
        with suppress(OSError, EOFError, ValueError, TypeError):
            content = (folder / name).read_bytes()
            if content[:DIGEST_SIZE] == _digest(state, content[DIGEST_SIZE:]):
                return marshal.loads(content[DIGEST_SIZE:])  # noqa: S302  (the user's own file)
    return None


def to_cache(name: str, state: str, value: Any) -> None:  # noqa: ANN401  (numbers, texts, lists, dictionaries, code)
    """Store the value of a name, where the folder can be written."""
    if _used and (folder := cache_folder()) is not None:
        with suppress(OSError, ValueError):
            content = marshal.dumps(value)
            write_atomically(folder / name, _digest(state, content) + content)


def _digest(state: str, content: bytes) -> bytes:
    return hashlib.sha256(f"{state}\0{_program()}\0".encode() + content).hexdigest().encode()


@cache
def _program() -> str:
    """Return a digest of the interpreter, and of the names, sizes and times of the package's modules."""
    return f"{MAGIC_NUMBER.hex()} {state_of_files(Path(__file__).resolve().parent.rglob('*.py'))}"
