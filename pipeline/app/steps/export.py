"""Step export: write the calibration in the formats of other tools."""

from __future__ import annotations

from typing import Any

from pipeline.core.settings import Settings
from pipeline.output.exports import exports


def export(
    calibration: dict[str, Any], validation: dict[str, Any], diagnosis: dict[str, Any], settings: Settings
) -> dict[str, str]:
    """Return the files of ``exports/<unit>/`` by name."""
    return exports(calibration, settings, validation, diagnosis)
