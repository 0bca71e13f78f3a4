"""The ``mcap`` section of an ingest profile.

``configs/ingest/canonical_csv.yaml`` explains every key. ``topics`` maps the fields of any messages to channels:

    topics:
      /imu:
        time: {field: header.stamp}                        # or a number: {field: t, unit: us}
        accel_x: {field: acc.x, unit: m/s^2}
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator

from pipeline.errors import ConfigurationError
from pipeline.io.field_path import FieldPath
from pipeline.io.ingest_settings import ChannelSource, Section, refuse_unknown, validated
from pipeline.io.units import ATTITUDE, TRIADS, UNITS

HEADER, OWN, TIME = "header", "own", "time"
ONLY_ONE = "a name, or null for the only one"
Name = Annotated[str | None, Field(description=ONLY_ONE)]
Duration = Annotated[float, Field(ge=0)]


class MappedField(ChannelSource):
    """The field of a message that holds a channel."""

    field: FieldPath

    @field_validator("field", mode="before")
    @classmethod
    def _is_a_path(cls, value: object) -> FieldPath:
        return value if isinstance(value, FieldPath) else FieldPath.parse(value if isinstance(value, str) else "")


class McapFormat(Section):
    """How an MCAP file is read (``ingest.mcap``).

    ``topics``: topic to channel (or ``time``) to field. ``time_source``: the stamps in the messages, or the recorder's
    times. ``table_clock``: ``shared`` if the table's messages have the stamps of the Imu messages, ``own`` if they are
    aligned by the motion. ``clock_difference_s``: largest difference between stamps and recorder's times (None: any).
    ``reorder_s``: how late a message may stand in the file.
    """

    imu_topic: Name = None
    temperature_topic: Name = None
    joint_topic: Name = None
    attitude_topic: Name = None
    joint: Name = None
    topics: dict[str, dict[str, MappedField]] = Field(default_factory=dict)
    time_source: Literal["header", "log_time"] = Field(default="header", description="header or log_time")
    allow_truncated: bool = Field(default=False, description="true or false")
    table_clock: Literal["shared", "own"] = Field(default="shared", description="shared or own")
    clock_difference_s: Duration | None = Field(default=3600.0, description="a time in s, 0 or more")
    reorder_s: Duration = Field(default=1.0, description="a time in s, 0 or more")


def mcap_format(ingest: Mapping[str, Any]) -> McapFormat:
    """Return how an MCAP file is read."""
    section = dict(ingest.get("mcap") or {})
    topics = section.pop("topics", None) or {}
    settings = validated(McapFormat, section, "ingest.mcap")
    return settings.model_copy(update={"topics": _topics(topics, settings.time_source)})


def _topics(topics: Mapping[str, Any], source: str) -> dict[str, dict[str, MappedField]]:
    if not isinstance(topics, Mapping):
        raise ConfigurationError(f"ingest.mcap.topics is {topics!r}; it maps topics to channels")
    found: dict[str, dict[str, MappedField]] = {}
    seen: set[str] = set()
    for topic, entries in topics.items():
        where = f"ingest.mcap.topics.{topic}"
        refuse_unknown(where, entries or {}, tuple(UNITS))
        fields = {c: _field(f"{where}.{c}", c, e) for c, e in (entries or {}).items() if e is not None}
        if TIME not in fields and source == HEADER:
            raise ConfigurationError(f"{where}.time is missing: the field of the moment, or time_source=log_time")
        twice = seen & set(fields) - {TIME}
        if twice:
            raise ConfigurationError(f"ingest.mcap.topics: {', '.join(sorted(twice))} stands in two topics")
        seen |= set(fields)
        found[str(topic)] = fields
    for triad in (*TRIADS.values(), ATTITUDE):
        missing = [c for c in triad if c not in seen]
        if 0 < len(missing) < len(triad):
            raise ConfigurationError(f"ingest.mcap.topics: {', '.join(missing)} is not described")
    return found


def _field(where: str, channel: str, entry: Mapping[str, Any]) -> MappedField:
    refuse_unknown(where, entry, tuple(k for k in MappedField.model_fields if k != "channel"))
    default = {"unit": "ns"} if channel == TIME else {"unit": None}
    return validated(MappedField, {"channel": channel, "field": None, **default, **entry}, where)
