"""What each job wrote: so files that were changed or deleted since are seen, and made again.

Snakemake looks at the time of a job's output folder alone. So each job keeps, in ``<results>/logs/written/``, a digest
of the names, sizes and times of its files, and how often the job was repeated because they had changed::

    {"again": 0, "files": {"": "5f70bf18a086007016e948b04aed3b82..."}}

Where the files differ from the digest when a run starts, ``again`` is one more. It is part of what the job reads of the
configuration, and Snakemake repeats a job whose configuration has changed. A folder without a record is taken as it is.
"""

from __future__ import annotations

import hashlib
import json
import os
from typing import TYPE_CHECKING

from pipeline.atomic import write_atomically

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

NOT_OURS = ".snakemake_timestamp"  # Snakemake writes it into every output folder


def keep_record(results: Path, output: str, again: int, names: Sequence[str] = ("",)) -> None:
    """Keep what a job wrote.

    Parameters
    ----------
    results : Path
        Of the campaign.
    output : str
        Of the job, below ``results``.
    again : int
        As ``times_again`` said when the run was started.
    names : sequence of str
        Files and folders below the output; the output itself where it is all the job's.
    """
    files = {name: _digest(results / output / name) for name in names}
    write_atomically(_record(results, output), json.dumps({"again": again, "files": files}, sort_keys=True))


def times_again(results: Path, output: str) -> tuple[int, list[str]]:
    """Return how often an output has been made again after a change, and what has changed since it was made.

    An output that is not there is made by Snakemake in any case.
    """
    try:
        record = json.loads(_record(results, output).read_text(encoding="utf-8"))
        again, files = int(record["again"]), dict(record["files"])
    except (OSError, ValueError, KeyError, TypeError):
        return 0, []
    if not (results / output).exists():
        return again, []
    changed = [
        os.path.normpath(results / output / n) for n, digest in files.items() if _digest(results / output / n) != digest
    ]
    return again + bool(changed), changed


def _record(results: Path, output: str) -> Path:
    return results / "logs" / "written" / f"{output.replace('/', '+') or 'published'}.json"


def _digest(path: Path) -> str:
    """Return a digest of the names, sizes and times of a file, or of all files below a folder."""
    lines: list[str] = []
    folders = [str(path)]
    while folders:
        folder = folders.pop()
        try:
            with os.scandir(folder) as entries:
                for entry in entries:
                    if entry.is_dir(follow_symlinks=False):
                        folders.append(entry.path)
                    elif entry.name != NOT_OURS:
                        found = entry.stat(follow_symlinks=False)
                        lines.append(f"{entry.path}\0{found.st_size}\0{found.st_mtime_ns}")
        except NotADirectoryError:
            found = os.lstat(folder)
            lines.append(f"{folder}\0{found.st_size}\0{found.st_mtime_ns}")
        except FileNotFoundError:
            lines.append(f"{folder}\0absent")
    lines.sort()
    text = "\n".join(lines).replace(str(path), "")  # results may be moved
    return hashlib.sha256(text.encode(errors="surrogateescape")).hexdigest()[:32]
