r"""Read the options of Hydra groups and the overrides of a user, and resolve what they name: settings, effects, files.

A reference ``${group.key}`` in a value stands for the value of that setting, and ``\${`` for the characters ``${``.
OmegaConf does not resolve them: its resolvers, such as ``${oc.env:NAME}``, would write environment variables of the
user into the pages of a campaign, and it takes 64 ms to build a configuration. A reference names a value or a list of
values that is not a reference itself, so the time is proportional to the size of a file.

Effects by formula are files of the campaign; only the command line can name Python files. The calibration that
``method=given`` reads from a file becomes a setting: if it changes, exactly the stages that read it are repeated.
"""

from __future__ import annotations

import difflib
import hashlib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

from imu_logs.files import read_text
from imu_logs.units import SENSORS
from imu_logs.yaml_file import MAX_YAML_BYTES, read_yaml
from pipeline.core.errors import ConfigurationError, PipelineError
from pipeline.core.files import CONFIGS
from pipeline.core.settings import OF_BENCH, RunSettings, Sensor, Settings, UserEffectFiles
from pipeline.physics.effects.base import Effect

GROUPS = ("sensor", "table", "procedure", "method", "filter", "ingest", "certificate")
RUN_SETTINGS = tuple(RunSettings.model_fields)
LARGEST_CONFIG = 10_000  # values of an option; the largest in configs/ has 160
NUMBER_OVERRIDE = re.compile(r"([a-z_][a-z_0-9]*(?:\.[A-Za-z_][A-Za-z_0-9]*)*)=(-?(?:0|[1-9][0-9]*)(\.[0-9]+)?)")
WORD_OVERRIDE = re.compile(r"([a-z_][a-z_0-9]*(?:\.[A-Za-z_][A-Za-z_0-9]*)*)=([A-Za-z_][A-Za-z_0-9./-]*)")  # text, path
NOT_TEXTS = ("null", "true", "false", "nan", "inf")
REFERENCE_TOKEN = re.compile(r"(\\\$\{)|\$\{\s*([A-Za-z_]\w*(?:\.\w+)+)\s*\}|\$\{")
MAX_REFERENCE_LENGTH = 10_000  # characters of a value with references, such as a name or a unit
REFERENCE_FORM = "a reference is ${group.key}, for example ${sensor.accelerometer.counts_per_unit}"
PYTHON = "python_effects"
GIVEN = "given"  # name of the method
BUILT_IN = r"(?m)^built_in: true"  # marks an effect of the package
ONLY_FROM_THE_COMMAND_LINE = (
    "an effect in Python is code, and is loaded only where the command line names it: "
    "--config 'python_effects=[path/to/my_effect.py]', or the argument python_effects of a Python function"
)


class SettingProblem(ConfigurationError):  # noqa: N818  (problems are collected, then raised as one error)
    """One error in the configuration of a unit or of a comparison."""


def nearest(name: str, known: Iterable[str]) -> str:
    """Return a hint with the nearest valid name, and with all valid names if they are at most 12."""
    known = sorted(known)
    close = difflib.get_close_matches(name, known, 1, 0.5)
    hint = f"; nearest: {close[0]}" if close else ""
    return f"{hint}; valid: {', '.join(known)}" if len(known) <= 12 else hint


@lru_cache(maxsize=100_000)
def parse(text: str) -> tuple[str, Any]:
    """Parse one Hydra override to its key and value.

    A plain number, word or path, the usual override of a single unit, is read without Hydra's parser, which takes
    0.6 ms, and 0.1 s at first. Raises ``SettingProblem`` if the text is not an override, or is a sweep or a deletion.
    """
    number, words = NUMBER_OVERRIDE.fullmatch(text), WORD_OVERRIDE.fullmatch(text)
    if number:
        key, value, fraction = number.groups()
        return key, float(value) if fraction else int(value)
    if words and words[2].lower() not in NOT_TEXTS:
        return words[1], words[2]
    from hydra.errors import HydraException, OverrideParseException  # noqa: PLC0415  (where it is needed)

    hint = "; write KEY=VALUE, for example filter.cutoff_hz=5"
    if text.startswith("["):
        raise SettingProblem(f'{text!r} is not a list of overrides; quote each one: \'overrides=["a=1","b=[x,y]"]\'')
    try:
        override = _hydras_parser().parse_override(text)
    except (OverrideParseException, HydraException) as error:
        raise SettingProblem(f"{text!r} is not a Hydra override ({str(error).splitlines()[0]}){hint}") from error
    if override.is_sweep_override() or override.is_delete():
        raise SettingProblem(f"{text!r} is a sweep or a deletion; give one value{hint}")
    return override.key_or_group, override.value()


@cache
def _hydras_parser() -> Any:  # noqa: ANN401  (hydra's types need its import)
    from hydra.core.override_parser.overrides_parser import OverridesParser  # noqa: PLC0415  (as above)

    return OverridesParser.create()


@cache
def read_option(group: str, option: str, searchpath: tuple[Path, ...], *_: object) -> dict[str, Any]:
    """Return the content of the file of an option; ``{}`` if the file does not exist.

    The other arguments are those that change with the files in these folders.
    """
    for root in (*searchpath, CONFIGS):
        file = root / group / f"{option}.yaml"
        if file.is_file():
            return {str(k): v for k, v in mapping_of(file).items()}
    return {}


def mapping_of(file: Path) -> dict[Any, Any]:
    """Read the file of an option; raises ``ConfigurationError`` if it is not a mapping or contains a resolver."""
    content = read_yaml(file, LARGEST_CONFIG)
    if not isinstance(content, dict):
        raise ConfigurationError("a mapping of settings is expected", str(file))
    check_references(content, str(file))
    return content


@cache
def default_option(group: str) -> str:
    """Return the default option of a group."""
    entries = mapping_of(CONFIGS / "config.yaml")["defaults"]
    return next(str(entry[group]) for entry in entries if isinstance(entry, dict) and group in entry)


def check_references(value: Any, where: str | None = None) -> None:  # noqa: ANN401  (any YAML value)
    """Raise ``ConfigurationError`` if a value contains ``${...}`` with more than the name of a setting."""
    if isinstance(value, dict):
        for key, below in value.items():
            check_references(key, where)
            check_references(below, where)
    elif isinstance(value, list):
        for below in value:
            check_references(below, where)
    elif isinstance(value, str) and any(not escaped and not name for escaped, name in REFERENCE_TOKEN.findall(value)):
        raise ConfigurationError(f"{value[:200]!r}: {REFERENCE_FORM}; resolvers (${{oc.env:NAME}}) are not read", where)


def with_references(node: Any, root: dict[str, Any]) -> Any:  # noqa: ANN401  (dict, list or value)
    """Return a copy of a node in which the value from the tree ``root`` replaces each reference.

    Raises ``ConfigurationError`` if a reference names no setting, a group of settings, or another reference.
    """
    if isinstance(node, dict):
        return {with_references(key, root): with_references(below, root) for key, below in node.items()}
    if isinstance(node, list):
        return [with_references(below, root) for below in node]
    if not isinstance(node, str) or "${" not in node:
        return node
    check_references(node)
    whole = REFERENCE_TOKEN.fullmatch(node)
    if whole and whole.group(2):
        return _value_of(whole.group(2), root, node)
    text, end = "", 0
    for token in REFERENCE_TOKEN.finditer(node):
        value = None if token.group(1) else _value_of(token.group(2), root, node)
        if not token.group(1) and value is None:
            raise ConfigurationError(f"{node[:200]!r}: {token.group(2)} is null; set it")
        text += node[end : token.start()] + ("${" if token.group(1) else str(value))
        end = token.end()
        if len(text) > MAX_REFERENCE_LENGTH:
            raise ConfigurationError(f"{node[:200]!r}: more than {MAX_REFERENCE_LENGTH} characters with its references")
    return text + node[end:]


def _value_of(name: str, root: dict[str, Any], text: str) -> Any:  # noqa: ANN401
    value: Any = root
    for key in name.split("."):
        if not isinstance(value, dict) or key not in value:
            raise ConfigurationError(f"{text[:200]!r}: no setting is called {name}")
        value = value[key]
    values = value if isinstance(value, list) else [value]
    if any(isinstance(v, (dict, list)) or (isinstance(v, str) and "${" in v) for v in values):
        raise ConfigurationError(f"{text[:200]!r}: {name} is a group of settings or a reference; name one value")
    return value


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
        configured = [unit.effects.of(s) for unit in units for s in SENSORS if sensor in ("", s)]
        if "auto" not in configured:
            wanted = {name for names in configured for name in names}
            formulas = [d for d in formulas if d["name"] in wanted]
            python = [e for e in python if Path(e["path"]).stem in wanted]
        formulas = formulas if stage == "effects" else []
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
        raise SettingProblem("method=given: method.file is not set; name the calibration, in a format of docs/apply.md")
    if stated := [f"table.{key}" for key in OF_BENCH if getattr(settings.table, key)]:
        raise SettingProblem(f"method=given: {stated[0]} is set, which only a fit estimates: set it null")
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
