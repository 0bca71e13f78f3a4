"""Propose the next rest or turn of a recording by hand, and state when the recording is sufficient."""

from __future__ import annotations

import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pipeline.commands import parser_of
from pipeline.commands.readings import campaign_of, config_of_log, grouped, recordings_of_files
from pipeline.config.campaign import load_campaign
from pipeline.errors import CannotCalibrateError, ConfigurationError, NotObservableError, PipelineError
from pipeline.estimation.gyroscope import rests_and_moves
from pipeline.estimation.rest_means import is_multi_position
from pipeline.io.files import MESSAGE_FORMATS, recording_files
from pipeline.io.ingest_settings import checks_of
from pipeline.io.read import read_table, to_recording
from pipeline.planning.guide import (
    MOST,
    Turn,
    default_goal,
    in_words,
    most_informative_turn,
    next_face_or_turn,
    progress_of,
    propose,
)
from pipeline.preprocessing.checks import check_recordings
from pipeline.signal.rests import NEIGHBOURS, WINDOW_S, find_rests
from pipeline.simulation.description import BY_HAND

if TYPE_CHECKING:
    import argparse
    from collections.abc import Sequence

    from pipeline.planning.guide import Progress
    from pipeline.records import Recording
    from pipeline.signal.rests import Rest

POLL_S = 1.0  # between two looks at a growing log: short against a rest
STILL_RESTING_S = 1.0  # from a rest's end to that of the log, below which the rest may go on
FIRST = Turn(0, 2, 180.0)  # about x, while nothing of the gyroscope is known
EPILOG = """\
The next rest is the one that reduces the uncertainty of the accelerometer's calibration most. The goal is reached when
the largest expanded uncertainty (95 %) of the bias, in mg, and of the matrix, in mg at 1 g, is below --goal. With
--gyroscope-goal, turns for the gyroscope's matrix follow (method=rests_and_moves); until then each message states its
uncertainty. With --procedure ferraris, the next
missing face or turn is named. docs/record.md shows the names of the attitudes.

A recording of a campaign is read as the campaign's configuration says, together with the unit's other recordings. Any
other file is read by --sensor, --ingest and --procedure.

examples:
  python -m pipeline guide data/my_bench/raw/U1/recording.csv --follow
  python -m pipeline guide log.csv --sensor mpu6050 --goal 0.3
  python -m pipeline guide log.mcap --sensor mpu6050 --ingest mcap --follow
"""


@dataclass(frozen=True)
class Source:
    """The files of a unit's recordings, and the configuration by which they are read."""

    config: dict[str, Any]
    folder: Path | None  # of a campaign's unit
    files: tuple[Path, ...]  # that were named

    def entries(self) -> dict[str, tuple[dict[str, Any], list[Path]]]:
        """Return role and files of each recording that exists."""
        if self.folder is not None:
            procedure = self.config["procedure"]
            found = recording_files(procedure, self.config["ingest"], self.folder)
            return {name: (_whole(procedure["recordings"][name]), files) for name, files in found.items()}
        groups = [group for group in grouped(self.files, self.config["ingest"]) if all(f.exists() for f in group)]
        return {group[0].stem: ({"role": "rests", "axis": None}, group) for group in groups}

    def read(self, *, growing: bool) -> list[Recording]:
        """Return the recordings; of a growing log the complete rows or chunks."""
        entries, ingest = self.entries(), self.config["ingest"]
        if growing and ingest.get("mcap"):
            ingest = {**ingest, "mcap": {**ingest["mcap"], "allow_truncated": True}}
        procedure = {**self.config["procedure"], "recordings": {n: entry for n, (entry, _) in entries.items()}}
        settings = {**self.config, "ingest": ingest, "procedure": procedure}
        recordings = []
        with tempfile.TemporaryDirectory() as folder:
            for name, (entry, files) in entries.items():
                whole = [_complete_rows(f, Path(folder)) for f in files] if growing else files
                table = read_table(whole, ingest)
                recordings.append(to_recording(name, entry, table, self.config["sensor"], checks_of(ingest)))
        return check_recordings(recordings, settings) if recordings else []


def main(argv: Sequence[str]) -> int:
    """Run ``python -m pipeline guide RECORDING...``."""
    arguments = _parser().parse_args(argv)
    source = _source(arguments)
    faces = source.config["procedure"].get("faces")
    if faces and (arguments.goal or arguments.gyroscope_goal):
        name = source.config["procedure"]["name"]
        raise ConfigurationError(
            f"procedure {name} needs given faces and turns, whatever their uncertainty: leave out --goal and "
            "--gyroscope-goal, or take --procedure multi_position"
        )
    sensor_config = source.config["sensor"]["accelerometer"]
    gravity = float(source.config["table"].get("gravity_g") or 1.0)
    goal = 1e-3 * arguments.goal if arguments.goal else default_goal(sensor_config, gravity, arguments.dwell)
    goals = Goals(goal, arguments.gyroscope_goal)
    if arguments.goal is None and not faces:
        name = source.config["sensor"]["name"]
        print(f"goal: {1e3 * goal:g} mg, what 24 rests 45 deg apart reach with the noise of the sensor file {name}")
    if not arguments.follow:
        missing = [str(f) for f in source.files if not f.exists()]
        if missing:
            raise ConfigurationError(f"there is no file {', '.join(missing)}; --follow waits for one")
        advice = _advice(source.read(growing=False), source.config, goals, arguments.dwell)
        print("\n".join([*(rest.text for rest in advice.rests), *_held_out(source), *advice.words]))
        return 0
    for line in _held_out(source):
        print(line, flush=True)
    _follow(source, goals, arguments.dwell)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = parser_of("guide", __doc__, EPILOG, ("--sensor", "--ingest"))
    add = parser.add_argument
    add("files", type=Path, nargs="+", metavar="RECORDING", help="recordings of one unit, made by hand")
    add("--follow", action="store_true", help="read the log while it grows, until the goal is reached (Ctrl-C ends it)")
    wanted = "wanted expanded uncertainty, mg (default: what orientations_24 reaches with the noise of the sensor file)"
    add("--goal", type=float, metavar="MG", help=wanted)
    wanted = "wanted expanded uncertainty of the gyroscope's matrix (default: only the accelerometer is guided)"
    add("--gyroscope-goal", type=float, metavar="PERCENT", help=wanted)
    add(
        "--dwell",
        type=float,
        metavar="S",
        default=BY_HAND.dwell_s,
        help="planned length of a rest (default: %(default)g)",
    )
    add("--procedure", metavar="NAME", help="multi_position (default), orientations_24, six_positions or ferraris")
    return parser


def _source(arguments: argparse.Namespace) -> Source:
    for option in ("goal", "gyroscope_goal", "dwell"):
        value = getattr(arguments, option)
        if value is not None and not value > 0.0:
            raise ConfigurationError(f"--{option.replace('_', '-')} is {value:g}; it must be above 0")
    first, campaign = arguments.files[0], campaign_of(arguments.files[0])
    files = tuple(arguments.files)
    if campaign is not None and not (arguments.sensor or arguments.procedure or arguments.ingest):
        loaded = load_campaign({"campaign": str(campaign)})
        for unit in recordings_of_files([first], loaded, [*loaded.units])[0]:
            return Source(_by_hand(loaded.units[unit].config), loaded.folder(unit), files)
    more = [f"procedure={arguments.procedure}"] if arguments.procedure else []
    return Source(_by_hand(config_of_log(first, arguments.ingest, arguments.sensor, more)), None, files)


def _by_hand(config: dict[str, Any]) -> dict[str, Any]:
    """Return a configuration whose procedure is recorded by hand; its recording gets as many rests as are needed."""
    procedure = config["procedure"]
    if config["table"]["motion"] != "none":
        raise ConfigurationError(
            f"procedure {procedure['name']} is recorded on a table; guide is for those recorded by hand: "
            "multi_position, orientations_24, six_positions, ferraris (docs/record.md)"
        )
    return {**config, "procedure": {**procedure, "holdout_from": 0}}


def _whole(entry: dict[str, Any]) -> dict[str, Any]:
    """Return the entry of a recording; one that a run cuts into parts counts as rests from its start to its end."""
    return {**entry, "role": "rests"} if entry["role"] == "session" else entry


def _held_out(source: Source) -> list[str]:
    """Return which rests are held out of the fit, and why; nothing where faces and turns are asked for."""
    procedure = source.config["procedure"]
    every = int(procedure.get("holdout_every") or 0)
    if procedure.get("faces"):
        return []
    if any(entry["role"] == "validation" for entry, _ in source.entries().values()):
        return ["no rest is held out of the fit: the recording for validation judges it"]
    if not every:
        return ["no rest is held out of the fit: procedure.holdout_every is 0"]
    why = "there is no recording for validation"
    return [
        f"one of {every} rests is held out of the fit, to judge it: {why} (a run does so from holdout_from rests on)"
    ]


def _complete_rows(file: Path, folder: Path) -> Path:
    """Return a copy of a text log up to its last complete row; logs of messages as they are."""
    if file.suffix.lower() in (".mcap", *MESSAGE_FORMATS):
        return file
    copy = folder / file.name
    copy.write_bytes(file.read_bytes().rpartition(b"\n")[0] + b"\n")
    return copy


class RestLine(NamedTuple):
    """What is printed of a rest."""

    recording: str
    start: float  # s
    used: bool
    final: bool  # whether the rests with whose rate its own is compared are there
    text: str


class Advice(NamedTuple):
    """Return the messages on the recordings so far."""

    enough: bool
    rests: list[RestLine]
    words: list[str]


class Goals(NamedTuple):
    """Largest expanded uncertainties that are enough."""

    accelerometer: float  # g
    gyroscope: float | None  # per cent of the matrix; None: not asked


def _advice(recordings: Sequence[Recording], config: dict[str, Any], goals: Goals, dwell: float) -> Advice:
    if config["procedure"].get("faces"):
        done, words = next_face_or_turn(recordings, config["procedure"], dwell)
        return Advice(done, [], words)
    progress = progress_of(recordings, config, dwell)
    starts = [(r.name, rest.start) for r, rest in (*progress.rests, *progress.left_out)]

    def line(r: Recording, rest: Rest, text: str) -> RestLine:
        of_recording = [start for name, start in starts if name == r.name]
        after = sum(start > rest.start for start in of_recording)
        final = after >= NEIGHBOURS // 2 and len(of_recording) >= NEIGHBOURS
        return RestLine(r.name, r.time[rest.start], rest.accepted, final, text)

    rows = zip(progress.rests, progress.up, progress.held_out, strict=True)
    lines = [
        line(r, rest, f"{k:>4}  {_described(r, rest, up, held=held)}")
        for k, ((r, rest), up, held) in enumerate(rows, start=1)
    ]
    for r, rest in progress.left_out:
        lines.append(line(r, rest, f"   -  {r.name} {r.time[rest.start]:.1f} s: left out: {rest.reason}"))
    done, words = _next(progress, goals.accelerometer, dwell)
    if goals.gyroscope is None:
        return Advice(done, lines, words)
    reached, of_gyroscope = _next_turn(recordings, config, progress, goals.gyroscope, dwell)
    if done:
        return Advice(reached, lines, of_gyroscope)
    later = "" if reached else "; turns for it are proposed once the accelerometer's goal is reached"
    return Advice(enough=False, rests=lines, words=[*words, of_gyroscope[0] + later])


def _next_turn(
    recordings: Sequence[Recording], config: dict[str, Any], progress: Progress, goal: float, dwell: float
) -> tuple[bool, list[str]]:
    """Return whether the gyroscope's goal is reached, and the next turn in words."""
    try:
        found = rests_and_moves.fit(recordings, None, config)
    except (NotObservableError, CannotCalibrateError) as lack:
        if not is_multi_position("gyroscope", recordings):
            raise
        reason = lack.message.partition(": ")[0]
        now = f"gyroscope's matrix: not determined yet: {reason} (goal {goal:g} %)"
        return False, [now, f"next: {FIRST.in_words(dwell)}"]
    expanded = 100.0 * float(np.max(found.to_json()["expanded_uncertainty"]["matrix"]))
    now = f"expanded uncertainty of the gyroscope's matrix: {expanded:.2g} % (goal {goal:g} %)"
    if expanded <= goal:
        return True, [now, "enough: both goals are reached"]
    gravity = float(config["table"].get("gravity_g") or 1.0)
    turn = most_informative_turn(found, float(np.sqrt(2.0)) * progress.error / gravity)
    return False, [now, f"next: {turn.in_words(dwell)}"]


def _described(recording: Recording, rest: Rest, up: Any, *, held: bool) -> str:  # noqa: ANN401  (an array)
    start, stop = recording.time[rest.start], recording.time[rest.stop - 1]
    return f"{recording.name} {start:.1f} to {stop:.1f} s: {in_words(up)}{' (held out)' if held else ''}"


def _next(progress: Progress, goal: float, dwell: float) -> tuple[bool, list[str]]:
    """Return whether the goal is reached, and the next rest in words."""
    held = sum(progress.held_out)
    count = f"{progress.used} rests of the fit, {held} held out"
    now = (
        f"not determined yet: {progress.reason.partition(': ')[0]}"
        if progress.reason
        else f"{1e3 * progress.expanded:.3g} mg"
    )
    lines = [f"expanded uncertainty: {now} ({count}; goal {1e3 * goal:.3g} mg)"]
    proposal = propose(progress, goal)
    if not proposal.further:
        return True, [*lines, "enough: the goal is reached"]
    lines.append(f"next: {in_words(proposal.up)}; rest it for {dwell:g} s")
    if progress.next_is_held_out:
        lines.append("      (held out of the fit, to judge it: an attitude far from all others)")
    if proposal.expected > goal:
        lines.append(
            f"expected: {1e3 * proposal.expected:.3g} mg after {MOST} more rests, so the goal is out of reach: rest "
            "longer (--dwell) and more firmly, or choose a larger --goal"
        )
    else:
        lines.append(f"expected: {1e3 * proposal.expected:.3g} mg after {proposal.further} more rests of the fit")
    return False, lines


def _follow(source: Source, goals: Goals, dwell: float) -> None:
    """Look at a growing log again and again, and tell what is new, until it is enough."""
    told: list[RestLine] = []
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
                state, new = advice.words[0], _news(advice.rests, told)
                if new or advice.enough or not last or (not advice.rests and advice.words[-1] != last):
                    print("\n".join([*new, *advice.words]) + bell, flush=True)
                    last = advice.words[-1]
                    if advice.enough:
                        return
            time.sleep(POLL_S)
    except KeyboardInterrupt:
        print(f"\nended before it was enough: {state}")


def _news(rests: Sequence[RestLine], told: list[RestLine]) -> list[str]:
    """Return the lines of rests that were not told before, and of those that are judged otherwise in the end.

    The rate of a rest is compared with that of its neighbours, so that rests to come may change what is told of it. To
    tell each rest twice at most, a change is told when the neighbours are there. ``told`` is brought up to date.
    """
    new = []
    for rest in rests:
        same = (t for t in told if t.recording == rest.recording and abs(t.start - rest.start) < WINDOW_S)
        before = next(same, None)  # more of the log may shift the start of a rest
        if before is None or (rest.final and not before.final):
            new += [rest.text] if before is None or before.used != rest.used else []
            told[:] = [*(t for t in told if t is not before), rest]
    return new


def _without_last_rest(recording: Recording, dwell: float) -> Recording:
    """Return a recording without the rest at its end, where that may go on and is still shorter than ``dwell``."""
    rests = find_rests(recording) if recording.role == "rests" else []
    if not rests:
        return recording
    start, stop, end = recording.time[[rests[-1].start, rests[-1].stop - 1, -1]]
    goes_on = end - stop < STILL_RESTING_S and stop - start < dwell - WINDOW_S
    return recording.select(slice(0, max(rests[-1].start, 1))) if goes_on else recording
