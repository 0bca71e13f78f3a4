"""The sections of an ingest profile, checked; each is described where its files are read."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.io.checks import checks_of
from pipeline.io.csv_settings import Column, CsvFormat, csv_formats
from pipeline.io.files import candidate_files
from pipeline.io.mcap_settings import mcap_format

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["Column", "CsvFormat", "check_ingest", "checks_of", "csv_formats", "mcap_format"]


def check_ingest(ingest: Mapping[str, Any], procedure: Mapping[str, Any] | None = None) -> None:
    """Refuse an ingest profile that no file could be read with.

    Parameters
    ----------
    ingest : mapping
        Section of a unit's configuration.
    procedure : mapping, optional
        Where it is given, the profile's parts have to suit its recordings.

    Raises
    ------
    ConfigurationError
        Naming the key, what it is, what is allowed.
    """
    mcap_format(ingest)
    checks_of(ingest)
    if ingest.get("csv"):
        csv_formats(ingest)
    if procedure is not None:
        candidate_files(procedure, ingest)
