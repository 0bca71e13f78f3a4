"""Stage effects of the gyroscope: bias, matrix and effects by generalized least squares."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.estimation.effects_stage import fit_effects

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.records import Recording, SensorCalibration


def fit(
    recordings: Sequence[Recording], previous: SensorCalibration | None, settings: Mapping[str, Any]
) -> SensorCalibration:
    """Fit the configured or selected effects; parameters as of ``effects_stage.fit_effects``."""
    return fit_effects("gyroscope", recordings, previous, settings)
