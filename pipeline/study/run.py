"""Run the cases of a study, in some processes, and keep what was said.

    <directory>/truth.jsonl      what is hidden in each case, and how far it stands out of the noise
    <directory>/results.jsonl    what the diagnosis said of it, and a digest of the code that said it

A case whose result is there is not run again, so that a study can be interrupted and made larger.
"""

from __future__ import annotations

import json
import os
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import TYPE_CHECKING, Any

from pipeline.config import code_digest
from pipeline.errors import ConfigurationError
from pipeline.study.cases import draw
from pipeline.study.judge import judge
from pipeline.study.signal_left import signals_left

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

TRUTH, RESULTS = "truth.jsonl", "results.jsonl"
JSON = dict[str, Any]
Planned = tuple[str, int, int]


def run_study(
    directory: Path,
    families: Sequence[str],
    count: int,
    seed: int,
    *,
    processes: int,
    progress: Callable[[int, int], None],
) -> None:
    """Run what is not there yet.

    Parameters
    ----------
    directory : Path
        Made if need be.
    families : sequence of str
    count : int
        Cases of each family.
    seed : int
    processes : int
    progress : callable
        Told how many of how many are done.

    Raises
    ------
    ConfigurationError
        If the directory holds cases of another seed.
    """
    directory.mkdir(parents=True, exist_ok=True)
    _refuse_another_seed(directory / TRUTH, seed)
    done = {line["key"] for line in read_lines(directory / RESULTS)}
    code = code_digest("pipeline.study.judge")
    planned: list[Planned] = [(family, number, seed) for number in range(count) for family in families]
    planned = [item for item in planned if draw(*item).key not in done]
    with (
        (directory / TRUTH).open("a", encoding="utf-8") as truth,
        (directory / RESULTS).open("a", encoding="utf-8") as results,
    ):
        for number, (hidden, entries) in enumerate(_judged(planned, processes), start=1):
            truth.write(json.dumps(hidden) + "\n")
            results.write("".join(json.dumps({**entry, "code": code}) + "\n" for entry in entries))
            truth.flush()
            results.flush()
            progress(number, len(planned))


def _refuse_another_seed(truth: Path, seed: int) -> None:
    found = {line["seed"] for line in read_lines(truth)} - {seed}
    if found:
        raise ConfigurationError(
            f"holds cases of seed {min(found)}, not {seed}; choose another directory, or that seed", str(truth)
        )


def _judged(planned: Sequence[Planned], processes: int) -> Iterator[tuple[JSON, list[JSON]]]:
    if processes == 1:
        yield from map(judged, planned)
        return
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(name, "1")  # a process is one core
    with ProcessPoolExecutor(processes, get_context("spawn")) as pool:
        yield from pool.map(judged, planned, chunksize=4)


def judged(planned: Planned) -> tuple[JSON, list[JSON]]:
    """Return the truth of a case and what was said of it; a fault is a result, not the end of the study."""
    case = draw(*planned)
    hidden = {**case.to_json(), "signal_left": signals_left(case)}
    try:
        return hidden, judge(case)
    except Exception as error:  # noqa: BLE001  (whatever it is, it is what the diagnosis did with this case)
        return hidden, [{"key": case.key, "sensor": case.sensor, "error": f"{type(error).__name__}: {error}"}]


def read_lines(path: Path) -> list[JSON]:
    """Return the entries of a file of one JSON document a line; none where it is not there."""
    if not path.is_file():
        return []
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines() if line]
