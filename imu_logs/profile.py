"""Read and check the settings of an ingest profile; ``configs/ingest/canonical_csv.yaml`` explains every key.

A profile describes a file: names, units, separators and the order of columns are never guessed from the file.
``ingest.mcap.topics`` maps the fields of any messages to channels:

    topics:
      /imu:
        time: {field: header.stamp}                        # or a number: {field: t, unit: us}
        accel_x: {field: acc.x, unit: m/s^2}
"""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, field_validator, model_validator

from imu_logs.errors import ConfigurationError
from imu_logs.units import ACCELEROMETER, ATTITUDE, COUNTS, GYROSCOPE, TRIADS, UNITS

_PACKAGE = Path(__file__).resolve().parent
# Of the shipped profiles: in a wheel beside this file, in a clone beside the package.
PROFILES = next(p for p in (_PACKAGE / "profiles", _PACKAGE.parent / "configs" / "ingest") if p.is_dir())
WHITESPACE, AUTO, COMMENTED = "whitespace", "auto", "commented"
REFUSE, DROP, GAP = "refuse", "drop", "gap"
DELIMITER_NAMES = {"comma": ",", "semicolon": ";", "tab": "\t", "pipe": "|", "space": " "}

Share = Annotated[float, Field(ge=0, le=1, description="a share between 0 and 1")]
Rate = Annotated[float, Field(gt=0, allow_inf_nan=False)]
HEADER, OWN, TIME = "header", "own", "time"
FIRST = "[0]"  # of a topic's name: the first instance, which has the name alone
ONLY_ONE = "a name, or null for the only one"
Name = Annotated[str | None, Field(description=ONLY_ONE)]
Duration = Annotated[float, Field(ge=0)]


_STEP = re.compile(r"([^.\[\]]+)((?:\[\d+\])*)")
_LAST = re.compile(r"(.*?)(?:\[([^\[\]]+)\])?")
NAMES = "name"


@dataclass(frozen=True)
class FieldPath:
    """A path: its text, the base without the last index, and that index (a number, a name, ``*``, or None)."""

    text: str
    base: str
    index: int | str | None

    @classmethod
    def parse(cls, text: str) -> FieldPath:
        """Parse a path; raise ``ValueError`` if it is invalid."""
        match = _LAST.fullmatch(text)
        base, last = match.groups() if match else ("", None)
        if not all(_STEP.fullmatch(part) for part in base.split(".")):
            raise ValueError(f"{text!r} is no path to a field, such as linear_acceleration.x or position[table]")
        return cls(text, base, int(last) if last is not None and last.isdigit() else last)

    @property
    def steps(self) -> list[str | int]:
        """Names and indices of the base, in order."""
        found: list[str | int] = []
        for part in self.base.split("."):
            name, _, rest = part.partition("[")
            found.append(name)
            found += [int(i) for i in re.findall(r"\d+", rest)]
        return found

    @property
    def names(self) -> FieldPath:
        """Path to the list of names in the same message as the numbers."""
        parent = self.base.rpartition(".")[0]
        base = f"{parent}.{NAMES}" if parent else NAMES
        return FieldPath(base, base, None)


class ProfileSection(BaseModel):
    """A section of an ingest profile. The description of a field states the expected value in an error message."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class Profile(ProfileSection):
    """A profile of logs: ``configs/ingest/canonical_csv.yaml`` explains the keys of ``csv``, ``mcap`` and ``checks``.

    ``instance`` selects a sensor in a log of several sensors; names in ``csv`` and ``mcap`` refer to it. A profile of
    text logs needs no ``mcap``, a profile of message logs no ``csv``.
    """

    name: str
    instance: str | int | None = None
    csv: dict[str, Any] = {}
    mcap: dict[str, Any] = {}
    checks: dict[str, Any] = {}


class Checks(ProfileSection):
    """Limits of repairs and faults (``ingest.checks``).

    ``repaired_rows``: share of a file's rows that may be dropped or sorted. ``missing_time``: share of the duration in
    gaps. ``disturbed_rows``: share of samples that may be removed as disturbances; 0: remove none. ``rate_hz``:
    expected sampling rate, within 20 %; None: unknown.
    """

    repaired_rows: Share = 1e-3
    missing_time: Share = 1e-2
    disturbed_rows: Share = 2e-2
    rate_hz: Rate | None = Field(default=None, description="a positive number in Hz, or null")


class ChannelSource(ProfileSection):
    """The source of a channel: its unit, and the scale of counts."""

    channel: str
    unit: str = Field(default="", validate_default=True)
    counts_per_unit: float = Field(default=1.0, description="a number other than 0")
    offset: float = Field(default=0.0, description="a number of counts")

    @classmethod
    def units(cls, channel: str) -> list[str]:
        """Return the units that are allowed for a channel."""
        return list(UNITS[channel])

    @model_validator(mode="before")
    @classmethod
    def _without_null(cls, given: dict[str, Any]) -> dict[str, Any]:
        return {key: value for key, value in given.items() if value is not None}

    @field_validator("unit", mode="before")
    @classmethod
    def _is_a_unit_of_the_channel(cls, value: object, info: ValidationInfo) -> str:
        allowed = cls.units(info.data["channel"])
        if str(value) not in allowed:
            raise ValueError(f"allowed are {', '.join(allowed)}")
        return str(value)

    @model_validator(mode="after")
    def _scales_counts_only(self) -> Self:
        scaled = "counts_per_unit" in self.model_fields_set
        if self.unit == COUNTS and (not scaled or self.counts_per_unit == 0):
            value = self.counts_per_unit if scaled else None
            raise ValueError(f"counts_per_unit is {value!r}; counts need a number other than 0")
        if self.unit != COUNTS and (scaled or self.offset):
            raise ValueError(f"counts_per_unit and offset belong to the unit counts; this is {self.unit}")
        if self.channel == "time" and self.offset:
            raise ValueError(f"offset is {self.offset!r}; a time has none")
        return self


class Column(ChannelSource):
    """The column of a channel: its name, or its index from 0. A time may be in counts, too."""

    column: str | int = Field(default="", validate_default=True)
    optional: bool = Field(default=False, description="true or false")

    def index(self, names: Sequence[str]) -> int | None:
        """Return the index of the column in a file with these names; None where it is missing."""
        if isinstance(self.column, int):
            return self.column if self.column < len(names) else None
        return names.index(self.column) if self.column in names else None

    @classmethod
    def units(cls, channel: str) -> list[str]:
        """Return the units that are allowed for a channel."""
        return [*UNITS[channel], *([COUNTS] if channel == "time" else [])]

    @field_validator("column")
    @classmethod
    def _names_a_column(cls, value: str | int, info: ValidationInfo) -> str | int:
        header = (info.context or {}).get("header", True)
        if (isinstance(value, str) and value) if header else (isinstance(value, int) and value >= 0):
            return value
        raise ValueError(f"it is {'a name of the header' if header else 'an index from 0, for header is false'}")


class CsvFormat(ProfileSection):
    """The layout of one text file (``ingest.csv``).

    ``comment``: start of lines that are no data. ``header``: ``commented`` if the last comment names the columns.
    ``rate_hz``: sampling rate of a file without a time column. ``session``: which part, from 1, of a restarted log to
    read. ``own_clock``: the times are of the table's clock.
    """

    delimiter: str = Field(default=",", description="a character")
    decimal: Literal[".", ","] = Field(default=".", description="'.' or ','")
    comment: str | None = Field(default=None, description="a text, or null", pattern=r"\S")
    header: bool | Literal["commented"] = Field(default=True, description=f"true or false, or {COMMENTED}")
    skip_lines: int = Field(default=0, ge=0, description="a number of lines, 0 or more")
    bad_rows: Literal["refuse", "drop"] = Field(default="refuse", description=f"{REFUSE} or {DROP}")
    nan: Literal["refuse", "gap"] = Field(default="refuse", description=f"{REFUSE} or {GAP}")
    session: int | None = Field(default=None, ge=1, description="a number counted from 1, or null")
    rate_hz: Rate | None = Field(default=None, description="a positive number in Hz, or null")
    own_clock: bool = False
    columns: tuple[Column, ...] = ()

    @field_validator("delimiter", mode="before")
    @classmethod
    def _is_a_delimiter(cls, value: object) -> object:
        if isinstance(value, str):
            if value in DELIMITER_NAMES:
                return DELIMITER_NAMES[value]
            if value in (WHITESPACE, AUTO) or (len(value) == 1 and value.isascii() and value not in '\r\n"'):
                return value
        names = ", ".join(DELIMITER_NAMES)
        raise ValueError(
            f"it is one character, or {WHITESPACE}, {AUTO}, {names} (write semicolon in units.csv, where ; separates "
            "overrides)"
        )

    @model_validator(mode="after")
    def _agrees_with_itself(self) -> CsvFormat:
        if self.decimal == self.delimiter:
            raise ValueError(f"decimal and ingest.csv.delimiter are both {self.delimiter!r}")
        if self.header == COMMENTED and self.comment is None:
            raise ValueError(f"header is {COMMENTED}; ingest.csv.comment has to say how comments start")
        return self

    @property
    def tick_ns(self) -> Fraction | None:
        """Duration of one count of the time in ns, None where the time has a unit."""
        time = next((c for c in self.columns if c.channel == "time" and c.unit == COUNTS), None)
        return None if time is None else 1_000_000_000 / Fraction(repr(time.counts_per_unit))


class _Part(ProfileSection):
    """One of several files of a recording."""

    file: str = Field(min_length=1, description="the name of a file")
    own_clock: bool = Field(default=False, description="true or false")
    columns: Any = None


S = TypeVar("S", bound=ProfileSection)
C = TypeVar("C", bound=ChannelSource)


def validated(model: type[S], section: Any, where: str, given: Mapping[str, Any] | None = None, **context: Any) -> S:  # noqa: ANN401
    """Parse a section to its model; an error names the key below ``where``, its value and what is allowed.

    ``given``: fields that are not set by the user.
    """
    given = given or {}
    refuse_unknown(where, section, [k for k in model.model_fields if k not in given])
    try:
        return model.model_validate({**section, **given}, context=context)
    except ValidationError as error:
        first = error.errors()[0]
    key = str(first["loc"][0]) if first["loc"] else ""
    reason = str(first["ctx"]["error"]) if first["type"] == "value_error" else ""
    if not key:
        raise ConfigurationError(f"{where}.{reason}")
    expected = reason or f"it is {model.model_fields[key].description or 'required'}"
    raise ConfigurationError(f"{where}.{key} is {section.get(key)!r}; {expected}")


def refuse_unknown(where: str, entries: object, allowed: Iterable[str]) -> None:
    """Raise ``ConfigurationError`` if ``entries`` is no mapping or has an unknown key, with the nearest known key."""
    known = tuple(allowed)
    if not isinstance(entries, Mapping):
        raise ConfigurationError(f"{where} is {entries!r}; it is a mapping with {', '.join(known)}")
    for key in entries:
        if key not in known:
            near = difflib.get_close_matches(str(key), known, 1)
            hint = f"did you mean {near[0]}?" if near else f"known are {', '.join(known)}"
            raise ConfigurationError(f"{where}.{key} is unknown; {hint}")


def _channels(model: type[C], where: str, entries: Any, **context: Any) -> dict[str, C]:  # noqa: ANN401  (the user's)
    """Return the sources of the channels of a file or topic, without channels set to null."""
    refuse_unknown(where, entries, UNITS)
    stated = {channel: entry for channel, entry in entries.items() if entry is not None}
    return {c: validated(model, entry, f"{where}.{c}", {"channel": c}, **context) for c, entry in stated.items()}


def _once(where: str, groups: Iterable[Iterable[str]], what: str) -> set[str]:
    """Return the channels of all files or topics; raise ``ConfigurationError`` if one, except the time, is in two."""
    seen: set[str] = set()
    for channels in groups:
        twice = seen & set(channels) - {TIME}
        if twice:
            raise ConfigurationError(f"{where}: {', '.join(sorted(twice))} is in two {what}")
        seen |= set(channels)
    return seen


def checks_of(profile: Profile) -> Checks:
    """Return the limits of an ingest profile (``ingest.checks``)."""
    return validated(Checks, profile.checks, "ingest.checks")


def csv_formats(profile: Profile) -> list[CsvFormat]:
    """Return the layout of each text file of a recording: one, or one for each part in the profile's ``parts``."""
    csv = profile.csv
    refuse_unknown("ingest.csv", csv, [k for k in (*CsvFormat.model_fields, "parts") if k != "own_clock"])
    shared = {k: v for k, v in csv.items() if k not in ("parts", "columns")}
    header = bool(validated(CsvFormat, shared, "ingest.csv").header)
    parts = {"ingest.csv": _Part(file="{file}", columns=csv.get("columns"))}
    if csv.get("parts"):
        places = {f"ingest.csv.parts[{index}]": part for index, part in enumerate(csv["parts"])}
        parts = {place: validated(_Part, part, place) for place, part in places.items()}
    formats = []
    for where, part in parts.items():
        columns = _channels(Column, f"{where}.columns", part.columns or {}, header=header)
        settings = {**shared, "own_clock": part.own_clock, "columns": tuple(columns.values())}
        formats.append(validated(CsvFormat, settings, "ingest.csv"))
    _check_channels(formats)
    return formats


def _check_channels(formats: Sequence[CsvFormat]) -> None:
    """Raise ``ConfigurationError`` for a profile without time, without a sensor, or with an incomplete sensor."""
    readings, channels = {*ACCELEROMETER, *GYROSCOPE}, [{c.channel for c in layout.columns} for layout in formats]
    for layout, in_part in zip(formats, channels, strict=True):
        if layout.own_clock and (in_part & readings or TIME not in in_part):
            raise ConfigurationError(
                "ingest.csv.parts: a part with own_clock is a table's log with its time; it holds "
                f"{', '.join(sorted(in_part & readings)) or 'no time'}"
            )
        if (TIME in in_part) == (layout.rate_hz is not None):
            raise ConfigurationError(
                "ingest.csv needs either a time column (columns.time) or the sampling rate (rate_hz), in every part"
            )
    seen = _once("ingest.csv.parts", channels, "parts")
    for sensor, triad in TRIADS.items():
        missing = [c for c in triad if c not in seen]
        if 0 < len(missing) < len(triad):
            raise ConfigurationError(f"ingest.csv.columns: {', '.join(missing)} of the {sensor} is not described")
    if not seen & readings:
        raise ConfigurationError("ingest.csv.columns describes neither an accelerometer nor a gyroscope")


class MappedField(ChannelSource):
    """The field of a message with the values of a channel; a time is in ns by default."""

    field: FieldPath = Field(description="a path, such as linear_acceleration.x or position[table]")

    @model_validator(mode="before")
    @classmethod
    def _time_in_ns(cls, given: dict[str, Any]) -> dict[str, Any]:
        return {"unit": "ns", **given} if given["channel"] == TIME else given

    @field_validator("field", mode="before")
    @classmethod
    def _is_a_path(cls, value: object) -> FieldPath:
        return value if isinstance(value, FieldPath) else FieldPath.parse(value if isinstance(value, str) else "")


class _LogPart(ProfileSection):
    """One of several message logs of a recording."""

    file: str = Field(min_length=1, description="the name of a file")
    topics: Any = None


class McapFormat(ProfileSection):
    """How an MCAP file is read (``ingest.mcap``).

    ``topics``: topic to channel (or ``time``) to field. ``time_source``: the stamps in the messages, or the recorder's
    times. ``rate_hz``: sampling rate of messages without usable times, which are counted (None: they have times).
    ``table_clock``: ``shared`` if the table's messages have the stamps of the Imu messages, ``own`` if they are
    to be aligned by the motion. ``sensor_clock``: ``own`` if the two sensors have different stamps and rates of one
    clock. ``clock_difference_s``: largest difference between stamps and recorder's times (None: any). ``reorder_s``:
    largest delay of a message in the file.
    """

    imu_topic: Name = None
    temperature_topic: Name = None
    joint_topic: Name = None
    attitude_topic: Name = None
    joint: Name = None
    topics: dict[str, dict[str, MappedField]] = Field(default_factory=dict)
    time_source: Literal["header", "log_time"] = Field(default="header", description="header or log_time")
    rate_hz: Rate | None = Field(default=None, description="a positive number in Hz, or null")
    allow_truncated: bool = Field(default=False, description="true or false")
    table_clock: Literal["shared", "own"] = Field(default="shared", description="shared or own")
    sensor_clock: Literal["shared", "own"] = Field(default="shared", description="shared or own")
    clock_difference_s: Duration | None = Field(default=3600.0, description="a time in s, 0 or more")
    reorder_s: Duration = Field(default=1.0, description="a time in s, 0 or more")


def mcap_formats(profile: Profile) -> list[McapFormat]:
    """Return how each message log of a recording is read: one, or one for each part in the profile's ``parts``."""
    parts = profile.mcap.get("parts")
    if not parts:
        return [mcap_format(profile)]
    if profile.mcap.get("topics") or profile.csv.get("parts"):
        message = "ingest.mcap.parts: topics stand in each part, and ingest.csv.parts is null beside them"
        raise ConfigurationError(message)
    formats = []
    for index, entry in enumerate(parts):
        where = f"ingest.mcap.parts[{index}]"
        topics = validated(_LogPart, entry, where).topics
        formats.append(mcap_format(profile.model_copy(update={"mcap": {**profile.mcap, "topics": topics}}), where))
    _once("ingest.mcap.parts", ([c for topic in f.topics.values() for c in topic] for f in formats), "parts")
    return formats


def mcap_format(profile: Profile, place: str = "ingest.mcap") -> McapFormat:
    """Return how a message log is read; ``place``: of its topics, in errors."""
    section = {key: value for key, value in profile.mcap.items() if key != "parts"}
    topics = section.pop("topics", None) or {}
    settings = validated(McapFormat, section, "ingest.mcap")
    if not isinstance(topics, Mapping):
        raise ConfigurationError(f"{place}.topics is {topics!r}; it maps topics to channels")
    found = {}
    for topic, entries in topics.items():
        where = f"{place}.topics.{topic}"
        found[str(topic).removesuffix(FIRST)] = fields = _channels(MappedField, where, entries or {})
        if TIME not in fields and settings.time_source == HEADER and settings.rate_hz is None:
            raise ConfigurationError(
                f"{where}.time is missing: the field of the moment, time_source=log_time, or the sampling rate "
                "(ingest.mcap.rate_hz)"
            )
    seen = _once(f"{place}.topics", found.values(), "topics")
    for triad in (*TRIADS.values(), ATTITUDE):
        missing = [c for c in triad if c not in seen]
        if 0 < len(missing) < len(triad):
            raise ConfigurationError(f"{place}.topics: {', '.join(missing)} is not described")
    return settings.model_copy(update={"topics": found})


def load_profile(profile: Mapping[str, Any] | str | os.PathLike[str], **changed: Any) -> Profile:  # noqa: ANN401
    """Return a profile.

    ``profile``: the keys of a profile, the name of a shipped one, or a YAML file. ``defaults`` names shipped profiles
    that it extends. ``${ingest.instance}`` stands for its key ``instance``. ``changed``: keys to replace: ``instance``,
    ``csv``, ``mcap`` or ``checks``; mappings are merged. Raises ``ConfigurationError`` if the profile is unknown or not
    valid, or refers to a setting of another program, such as ``${sensor.accelerometer.counts_per_unit}``.
    """
    if isinstance(profile, Mapping):
        content, where = dict(profile), "profile"
    else:
        path = Path(profile)
        path = path if path.suffix in (".yaml", ".yml") else PROFILES / f"{profile}.yaml"
        if not path.is_file():
            known = ", ".join(sorted(f.stem for f in PROFILES.glob("*.yaml")))
            raise ConfigurationError(
                f"no profile {profile}; shipped are {known}; name one of your own by its YAML file"
            )
        from imu_logs.yaml_file import read_yaml  # noqa: PLC0415  (a run reads profiles as settings)

        content, where = read_yaml(path), str(path)
    if not isinstance(content, Mapping):
        raise ConfigurationError(f"holds {content!r}; a profile is a mapping", where)
    merged: dict[str, Any] = {}
    for base in content.get("defaults") or ():
        of_base = {k: v for k, v in content.items() if k != "defaults"} if base == "_self_" else None
        merged = _merged(merged, load_profile(base).model_dump() if of_base is None else of_base)
    merged = _merged(merged or {"name": "profile"} | dict(content), changed)
    stated = _filled(merged, {"${ingest.instance}": str(merged.get("instance"))}, where)
    return validated(Profile, stated, "ingest")


def _merged(base: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, Any]:
    """Return mappings merged key by key, the second before the first."""
    both = {
        k: _merged(v, other[k]) for k, v in base.items() if isinstance(v, Mapping) and isinstance(other.get(k), Mapping)
    }
    return {**base, **other, **both}


def _filled(value: Any, known: Mapping[str, str], where: str) -> Any:  # noqa: ANN401  (any value of YAML)
    """Return a value with the texts of known references in their place."""
    if isinstance(value, Mapping):
        return {_filled(k, known, where): _filled(v, known, where) for k, v in value.items()}
    if isinstance(value, list):
        return [_filled(v, known, where) for v in value]
    if not isinstance(value, str) or "${" not in value:
        return value
    for reference, text in known.items():
        value = value.replace(reference, text)
    if "${" in value:
        message = f"refers to {value}, a setting of another program: write the number into a copy of the profile"
        raise ConfigurationError(message, where)
    return value
