"""The command guide on a recording: its rests, the next one, and whether the recording is sufficient."""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipeline.app.commands.readings import Reading, campaign_of, complete_rows, config_of_log, recordings_of_files
from pipeline.app.config.campaign import load_campaign
from pipeline.app.guide import (
    MAX_PLANNED_RESTS,
    GuideProgress,
    ProposedTurn,
    default_goal,
    fitted_by_hand,
    in_words,
    most_informative_turn,
    next_face_or_turn,
    progress_of,
    propose,
)
from pipeline.core.errors import CannotCalibrateError, ConfigurationError, PipelineError
from pipeline.core.records import NotCalibrated, Recording, Values
from pipeline.core.settings import RecordingFile, Settings
from pipeline.estimation.rest_means import is_multi_position
from pipeline.ingest.files import grouped, recording_files
from pipeline.physics.signal.rests import WINDOW_S, Rest, find_rests
from pipeline.unit import Task, UnitFiles, UnitState, run_steps

POLL_S = 1.0  # between two readings of a growing log: short against a rest
STILL_RESTING_S = 1.0  # from the end of a rest to that of the log, below which the rest may continue
FIRST = ProposedTurn(0, 2, 180.0)  # about x, while nothing of the gyroscope is known


@dataclass(frozen=True)
class Source:
    """The files of a unit's recordings, and the configuration by which they are read."""

    config: Settings
    folder: Path | None  # of a campaign's unit
    files: tuple[Path, ...]  # on the command line

    def entries(self) -> dict[str, tuple[RecordingFile, list[Path]]]:
        """Return the entry and the files of each recording that exists."""
        if self.folder is not None:
            procedure = self.config.procedure
            found = recording_files(procedure, self.config.ingest, self.folder)
            return {name: (procedure.recordings[name], files) for name, files in found.items()}
        groups = [group for group in grouped(self.files, self.config.ingest) if all(f.exists() for f in group)]
        return {g[0].stem: (RecordingFile(file=g[0].stem, role="rests", axis=None, optional=False), g) for g in groups}

    def read(self, *, growing: bool) -> list[Recording]:
        """Return the recordings after ingest, of which no turn is held out; of a growing log the complete rows."""
        entries, ingest = self.entries(), self.config.ingest
        if growing and ingest.mcap:
            ingest = ingest.replaced(mcap={**ingest.mcap, "allow_truncated": True})
        named = {name: entry for name, (entry, _) in entries.items()}
        procedure = self.config.procedure.replaced(recordings=named, turns=None)
        settings = self.config.replaced(ingest=ingest, procedure=procedure)
        whole = []
        with tempfile.TemporaryDirectory() as folder:
            for name, (entry, files) in entries.items():
                rows = [complete_rows(f, Path(folder)) for f in files] if growing else files
                role = "rests" if entry.role == "session" and not entry.windows else entry.role
                whole.append(Reading(rows, name, entry.replaced(role=role), settings).recording())
        unit = UnitState("unit", UnitFiles(Path(), Path(), recordings=whole))
        return run_steps(unit, iter([Task("ingest")]), lambda _: settings).checked or [] if whole else []


def guide_recording(arguments: argparse.Namespace) -> int:
    """Run ``python -m pipeline guide`` with its options; return the exit code."""
    source = _source(arguments)
    config, faces = source.config, source.config.procedure.faces
    if faces and (arguments.goal or arguments.gyroscope_goal):
        raise ConfigurationError(
            f"procedure {config.procedure.name} needs given faces and turns, whatever their uncertainty: leave out "
            "--goal and --gyroscope-goal, or take --procedure multi_position"
        )
    data_sheet, gravity = config.sensor.accelerometer, config.table.gravity_g
    goal = 1e-3 * arguments.goal if arguments.goal else default_goal(data_sheet, gravity, arguments.dwell)
    goals = Goals(goal, arguments.gyroscope_goal)
    if arguments.goal is None and not faces:
        what = f"what 24 rests 45 deg apart reach with the noise of the sensor file {config.sensor.name}"
        print(f"goal: {1e3 * goal:g} mg, {what}")
    left_out = config.effects.accelerometer
    if left_out and not faces:
        names = left_out if isinstance(left_out, str) else ", ".join(left_out)
        print(f"the accelerometer is forecast without its configured effects: {names}")
    if not arguments.follow:
        missing = [str(f) for f in source.files if not f.exists()]
        if missing:
            raise ConfigurationError(f"there is no file {', '.join(missing)}; --follow waits for one")
        advice = _advice(source.read(growing=False), config, goals, arguments.dwell)
        print("\n".join([*(rest.text for rest in advice.rests), *_held_out(source), *advice.words]))
        return 0
    if source.folder is not None and any(entry.windows for entry in config.procedure.recordings.values()):
        name = config.procedure.name
        raise ConfigurationError(f"procedure {name} states windows, so the recording must be complete: omit --follow")
    for line in _held_out(source):
        print(line, flush=True)
    _follow(source, goals, arguments.dwell)
    return 0


def _source(arguments: argparse.Namespace) -> Source:
    for option in ("goal", "gyroscope_goal", "dwell"):
        value = getattr(arguments, option)
        if value is not None and not value > 0.0:
            raise ConfigurationError(f"--{option.replace('_', '-')} is {value:g}; it must be above 0")
    first, campaign = arguments.files[0], campaign_of(arguments.files[0])
    files = tuple(arguments.files)
    if campaign is not None and not (arguments.sensor or arguments.procedure or arguments.ingest):
        loaded = load_campaign({"campaign": str(campaign)})
        if first.name in {unit.config.procedure.sheet for unit in loaded.units.values()}:
            raise ConfigurationError("this is a sheet; guide needs the recordings that it lists", str(first))
        for unit in recordings_of_files([first], loaded, [*loaded.units])[0]:
            return Source(_by_hand(loaded.units[unit].config), loaded.folder(unit), files)
    more = [f"procedure={arguments.procedure}"] if arguments.procedure else []
    return Source(_by_hand(config_of_log(first, arguments.ingest, arguments.sensor, more)), None, files)


def _by_hand(config: Settings) -> Settings:
    """Return a configuration whose procedure is recorded by hand; its recording gets as many rests as are needed."""
    procedure = config.procedure
    if config.table.motion != "none":
        raise ConfigurationError(
            f"procedure {procedure.name} is recorded on a table; guide is for those recorded by hand: "
            "multi_position, orientations_24, six_positions, ferraris (docs/record.md)"
        )
    return config.replaced(procedure=procedure.replaced(holdout_from=0))


def _held_out(source: Source) -> list[str]:
    """Return which rests are held out of the fit, and why; empty for a procedure of given faces and turns."""
    every = source.config.procedure.holdout_every
    if source.config.procedure.faces:
        return []
    entries = [entry for entry, _ in source.entries().values()]
    if any(part.role == "validation" for entry in entries for part in [entry, *(entry.windows or ())]):
        return ["no rest is held out of the fit: the recording for validation judges it"]
    if not every:
        return ["no rest is held out of the fit: procedure.holdout_every is 0"]
    held = f"one of {every} rests is held out of the fit, to judge it: there is no recording for validation"
    return [f"{held} (a run does so from holdout_from rests on)"]


class RestLine(NamedTuple):
    """The printed line on a rest."""

    recording: str
    start: float  # s; with the recording it identifies the rest, since its number may change
    stop: float  # s
    number: int  # 0 where the rest is left out
    use: str  # "in the fit", "held out" or "left out"
    text: str

    def overlaps(self, other: RestLine) -> bool:
        """Return whether both are the same rest: its start and end may change while the log grows."""
        return self.recording == other.recording and self.start < other.stop and other.start < self.stop


class Advice(NamedTuple):
    """The messages on the recordings so far."""

    enough: bool
    rests: list[RestLine]
    words: list[str]


class Goals(NamedTuple):
    """Largest expanded uncertainties that are sufficient."""

    accelerometer: float  # g
    gyroscope: float | None  # per cent of the matrix; None: no goal


def _advice(recordings: Sequence[Recording], config: Settings, goals: Goals, dwell: float) -> Advice:
    if config.procedure.faces:
        done, words = next_face_or_turn(recordings, config.procedure, dwell)
        return Advice(done, [], words)
    unit = fitted_by_hand(recordings, config, gyroscope=goals.gyroscope is not None)
    progress = progress_of(unit, config, dwell)
    rows = zip(progress.rests, progress.up, progress.held_out, strict=True)
    lines = []
    for k, ((r, rest), up, held) in enumerate(rows, start=1):
        start, stop = _span(r, rest)
        text = f"{k:>4}  {r.name} {start:.1f} to {stop:.1f} s: {in_words(up)}{' (held out)' if held else ''}"
        lines.append(RestLine(r.name, start, stop, k, "held out" if held else "in the fit", text))
    for r, rest in progress.left_out:
        start, stop = _span(r, rest)
        text = f"   -  {r.name} {start:.1f} s: left out: {rest.reason}"
        lines.append(RestLine(r.name, start, stop, 0, "left out", text))
    done, words = _next(progress, goals.accelerometer, dwell)
    if goals.gyroscope is None:
        return Advice(done, lines, words)
    reached, of_gyroscope = _next_turn(unit, config, progress, goals.gyroscope, dwell)
    if done:
        return Advice(reached, lines, of_gyroscope)
    later = "" if reached else "; turns for it are proposed once the accelerometer's goal is reached"
    return Advice(enough=False, rests=lines, words=[*words, of_gyroscope[0] + later])


def _next_turn(
    unit: UnitState, config: Settings, progress: GuideProgress, goal: float, dwell: float
) -> tuple[bool, list[str]]:
    """Return whether the gyroscope's goal is reached, and the next turn in words."""
    found = unit.fits["gyroscope"]
    if isinstance(found, NotCalibrated):
        assert unit.recordings is not None  # noqa: S101
        if not is_multi_position("gyroscope", unit.recordings.filtered):
            raise CannotCalibrateError(found.reason)
        now = f"gyroscope's matrix: not determined yet: {found.reason.partition(': ')[0]} (goal {goal:g} %)"
        return False, [now, f"next: {FIRST.in_words(dwell)}"]
    expanded = 100.0 * float(np.max(found.to_json()["expanded_uncertainty"]["matrix"]))
    now = f"expanded uncertainty of the gyroscope's matrix: {expanded:.2g} % (goal {goal:g} %)"
    if expanded <= goal:
        return True, [now, "enough: both goals are reached"]
    turn = most_informative_turn(found, float(np.sqrt(2.0)) * progress.error / config.table.gravity_g)
    return False, [now, f"next: {turn.in_words(dwell)}"]


def _span(recording: Recording, rest: Rest) -> tuple[float, float]:
    """Return start and end of a rest, s."""
    return float(recording.time[rest.start]), float(recording.time[rest.stop - 1])


def _next(progress: GuideProgress, goal: float, dwell: float) -> tuple[bool, list[str]]:
    held = sum(progress.held_out)
    count = f"{progress.used} rests of the fit, {held} held out"
    reason = progress.reason.partition(": ")[0]
    now = f"not determined yet: {reason}" if reason else f"{1e3 * progress.expanded:.3g} mg"
    lines = [f"expanded uncertainty: {now} ({count}; goal {1e3 * goal:.3g} mg)"]
    proposal = propose(progress, goal)
    if not proposal.further:
        return True, [*lines, "enough: the goal is reached"]
    lines.append(f"next: {in_words(proposal.up)}; rest it for {dwell:g} s")
    if progress.next_is_held_out:
        lines.append("      (held out of the fit, to judge it: an attitude far from all others)")
    elif repeated := _repeated_attitude(progress, proposal.up):
        lines.append(f"      ({repeated})")
    if proposal.expected > goal:
        lines.append(
            f"expected: {1e3 * proposal.expected:.3g} mg after {MAX_PLANNED_RESTS} more rests, so the goal is out of "
            "reach: rest longer (--dwell) and more firmly, or choose a larger --goal"
        )
    else:
        lines.append(f"expected: {1e3 * proposal.expected:.3g} mg after {proposal.further} more rests of the fit")
    return False, lines


def _repeated_attitude(progress: GuideProgress, up: Values) -> str:
    """Return why an attitude is proposed that was recorded before; empty if no rest is near it."""
    near = progress.near(up)
    if not near:
        return ""
    of_fit = [i for i in near if not progress.held_out[i]]
    i = (of_fit or near)[-1]
    known = f"rest {i + 1} ({progress.rests[i][0].name} {_span(*progress.rests[i])[0]:.1f} s) is near this attitude"
    if of_fit:
        return f"{known}; of all attitudes another rest there still reduces the uncertainty most"
    return f"{known}, but it is held out: the fit needs one there"


def _follow(source: Source, goals: Goals, dwell: float) -> None:
    """Read a growing log repeatedly and print what is new, until the goal is reached."""
    printed: list[RestLine] = []
    advice: Advice | None = None
    last, waiting, state = "", "", "no rest was read"
    bell = "\a" if sys.stdout.isatty() else ""
    try:
        while True:
            try:
                recordings = [_without_last_rest(r, dwell) for r in source.read(growing=True)]
                problem = "" if recordings else f"there is no file {source.files[0]} yet"
                advice = _advice(recordings, source.config, goals, dwell) if recordings else None
            except CannotCalibrateError:
                raise
            except PipelineError as error:
                advice, problem = None, error.message
            if problem and problem != waiting:
                print(f"waiting: {problem}", flush=True)
            waiting = problem
            if advice is not None:
                state = advice.words[0]
                new = any(not any(rest.overlaps(other) for other in printed) for rest in advice.rests)
                if new or advice.enough or not last or (not advice.rests and advice.words[-1] != last):
                    lines, printed = _news(advice.rests, printed)
                    print("\n".join([*lines, *advice.words]) + bell, flush=True)
                    last = advice.words[-1]
                    if advice.enough:
                        return
            time.sleep(POLL_S)
    except KeyboardInterrupt:
        changes = _news(advice.rests, printed)[0] if advice is not None else []
        print("\n".join(["", *changes, f"ended before it was enough: {state}"]))


def _news(rests: Sequence[RestLine], printed: Sequence[RestLine]) -> tuple[list[str], list[RestLine]]:
    """Return the lines on new rests and on those whose use changed, and the rests that are then printed.

    The use of a rest may change while the log grows: its rate is compared with that of its neighbours, and the limit of
    a quiet window follows from the whole log. If a rest is admitted or left out, all later ones have other numbers, so
    that other rests are held out. The changes are printed together with the next new rest.
    """
    changed, numbers, new, known = [], [], [], list(printed)
    for rest in rests:
        before = next((t for t in known if rest.overlaps(t)), None)
        if before is None:
            new.append(rest.text)
            continue
        known.remove(before)
        number = f" as number {before.number}" if before.number not in {0, rest.number} else ""
        if before.use != rest.use:
            changed.append(f"{rest.text}; before it was {before.use}{number}")
        elif number:
            numbers.append(f"{before.number} ({rest.recording} {rest.start:.1f} s) is now {rest.number}")
    gone = [t for t in known if any(r.recording == t.recording and r.start >= t.stop for r in rests)]
    changed += [f"   -  {t.recording} {t.start:.1f} s: no longer a separate rest; before it was {t.use}" for t in gone]
    renumbered = [f"      numbers: {', '.join(numbers)}"] if numbers else []
    return [*changed, *renumbered, *new], [*rests, *(t for t in known if t not in gone)]


def _without_last_rest(recording: Recording, dwell: float) -> Recording:
    """Return a recording without a rest at its end that may continue and is still shorter than ``dwell``."""
    rests = find_rests(recording) if recording.role == "rests" else []
    if not rests:
        return recording
    start, stop, end = recording.time[[rests[-1].start, rests[-1].stop - 1, -1]]
    continues = end - stop < STILL_RESTING_S and stop - start < dwell - WINDOW_S
    return recording.select(slice(0, max(rests[-1].start, 1))) if continues else recording
