"""Show what a run would read from a file, with notes and errors; propose a profile for an unknown log."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from imu_logs.columns import UnknownLog
from imu_logs.files import SUFFIXES
from imu_logs.guesses import TO_DECIDE
from imu_logs.proposal import Proposal, layouts_of, not_found
from pipeline.app.commands import parser_of
from pipeline.app.commands.readings import Reading, campaign_of, config_of_log, recordings_of_files
from pipeline.app.config.campaign import Campaign, find_campaign, load_campaign, require_unit
from pipeline.app.one_unit import try_unit, unit_of_campaign
from pipeline.app.recording_facts import (
    SUITS_FERRARIS,
    Line,
    as_text,
    counted,
    facts,
    has_rows,
    proposed_sheet,
    rests_in_short,
    shows_gravity,
    suits_ferraris,
    topic_lines,
)
from pipeline.app.run_progress import Countdown
from pipeline.app.unit_guesses import propose
from pipeline.core.errors import UNKNOWN_LAYOUT, ConfigurationError, IngestError, PipelineError, shortened
from pipeline.core.files import CONFIGS, write_atomically
from pipeline.core.records import SENSORS, Recording
from pipeline.core.settings import Ingest, Sensor, settings_of_ranges
from pipeline.estimation.rest_means import BY_HAND
from pipeline.ingest.files import FILE, grouped, recording_files
from pipeline.output.outcome import NAMED_PER_LINE, FoundMounting, Ways, as_overrides, found_mountings
from pipeline.physics.statements import LEFT_OUT_REASONS
from pipeline.simulation.description import read_option

MOST_IN_FULL = 3  # logs of one layout
WIDTH = 118  # characters of a line
EPILOG = """\
Recordings of a campaign are checked as a run would do it: with the settings of their unit, compared with the other
recordings of the unit, and fitted. --campaign without files checks every unit of a campaign, with its effects and its
held-out motion. What check refuses, a run refuses. A run alone makes the diagnosis, the exports and the pages, and
check does not see what fails there.

Any other file is read alone: as the units of --campaign, or by the profile --ingest (default: canonical_csv); with
--sensor, the readings are compared with the full scale of that sensor, or with --range. Only --save writes a file.

Where the profile does not fit the log, another one is proposed, with the evidence for each line and ??? where you must
decide. A run uses it only after you save it and name it in the configuration.

examples:
  python -m pipeline check log.csv
  python -m pipeline check log.csv --save my_bench/configs/ingest/my_logger.yaml
  python -m pipeline check log.csv --ingest my_logger --sensor mpu6050 --range 4 500
  python -m pipeline check log.csv --campaign my_bench
  python -m pipeline check my_bench/raw/U1/*.csv
  python -m pipeline check --campaign my_bench
  snakemake --cores 2 --config campaign=my_bench 'overrides=[ingest=my_logger]'

exit code: 0 if a run would use every file or unit, 2 if one is refused or its layout is unknown.
"""


class Refused(NamedTuple):
    """A refusal of a log or, if ``reading`` is None, of a unit."""

    code: str
    message: str
    place: str
    reading: Reading | None = None


class Outcome(NamedTuple):
    """The result of one check, of a log or a unit."""

    text: str  # that is printed
    refused: list[Refused]
    unit: str = ""
    # recording to the settings that describe it, where gravity shows another mounting than stated
    mounted: Mapping[str, Ways] = MappingProxyType({})
    saved: Path | None = None  # the profile of the campaign that reads what is refused


@dataclass
class SavedProfiles:
    """The ingest profiles in ``configs/ingest`` of a campaign, and its units as each of them reads them."""

    directory: Path
    unusable: dict[Path, str] = field(default_factory=dict)  # why, such as a value that is to be filled in

    @cached_property
    def campaigns(self) -> dict[Path, Campaign]:
        """The campaign by each profile that can be used; read when it is first needed."""
        found = {}
        for file in sorted((self.directory / "configs" / "ingest").glob("*.yaml")):
            try:
                found[file] = load_campaign({"campaign": str(self.directory), "overrides": [f"ingest={file.stem}"]})
            except ConfigurationError as error:
                self.unusable[file] = str(error)
        return found


def main(argv: Sequence[str]) -> int:
    """Run ``python -m pipeline check FILE...``."""
    arguments = _parser().parse_intermixed_args(argv)
    if arguments.save and arguments.save.suffix != ".yaml":
        raise ConfigurationError(f"--save {arguments.save}: the name of a profile's file ends in .yaml")
    tasks = _tasks(arguments)
    countdown, refused = Countdown(len(tasks)), list[Refused]()
    alike: dict[str, list[str]] = {}  # the names of logs of one unknown layout, by its message
    mounted, saved = [], dict[Path, list[str]]()
    for number, (what, task) in enumerate(tasks):
        countdown(number, f"checking {what} ({number + 1} of {len(tasks)})")
        outcome = task()
        countdown.end()
        names = alike.setdefault(_same_layout(outcome.refused) or str(number), [])
        if not names:
            print(f"{outcome.text}\n")
        names.append(what)
        refused += outcome.refused
        mounted.append((outcome.unit, outcome.mounted))
        if outcome.saved:
            saved.setdefault(outcome.saved, []).append(what.removeprefix("unit "))
    for one, *others in alike.values():
        if others:
            print(_wrapped(f"REFUSED as {one}: {', '.join(others)}") + "\n")
    whole_campaign = not arguments.files and not arguments.unit
    _print_mountings(found_mountings(mounted), len(tasks) if whole_campaign else None)
    _print_saved(saved)
    sys.stdout.flush()
    _print_refused(refused)
    unknown = [(r.reading, layout) for r in refused if r.reading for layout in _layouts(r.reading, r.code)]
    if unknown:
        sensor_model = unknown[0][0].sensor_model
        _print_shipped([file for reading, _ in unknown for file in reading.files])
        _print_proposals(propose([layout for _, layout in unknown], sensor_model), sensor_model, arguments.save)
    elif arguments.save:
        print(f"{arguments.save} was not written: no profile is proposed")
    return 2 if refused else 0


def _print_refused(refused: Sequence[Refused]) -> None:
    equal: dict[tuple[str, str], list[str]] = {}
    for refusal in refused:
        equal.setdefault((refusal.code, refusal.message), []).append(refusal.place)
    for (code, _), (place, *others) in equal.items():
        where = f"{1 + len(others)} files, for example {place}" if others else place
        print(f"python -m pipeline check: {where}: refused ({code})", file=sys.stderr, flush=True)


def _print_mountings(groups: Sequence[FoundMounting], units: int | None) -> None:
    """Print the settings that describe the mountings by gravity: once for all units that share them.

    ``units``: of the campaign, if all were checked; settings of all belong in ``campaign.yaml``.
    """
    for group in groups[:MOST_IN_FULL]:
        of_units = f"devices/{group.units[0]}.yaml" if len(group.units) == 1 else "devices/UNIT.yaml of each unit"
        place = "campaign.yaml" if len(group.units) == units else of_units
        text = (
            f"MOUNTING: gravity shows another one than stated in {', '.join(group.recordings)} of "
            f"{', '.join(shortened(group.units, NAMED_PER_LINE, 'units'))}, and it is used as found (N-FOUND). If the "
            f"bench is so, state it in {place}; else correct the columns or the mounting (docs/mounting.md):"
        )
        print(_wrapped(text) + f"\n\n{as_overrides(group.ways)}")
    if others := [unit for group in groups[MOST_IN_FULL:] for unit in group.units]:
        units_named = ", ".join(shortened(others, NAMED_PER_LINE, "units"))
        print(_wrapped(f"MOUNTING: other settings describe {units_named}: check each with --unit") + "\n")


def _wrapped(text: str) -> str:
    """Return a text in lines; the path of a file is not broken."""
    return textwrap.fill(text, WIDTH, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)


def _same_layout(refused: Sequence[Refused]) -> str:
    """Return the message of a log alone whose layout is unknown, empty for any other."""
    one = refused[0] if len(refused) == 1 else None
    return one.message if one and one.code in UNKNOWN_LAYOUT and one.reading and not one.reading.has_topics else ""


def _parser() -> argparse.ArgumentParser:
    parser = parser_of("check", __doc__, EPILOG, ("--ingest", "--sensor", "--range"))
    add = parser.add_argument
    add("files", type=Path, nargs="*", metavar="FILE", help=f"a text log, or {', '.join(SUFFIXES[1:-1])}")
    add("--campaign", metavar="CAMPAIGN", help="a campaign's name or directory: settings, or without files its units")
    add("--unit", metavar="UNIT", help="this unit of the campaign alone")
    add("--save", type=Path, metavar="FILE", help="write the proposed profile to this file")
    return parser


def _tasks(arguments: argparse.Namespace) -> list[tuple[str, partial[Outcome]]]:
    """Return the name and the function of each check: of units of campaigns, then of logs alone."""
    given = find_campaign(arguments.campaign) if arguments.campaign else None
    stated = arguments.ingest is not None or arguments.sensor is not None
    if arguments.range and arguments.sensor is None:
        raise ConfigurationError("--range is that of --sensor; a campaign states it in campaign.yaml")
    if not arguments.files and given is None:
        raise ConfigurationError("expected files, or a campaign: check FILE, or check --campaign CAMPAIGN")
    places: dict[Path | None, list[Path]] = {} if arguments.files else {given: []}
    for file in arguments.files:
        places.setdefault(given or campaign_of(file), []).append(file)
    tasks: list[tuple[str, partial[Outcome]]] = []
    for directory, files in places.items():
        if directory is None or stated:
            tasks += [(str(log.files[0]), partial(_check_log, log)) for log in _logs(files, directory, arguments)]
            continue
        campaign = load_campaign({"campaign": str(directory)})
        known = [arguments.unit] if arguments.unit else list(campaign.units)
        require_unit(known[0], campaign.units, directory)
        chosen, others = recordings_of_files(files, campaign, known) if files else ({unit: [] for unit in known}, [])
        saved = SavedProfiles(directory)
        checks = {f"unit {u}": partial(_check_unit, unit=u, names=names, saved=saved) for u, names in chosen.items()}
        for log in _logs_of_campaign(others, campaign, known) if others else []:
            checks[str(log.files[0])] = partial(_check_log_of_campaign, files=log.files, units=known)
        tasks += [(what, partial(_check_or_saved, check, campaign, saved)) for what, check in checks.items()]
    return sorted(tasks, key=lambda task: not task[0].startswith("unit "))


def _logs(files: Sequence[Path], campaign: Path | None, arguments: argparse.Namespace) -> list[Reading]:
    profile, sensor = arguments.ingest, arguments.sensor
    config = config_of_log(files[0], profile, sensor, campaign=campaign)
    if arguments.range:
        ranges = settings_of_ranges({s: config.sensor.of(s) for s in SENSORS}, arguments.range)
        config = config_of_log(files[0], profile, sensor, ranges, campaign)
    ingest, sensor_model = config.ingest, config.sensor if sensor else None
    read_with = f"ingest={ingest.name}" + (f", sensor={sensor}" if sensor else "")
    return [Reading.alone(group, ingest, sensor_model, read_with) for group in grouped(files, ingest)]


def _logs_of_campaign(files: Sequence[Path], campaign: Campaign, units: Sequence[str]) -> list[Reading]:
    """Return logs that are no recordings of a campaign, read by its settings."""
    one, *others = (campaign.units[unit].config for unit in units)
    if any((one.ingest, one.sensor) != (other.ingest, other.sensor) for other in others):
        message = "the units are read by different settings (ingest, sensor): choose one by --unit"
        raise ConfigurationError(message, str(campaign.directory / "units.csv"))
    names = f"ingest={one.ingest.name}, sensor={one.sensor.name}"
    read_with = f"campaign {campaign.name}, as no recording of a unit: {names}"
    return [Reading.alone(group, one.ingest, one.sensor, read_with) for group in grouped(files, one.ingest)]


def _check_log(reading: Reading) -> Outcome:
    """Return content and notes of a log that is checked alone, or its refusal."""
    try:
        recording = reading.checked()
        return Outcome(_described(reading, [*_topics(reading), *facts(recording, reading.sensor_model)]), [])
    except PipelineError as error:
        return _refusal_of(reading, error)


def _check_or_saved(check: Callable[[Campaign], Outcome], campaign: Campaign, profiles: SavedProfiles) -> Outcome:
    """Check by the settings of a campaign; where they need another profile, by those that the campaign holds.

    The refusal remains, because a run uses no profile that the settings do not name.
    """
    outcome = check(campaign)
    if not _needs_profile(outcome):
        return outcome
    for file, other in profiles.campaigns.items():
        try:
            by_profile = check(other)
        except ConfigurationError:  # the log has none of the names that the profile gives to the parts of a recording
            continue
        if not _needs_profile(by_profile):
            one = outcome.refused[0]
            why = f"the profile that the settings name does not describe it ({one.code}), and the saved one does:"
            refused = [each._replace(reading=None) for each in (*outcome.refused, *by_profile.refused)]
            text = f"{one.place}\n{as_text([('REFUSED', why), ('saved profile', str(file))])}\n\n{by_profile.text}"
            return by_profile._replace(text=text, refused=refused, saved=file)
    lines = [("saved profile", f"{file} cannot be used: {why}") for file, why in profiles.unusable.items()]
    profiles.unusable.clear()  # told once
    return outcome._replace(text=f"{outcome.text}\n{as_text(lines)}") if lines else outcome


def _needs_profile(outcome: Outcome) -> bool:
    """Return whether files are missing, or have a layout that the profile does not describe."""
    return any(one.code in (*UNKNOWN_LAYOUT, "missing_file") for one in outcome.refused)


def _print_saved(saved: Mapping[Path, Sequence[str]]) -> None:
    """Print how a run uses the saved profiles that read what is refused; ``saved``: profile to the units or logs."""
    for file, names in saved.items():
        text = (
            f"SAVED PROFILE: {file} describes the files of {', '.join(shortened(names, NAMED_PER_LINE))}. A run uses "
            f"it where the settings name it: write {file.stem} into the column ingest of units.csv, or for all units "
            "into campaign.yaml:"
        )
        print(_wrapped(text) + f"\n\n{as_overrides([[f'ingest={file.stem}']])}")


def _check_log_of_campaign(campaign: Campaign, files: Sequence[Path], units: Sequence[str]) -> Outcome:
    """Return content and notes of a log that is no recording of a campaign, read by its settings."""
    (reading,) = _logs_of_campaign(files, campaign, units)
    return _check_log(reading)


def _check_unit(campaign: Campaign, unit: str, names: Sequence[str], saved: SavedProfiles) -> Outcome:
    """Return the result of a run for a unit: content and notes of the named recordings, or a summary of all."""
    configured, missing = unit_of_campaign(campaign, unit), ""
    state, failure = try_unit(configured, "fit", fits=False) if names else try_unit(configured, "calibration")
    if names and failure and failure["code"] == "missing_file":
        missing = f"a run needs more recordings of unit {unit}; without them none is compared: {failure['message']}"
        state, failure = try_unit(configured.with_missing(), "ingest")
    checked = state.checked or []
    read = _readings_of(campaign, unit)
    texts = []
    refused: list[Refused] = []
    for name in names or (read if not checked else ()):
        try:
            lines = _facts_of_recording(read[name], campaign, checked)
            texts += [_described(read[name], lines)] if names else []
        except PipelineError as error:
            outcome = _refusal_of(read[name], error)
            texts.append(outcome.text)
            refused += outcome.refused
    if failure and (not refused or failure["code"] == "missing_file"):
        place = failure["file"] or f"unit {unit}"
        refused.append(Refused(failure["code"], failure["message"], place))
        file = [("file", failure["file"])] if failure["file"] else []
        lines = [*file, ("REFUSED", failure["message"]), ("code", failure["code"])]
        texts.append(f"unit {unit} of campaign {campaign.name}\n{as_text(lines)}")
        texts += _sheet_proposed(campaign, unit, saved)
    elif not names and not refused:
        document = state.calibration or {}
        lines = [(sensor, f"null: {reason}") for sensor, reason in document["not_calibrated"].items()]
        lines += [(s, text) for s in SENSORS if document[s] and (text := document[s]["not_determined"])]
        by_hand = [r for r in checked if r.role == "rests" and r.kind in BY_HAND and r.logged_rate is None]
        lines += [("rests", text) for recording in by_hand if (text := rests_in_short(recording))]
        lines += [("procedure", f"{r.name}: {SUITS_FERRARIS}") for r in by_hand if r.kind and suits_ferraris(r)]
        noted: dict[str, dict[tuple[str, str], list[str]]] = {}
        for recording in checked:
            for note in (n for n in recording.notes if not n.settings):
                place = f", line {note.first} to {note.last}" if note.code in LEFT_OUT_REASONS and note.first else ""
                noted.setdefault(note.code, {}).setdefault((place, note.detail), []).append(recording.name)
        notes = [
            f"{code} {name}{place}: {detail}" + f"; likewise {', '.join(others)}" * bool(others)
            for code, found in noted.items()
            for (place, detail), (name, *others) in found.items()
        ]
        lines += [("notes" if i == 0 else "", note) for i, note in enumerate(notes)]
        head = f"unit {unit}: {counted(len(checked), 'recording')}, no refusal up to the calibration"
        texts.append("\n".join([head, *([as_text(lines)] if lines else [])]))
    mounted = {r.name: n.settings for r in checked for n in r.notes if n.settings}
    return Outcome("\n\n".join([*texts, *([missing] if missing else [])]), refused, unit, mounted)


def _sheet_proposed(campaign: Campaign, unit: str, saved: SavedProfiles) -> list[str]:
    """Return a proposed sheet where there is none, read by a saved profile where the settings' reads no file."""
    config, folder = campaign.units[unit].config, campaign.folder(unit)
    if not config.procedure.sheet or config.procedure.recordings or not folder.is_dir():
        return []
    proposed, used = proposed_sheet(folder, config), ""
    for file, other in saved.campaigns.items() if not has_rows(proposed) else ():
        if has_rows(by_saved := proposed_sheet(folder, other.units[unit].config)):
            proposed = by_saved
            used = f", read with {file}: no setting names it, write ingest={file.stem} into campaign.yaml"
            break
    if not proposed:
        return []
    if not has_rows(proposed):
        proposed += f"\n# a profile: python -m pipeline check FILE --save {campaign.directory}/configs/ingest/NAME.yaml"
    head = f"PROPOSED {folder / config.procedure.sheet}, by what the files show{used}; correct it:"
    return [f"{_wrapped(head)}\n\n{proposed}"]


def _readings_of(campaign: Campaign, unit: str) -> dict[str, Reading]:
    config = campaign.units[unit].config
    used = f"ingest={config.ingest.name}, sensor={config.sensor.name}, table={config.table.name}"
    found = {}
    for name, files in recording_files(config.procedure, config.ingest, campaign.folder(unit)).items():
        entry = config.procedure.recordings[name]
        settings = config.replaced(procedure=config.procedure.replaced(recordings={name: entry}))
        place = f"unit {unit} of campaign {campaign.name}, recording {name}: {used}"
        found[name] = Reading(files, name, entry, settings, place, of_campaign=True)
    return found


def _facts_of_recording(reading: Reading, campaign: Campaign, checked: Sequence[Recording]) -> list[Line]:
    """Return the content of a recording after ingest, and the parts if ingest cuts it."""
    of_part = (reading.files[0], reading.entry.session)
    parts = [r for r in checked if (campaign.recorded / r.source["file"], r.source.get("session")) == of_part]
    if [part.name for part in parts] == [reading.name]:
        return [*_topics(reading), *facts(parts[0], reading.sensor_model)]
    whole = reading.recording()
    notes = dict.fromkeys(n for r in (whole, *parts) for n in r.notes if n.code != "N-SEGMENT")
    segments = [f"{p.name}: {n.detail}" for p in parts for n in p.notes if n.code == "N-SEGMENT"]
    lines = facts(replace(whole, notes=tuple(notes)), reading.sensor_model)
    return _topics(reading) + lines + [("segments" if i == 0 else "", text) for i, text in enumerate(segments)]


def _described(reading: Reading, lines: Sequence[Line]) -> str:
    """Return the content of a log as text, with its profile and settings."""
    return f"{', '.join(map(str, reading.files))}\n  {'read with':<16}{reading.read_with}\n{as_text(lines)}"


def _topics(reading: Reading, *, fields: bool = False) -> list[Line]:
    return topic_lines(reading.files[0], fields=fields) if reading.has_topics else []


def _refusal_of(reading: Reading, error: PipelineError) -> Outcome:
    unlike = "the file needs another profile, see below: " if error.code in UNKNOWN_LAYOUT else ""
    lines = [("REFUSED", f"{unlike}{_place(error.file, reading.files)}{error.message}"), ("code", error.code)]
    refused = Refused(error.code, error.message, error.file or str(reading.files[0]), reading)
    text = _described(reading, [*lines, *_topics(reading, fields=error.code == "missing_topic")])
    parts = getattr(error, "sessions", 0)
    return Outcome(f"{text}\n\n{_recipe(reading, parts)}" if parts else text, [refused])


def _recipe(reading: Reading, parts: int) -> str:
    """Return the settings with which all parts of a log that was restarted are used."""
    name, entry = reading.name, reading.entry
    if not reading.of_campaign:
        return "To use all parts, check the file where it lies in your campaign: check then prints the settings."
    if entry.windows:
        text = "The procedure cuts this recording into windows, and its time falls back within it"
        return f"{text}. Write a file for each window, or one file whose time never falls back (docs/record.md, Parts)."
    here = {k: v for k, v in entry.json_value.items() if v is not None or k == "axis"}
    lines = [f"procedure.recordings.{name}.session=1"]
    for part in range(2, parts + 1):
        values = ", ".join(f"{k}: {json.dumps(v)}" for k, v in (here | {"session": part}).items())
        lines.append(f"'procedure.recordings.{name}_{part}={{{values}}}'")
    listed = "\n".join(f"  - {line}" for line in lines)
    return (
        "To use all parts, write into devices/UNIT.yaml of your campaign (or into campaign.yaml, for all units):\n\n"
        f"overrides:\n{listed}\n\n"
        "A part that these lines do not name is not used. Lines between the parts are left out."
    )


def _place(file: str | None, files: Sequence[Path]) -> str:
    """Return the place of a refusal, without the name of the only file."""
    if file is None or [file] == [str(f) for f in files]:
        return ""
    line = file.removeprefix(f"{files[0]}:") if len(files) == 1 else file
    return f"line {line}: " if line.isdigit() else f"{file}: "


def _layouts(reading: Reading, code: str) -> list[UnknownLog]:
    """Return the layout of each log that the profile does not describe; of a log of messages, that of one topic."""
    layouts = []
    for file in reading.files if code in UNKNOWN_LAYOUT else ():
        try:
            layouts += layouts_of(file)
        except IngestError as none:
            print(f"{file}: {none.message}\n")
    return layouts


def _print_shipped(files: Sequence[Path]) -> None:
    """Print the shipped profiles of text logs that read files as readings with gravity."""
    for name in sorted(file.stem for file in (CONFIGS / "ingest").glob("*.yaml")):
        option = read_option("ingest", name)
        if "defaults" in option or "${" in str(option):  # of messages, or of a table or sensor that nobody stated
            continue
        ingest = Ingest.model_validate({"name": name, **option})
        try:
            recordings = [Reading.alone(group, ingest, None).checked() for group in grouped(files, ingest)]
        except PipelineError:
            continue
        if all(map(shows_gravity, recordings)):
            use = f"check by --ingest {name}, or set ingest={name} in a campaign"
            print(_wrapped(f"SHIPPED PROFILE: {name} reads {', '.join(map(str, files))}: {use}") + "\n")


def _print_proposals(proposals: Sequence[Proposal], sensor_model: Sensor | None, save: Path | None) -> None:
    """Print each proposed profile and the files as it reads them; with ``save``, write the only one."""
    if save is not None and len(proposals) > 1:
        raise ConfigurationError(f"{len(proposals)} profiles are proposed and --save writes one: check fewer files")
    name = "my_logger" if save is None else save.stem
    for proposal in proposals:
        if proposal.complete:
            print("WITH THE PROFILE PROPOSED BELOW:\n")
            counts = {s: sensor_model.of(s).counts_per_unit for s in SENSORS} if sensor_model else {}
            ingest = Ingest.model_validate(proposal.sections(name, counts))
            groups = [[Path(f) for f in proposal.files]] if proposal.parts else [[Path(f)] for f in proposal.files]
            for number, group in enumerate(groups):
                outcome = _check_log(Reading.alone(group, ingest, sensor_model, "the proposed profile"))
                if number < MOST_IN_FULL or outcome.refused:
                    print(f"{outcome.text}\n")
            if len(groups) > MOST_IN_FULL:
                print("Every other file is read without a refusal: check it alone for what it holds.\n")
        print(_wrapped(f"PROPOSED PROFILE for {', '.join(proposal.files)}") + "\n")
        text = proposal.text(name)
        print(textwrap.indent(text, "    "))
        if proposal.unknown():
            print(f"Fill in {TO_DECIDE} for {', '.join(proposal.unknown())}.")
        if save is not None:
            write_atomically(save, text)
            print(f"Saved as {save}. No configuration uses it yet.")
        print("\n".join([*not_found(proposal), _next_step(proposal, name, save)]))


def _next_step(proposal: Proposal, name: str, save: Path | None) -> str:
    """Return how to save, check and use a proposed profile, and where to place files that are joined."""
    profile = save or Path("my_bench", "configs", "ingest", f"{name}.yaml")
    todo = "check it by" if save else f"save it in your campaign (--save {profile}), and check it by"
    lines = [
        f"If every line is right, {todo}",
        f"python -m pipeline check {shlex.join(proposal.files)} --ingest {shlex.quote(str(profile))}",
        f"A run uses it from configs/ingest of the campaign, with the override ingest={name}, or with {name} in the",
        "column ingest of units.csv.",
    ]
    if proposal.parts:
        names, text = " and ".join(proposal.parts), " and ".join(FILE + f"_{part}" for part in proposal.parts)
        words = (
            f"{names} are one recording: place both in raw/<unit>/ under these names. They stand for the only required "
            "recording of the procedure; no other file is needed for it. For a procedure with several recordings, "
            f"write {FILE}, the name of a recording, into the names of the profile, for example {text}."
        )
        lines.append(_wrapped(words))
    return "\n".join(lines) + "\n"
