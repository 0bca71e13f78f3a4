"""The published files of a campaign: replaced by a complete new set, whatever stops the exchange.

A new set is made in a folder of its own, and renamed to ``.published`` when it is complete. Each of its files and
folders then changes places with the published one of its name. If that is interrupted, the next run completes it.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
from typing import TYPE_CHECKING

from pipeline.atomic import exchange, flush_file_system, write_atomically

if TYPE_CHECKING:
    from pathlib import Path

PUBLISHED = (
    "calibrations", "validations", "diagnoses", "reports", "certificates", "exports",
    "index.html", "summary.csv", "failures.json", "parameters.parquet", "fleet.json",
)  # fmt: skip
COMPLETE, PLAN = ".published", ".plan.json"
LATER = {signal.SIGINT, signal.SIGTERM}  # they wait until the exchange is done: milliseconds


def publish_all(new: Path, results: Path) -> None:
    """Put a complete new set in place of the published one.

    Parameters
    ----------
    new : Path
        Folder of the new set, below ``results``; it is gone afterwards.
    results : Path
        Of the campaign.
    """
    inodes = {item.name: item.lstat().st_ino for item in new.iterdir()}
    write_atomically(new / PLAN, json.dumps(inodes))
    flush_file_system(results)
    new.rename(results / COMPLETE)
    finish_publishing(results)


def finish_publishing(results: Path) -> None:
    """Complete an exchange that was begun; without one, nothing is done."""
    complete = results / COMPLETE
    if not (complete / PLAN).is_file():
        shutil.rmtree(complete, ignore_errors=True)
        return
    inodes = json.loads((complete / PLAN).read_text(encoding="utf-8"))
    before = signal.pthread_sigmask(signal.SIG_BLOCK, LATER)
    try:
        for name, inode in inodes.items():
            published = results / name
            if not os.path.lexists(published):
                (complete / name).rename(published)
            elif published.lstat().st_ino != inode:
                exchange(complete / name, published)
        (complete / PLAN).unlink()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    shutil.rmtree(complete)
