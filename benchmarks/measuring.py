"""The CPU time of a call, and of what a script measures in a process of its own."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable


def least(times: int, work: Callable[[], Any]) -> tuple[float, Any]:
    """Return the least CPU time of some calls, s, and the last result."""
    spent, result = [], None
    for _ in range(times):
        began = time.process_time()
        result = work()
        spent.append(time.process_time() - began)
    return min(spent), result


def in_own_process(script: str, *words: str) -> dict[str, Any]:
    """Return what a script prints as JSON."""
    command = [sys.executable, script, *words]
    found: dict[str, Any] = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    return found
