"""Write a simulated campaign: units.csv, campaign.yaml, the recordings, and the true parameters.

    <directory>/units.csv, campaign.yaml, simulation.yaml
    <directory>/raw/<unit>/<recording>.csv (or .mcap)
    <directory>/truth/<unit>.json     bias, matrix, effects and noise of each sensor

``truth`` is for tests and for the reader; no stage reads it.
"""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from pipeline.core.errors import ConfigurationError
from pipeline.core.records import AXES, SENSORS
from pipeline.ingest.write import write_recording
from pipeline.simulation.description import course_of, shipped_settings
from pipeline.simulation.procedures import ONE_RECORDING, plan
from pipeline.simulation.sensor import decimals_of, drawn_effects, drawn_sensors
from pipeline.simulation.session import (
    ANGLE_DECIMALS,
    QUATERNION_DECIMALS,
    TEMPERATURE_DECIMALS,
    SimulatedBench,
    Streams,
    columns_of,
    programs_of,
    random_environment,
    record,
    with_table_log,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from pipeline.core.records import Recording
    from pipeline.core.settings import Sensor
    from pipeline.simulation.description import Description, UnitDescription
    from pipeline.simulation.sensor import Hidden, SimulatedSensor
    from pipeline.simulation.trajectory import Planned

UNITS_CSV_COLUMNS = (
    "unit",
    "serial",
    "lot",
    "date",
    "sensor",
    "table",
    "procedure",
    "method",
    "ingest",
    "filter",
    "overrides",
)
CAMPAIGN_YAML = "# Hydra overrides for all units of this campaign.\noverrides: []\n"


def write_campaign(
    description: Description,
    directory: Path,
    progress: Callable[[str], None] = lambda _: None,
    *,
    sheet_only: bool = False,
) -> None:
    """Simulate every unit of a description and write the campaign; files of the same names are replaced.

    ``progress`` is called with a line for each finished unit. ``sheet_only``: write ``units.csv`` without recordings
    and truth, for a campaign whose run simulates them.
    """
    for name, text in programs_of(description.units).items():
        path = directory / "configs" / "procedure" / f"{name}.yaml"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    names = [unit.unit for unit in description.units]
    for unit in () if sheet_only else description.units:
        if (unit.copy_of or unit.unit) not in names:
            raise ConfigurationError(f"unit {unit.unit}: copy_of names {unit.copy_of}, which is not among the units")
        origin = names.index(unit.copy_of or unit.unit)
        original = replace(description.units[origin], table_log=unit.table_log)
        recordings, truth = simulate_unit(original, description.seed, origin)
        sensor_model = shipped_settings(sensor=unit.sensor).sensor
        folder = directory / "raw" / unit.unit
        folder.mkdir(parents=True, exist_ok=True)
        for recording in recordings:
            _write_recording(folder, recording, unit.format, sensor_model)
        path = directory / "truth" / f"{unit.unit}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({**truth, "unit": unit.unit}, indent=1) + "\n", encoding="utf-8")
        progress(f"{unit.unit}: {sum(r.samples for r in recordings)} samples in {len(recordings)} recordings")
    table = pd.DataFrame(_sheet_rows(description), dtype=object)
    columns = [*(c for c in UNITS_CSV_COLUMNS if c in table), *(c for c in table if c not in UNITS_CSV_COLUMNS)]
    (directory / "units.csv").write_text(
        table.to_csv(columns=columns, index=False, lineterminator="\n"), encoding="utf-8"
    )
    if not (directory / "campaign.yaml").exists():
        (directory / "campaign.yaml").write_text(CAMPAIGN_YAML, encoding="utf-8")


def _sheet_rows(description: Description) -> list[dict[str, Any]]:
    """Return the rows of ``units.csv``: units, variants with the recordings of a unit, further rows."""
    rows: list[dict[str, Any]] = [
        {"unit": unit.unit, "sensor": unit.sensor, "table": unit.table, "procedure": unit.procedure}
        | columns_of(unit)
        | unit.columns
        for unit in description.units
    ]
    variants = []
    for variant, row in product(description.variants or (), rows):
        changed = {**row, **variant.columns, "unit": f"{row['unit']}{variant.suffix}"}
        overrides = [changed.get("overrides"), f"procedure.folder=raw/{row['unit']}"]
        variants.append(changed | {"overrides": "; ".join(o for o in overrides if o)})
    return rows + variants + list(description.rows or ())


def simulate_unit(
    unit: UnitDescription, seed: int, number: int, extra: Sequence[Planned] = ()
) -> tuple[list[Recording], dict[str, Any]]:
    """Return the recordings of one unit and its true parameters.

    The seed and the unit's number in its campaign determine every random number. ``extra``: recordings to make after
    those of the procedure.
    """
    streams, course = Streams(seed, number), course_of(unit)
    benches, effects = _drawn(unit, streams)
    by_hand = benches[""].table.angle_accuracy_deg if benches[""].table.motion == "none" else 0.0
    mover = streams["motion"] if unit.motion is None else Streams(seed, unit.motion)["motion"]
    planned = [*_selected(unit, plan(unit.procedure, course, mover, by_hand)), *extra]
    total = sum(p.trajectory.duration + course.pause_s for p in planned)
    ramp = course.thermal_ramp_degc if unit.procedure == "thermal_ramp" else 0.0
    of_ramp = {"ramp": ramp, "ramp_period": total / 1.5}
    environment = replace(random_environment(streams["room"]), **{**of_ramp, **unit.temperature})
    pause = unit.interval_s if unit.procedure == ONE_RECORDING else course.pause_s
    truth = true_parameters(unit, seed, number)
    made = record(planned, benches, effects, environment=environment, unit=unit, pause=pause, streams=streams)
    recordings, clock = with_table_log(unit, planned, made, streams["link"])
    return recordings, truth | ({"table_clock": clock} if clock else {})


def true_parameters(unit: UnitDescription, seed: int, number: int) -> dict[str, Any]:
    """Return the true parameters of one unit, without its recordings."""
    benches, effects = _drawn(unit, Streams(seed, number))
    bench = benches[""]
    return {
        "seed": [seed, number],
        **{name: getattr(unit, name) for name in ("sensor", "table", "procedure", "interval_s", "lost")},
        **{s: _truth(bench.sensors[s], effects[s], unit.interval_s) for s in SENSORS},
        "imperfections": {k: np.asarray(v).tolist() for k, v in bench.imperfections.items()},
    }


def _drawn(unit: UnitDescription, streams: Streams) -> tuple[dict[str, SimulatedBench], dict[str, Hidden]]:
    """Return the bench of each recording (``""``: of all others), and the effects of each sensor."""
    sensor_model = shipped_settings(sensor=unit.sensor).sensor
    effects = drawn_effects(unit.effects, sensor_model, streams["effects"])

    def bench_of(other: Mapping[str, Any]) -> SimulatedBench:
        """Return the bench of the description, changed by ``other`` settings; with the same sensors."""
        table = shipped_settings(table=other.get("table", unit.table)).table
        rng = streams["bench"]
        imperfections = {
            "angle_accuracy_deg": table.angle_accuracy_deg,
            "rate_error": table.rate_accuracy * rng.standard_normal(3),
            "direction_deg": table.orthogonality_deg * rng.standard_normal((3, 2)),
            **(other.get("imperfections", {}) if other else unit.imperfections),
        }
        given = {s: {**getattr(unit, s), **other.get(s, {})} for s in SENSORS}
        return SimulatedBench(table, imperfections, drawn_sensors(sensor_model, given, effects, streams["unit"]))

    held_out = dict.fromkeys(("validation", "static"), bench_of(unit.held_out)) if unit.held_out else {}
    return {"": bench_of({}), **held_out}, effects


def _selected(unit: UnitDescription, planned: list[Planned]) -> list[Planned]:
    """Return the planned recordings that the unit's description selects."""
    unknown = set(unit.recordings) - {p.name for p in planned}
    if unknown:
        known = ", ".join(p.name for p in planned)
        raise ConfigurationError(
            f"unit {unit.unit}: recordings {', '.join(sorted(unknown))} are not made; made: {known}"
        )
    return [p for p in planned if not unit.recordings or p.name in unit.recordings]


def _write_recording(folder: Path, recording: Recording, kind: str, sensor_model: Sensor) -> None:
    """Write one recording as ``<name>.csv`` or ``<name>.mcap``, in the axes of the unit's body."""
    if kind == "mcap":
        write_recording(folder / f"{recording.name}.mcap", recording)
        return
    wanted = {f"accel_{a}_g": decimals_of(sensor_model.accelerometer) for a in AXES}
    wanted |= {f"gyro_{a}_dps": decimals_of(sensor_model.gyroscope) for a in AXES}
    wanted |= {"temperature_degc": TEMPERATURE_DECIMALS}
    wanted |= dict.fromkeys(("table_angle_deg", "table_rate_dps"), ANGLE_DECIMALS)
    wanted |= {f"table_q{c}": QUATERNION_DECIMALS for c in "wxyz"}
    write_recording(folder / f"{recording.name}.csv", recording, wanted)


def _truth(sensor: SimulatedSensor, effects: Hidden, interval: float) -> dict[str, Any]:
    defined = {name: kind.definition for name, (kind, _) in effects.items() if kind.definition}
    return {
        "bias": sensor.bias.tolist(),
        "matrix": sensor.matrix.tolist(),
        "effects": {
            name: {p.name: float(v) for p, v in zip(kind.parameters(sensor.sensor), values, strict=True)}
            for name, (kind, values) in effects.items()
        },
        **({"definitions": defined} if defined else {}),
        "noise": {
            "white": sensor.white(interval),
            "wander": sensor.data_sheet.bias_wander,
            "correlation_time": sensor.data_sheet.wander_time_s,
        },
    }
