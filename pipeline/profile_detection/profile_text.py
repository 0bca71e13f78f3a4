"""Write a proposed profile as YAML, with the evidence for each line and the columns that it does not use."""

from __future__ import annotations

import json
import re
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.io.units import TABLE_CHANNELS, TRIADS
from pipeline.profile_detection.proposal import UNITS_OF, fields_of
from pipeline.profile_detection.unit_guesses import OF_SENSOR, TO_DECIDE

if TYPE_CHECKING:
    from pipeline.profile_detection.proposal import Proposal

WIDTH = 116  # of comments in a proposed profile
WORD = re.compile(r"[A-Za-z_][\w.-]*(/[\w^]+)?")


def as_yaml(proposal: Proposal, name: str) -> str:
    """Return a proposal as the text of a profile that Hydra reads."""
    files = ", ".join(Path(f).name for f in proposal.files)
    lines = _comment(f"Proposed by python -m pipeline check for {files}. Check each line: no line is certain.")
    for remark in proposal.remarks:
        lines += _comment(f"To decide: {remark}.")
    if proposal.topic is not None:
        lines += ["defaults:", "  - canonical_csv", "  - _self_", ""]
    lines += [f"name: {_scalar(name)} # name of the profile, for the report", ""]
    if proposal.topic is not None:
        return "\n".join(lines + _topics(proposal)) + "\n"
    lines += ["csv:"]
    for key, value in proposal.csv.items():
        if key in proposal.evidence:
            lines += _comment(proposal.evidence[key], "  ")
        lines.append(f"  {key}: {_scalar(value)}")
    if proposal.parts:
        lines += ["  columns: {} # described by part", "  parts: # files of one recording, joined on equal time"]
        for part, file in enumerate(proposal.parts):
            lines += [f"    - file: {_scalar(file)}", "      columns:"]
            lines += _entries(proposal, part, "        ")
    else:
        lines += ["  columns: # channel: the column's name (or index from 0) and its unit"]
        lines += _entries(proposal, 0, "    ")
    return "\n".join(lines) + "\n"


def _topics(proposal: Proposal) -> list[str]:
    """Return the section of a profile for logs of messages."""
    lines = ["mcap: # logs of messages of every format"]
    if proposal.csv["rate_hz"] is not None:
        lines += [*_comment(proposal.evidence["rate_hz"], "  "), f"  rate_hz: {_scalar(proposal.csv['rate_hz'])}"]
    if not proposal.parts:
        return [*lines, "  topics:", f"    {_scalar(proposal.topic)}:", *_entries(proposal, 0, "      ")]
    lines.append("  parts: # files of one recording, joined on equal time")
    for part, file in enumerate(proposal.parts):
        lines += [f"    - file: {_scalar(file)}", "      topics:", f"        {_scalar(proposal.logs[part].topic)}:"]
        lines += _entries(proposal, part, "          ")
    return lines


def _entries(proposal: Proposal, part: int, indent: str) -> list[str]:
    """Return the entries of a part, the first of each sensor with its evidence, and the columns without an entry."""
    lines: list[str] = []
    explained: set[str] = set()
    columns, evidence = proposal.columns[part], proposal.evidence
    for channel, entry in (columns if proposal.topic is None else fields_of(columns)).items():
        key = next((s for s, triad in TRIADS.items() if channel in triad), channel)
        if key in evidence and key not in explained:
            lines += _comment(evidence[key], indent)
            explained.add(key)
        inner = ", ".join(f"{k}: {_scalar(v)}" for k, v in entry.items())
        lines.append(f"{indent}{channel}: {{{inner}}}")
    used = {entry["column"] for entry in columns.values()}
    unused = [f"{c} ({content})" for c, content in proposal.seen[part].items() if c not in used]
    return lines + [f"{indent}# not used: {text}" for text in unused]


def not_found(proposal: Proposal) -> list[str]:
    """Return sentences about the sensors and references without a column, and the lines to add."""
    channels = {c for entries in proposal.columns for c, e in entries.items() if e["column"] != TO_DECIDE}
    missing = [
        f"the {s}, which such a log cannot calibrate. If the log holds it, add {', '.join(triad)}, each with its "
        f"column and unit ({', '.join(UNITS_OF[s])}, or counts with counts_per_unit)."
        for s, triad in TRIADS.items()
        if not set(triad) <= channels
    ]
    if not channels & set(TABLE_CHANNELS):
        missing.append(
            "the angle or rate of a table. If a column is its encoder, add table_angle with the column and its unit: "
            "deg, rad, or counts with counts_per_unit (counts per turn / 360). Without a table, add nothing."
        )
    if "temperature" not in channels:
        missing.append("the temperature. If a column holds it, add temperature with the column and unit: degC.")
    return [line for text in missing for line in textwrap.wrap(f"NOT FOUND: {text}", WIDTH, subsequent_indent="  ")]


def _comment(text: str, indent: str = "") -> list[str]:
    return textwrap.wrap(text, WIDTH, initial_indent=f"{indent}# ", subsequent_indent=f"{indent}# ")


def _scalar(value: Any) -> str:  # noqa: ANN401  (any scalar of YAML)
    """Return a scalar as YAML: plain words without quotes, else JSON."""
    if not isinstance(value, str):
        return json.dumps(value)
    keyword = value.lower() in ("true", "false", "yes", "no", "on", "off", "null", "y", "n")
    if WORD.fullmatch(value) and not keyword:
        return value
    if value in map(OF_SENSOR.format, TRIADS):
        return json.dumps(value)
    return json.dumps(value, ensure_ascii=False).replace("${", "\\\\${")
