"""The ``checks`` section of an ingest profile: how much may be wrong with a file before it is refused."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

from pipeline.errors import ConfigurationError
from pipeline.io.setting_checks import is_number, refuse_unknown

if TYPE_CHECKING:
    from collections.abc import Mapping


@dataclass(frozen=True)
class Checks:
    """Limits of what is repaired or tolerated.

    Attributes
    ----------
    repaired_rows : float
        Largest share of a file's rows that may be dropped or put in order; each is noted, more are refused.
    missing_time : float
        Largest share of a recording's duration that may lie in gaps.
    disturbed_rows : float
        Largest share of a recording's samples that are left out as glitches and knocks; 0 keeps all.
    rate_hz : float or None, Hz
        Rate that the time stamps have to keep within a fifth; None where it is not known.
    """

    repaired_rows: float = 1e-3
    missing_time: float = 1e-2
    disturbed_rows: float = 2e-2
    rate_hz: float | None = None


def checks_of(ingest: Mapping[str, Any]) -> Checks:
    """Return the checks of an ingest profile.

    Raises
    ------
    ConfigurationError
        Naming the key, what it is, what is allowed.
    """
    section = ingest.get("checks") or {}
    refuse_unknown("ingest.checks", section, tuple(f.name for f in fields(Checks)))
    for key, value in section.items():
        if key == "rate_hz":
            if value is not None and not (is_number(value) and value > 0):
                raise ConfigurationError(f"ingest.checks.rate_hz is {value!r}; it is a positive number in Hz, or null")
        elif not (is_number(value) and 0 <= value <= 1):
            raise ConfigurationError(f"ingest.checks.{key} is {value!r}; it is a share between 0 and 1")
    return Checks(**section)
