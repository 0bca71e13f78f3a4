"""Files of stages as tests write and read them: packs, recordings, exports."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from pipeline.core.pack import Pack, as_bytes, new_pack
from pipeline.ingest.arrow import from_parquet, to_parquet
from pipeline.output.exports import exports

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from pipeline.core.records import Recording
    from pipeline.core.settings import Settings


def write_pack(path: Path, files: dict[str, Any]) -> Path:
    with new_pack(path) as add:
        add({name: as_bytes(content) for name, content in files.items()})
    return path


def documents(path: Path) -> dict[str, Any]:
    """Return the JSON documents of a pack."""
    pack = Pack(path)
    return {name: json.loads(pack.read(name)) for name in pack.names() if name.endswith(".json")}


def save_recordings(path: Path, recordings: Sequence[Recording]) -> None:
    path.write_bytes(to_parquet(recordings))


def load_recordings(path: Path) -> list[Recording]:
    return from_parquet(path.read_bytes(), str(path))


def export_all(document: dict[str, Any], settings: Settings, folder: Path) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in exports(document, settings).items():
        (folder / name).write_text(text, encoding="utf-8")
    return sorted(folder.iterdir())
