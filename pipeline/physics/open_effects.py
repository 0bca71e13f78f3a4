"""State the effects of the sensor file that the recordings leave open, with their largest change of bias and matrix.

The expanded uncertainty U is valid if these effects are absent. With each as a rectangular distribution within +-a, a
its largest change of a parameter (JCGM 100:2008, 4.3.7):

    U_open = k sqrt((U / k)^2 + sum a^2 / 3)

Earth's rotation and the sensor's clock are such effects where the budget does not include them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.core.errors import shortened
from pipeline.core.records import BASE, BASE_NAMES, base_values, matrix_of
from pipeline.core.verdicts import WITH_THEM
from pipeline.physics.effects import effect

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from pipeline.core.records import SensorCalibration, Values

DIFFERENT = 1.1  # ratio of both uncertainties above which pages, terminal and certificate state both
NAMED_EFFECTS = 4  # in a sentence
NEGLIGIBLE = 1e-3  # of U of every parameter: a change below it is not listed
OF_BUDGET = {"time base": "clock_rate", "Earth's rotation": "earth_rotation"}  # source that is not included: its effect
NOT_DIAGNOSED = "the diagnosis failed, so that it is not known what the recordings show"


def with_open(
    sensor: str, calibration: SensorCalibration, hidden: Mapping[str, Mapping[str, str] | None]
) -> dict[str, Any]:
    """Return ``open`` and ``uncertainty_with_open`` of a sensor's part of ``calibrations/<unit>.json``.

    ``hidden``: of each sensor, the effects that are not observable with their reasons; None where the diagnosis failed.
    """
    parameters = calibration.parameters
    U, k = (values[BASE] for values in (parameters.expanded_uncertainty, parameters.coverage_factor))
    found = list(_open(sensor, calibration, hidden, U))
    u_open = np.sqrt((U / k) ** 2 + sum((a**2 / 3.0 for _, a, _ in found), np.zeros(len(U))))
    return {
        "open": [{"effect": name, "up_to": _shaped(a), "reason": reason} for name, a, reason in found],
        "uncertainty_with_open": _shaped(k * u_open),
    }


def _open(
    sensor: str, calibration: SensorCalibration, hidden: Mapping[str, Mapping[str, str] | None], U: Values
) -> Iterator[tuple[str, Values, str]]:
    """Yield name, largest change of bias and matrix, (12,), and reason of each open effect.

    A change by a contained effect that the recordings show is not open.
    """
    reasons: dict[str, str] = {}
    for name in calibration.at_limits:
        owner, _, plain = name.rpartition(".")
        of_sensor = hidden.get(owner or sensor)
        reason = NOT_DIAGNOSED if of_sensor is None else of_sensor.get(plain)
        if reason:
            reasons[name] = reason
    fitted = {e.name for e in calibration.effects}
    contained = {f"{name.rpartition('.')[0]}.{other}".lstrip(".") for name in reasons
                 for other in effect(name.rpartition(".")[2]).contains}  # fmt: skip
    for name, reason in reasons.items():
        owner, _, plain = name.rpartition(".")
        within = [f"{owner}.{other}".lstrip(".") for other in effect(plain).contains]
        seen = [
            _largest(calibration, other) for other in within if other in calibration.at_limits and other not in reasons
        ]
        a = np.clip(_largest(calibration, name) - np.max([*seen, np.zeros(len(U))], axis=0), 0.0, None)
        if name not in contained | fitted and np.any(a > NEGLIGIBLE * U):
            yield name, a, reason
    for entry in calibration.budget.not_included if calibration.budget else ():
        if entry.up_to and entry.source in OF_BUDGET:
            bias = np.full(3, entry.up_to.get("bias", 0.0))
            yield (
                OF_BUDGET[entry.source],
                base_values(bias, entry.up_to.get("matrix", 0.0) * np.abs(calibration.matrix)),
                entry.reason,
            )


def _largest(calibration: SensorCalibration, name: str) -> Values:
    """Return the largest change of bias and matrix by an effect, (12,)."""
    return np.asarray(np.abs(calibration.at_limits[name]).sum(axis=1))


def _shaped(values: Values) -> dict[str, Any]:
    return {"bias": values[:3].tolist(), "matrix": matrix_of(values).tolist()}


def both_figures(part: Mapping[str, Any] | None) -> dict[str, tuple[float, float]]:
    """Return U without and with the open effects, of each parameter of bias and matrix where they differ by over 10 %.

    ``part``: a sensor's part of ``calibrations/<unit>.json``; empty without ``uncertainty_with_open``.
    """
    wide = (part or {}).get("uncertainty_with_open")
    if part is None or not wide:
        return {}
    pairs = zip(BASE_NAMES, *(map(float, _flat(each)) for each in (part["expanded_uncertainty"], wide)), strict=True)
    return {name: (U, open_) for name, U, open_ in pairs if open_ > DIFFERENT * U}


def _flat(values: Mapping[str, Any]) -> Values:
    return base_values(np.array(values["bias"], float), np.array(values["matrix"], float))


def open_words(part: Mapping[str, Any] | None) -> list[tuple[str, str]]:
    """Return the open effects of a sensor with both uncertainties, and what they mean; empty without a difference."""
    both = both_figures(part)
    if part is None or not both:
        return []
    figures: list[str] = []
    for kind, unit in (("bias", f" {part['unit']}"), ("matrix", "")):
        U, wide = np.max([pair for name, pair in both.items() if name.startswith(kind)] or [(0.0, 0.0)], axis=0)
        figures += [f"{kind} is up to {wide:.2g}{unit} in place of {U:.2g}"] if wide else []
    names = [entry["effect"].replace("_", " ").replace(".", ": ") for entry in part["open"]]
    source = f"{', '.join(shortened(names, NAMED_EFFECTS))}{WITH_THEM}{', of the '.join(figures)})"
    return [(source, "these recordings leave them open, and U is valid if they are absent")]
