"""A procedure run in memory by a sensor and a table without faults: what the diagnosis would then have in its hands.

The noise is that of the sensor's data sheet,

    white^2 = noise_density^2 / (2 dt) + (1 / counts_per_unit)^2 / 12

where

dt              : sampling interval, s
noise_density   : of white noise, one-sided, unit/sqrt(Hz)
counts_per_unit : steps of the converter in a g or deg/s; the second part is the quantisation

and a bias wander of ``bias_wander`` with the correlation time ``wander_time_s``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.records import Noise, Recording
from pipeline.simulation.campaign import simulate_unit
from pipeline.simulation.description import read_config

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.simulation.description import UnitDescription
    from pipeline.simulation.planned import Planned

SEED = 0
# The middle of what is drawn at random for a simulated unit: it warms up by some degrees in a room that changes little.
ROOM: dict[str, Any] = {
    "ambient": 25.0, "warm_up": 4.5, "warm_up_time": 300.0, "drift": 0.3,
    "periods": np.array([3000.0, 5000.0]), "phases": np.zeros(2),
}  # fmt: skip
FAULTLESS: dict[str, Any] = {"angle_accuracy_deg": 0.0, "rate_error": [0.0] * 3, "direction_deg": np.zeros((3, 2))}


@dataclass(frozen=True)
class Rehearsal:
    """What a procedure would record.

    Attributes
    ----------
    recordings : list of Recording
    sheets, table, procedure : mapping
        Configurations of sensor, table and procedure.
    noise : dict of str to Noise
        Sensor to what its data sheet says.
    minutes : float
        From power-on to the end of the last recording.
    """

    recordings: list[Recording]
    sheets: Mapping[str, Any]
    table: Mapping[str, Any]
    procedure: Mapping[str, Any]
    noise: dict[str, Noise]
    minutes: float


def rehearse(unit: UnitDescription, extra: Sequence[Planned] = ()) -> Rehearsal:
    """Run a procedure in memory.

    Parameters
    ----------
    unit : UnitDescription
        Its effects and its table's imperfections are left out.
    extra : sequence of Planned
        Further recordings after those of the procedure.

    Raises
    ------
    ConfigurationError
        If sensor, table or procedure are not known, or the course cannot be run.
    """
    faultless = replace(
        unit, effects={}, imperfections=FAULTLESS, held_out={}, temperature={**ROOM, **unit.temperature}
    )
    recordings, _ = simulate_unit(faultless, SEED, 0, extra)
    sheets, table = read_config("sensor", unit.sensor), read_config("table", unit.table)
    long_rest = any(recording.role == "static" for recording in recordings)
    noise = {s: noise_of_sheet(sheets[s], unit.interval_s, long_rest=long_rest) for s in ("accelerometer", "gyroscope")}
    minutes = max(float(r.time[-1]) for r in recordings) / 60.0
    return Rehearsal(recordings, sheets, table, read_config("procedure", unit.procedure), noise, minutes)


def noise_of_sheet(sheet: Mapping[str, Any], interval: float, *, long_rest: bool) -> Noise:
    """Return the noise of a sensor by its data sheet.

    Parameters
    ----------
    sheet : mapping
        The sensor's section of the configuration.
    interval : float, s
    long_rest : bool
        Whether a long rest will tell the noise.
    """
    variance = sheet["noise_density"] ** 2 * 0.5 / interval + 1.0 / (12.0 * sheet["counts_per_unit"] ** 2)
    wander = float(sheet.get("bias_wander") or 0.0)
    source = "static" if long_rest else "rests"
    return Noise(np.full(3, np.sqrt(variance)), np.full(3, wander), float(sheet.get("wander_time_s") or 100.0), source)


def limits_broken(rehearsal: Rehearsal) -> list[str]:
    """Return what the procedure asks of sensor and table that they cannot do, as sentences."""
    full = float(rehearsal.sheets["gyroscope"]["full_scale"])
    rates = [float(np.abs(r.table_rate).max()) for r in rehearsal.recordings if r.table_rate is not None]
    fastest, found = max(rates, default=0.0), []
    if fastest > full:
        found.append(f"the fastest turn, {fastest:g} deg/s, is beyond the gyroscope's full scale of {full:g} deg/s")
    if rehearsal.table["motion"] == "commanded":
        angle = float(rehearsal.table["angle_accuracy_deg"])
        found.append(
            f"the table logs its program, not what it did: angle errors of {angle:g} deg read as "
            f"{1000.0 * np.radians(angle):.2g} mg, and sizes below that are only found if they repeat from stop to stop"
        )
    return found
