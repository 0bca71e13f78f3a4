"""The best shape in one covariate, and how the field would say it: ``a step at 31.0 degC, of 3.9 mg on x``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.model.effects.base import unit_of

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from pipeline.diagnosis.leftover import Gain
    from pipeline.diagnosis.shapes import Shape

    Values = NDArray[np.float64]

UNITS = {"temperature": "degC", "time": "s", "speed": "deg/s", "angle": "deg"}


@dataclass(frozen=True)
class Guess:
    """The best shape in one covariate.

    Attributes
    ----------
    covariate : str
    shape : Shape
    gain : Gain
    coefficients : (3, r) array
        Zero on the axes that are left out.
    sizes : (3,) array
        Amplitude, height or whole change on each axis, unit of the sensor; signed where a sign has a meaning.
    """

    covariate: str
    shape: Shape
    gain: Gain
    coefficients: Values
    sizes: Values


def in_words(guess: Guess, sensor: str) -> str:
    """Return a guess in the words of the field: ``a step at 31.0 degC of 3.9 mg on x``."""
    shape, figures = guess.shape, guess.shape.figures
    unit = UNITS.get(shape.signal, "")
    signed = shape.kind in ("step", "band")
    sizes = _sizes(guess, sensor, signed=signed)
    if shape.kind in ("harmonic", "ripple"):
        cycles = " and ".join(str(n) for n in sorted(figures["cycles"]))
        rate = " in proportion to the rate" if shape.kind == "ripple" else ""
        return f"{cycles} cycle{'' if cycles == '1' else 's'} per turn of the table{rate}, amplitude {sizes}"
    if shape.kind == "band":
        return f"a band from {figures['low']:.3g} to {figures['high']:.3g} {unit} of {sizes}"
    if shape.kind == "step":
        soft = f", over about {2 * figures['width']:.2g} {unit}" if "width" in figures else ""
        return f"a step at {_place(figures['at'], guess, unit)}{soft}, of {sizes}"
    if shape.kind == "exponential":
        way = "grows" if figures["grows"] else "dies out"
        constant = f"{figures['constant']:.3g} {unit}"
        return f"an exponential of the {shape.signal} that {way} with a constant of {constant}, {sizes} in all"
    of = {"u": "the axis' own signal", "speed": "the speed"}.get(shape.signal, f"{shape.signal}")
    return f"a polynomial of order {figures['order']} in {of}, {sizes} over its span"


def _place(value: float, guess: Guess, unit: str) -> str:
    return f"{value:.1f} {unit}" if guess.shape.signal != "time" else f"{value:.0f} {unit}"


def _sizes(guess: Guess, sensor: str, *, signed: bool) -> str:
    """Return the size on each axis: ``3.9 mg on x and -2.1 mg on z``."""
    milli = sensor == "accelerometer" and float(np.abs(guess.sizes).max()) < 0.1
    unit = "mg" if milli else unit_of(sensor)
    values = guess.sizes * (1e3 if milli else 1.0)
    if guess.shape.kind == "ripple":
        unit, values = "%", 100.0 * guess.sizes
    told = [f"{values[c] if signed else abs(values[c]):.3g} {unit} on {'xyz'[c]}" for c in guess.gain.axes]
    return " and ".join(filter(None, [", ".join(told[:-1]), told[-1]]))


def effect_file(definition: Mapping[str, Any], unit: str) -> str:
    """Return the text of an effect file, ready to be copied into a campaign's ``effects/``.

    Parameters
    ----------
    definition : mapping
    unit : str
        The unit that showed it.
    """
    import yaml  # noqa: PLC0415  (only a unit with unknown physics pays for it)

    name, sensor = definition["name"], definition["sensors"][0]
    remarks = (
        f"# What unit {unit} shows beyond the catalogue of effects: a first guess, to be named, tried and confirmed.\n"
        f"# To try it, copy this file to effects/{name}.yaml in the campaign's directory and add {name} to\n"
        f"# effects.{sensor}. For another name, change the file's and the one below together.\n"
    )
    content = {key: list(value) if isinstance(value, tuple) else value for key, value in definition.items()}
    return remarks + str(yaml.safe_dump(content, sort_keys=False, allow_unicode=True, width=110))
