"""Names of units: files and folders are called after them."""

from __future__ import annotations

import re

ALLOWED = re.compile(r"[A-Za-z0-9._-]+")
LONGEST = 200  # a file name has at most 255 bytes; the longest of a unit's adds 41 (_accelerometer_unknown.yaml)
OF_STAGES = (".failed", ".noise", ".calibration")  # <unit>.failed.json and others lie beside <unit>.json


def wrong_name(name: str) -> str:
    """Return what is wrong with the name of a unit; nothing for a good one."""
    if not ALLOWED.fullmatch(name) or name in (".", ".."):
        return "use letters, digits, '.', '_', '-'"
    if len(name) > LONGEST:
        return f"has {len(name)} characters; {LONGEST} is the limit, as file names are made of it"
    ending = next((e for e in OF_STAGES if name.endswith(e)), "")
    return f"a name cannot end in {ending}, which marks files of another kind" if ending else ""
