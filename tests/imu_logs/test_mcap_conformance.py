"""The format's own conformance files: every message, channel, definition, attachment and metadata record."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from damaged_logs import read_messages

if TYPE_CHECKING:
    from pathlib import Path


def numbers(value: Any) -> Any:
    """Return a declared value: integers are strings in the declarations, and bytes are lists of them."""
    if isinstance(value, list):
        return bytes(map(int, value))
    return int(value) if isinstance(value, str) and value.isdigit() else value


def declared(file: Path, kind: str) -> list[dict[str, Any]]:
    records = json.loads(file.with_suffix(".json").read_text())["records"]
    return [{k: numbers(v) for k, v in r["fields"]} for r in records if r["type"] == kind]


def found(records: Any) -> list[dict[str, Any]]:
    return [vars(record) for record in records]


def distinct(records: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return records that are declared in the data and once more in the summary one time each."""
    return list({r["id"]: r for r in records}.values())


def test_conformance_files_hold_what_they_declare(reference: Path) -> None:
    files = sorted((reference / "mcap_conformance").rglob("*.mcap"))
    assert len(files) == 416
    for file in files:
        container, by_channel = read_messages(file.read_bytes())
        messages = [m for channel in by_channel.values() for m in channel]
        assert found(messages) == declared(file, "Message"), file.name
        assert found(container.channels.values()) == distinct(declared(file, "Channel")), file.name
        assert found(container.schemas.values()) == distinct(declared(file, "Schema")), file.name
        assert found(container.metadata) == declared(file, "Metadata"), file.name
        attachments = [{k: v for k, v in a.items() if k != "crc"} for a in declared(file, "Attachment")]
        assert found(container.attachments) == attachments, file.name
        assert container.header is not None
        assert [vars(container.header)] == declared(file, "Header"), file.name
