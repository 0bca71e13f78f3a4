"""Bias and full matrix of the accelerometer against the table's motion; see ``pipeline.estimation.reference``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.estimation.reference import fit_reference

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from typing import Any

    from pipeline.records import Recording, SensorCalibration


def fit(
    recordings: Sequence[Recording], previous: SensorCalibration | None, settings: Mapping[str, Any]
) -> SensorCalibration:
    """Fit the accelerometer; see ``pipeline.estimation.reference.fit_reference``."""
    return fit_reference("accelerometer", recordings, previous, settings)
