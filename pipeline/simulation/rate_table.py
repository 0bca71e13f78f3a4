"""Simulate the errors of a rate table against its commanded program (``pipeline.io.commanded_motion.Program``).

A turn is commanded to the angle ``phi(t)`` and reaches

    theta = D_k + (phi - C_k) (D_k+1 - D_k) / (C_k+1 - C_k) + h(phi) + v(t)
    h(phi) = A cos phi + B sin phi + (180/pi) (a sin phi + b (1 - cos phi))

about the axis ``u = (e + d) / |e + d|``, where

C_k, D_k : commanded and true angle of stop k, deg: step quantisation, angle errors, lost steps (rate errors), backlash
A, B     : encoder error (eccentricity), deg
a, b     : rate ripple once a revolution: ``dtheta/dt = (1 + a cos phi + b sin phi) dphi/dt``, relative
v(t)     : vibration while the table moves, ``V sin(2 pi f t)``, deg; it also accelerates the plate, in g
d        : error of the axis direction, rad, across the nominal axis e

The true rate and acceleration are the derivatives of theta(t), by the chain rule. The Mark 2 table (Sudsanguan 2019,
sections 3.3 and 5.2.3) has all of them: acrylic parts, stepper motors, friction and an unbalanced load.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pipeline.io.commanded_motion import Program
    from pipeline.records import Index, Values

    Step = dict[str, float]


def rest(seconds: float) -> Step:
    """Return a rest as a step of a program."""
    return {"rest_s": seconds}


def turn(angle: float, rate: float, acceleration: float) -> Step:
    """Return a turn as a step of a program: angle in deg, signed; largest rate in deg/s; ramps in deg/s^2."""
    return {"turn_deg": angle, "rate_dps": rate, "acceleration_dps2": acceleration}


def turn_with_plateau(angle: float, rate: float, acceleration: float) -> Step:
    """Return a turn that covers ``angle`` at full ``rate``, plus the ramps before and after."""
    return turn(angle + float(np.sign(angle)) * rate**2 / acceleration, rate, acceleration)


@dataclass(frozen=True)
class TurnErrors:
    """Errors of turns about one axis; none by default."""

    encoder: Values = field(default_factory=lambda: np.zeros(2))  # A and B above, deg
    ripple: Values = field(default_factory=lambda: np.zeros(2))  # a and b above, relative
    stops: Values | None = None  # (moves + 1,), deg: angle error D_k - C_k of each stop of the program
    backlash: float = 0.0  # lag of the angle in the direction of the last move, deg
    direction: Values = field(default_factory=lambda: np.zeros(2))  # d along the next two axes, cyclically, rad
    vibration: float = 0.0  # amplitude V, deg
    shaking: float = 0.0  # g, of the vibration along each body axis, 120 deg apart in phase
    vibration_frequency: float = 0.0  # Hz

    def turn_axis(self, axis: int) -> Values:
        """Return the true turn axis: (3,) unit vector, body frame."""
        u = np.zeros(3)
        u[[axis, (axis + 1) % 3, (axis + 2) % 3]] = 1.0, *self.direction
        unit: Values = u / np.linalg.norm(u)
        return unit

    def force(self, program: Program, time: Values) -> Values | None:
        """Return the specific force of the plate's vibration: (n, 3) array, g, or None without vibration."""
        if not self.shaking:
            return None
        phase = 2.0 * np.pi * (self.vibration_frequency * time[:, None] + np.arange(3) / 3.0)
        moving = program.at(time)[1] != 0.0
        shaken: Values = self.shaking * moving[:, None] * np.sin(phase)
        return shaken

    def motion(self, program: Program, time: Values) -> tuple[Values, Values, Values]:
        """Return the true angle (deg), rate (deg/s) and acceleration (deg/s^2): (n,) arrays."""
        phi, rate, acceleration, move = program.at(time)
        base, slope = self._stops(program, phi, move)
        theta, first, second = self._harmonics(phi)
        theta, first = theta + base, first + slope
        angle, true_rate, true_acceleration = theta, first * rate, first * acceleration + second * rate**2
        if self.vibration:
            w = 2.0 * np.pi * self.vibration_frequency
            swing = np.where(rate != 0.0, self.vibration, 0.0)
            angle = angle + swing * np.sin(w * time)
            true_rate = true_rate + swing * w * np.cos(w * time)
            true_acceleration = true_acceleration - swing * w**2 * np.sin(w * time)
        return angle, true_rate, true_acceleration

    def _stops(self, program: Program, phi: Values, move: Index) -> tuple[Values, Values]:
        """Return the angle interpolated between the true stops, and its derivative by the commanded angle."""
        if (self.stops is None and not self.backlash) or len(program.stops) < 2:
            return phi, np.ones_like(phi)
        error = np.zeros_like(program.stops) if self.stops is None else self.stops
        commanded = np.diff(program.stops)
        k = np.clip(move, 0, None)
        slope = 1.0 + np.diff(error)[k] / commanded[k]
        lag = np.where(move >= 0, -self.backlash * np.sign(commanded[k]), 0.0)
        return program.stops[k] + error[k] + (phi - program.stops[k]) * slope + lag, slope

    def _harmonics(self, phi: Values) -> tuple[Values, Values, Values]:
        """Return h (deg) and its first (deg/deg) and second (1/deg) derivative."""
        sine, cosine = np.sin(np.radians(phi)), np.cos(np.radians(phi))
        (A, B), (a, b) = self.encoder, self.ripple
        value = A * cosine + B * sine + np.degrees(a * sine + b * (1.0 - cosine))
        first = np.radians(B * cosine - A * sine) + a * cosine + b * sine
        second = np.radians(np.radians(-A * cosine - B * sine) + b * cosine - a * sine)
        return value, first, second


def random_errors(program: Program, rng: np.random.Generator, settings: Mapping[str, Any], axis: int) -> TurnErrors:
    """Draw the errors of one recording about an axis of a table.

    ``settings``, each 0 by default: ``angle_accuracy_deg`` (standard deviation of each stop), ``rate_error`` (3,)
    (relative error of every move), ``step_deg`` (of the motor), ``ripple`` (relative amplitude), ``direction_deg``
    (3, 2), ``vibration_deg``, ``shaking_g``, ``vibration_hz``.
    """
    phase = rng.uniform(0.0, 2.0 * np.pi)
    travelled = np.cumsum(np.diff(program.stops) * settings.get("rate_error", np.zeros(3))[axis])
    scatter = settings.get("angle_accuracy_deg", 0.0) * rng.standard_normal(len(program.stops))
    stops = np.concatenate([[0.0], travelled]) + scatter
    step = settings.get("step_deg", 0.0)
    if step > 0.0:
        stops = np.round((program.stops + stops) / step) * step - program.stops
    return TurnErrors(
        ripple=settings.get("ripple", 0.0) * np.array([np.cos(phase), np.sin(phase)]),
        stops=stops,
        direction=np.radians(np.asarray(settings.get("direction_deg", np.zeros((3, 2))), float)[axis]),
        vibration=settings.get("vibration_deg", 0.0),
        shaking=settings.get("shaking_g", 0.0),
        vibration_frequency=settings.get("vibration_hz", 0.0),
    )
