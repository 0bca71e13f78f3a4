"""Which approximation of a method leaves which error: in the terms of its stages and equations."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.model.effects.base import unit_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.records import Recording

COSINES = (
    "the stages orthogonality and misalignment multiply readings by cosines, which changes a scale factor a little and "
    "turns nothing (Sudsanguan 2019, eqs 3.15-3.37): the matrix stays diagonal"
)
MEANINGS = {
    (
        "accelerometer",
        "orthogonality",
        "non_orthogonality",
    ): f"the sensor's axes are not at right angles, and {COSINES}",
    ("accelerometer", "orthogonality", "rotation"): f"the sensor is turned against the table's axes, and {COSINES}",
    ("accelerometer", "orthogonality", "scale_factor"): (
        "the scale factors come from the extremes of each axis alone (eqs 3.40-3.43), with the cosines of the stages "
        "orthogonality and misalignment in them"
    ),
    ("accelerometer", "orthogonality", "bias"): (
        "the bias is the mean reading of an axis where it is level (eqs 3.38-3.39), which a table that is off level or "
        "another axis' reading shifts"
    ),
    ("accelerometer", "orthogonality", "two_sided"): (
        "the positive and the negative side get scale factors of their own (eqs 3.40-3.43)"
    ),
    ("accelerometer", "nonlinear_least_squares", "rotation"): (
        "nine parameters from the length of gravity say nothing of how the sensor is mounted: its x axis is taken for "
        "the body's"
    ),
    ("gyroscope", "orthogonality_and_misalignment", "bias"): (
        "the bias is the mean of the rests beside the turns (eqs 3.47-3.48), wherever it has wandered since"
    ),
    ("gyroscope", "cholesky_lu", "bias"): "the bias is the mean of the rests beside the turns",
}
PLAIN = {
    "bias": "the method's bias is not that of a free fit of the same recordings",
    "scale_factor": "the method's scale factors are not those of a free fit of the same recordings",
    "non_orthogonality": "the method leaves a part of the angles between the sensor's axes",
    "rotation": "the method leaves the sensor turned against the body",
    "two_sided": "the method fits a scale factor for each side, which these recordings do not ask for",
}
PRINTED = "; the equations are taken as printed (as_printed), errata included"
FORWARD = (
    "as printed, the forward matrix is applied as if it were the correction (Sudsanguan 2019, tables 5.25 and 5.26)"
)


def meaning(
    name: str, sensor: str, stages: Sequence[str], recordings: Sequence[Recording], *, printed: bool = False
) -> str:
    """Return what an error is, as the end of a sentence.

    Parameters
    ----------
    name : str
        Of a part in ``pipeline.diagnosis.method_errors``.
    sensor : str
    stages : sequence of str
        Of the method.
    recordings : sequence of Recording
        Filtered.
    printed : bool
        Whether the method takes the equations as printed.
    """
    if name == "filter_delay":
        delay = max(float(r.filter.get("delay_s", 0.0)) for r in recordings)
        used = next(r.filter["name"] for r in recordings if r.filter["name"] != "none")
        return (
            f"the filter {used} delays readings by {delay:.2g} s and smooths them, so that in a continuous turn the "
            "angle is late by rate times delay (Sudsanguan 2019, eqs 3.3-3.14)"
        )
    if printed and "cholesky_lu" in stages:
        return FORWARD
    text = next((MEANINGS[sensor, s, name] for s in stages if (sensor, s, name) in MEANINGS), PLAIN[name])
    return text + (PRINTED if printed else "")


def in_words(errors: Sequence[Mapping[str, Any]], sensor: str) -> list[str]:
    """Return a sentence for each error that a method leaves.

    Parameters
    ----------
    errors : sequence of mapping
        What ``pipeline.diagnosis.method_errors.method_errors`` returned.
    sensor : str
    """
    return [_sentence(error, sensor) for error in errors]


def _sentence(error: Mapping[str, Any], sensor: str) -> str:
    size = f"{error['size']:.2g} {error['unit']}" if error["unit"] != "1" else f"{100 * error['size']:.2g} %"
    told = f"{100 * error['share']:.0f} % of what the method leaves"
    magnitude = error.get("held_out_magnitude_share")
    if magnitude is not None:
        told += f", {100 * magnitude:.0f} % of its error of the magnitude on held-out motion"
    rms = f"{error['rms']:.2g} {unit_of(sensor)} rms"
    return f"Of the method, not of the sensor: {_plain(error['name'])} ({size}; {rms}; {told}): {error['meaning']}."


def _plain(name: str) -> str:
    return name.replace("non_", "non-").replace("_", " ")
