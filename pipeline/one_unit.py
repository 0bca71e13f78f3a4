"""Configure and run the steps of one unit in memory: a unit of a campaign, or recordings without a campaign."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from threadpoolctl import threadpool_limits

from pipeline.config.campaign import Campaign, UnitRow, cut_batches, run_settings
from pipeline.config.compose import Composer
from pipeline.config.options import RUN_SETTINGS, Problem, nearest, parse
from pipeline.config.stage_settings import as_job_reads, settings_of_unit
from pipeline.errors import ConfigurationError, InputError, MissingInputError, failure_of
from pipeline.io.files import UNIT_NAME
from pipeline.model.effects import registered
from pipeline.unit import Task, UnitFiles, UnitState, run_steps, tasks_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    import pandas as pd

    from pipeline.records import Recording

NO_CAMPAIGN = Path(__file__).with_name("no_campaign")  # does not exist: no options or effects of a campaign


@dataclass(frozen=True)
class ConfiguredUnit:
    """A unit with its settings, the files of its recordings, and the stages of the fit of each sensor."""

    row: UnitRow
    files: UnitFiles
    stages: Mapping[str, Sequence[str]]
    run: Mapping[str, Any] = field(default_factory=dict)  # settings of the run that the page states

    def settings(self, task: Task) -> dict[str, Any]:
        """Return the settings that a task reads."""
        stage = task.step if task.step != "fit" else "effects" if task.stage == "effects" else "fit"
        settings = settings_of_unit(self.row, stage, task.sensor)
        return as_job_reads(settings | {"run": dict(self.run)} if self.run and stage == "report" else settings)

    def with_missing(self) -> ConfiguredUnit:
        """Return the unit with all recordings optional."""
        procedure = self.row.config["procedure"]
        optional = {name: {**entry, "optional": True} for name, entry in procedure["recordings"].items()}
        config = {**self.row.config, "procedure": {**procedure, "recordings": optional}}
        return replace(self, row=replace(self.row, config=config))

    def with_effects(self, sensor: str, names: Sequence[str]) -> ConfiguredUnit:
        """Return the unit with effects in the model of a sensor, instead of those that are configured."""
        effects = {**self.row.config["effects"], sensor: list(names)}
        return _configured(replace(self.row, config={**self.row.config, "effects": effects}), self.files)

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

    @contextmanager
    def environment(self) -> Iterator[None]:
        """Have the unit's own effects in the catalogue, and one thread of the linear algebra, as a job of a run has.

        The order of summation, and so the last digits, depend on the number of threads.
        """
        with registered(self.row.config.get("user_effects", {})), threadpool_limits(1, "blas"):
            yield


@dataclass
class Trial:
    """A unit after the steps that were tried, and the failure record of a run; None if no step failed."""

    state: UnitState
    failure: dict[str, Any] | None = None


def try_unit(unit: ConfiguredUnit, until: str, *, fits: bool = True) -> Trial:
    """Run the steps of a unit as a run does, where an error stops only this unit."""
    state = unit.state()
    try:
        return Trial(unit.run_to(until, fits=fits, state=state))
    except Exception as error:  # noqa: BLE001  (as in a run)
        return Trial(state, failure_of(error, unit.row.name, until))


def unit_of_campaign(campaign: Campaign, unit: str) -> ConfiguredUnit:
    """Return a unit of a campaign, as a run of the campaign configures it."""
    if unit not in campaign.units:
        message = f"no unit {unit!r}{nearest(unit, campaign.units)}"
        raise ConfigurationError(message, str(campaign.directory / "units.csv"))
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


def unit_without_campaign(
    recordings: str | Path | Mapping[str, str | Path | pd.DataFrame], layers: Sequence[str]
) -> ConfiguredUnit:
    """Return recordings as a unit, configured by overrides, weakest first; raises ``ConfigurationError``.

    ``recordings``: a folder with the files that the procedure names, or the files or DataFrames (columns of the
    canonical CSV) of the recordings by their names.
    """
    folder = Path() if not isinstance(recordings, str | Path) else Path(recordings).resolve()
    name = folder.name if folder.name and UNIT_NAME.fullmatch(folder.name) else "unit"
    row, files = unit_row(layers, name), UnitFiles(folder, folder)
    if not isinstance(recordings, str | Path):
        row, files = _of_mapping(row, recordings)
    elif not folder.is_dir():
        raise InputError("is no folder; a folder of recordings is expected, or a mapping of names to them", str(folder))
    return _configured(row, files)


def unit_of_recordings(recordings: Sequence[Recording], layers: Sequence[str]) -> ConfiguredUnit:
    """Return the recordings of a simulation as a unit, configured by overrides; raises ``ConfigurationError``."""
    return _configured(unit_row(layers), UnitFiles(NO_CAMPAIGN, NO_CAMPAIGN, recordings=tuple(recordings)))


def unit_row(layers: Sequence[str], name: str = "unit") -> UnitRow:
    """Return a unit without a campaign, as a run composes and checks its configuration from overrides."""
    run = [text for text in layers if text.partition("=")[0].strip() in RUN_SETTINGS]
    run_settings(run)  # refuses values that no run accepts
    texts = [text for text in layers if text not in run]
    try:
        values = dict(map(parse, texts))
        config = Composer(NO_CAMPAIGN).unit(name, texts)
    except Problem as problem:
        raise ConfigurationError(f"the configuration is refused: {problem}") from problem
    return UnitRow(name, {"unit": name}, config, {k: str(v) for k, v in values.items()})


def _configured(row: UnitRow, files: UnitFiles) -> ConfiguredUnit:
    _, chains = cut_batches({row.name: row}, 1)
    return ConfiguredUnit(row, files, next(iter(chains.values())))


def _of_mapping(row: UnitRow, recordings: Mapping[str, str | Path | pd.DataFrame]) -> tuple[UnitRow, UnitFiles]:
    """Return the unit and its files for recordings that are named one by one; those that are not named are absent."""
    procedure = row.config["procedure"]
    known = procedure["recordings"]
    for name in recordings:
        if name not in known:
            raise ConfigurationError(
                f"no recording of procedure {procedure['name']} is called {name!r}{nearest(str(name), known)}"
            )
    lacking = [n for n, entry in known.items() if n not in recordings and not entry.get("optional", False)]
    if lacking:
        raise MissingInputError(f"missing recordings: {', '.join(lacking)}; procedure {procedure['name']} needs them")
    paths = {n: Path(r).resolve() for n, r in recordings.items() if isinstance(r, str | Path)}
    # A float is written by its shortest text that reads back as the same float.
    texts = {n: r.to_csv(index=False).encode() for n, r in recordings.items() if not isinstance(r, str | Path)}
    entries = {n: {**known[n], "file": str(paths[n])} if n in paths else known[n] for n in known if n in recordings}
    config = {**row.config, "procedure": {**procedure, "recordings": entries}}
    return replace(row, config=config), UnitFiles(NO_CAMPAIGN, NO_CAMPAIGN, in_memory=texts)
