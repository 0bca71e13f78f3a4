"""Show what a run would read from a file, with notes and errors; propose a profile for an unknown log."""

from __future__ import annotations

import re
import sys
import tempfile
import textwrap
from dataclasses import dataclass
from pathlib import Path
from shutil import copyfile
from typing import TYPE_CHECKING, Any

from pipeline.commands import parser_of
from pipeline.config.campaign import load_campaign
from pipeline.config.compose import Composer
from pipeline.config.options import Problem
from pipeline.errors import ConfigurationError, IngestError, PipelineError
from pipeline.files import CONFIGS, write_atomically
from pipeline.io.files import FILE, MESSAGE_FORMATS, SUFFIXES, candidate_files
from pipeline.io.ingest_settings import checks_of
from pipeline.io.read import read_table, to_recording
from pipeline.preprocessing.checks import check_recordings
from pipeline.profile_detection.columns import find_layout
from pipeline.profile_detection.proposal import as_yaml, propose
from pipeline.profile_detection.recording_facts import as_text, facts
from pipeline.profile_detection.topics import topic_lines, topics_of
from pipeline.profile_detection.unit_guesses import UNKNOWN
from pipeline.run_progress import Countdown
from pipeline.signal.segments import cut

if TYPE_CHECKING:
    import argparse
    from collections.abc import Sequence

    from pipeline.profile_detection.columns import TextLayout
    from pipeline.profile_detection.proposal import Proposal
    from pipeline.records import Recording

DEFAULT_PROFILE = "canonical_csv"
SEARCHED_BYTES = 1 << 25  # of a log, for its layout
SEARCHED_FOLDERS = 4  # the log's, and a campaign's above raw/<unit>/
UNKNOWN_LAYOUT = ("missing_column", "no_header", "missing_topic")
EPILOG = """\
A file of a campaign is read as the campaign's configuration says. Any other file is read by the profile --ingest
(default: canonical_csv); with --sensor, the readings are compared with the full scale of that sensor. Only --save
writes a file.

Where the profile does not fit the log, another one is proposed, with the evidence for each line and ??? where you must
decide. A run uses it only after you save it and name it in the configuration.

examples:
  python -m pipeline check log.csv
  python -m pipeline check log.csv --save my_bench/configs/ingest/my_logger.yaml
  python -m pipeline check log.csv --ingest my_logger
  python -m pipeline check raw/*.mcap --sensor mpu6050
  snakemake --cores 2 --config campaign=my_bench 'overrides=[ingest=my_logger]'

exit code: 0 if ingest reads every file, 2 if a file is refused or its layout is unknown.
"""


@dataclass
class Reading:
    """Files that are read as one recording, and the sections of the configuration by which they are read."""

    files: list[Path]
    settings: dict[str, Any]
    said: str

    @property
    def has_topics(self) -> bool:
        """Whether the recording is a log of messages: MCAP, or a format that an extra reads."""
        return self.files[0].suffix.lower() in (".mcap", *MESSAGE_FORMATS)


def _reading_of_file(files: list[Path], ingest: dict[str, Any], sensor: dict[str, Any], said: str) -> Reading:
    """Return how files that belong to no campaign are read: as rests without a table."""
    recordings = {files[0].stem: {"role": "rests", "axis": None}}
    settings = {"procedure": {"recordings": recordings}, "table": {}, "sensor": sensor, "ingest": ingest}
    return Reading(files, settings, said)


def main(argv: Sequence[str]) -> int:
    """Run ``python -m pipeline check FILE...``."""
    arguments = _parser().parse_args(argv)
    refused: list[tuple[Reading, PipelineError]] = []
    readings = _readings(arguments.files, arguments.ingest, arguments.sensor)
    sizes = [sum(f.stat().st_size for f in reading.files if f.is_file()) for reading in readings]
    countdown = Countdown(sum(sizes))
    for number, reading in enumerate(readings):
        countdown(sum(sizes[:number]), f"reading {reading.files[0]} ({number + 1} of {len(readings)})")
        error = _print_facts(reading, countdown)
        if error is not None:
            refused.append((reading, error))
    unknown = [layout for reading, error in refused for layout in _layouts(reading, error)]
    if unknown:
        sensor = refused[0][0].settings["sensor"]
        _print_proposals(propose(unknown, sensor), sensor, arguments.save)
    elif arguments.save:
        print(f"{arguments.save} was not written: no profile is proposed")
    sys.stdout.flush()
    for reading, error in refused:
        print(f"python -m pipeline check: {error.file or reading.files[0]}: refused ({error.code})", file=sys.stderr)
    return 2 if refused else 0


def _parser() -> argparse.ArgumentParser:
    parser = parser_of("check", __doc__, EPILOG, ("--ingest", "--sensor"))
    parser.add_argument(
        "files", type=Path, nargs="+", metavar="FILE", help=f"a text log, or {', '.join(SUFFIXES[1:-1])}"
    )
    parser.add_argument("--save", type=Path, metavar="FILE", help="write the proposed profile to this file")
    return parser


def _readings(files: Sequence[Path], profile: str | None, sensor: str | None) -> list[Reading]:
    """Return how each file, or the files of one recording, are to be read."""
    as_campaigns_say = profile is None and sensor is None
    directories = {campaign_of(f) for f in files} - {None} if as_campaigns_say else set()
    known: dict[Path, Reading] = {}
    for reading in (r for directory in directories for r in _of_campaign(directory)):
        for file in reading.files:
            known.setdefault(file, reading)
    readings, others = [], []
    for file in files:
        found = known.get(file.resolve())
        if found is None:
            others.append(file)
        elif found not in readings:
            readings.append(found)
    if others:
        config = config_of_log(others[0], profile, sensor)
        ingest, sheet = config["ingest"], config["sensor"]
        said = f"ingest={ingest['name']}" + (f", sensor={sensor}" if sensor else "")
        parts = [p["file"] for p in (ingest["csv"] or {}).get("parts") or []]
        readings += [_reading_of_file(g, ingest, sheet if sensor else {}, said) for g in _grouped(others, parts)]
    return readings


def _grouped(files: Sequence[Path], parts: Sequence[str]) -> list[list[Path]]:
    """Return the files of each recording: one, or one for each part of the profile."""
    groups: dict[Path, list[Path]] = {}
    for file in files:
        if not parts or file.suffix.lower() in SUFFIXES[1:]:
            groups[file] = [file]
            continue
        patterns = [re.escape(p).replace(re.escape(FILE), "(.+)") for p in parts]
        found = next((m for p in patterns if (m := re.fullmatch(p, file.name))), None)
        if found is None:
            raise ConfigurationError(f"matches none of the profile's parts ({', '.join(parts)})", str(file))
        stem = found.group(1) if found.groups() else ""
        groups[file.parent / stem] = [file.parent / p.replace(FILE, stem) for p in parts]
    return list(groups.values())


def campaign_of(file: Path) -> Path | None:
    """Return the campaign that a file lies in, None where it lies in none."""
    return next((d for d in file.resolve().parents if (d / "units.csv").is_file()), None)


def _of_campaign(directory: Path | None) -> list[Reading]:
    campaign = load_campaign({"campaign": str(directory)})
    readings = []
    for name, unit in campaign.units.items():
        config, folder = unit.config, campaign.folder(name)
        for recording, candidates in candidate_files(config["procedure"], config["ingest"]).items():
            entry = config["procedure"]["recordings"][recording]
            said = f"unit {name} of campaign {campaign.name}, recording {recording}: "
            said += f"ingest={config['ingest']['name']}, sensor={config['sensor']['name']}"
            tolerance = config["procedure"]["mounting_tolerance_deg"]
            procedure = {"recordings": {recording: entry}, "mounting_tolerance_deg": tolerance}
            settings = {"procedure": procedure, **{k: config[k] for k in ("table", "sensor", "ingest")}}
            readings += [Reading([(folder / f).resolve() for f in files], settings, said) for files in candidates]
    return readings


def config_of_log(file: Path, profile: str | None, sensor: str | None, more: Sequence[str] = ()) -> dict[str, Any]:
    """Return the configuration by which a log is read alone: by a profile (default: ``DEFAULT_PROFILE``) and a sensor.

    The options of the campaign that the log lies in, if any, may be named too. ``more``: further overrides.
    """
    campaign = campaign_of(file)
    return composed(named(profile, file, campaign) if profile else DEFAULT_PROFILE, sensor, campaign, more)


def named(profile: str, file: Path, campaign: Path | None) -> str:
    """Return a profile as it is to be read: a name that is known, or the only saved file of that name.

    A file is looked for in the working directory, in the folders about the log, and in ``configs/ingest`` of each of
    these and of the campaigns below the working directory.

    Raises
    ------
    ConfigurationError
        If files of that name hold different profiles.
    """
    known = [root / "ingest" / f"{profile}.yaml" for root in (CONFIGS, *([campaign / "configs"] if campaign else []))]
    if Path(profile).suffix in (".yaml", ".yml") or any(place.is_file() for place in known):
        return profile
    folders = [Path.cwd(), *list(file.resolve().parents)[:SEARCHED_FOLDERS]]
    places = [place for folder in folders for place in (folder, folder / "configs" / "ingest")]
    places += sorted(Path.cwd().glob("*/configs/ingest"))
    found = {f.resolve(): f.read_bytes() for place in places if (f := place / f"{profile}.yaml").is_file()}
    if len(set(found.values())) > 1:
        raise ConfigurationError(f"--ingest {profile} is one of {', '.join(map(str, found))}; name its path")
    return str(next(iter(found), profile))


def composed(profile: str, sensor: str | None, campaign: Path | None, more: Sequence[str] = ()) -> dict[str, Any]:
    """Return a configuration with a profile, and with ``more`` overrides."""
    path = Path(profile)
    layers = ["procedure=multi_position", *([f"sensor={sensor}"] if sensor else []), *more]
    with tempfile.TemporaryDirectory() as folder:
        own = campaign or Path(folder)
        if path.suffix in (".yaml", ".yml"):
            if not path.is_file():
                raise ConfigurationError("there is no such file", profile)
            own = Path(folder)
            (own / "configs" / "ingest").mkdir(parents=True)
            copyfile(path, own / "configs" / "ingest" / f"{path.stem}.yaml")
        try:
            return Composer(own).unit("check", [*layers, f"ingest={path.stem}"])
        except Problem as problem:
            raise ConfigurationError(str(problem), profile if own == Path(folder) else None) from None


def _print_facts(reading: Reading, countdown: Countdown | None = None) -> PipelineError | None:
    """Print content and notes of a recording, or its refusal, which is returned."""
    settings = reading.settings
    ((name, entry),) = settings["procedure"]["recordings"].items()
    refused: PipelineError | None = None
    try:
        table = read_table(reading.files, settings["ingest"])
        recording = to_recording(name, entry, table, settings["sensor"], checks_of(settings["ingest"]))
        parts = cut(recording, entry.get("windows")) if recording.role == "session" else []
        checked = check_recordings(parts or [recording], settings)
        parts, recording = (checked, recording) if parts else ([], checked[0])
    except PipelineError as error:
        refused = error
    if countdown is not None:
        countdown.end()
    print(f"{', '.join(map(str, reading.files))}\n  {'read with':<16}{reading.said}")
    if refused is not None:
        topics = topic_lines(reading.files[0], fields=refused.code == "missing_topic") if reading.has_topics else []
        place = _place(refused.file, reading.files)
        print(as_text([("REFUSED", f"{place}{refused.message}"), ("code", refused.code), *topics]) + "\n")
        return refused
    topics = topic_lines(reading.files[0], fields=False) if reading.has_topics else []
    segments = [("segments" if i == 0 else "", f"{p.name}: {_segment(p)}") for i, p in enumerate(parts)]
    print(as_text([*topics, *facts(recording, settings["sensor"]), *segments]) + "\n")
    return None


def _segment(part: Recording) -> str:
    return next(n.detail for n in part.notes if n.code == "N-SEGMENT")


def _place(file: str | None, files: Sequence[Path]) -> str:
    """Return where a refusal lies, without the name of the only file."""
    if file is None or [file] == [str(f) for f in files]:
        return ""
    line = file.removeprefix(f"{files[0]}:") if len(files) == 1 else file
    return f"line {line}: " if line.isdigit() else f"{file}: "


def _layouts(reading: Reading, error: PipelineError) -> list[TextLayout]:
    """Return the layout of each log that the profile does not describe; of a log of messages, that of one topic."""
    if not isinstance(error, IngestError) or error.code not in UNKNOWN_LAYOUT:
        return []
    found = []
    for file in reading.files:
        try:
            found.append(topics_of(file)[0] if reading.has_topics else _text_layout(file))
        except IngestError as none:
            print(f"{file}: {none.message}\n")
    return found


def _text_layout(file: Path) -> TextLayout:
    with file.open("rb") as stream:
        return find_layout(stream.read(SEARCHED_BYTES), str(file))


def _print_proposals(proposals: Sequence[Proposal], sensor: dict[str, Any], save: Path | None) -> None:
    """Print each proposed profile and the files as it reads them; with ``save``, write the only one."""
    if save is not None and len(proposals) > 1:
        raise ConfigurationError(f"{len(proposals)} profiles are proposed and --save writes one: check fewer files")
    name = "my_logger" if save is None else save.stem
    for proposal in proposals:
        print(f"PROPOSED PROFILE for {', '.join(proposal.files)}\n")
        text = as_yaml(proposal, name)
        print(textwrap.indent(text, "    "))
        if proposal.complete:
            print("With it:\n")
            ingest = proposal.ingest(name, sensor)
            groups = [[Path(f) for f in proposal.files]] if proposal.parts else [[Path(f)] for f in proposal.files]
            for group in groups:
                _print_facts(_reading_of_file(group, ingest, sensor, "the proposed profile"))
        elif proposal.unknown():
            print(f"Fill in {UNKNOWN} for {', '.join(proposal.unknown())}.")
        if save is not None:
            write_atomically(save, text)
            print(f"Saved as {save}. No configuration uses it yet.")
        print(NEXT.format(name=name))


NEXT = """\
If every line is right, save it (--save FILE) as configs/ingest/{name}.yaml of your campaign, and check it by
python -m pipeline check FILE --ingest {name}. A run uses it with the override ingest={name}, or with {name} in the
column ingest of units.csv.
"""
