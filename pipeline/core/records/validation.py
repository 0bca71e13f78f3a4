"""The validation of a unit: the errors of both calibrations on held-out motion, and their JSON form."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np

from imu_logs.units import SENSORS
from pipeline.core.records.calibration import SCHEMA_VERSION
from pipeline.core.records.recording import Noise

if TYPE_CHECKING:
    from collections.abc import Mapping


@dataclass(frozen=True)
class StepErrors:
    """Errors of the magnitude after a step of a calibration, g or deg/s; None where no sample tests it."""

    name: str  # ``raw``, ``stage:<name>``, ``calibrated``, ``+ <effect>``
    mean_abs_error: float | None = None
    sum_abs_error: float | None = None
    max_error: float | None = None
    min_error: float | None = None
    rms_error: float | None = None
    change_percent: float | None = None  # of the mean, relative to that of raw readings
    vector_rms_error: float | None = None  # of the difference to the reference; None without an attitude


@dataclass(frozen=True)
class Agreement:
    """The matrix against that of held-out motion, and the element that differs most."""

    p_value: float
    reads: str  # axis of the sensor
    of: str  # axis of the truth
    error: float
    expanded_uncertainty: float


@dataclass(frozen=True)
class TemperatureBin:
    """Errors of the magnitude after the last step at one temperature, g or deg/s."""

    temperature_degc: float  # mean
    mean_error: float
    rms_error: float  # with the noise
    samples: int


@dataclass(frozen=True)
class OverTemperature:
    """Errors over a swept temperature."""

    samples_of: str  # which samples these are
    bins: tuple[TemperatureBin, ...]


@dataclass(frozen=True)
class LimitCheck:
    """A figure against its limit."""

    name: str
    limit: float
    value: float | None
    passes: bool


@dataclass(frozen=True)
class SensorValidation:
    """A sensor's part of ``validations/<unit>.json``."""

    unit: str  # of the errors
    held_out: bool  # False: the samples of the fit are used
    reason: str | None  # why no samples are held out
    samples: int
    noise: Noise
    steps: tuple[StepErrors, ...]
    noise_floor: float | None = None
    vector_noise_floor: float | None = None
    reference_rms: float | None = None  # of the reference's magnitude
    notes: tuple[str, ...] = ()
    expected_rms_error: tuple[float, float] | None = None  # None where an effect is left out
    worse_than_raw: str | None = None  # why the calibration must not be used
    agreement: Agreement | None = None
    over_temperature: OverTemperature | None = None  # only where the temperature was swept
    limits: tuple[LimitCheck, ...] = ()

    @property
    def passes(self) -> bool | None:
        """Whether all limits are kept; None: there is no limit."""
        return all(check.passes for check in self.limits) if self.limits else None

    def to_json(self) -> dict[str, Any]:
        """Return the part of the document."""
        over = self.over_temperature
        bins = over and {"samples_of": over.samples_of, "bins": [dict(vars(each)) for each in over.bins]}
        return {
            "unit": self.unit,
            "held_out": self.held_out,
            "reason": self.reason,
            "samples": self.samples,
            "noise": {
                "white": self.noise.white.tolist(),
                "wander": self.noise.wander.tolist(),
                "correlation_time_s": self.noise.correlation_time,
                "source": self.noise.source,
                "wander_source": self.noise.wander_source,
                "correlation_time_source": self.noise.time_source,
            },
            "noise_floor": self.noise_floor,
            "vector_noise_floor": self.vector_noise_floor,
            "reference_rms": self.reference_rms,
            "steps": [dict(vars(step)) for step in self.steps],
            "notes": list(self.notes),
            "expected_rms_error": self.expected_rms_error and list(self.expected_rms_error),
            "worse_than_raw": self.worse_than_raw,
            "agreement": self.agreement and dict(vars(self.agreement)),
            **({"over_temperature": bins} if bins else {}),
            "limits": [{"name": c.name, "limit": c.limit, "value": c.value, "pass": c.passes} for c in self.limits],
            "pass": self.passes,
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """Return the object from the value of ``to_json``."""
        noise, agreement, over = data["noise"], data["agreement"], data.get("over_temperature")
        return cls(
            noise=Noise(
                np.array(noise["white"], float),
                np.array(noise["wander"], float),
                noise["correlation_time_s"],
                noise["source"],
                noise["wander_source"],
                noise["correlation_time_source"],
            ),
            steps=tuple(StepErrors(**step) for step in data["steps"]),
            notes=tuple(data["notes"]),
            expected_rms_error=data["expected_rms_error"] and tuple(data["expected_rms_error"]),
            agreement=agreement and Agreement(**agreement),
            over_temperature=over
            and OverTemperature(over["samples_of"], tuple(TemperatureBin(**each) for each in over["bins"])),
            limits=tuple(LimitCheck(c["name"], c["limit"], c["value"], c["pass"]) for c in data["limits"]),
            **{key: data[key] for key in KEYS_AS_THEY_ARE},
        )


FEWEST_MOVES = 6  # held-out moves whose mean error counts: of fewer, one slip is a large share
KEYS_AS_THEY_ARE = (
    "unit", "held_out", "reason", "samples", "noise_floor", "vector_noise_floor", "reference_rms", "worse_than_raw",
)  # fmt: skip


class MovesError(NamedTuple):
    """Errors of gravity's direction after held-out moves by hand."""

    rms_deg: float
    largest_deg: float  # largest rms that noise, scatter and uncertainties explain
    over_noise: float = 1.0  # mean error over that of noise alone; 1 for fewer than ``FEWEST_MOVES``


@dataclass(frozen=True)
class Validation:
    """``validations/<unit>.json``."""

    unit: str
    sensors: Mapping[str, SensorValidation | None]  # None for a sensor without a calibration
    attitude: dict[str, Any]  # see ``pipeline.evaluation.held_out.attitude``
    gravity_direction: dict[str, Any]

    @property
    def moves_error(self) -> MovesError | None:
        """Errors after held-out moves by hand; None without them, or where the fit does not determine the matrix."""
        found = self.gravity_direction
        if "largest_expected_rms_deg" not in found:
            return None
        several, floor = found["moves"] >= FEWEST_MOVES, found["noise_floor_deg"]
        over = found["mean_deg"]["after"] / floor if several and floor > 0.0 else 1.0
        return MovesError(found["rms_deg"]["after"], found["largest_expected_rms_deg"], over)

    def to_json(self) -> dict[str, Any]:
        """Return the document."""
        return {
            "schema_version": SCHEMA_VERSION,
            "unit": self.unit,
            **{sensor: part and part.to_json() for sensor, part in self.sensors.items()},
            "attitude": self.attitude,
            "gravity_direction": self.gravity_direction,
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """Return the object from the value of ``to_json``."""
        parts = {sensor: data[sensor] and SensorValidation.from_json(data[sensor]) for sensor in SENSORS}
        return cls(data["unit"], parts, data["attitude"], data["gravity_direction"])
