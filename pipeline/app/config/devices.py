"""Add effects to, or remove them from, the file of one unit, ``<campaign>/devices/<unit>.yaml``.

The file keeps its comments and its other content: an entry is replaced in place, a new one is added behind the last. If
a layer with precedence over the file (``units.csv``, the command line) sets the effects, the edit would have no result:
it is refused, and the message names the place to edit.
"""

from __future__ import annotations

import functools
import json
from typing import TYPE_CHECKING, NamedTuple

import yaml

from imu_logs.units import SENSORS
from pipeline.app.config.layers import DEVICES_FOLDER, key_of
from pipeline.app.config.options import Problem, nearest, parse
from pipeline.core.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from pipeline.app.config.compose import Composer
    from pipeline.app.config.layers import Layer, Layers

OVERRIDES_KEY = "overrides"


class Edit(NamedTuple):
    """A device file, its new content (None: the file is removed), and a line about each effect."""

    file: Path
    text: str | None
    changes: list[str]


def sensor_and_effect(text: str) -> tuple[str, str]:
    """Split ``SENSOR.EFFECT``; raises ``ConfigurationError`` for another form or an unknown sensor."""
    sensor, dot, effect = text.partition(".")
    if not dot or not effect:
        raise ConfigurationError(f"{text!r}: SENSOR.EFFECT is expected, for example gyroscope.g_sensitivity")
    if sensor not in SENSORS:
        raise ConfigurationError(f"{text!r}: no sensor is called {sensor!r}{nearest(sensor, SENSORS)}")
    return sensor, effect


def edit_effects(
    unit: str, effects: Sequence[tuple[str, str]], layers: Layers, composer: Composer, *, remove: bool = False
) -> Edit:
    """Add effects (sensor and name) to the device file of a unit, or remove them; return the edit.

    Raises ``ConfigurationError`` if the unit or an effect is unknown, if a stronger layer sets the effects, or if the
    file cannot be edited.
    """
    file = _file(unit, layers, composer.campaign)
    text = file.read_bytes().decode() if file.is_file() else ""  # keeps line ends
    of_unit = layers.of(unit)
    changes: list[str] = []
    for sensor in dict.fromkeys(sensor for sensor, _ in effects):
        key = f"effects.{sensor}"
        _refuse_stronger(of_unit, key, composer.campaign, unit)
        weaker = _value([layer for layer in of_unit if layer.origin != f"{DEVICES_FOLDER}/{unit}.yaml"], key)
        now = _value(of_unit, key)
        wanted = list(now)
        for name in (name for s, name in effects if s == sensor):
            if not remove:
                changes.append(
                    f"unit {unit}: {f'{key} has {name} already' if name in now else f'{name} added to {key}'}"
                )
                wanted += [name] * (name not in wanted)
            elif name in now:
                changes.append(f"unit {unit}: {name} removed from {key}")
                wanted.remove(name)
            else:
                known = f"it has {', '.join(now)}" if now else "it has none"
                raise ConfigurationError(f"unit {unit}: {name} is not among its {key}; {known}")
        override = f"{key}=[{','.join(wanted)}]"
        try:
            composer.unit(unit, [*(layer.text for layer in of_unit), override])
        except Problem as problem:
            raise ConfigurationError(f"unit {unit}: {problem}") from None
        if wanted != now:
            text = set_override(text, key, None if wanted == weaker else override, str(file))
    empty = all(line.strip() in ("", f"{OVERRIDES_KEY}:", f"{OVERRIDES_KEY}: []") for line in text.splitlines())
    return Edit(file, None if empty else text, changes)


def _file(unit: str, layers: Layers, directory: Path) -> Path:
    """Return the device file of a unit; the unit must exist, and its name must not be the serial of another unit."""
    rows, units_table = layers.units_table.rows, str(directory / "units.csv")
    if unit not in rows:
        raise ConfigurationError(f"no unit {unit!r}{nearest(unit, rows)}", units_table)
    others = [u for u, row in rows.items() if row.get("serial") == unit and u != unit]
    if others:
        both = f"{DEVICES_FOLDER}/{unit}.yaml would concern {', '.join(others)} too, whose serial is {unit}"
        raise ConfigurationError(f"{both}: give the unit or the serial another name", units_table)
    return directory / DEVICES_FOLDER / f"{unit}.yaml"


def set_override(text: str, key: str, override: str | None, file: str) -> str:
    """Replace, add or (``override`` None) remove the override of a key in the text of a device file.

    Raises ``ConfigurationError`` if the file has a form that cannot be edited in place.
    """
    expected = _changed([(entry, entry) for entry in _overrides(text)], key, override, override)
    edited = _edited(text, key, override)
    try:
        correct = _overrides(edited) == expected
    except (yaml.YAMLError, ConfigurationError):
        correct = False
    if not correct:
        what = f"remove {key}" if override is None else f"write {override!r}"
        raise ConfigurationError(f"cannot be edited in place: {what} yourself, in its list '{OVERRIDES_KEY}'", file)
    return edited


def _changed(entries: Sequence[tuple[str, str]], key: str, override: str | None, written: str | None) -> list[str]:
    """Return the texts of entries (value, text) after the entry of a key is replaced, added or (None) removed."""
    if override is None or written is None:
        return [text for value, text in entries if key_of(value) != key]
    texts = [written if key_of(value) == key else text for value, text in entries]
    return texts if written in texts else [*texts, written]


def _edited(text: str, key: str, override: str | None) -> str:
    """Return the text with the entry changed in place, or the same text if a comment would be lost."""
    root = yaml.compose(text, yaml.SafeLoader)
    pairs = root.value if isinstance(root, yaml.MappingNode) else []
    node = next((value for name, value in pairs if name.value == OVERRIDES_KEY), None)
    written = None if override is None else json.dumps(override, ensure_ascii=False)
    if node is None:
        end = "" if not text or text.endswith("\n") else "\n"
        return f"{text}{end}{OVERRIDES_KEY}:\n  - {written}\n"
    if isinstance(node, yaml.SequenceNode) and not node.flow_style:
        return _edited_lines(text, node.value, key, written)
    start, stop = node.start_mark.index, node.end_mark.index
    if isinstance(node, yaml.ScalarNode):  # one override as a text, or no value
        entries = [(node.value, json.dumps(node.value, ensure_ascii=False))] if node.tag.endswith(":str") else []
    else:
        entries = [(item.value, text[item.start_mark.index : item.end_mark.index]) for item in node.value]
        if "#" in functools.reduce(lambda rest, entry: rest.replace(entry[1], "", 1), entries, text[start:stop]):
            return text
    space = " " if text[:start].endswith(":") else ""
    return f"{text[:start]}{space}[{', '.join(_changed(entries, key, override, written))}]{text[stop:]}"


def _edited_lines(text: str, items: Sequence[yaml.Node], key: str, written: str | None) -> str:
    """Return the text with an item of a block list replaced, added as the last, or (None) removed with its line."""
    of_key = [item for item in items if key_of(item.value) == key]
    for item in reversed(of_key):
        first, last = item.start_mark.index, item.end_mark.index
        if written is None:
            after = text.find("\n", last)
            text = text[: text.rfind("\n", 0, first) + 1] + (text[after + 1 :] if after >= 0 else "")
        else:
            text = text[:first] + written + text[last:]
    if of_key or written is None:
        return text
    end = text.find("\n", items[-1].end_mark.index)
    end = len(text) if end < 0 else end
    indent = " " * (items[0].start_mark.column - 2)
    return f"{text[:end]}\n{indent}- {written}{text[end:] or chr(10)}"


def _overrides(text: str) -> list[str]:
    content = yaml.safe_load(text) or {}
    if not isinstance(content, dict):
        raise ConfigurationError("a mapping is expected")
    entries = content.get(OVERRIDES_KEY) or []
    return [entries] if isinstance(entries, str) else list(entries)


def _refuse_stronger(layers: Sequence[Layer], key: str, directory: Path, unit: str) -> None:
    """Raise ``ConfigurationError`` if a layer with precedence over the device file sets the effects."""
    for origin, text in layers:
        if key_of(text) not in (key, "effects"):
            continue
        if origin.startswith("units.csv line"):
            line = origin.removeprefix("units.csv line ").split(",")[0]
            raise ConfigurationError(
                f"the column overrides sets {text} for unit {unit}, which is stronger than "
                f"{DEVICES_FOLDER}/{unit}.yaml: edit this cell, or clear it",
                f"{directory / 'units.csv'}:{line}",
            )
        if origin.startswith("command line"):
            raise ConfigurationError(
                f"--config {origin.removeprefix('command line, ')}{text} is stronger than "
                f"{DEVICES_FOLDER}/{unit}.yaml for unit {unit}: leave it out"
            )


def _value(layers: Sequence[Layer], key: str) -> list[str]:
    """Return the effects that the strongest of the layers (weakest first) sets."""
    sensor, effects = key.partition(".")[2], list[str]()
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
        effects = [str(v) for v in value]
    return effects
