"""The ``mcap`` section of an ingest profile, checked.

Every key stands with its unit and a sentence in ``configs/ingest/canonical_csv.yaml``. ``topics`` maps the fields of
messages of any type to channels:

    topics:
      /imu:
        time: {field: header.stamp}                        # or a number: {field: t, unit: us}
        accel_x: {field: acc.x, unit: m/s^2}
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from pipeline.errors import ConfigurationError
from pipeline.io.field_path import FieldPath
from pipeline.io.ingest_settings import is_number, refuse_unknown
from pipeline.io.units import ATTITUDE, COUNTS, TRIADS, UNITS

if TYPE_CHECKING:
    from collections.abc import Mapping

NAMES = ("imu_topic", "temperature_topic", "joint_topic", "attitude_topic", "joint")
KEYS = (*NAMES, "topics", "time_source", "allow_truncated", "table_clock", "clock_difference_s", "reorder_s")
TIME_SOURCES = ("header", "log_time")
SHARED, OWN = "shared", "own"
FIELD_KEYS = ("field", "unit", "counts_per_unit", "offset")
TIME = "time"


@dataclass(frozen=True)
class MappedField:
    """Where a channel comes from: the path of a number, its unit, and the scale of its counts."""

    path: FieldPath
    unit: str
    counts_per_unit: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class McapFormat:
    """How an MCAP file is read.

    Attributes
    ----------
    imu_topic, temperature_topic, joint_topic, attitude_topic : str or None
        None stands for the only topic of its type.
    joint : str or None
        The table's joint; None for the only one.
    topics : dict of str to dict of str to MappedField
        Topic to channel (or ``time``) to field.
    time_source : str
        ``header`` or ``log_time``.
    allow_truncated : bool
    table_clock : str
        ``shared``: the table's messages bear the Imu's stamps; ``own``: they are aligned by the motion.
    clock_difference_s, reorder_s : float, s
        How far headers and recorder may be apart (None: any), and how late a message may stand in the file.
    """

    imu_topic: str | None = None
    temperature_topic: str | None = None
    joint_topic: str | None = None
    attitude_topic: str | None = None
    joint: str | None = None
    topics: dict[str, dict[str, MappedField]] = field(default_factory=dict)
    time_source: str = "header"
    allow_truncated: bool = False
    table_clock: str = SHARED
    clock_difference_s: float | None = 3600.0
    reorder_s: float = 1.0


def mcap_format(ingest: Mapping[str, Any]) -> McapFormat:
    """Return how an MCAP file is read.

    Raises
    ------
    ConfigurationError
        Naming the key, what it is, what is allowed.
    """
    mcap: Mapping[str, Any] = ingest.get("mcap") or {}
    refuse_unknown("ingest.mcap", mcap, KEYS)
    for key in NAMES:
        value = mcap.get(key)
        if not (value is None or isinstance(value, str)):
            raise ConfigurationError(f"ingest.mcap.{key} is {value!r}; it is a name, or null for the only one")
    source, truncated = mcap.get("time_source", "header"), mcap.get("allow_truncated", False)
    if source not in TIME_SOURCES:
        raise ConfigurationError(f"ingest.mcap.time_source is {source!r}; it is {' or '.join(TIME_SOURCES)}")
    if mcap.get("table_clock", SHARED) not in (SHARED, OWN):
        raise ConfigurationError(f"ingest.mcap.table_clock is {mcap['table_clock']!r}; it is {SHARED} or {OWN}")
    if not isinstance(truncated, bool):
        raise ConfigurationError(f"ingest.mcap.allow_truncated is {truncated!r}; it is true or false")
    for key, may_lack in (("clock_difference_s", True), ("reorder_s", False)):
        value = mcap.get(key, 0.0)
        if not ((may_lack and value is None) or (is_number(value) and value >= 0)):
            raise ConfigurationError(f"ingest.mcap.{key} is {value!r}; it is a time in s, 0 or more")
    plain = {k: v for k, v in mcap.items() if k != "topics"}
    return McapFormat(**plain, topics=_topics(mcap.get("topics") or {}, source))


def _topics(topics: Mapping[str, Any], source: str) -> dict[str, dict[str, MappedField]]:
    if not hasattr(topics, "items"):
        raise ConfigurationError(f"ingest.mcap.topics is {topics!r}; it maps topics to channels")
    found: dict[str, dict[str, MappedField]] = {}
    seen: set[str] = set()
    for topic, entries in topics.items():
        where = f"ingest.mcap.topics.{topic}"
        refuse_unknown(where, entries or {}, tuple(UNITS))
        found[str(topic)] = {c: _mapped(f"{where}.{c}", c, e) for c, e in (entries or {}).items() if e is not None}
        channels = set(found[str(topic)])
        if TIME not in channels and source == "header":
            raise ConfigurationError(f"{where}.time is missing: the field of the moment, or time_source=log_time")
        twice = seen & channels - {TIME}
        if twice:
            raise ConfigurationError(f"ingest.mcap.topics: {', '.join(sorted(twice))} stands in two topics")
        seen |= channels
    for triad in (*TRIADS.values(), ATTITUDE):
        missing = [c for c in triad if c not in seen]
        if 0 < len(missing) < len(triad):
            raise ConfigurationError(f"ingest.mcap.topics: {', '.join(missing)} is not described")
    return found


def _mapped(where: str, channel: str, entry: Mapping[str, Any]) -> MappedField:
    refuse_unknown(where, entry, FIELD_KEYS)
    unit, path = str(entry.get("unit", "ns" if channel == TIME else None)), entry.get("field")
    if unit not in UNITS[channel]:
        raise ConfigurationError(f"{where}.unit is {entry.get('unit')!r}; allowed are {', '.join(UNITS[channel])}")
    scale, offset = entry.get("counts_per_unit"), entry.get("offset", 0.0)
    if (unit == COUNTS) != (is_number(scale) and scale != 0) or not is_number(offset) or (offset and unit != COUNTS):
        raise ConfigurationError(
            f"{where}: the unit counts, and no other, has counts_per_unit (a number other than 0) and offset"
        )
    try:
        parsed = FieldPath.parse(path if isinstance(path, str) else "")
    except ValueError as error:
        raise ConfigurationError(f"{where}.field is {path!r}: {error}") from error
    return MappedField(parsed, unit, float(scale or 1.0), float(offset))
