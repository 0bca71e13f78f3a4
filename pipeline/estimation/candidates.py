"""List the effects that a fit can include, with the starts, the priors and the limits of their parameters."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise, product

import numpy as np

from pipeline.core.errors import NotObservableError
from pipeline.core.records import Motion, Recording, SensorCalibration, Values, standard_uncertainty
from pipeline.core.settings import DataSheet, Settings, Table
from pipeline.estimation.design import EffectColumns, NormalPrior, Terms, placed
from pipeline.estimation.gates import possible
from pipeline.estimation.observations import Observations
from pipeline.physics.effects import catalogue, effect, stated_priors
from pipeline.physics.effects.base import Effect, parameter_limits
from pipeline.physics.effects.equations import MAX_BEND_SHARE_OF_ROOM, Bend
from pipeline.physics.effects.mounting import SETUP_EFFECTS
from pipeline.physics.signal.filters import MIN_SWING_DEGC, heats_and_cools

NO_SWING = f"the temperature does not rise and fall by {MIN_SWING_DEGC:g} degC while it is recorded"
AUTO = "auto"  # instead of a list of effects: the effects that the diagnosis selects
MOUNTING, ZERO, TILT = "mounting", "encoder_zero", "table_tilt"
TILTS = ("d_x", "d_y")  # parameters of ``table_tilt``
FIXED_DEG = 1e-4  # standard deviation of a tilt that is fixed at 0: a hundredth of a good encoder's accuracy
FIXED_AT_ZERO = (
    "A tilt about the shaft has the same signal as a common zero of the turns: the recordings do not determine it "
    "together with mountings or zeros. table.levelling_deg does not state it, so that it is fixed at 0."
)
ONE_SHAFT = 0.999  # cosine between shafts that count as one: mountings of 2 deg turn the level frame by as much
SEAT_DEG = 5.0  # of mountings if the table's config states none: the default tolerance of ingest
SECOND_SHARE = 0.1  # of the likelier one's prior probability, by assumption
SECOND = {"accelerometer": (), "gyroscope": ("table_encoder_error",)}  # exact look-alikes of a likelier effect


def parameter_names(sensor: str, effects: Sequence[Effect]) -> list[str]:
    """Return ``<effect>.<parameter>`` for each parameter."""
    return [f"{e.name}.{p.name}" for e in effects for p in e.parameters(sensor)]


def configured_effects(sensor: str, settings: Settings, recordings: Sequence[Recording]) -> list[str]:
    """Return the effects in the model: effects of the bench, and listed effects."""
    wanted = settings.effects.of(sensor)
    listed = [] if wanted == AUTO else list(wanted)
    return [*(name for name in bench_effects(sensor, settings.table, recordings) if name not in listed), *listed]


def bench_effects(sensor: str, table: Table, recordings: Sequence[Recording]) -> list[str]:
    """Return the effects of the bench: errors that the table's config states, and estimated zeros of the angle."""
    stated = stated_priors(table) if table.motion != "none" else {}
    one_clock = all(recording.clock_shared for recording in recordings)
    names = [name for name in stated if one_clock or not effect(name).needs_clock]
    found = any(note.code == "N-FOUND" for recording in recordings for note in recording.notes)
    return [*names, ZERO] if found and sensor == "accelerometer" and MOUNTING not in names else names


def starts_of(
    names: Sequence[str],
    observed: Observations | str,
    known: SensorCalibration | None = None,
    accelerometer: SensorCalibration | None = None,
) -> list[list[EffectColumns]]:
    """Return the terms from which a fit starts, every combination of the effects' starts.

    ``observed``: for recordings by hand only the sensor. ``known``: a calibration, at whose effects a fit starts.
    ``accelerometer``, for the gyroscope: its mountings. Raises ``ConfigurationError`` if an effect is unknown; the
    configuration names each once, none of the other sensor alone, and none beside one that contains it.
    """
    sensor = observed if isinstance(observed, str) else observed.sensor
    recordings = {} if isinstance(observed, str) else turns_of(observed)
    fitted = {} if known is None else {e.name: e.values for e in known.effects}
    choices: list[list[EffectColumns]] = []
    for name in names:
        this = effect(name).of_recordings(recordings)
        prior = None if isinstance(observed, str) else prior_of(this, observed, accelerometer, names)
        starts = this.starts(sensor) if prior is None or this.nonlinear else [prior.mean]
        if name in fitted and len(fitted[name]) == len(this.parameters(sensor)):
            starts = [fitted[name]]
        choices.append([EffectColumns(this, values, prior=prior) for values in starts])
    return [list(terms) for terms in product(*choices)]


def turns_of(observations: Observations) -> dict[str, str]:
    """Return the setup of each recording of turns, by its name."""
    return {part.name: part.motion.setup for part in observations.parts if part.motion.axis is not None}


def prior_of(
    this: Effect, observed: Observations, accelerometer: SensorCalibration | None, fitted: Sequence[str] = ()
) -> NormalPrior | None:
    """Return the prior of an effect of the bench; None for other effects.

    Each parameter has the prior ``N(0, s^2)``, s by the table's config. If the accelerometer was fitted with mountings,
    its estimate is the prior of the gyroscope's: both sensors share the frame of the mean of the mountings. For a tilt
    of the table see ``tilt_like_zeros``.

    ``accelerometer``: for the gyroscope. ``fitted``: the effects of the fit.
    """
    if this.name == TILT:
        along = tilt_like_zeros([part.motion for part in observed.parts], fitted)
        width = observed.levelling_deg or FIXED_DEG
        return None if along is None else NormalPrior(np.zeros(2), np.outer(along, along) / width**2)
    if this.name != MOUNTING:
        stated = observed.bench.get(this.name)
        return None if stated is None else NormalPrior(np.zeros(1), np.full((1, 1), stated**-2))
    assert this.definition is not None  # noqa: S101
    own, seat_deg = this.definition["recordings"], observed.bench.get(MOUNTING, SEAT_DEG)
    mean, covariance = np.zeros(3 * len(own)), seat_deg**2 * np.eye(3 * len(own))
    found = None if accelerometer is None else next((e for e in accelerometer.effects if e.name == MOUNTING), None)
    if accelerometer is not None and accelerometer.covariance is not None and found and found.definition:
        others = found.definition["recordings"]
        shared = [(k, others.index(name)) for k, name in enumerate(own) if name in others]
        if shared:
            here, there = (np.add.outer(np.multiply(3, k), np.arange(3)).ravel() for k in zip(*shared, strict=True))
            mean[here] = found.values[there]
            mountings = accelerometer.parameters.select(accelerometer.parameters.of_effect(MOUNTING))
            covariance[np.ix_(here, here)] = mountings.covariance[np.ix_(there, there)]
            covariance += np.kron(np.full((len(own),) * 2, np.diag(covariance)[here].mean()), np.eye(3))
    return NormalPrior(mean, np.asarray(np.linalg.inv(covariance), np.float64))


def tilt_like_zeros(motions: Sequence[Motion], fitted: Sequence[str]) -> Values | None:
    """Return the direction of (d_x, d_y) in which a tilt is equivalent to a rotation of the unit in every turn.

    It is the direction of the shaft, if one level shaft makes all turns and each has a separate mounting or zero. The
    readings do not determine this component of the tilt: its prior is the table's levelling, or it is fixed at 0. None
    if the readings determine both components.
    """
    owner = next((effect(name) for name in (MOUNTING, ZERO) if name in fitted), None)
    if owner is None or any(m.axis is None or m.level is None for m in motions):
        return None
    turns = {(m.setup or m.recording if owner.name == MOUNTING else m.recording, m.axis) for m in motions}
    shafts = np.array([m.level[0, :2, m.axis] for m in motions if m.level is not None])
    if len(dict(turns)) < len(turns) or np.min(np.abs(shafts @ shafts[0])) < ONE_SHAFT:
        return None
    return np.asarray(shafts[0] / np.linalg.norm(shafts[0]), np.float64)


def is_fixed(name: str, value: float, unit: str | None, standard_uncertainty: float | None) -> bool:
    """Return whether a parameter is a tilt that was fixed at 0."""
    is_tilt = name.rpartition(".")[2] in TILTS and unit == "deg"
    return is_tilt and (standard_uncertainty or 0.0) < 10.0 * FIXED_DEG and abs(value) < 0.01 * FIXED_DEG


def limits_of(sensor: str, data_sheet: DataSheet) -> dict[str, Values]:
    """Return the limits of plausibility of every effect's parameters, absolute values; infinite if none is stated.

    ``data_sheet``: ``effects`` of the sensor file: ``<effect>`` for all its parameters, ``<effect>_<parameter>`` for
    one or, without the axis, for some of them.
    """
    return dict(_limits_of(sensor, tuple(data_sheet.effects.items()), tuple(catalogue().items())))


@lru_cache(maxsize=16)
def _limits_of(
    sensor: str, stated: tuple[tuple[str, float], ...], effects: tuple[tuple[str, Effect], ...]
) -> dict[str, Values]:
    of_sensor = {name: parameter_limits(this, sensor, dict(stated)) for name, this in effects if sensor in this.sensors}
    return {name: values for name, values in of_sensor.items() if len(values)}


def estimates(terms: Terms, covariance: Values) -> dict[str, tuple[Values, Values]]:
    """Return values and standard uncertainties by the effect's name; their parameters are the last of a covariance."""
    base, u = len(covariance) - sum(len(term.values) for term in terms), standard_uncertainty(covariance)
    return {name: (term.values, u[at]) for name, (term, at) in placed(terms, base).items()}


def offered(names: Sequence[str], terms: Terms, covariance: Values, data_sheet: DataSheet, sensor: str) -> list[str]:
    """Return the selected effects for ``auto``, none if one is not possible; ``terms``: the last of ``covariance``."""
    limits, found = limits_of(sensor, data_sheet), estimates(terms, covariance)
    every = all(possible(*found[name], limits[name]) for name in names if name in limits)
    return list(names) if every or data_sheet.accept_implausible else []


def candidates_for(observations: Observations, configured: Sequence[str]) -> list[Effect]:
    """Return the effects that could be missing in the model and that the recordings can show."""
    sensor, motions = observations.sensor, [part.motion for part in observations.parts]
    turns, without_temperature = turns_of(observations), any(motion.temperature is None for motion in motions)
    candidates, swings = [], heats_and_cools(motion.temperature for motion in motions)
    for name, listed in catalogue().items():
        this = listed.of_recordings(turns)
        impossible = (
            name in configured
            or sensor not in this.sensors
            or sensor in this.unseen
            or this.shown_by
            or (this.of_turns and not observations.mounting_in_doubt)
            or (name == "earth_rotation" and observations.earth)
            or (this.needs_clock and not observations.clock_shared)
            or ("temperature" in this.needs and without_temperature)
            or (this.needs_swing and not swings)
        )
        if not impossible and any(this.available(motion) for motion in motions):
            candidates.append(this)
    second = SECOND[sensor]
    return sorted(candidates, key=lambda e: (e.name in second, e.name))


def require_available(observations: Observations, names: Sequence[str]) -> None:
    """Raise ``NotObservableError``, with advice, for an effect that needs signals which the recordings lack."""
    parts = observations.parts
    setups = {part.motion.setup for part in parts}
    for own in SETUP_EFFECTS:
        if setups <= {name.partition("@")[2] for name in names if name.startswith(f"{own}@")}:
            base = "matrix" if own == "mounting" else "bias"
            problem = f"a separate {own} in every setup ({', '.join(sorted(setups))}) has the same signal as the {base}"
            raise NotObservableError(f"{problem}: leave it out for one of them, the reference of the others")
    for name in names:
        this = effect(name)
        lacking = [need for need in this.needs if all(getattr(part.motion, need) is None for part in parts)]
        without = [part.name for part in parts for need in this.needs if getattr(part.motion, need) is None]
        if lacking or ("temperature" in this.needs and without):
            raise NotObservableError(
                f"{name} needs {', '.join(lacking or ['temperature'])}, which "
                f"{'no recording holds' if lacking else 'is missing in ' + ', '.join(without)}; "
                f"record it, or take {name} out of effects.{observations.sensor}"
            )
        if this.needs_clock and not observations.clock_shared:
            raise NotObservableError(
                f"{name} needs the time between the recordings, but their times overlap (each starts at 0?): "
                f"record them on one clock, or take {name} out of effects.{observations.sensor}"
            )


def time_constants(
    this: Effect, sensor: str, fitted: EffectColumns | None = None, width: float | None = None, *, between: bool = True
) -> list[tuple[EffectColumns, float]]:
    """Return an effect at several time constants or widths, with log weights of their prior; the fitted one first.

    ``between``: whether to add the geometric mean of each two successive starts of the effect. ``width``: standard
    uncertainty of the fitted value's logarithm; None: that of the steps between the others.
    """
    starts = this.starts(sensor)
    if isinstance(this, Bend):
        log_share = float(np.log(MAX_BEND_SHARE_OF_ROOM / len(this.forms)))
        return [(EffectColumns(Bend(this.forms, k), starts[0]), log_share) for k in range(len(this.forms))]
    if not this.nonlinear or this.moves:
        return [(fitted or EffectColumns(this, np.zeros(len(starts[0]))), 0.0)]
    if between:
        middle = [np.sqrt(one * other) for one, other in pairwise(starts)]
        starts = sorted([*starts, *middle], key=lambda values: float(values[-1]))
    share = 1.0 / len(starts)
    terms = [(EffectColumns(this, values), float(np.log(share))) for values in starts]
    if fitted is None:
        return terms
    if width is not None:
        share = min(share, float(np.sqrt(2.0 * np.pi) * width / np.log(starts[-1][-1] / starts[0][-1])))
    return [(fitted, float(np.log(share))), *terms]
