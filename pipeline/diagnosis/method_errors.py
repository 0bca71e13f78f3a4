"""What a method's own approximations leave, beside a free fit of the same recordings: no fault of the sensor's.

A method says ``truth = M (reading - b_m - z_m)``; bias b, K and effects z of the free fit say what is read. In a motion
u that the recording's filter turns into u_f, the method's calibrated reading is off by

    e = M (b - b_m) + (M K - 1) u_f + M (z - z_m) + (u_f - u)

    bias                 M (b - b_m)
    scale_factor         diagonal of M K - 1
    non_orthogonality    symmetric part off the diagonal, half of the angle by which two axes are not at a right angle
    rotation             antisymmetric part: the mounting
    two_sided            M (z - z_m), of effects that the method fits of its own accord
    filter_delay         u_f - u: the reading is late, and smoothed

and each has the share ``mean(e_k^2) / sum_j mean(e_j^2)``. A turn or a delay does not change a magnitude; so the share
of the error of the magnitude, ``d_k = |u_f + e_k| - |u_f|`` and for the filter ``|u_f| - |u(t - delay)|``, is told
beside it. A part is named where it is more than noise leaves in the two fits, and more than a fiftieth of either. Where
an effect is missing, bias and sides are not compared: the effect shifts both in the method's fit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.diagnosis.method_difference import difference_of
from pipeline.diagnosis.method_words import meaning
from pipeline.estimation.observations import through_filter
from pipeline.model.effects.base import truth, unit_of
from pipeline.model.kinematics import earth_rate, reference_motion

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from pipeline.diagnosis.method_difference import Difference
    from pipeline.estimation.selection import Selection
    from pipeline.records import Recording, SensorCalibration

    Values = NDArray[np.float64]

FREE = ("reference_least_squares", "effects")  # stages that leave bias and matrix free
LEAST_SHARE = 0.02


@dataclass(frozen=True)
class Error:
    """An error of calibrated readings: (n, 3) and of the magnitude (n,), g or deg/s."""

    vector: Values
    magnitude: Values


def method_errors(
    calibration: SensorCalibration,
    selection: Selection,
    recordings: Sequence[Recording],
    settings: Mapping[str, Any],
) -> list[dict[str, Any]]:
    """Return what the method's approximations leave, the largest share first; nothing where its fit is free.

    Parameters
    ----------
    calibration : SensorCalibration
        As the method has fitted it.
    selection : Selection
        The free fit, with what was selected.
    recordings : sequence of Recording
        All of the unit, filtered.
    settings : mapping
        Sections ``table`` and, for the words, ``method``.

    Returns
    -------
    list of dict
        ``name, meaning, size, unit, share`` of the error on the method's own recordings; beside these ``rms`` (there,
        unit of the sensor) and ``held_out_share`` (of the vector error on held-out motion, or None).
    """
    stages = [stage.name for stage in calibration.stages]
    if not stages or stages[-1] in FREE:
        return []
    difference = difference_of(calibration, selection)
    own = _together([_errors(difference, r, settings["table"]) for r in recordings if r.role == calibration.sensor])
    held_out = _together([_errors(difference, r, settings["table"]) for r in recordings if r.role == "validation"])
    if not own:
        return []
    share, held = (_shares({name: e.vector for name, e in found.items()}) for found in (own, held_out))
    magnitude = _shares({name: e.magnitude[:, None] for name, e in held_out.items()})
    sure = difference.certain(selection.names)
    printed = bool((settings.get("method") or {}).get("as_printed"))
    found = [
        {
            "name": name,
            "meaning": meaning(name, calibration.sensor, stages, recordings, printed=printed),
            **_size(name, difference, own[name].vector, recordings),
            "share": share[name],
            "rms": _rms(own[name].vector),
            "held_out_share": held.get(name),
            "held_out_magnitude_share": magnitude.get(name),
        }
        for name in share
        if max(share[name], magnitude.get(name, 0.0)) > LEAST_SHARE and sure.get(name, True)
    ]
    return sorted(found, key=lambda entry: -float(entry["share"]))


def _errors(difference: Difference, recording: Recording, table: Mapping[str, Any]) -> dict[str, Error]:
    """Return the errors in one recording by their cause; none where no motion is known."""
    sensor = difference.method.sensor
    if recording.samples < 6 or recording.reading(sensor) is None:
        return {}
    latitude, azimuth = table.get("latitude_deg"), table.get("azimuth_deg")
    earth = None if latitude is None or azimuth is None else earth_rate(float(latitude), float(azimuth))
    before = reference_motion(recording, float(table.get("gravity_g") or 1.0), earth)
    if before is None:
        return {}
    filtered = recording.filter["name"] != "none"
    motion = through_filter(replace(before, at_offset=None, at_lag=None), recording) if filtered else before
    u = truth(sensor, motion)
    size = np.linalg.norm(u, axis=1)
    found = {name: Error(e, np.linalg.norm(u + e, axis=1) - size) for name, e in difference.parts(motion).items()}
    if filtered:
        plain = truth(sensor, before)
        late = recording.time - float(recording.filter.get("delay_s", 0.0))
        found["filter_delay"] = Error(u - plain, size - np.interp(late, recording.time, np.linalg.norm(plain, axis=1)))
    return found


def _together(found: Sequence[dict[str, Error]]) -> dict[str, Error]:
    names = dict.fromkeys(name for errors in found for name in errors)
    return {
        name: Error(
            np.concatenate([errors[name].vector for errors in found if name in errors]),
            np.concatenate([errors[name].magnitude for errors in found if name in errors]),
        )
        for name in names
    }


def _shares(parts: Mapping[str, Values]) -> dict[str, float]:
    squares = {name: float(np.mean(part**2)) for name, part in parts.items()}
    total = sum(squares.values())
    return {name: square / total for name, square in squares.items()} if total > 0.0 else {}


def _rms(values: Values) -> float:
    return float(np.sqrt(np.mean(np.sum(values**2, axis=1))))


def _size(name: str, difference: Difference, own: Values, recordings: Sequence[Recording]) -> dict[str, Any]:
    """Return the size of a part as the field says it."""
    E, sensor = difference.matrix, difference.method.sensor
    if name == "bias":
        return {"size": float(np.abs(difference.bias).max()), "unit": unit_of(sensor)}
    if name == "scale_factor":
        return {"size": float(np.abs(np.diag(E)).max()), "unit": "1"}
    if name in ("non_orthogonality", "rotation"):
        part = 0.5 * (E + E.T) - np.diag(np.diag(E)) if name == "non_orthogonality" else 0.5 * (E - E.T)
        return {"size": float(np.degrees(np.abs(part).max())), "unit": "deg"}
    if name == "filter_delay":
        turns = [r for r in recordings if r.role == sensor]
        return {"size": max(_fastest(r) * float(r.filter.get("delay_s", 0.0)) for r in turns), "unit": "deg"}
    return {"size": _rms(own), "unit": unit_of(sensor)}


def _fastest(recording: Recording) -> float:
    """Return the largest rate of a turn, deg/s."""
    if recording.table_rate is not None:
        return float(np.abs(recording.table_rate).max())
    return (
        0.0
        if recording.table_angle is None
        else float(np.abs(np.gradient(recording.table_angle, recording.time)).max())
    )
