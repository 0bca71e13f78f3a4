"""Compose the configuration of a unit with Hydra.

Options of groups are chosen first, then values are merged. The order of precedence is: group defaults, then the layers
of ``pipeline.app.config.layers``, weakest first.

Hydra composes each choice of groups once (65 ms). The values of single units are merged into plain dicts, and a regular
expression parses a plain number. OmegaConf would take 46 ms to merge one value into a configuration and 64 ms to build
it, and Hydra's parser 0.6 ms per override: 20 minutes and 12 s for 10,000 units. Units share the sections that their
overrides do not change.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from copy import deepcopy
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeAlias

from pydantic import ValidationError

from imu_logs.profile import checks_of, csv_formats, mcap_formats
from imu_logs.units import SENSORS
from pipeline.app.config.options import (
    GIVEN,
    GROUPS,
    ONLY_FROM_THE_COMMAND_LINE,
    PYTHON,
    RUN_SETTINGS,
    SettingProblem,
    UserEffects,
    default_option,
    load_user_effects,
    mapping_of,
    nearest,
    parse,
    read_option,
    with_given,
    with_references,
)
from pipeline.core.errors import ConfigurationError
from pipeline.core.files import CONFIGS, from_cache, state_of_files, to_cache
from pipeline.core.settings import (
    OF_BENCH,
    SECTIONS,
    Ingest,
    Method,
    Procedure,
    Section,
    Sensor,
    Settings,
    Stages,
    Unit,
    completed,
    range_settings,
    without_overridden,
)
from pipeline.estimation.stages import NOT_WANTED, check_stages, declared
from pipeline.ingest.files import candidate_files
from pipeline.ingest.recordings_sheet import with_sheet

Groups: TypeAlias = tuple[tuple[str, str], ...]  # group and option
INSTANCE = "${ingest.instance}"
WITHOUT_CONSTANT = ("high_pass", "band_pass")  # filters of ``configs/filter`` whose output has no constant part
OF_A_SETUP = ("mounting", "bias")  # effects that exist only for one setup (pipeline.physics.effects.mounting)


class Composer:
    """Composes the configurations of the units of one campaign.

    Options include the files ``configs/<group>/*.yaml`` of the campaign. Effects include its files ``effects/*.yaml``
    and the Python files that the user names. ``below``: folder of relative paths in settings, by default the campaign.
    Raises ``ConfigurationError`` if one of the files is not valid.
    """

    def __init__(self, campaign: Path, python_effects: Sequence[str] = (), below: Path | None = None) -> None:
        self.campaign, self.below = campaign, below or campaign
        configs = campaign / "configs"
        self.searchpath = [configs.resolve()] if configs.is_dir() else []
        files = sorted(configs.rglob("*.yaml"))
        for file in files:  # checks each file before Hydra opens it
            mapping_of(file)
        self.state = tuple((status.st_mtime_ns, status.st_size) for status in map(Path.stat, files))
        roots = CONFIGS, *self.searchpath
        self.options = {group: {f.stem for root in roots for f in (root / group).glob("*.yaml")} for group in GROUPS}
        self.user_effects: UserEffects = load_user_effects(campaign, [*self.searchpath, CONFIGS], python_effects)
        self.effects = {f.stem for f in (CONFIGS / "effect").glob("*.yaml")} | set(self.user_effects.effects)
        self._bases: dict[Groups, tuple[dict[str, Any], bool]] = {}
        self._checked_bases: dict[int, Section] = {}  # by the id of a section of ``_bases``
        self._resolved: dict[str, Settings] = {}
        self._valid_ingest: set[str] = set()

    def unit(self, name: str, layers: Sequence[str]) -> Settings:
        """Return the checked settings of a unit from its overrides, weakest first.

        Raises ``ConfigurationError`` with one line for each error.
        """
        groups, values = self.split(layers)
        key = repr((sorted(groups.items()), values))
        if key not in self._resolved:
            self._resolved[key] = self._resolve(groups, values)
        resolved = self._resolved[key]
        folder = resolved.procedure.folder.replace("{unit}", name)
        unit = resolved.replaced(unit=name, procedure=resolved.procedure.replaced(folder=folder))
        unit = with_sheet(unit, self.below / unit.procedure.folder)
        return with_given(unit, self.below) if GIVEN in (unit.method.accelerometer, unit.method.gyroscope) else unit

    def split(self, layers: Sequence[str]) -> tuple[dict[str, str], list[tuple[str, Any]]]:
        """Split overrides into the chosen options by group, and the values in order; raises ``ConfigurationError``."""
        groups: dict[str, str] = {}
        values: list[tuple[str, Any]] = []
        for text in layers:
            key, value = parse(text)
            if key in GROUPS and isinstance(value, str):
                if value not in self.options[key]:
                    raise SettingProblem(f"{key}={value}: no such {key}{nearest(value, self.options[key])}")
                groups[key] = value
            elif key in RUN_SETTINGS:
                raise SettingProblem(f"{text}: {key} is a setting of the run, not of a unit; set it in campaign.yaml")
            elif key == PYTHON:
                raise SettingProblem(f"{text}: {ONLY_FROM_THE_COMMAND_LINE}")
            elif key.startswith("method.stages"):
                raise SettingProblem(f"{text}: stages are what a method is; write your own method in configs/method/")
            else:
                values.append((key, value))
        sensor = self._read("sensor", groups.get("sensor") or default_option("sensor"))
        return groups, [setting for key, value in values for setting in range_settings(key, value, sensor)]

    def _resolve(self, groups: dict[str, str], values: list[tuple[str, Any]]) -> Settings:
        base, has_references = self._base(self.complete(groups))
        merged = dict(base)
        for key, value in values:
            _set(merged, key.split("."), value)
        merged["sensor"] = without_overridden(merged["sensor"], {key for key, _ in values})
        if merged["ingest"].get("instance") is not None and INSTANCE not in repr(merged["ingest"]):
            profile = merged["ingest"]["name"]
            raise SettingProblem(f"ingest.instance is set, and no name in the profile {profile} contains {INSTANCE}")
        if has_references or "${" in repr(values):
            merged = with_references(merged, merged)
        checked: dict[str, Any] = {}
        errors: list[Any] = []
        for section, content in merged.items():
            try:
                checked[section] = self._checked(section, content, of_base=content is base.get(section))
            except ValidationError as error:
                errors += [{**e, "loc": (section, *e["loc"])} for e in error.errors()]
        if errors:
            raise SettingProblem("\n".join(_explain(e, merged) for e in errors))
        checked["method"] = _with_known(self._with_stages(checked["method"]), checked["sensor"])
        checked["procedure"] = _with_unused_optional(checked["procedure"], checked["method"])
        settings = Settings.model_construct(unit="", user_effects=self.user_effects.section(), **checked)
        self._check_meaning(settings)
        return settings

    def _checked(self, section: str, content: Any, *, of_base: bool) -> Section:  # noqa: ANN401  (the user's)
        """Validate a section against the schema (a section of a base once); raises ``ValidationError``."""
        if of_base and id(content) in self._checked_bases:
            return self._checked_bases[id(content)]
        if section not in SECTIONS:
            raise ValidationError.from_exception_data("", [{"type": "extra_forbidden", "loc": (), "input": content}])
        checked = SECTIONS[section].model_validate(content)
        if isinstance(checked, Sensor):
            checked = self.user_effects.with_limits(checked)
        if of_base:
            self._checked_bases[id(content)] = checked
        return checked

    def complete(self, groups: dict[str, str]) -> dict[str, str]:
        """Add the defaults that depend on other options: the table of the procedure, and the method."""
        chosen = dict(groups)
        procedure = self._read("procedure", chosen.get("procedure", "three_axis_turns"))
        chosen.setdefault("table", str(procedure["table"]))
        if "method" not in chosen:
            without = self._read("table", chosen["table"])["motion"] == "none" or procedure["table"] == "hand"
            usual = "nonlinear_least_squares" if without else "reference_least_squares"
            chosen["method"] = str(procedure.get("method") or usual)
        return chosen

    def _read(self, group: str, option: str) -> dict[str, Any]:
        return read_option(group, option, tuple(self.searchpath), self.state)

    def _base(self, groups: dict[str, str]) -> tuple[dict[str, Any], bool]:
        """Return the configuration that Hydra composes from a choice of groups, and whether it contains references."""
        key = tuple(sorted(groups.items()))
        if key not in self._bases:
            base = deepcopy(_composed(key, tuple(self.searchpath), self.state))
            plain: dict[str, Any] = {str(k): v for k, v in base.items() if k not in RUN_SETTINGS}
            for group in GROUPS:
                option = groups.get(group) or default_option(group)
                plain[group] = {"name": option, **plain[group]}
            plain["sensor"] = completed(plain["sensor"], self._read("sensor", "generic"))
            self._bases[key] = plain, "${" in repr(plain)
        return self._bases[key]

    def _with_stages(self, method: Method) -> Method:
        """Return the method with the stages of the method that is chosen for each sensor."""
        stages: dict[str, list[str]] = {}
        if method.accelerometer is None and method.gyroscope is None:
            raise SettingProblem(
                "method.accelerometer and method.gyroscope are both null: no sensor would be calibrated"
            )
        for sensor in SENSORS:
            name = method.of(sensor)
            if name is None:
                stages[sensor] = [NOT_WANTED]
                continue
            if name not in self.options["method"]:
                raise SettingProblem(f"method.{sensor}={name}: no such method{nearest(name, self.options['method'])}")
            of_method = method.stages.of(sensor) if name == method.name else self._stages(name).get(sensor)
            if not of_method:
                valid = [m for m in self.options["method"] if self._stages(m).get(sensor)]
                raise SettingProblem(
                    f"method.{sensor}={name}: {name} has no stages for the {sensor}{nearest(name, valid)}"
                )
            stages[sensor] = list(of_method)
            try:
                check_stages(sensor, stages[sensor])
            except ConfigurationError as error:
                raise SettingProblem(f"method.{sensor}={name}: {error.message} (configs/method/{name}.yaml)") from None
            if not any({"bias", "matrix"} & {*declared(sensor, stage).changes} for stage in stages[sensor]):
                problem = f"method.{sensor}={name}: no stage fits bias or matrix: add one that does"
                raise SettingProblem(f"{problem}, such as reference_least_squares (configs/method/{name}.yaml)")
        unused = {} if GIVEN in (method.accelerometer, method.gyroscope) else {"file": None, "format": None}
        return method.replaced(stages=Stages(**stages), **unused)

    def _stages(self, method: str) -> dict[str, Any]:
        stages: dict[str, Any] = self._read("method", method)["stages"]
        return stages

    def _check_effect(self, sensor: str, whole: str, procedure: Procedure) -> None:
        name, separator, setup = whole.partition("@")
        if separator:
            known = {entry.setup for entry in procedure.recordings.values() if entry.setup is not None}
            if setup not in known:
                hint = nearest(setup, known) if known else "; name the setup of each recording in the procedure config"
                raise SettingProblem(f"{whole}: no recording of procedure {procedure.name} has setup: {setup}{hint}")
            if name in OF_A_SETUP:
                return
        if name not in self.effects:
            raise SettingProblem(f"effects.{sensor}: no effect is called {name!r}{nearest(name, self.effects)}")
        user_effect = self.user_effects.effects.get(name)
        if user_effect and separator:
            raise SettingProblem(f"effects.{sensor}: {whole}: an effect that you define cannot apply to one setup only")
        applies = user_effect.sensors if user_effect else read_option("effect", name, ()).get("sensors", [sensor])
        if sensor not in applies:
            raise SettingProblem(f"effects.{sensor}: {name} applies to the {' and '.join(applies)} only")

    def _check_limits(self, sensor: str, limits: Iterable[str]) -> None:
        """Refuse a limit that is neither of an effect nor of its parameter, such as ``warm_up_time_constant``."""
        for name in limits:
            if name not in self.effects and not any(name.startswith(f"{effect}_") for effect in self.effects):
                hint = nearest(name, self.effects)
                raise SettingProblem(f"sensor.{sensor}.effects.{name}: no effect is called {name!r}{hint}")

    def _check_meaning(self, settings: Settings) -> None:
        stated = {key for key in OF_BENCH if getattr(settings.table, key)}
        of_bench = [name for name in self.effects if stated and read_option("effect", name, ()).get("prior") in stated]
        for sensor in SENSORS:
            names = settings.effects.of(sensor)
            self._check_limits(sensor, settings.sensor.of(sensor).effects)
            for name in [] if names == "auto" else names:
                self._check_effect(sensor, name, settings.procedure)
            if names != "auto" and len(set(names)) < len(names):
                raise SettingProblem(f"effects.{sensor} names an effect twice: {', '.join(names)}")
            for name in [] if names == "auto" else [*of_bench, *names]:
                user_effect = self.user_effects.effects.get(name)
                contains = user_effect.contains if user_effect else read_option("effect", name, ()).get("contains", [])
                if within := [other for other in names if other in contains]:
                    raise SettingProblem(f"effects.{sensor} names {name} and {within[0]}, which it contains: name one")
        ingest = repr((settings.ingest, settings.procedure))
        if ingest not in self._valid_ingest:
            check_ingest(settings.ingest, settings.procedure)
            self._valid_ingest.add(ingest)
        for sensor in SENSORS if settings.filter.name in WITHOUT_CONSTANT else ():
            if any(declared(sensor, stage).known for stage in settings.method.stages.of(sensor) or ()):
                raise SettingProblem(
                    f"filter={settings.filter.name} removes the slow changes of a bias, and method.{sensor}="
                    f"{settings.method.of(sensor)} subtracts them: choose another filter or another method"
                )
        if (settings.table.latitude_deg is None) != (settings.table.azimuth_deg is None):
            raise SettingProblem(
                "table.latitude_deg and table.azimuth_deg: set both (Earth's rotation is modelled) or neither (null)"
            )


@lru_cache(maxsize=256)  # commands and notebooks load a campaign several times
def _composed(groups: Groups, folders: Sequence[Path], *_: object) -> dict[Any, Any]:
    """Return what Hydra composes from a choice of groups, with options from the folders of a campaign.

    The other arguments are those that change with the files in these folders. A choice of shipped options is kept in
    the user's cache. Raises ``SettingProblem``.
    """
    if folders:
        return _compose(groups, folders)
    hydra = find_spec("hydra")
    assert hydra is not None and hydra.origin is not None  # noqa: PT018, S101  (for the type checker)
    name = f"configuration-{hashlib.sha256(repr(groups).encode()).hexdigest()[:16]}"
    state = state_of_files([Path(hydra.origin), *CONFIGS.rglob("*.yaml")])
    found = from_cache(name, state)
    if not isinstance(found, dict):
        found = _compose(groups, ())
        to_cache(name, state, found)
    return found


def _compose(groups: Groups, folders: Sequence[Path]) -> dict[Any, Any]:
    from hydra import compose, initialize_config_dir  # noqa: PLC0415  (0.1 s, where the cache lacks a choice)
    from hydra.core.global_hydra import GlobalHydra  # noqa: PLC0415
    from hydra.errors import HydraException  # noqa: PLC0415
    from omegaconf import OmegaConf  # noqa: PLC0415
    from omegaconf.errors import OmegaConfBaseException  # noqa: PLC0415

    overrides = [f"{group}={option}" for group, option in groups]
    if folders:
        overrides.append(f"hydra.searchpath=[{','.join(map(_quoted, folders))}]")
    before = GlobalHydra.instance().hydra  # of a program that uses Hydra and calls this package
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(CONFIGS), version_base="1.3"):
            composed: Any = OmegaConf.to_container(compose("config", overrides), resolve=False)
            return dict(composed)
    except (HydraException, OmegaConfBaseException) as error:
        cause = f" ({error.__cause__})" if error.__cause__ else ""
        raise SettingProblem(f"{str(error).splitlines()[0]}{cause}") from error
    finally:
        GlobalHydra.instance().hydra = before


def _with_known(method: Method, sensors: Sensor) -> Method:
    """Return the method with the known effects of its stages (``known``) by sensor; raises ``SettingProblem``."""
    known = {}
    for sensor in SENSORS:
        declarations = [declared(sensor, stage) for stage in method.stages.of(sensor) or ()]
        try:
            effects = [e for stage in declarations if stage.known for e in stage.known(sensor, sensors.of(sensor))]
        except ConfigurationError as error:
            raise SettingProblem(f"method.{sensor}={method.of(sensor)}: {error.message}") from None
        if effects:
            known[sensor] = [e.to_json() for e in effects]
    return method.replaced(known=known) if known else method


def _with_unused_optional(procedure: Procedure, method: Method) -> Procedure:
    """Return the procedure with optional recordings for a sensor that is not calibrated."""
    unused = {sensor for sensor in SENSORS if method.of(sensor) is None}
    entries = procedure.recordings.items()
    recordings = {name: e.replaced(optional=True) if e.role in unused else e for name, e in entries}
    return procedure.replaced(recordings=recordings) if unused else procedure


def _quoted(folder: Path) -> str:
    """Quote a folder for Hydra's grammar, in which commas, braces and quotes have special meanings."""
    return "'" + re.sub(r"(\\*)('|$)", lambda m: m[1] * 2 + "\\'" * bool(m[2]), f"file://{folder}") + "'"


def _set(tree: dict[str, Any], path: list[str], value: Any) -> None:  # noqa: ANN401
    """Set a value on copies of the branches above it; the schema refuses a key that does not exist later."""
    for i, key in enumerate(path[:-1]):
        node = tree.get(key, {})
        if not isinstance(node, dict):
            raise SettingProblem(f"{'.'.join(path)}: {'.'.join(path[: i + 1])} is a value ({node!r}), it has no keys")
        tree[key] = dict(node)
        tree = tree[key]
    tree[path[-1]] = value


def _explain(error: Any, config: Mapping[str, Any]) -> str:  # noqa: ANN401  (pydantic's TypedDict)
    """Describe an error of pydantic in a sentence with key, value and nearest valid name."""
    *above, last = path = [str(p) for p in error["loc"]]
    shown = json.dumps(error["input"], default=str)
    setting = f"{'.'.join(path)}={shown if len(shown) <= 60 else f'{shown[:57]}...'}"
    if error["type"] != "extra_forbidden":
        return f"{setting}: {error['msg'][0].lower()}{error['msg'][1:]}"
    model: Any = Unit
    parent: Any = config
    for part in above:
        model = getattr(getattr(model, "model_fields", {}).get(part), "annotation", None)
        parent = parent.get(part, {}) if isinstance(parent, dict) else {}
    known = getattr(model, "model_fields", parent)
    return f"{setting}: unknown key{nearest(last, [k for k in known if k not in ('unit', last)])}"


def check_ingest(ingest: Ingest, procedure: Procedure | None = None) -> None:
    """Raise ``ConfigurationError`` for an invalid ingest profile, or if its parts do not match the procedure."""
    mcap_formats(ingest)
    checks_of(ingest)
    if ingest.csv:
        csv_formats(ingest)
    if procedure is not None:
        candidate_files(procedure, ingest)
