"""A proposed profile as YAML, each guess below what speaks for it."""

from __future__ import annotations

import json
import re
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.io.units import TRIADS

if TYPE_CHECKING:
    from pipeline.profile_detection.proposal import Entries, Proposal

WIDTH = 116


def as_yaml(proposal: Proposal, name: str) -> str:
    """Return a proposal as the text of a profile that Hydra reads."""
    files = ", ".join(Path(f).name for f in proposal.files)
    lines = _comment(f"Proposed by python -m pipeline check for {files}. Read each line: nothing of it is certain.")
    for remark in proposal.remarks:
        lines += _comment(f"To decide: {remark}.")
    lines += [f"name: {_scalar(name)} # name of the profile, for the report", "", "csv:"]
    for key, value in proposal.csv.items():
        if key in proposal.evidence:
            lines += _comment(proposal.evidence[key], "  ")
        lines.append(f"  {key}: {_scalar(value)}")
    if proposal.parts:
        lines += ["  columns: {} # described by part", "  parts: # files of one recording, joined on equal time"]
        for file, entries in zip(proposal.parts, proposal.columns, strict=True):
            lines += [f"    - file: {_scalar(file)}", "      columns:"]
            lines += _entries(entries, proposal.evidence, "        ")
    else:
        lines += ["  columns: # channel: the column's name (or index from 0) and its unit"]
        lines += _entries(proposal.columns[0], proposal.evidence, "    ")
    return "\n".join([*lines, "", "mcap: {}"]) + "\n"


def _entries(entries: Entries, evidence: dict[str, str], indent: str) -> list[str]:
    lines: list[str] = []
    said: set[str] = set()
    for channel, entry in entries.items():
        key = next((s for s, triad in TRIADS.items() if channel in triad), channel)
        if key in evidence and key not in said:
            lines += _comment(evidence[key], indent)
            said.add(key)
        inner = ", ".join(f"{k}: {_scalar(v)}" for k, v in entry.items())
        lines.append(f"{indent}{channel}: {{{inner}}}")
    return lines


def _comment(text: str, indent: str = "") -> list[str]:
    return textwrap.wrap(text, WIDTH, initial_indent=f"{indent}# ", subsequent_indent=f"{indent}# ")


def _scalar(value: Any) -> str:  # noqa: ANN401  (any scalar of YAML)
    """Return a scalar as YAML: JSON is YAML; plain words need no quotes."""
    if isinstance(value, str) and re.fullmatch(r"[A-Za-z_][\w.-]*(/[\w^]+)?", value) and not _is_keyword(value):
        return value
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("${", "\\\\${")
    return json.dumps(value)


def _is_keyword(value: str) -> bool:
    return value.lower() in ("true", "false", "yes", "no", "on", "off", "null", "y", "n")
