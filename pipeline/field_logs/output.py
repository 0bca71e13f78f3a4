"""The file that compensating a log makes, and how far it is."""

from __future__ import annotations

import sys
import time
from contextlib import contextmanager
from typing import IO, TYPE_CHECKING

from pipeline.errors import InputError, MissingInputError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


def require_apart(source: Path, target: Path) -> None:
    """Refuse a log that does not exist and an output that cannot be, or would overwrite the log."""
    if not source.is_file():
        raise MissingInputError("there is no such log", str(source))
    if target.exists() and target.samefile(source):
        raise InputError("the output would overwrite the log; choose another file for -o", str(target))
    if not target.parent.is_dir():
        raise InputError("the directory of the output does not exist; make it first", str(target))


@contextmanager
def replacing(target: Path) -> Iterator[IO[bytes]]:
    """Open a file that takes its name only when it is complete."""
    if target.exists() and not target.is_file():  # a pipe or device
        with target.open("wb") as out:
            yield out
        return
    part = target.with_name(f".{target.name}.part")
    try:
        with part.open("wb") as out:
            yield out
        part.replace(target)
    finally:
        part.unlink(missing_ok=True)


class Progress:
    """A line on a terminal that says how far the log is read, and how long it will take; silent elsewhere."""

    def __init__(self, source: Path) -> None:
        self.size = source.stat().st_size if source.is_file() else 0
        self.began = self.said = time.monotonic()

    def __call__(self, rows: int, read: int) -> None:
        """Say that so many rows are done and so many bytes read."""
        now = time.monotonic()
        if not sys.stderr.isatty() or now - self.said < 0.5:
            return
        self.said = now
        share = read / max(self.size, 1)
        left = (now - self.began) * (1.0 / share - 1.0) if share > 0 else 0.0
        sys.stderr.write(f"\r{100 * share:3.0f} %, {rows} samples, {left:.0f} s left ")
        sys.stderr.flush()

    def end(self) -> None:
        """Leave the line."""
        if self.said != self.began:
            sys.stderr.write("\r" + " " * 60 + "\r")
