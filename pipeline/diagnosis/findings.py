"""What a selection found, in the same terms for turns on a table and for rests and moves by hand."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from pipeline.estimation.design import Term
    from pipeline.estimation.ranking import Score
    from pipeline.records import SensorCalibration

    Values = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Findings:
    """What a selection found, and how every candidate did."""

    sensor: str
    selected: Sequence[str]
    verdict: str  # by the selection alone
    steps: Mapping[str, Score]  # of each selected effect when it was accepted
    alone: Mapping[str, Score]  # of each candidate given base and configured effects
    terms: Sequence[Term]  # configured and selected effects at their values in the fit of all
    covariance: Values  # of that fit; the effects' parameters come last
    limits: Mapping[str, Values]  # of plausibility
    shares: Callable[[str], Mapping[str, float]]  # of an effect's fitted signal that each other one reproduces
    left: Sequence[float]  # residual sum or mean of squares of the base, and with each further selected effect
    drop_alone: Callable[[str], float]  # by how much an effect that was not selected would lower the first
    excess: float  # of the first over the noise
    held_out: Sequence[float | None]  # held-out rms error, as ``left``
    hidden: Mapping[str, str]  # effect that is not observable to the reason
    unknown: list[dict[str, Any]]  # entries ``unexplained``
    over_noise: float | None  # residual of the base over the noise
    left_over_noise: float | None  # the same with what was selected
    noises: Sequence[tuple[float, float, float]]  # ratio of wander to white noise, its time in s, and log L
    white: float  # noise, unit of the sensor
    expected_wander: float | None
    advice: Callable[[str], str]  # verdict to what to record next where nothing was selected
    free: Callable[[], SensorCalibration] | None = None  # by a free fit of the same recordings
    full: Callable[[], SensorCalibration] | None = None  # with what was selected, where that is something
    other: SensorCalibration | None = None  # of the other sensor
    on_table: bool = True
    scatter: Mapping[str, float] = field(default_factory=dict)  # further entries of ``wander``
    more: Mapping[str, Any] = field(default_factory=dict)  # further entries of the document
    turns: Sequence[str] = ()  # recordings that some effects have parameters for

    def share(self, drop: float) -> float:
        """Return the share of the residual's excess over the noise that a drop of its squares is."""
        excess = max(self.excess, drop)
        return float(np.clip(drop / excess, 0.0, 1.0)) if excess > 0.0 else 0.0
