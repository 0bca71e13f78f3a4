"""Which paths are regular files: to open a FIFO waits for ever, a device may never end."""

from __future__ import annotations

import os
import stat
from typing import TYPE_CHECKING

from pipeline.errors import ConfigurationError

if TYPE_CHECKING:
    from pathlib import Path

KINDS = {
    stat.S_IFDIR: "a directory",
    stat.S_IFIFO: "a FIFO",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


def not_regular(path: Path) -> str:
    """Return why a path cannot be read as a file; nothing for a regular file, or a link to one.

    Raises
    ------
    OSError
        If the path does not exist, or a folder above it cannot be searched.
    """
    try:
        kind = stat.S_IFMT(path.stat().st_mode)
    except FileNotFoundError:
        if not os.path.lexists(path):
            raise
        return f"is a symbolic link to {path.readlink()}, which does not exist; correct the link or remove it"
    if kind == stat.S_IFREG:
        return ""
    return f"is {KINDS.get(kind, 'no regular file')}; a regular file, or a symbolic link to one, is expected"


def read_text(path: Path, largest: int, what: str) -> str:
    """Return the text of a UTF-8 file, of which at most ``largest`` bytes are read.

    Parameters
    ----------
    path : Path
    largest : int
        Bytes.
    what : str
        What the file holds, for the message: ``settings``.

    Raises
    ------
    ConfigurationError
        If it is no regular file, cannot be read, is not UTF-8, or is larger.
    """
    try:
        other = not_regular(path)
        if other:
            raise ConfigurationError(other, str(path))
        with path.open("rb") as stream:
            content = stream.read(largest + 1)
        text = content.decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"cannot be read: {error}", str(path)) from None
    if len(content) > largest:
        raise ConfigurationError(f"has more than {largest} bytes, the limit for {what}", str(path))
    return text
