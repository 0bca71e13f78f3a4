"""Load the effects that a user defines, and the calibrations of ``method=given``.

Effects by formula are files of the campaign; only the command line can name Python files. The calibration that
``method=given`` reads from a file becomes a setting: if it changes, exactly the stages that read it are repeated.
"""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from imu_logs.files import read_text
from imu_logs.units import SENSORS
from imu_logs.yaml_file import MAX_YAML_BYTES
from pipeline.app.config.options import SettingProblem
from pipeline.core.errors import ConfigurationError, PipelineError
from pipeline.core.files import CONFIGS
from pipeline.core.settings import OF_BENCH, UserEffectFiles

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from pipeline.core.settings import Sensor, Settings
    from pipeline.physics.effects.base import Effect

PYTHON = "python_effects"
GIVEN = "given"  # name of the method
BUILT_IN = r"(?m)^built_in: true"  # marks an effect of the package
ONLY_FROM_THE_COMMAND_LINE = (
    "an effect in Python is code, and is loaded only where the command line names it: "
    "--config 'python_effects=[path/to/my_effect.py]', or the argument python_effects of a Python function"
)


@dataclass(frozen=True)
class UserEffects:
    """The effects that the user defines."""

    effects: dict[str, Effect] = field(default_factory=dict)
    python: dict[str, dict[str, str]] = field(default_factory=dict)  # path and sha256 of Python effects, by name

    def section(self) -> UserEffectFiles | None:
        """Return the section ``user_effects`` for the settings of each unit; None without such effects."""
        if not self.effects:
            return None
        formulas = [e.definition or {} for name, e in self.effects.items() if name not in self.python]
        return UserEffectFiles(formulas=formulas, python=list(self.python.values()))

    def with_limits(self, sensor_model: Sensor) -> Sensor:
        """Return a sensor model with the limits of the effects beside its own, which have precedence."""
        for effect in self.effects.values():
            for sensor in effect.sensors:
                data_sheet = sensor_model.of(sensor)
                if effect.name not in data_sheet.effects:
                    limits = {**effect.limits(sensor), **data_sheet.effects}
                    sensor_model = sensor_model.replaced(**{sensor: data_sheet.replaced(effects=limits)})
        return sensor_model


def load_user_effects(campaign: Path, configs: Iterable[Path], python: Sequence[str]) -> UserEffects:
    """Read ``<campaign>/effects``, ``<configs>/effect`` and the Python files that the command line names.

    Raises ``ConfigurationError`` with a line for each invalid file.
    """
    loaded: dict[str, Effect] = {}
    places: dict[str, str] = {}
    hashes: dict[str, dict[str, str]] = {}
    problems: list[str] = []

    def add(effects: Mapping[str, Effect], place: Path) -> None:
        for name, effect in effects.items():
            if name in loaded:
                problems.append(f"{place}: the effect {name} is also in {places[name]}; name one of them otherwise")
            loaded[name], places[name] = effect, str(place)

    folders = [campaign / "effects", *(root / "effect" for root in configs)]
    directory, shipped = campaign.resolve(), CONFIGS / "effect"
    files = {
        folder: [
            f
            for f in sorted(folder.glob("*.yaml"))
            if not re.search(BUILT_IN, read_text(f, MAX_YAML_BYTES, "an effect"))
            or (f.resolve().is_relative_to(directory) and f.resolve().parent != shipped)
        ]
        for folder in folders
    }
    if not any(files.values()) and not python:
        return UserEffects()
    from pipeline.physics.effects import load_python_effect, read_effect_files  # noqa: PLC0415  (imports numpy)

    for folder, files_of_folder in files.items():
        try:
            add(read_effect_files(files_of_folder), folder)
        except PipelineError as error:
            problems.append(str(error))
    for text in python:
        path = Path(text).expanduser().resolve()
        try:
            effect = load_python_effect(path)
        except PipelineError as error:
            problems.append(str(error))
            continue
        add({effect.name: effect}, path)
        hashes[effect.name] = {"path": str(path), "sha256": str((effect.definition or {})["sha256"])}
    if problems:
        raise ConfigurationError("the configuration is refused:\n" + "\n".join(f"  {p}" for p in problems))
    return UserEffects(loaded, hashes)


def effects_for(stage: str, sensor: str, units: Sequence[Settings]) -> dict[str, Any]:
    """Return the section ``user_effects`` that a stage needs for some units; empty if it needs none.

    A fit needs the configured effects, or all effects for ``auto``. Diagnosis and report need all of them. The other
    stages read fitted effects, which contain their formulas but not their Python code.
    """
    section = next((unit.user_effects for unit in units if unit.user_effects), None)
    if section is None or stage not in ("effects", "validate", "diagnose", "export", "report", "prior"):
        return {}
    formulas, python = section.formulas, section.python
    if stage not in ("diagnose", "report"):
        wanted: set[str] = set()
        for unit in units:
            for of_sensor in SENSORS:
                names = unit.effects.of(of_sensor)
                if sensor in ("", of_sensor):
                    wanted |= {"auto"} if names == "auto" else set(names)
        everything = "auto" in wanted
        formulas = formulas if stage == "effects" else []
        formulas = [d for d in formulas if everything or d["name"] in wanted]
        python = [e for e in python if everything or Path(e["path"]).stem in wanted]
    return {"user_effects": {"formulas": formulas, "python": python}} if formulas or python else {}


def with_given(settings: Settings, campaign: Path) -> Settings:
    """Return the settings of a unit with the calibration from its file ``method.file``.

    ``method.given``: ``source`` (for texts), ``sha256``, ``notes``, and bias, matrix, effects and uncertainties of each
    sensor as in ``calibrations/<unit>.json``. ``effects``: the effects of the file that the sensor causes. Raises
    ``SettingProblem``.
    """
    from pipeline.output.exports.reading import read_any  # noqa: PLC0415  (only for this method)
    from pipeline.physics.effects import owner_of  # noqa: PLC0415  (as above)
    from pipeline.physics.effects.base import Owner  # noqa: PLC0415  (as above)

    method, effects = settings.method, {sensor: settings.effects.of(sensor) for sensor in SENSORS}
    if not method.file:
        raise SettingProblem(
            "method=given: method.file is not set; name the calibration, in any format of docs/apply.md"
        )
    if stated := [f"table.{key}" for key in OF_BENCH if getattr(settings.table, key)]:
        raise SettingProblem(
            f"method=given: {stated[0]} is set, which a fit would estimate; nothing is fitted: set it null"
        )
    file = campaign / method.file.replace("{unit}", settings.unit)
    try:
        content = read_any(file, method.format, {s: settings.sensor.of(s).counts_per_unit for s in SENSORS})
        digest = hashlib.sha256(file.read_bytes()).hexdigest()
    except PipelineError as error:
        raise SettingProblem(f"method.file: {error}") from error
    given: dict[str, Any] = {"source": f"{file.name} ({content.format_name})", "sha256": digest, "notes": content.notes}
    for sensor in SENSORS:
        if method.of(sensor) != GIVEN:
            continue
        if effects[sensor]:
            raise SettingProblem(
                f"effects.{sensor}: method=given takes the effects from its file; to fit effects, choose another method"
            )
        calibration = content.sensors.get(sensor)
        if calibration is None:
            given[sensor] = None
            continue
        of_sensor = [e for e in calibration.effects if owner_of(e) == Owner.SENSOR]
        effects[sensor] = [e.name for e in of_sensor]
        part = calibration.to_json() | {"stages": []}
        part["uncertain"] = calibration.covariance is not None
        part["of_the_bench"] = [e.name for e in calibration.effects if e not in of_sensor]
        given[sensor] = part
    return settings.replaced(method=method.replaced(given=given), effects=settings.effects.replaced(**effects))
