"""The last stage of a fit, for both sensors: base and effects together, the list configured or selected."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.estimation.generalized_least_squares import fit_joint
from pipeline.estimation.multi_position.rests import is_multi_position
from pipeline.estimation.noise import noise_of
from pipeline.estimation.observations import observe
from pipeline.estimation.selection import select
from pipeline.records import SensorCalibration

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.records import Recording

AUTO = "auto"


def fit(
    sensor: str, recordings: Sequence[Recording], previous: SensorCalibration | None, settings: Mapping[str, Any]
) -> SensorCalibration:
    """Fit the effects of ``settings["effects"][sensor]`` together with bias and matrix, whatever the method was.

    Parameters
    ----------
    sensor : str
    recordings : sequence of Recording
    previous : SensorCalibration or None
        The stage before.
    settings : mapping
        Sections ``effects``, ``sensor`` and ``table``; ``procedure`` for recordings by hand.

    Returns
    -------
    SensorCalibration
        ``previous`` unchanged where there is nothing to add.
    """
    wanted = settings["effects"][sensor]
    before = previous or SensorCalibration(sensor)
    if not wanted:
        return before
    noise = noise_of(sensor, recordings, settings)
    if is_multi_position(sensor, recordings):
        from pipeline.estimation.multi_position.result import fit_effects_by_rests  # noqa: PLC0415  (recordings by hand alone)

        return fit_effects_by_rests(before, recordings, noise, settings)
    names = list(wanted)
    if wanted == AUTO:
        observations = observe(sensor, recordings, settings["table"])
        if not observations.parts:
            return before
        names = select(observations, [], noise, settings["sensor"][sensor]).names
    if not names:
        return before
    return fit_joint(sensor, recordings, names, noise, settings, before)
