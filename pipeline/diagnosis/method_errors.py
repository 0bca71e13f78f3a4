"""Errors that a method's own approximations leave, compared with a free fit of the same recordings.

A method says ``truth = M (reading - b_m - z_m)``; bias b, matrix K and effects z of the free fit predict the reading.
In a motion u that the recording's filter turns into u_f, with E = M K - 1, the calibrated reading is off by

    M (b - b_m) [bias]  +  E u_f [diagonal: scale_factor; symmetric part off it: non_orthogonality, half of the angle by
    which two axes depart from 90 deg; antisymmetric: rotation]  +  M (z - z_m) [two_sided]  +  u_f - u [filter_delay]

each with the share ``mean(e_k^2) / sum_j mean(e_j^2)``, and of the error of the magnitude, ``|u_f + e_k| - |u_f|``, for
the filter ``|u_f| - |u(t - delay)|``. An error is named where it exceeds ``SURE`` standard uncertainties of both fits,
as if these were independent (which is never too small), and a fiftieth of either error. Where an effect is missing,
bias and sides are not compared: the effect shifts both in the method's fit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.diagnosis.words import template
from pipeline.estimation.generalized_least_squares import Fit, fit_terms
from pipeline.estimation.observations import filtered_motion
from pipeline.model.effects import effect_of
from pipeline.model.effects.base import truth, unit_of
from pipeline.model.kinematics import table_motion

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from pipeline.estimation.selection import Selection
    from pipeline.records import Motion, Recording, SensorCalibration, Values

    Errors = dict[str, tuple[Values, Values]]  # by cause: of the vector (n, 3), and of its magnitude (n,)

FREE = ("reference_least_squares", "effects")  # stages that leave bias and matrix free
LEAST_SHARE = 0.02  # of the mean square: a part that adds less than 1 % to the rms error is not named
SURE = 5.0  # standard uncertainties: 9 elements of 10^4 units exceed them by chance less than once in 10


def method_errors(
    calibration: SensorCalibration, selection: Selection, recordings: Sequence[Recording], settings: Mapping[str, Any]
) -> list[dict[str, Any]]:
    """Return what the method's approximations leave, the largest share first; nothing where its fit is free.

    ``selection``: the free fit, with what was selected. ``recordings``: all of the unit, filtered. ``settings``:
    sections ``table``, ``method`` and, for a given calibration, ``sensor``. Returns ``name, meaning, size, unit,
    share`` of each error on the method's own recordings; in addition ``rms`` (there, unit of the sensor),
    ``held_out_share`` and ``held_out_magnitude_share`` (on held-out motion, or None).
    """
    stages = [stage.name for stage in calibration.stages]
    if not stages or stages[-1] in FREE:
        return []
    difference = _difference_of(calibration, selection, settings)
    own = _together([_errors(difference, r, settings["table"]) for r in recordings if r.role == calibration.sensor])
    held_out = _together([_errors(difference, r, settings["table"]) for r in recordings if r.role == "validation"])
    rms = {name: _rms(vector) for name, (vector, _) in own.items()}
    held = _shares({name: _rms(vector) for name, (vector, _) in held_out.items()})
    magnitude = _shares({name: _rms(error[:, None]) for name, (_, error) in held_out.items()})
    printed = bool((settings.get("method") or {}).get("as_printed"))

    def meaning(name: str) -> str:
        return _meaning(name, calibration.sensor, stages, recordings, printed=printed)

    return _named(difference, rms, difference.certain(selection.names), recordings, meaning, held, magnitude)


def _named(  # noqa: PLR0917  (what the entries hold)
    difference: _Difference,
    rms: Mapping[str, float],
    sure: Mapping[str, bool],
    recordings: Sequence[Recording],
    meaning: Callable[[str], str],
    held: Mapping[str, float],
    magnitude: Mapping[str, float],
) -> list[dict[str, Any]]:
    """Return the errors that are worth naming, the largest share first."""
    found = [
        {
            "name": name,
            "meaning": meaning(name),
            **_size(name, difference, rms[name], recordings),
            "share": share,
            "rms": rms[name],
            "held_out_share": held.get(name),
            "held_out_magnitude_share": magnitude.get(name),
        }
        for name, share in _shares(rms).items()
        if max(share, magnitude.get(name, 0.0)) > LEAST_SHARE and sure.get(name, True)
    ]
    return sorted(found, key=lambda entry: -float(entry["share"]))


def given_differences(
    calibration: SensorCalibration,
    free_fit: Callable[[], SensorCalibration],
    recordings: Sequence[Recording],
    settings: Mapping[str, Any],
) -> list[dict[str, Any]]:
    """Return what a given calibration and a free fit of rests and moves by hand differ in, the largest share first.

    Bias and the symmetric part of E only: by hand, nothing ties the sensor's axes to a body. Shares are those of a
    truth of any direction, 1 g or the rms rate of the recordings. Nothing for a method that fits.
    """
    if [stage.name for stage in calibration.stages] != ["given"]:
        return []
    free, sensor = free_fit(), calibration.sensor
    known = _own_covariance(calibration, settings), free.covariance
    K = np.linalg.inv(free.matrix)
    M, maps = calibration.matrix, (np.kron(np.eye(3), K.T), np.kron(calibration.matrix @ K, K.T))
    variance = np.zeros(12)
    for covariance, of_matrix in zip(known, maps, strict=True):
        if covariance is not None:
            both = np.block([[M, np.zeros((3, 9))], [np.zeros((9, 3)), of_matrix]])
            variance += np.diag(both @ covariance[:12, :12] @ both.T)
    d, uncertainty = M @ (free.bias - calibration.bias), np.sqrt(np.clip(variance, 0.0, None))
    parts = _parts_of(M @ K - np.eye(3))
    del parts["rotation"]
    difference = _Difference(calibration, d, parts, uncertainty, None)
    rates = [np.sum(w**2, axis=1) for r in recordings if (w := r.reading("gyroscope")) is not None]
    size = 1.0 if sensor == "accelerometer" else float(np.sqrt(np.nanmean(np.concatenate(rates))))
    rms = {"bias": float(np.linalg.norm(d))}
    rms |= {name: size * float(np.linalg.norm(part)) / np.sqrt(3.0) for name, part in parts.items()}
    return _named(
        difference,
        rms,
        difference.certain([]),
        recordings,
        lambda name: _meaning(name, sensor, ["given"], recordings, printed=False),
        {},
        {},
    )


def _parts_of(E: Values) -> dict[str, Values]:
    """Return the parts of ``M K - 1``, by name."""
    diagonal = np.diag(np.diag(E))
    return {
        "scale_factor": diagonal,
        "non_orthogonality": 0.5 * (E + E.T) - diagonal,
        "rotation": 0.5 * (E - E.T),
    }


@dataclass(frozen=True)
class _Difference:
    """A method compared with the free fit."""

    method: SensorCalibration
    bias: Values  # (3,): M (b - b_m)
    matrices: dict[str, Values]  # the parts of E: (3, 3) each
    uncertainty: Values  # (12,), of bias and E
    free: Fit | None  # None by hand, where effects are not compared

    def parts(self, motion: Motion) -> dict[str, Values]:
        """Return the error of the calibrated reading by its cause, without the filter's: (n, 3) arrays."""
        u = truth(self.method.sensor, motion)
        of_matrix = {name: u @ matrix.T for name, matrix in self.matrices.items()}
        two_sided = self._of_effects(motion) @ self.method.matrix.T
        return {"bias": np.broadcast_to(self.bias, u.shape), **of_matrix, "two_sided": two_sided}

    def _of_effects(self, motion: Motion) -> Values:
        """Return what the method's effects add at the free fit's values, minus what they add at the method's."""
        added = np.zeros((len(motion.time), 3))
        assert self.free is not None  # noqa: S101  (on a table)
        fitted = {term.effect.name: term.values for term in self.free.terms}
        for effect in self.method.effects:
            this = effect_of(effect)
            if not this.moves and this.available(motion):
                added -= this.reading(self.method.sensor, motion, self.free.K, effect.values)
                if effect.name in fitted:
                    added += this.reading(self.method.sensor, motion, self.free.K, fitted[effect.name])
        return added

    def certain(self, selected: Sequence[str]) -> dict[str, bool]:
        """Return which parts exceed the noise of the two fits."""
        u = self.uncertainty[3:].reshape(3, 3)
        least = SURE * np.where(np.eye(3) > 0.0, u, np.hypot(u, u.T) / 2.0)
        whole = {effect.name for effect in self.method.effects}.issuperset(selected)
        of_bias = whole and bool(np.any(np.abs(self.bias) > SURE * self.uncertainty[:3]))
        of_matrix = {name: bool(np.any(np.abs(matrix) > least)) for name, matrix in self.matrices.items()}
        return {"two_sided": whole, "bias": of_bias, **of_matrix}


def _own_covariance(calibration: SensorCalibration, settings: Mapping[str, Any]) -> Values:
    """Return the covariance of bias and matrix: (12, 12).

    Where a given calibration states none, its bias has at least the wander that the sensor file states.
    """
    own = np.zeros((12, 12)) if calibration.covariance is None else calibration.covariance[:12, :12]
    if own.any() or [stage.name for stage in calibration.stages] != ["given"]:
        return own
    wander = float(settings["sensor"][calibration.sensor]["bias_wander"])
    return np.diag([wander**2] * 3 + [0.0] * 9)


def _difference_of(calibration: SensorCalibration, selection: Selection, settings: Mapping[str, Any]) -> _Difference:
    """Compare with the free fit of base, configured effects and those selected that the method has too."""
    free, names = selection.base, [effect.name for effect in calibration.effects]
    known = {term.effect.name for term in free.terms}
    more = [t for t in selection.fit.terms if t.effect.name in names and t.effect.name not in known]
    if more:
        free = fit_terms(selection.observations, [*free.terms, *more], free, selection.settings)
    M = calibration.matrix
    own = _own_covariance(calibration, settings)
    of_free, of_method = np.zeros((12, 12)), np.zeros((12, 12))
    of_free[:3, :3] = of_method[:3, :3] = M
    of_free[3:, 3:], of_method[3:, 3:] = np.kron(M, np.eye(3)), np.kron(np.eye(3), free.K.T)
    covariance = of_free @ free.covariance[:12, :12] @ of_free.T + of_method @ own @ of_method.T
    uncertainty = np.sqrt(np.clip(np.diag(covariance), 0.0, None))
    parts = _parts_of(M @ free.K - np.eye(3))
    return _Difference(calibration, M @ (free.bias - calibration.bias), parts, uncertainty, free)


def _errors(difference: _Difference, recording: Recording, table: Mapping[str, Any]) -> Errors:
    """Return the errors in one recording by their cause; none where no motion is known."""
    sensor = difference.method.sensor
    if recording.samples < 6 or recording.reading(sensor) is None:
        return {}
    before = table_motion(recording, table)
    if before is None:
        return {}
    filtered = recording.filter["name"] != "none"
    motion = filtered_motion(replace(before, at_offset=None, at_lag=None), recording) if filtered else before
    u = truth(sensor, motion)
    size = np.linalg.norm(u, axis=1)
    found: Errors = {name: (e, np.linalg.norm(u + e, axis=1) - size) for name, e in difference.parts(motion).items()}
    if filtered:
        plain = truth(sensor, before)
        late = recording.time - float(recording.filter.get("delay_s", 0.0))
        found["filter_delay"] = (u - plain, size - np.interp(late, recording.time, np.linalg.norm(plain, axis=1)))
    return found


def _together(found: Sequence[Errors]) -> Errors:
    """Return the errors of several recordings one after the other."""
    every = {name: [errors[name] for errors in found if name in errors] for errors in found for name in errors}
    return {
        name: (np.concatenate([e[0] for e in errors]), np.concatenate([e[1] for e in errors]))
        for name, errors in every.items()
    }


def _shares(rms: Mapping[str, float]) -> dict[str, float]:
    total = sum(size**2 for size in rms.values())
    return {name: size**2 / total for name, size in rms.items()} if total > 0.0 else {}


def _rms(values: Values) -> float:
    return float(np.sqrt(np.mean(np.sum(values**2, axis=1))))


def _size(name: str, difference: _Difference, rms: float, recordings: Sequence[Recording]) -> dict[str, Any]:
    """Return the size of an error in its usual unit."""
    sensor = difference.method.sensor
    if name == "bias":
        return {"size": float(np.abs(difference.bias).max()), "unit": unit_of(sensor)}
    if name in difference.matrices:
        size = float(np.abs(difference.matrices[name]).max())
        return (
            {"size": size, "unit": "1"} if name == "scale_factor" else {"size": float(np.degrees(size)), "unit": "deg"}
        )
    if name == "filter_delay":
        turns = [r for r in recordings if r.role == sensor]
        return {"size": max(_fastest(r) * float(r.filter.get("delay_s", 0.0)) for r in turns), "unit": "deg"}
    return {"size": rms, "unit": unit_of(sensor)}


def _fastest(recording: Recording) -> float:
    """Return the largest rate of a turn, deg/s."""
    rate = recording.logged_rate
    return 0.0 if rate is None else float(np.abs(rate).max())


def _meaning(name: str, sensor: str, stages: Sequence[str], recordings: Sequence[Recording], *, printed: bool) -> str:
    """Return what an error is, as the end of a sentence."""
    filters = [r.filter for r in recordings if r.filter["name"] != "none"] or [{"name": "none"}]
    delay = max(float(each.get("delay_s", 0.0)) for each in filters)
    told = template("method_errors.txt").module.meaning(name, sensor, stages, printed, filters[0]["name"], delay)  # type: ignore[attr-defined]
    return " ".join(told.split())
