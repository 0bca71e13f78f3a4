"""Find the files of a log that a command reads, and the configuration from its campaign or from the options."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from shutil import copyfile
from typing import Literal

from imu_logs.files import ZIP, is_message_log
from imu_logs.profile import checks_of
from pipeline.app.config.campaign import Campaign
from pipeline.app.config.compose import Composer
from pipeline.app.config.options import nearest
from pipeline.checks.checks import check_recordings
from pipeline.core.errors import ConfigurationError
from pipeline.core.files import CONFIGS
from pipeline.core.records import Recording
from pipeline.core.settings import Ingest, RecordingFile, Sensor, Settings
from pipeline.ingest.files import candidate_files
from pipeline.ingest.read import read_table, to_recording
from pipeline.simulation.description import shipped_settings

DEFAULT_PROFILE = "canonical_csv"
SEARCHED_FOLDERS = 4  # from the folder of the log upwards: a campaign is above raw/<unit>/


@dataclass
class Reading:
    """Files that are read as one recording, and the settings for it."""

    files: list[Path]
    name: str
    entry: RecordingFile
    settings: Settings  # sections ``procedure``, ``table``, ``ingest``, and ``sensor`` where it is known
    read_with: str = ""  # profile, sensor and place in a campaign, in words
    of_campaign: bool = False  # whether it is a recording of a campaign's unit

    @classmethod
    def alone(
        cls,
        files: list[Path],
        ingest: Ingest,
        sensor_model: Sensor | None,
        read_with: str = "",
        role: Literal["rests", "static"] = "rests",
    ) -> Reading:
        """Return the reading of files that belong to no campaign, without a table; None: no sensor is stated."""
        name, hand = files[0].stem, shipped_settings(procedure="multi_position", table="hand")
        entry = RecordingFile(file=files[0].name, role=role, axis=None, optional=False)
        procedure = hand.procedure.replaced(recordings={name: entry})
        known = {"sensor": sensor_model} if sensor_model else {}
        settings = Settings.with_sections(procedure=procedure, table=hand.table, ingest=ingest, **known)
        return cls(files, name, entry, settings, read_with)

    @property
    def sensor_model(self) -> Sensor | None:
        """The sensor; None if it is not stated."""
        return self.settings.sensor if "sensor" in self.settings.model_fields_set else None

    @property
    def has_topics(self) -> bool:
        """Whether the recording is a message log: MCAP, or a format that needs an extra."""
        return is_message_log(self.files[0])

    def recording(self) -> Recording:
        """Return the recording, without checks."""
        ingest, entry = self.settings.ingest, self.entry
        table = read_table(self.files, ingest, session=entry.session)
        return to_recording(self.name, entry, table, self.sensor_model, checks_of(ingest))

    def checked(self) -> Recording:
        """Return the recording after the checks of a single recording; without a sensor, by those of ``generic``."""
        generic = {} if self.sensor_model else {"sensor": shipped_settings(sensor="generic").sensor}
        return check_recordings([self.recording()], self.settings.replaced(**generic))[0]


def absolute(file: Path) -> Path:
    """Return an absolute path without following links."""
    return Path(os.path.abspath(file))  # noqa: PTH100  (resolve() follows links)


def campaign_of(file: Path) -> Path | None:
    """Return the campaign that contains a file or the link to it; None if there is none."""
    above = [*absolute(file).parents, *file.resolve().parents]
    return next((d for d in above if (d / "units.csv").is_file()), None)


def recordings_of_files(
    files: Sequence[Path], campaign: Campaign, units: Sequence[str]
) -> tuple[dict[str, list[str]], list[Path]]:
    """Return the names of the recordings that files contain, by unit, and the files of no recording."""
    known: dict[Path, tuple[str, list[str]]] = {}  # file to its unit and recordings
    for unit in units:
        config, folder = campaign.units[unit].config, campaign.folder(unit)
        for name, candidates in candidate_files(config.procedure, config.ingest).items():
            for file in (folder / f for parts in candidates for f in parts):
                for path in {absolute(file), file.resolve()}:
                    owner, names = known.setdefault(path, (unit, []))
                    names += [name] if owner == unit else []
    chosen: dict[str, list[str]] = {}
    others = []
    for file in files:
        unit, names = known.get(absolute(file)) or known.get(file.resolve()) or ("", [])
        if not unit:
            others.append(file)
            continue
        chosen[unit] = list(dict.fromkeys([*chosen.get(unit, []), *names]))
    return chosen, others


def config_of_log(
    file: Path, profile: str | None, sensor: str | None, more: Sequence[str] = (), campaign: Path | None = None
) -> Settings:
    """Return the settings for a single log, from a profile (default: ``DEFAULT_PROFILE``) and a sensor.

    Both may be options of ``campaign`` or, by default, of the campaign that contains the log. ``more``: overrides.
    """
    campaign = campaign or campaign_of(file)
    profile = _named(profile, file, campaign) if profile else DEFAULT_PROFILE
    path = Path(profile)
    layers = ["procedure=multi_position", *([f"sensor={sensor}"] if sensor else []), *more]
    with tempfile.TemporaryDirectory() as folder:
        directory = campaign or Path(folder)
        if path.suffix in (".yaml", ".yml"):
            if not path.is_file():
                raise ConfigurationError("there is no such file", profile)
            directory = Path(folder)
            (directory / "configs" / "ingest").mkdir(parents=True)
            copyfile(path, directory / "configs" / "ingest" / f"{path.stem}.yaml")
        composer = Composer(directory)
        try:
            return composer.unit("check", [*layers, f"ingest={path.stem}"])
        except ConfigurationError as problem:
            raise ConfigurationError(str(problem), profile if directory == Path(folder) else None) from None


def _named(profile: str, file: Path, campaign: Path | None) -> str:
    """Return a known name of a profile unchanged, else the path of the only saved file with that name.

    The search includes the working directory, the folders above the log, and ``configs/ingest`` of each of these and of
    the campaigns below the working directory. Raises ``ConfigurationError`` if there is no such file, or if files of
    that name contain different profiles.
    """
    known = [root / "ingest" / f"{profile}.yaml" for root in (CONFIGS, *([campaign / "configs"] if campaign else []))]
    if Path(profile).suffix in (".yaml", ".yml") or any(place.is_file() for place in known):
        return profile
    folders = [Path.cwd(), *list(file.resolve().parents)[:SEARCHED_FOLDERS]]
    places = [place for folder in folders for place in (folder, folder / "configs" / "ingest")]
    places += sorted(Path.cwd().glob("*/configs/ingest"))
    saved = {f.resolve(): f.read_bytes() for place in places if (f := place / f"{profile}.yaml").is_file()}
    if len(set(saved.values())) > 1:
        raise ConfigurationError(f"--ingest {profile} is one of {', '.join(map(str, saved))}; name its path")
    if not saved:
        valid = nearest(profile, {f.stem for place in known for f in place.parent.glob("*.yaml")})
        raise ConfigurationError(f"--ingest {profile}: no such ingest{valid}; name a profile of your own by its file")
    return str(next(iter(saved)))


def complete_rows(file: Path, folder: Path) -> Path:
    """Return a copy in ``folder`` of a text log up to its last complete row; logs of messages as they are."""
    if is_message_log(file) or file.suffix.lower() == ZIP:
        return file
    copy = folder / file.name
    copy.write_bytes(file.read_bytes().rpartition(b"\n")[0] + b"\n")
    return copy
