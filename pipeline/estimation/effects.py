"""Fit bias, matrix and effects together: the last stage of a fit, for both sensors."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.core.errors import NotObservableError
from pipeline.core.records import SensorCalibration
from pipeline.estimation.candidates import AUTO, MOUNTING, configured_effects, offered
from pipeline.estimation.generalized_least_squares import fit_joint
from pipeline.estimation.observations import observe
from pipeline.estimation.rest_means import is_multi_position
from pipeline.estimation.selection import select
from pipeline.estimation.stages import FitStage
from pipeline.physics.effects import bench_priors, effect, stated_priors

if TYPE_CHECKING:
    from pipeline.core.records import UnitRecordings
    from pipeline.core.settings import Settings
    from pipeline.estimation.stages import Change

ALL: tuple[Change, ...] = ("bias", "matrix", "effects")
FIT_STAGES = {"effects": FitStage(changes=ALL, accepts=("readings", *ALL), free=True, reference=True)}


def fit(
    sensor: str, recordings: UnitRecordings, previous: SensorCalibration | None, settings: Settings
) -> SensorCalibration:
    """Fit the effects of ``settings.effects`` together with bias and matrix, after every method.

    Returns ``previous`` unchanged if there are no effects to add.
    """
    before = previous or SensorCalibration(sensor)
    by_hand = is_multi_position(sensor, recordings.filtered)
    of_bench = not by_hand and stated_priors(settings.table)
    if not settings.effects.of(sensor) and not of_bench:
        return before
    noise = recordings.noises[sensor]
    if by_hand:
        from pipeline.estimation.multi_position.effects import fit_effects_by_rests  # noqa: PLC0415  (recordings by hand alone)

        return fit_effects_by_rests(before, recordings, settings)
    names = configured_effects(sensor, settings, recordings.filtered)
    accelerometer = mountings_by_gravity(recordings, settings) if sensor == "gyroscope" and MOUNTING in names else None
    if settings.effects.of(sensor) == AUTO:
        observations = observe(sensor, recordings.filtered, settings.table)
        if not observations.parts:
            return before
        data_sheet = settings.sensor.of(sensor)
        chosen = select(observations, names, noise, data_sheet, accelerometer=accelerometer)
        names += offered(chosen.names, chosen.fit.terms, chosen.fit.covariance, data_sheet, sensor)
    if not names:
        return before
    return fit_joint(sensor, recordings.filtered, names, noise, settings, before, accelerometer)


def mountings_by_gravity(recordings: UnitRecordings, settings: Settings) -> SensorCalibration | None:
    """Fit the accelerometer with the mountings of its turns; None if the recordings do not determine them.

    Effects that are missing in the list are selected and fitted, too: without them the mountings would be biased.
    Errors of the table's angle are fitted only if they are listed, because a wrongly selected one would bias the
    mountings.
    """
    listed = settings.effects.accelerometer
    within = (MOUNTING, *effect(MOUNTING).contains)
    wanted = [MOUNTING, *(name for name in ([] if listed == AUTO else listed) if name not in within)]
    both = settings.replaced(effects=settings.effects.replaced(accelerometer=wanted))
    names = configured_effects("accelerometer", both, recordings.filtered)
    observations = observe("accelerometer", recordings.filtered, settings.table)
    noise = recordings.noises["accelerometer"]
    try:
        selected = select(observations, names, noise, settings.sensor.accelerometer).names
        names += [name for name in selected if not of_the_angle(name)]
        return fit_joint("accelerometer", recordings.filtered, names, noise, settings)
    except NotObservableError:
        return None


def of_the_angle(name: str) -> bool:
    """Return whether an effect is an error of the table's angle or axes."""
    return effect(name).owner == "table" and name not in bench_priors()
