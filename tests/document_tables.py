"""Write the tables of documents that follow from the code: ``python tests/document_tables.py``; a test compares them.

A table stands between the comments ``<!-- NAME: tests/document_tables.py -->`` and ``<!-- end -->``.
"""

from __future__ import annotations

import re
import sys
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterable

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), *(str(ROOT / "tests" / name) for name in ("imu_logs", "preprocessing", "."))]

import bad_logs  # noqa: E402
import bad_units  # noqa: E402

from pipeline.core.verdicts import KINDS, Verdict  # noqa: E402
from pipeline.output.exports import Format, formats  # noqa: E402

PLACE = re.compile(r"(<!-- (\w+): tests/document_tables\.py -->\n).*?(<!-- end -->)", re.DOTALL)
CASES_OF = ((bad_logs.INPUTS, bad_logs.cases()), (bad_units.INPUTS, bad_units.cases()))


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a table in Markdown."""
    lines = [list(head), *map(list, rows)]
    lines.insert(1, ["---"] * len(lines[0]))
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def bad_inputs() -> str:
    """Return a row for each bad input: what happens, by the cases of the tests."""
    rows = []
    for inputs, cases in CASES_OF:
        for number, title in inputs.items():
            codes: dict[str, dict[str, None]] = {}  # by what happens, in the order of the cases
            for name, case in cases.items():
                if name.split()[0].lstrip("0") == number:
                    happens, found = outcome(case)
                    codes.setdefault(happens, {}).update(dict.fromkeys(found))
            rows.append(
                [number, title, "; ".join(" ".join([k, *(f"`{c}`" for c in v)]) for k, v in codes.items() if k)]
            )
    return table(["#", "input", "what happens"], rows)


def outcome(case: Any) -> tuple[str, list[str]]:
    """Return what happens to one input, with the settings of the case, and the codes."""
    if case.fault:
        return "refused", [case.fault]
    chosen = {
        k: v
        for k, v in getattr(case, "settings", {}).items()
        if not (isinstance(v, (dict, list)) or k.endswith("/unit"))
    }
    words = {None: "null", False: "false"}
    stated = " ".join(f"`ingest.{k.replace('/', '.')}={words.get(v, v)}`" for k, v in chosen.items())
    codes = [c for c in getattr(case, "notes", [getattr(case, "code", "")]) if stated == "" or c != "N-IGNORED"]
    happens = "noted" if codes else "read" if stated else ""
    return f"{stated}: {happens}" if stated else happens, codes


def exports() -> str:
    """Return a row for each format: what it holds, by its declaration."""
    rows = []
    for declared, _ in formats().values():
        stem, _, suffix = declared.file.rpartition(".")
        files = [f"`{stem}{ending}.{suffix}`" for ending in declared.sensor_endings.values()] or [f"`{declared.file}`"]
        units = ", ".join(
            dict.fromkeys("counts" if s in declared.required_counts else u for s, u in declared.units.items())
        )
        rows.append([", ".join(files), declared.consumer, units, held(declared)])
    return table(["file", "for", "units", "holds"], rows)


def held(declared: Format) -> str:
    """Return what a format can hold, in words."""
    if not declared.units:
        return "noise only" if declared.noise else "how the chips of a board sit"
    matrices = {"full": "matrix", "diagonal": "scale factors", "none": ""}
    read = declared.read_back
    parts = {}
    for sensor in declared.units:
        by = read.get(sensor, read.get("sensor"))
        if by is not None:  # what ``convert`` finds in the file
            bias = "" if by.get("bias") == "0 * ones" else "bias"
            parts[sensor] = " and ".join(filter(None, [bias, matrices[declared.matrix.get(sensor, "full")]]))
    same = len(set(parts.values())) == 1 and len(parts) > 1
    words = [next(iter(parts.values()))] if same else [f"{sensor}: {part}" for sensor, part in parts.items()]
    words += [
        "all effects of the sensor" if e == "all" else f"`{e}`" for e in (*declared.effects, *declared.effects_in_part)
    ]
    return ", ".join([*words, *(["noise"] if declared.noise else [])])


def sensors() -> str:
    """Return the names of the sensor files."""
    names = [
        f"`{file.stem}`" for file in sorted((ROOT / "configs" / "sensor").glob("*.yaml")) if file.stem != "generic"
    ]
    return "\n".join(textwrap.wrap(", ".join(names), 120)) + "\n"


def states() -> str:
    """Return a row for each state of a unit, the most urgent first."""
    verdicts = {*Verdict}
    rows = [[f"{k.name} (`{kind}`)" if kind in verdicts else k.name, k.meaning] for kind, k in KINDS.items()]
    return table(["state", "meaning"], rows)


TABLES = {"bad_inputs": bad_inputs, "exports": exports, "sensors": sensors, "states": states}


def with_tables(text: str) -> str:
    """Return a document with its tables as they follow from the code."""
    return PLACE.sub(lambda match: match[1] + TABLES[match[2]]() + match[3], text)


def main() -> None:
    """Write the tables of all documents."""
    for file in sorted((ROOT / "docs").glob("*.md")):
        file.write_text(with_tables(file.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
