"""One module per format that consumes a calibration; every module of this package that has one is used.

Each has ``FILE_NAME`` and ``export(calibration, settings, validation)``, which returns the file's text, or None where
the format can hold nothing of this unit. There is no list to extend.
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.files import write_atomically

if TYPE_CHECKING:
    from types import ModuleType


@cache
def exporters() -> tuple[ModuleType, ...]:
    """Return the modules of all formats, in alphabetical order."""
    names = sorted(f.stem for f in Path(__file__).parent.glob("*.py") if f.stem != "__init__")
    modules = (import_module(f"{__name__}.{name}") for name in names)
    return tuple(module for module in modules if hasattr(module, "FILE_NAME"))


def export_all(
    calibration: dict[str, Any], settings: dict[str, Any], folder: Path, validation: dict[str, Any] | None = None
) -> list[Path]:
    """Write a calibration in every format.

    Parameters
    ----------
    calibration : dict
        ``calibrations/<unit>.json``.
    settings : dict
        The sections ``sensor`` and ``table`` of the unit's configuration.
    folder : Path
        Made if need be.
    validation : dict, optional
        ``validations/<unit>.json``.

    Returns
    -------
    list of Path
        What was written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for module in exporters():
        text = module.export(calibration, settings, validation)
        if text is None:
            continue
        path = folder / module.FILE_NAME
        write_atomically(path, text)
        written.append(path)
    return written
