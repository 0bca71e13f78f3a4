"""The file that compensating a log makes, and how far it is."""

from __future__ import annotations

import os
import re
import shutil
import sys
from contextlib import contextmanager, suppress
from typing import IO, TYPE_CHECKING

from pipeline.errors import InputError, MissingInputError
from pipeline.io.files import MESSAGE_FORMATS, not_regular

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

DESCRIPTOR = re.compile(r"-|/dev/stdout|(?:/dev/fd|/proc/self/fd)/(\d+)")  # files that the caller has opened already
KINDS = {".mcap": "MCAP", ".csv": "text", ".txt": "text"}


def require_apart(source: Path, target: Path) -> None:
    """Refuse a log that is no file, and an output (``-``: stdout) that cannot be made or would overwrite it."""
    if not source.exists():
        raise MissingInputError("there is no such log", str(source))
    other = not_regular(source)
    if other:
        raise InputError(f"{other}: save the log, then name that file", str(source))
    if (descriptor := _descriptor(target)) is not None:
        with suppress(OSError):  # it may be closed
            if os.path.samestat(os.fstat(descriptor), source.stat()):
                raise InputError("the output would overwrite the log; choose another file", str(target))
        return
    if target.is_dir():
        raise InputError("the output is a directory; name a file for -o", str(target))
    if target.exists() and target.samefile(source):
        raise InputError("the output would overwrite the log; choose another file for -o", str(target))
    if not target.resolve().parent.is_dir():
        raise InputError("the directory of the output does not exist; make it first", str(target))
    kinds = [KINDS.get(file.suffix.lower(), "text" if file is source else None) for file in (source, target)]
    if kinds[1] is not None and kinds[0] != kinds[1]:
        is_text = source.suffix.lower() in MESSAGE_FORMATS
        log = f"of a {source.suffix} log text is made" if is_text else f"the log is {kinds[0]}, and so is the output"
        message = f"{log}, but its name ends in {target.suffix}"
        raise InputError(f"{message}: choose another name", str(target))


def _descriptor(target: Path) -> int | None:
    """Return the number of the open file that a target names; None for a path."""
    found = DESCRIPTOR.fullmatch(str(target))
    return int(found[1] or 1) if found else None


class Output:
    """What is written to: an ``OSError`` becomes a message that names the output."""

    def __init__(self, stream: IO[bytes], target: Path) -> None:
        self.stream, self.target = stream, target

    def write(self, data: bytes | memoryview) -> None:
        """Write all of it."""
        with _named(self.target):
            self.stream.write(data)


@contextmanager
def replacing(target: Path) -> Iterator[Output]:
    """Open a file that takes its name only when it is complete; what stood there before is left until then.

    A symbolic link stays, and the file to which it points is replaced, with its permissions kept. Standard output,
    pipes and devices are written to as they are.
    """
    descriptor, part = _descriptor(target), None
    file = target if descriptor is not None else target.resolve()
    with _named(target):
        if descriptor is not None:
            sys.stdout.flush()
            stream = os.fdopen(os.dup(descriptor), "wb")
        elif file.exists() and not file.is_file():
            stream = file.open("wb")
        else:
            part = file.with_name(f".apply.{os.getpid()}.part")
            stream = part.open("wb")
    try:
        yield Output(stream, target)
        with _named(target):
            stream.close()
            if part is not None:
                if file.exists():
                    shutil.copymode(file, part)
                part.replace(file)
    finally:
        with suppress(OSError):
            stream.close()
        if part is not None:
            part.unlink(missing_ok=True)


@contextmanager
def _named(target: Path) -> Iterator[None]:
    try:
        yield
    except BrokenPipeError:
        raise InputError("the output was closed before it was complete", str(target)) from None
    except OSError as error:
        raise InputError(f"the output cannot be written: {error.strerror}", str(target)) from None
