"""Which paths are regular files: to open a FIFO waits for ever, a device may never end. Standard library only."""

from __future__ import annotations

import os
import stat
from typing import TYPE_CHECKING

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
