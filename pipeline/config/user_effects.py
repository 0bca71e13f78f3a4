"""Effects of the user's own that a campaign brings: formulas beside it, Python files from the command line alone."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.errors import ConfigurationError, PipelineError
from pipeline.files import CONFIGS
from pipeline.io.files import not_regular

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from pipeline.model.effects.base import Effect

PYTHON = "python_effects"
BUILT_IN = r"(?m)^built_in: true"  # a file of configs/effect/ that ships
ONLY_FROM_THE_COMMAND_LINE = (
    "an effect in Python is code, and is loaded only where the command line names it: "
    "--config 'python_effects=[path/to/my_effect.py]'"
)


@dataclass(frozen=True)
class UserEffects:
    """The effects of the user's own.

    Attributes
    ----------
    python : dict of str to dict
        Of those in Python, by name: ``path`` and ``sha256``.
    """

    effects: dict[str, Effect] = field(default_factory=dict)
    python: dict[str, dict[str, str]] = field(default_factory=dict)

    def section(self) -> dict[str, Any]:
        """Return what goes into the configuration of each unit; empty where there are none."""
        if not self.effects:
            return {}
        formulas = [e.definition for name, e in self.effects.items() if name not in self.python]
        return {"user_effects": {"formulas": formulas, "python": list(self.python.values())}}

    def add_limits(self, sheets: dict[str, Any]) -> None:
        """Put the effects' limits beside those of the data sheets, which go before them."""
        for each in self.effects.values():
            for sensor in each.sensors:
                given = sheets[sensor]["effects"]
                if each.name not in given:
                    sheets[sensor]["effects"] = {**each.limits(sensor), **given}


def load_user_effects(campaign: Path, configs: Iterable[Path], python: Sequence[str]) -> UserEffects:
    """Read ``<campaign>/effects``, ``<configs>/effect`` and the Python files that the command line names.

    Raises ``ConfigurationError`` with a line for each file that is not as it should be.
    """
    found: dict[str, Effect] = {}
    places: dict[str, str] = {}
    hashes: dict[str, dict[str, str]] = {}
    problems: list[str] = []

    def add(effects: Mapping[str, Effect], place: Path) -> None:
        for name, each in effects.items():
            if name in found:
                problems.append(f"{place}: the effect {name} is also in {places[name]}; name one of them otherwise")
            found[name], places[name] = each, str(place)

    folders = [campaign / "effects", *(root / "effect" for root in configs)]
    own, shipped = campaign.resolve(), CONFIGS / "effect"
    files = {
        folder: [
            f
            for f in sorted(folder.glob("*.yaml"))
            if not _ships(f) or (f.resolve().is_relative_to(own) and f.resolve().parent != shipped)
        ]
        for folder in folders
    }
    if not any(files.values()) and not python:
        return UserEffects()
    from pipeline.model.effects.files import load_python_effect, read_effect_files  # noqa: PLC0415  (imports numpy)

    for folder, those in files.items():
        try:
            add(read_effect_files(those), folder)
        except PipelineError as error:
            problems.append(str(error))
    for text in python:
        path = Path(text).expanduser().resolve()
        try:
            each = load_python_effect(path)
        except PipelineError as error:
            problems.append(str(error))
            continue
        add({each.name: each}, path)
        hashes[each.name] = {"path": str(path), "sha256": str((each.definition or {})["sha256"])}
    if problems:
        raise ConfigurationError("the configuration is refused:\n" + "\n".join(f"  {p}" for p in problems))
    return UserEffects(found, hashes)


def effects_for(stage: str, sensor: str, configs: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Return those effects of the user's own that a stage of some units needs; empty where there are none.

    A fit needs those that are asked for, or all where they are selected; diagnosis and report know all of them. The
    other stages read fitted effects, which carry their formulas themselves, but not their Python.
    """
    units = list(configs)
    section = next((c["user_effects"] for c in units if "user_effects" in c), None)
    if section is None or stage not in ("effects", "validate", "diagnose", "export", "report"):
        return {}
    if stage not in ("diagnose", "report"):
        wanted: set[str] = set()
        for config in units:
            for of, names in config["effects"].items():
                if sensor in ("", of):
                    wanted |= {"auto"} if names == "auto" else set(names)
        everything = "auto" in wanted
        formulas = section["formulas"] if stage == "effects" else []
        section = {
            "formulas": [d for d in formulas if everything or d["name"] in wanted],
            "python": [e for e in section["python"] if everything or Path(e["path"]).stem in wanted],
        }
    return {"user_effects": section} if section["formulas"] or section["python"] else {}


def _ships(file: Path) -> bool:
    """Return whether a file is that of a built-in effect."""
    try:
        other = not_regular(file)
        if other:
            raise ConfigurationError(other, str(file))
        return re.search(BUILT_IN, file.read_text(encoding="utf-8", errors="replace")) is not None
    except OSError as error:
        raise ConfigurationError(f"cannot be read: {error}", str(file)) from None
