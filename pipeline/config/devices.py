"""Effects of one unit, added to or taken from its file ``<campaign>/devices/<unit>.yaml``.

The file keeps its comments and its other content: an entry is replaced where it stands, or a new one is put behind the
last. A layer that is stronger than the file (``units.csv``, the command line) would make the edit ineffective, so it is
refused with the place to edit.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING

import yaml

from pipeline.config.compose import Problem, nearest, parse
from pipeline.config.layers import DEVICES
from pipeline.errors import ConfigurationError
from pipeline.records import SENSORS

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from pipeline.config.compose import Composer
    from pipeline.config.layers import Layer, Layers

KEY = "overrides"


@dataclass(frozen=True)
class Edit:
    """What a device file is to hold.

    Attributes
    ----------
    file : Path
    text : str or None
        Its new content; None where it is to be removed.
    said : list of str
        What changes, one line for each effect.
    """

    file: Path
    text: str | None
    said: list[str]


def sensor_and_effect(text: str) -> tuple[str, str]:
    """Split ``SENSOR.EFFECT``.

    Raises
    ------
    ConfigurationError
        If it has another form, or names no sensor.
    """
    sensor, dot, effect = text.partition(".")
    if not dot or not effect:
        raise ConfigurationError(f"{text!r}: SENSOR.EFFECT is expected, for example gyroscope.g_sensitivity")
    if sensor not in SENSORS:
        raise ConfigurationError(f"{text!r}: no sensor is called {sensor!r}{nearest(sensor, SENSORS)}")
    return sensor, effect


def edit_effects(
    directory: Path,
    unit: str,
    effects: Sequence[tuple[str, str]],
    layers: Layers,
    composer: Composer,
    *,
    remove: bool = False,
) -> Edit:
    """Return the unit's device file with effects added or removed.

    Parameters
    ----------
    directory : Path
        Of the campaign.
    unit : str
    effects : sequence of (str, str)
        Sensor and effect.
    layers : Layers
        Of the campaign, with what the command line gives.
    composer : Composer
    remove : bool
        Whether the effects are removed.

    Raises
    ------
    ConfigurationError
        If the unit or an effect is unknown, a stronger layer sets the effects, or the file cannot be edited.
    """
    file = _file(directory, unit, layers)
    text = file.read_bytes().decode() if file.is_file() else ""  # line ends as they are
    of_unit = layers.of(unit)
    said: list[str] = []
    for sensor in dict.fromkeys(sensor for sensor, _ in effects):
        key = f"effects.{sensor}"
        _refuse_stronger(of_unit, key, directory, unit)
        weaker = _value([layer for layer in of_unit if layer.origin != f"{DEVICES}/{unit}.yaml"], key)
        now = _value(of_unit, key)
        names = [name for s, name in effects if s == sensor]
        wanted = _removed(unit, key, now, names, said) if remove else _added(unit, key, now, names, said)
        try:
            composer.unit(unit, [*(layer.text for layer in of_unit), _override(key, wanted)])
        except Problem as problem:
            raise ConfigurationError(f"unit {unit}: {problem}") from None
        if wanted != now:
            text = set_override(text, key, None if wanted == weaker else _override(key, wanted), str(file))
    kept = any(line.strip() not in ("", f"{KEY}:", f"{KEY}: []") for line in text.splitlines())
    return Edit(file, text if kept else None, said)


def _file(directory: Path, unit: str, layers: Layers) -> Path:
    """Return the device file of a unit, which must exist and share its name with no serial of another."""
    rows, sheet = layers.sheet.rows, str(directory / "units.csv")
    if unit not in rows:
        raise ConfigurationError(f"no unit {unit!r}{nearest(unit, rows)}", sheet)
    others = [u for u, row in rows.items() if row.get("serial") == unit and u != unit]
    if others:
        both = f"{DEVICES}/{unit}.yaml would concern {', '.join(others)} too, whose serial is {unit}"
        raise ConfigurationError(f"{both}: give the unit or the serial another name", sheet)
    return directory / DEVICES / f"{unit}.yaml"


def _added(unit: str, key: str, now: Sequence[str], names: Sequence[str], said: list[str]) -> list[str]:
    told = [f"{key} has {name} already" if name in now else f"{name} added to {key}" for name in names]
    said += [f"unit {unit}: {text}" for text in told]
    return list(dict.fromkeys([*now, *names]))


def _removed(unit: str, key: str, now: Sequence[str], names: Sequence[str], said: list[str]) -> list[str]:
    for name in names:
        if name not in now:
            known = f"it has {', '.join(now)}" if now else "it has none"
            raise ConfigurationError(f"unit {unit}: {name} is not among its {key}; {known}")
        said.append(f"unit {unit}: {name} removed from {key}")
    return [name for name in now if name not in names]


def set_override(text: str, key: str, override: str | None, file: str) -> str:
    """Return a device file with the override of a key replaced, added, or (None) removed; all else stays as it is.

    Parameters
    ----------
    text : str
        Of the file; may be empty.
    key : str
    override : str or None
        ``key=value``.
    file : str
        For the message.

    Raises
    ------
    ConfigurationError
        If the file has a form that cannot be edited in place.
    """
    before = _listed(text)
    wanted = [entry for entry in before if _key(entry) != key] if override is None else []
    if override is not None:
        wanted = [override if _key(entry) == key else entry for entry in before]
        wanted += [override] * (override not in wanted)
    edited = _edited(text, key, override)
    try:
        as_wanted = _listed(edited) == wanted
    except (yaml.YAMLError, ConfigurationError):
        as_wanted = False
    if not as_wanted:
        what = f"remove {key}" if override is None else f"write {override!r}"
        raise ConfigurationError(f"cannot be edited in place: {what} yourself, in its list '{KEY}'", file)
    return edited


def _edited(text: str, key: str, override: str | None) -> str:
    """Return the text with the entry replaced, added or removed where YAML says that it stands."""
    root = yaml.compose(text, yaml.SafeLoader)
    pairs = root.value if isinstance(root, yaml.MappingNode) else []
    node = next((value for name, value in pairs if name.value == KEY), None)
    quoted = json.dumps(override, ensure_ascii=False)
    if node is None:
        end = "" if not text or text.endswith("\n") else "\n"
        return f"{text}{end}{KEY}:\n  - {quoted}\n"
    start, stop = node.start_mark.index, node.end_mark.index
    if isinstance(node, yaml.ScalarNode):  # one override as a text, or nothing
        entries = [entry for entry in [node.value] if entry and node.tag.endswith(":str")]
        kept = [json.dumps(e, ensure_ascii=False) for e in entries if _key(e) != key]
        kept += [quoted] * (override is not None)
        space = " " if text[:start].endswith(":") else ""
        return f"{text[:start]}{space}[{', '.join(kept)}]{text[stop:]}"
    items = node.value
    found = [item for item in items if _key(item.value) == key]
    if found and override is not None:
        first, last = found[-1].start_mark.index, found[-1].end_mark.index
        return text[:first] + quoted + text[last:]
    if override is None:
        return _without(text, node, found)
    if node.flow_style:
        comma = ", " if items else ""
        return f"{text[: stop - 1].rstrip().rstrip(',')}{comma}{quoted}{text[stop - 1 :]}"
    last = items[-1].end_mark.index
    line_end = text.find("\n", last)
    line_end = len(text) if line_end < 0 else line_end
    indent = " " * (items[0].start_mark.column - 2)
    return f"{text[:line_end]}\n{indent}- {quoted}{text[line_end:] or chr(10)}"


def _without(text: str, node: yaml.SequenceNode, found: Sequence[yaml.Node]) -> str:
    """Return the text without some items of a list; a block list loses their lines."""
    for item in reversed(found):
        first, last = item.start_mark.index, item.end_mark.index
        if node.flow_style:
            rest = text[last:].lstrip()
            if rest.startswith(","):
                text = text[:first] + rest[1:].lstrip()
            else:
                text = text[:first].rstrip().removesuffix(",") + text[last:]
        else:
            line = text.rfind("\n", 0, first) + 1
            after = text.find("\n", last)
            text = text[:line] + (text[after + 1 :] if after >= 0 else "")
    return text


def _listed(text: str) -> list[str]:
    content = yaml.safe_load(text) or {}
    if not isinstance(content, dict):
        raise ConfigurationError("a mapping is expected")
    entries = content.get(KEY) or []
    return [entries] if isinstance(entries, str) else list(entries)


def _refuse_stronger(layers: Sequence[Layer], key: str, directory: Path, unit: str) -> None:
    """Refuse where a layer above the device file sets the effects."""
    for origin, text in layers:
        if _key(text) not in (key, "effects"):
            continue
        if origin.startswith("units.csv line"):
            line = origin.removeprefix("units.csv line ").split(",")[0]
            raise ConfigurationError(
                f"the column overrides sets {text} for unit {unit}, which is stronger than {DEVICES}/{unit}.yaml: "
                "edit this cell, or clear it",
                f"{directory / 'units.csv'}:{line}",
            )
        if origin.startswith("command line"):
            raise ConfigurationError(
                f"--config {origin.removeprefix('command line, ')}{text} is stronger than {DEVICES}/{unit}.yaml for "
                f"unit {unit}: leave it out"
            )


def _value(layers: Sequence[Layer], key: str) -> list[str]:
    """Return the effects that layers give, weakest first."""
    sensor, found = key.partition(".")[2], []
    for origin, text in layers:
        name, value = parse(text)
        if name == "effects" and isinstance(value, dict) and sensor in value:
            value = value[sensor]
        elif name != key:
            continue
        if not isinstance(value, list):
            raise ConfigurationError(
                f"{text} ({origin}): the effects are no list, so none can be added to or removed from it; "
                f"write {key}=[...] there"
            )
        found = [str(v) for v in value]
    return found


def _override(key: str, effects: Sequence[str]) -> str:
    return f"{key}=[{','.join(effects)}]"


def _key(text: str) -> str:
    return str(text).partition("=")[0].strip().lstrip("+")
