"""Configure and run the steps of one unit in memory: a unit of a campaign, or recordings without a campaign.

``UnitResult`` has the documents that a run publishes of the unit, and what they are used for.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from ctypes import CDLL
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.linalg  # noqa: F401  (loads its library of linear algebra, so that ``environment`` limits its threads)
from threadpoolctl import ThreadpoolController, threadpool_limits

from imu_logs import CANONICAL_CSV, load_profile
from imu_logs.units import CANONICAL, SECOND_NS, SINCE_1970_NS, TRIADS
from pipeline.app.config.campaign import Campaign, UnitRow, cut_batches, require_unit
from pipeline.app.config.compose import Composer
from pipeline.app.config.layers import as_list, key_of
from pipeline.app.config.options import PYTHON, RUN_SETTINGS, nearest, parse
from pipeline.app.config.stage_settings import as_job_reads, settings_in_memory
from pipeline.core.errors import (
    ConfigurationError,
    InputError,
    MissingInputError,
    PipelineError,
    as_published,
    failure_of,
    is_of_run,
)
from pipeline.core.files import write_atomically
from pipeline.core.pack import as_bytes
from pipeline.core.records import SENSOR_UNITS, SENSORS, Recording, Values, in_body_axes, maps_of_log
from pipeline.core.settings import Settings, UserEffectFiles
from pipeline.core.verdicts import error_of
from pipeline.ingest.files import candidate_files, wrong_name
from pipeline.ingest.read import IN_MEMORY, of_one_sensor, tried
from pipeline.ingest.recordings_sheet import SHEET, sheet_of_mapping, with_sheet
from pipeline.output.outcome import run_command
from pipeline.physics.compensation import Compensation, compensation_of
from pipeline.physics.effects import registered
from pipeline.unit import Task, UnitFiles, UnitState, run_step, run_steps, tasks_of

if TYPE_CHECKING:
    import pandas as pd

    Paths = Sequence[str | os.PathLike[str]]
    Recordings = str | os.PathLike[str] | Mapping[str, str | os.PathLike[str] | pd.DataFrame]


if sys.platform == "linux":  # else threadpoolctl starts the program ldconfig to find the library, which is loaded
    getattr(ThreadpoolController, "_system_libraries", {}).setdefault("libc", CDLL(None))
NO_EFFECTS = UserEffectFiles(formulas=[], python=[])
NO_CAMPAIGN = Path(__file__).with_name("no_campaign")  # does not exist: no options or effects of a campaign
DIGITS = 5  # significant, of the figures that are printed
WIDTH = 120  # characters of a printed line


@dataclass(frozen=True)
class ConfiguredUnit:
    """A unit with its settings, the files of its recordings, and the stages of the fit of each sensor."""

    row: UnitRow
    files: UnitFiles
    stages: Mapping[str, Sequence[str]]
    run: Mapping[str, Any] = field(default_factory=dict)  # settings of the run that the page states

    def settings(self, task: Task) -> Settings:
        """Return the settings that a task reads, as its job reads them from a file."""
        stage = task.step if task.step != "fit" else "effects" if task.stage == "effects" else "fit"
        return settings_in_memory(self.row, stage, task.sensor, self.run)

    def with_missing(self) -> ConfiguredUnit:
        """Return the unit with all recordings optional."""
        procedure = self.row.config.procedure
        optional = {name: entry.replaced(optional=True) for name, entry in procedure.recordings.items()}
        config = self.row.config.replaced(procedure=procedure.replaced(recordings=optional))
        return replace(self, row=replace(self.row, config=config))

    def with_effects(self, sensor: str, names: Sequence[str]) -> ConfiguredUnit:
        """Return the unit with effects in the model of a sensor, instead of those that are configured."""
        effects = self.row.config.effects.replaced(**{sensor: list(names)})
        return _configured(replace(self.row, config=self.row.config.replaced(effects=effects)), self.files)

    def state(self) -> UnitState:
        """Return the unit before its first step."""
        return UnitState(self.row.name, self.files)

    def run_to(
        self, until: str = "calibration", *, first: str = "ingest", fits: bool = True, state: UnitState | None = None
    ) -> UnitState:
        """Run the steps in memory, from ``first`` to ``until``.

        ``fits``: whether to include the stage ``effects``, the slowest of a fit. ``state``: filled by each step, so
        that it holds what was reached before an error; it holds what the steps before ``first`` returned.
        """
        stages = self.stages if fits else {s: [n for n in names if n != "effects"] for s, names in self.stages.items()}
        with self.environment():
            return run_steps(state or self.state(), tasks_of(stages, until, first=first), self.settings)

    def calibrated(self) -> UnitState:
        """Return the unit after the calibration; an error is that whose code, message and file a run publishes."""
        try:
            return self.run_to("calibration")
        except Exception as error:
            if isinstance(error, PipelineError) or is_of_run(error):
                raise
            raise as_published(error) from error

    @contextmanager
    def environment(self) -> Iterator[None]:
        """Have the unit's own effects in the catalogue, and one thread of the linear algebra, as a job of a run has.

        The order of summation, and so the last digits, depend on the number of threads.
        """
        effects = self.row.config.user_effects
        files = UserEffectFiles.model_validate(as_job_reads(effects.json_value)) if effects else NO_EFFECTS
        with registered(files), threadpool_limits(1, "blas"):
            yield


def try_unit(unit: ConfiguredUnit, until: str, *, fits: bool = True) -> tuple[UnitState, dict[str, Any] | None]:
    """Run the steps of a unit as a run does; return its state, and the failure record of a run, or None."""
    state = unit.state()
    try:
        return unit.run_to(until, fits=fits, state=state), None
    except Exception as error:  # noqa: BLE001  (as in a run)
        return state, failure_of(error, unit.row.name, state.task)


def unit_of_campaign(campaign: Campaign, unit: str) -> ConfiguredUnit:
    """Return a unit of a campaign, as a run of the campaign configures it."""
    require_unit(unit, campaign.units, campaign.directory)
    batch = next(name for name, units in campaign.batches.items() if unit in units)
    files = UnitFiles(campaign.recorded, campaign.folder(unit))
    return ConfiguredUnit(campaign.units[unit], files, campaign.chains[batch], campaign.run_settings(unit))


def notes_of_campaign(campaign: Campaign, unit: str) -> list[str]:
    """Return what a run of the campaign takes from other units, and a unit alone does not."""
    notes = []
    if campaign.combine:
        notes.append(f"combine={campaign.combine}: the other units of the campaign were not used")
    board = campaign.units[unit].row.get("board", "")
    if board in campaign.boards:
        notes.append(f"board {board}: the other chips were not used; how they are mounted is not stated")
    return notes


def require_simulated(campaign: Campaign) -> None:
    """Raise ``MissingInputError`` if the recordings of a campaign are those that its run simulates, and are not there.

    They are not there, either, if the description has changed since: a run then simulates them again.
    """
    if campaign.simulation is None:
        return
    mark = campaign.recorded / ".snakemake_timestamp"
    made = next((file.stat().st_mtime for file in (mark, campaign.recorded) if file.exists()), None)
    if made is None or made < campaign.simulation.stat().st_mtime:
        reason = "they do not exist" if made is None else f"{campaign.simulation.name} has changed since"
        message = f"the recordings of campaign {campaign.name} are simulated by its run, and {reason}"
        results = f"run it: {run_command(campaign.settings)}; a run with other results is named by results=FOLDER"
        raise MissingInputError(f"{message}; {results}", str(campaign.recorded))


def unit_without_campaign(
    recordings: Recordings, chosen: Mapping[str, str | None], overrides: Sequence[str], python_effects: Paths
) -> ConfiguredUnit:
    """Return recordings as a unit; parameters and errors as of ``pipeline.calibrate``.

    ``chosen``: the option of each group, None for its default.
    """
    for group, option in chosen.items():
        if not isinstance(option, str) and (option is not None or group == "sensor"):
            raise ConfigurationError(f"{group}={option!r}: a name is expected, of a file in configs/{group}")
    texts = as_list(overrides, "overrides")
    for text in texts:
        if key_of(text) in RUN_SETTINGS:
            raise ConfigurationError(f"{text}: a setting of a run, which one unit does not have; leave it out")
    files = files_of_effects(python_effects)
    name, folder = "unit", NO_CAMPAIGN
    if isinstance(recordings, str | os.PathLike):
        folder = Path(recordings).resolve()
        name = name if wrong_name(folder.name) else folder.name
    layers = [*(f"{group}={option}" for group, option in chosen.items() if option is not None), *texts]
    row = unit_row(layers, name, files)
    if folder != NO_CAMPAIGN:
        _require_recordings(folder)
        found = UnitFiles(folder, folder)
        row = replace(row, config=with_sheet(row.config, folder))
    else:
        row, found = _of_mapping(row, recordings)
    return _configured(row, found)


def unit_of_recordings(recordings: Sequence[Recording], layers: Sequence[str]) -> ConfiguredUnit:
    """Return the recordings of a simulation as a unit, configured by overrides; raises ``ConfigurationError``."""
    return _configured(unit_row(layers), UnitFiles(NO_CAMPAIGN, NO_CAMPAIGN, recordings=tuple(recordings)))


def unit_row(layers: Sequence[str], name: str = "unit", python_effects: Sequence[str] = ()) -> UnitRow:
    """Return a unit without a campaign, as a run composes and checks its configuration from overrides."""
    composer = Composer(NO_CAMPAIGN, python_effects, below=Path())
    try:
        config = composer.unit(name, layers)
    except ConfigurationError as problem:
        raise ConfigurationError(f"the configuration is refused: {problem}") from problem
    return UnitRow(name, {"unit": name}, config, {key: str(value) for key, value in map(parse, layers)})


def _configured(row: UnitRow, files: UnitFiles) -> ConfiguredUnit:
    _, chains = cut_batches({row.name: row}, 1)
    return ConfiguredUnit(row, files, next(iter(chains.values())))


def files_of_effects(python_effects: Paths) -> list[str]:
    """Return the paths of Python effects as texts."""
    one = isinstance(python_effects, str | os.PathLike)
    texts = [os.fspath(p) if isinstance(p, os.PathLike) else p for p in ([python_effects] if one else python_effects)]
    return as_list(texts, PYTHON, "a list of paths of Python files")


def _require_recordings(folder: Path) -> None:
    """Raise ``InputError`` for a path that is no folder, or is a campaign."""
    expected = "a folder of recordings is expected, or a mapping of their names to files or DataFrames"
    if not folder.exists():
        raise MissingInputError(f"does not exist; {expected}", str(folder))
    if not folder.is_dir():
        raise InputError(f"is no folder; {expected}", str(folder))
    if (folder / "units.csv").is_file():
        raise InputError("is a campaign; pipeline.calibrate_unit(campaign, unit) calibrates a unit of it", str(folder))


def _of_mapping(row: UnitRow, recordings: Any) -> tuple[UnitRow, UnitFiles]:  # noqa: ANN401  (the user's)
    """Return the unit and its files for recordings that are named one by one; those that are not named are absent."""
    if not isinstance(recordings, Mapping):
        kind = type(recordings).__name__
        problem = "recordings: a folder is expected, or a mapping of names to files or DataFrames"
        raise InputError(f"{problem}, for example {{'recording': frame}}; got {kind}")
    procedure = row.config.procedure
    if procedure.sheet is not None:
        procedure = procedure.replaced(recordings=sheet_of_mapping(recordings))
        recordings = {name: recording for name, recording in recordings.items() if name != SHEET}
    known = procedure.recordings
    for name in recordings:
        if name not in known:
            raise ConfigurationError(
                f"no recording of procedure {procedure.name} is called {name!r}{nearest(str(name), known)}"
            )
    lacking = [n for n, entry in known.items() if n not in recordings and not entry.optional]
    if lacking:
        needed = f"procedure {procedure.name} needs them{of_one_sensor(procedure, recordings)}"
        raise MissingInputError(f"missing recordings: {', '.join(lacking)}; {needed}")
    frames = {n: _text_of(n, r) for n, r in recordings.items() if not isinstance(r, str | os.PathLike)}
    paths = {n: str(Path(r).resolve()) for n, r in recordings.items() if n not in frames}
    columns = row.config.ingest.csv.get("columns")
    if frames and not paths and columns and columns != load_profile(CANONICAL_CSV).csv["columns"]:
        message = "describes columns of files; a DataFrame has those of the canonical CSV: leave out the setting"
        raise ConfigurationError(f"ingest={row.config.ingest.name} {message} of ingest")
    entries = {n: e.replaced(file=paths.get(n, e.file)) for n, e in known.items() if n in recordings}
    of_unit = procedure.replaced(recordings=entries)
    for name, candidates in candidate_files(of_unit, row.config.ingest).items():
        if name not in paths or any(os.path.exists(file) for files in candidates for file in files):  # noqa: PTH110
            continue
        if Path(paths[name]).is_dir():
            raise InputError(f"recording {name}: is a folder; a file is expected", paths[name])
        message = f"recording {name}: there is no such file (tried {tried(candidates)})"
        raise MissingInputError(message, paths[name])
    files = UnitFiles(NO_CAMPAIGN, NO_CAMPAIGN, in_memory=frames)
    return replace(row, config=row.config.replaced(procedure=of_unit)), files


def _text_of(name: str, recording: Any) -> bytes:  # noqa: ANN401  (the user's)
    """Return a DataFrame as canonical CSV; raises ``InputError`` for any other object."""
    import pandas as pd  # noqa: PLC0415  (0.4 s, for DataFrames only)

    from imu_logs.text_write import canonical_csv  # noqa: PLC0415  (likewise)

    if not isinstance(recording, pd.DataFrame):
        kind = type(recording).__name__
        raise InputError(f"recording {name}: the path of a file or a pandas DataFrame is expected; got {kind}")
    return canonical_csv(f"{name} {IN_MEMORY}", recording)


@dataclass(frozen=True, eq=False)
class SensorResult:
    """The calibration of one sensor: ``truth = matrix @ (reading - bias - effects)``."""

    unit: str  # g or deg/s
    bias: Values  # (3,), in that unit
    matrix: Values  # (3, 3), dimensionless
    expanded_uncertainty: dict[str, Values]  # of ``bias`` and ``matrix``, 95 %
    effects: dict[str, dict[str, dict[str, Any]]]  # effect to its parameters: value, unit, expanded_uncertainty

    @classmethod
    def of(cls, part: Mapping[str, Any]) -> SensorResult:
        """Return the calibration from a sensor's part of ``calibrations/<unit>.json``."""
        expanded = {name: np.array(part["expanded_uncertainty"][name]) for name in ("bias", "matrix")}
        effects = {effect["name"]: effect["parameters"] for effect in part["effects"]}
        return cls(part["unit"], np.array(part["bias"]), np.array(part["matrix"]), expanded, effects)


@dataclass(frozen=True, eq=False)
class UnitResult:
    """A calibrated unit.

    ``calibration``, ``validation`` and ``diagnosis`` are the documents that a run publishes. ``notes``: what the inputs
    showed, and what a run would take from other units.
    """

    calibration: dict[str, Any]
    validation: dict[str, Any]
    diagnosis: dict[str, Any]
    notes: list[str]
    _configured: ConfiguredUnit = field(repr=False)
    _state: UnitState = field(repr=False)

    @classmethod
    def of(cls, configured: ConfiguredUnit, state: UnitState, notes: Sequence[str] = ()) -> UnitResult:
        """Return the result of a unit after its steps."""
        # As read from the published files, in which a tuple is a list and a number of numpy a number.
        documents = (state.calibration, state.validation, state.diagnosis)
        calibration, validation, diagnosis = (json.loads(as_bytes(document)) for document in documents)
        of_inputs = [f"{i['recording']}: {n['detail']}" for i in calibration["inputs"] for n in i["notes"]]
        told = [*notes, *dict.fromkeys(of_inputs)]
        return cls(calibration, validation, diagnosis, told, configured, state)

    @property
    def accelerometer(self) -> SensorResult | None:
        """Calibration of the accelerometer; None if it is not calibrated."""
        return self._part("accelerometer")

    @property
    def gyroscope(self) -> SensorResult | None:
        """Calibration of the gyroscope; None if it is not calibrated."""
        return self._part("gyroscope")

    def _part(self, sensor: str) -> SensorResult | None:
        part = self.calibration[sensor]
        return SensorResult.of(part) if part else None

    @property
    def verdict(self) -> dict[str, str]:
        """Verdict on each calibrated sensor."""
        return {s: self.diagnosis[s]["verdict"] for s in SENSORS if self.calibration[s] and self.diagnosis[s]}

    @cached_property
    def _compensation(self) -> Compensation:
        return compensation_of(self.calibration)

    def apply(self, log: pd.DataFrame) -> pd.DataFrame:
        """Return a log with calibrated readings: the same columns, in the same order, and the same index.

        Columns are those of the canonical CSV, with the axes of the recordings (``sensor.axis_map``); calibrated
        readings are in body axes. A sensor that the log does not contain, or that is not calibrated, and all other
        columns are unchanged. Raises ``InputError`` where an effect needs a column that is absent, and where nothing
        would be calibrated.
        """
        signals = self._signals(log)
        with self._configured.environment():
            stream = self._compensation.stream()
            try:
                found = stream.apply(**signals)
            except InputError as error:
                lacking = {**{s: TRIADS[s] for s in SENSORS}, "temperature": ["temperature"], "time": ["time"]}
                names = [CANONICAL[c] for s in sorted(stream.needs - set(signals)) for c in lacking[s]]
                raise InputError(f"{error.message}; the log has no column {', '.join(names)}") from None
        out = log.copy()
        for sensor in (s for s in SENSORS if s in signals and self.calibration[s]):
            out[[CANONICAL[channel] for channel in TRIADS[sensor]]] = getattr(found, sensor)
        return out

    def _signals(self, log: pd.DataFrame) -> dict[str, Any]:
        """Return the signals of a log: (n, 3) readings in body axes, (n,) temperature and time."""
        import pandas as pd  # noqa: PLC0415  (who calls this has imported it)

        if not isinstance(log, pd.DataFrame):
            raise InputError(f"a pandas DataFrame is expected; got {type(log).__name__}")
        columns = {s: [CANONICAL[channel] for channel in TRIADS[s]] for s in SENSORS}
        known = {s: names for s, names in columns.items() if set(names) & set(log.columns)}
        scalars = [CANONICAL[signal] for signal in ("temperature", "time")]
        if lacking := [n for names in known.values() for n in names if n not in log]:
            raise InputError(f"the log has no column {', '.join(lacking)}; the three of a sensor are expected")
        used = [n for n in (*columns["accelerometer"], *columns["gyroscope"], *scalars) if n in log]
        for name in used:
            if log.columns.get_loc(name).__class__ is not int:
                raise InputError(f"the log has more than one column {name}")
            if log[name].dtype.kind not in "iuf":
                raise InputError(f"column {name} of the log has the dtype {log[name].dtype}; numbers are expected")
        reasons = [f"{s}: {self.calibration['not_calibrated'].get(s, '')}" for s in known if not self.calibration[s]]
        if len(reasons) == len(known):
            expected = ", ".join(name for s in SENSORS if self.calibration[s] for name in columns[s])
            why = f" (not calibrated: {'; '.join(reasons)})" if reasons else ""
            raise InputError(f"the log has no column of a calibrated sensor; expected {expected}{why}")
        maps = maps_of_log(self.calibration["log"])
        values = {n: log[n].to_numpy(np.float64, na_value=np.nan) for n in used}
        signals = {s: in_body_axes(maps[s], np.column_stack([values[n] for n in names])) for s, names in known.items()}
        temperature, time = (values.get(name) for name in scalars)
        if time is not None and len(time) and time[0] * SECOND_NS > SINCE_1970_NS:
            time = time - time[0]  # as the command apply counts it
        return signals | {k: v for k, v in (("temperature", temperature), ("time", time)) if v is not None}

    def _files(self) -> dict[str, Any]:
        """Return the files that a run publishes of the unit, by their path in a results folder."""
        unit, diagnosed = self.calibration["unit"], self._state.diagnosed
        pages = self._made("report").items()
        return {
            f"calibrations/{unit}.json": self.calibration,
            f"validations/{unit}.json": self.validation,
            f"diagnoses/{unit}.json": self.diagnosis,
            **{f"diagnoses/{name}": text for name, text in diagnosed.effect_files.items()},
            **{f"exports/{unit}/{name}": text for name, text in self._made("export").items()},
            **{name if name.startswith("certificates/") else f"reports/{name}": page for name, page in pages},
        }

    def _made(self, step: str) -> Any:  # noqa: ANN401  (each step has its type)
        task = Task(step)
        with self._configured.environment():
            return run_step(task, self._state, self._configured.settings(task))

    def save(self, folder: str | Path) -> None:
        """Write the files that a run publishes of the unit into a folder, in the layout of a results folder."""
        for name, content in self._files().items():
            path = Path(folder, name)
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(path, as_bytes(content))

    def report(self, path: str | Path) -> None:
        """Write the page of the unit, one HTML file that opens without a network."""
        page = self._made("report")[f"{self.calibration['unit']}.html"]
        write_atomically(Path(path), as_bytes(page))

    def __repr__(self) -> str:
        """Return bias, matrix, effects, held-out error and verdict of each sensor, in at most 16 lines."""
        document = self.calibration
        lines = [f"{document['unit']}: {document['sensor']}, {document['procedure']}, {document['method']}"]
        for sensor in SENSORS:
            part = self._part(sensor)
            if part is None:
                lines.append(f"{sensor}: null, {document['not_calibrated'].get(sensor, '')}")
                continue
            missing = self.diagnosis[sensor]["selected"] if self.diagnosis[sensor] else []
            missing = [name for name in missing if name not in part.effects]
            told = f" ({', '.join(missing)})" if missing else ""
            lines.append(f"{sensor}: {self.verdict.get(sensor, '')}{told}")
            lines.append(f"  bias {_row(part.bias)} {SENSOR_UNITS[sensor]}")
            lines += [f"  {'matrix' if i == 0 else '      '} {_row(row)}" for i, row in enumerate(part.matrix)]
            lines += [f"  effects {', '.join(part.effects)}"] if part.effects else []
            lines.append(f"  held-out error {self._held_out(sensor)}")
        return "\n".join(line if len(line) <= WIDTH else f"{line[: WIDTH - 3]}..." for line in lines)

    def _held_out(self, sensor: str) -> str:
        held_out, unit = self.validation[sensor], SENSOR_UNITS[sensor]
        if not held_out or not held_out["held_out"]:
            return "not known: no held-out motion"
        error = error_of(held_out)
        noise = f", {error.ratio:.3g} times the noise floor" if error.ratio else ""
        return f"of the {error.kind} {error.before:.3g} -> {error.after:.3g} {unit}{noise}"


def _row(values: Values) -> str:
    return " ".join(f"{value: .{DIGITS}g}" for value in values)
