"""Add effects to units in <campaign>/devices/<unit>.yaml, and run the campaign."""

from __future__ import annotations

import json
from contextlib import suppress
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from pipeline.app.commands import add_run_options, parser_of
from pipeline.app.commands.run import run_snakemake
from pipeline.app.config.campaign import TAKE_OVER, find_campaign, read_layers
from pipeline.app.config.devices import edit_effects, sensor_and_effect
from pipeline.app.config.owner import require_own_results
from pipeline.core.errors import ConfigurationError, MissingInputError, PipelineError, shortened
from pipeline.core.files import write_atomically
from pipeline.core.pack import read_published
from pipeline.core.records import SENSORS
from pipeline.core.verdicts import Verdict
from pipeline.output.outcome import DEFAULT_RESULTS, NAMED_PER_LINE, changes_of, read_summary, run_command
from pipeline.physics.effects import catalogue

if TYPE_CHECKING:
    import argparse
    from collections.abc import Iterable, Mapping, Sequence

    from pipeline.app.config.devices import Edit

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


def main(argv: Sequence[str]) -> int:
    """Run ``python -m pipeline add CAMPAIGN UNIT SENSOR.EFFECT ...``."""
    parser = _parser("add", __doc__)
    words = "add to each unit the effects that its diagnosis in the last run found missing, or only EFFECT of these"
    parser.add_argument("--missing", nargs="?", const="", metavar="EFFECT", help=words)
    words = "write the formulas that the last run suggests for the unit to effects/, and add them"
    parser.add_argument("--suggested", action="store_true", help=words)
    arguments = parser.parse_args(argv)
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
    arguments = _parser("remove", remove.__doc__).parse_args(argv)
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
    settings = {"campaign": arguments.campaign, **run_settings}
    if arguments.results != DEFAULT_RESULTS:
        settings["results"] = arguments.results
    command = run_command(settings).replace("--cores 2", f"--cores {arguments.cores}", 1)
    if arguments.no_run:
        print(f"then: {command}")
        return 0
    print(f"runs: {command}", flush=True)
    code = run_snakemake(arguments, arguments.config)
    results = Path(arguments.results) / directory.name
    own = changes_of(results, list(effects_of)) if code == 0 else []
    print(
        "\n".join(
            shortened(own, NAMED_PER_LINE, "sensors that changed")
            or ["no sensor of these units has another error"] * (code == 0)
        )
    )
    return code


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
    """Return the parser of add and remove."""
    parser = parser_of(command, description, EPILOG)
    parser.add_argument("campaign", metavar="CAMPAIGN", help="a campaign's name or directory")
    parser.add_argument("unit", metavar="UNIT", nargs="?", help="a unit of units.csv")
    parser.add_argument("effects", metavar="SENSOR.EFFECT", nargs="*", help="for example gyroscope.g_sensitivity")
    parser.add_argument("--no-run", action="store_true", help="write the files, and do not run the campaign")
    add_run_options(parser)
    return parser


def _effects_of_units(arguments: argparse.Namespace, campaign: str) -> dict[str, list[tuple[str, str]]]:
    """Return the effects to add or remove, as sensor and name, by unit."""
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
    effects = [
        (sensor, name)
        for sensor in SENSORS
        if row.get(f"{sensor}_verdict") == Verdict.MISSING_EFFECT
        for name in row[f"{sensor}_selected"].split(";")
    ]
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
