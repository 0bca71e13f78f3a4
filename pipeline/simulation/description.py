"""What is to be simulated, as a file ``simulation.yaml`` describes it.

    seed: 2019                       # every number follows from it
    defaults: {...}                  # keys of a unit, for all units
    units:
      - unit: U1                     # with count: 100, U1 is a prefix: U1001 .. U1100
        sensor: mpu6050              # configs/sensor
        table: acutronic             # configs/table
        procedure: three_axis_turns
        ...
    variants:                        # every unit once more, from the same recordings, with other columns
      - {suffix: -staged, columns: {method: staged, filter: rc_low_pass}}
    rows: [...]                      # further rows of units.csv, for units whose recordings another one has made

What a unit leaves out is drawn at random from the sensor's data sheet. The keys of a unit are the attributes of
``UnitDescription``.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field, fields
from functools import cache
from typing import TYPE_CHECKING, Any

from pipeline.errors import ConfigurationError, MissingInputError
from pipeline.files import CONFIGS
from pipeline.io.files import wrong_name
from pipeline.io.yaml_file import read_yaml
from pipeline.simulation.procedures import ONE_RECORDING, TABLE_PROCEDURES, Course
from pipeline.simulation.table_logs import table_log_of

if TYPE_CHECKING:
    from pathlib import Path

FORMATS = ("csv", "mcap")
UNITS_OF_A_LOT = 25


@dataclass(frozen=True)
class UnitDescription:
    """One unit to be simulated.

    Attributes
    ----------
    unit : str
    count : int
        Units of this description; above 1, ``unit`` is a prefix.
    sensor, table, procedure : str
        Names of configurations.
    columns : dict
        Further columns of ``units.csv``: serial, lot, date, method, overrides ...
    course : dict
        How the procedure is run: attributes of ``procedures.Course``.
    samples : int or None
        About how many rows the unit's recordings have together.
    interval_s : float
        Sampling interval.
    lost : float
        Share of the samples that the radio link loses.
    format : str
        ``csv`` or ``mcap``.
    accelerometer, gyroscope : dict
        ``bias`` (g or deg/s), ``matrix``, or in its place ``scale_factor`` (of the correction),
        ``non_orthogonality_deg`` (yx, zx, zy) and ``mounting_deg`` (turns about x, then y, then z); and
        ``noise_density``, ``bias_wander``, ``wander_time_s`` in place of the data sheet's.
    effects : dict
        ``sensor.effect``, or ``effect`` alone for both sensors, to null (a typical size, at random), a number (that
        size, with random signs) or the list of the parameters' values; or to a formula of its own
        (``inline_effects``).
    imperfections : dict
        What the table does otherwise than commanded; see ``table_errors.random_errors``, and ``tilt_deg`` (2,). What is
        left out follows from the accuracies of the table's configuration.
    held_out : dict
        Where the held-out motion and the long rest are recorded elsewhere: ``table``, ``imperfections``,
        ``accelerometer``, ``gyroscope``.
    temperature : dict
        ``ambient``, ``warm_up``, ``drift`` in degC, to replace the random ones.
    copy_of : str or None
        The unit whose recordings these are once more, in another format or with another log of the table.
    recordings : list of str
        Those of the procedure's recordings that are made; empty for all.
    motion : int or None
        Number of the random motion: units of the same number and course move alike. None: each has a motion of its own.
    table_log : dict
        How the table is logged: attributes of ``table_logs.TableLog``.
    """

    unit: str
    count: int = 1
    sensor: str = "mpu6050"
    table: str = "acutronic"
    procedure: str = "three_axis_turns"
    columns: dict[str, Any] = field(default_factory=dict)
    course: dict[str, Any] = field(default_factory=dict)
    samples: int | None = None
    interval_s: float = 0.12
    lost: float = 0.0
    format: str = "csv"
    accelerometer: dict[str, Any] = field(default_factory=dict)
    gyroscope: dict[str, Any] = field(default_factory=dict)
    effects: dict[str, Any] = field(default_factory=dict)
    imperfections: dict[str, Any] = field(default_factory=dict)
    held_out: dict[str, Any] = field(default_factory=dict)
    temperature: dict[str, Any] = field(default_factory=dict)
    copy_of: str | None = None
    recordings: list[str] = field(default_factory=list)
    motion: int | None = None
    table_log: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        wrong = wrong_name(self.unit)
        if wrong:
            raise ConfigurationError(f"unit {self.unit[:60]!r}: {wrong}")
        if self.format not in FORMATS:
            raise ConfigurationError(f"unit {self.unit}: format {self.format!r} is not known; use csv or mcap")
        if not 0.0 <= self.lost < 0.9:
            raise ConfigurationError(f"unit {self.unit}: lost is {self.lost}; it is a share from 0 to 0.9")
        if not self.interval_s > 0.0:
            raise ConfigurationError(f"unit {self.unit}: interval_s is {self.interval_s}; it must be above 0")
        _refuse_unknown(self.course, {f.name for f in fields(Course)}, f"unit {self.unit}: course")
        log = table_log_of(self.table_log).kind
        if log != "rows" and self.format != "csv":
            raise ConfigurationError(f"unit {self.unit}: a table_log of its own is written in csv only")
        if log != "rows" and self.procedure not in TABLE_PROCEDURES:
            raise ConfigurationError(f"unit {self.unit}: procedure {self.procedure} has no table to log")
        if log == "program" and self.procedure == ONE_RECORDING:
            raise ConfigurationError(f"unit {self.unit}: procedure {ONE_RECORDING} has moves that no program describes")


@dataclass(frozen=True)
class Description:
    """A campaign to be simulated: its seed, units, variants of them, and further rows of ``units.csv``."""

    seed: int
    units: tuple[UnitDescription, ...]
    rows: tuple[dict[str, Any], ...] = ()
    variants: tuple[dict[str, Any], ...] = ()


def read_description(path: Path) -> Description:
    """Read a ``simulation.yaml``.

    Raises
    ------
    MissingInputError
        If the file does not exist.
    ConfigurationError
        If it holds what is not known.
    """
    data = read_mapping(path)
    return description_from(data, str(path))


def description_from(data: dict[str, Any], origin: str) -> Description:
    """Return the description that a mapping gives; ``origin`` is named in messages."""
    _refuse_unknown(data, {"seed", "defaults", "units", "variants", "rows"}, origin)
    known = {f.name for f in fields(UnitDescription)}
    units = []
    for entry in data.get("units") or ():
        merged = {**(data.get("defaults") or {}), **entry}
        _refuse_unknown(merged, known, f"{origin}: unit {entry.get('unit')}")
        if "unit" not in merged:
            raise ConfigurationError(f"{origin}: a unit has no name; give it one with the key unit")
        units += _counted(merged)
    names = [u.unit for u in units]
    if not names or len(set(names)) < len(names):
        raise ConfigurationError(f"{origin}: there must be at least one unit, and each needs a name of its own")
    variants = tuple(data.get("variants") or ())
    for variant in variants:
        _refuse_unknown(variant, {"suffix", "columns"}, f"{origin}: variants")
        if not variant.get("suffix"):
            raise ConfigurationError(f"{origin}: variants: each needs a suffix for the names of its units")
    return Description(int(data.get("seed", 0)), tuple(units), tuple(data.get("rows") or ()), variants)


def read_mapping(path: Path) -> dict[str, Any]:
    """Read a YAML file that holds a mapping."""
    if not os.path.lexists(path):
        raise MissingInputError("this file does not exist", str(path))
    data = read_yaml(path)
    if not isinstance(data, dict):
        raise ConfigurationError("expected a mapping of settings", str(path))
    return data


@cache
def read_config(group: str, name: str) -> dict[str, Any]:
    """Read one configuration of a group as plain YAML, without composing it.

    Raises
    ------
    ConfigurationError
        If there is none of that name.
    """
    path = CONFIGS / group / f"{name}.yaml"
    if not path.is_file():
        known = ", ".join(sorted(p.stem for p in path.parent.glob("*.yaml")))
        raise ConfigurationError(f"no {group} is called {name!r}; known: {known}")
    return read_mapping(path)


def _counted(entry: dict[str, Any]) -> list[UnitDescription]:
    count = entry.get("count", 1)
    if count == 1:
        return [UnitDescription(**entry)]
    width = max(3, len(str(count)))
    units = []
    for number in range(1, count + 1):
        name = f"{entry['unit']}{number:0{width}d}"
        columns = {"serial": name, "lot": f"L{(number - 1) // UNITS_OF_A_LOT + 1}", **entry.get("columns", {})}
        units.append(UnitDescription(**{**entry, "unit": name, "count": 1, "columns": columns}))
    return units


def _refuse_unknown(data: dict[str, Any], known: set[str], origin: str) -> None:
    unknown = sorted(set(data) - known)
    if unknown:
        raise ConfigurationError(f"{origin}: {', '.join(unknown)} is not known; known: {', '.join(sorted(known))}")
