"""Add effects to units in <campaign>/devices/<unit>.yaml, and run the campaign.

The file keeps its comments and its other content: an entry is replaced in place, a new one is added behind the last. If
a layer with precedence over the file (``units.csv``, the command line) sets the effects, the edit would have no result:
it is refused, and the message names the place to edit.
"""

from __future__ import annotations

import argparse
import functools
import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from itertools import chain, count
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from pipeline.app.commands import add_run_options, parser_of
from pipeline.app.commands.run import run_snakemake
from pipeline.app.config.campaign import TAKE_OVER, find_campaign, read_layers, require_unit
from pipeline.app.config.compose import Composer
from pipeline.app.config.layers import DEVICES_FOLDER, Layer, Layers, key_of
from pipeline.app.config.options import nearest, parse
from pipeline.app.config.owner import require_own_results
from pipeline.core.errors import ConfigurationError, MissingInputError, PipelineError, shortened
from pipeline.core.files import write_atomically
from pipeline.core.pack import read_published
from pipeline.core.records import SENSOR_UNITS, SENSORS
from pipeline.core.verdicts import Verdict
from pipeline.output.exports import ExportedUnit
from pipeline.output.outcome import NAMED_PER_LINE, changes_of, read_summary, run_command
from pipeline.physics.effects import catalogue

OVERRIDES_KEY = "overrides"
SMALLEST_CHANGE_OF_A_FILE = 0.1  # of its held-out error, which is said
EPILOG = """\
Added effects are part of the model of the unit in every run, until they are removed. The run repeats the stages that
depend on them, and its last lines state the change of the held-out error.

examples:
  python -m pipeline add demo mpu6050-2-hidden gyroscope.g_sensitivity
  python -m pipeline add my_bench U1 gyroscope.g_sensitivity accelerometer.lever_arm --no-run
  python -m pipeline add my_fleet --missing                 to each unit, the effects that its diagnosis found missing
  python -m pipeline add my_fleet --missing g_sensitivity   only this effect, in the units where it is missing
  python -m pipeline add my_bench U1 --suggested            the formula that the diagnosis suggests, as effects/*.yaml
  python -m pipeline remove demo mpu6050-2-hidden gyroscope.g_sensitivity

Effects in units.csv or on the command line override the file. The command is then refused, and the message names the
place to edit.
"""


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
                done = f"{key} has {name} already" if name in now else f"{name} added to {key}"
                changes.append(f"unit {unit}: {done}")
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
        except ConfigurationError as problem:
            raise ConfigurationError(f"unit {unit}: {problem}") from None
        if wanted != now:
            text = set_override(text, key, None if wanted == weaker else override, str(file))
    empty = all(line.strip() in ("", f"{OVERRIDES_KEY}:", f"{OVERRIDES_KEY}: []") for line in text.splitlines())
    return Edit(file, None if empty else text, changes)


def _file(unit: str, layers: Layers, directory: Path) -> Path:
    """Return the device file of a unit; the unit must exist, and its name must not be the serial of another unit."""
    rows = layers.units_table.rows
    require_unit(unit, rows, directory)
    others = [u for u, row in rows.items() if row.get("serial") == unit and u != unit]
    if others:
        both = f"{DEVICES_FOLDER}/{unit}.yaml would concern {', '.join(others)} too, whose serial is {unit}"
        raise ConfigurationError(f"{both}: give the unit or the serial another name", str(directory / "units.csv"))
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
            cell, file = f"the column overrides sets {text} for unit {unit}", f"{DEVICES_FOLDER}/{unit}.yaml"
            message = f"{cell}, which is stronger than {file}: edit this cell, or clear it"
            raise ConfigurationError(message, f"{directory / 'units.csv'}:{line}")
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
            problem = f"{text} ({origin}): the effects are no list, so none can be added to or removed from it"
            raise ConfigurationError(f"{problem}; write {key}=[...] there")
        effects = [str(v) for v in value]
    return effects


def main(argv: Sequence[str]) -> int:
    """Run ``python -m pipeline add CAMPAIGN UNIT SENSOR.EFFECT ...``."""
    parser = _parser("add", __doc__)
    words = "add to each unit the effects that its diagnosis in the last run found missing, or only EFFECT of these"
    parser.add_argument("--missing", nargs="?", const="", metavar="EFFECT", help=words)
    words = "write the formulas that the last run suggests for the unit to effects/, and add them"
    parser.add_argument("--suggested", action="store_true", help=words)
    arguments = parser.parse_intermixed_args(argv)
    _require_own_results(arguments, reads=arguments.suggested or arguments.missing is not None)
    if not arguments.suggested:
        return _change(arguments)
    written, arguments.effects = _write_suggested(arguments)
    try:
        return _change(arguments)
    except PipelineError:
        for file in written:
            file.unlink()
        raise


def remove(argv: Sequence[str]) -> int:
    """Remove effects from <campaign>/devices/<unit>.yaml, and run the campaign: undoes add."""
    arguments = _parser("remove", remove.__doc__).parse_intermixed_args(argv)
    _require_own_results(arguments, reads=False)
    return _change(arguments, undo=True)


def _require_own_results(arguments: argparse.Namespace, *, reads: bool) -> None:
    """Refuse results of another campaign before any file is changed; a command that reads them takes none over."""
    if reads or not arguments.no_run:
        settings = {k: v for k, v in _settings(arguments.config).items() if k != TAKE_OVER or not reads}
        require_own_results(find_campaign(arguments.campaign), Path(arguments.results), settings)


def _write_suggested(arguments: argparse.Namespace) -> tuple[list[Path], list[str]]:
    """Write the suggested formulas of a unit as effects of the campaign; return the new files and SENSOR.EFFECT."""
    if not arguments.unit or arguments.effects:
        raise ConfigurationError("--suggested takes a unit and no effects: it reads them from the results")
    directory = find_campaign(arguments.campaign)
    diagnoses = Path(arguments.results) / directory.name / "diagnoses"
    document = diagnoses / f"{arguments.unit}.json"
    try:
        parts = json.loads(read_published(document))
    except FileNotFoundError:
        raise MissingInputError("does not exist: run the campaign first", str(document)) from None
    suggesting = {s: parts[s] for s in SENSORS if parts.get(s) and parts[s].get("suggested_effect")}
    if not suggesting:
        raise ConfigurationError("the diagnosis suggests no formula for this unit", str(document))
    written, names = [], []
    for sensor, part in suggesting.items():
        text, plain = read_published(diagnoses / part["suggested_file"]).decode(), part["suggested_effect"]["name"]
        for name in chain([plain], (f"{plain}_{k}" for k in count(2))):
            file = directory / "effects" / f"{name}.yaml"
            content = text.replace(plain, name)
            if not file.is_file():
                file.parent.mkdir(exist_ok=True)
                write_atomically(file, content)
                print(f"{file} written")
                written.append(file)
            if file.read_text(encoding="utf-8") == content:
                names.append(f"{sensor}.{name}")
                break
    return written, names


def _change(arguments: argparse.Namespace, *, undo: bool = False) -> int:
    """Edit the device files and run the campaign; return the exit code of the run."""
    run_settings = _settings(arguments.config)
    directory = find_campaign(arguments.campaign)
    composer, layers = read_layers(directory, run_settings)
    effects_of = _effects_of_units(arguments, directory.name)
    edits = [edit_effects(unit, effects, layers, composer, remove=undo) for unit, effects in effects_of.items()]
    for edit in edits:
        _apply(edit)
    if not undo and (note := _bench_note(chain.from_iterable(effects_of.values()))):
        print(note)
    settings = {"campaign": arguments.campaign, **run_settings, "results": arguments.results}
    command = run_command(settings).replace("--cores 2", f"--cores {arguments.cores}", 1)
    if arguments.no_run:
        print(f"then: {command}")
        return 0
    print(f"runs: {command}", flush=True)
    results = Path(arguments.results) / directory.name
    before = {unit: _published(results, unit) for unit in effects_of}
    code = run_snakemake(arguments, arguments.config)
    if code == 0:
        if not changes_of(results, list(effects_of)):  # else the lines of the run state them
            print("no sensor of these units has another error")
        lines = [line for unit in effects_of for line in changed_files(unit, before[unit], _published(results, unit))]
        print("".join(f"{line}\n" for line in shortened(lines, NAMED_PER_LINE, "changes of files")), end="")
    return code


def _published(results: Path, unit: str) -> ExportedUnit | None:
    try:
        documents = [json.loads(read_published(results / d / f"{unit}.json")) for d in ("calibrations", "validations")]
    except FileNotFoundError:
        return None
    return ExportedUnit(documents[0], {}, validation=documents[1])


def changed_files(unit: str, before: ExportedUnit | None, after: ExportedUnit | None) -> list[str]:
    """Return lines on files of other programs that hold less than the calibration, where their error or its changed."""
    if before is None or after is None:
        return []
    was, files = before.held_out_errors(less=False), dict[str, list[str]]()
    both = was, after.held_out_errors(less=False)
    best = [{s: min(e for (x, _), e in errors.items() if x == s) for s, _ in errors} for errors in both]
    for (sensor, file), now in after.held_out_errors(less=True).items():
        error = was.get((sensor, file))
        if not error:
            continue
        change = f"{unit}, {sensor}, held-out error of files that hold less"
        if abs(now / error - 1.0) > SMALLEST_CHANGE_OF_A_FILE:
            files.setdefault(f"{change} {error:.3g} -> {now:.3g} {SENSOR_UNITS[sensor]}", []).append(file)
        elif best[1][sensor] < (1.0 - SMALLEST_CHANGE_OF_A_FILE) * best[0][sensor]:
            stays = f"{unit}, {sensor}: these files cannot hold the effect, and their error stays"
            files.setdefault(stays, []).append(file)
    return [f"{change}: {', '.join(names)}" for change, names in files.items()]


def _bench_note(effects: Iterable[tuple[str, str]]) -> str:
    """Return a note about the effects that belong to the bench; empty if there are none."""
    known = {name: catalogue().get(name.partition("@")[0]) for _, name in effects}
    names = sorted(name for name, effect in known.items() if effect is not None and effect.owner != "sensor")
    if not names:
        return ""
    what = "an effect of the bench (table, mounting, place or one recording), not of the sensor"
    use = "It removes an error of the bench from the fit; apply does not correct it in field logs"
    return f"note: {', '.join(names)}: {what}. {use}"


def _parser(command: str, description: str | None) -> argparse.ArgumentParser:
    parser = parser_of(command, description, EPILOG)
    parser.add_argument("campaign", metavar="CAMPAIGN", help="a campaign's name or directory")
    parser.add_argument("unit", metavar="UNIT", nargs="?", help="a unit of units.csv")
    parser.add_argument("effects", metavar="SENSOR.EFFECT", nargs="*", help="for example gyroscope.g_sensitivity")
    parser.add_argument("--no-run", action="store_true", help="write the files, and do not run the campaign")
    add_run_options(parser)
    return parser


def _effects_of_units(arguments: argparse.Namespace, campaign: str) -> dict[str, list[tuple[str, str]]]:
    missing = getattr(arguments, "missing", None)
    if missing is None:
        if not arguments.unit or not arguments.effects:
            raise ConfigurationError("a unit and at least one SENSOR.EFFECT are expected; --help shows examples")
        return {arguments.unit: [sensor_and_effect(text) for text in arguments.effects]}
    if arguments.unit:
        raise ConfigurationError("--missing takes its units from the results of the last run: leave out the unit")
    folder = Path(arguments.results) / campaign
    file = folder / "summary.csv"
    if not file.is_file():
        raise MissingInputError("does not exist: run the campaign first", str(file))
    effects_of = {row["unit"]: effects for row in read_summary(folder) if (effects := _missing(row, missing))}
    if not effects_of:
        raise ConfigurationError(f"{missing or 'an effect'} is missing in no unit", str(file))
    return effects_of


def _missing(row: Mapping[str, str], only: str) -> list[tuple[str, str]]:
    found = [s for s in SENSORS if row.get(f"{s}_verdict") == Verdict.MISSING_EFFECT]
    effects = [(sensor, name) for sensor in found for name in row[f"{sensor}_selected"].split(";")]
    return [(sensor, name) for sensor, name in effects if not only or name == only]


def _settings(words: Sequence[str]) -> dict[str, Any]:
    """Parse the settings of ``--config`` in the way of Snakemake."""
    settings = {}
    for word in words:
        key, equal, value = word.partition("=")
        if not equal or key in ("campaign", "results"):
            raise ConfigurationError(f"--config {word}: KEY=VALUE of the run is expected, not of campaign or results")
        settings[key] = yaml.load(value, yaml.BaseLoader)  # noqa: S506  (texts, lists and mappings only)
    return settings


def _apply(edit: Edit) -> None:
    try:
        if edit.text is None:
            edit.file.unlink(missing_ok=True)
            with suppress(OSError):  # other files are in it, or it does not exist
                edit.file.parent.rmdir()
        else:
            write_atomically(edit.file, edit.text)
    except OSError as error:
        raise ConfigurationError(f"cannot be written: {error.strerror}", str(edit.file)) from error
    end = "removed" if edit.text is None else "written"
    print("\n".join([*edit.changes, f"  {edit.file} {end}"]))
