"""Plan a procedure: simulate it without effects, and state which size of each effect it would find.

    {"sensor", "table", "procedure", "course": {how it is run}, "at_a_table", "minutes", "samples", "warnings": [text],
     "accelerometer": {"noise": {"white", "wander"}, "unit",
        "effects": [{"effect", "smallest", "unit", "share_of_limit", "almost_sure", "named", "sizes", "taken_for",
                      "look_alikes": [{"effect", "share"}]}],
        "not_observable": [{"effect", "reason"}], "reason": null | why nothing can be planned},
     "gyroscope": {...}}

Sizes are those that half of the units would show. An effect that needs a size above its limit is not observable.

A change of the procedure is proposed by its own plan. One with options can be planned and simulated by these; the
others are further recordings, to be named in the procedure's configuration. The README of a new campaign states how to
mount and record a unit, and the lengths of the recordings and what they determine, as simulated.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from textwrap import wrap
from typing import Any

import numpy as np

from pipeline.app.detection_limits import Detection, DetectionLimits, RestLimits, TurntableLimits
from pipeline.checks.bench import usual_up
from pipeline.core.errors import NotObservableError
from pipeline.core.files import JSON
from pipeline.core.records import AXES, SENSORS, Fit, Noise, NotCalibrated, Recording, SensorCalibration, as_json
from pipeline.core.settings import DataSheet, Settings, assumed_figures
from pipeline.estimation.multi_position import selection as by_hand
from pipeline.estimation.observability import at_its_limit, not_observable, not_observable_by_hand
from pipeline.estimation.observations import observe
from pipeline.estimation.rest_means import is_multi_position
from pipeline.estimation.selection import select
from pipeline.evaluation.diagnosis.multi_position import require_model
from pipeline.ingest.recordings_sheet import recordings_of_text
from pipeline.output.pages.pages import template
from pipeline.physics.effects import effect
from pipeline.physics.effects.base import Owner, unit_of
from pipeline.physics.signal.rests import SETTLING_S
from pipeline.simulation.campaign import SHEET_FILE, sheet_of, simulate_unit
from pipeline.simulation.description import (
    OF_A_SHEET,
    TABLE_PROCEDURES,
    Course,
    UnitDescription,
    course_of,
    plan,
    shipped_settings,
)
from pipeline.simulation.trajectory import Gimbals, Planned, random_gimbals
from pipeline.unit import run_checked

WIDTH = 100  # columns of a plan on the terminal
CLEARLY_LARGER = 1.2  # times the smallest size: least size of a named effect that is printed
SEED = 0  # of the simulated noise, so that a plan is reproducible
# The middle of the random values of a simulated unit, which warms up by some degrees in a room that changes little.
ROOM: dict[str, Any] = {
    "ambient": 25.0, "warm_up": 4.5, "warm_up_time": 300.0, "drift": 0.3,
    "periods": np.array([3000.0, 5000.0]), "phases": np.zeros(2),
}  # fmt: skip
FAULTLESS: dict[str, Any] = {"angle_accuracy_deg": 0.0, "rate_error": [0.0] * 3, "direction_deg": np.zeros((3, 2))}
FASTER_DPS = (100.0, 200.0)  # proposed rates, within a low-cost range of 250 deg/s
CLEARLY_FASTER = 1.3  # least proposed rate over the procedure's fastest rate
USABLE_SHARE = 0.9  # of the gyroscope's full scale: its bias needs the remainder
MOTION_S, MOTION_DPS = 120.0, 100.0  # of the proposed random motion
UPRIGHT_DPS = 60.0  # one turn about an upright z in 6 s
LONG_REST_S = 600.0  # six correlation times of a typical wander (configs/sensor)
POSITIONS = 2  # proposed number of rests over that of the procedure
CLEARLY_SMALLER = 99.5  # per cent
PRINTED_CHANGES = 3  # changes that are printed


def plan_of(unit: UnitDescription, extra: Sequence[Planned] = (), *, half_only: bool = False) -> JSON:
    """Return the plan of a unit's procedure with further recordings.

    With ``half_only``, ``almost_sure`` and ``named`` are None. Raises ``ConfigurationError`` if a name is unknown or
    the course is impossible.
    """
    simulated = simulate_procedure(unit, extra)
    return {
        "sensor": unit.sensor,
        "table": unit.table,
        "procedure": unit.procedure,
        "course": as_json(course_of(unit)),
        "at_a_table": simulated.settings.table.motion != "none",
        "minutes": simulated.minutes,
        "samples": sum(r.samples for r in simulated.recordings),
        "warnings": _warnings(simulated),
        **{sensor: of_sensor(sensor, simulated, half_only=half_only) for sensor in SENSORS},
    }


def not_shown(unit: UnitDescription, effects: Sequence[str]) -> dict[str, str]:
    """Return the effects of a simulation that the unit's procedure cannot show, with the reason.

    ``effects``: ``sensor.effect``, or ``effect`` for all its sensors; the latter is shown if one sensor shows it.
    """
    wanted: dict[str, dict[str, str]] = {}  # effect as given: its sensors, with the name
    for key in effects:
        sensor, _, name = key.rpartition(".")
        wanted[key] = dict.fromkeys([s for s in effect(name).sensors if sensor in (s, "")], name)
    simulated, reasons = simulate_procedure(unit), dict[str, dict[str, str]]()
    for sensor in {sensor for of_key in wanted.values() for sensor in of_key}:
        names = {of_key[sensor] for of_key in wanted.values() if sensor in of_key}
        document = of_sensor(sensor, simulated, half_only=True, only=names)
        hidden = {entry["effect"]: entry["reason"] for entry in document["not_observable"]}
        reasons[sensor] = dict.fromkeys(names, str(document["reason"])) if document["reason"] else hidden
    found = {}
    for key, of_key in wanted.items():
        lacking = {sensor: reasons[sensor][name] for sensor, name in of_key.items() if name in reasons[sensor]}
        if lacking and len(lacking) == len(of_key):
            found[key] = "; ".join(dict.fromkeys(lacking.values()))
    return found


def of_sensor(
    sensor: str, simulated: SimulatedProcedure, *, half_only: bool = False, only: Collection[str] | None = None
) -> JSON:
    """Return the plan of one sensor; ``only``: of some effects."""
    noise = simulated.noise[sensor]
    noises = {"white": float(noise.white[0]), "wander": float(noise.wander[0])}
    document: JSON = {"unit": unit_of(sensor), "noise": noises, "effects": [], "not_observable": [], "reason": None}
    limits: DetectionLimits
    try:
        if is_multi_position(sensor, simulated.recordings):
            by_rests = select_by_hand(sensor, simulated)
            limits, hidden = RestLimits(by_rests, noise), not_observable_by_hand(by_rests, [])
        else:
            observations = observe(sensor, simulated.recordings, simulated.settings.table)
            selection = select(observations, [], noise, simulated.settings.sensor.of(sensor), search=False)
            limits, hidden = TurntableLimits(selection, noise), not_observable(selection, [])
    except NotObservableError as error:
        return {**document, "reason": error.message}
    for name in sorted(set(limits.names if only is None else only) & set(limits.names) - set(hidden)):
        detection = limits.detection(name, half_only=half_only)
        limited = bool(np.isfinite(limits.limits[name]).any())
        if limited and detection.found > 1.0:
            this, times = effect(name), f", {detection.found:.2g} times that would show"
            faint = at_its_limit(this, sensor, detection.unit_sizes[0]) + " be below the noise"
            hidden[name] = f"{faint}{times if np.isfinite(detection.found) else ''}; it needs {this.excitation}"
        else:
            document["effects"].append(_entry(sensor, detection, limited=limited))
    document["not_observable"] = [{"effect": n, "reason": hidden[n]} for n in sorted(hidden)]
    return document


def select_by_hand(sensor: str, simulated: SimulatedProcedure) -> by_hand.SelectionByHand:
    """Return the selection in a simulated procedure by hand.

    Raises ``NotObservableError`` if bias and matrix cannot be determined, or if there are no rests.
    """
    start, other = simulated.accelerometer_by_hand, None
    if isinstance(start, NotCalibrated):
        raise NotObservableError(start.reason)
    if sensor == "gyroscope":
        start, other = SensorCalibration(sensor), start
    model = require_model(simulated.recordings, start, simulated.noise[sensor], simulated.settings, other)
    return by_hand.SelectionByHand(model, start, [], simulated.noise[sensor], simulated.settings.sensor.of(sensor))


def _entry(sensor: str, detection: Detection, *, limited: bool) -> JSON:
    parameters = effect(detection.effect).parameters(sensor)
    first = float(detection.unit_sizes[0])
    almost_sure, named = (s * first if np.isfinite(s * first) else None for s in (detection.sure, detection.named))
    return {
        "effect": detection.effect,
        "smallest": detection.found * first,
        "unit": parameters[0].unit,
        "share_of_limit": detection.found if limited else None,
        "almost_sure": almost_sure,
        "named": named,
        "sizes": {
            p.name: detection.found * float(u) for p, u in zip(parameters, detection.unit_sizes, strict=True) if u
        },
        "taken_for": detection.taken_for,
        "look_alikes": [{"effect": name, "share": share} for name, share in detection.look_alikes.items()],
    }


@dataclass(frozen=True)
class SimulatedProcedure:
    """The recordings of a procedure with a faultless sensor and table, and the configurations and noise of both."""

    recordings: list[Recording]
    settings: Settings
    noise: dict[str, Noise]
    minutes: float  # from power-on to the end of the last recording

    @cached_property
    def accelerometer_by_hand(self) -> Fit:
        """The fit of the accelerometer to rests."""
        stages = {"accelerometer": ["nonlinear_least_squares"]}
        return run_checked(self.recordings, stages, self.settings).fits["accelerometer"]


def simulate_procedure(unit: UnitDescription, extra: Sequence[Planned] = ()) -> SimulatedProcedure:
    """Simulate a procedure and further recordings without the unit's effects and the table's imperfections.

    Raises ``ConfigurationError`` if sensor, table or procedure are unknown, or the course is impossible.
    """
    faultless = replace(unit, effects={}, imperfections=FAULTLESS, held_out={}, temperature=ROOM | unit.temperature)
    recordings, _ = simulate_unit(faultless, SEED, 0, extra)
    settings = shipped_settings(sensor=unit.sensor, table=unit.table, procedure=unit.procedure)
    if sheet := sheet_of(unit):
        listed = settings.procedure.replaced(recordings=recordings_of_text(sheet, SHEET_FILE))
        settings = settings.replaced(procedure=listed)
    long_rest = any(recording.role == "static" for recording in recordings)
    noise = {s: stated_noise(settings.sensor.of(s), unit.interval_s, long_rest=long_rest) for s in SENSORS}
    minutes = max(float(r.time[-1]) for r in recordings) / 60.0
    return SimulatedProcedure(recordings, settings, noise, minutes)


def stated_noise(data_sheet: DataSheet, interval: float, *, long_rest: bool) -> Noise:
    """Return the noise of a sensor by the sensor file.

        white^2 = noise_density^2 / (2 dt) + (1 / counts_per_unit)^2 / 12

    with the sampling interval dt in s, the one-sided density in unit/sqrt(Hz), and the quantisation. ``long_rest``:
    whether a long rest will determine the noise.
    """
    quantisation = 1.0 / (12.0 * data_sheet.counts_per_unit**2)
    white = np.sqrt(data_sheet.white(interval) ** 2 + quantisation)
    wander = np.full(3, data_sheet.bias_wander)
    return Noise(np.full(3, white), wander, data_sheet.wander_time_s, "static" if long_rest else "rests")


def _warnings(simulated: SimulatedProcedure) -> list[str]:
    """Return the limitations of sensor and table in the procedure, and the assumed figures, as sentences."""
    full = simulated.settings.sensor.gyroscope.full_scale
    rates = [float(np.abs(r.table_rate).max()) for r in simulated.recordings if r.table_rate is not None]
    fastest, assumed = max(rates, default=0.0), assumed_figures(simulated.settings.sensor)
    found = [assumed] if assumed else []
    if fastest > full:
        found.append(f"the fastest turn, {fastest:g} deg/s, is beyond the gyroscope's full scale of {full:g} deg/s")
    if simulated.settings.table.motion == "commanded":
        angle = simulated.settings.table.angle_accuracy_deg
        found.append(
            f"the table logs its program, not its motion: angle errors of {angle:g} deg read as "
            f"{1000.0 * np.radians(angle):.2g} mg, and sizes below that are only found if they repeat from stop to stop"
        )
    return found


def plan_text(document: JSON, second: JSON | None = None) -> list[str]:
    """Return a plan (``plan_of``) as lines, or two plans side by side."""
    text: str = template("plan.txt").render(
        first=document,
        second=second,
        sensors=SENSORS,
        rows=_rows,
        hidden=lambda part: [[entry["effect"], entry["reason"]] for entry in part["not_observable"]],
        both=_compared,
        width=WIDTH,
    )
    return [part for line in text.splitlines() for part in ([line] if len(line) <= WIDTH else wrap(line, WIDTH))]


def _rows(part: Mapping[str, Any]) -> list[list[str]]:
    """Return the plan of a sensor as a table; empty if no effect is observable."""
    effects = part["effects"]
    sizes = [[e["effect"], size_text(e["smallest"], e["unit"]), share_text(e["share_of_limit"])] for e in effects]
    rows = [[*size, "; ".join(filter(None, [_alike(e), _note(e)]))] for size, e in zip(sizes, effects, strict=True)]
    return [["effect", "smallest size", "of limit", "similar signal; what would be named"], *rows] if rows else []


def _alike(entry: Mapping[str, Any]) -> str:
    return ", ".join(f"{a['effect']} {a['share']:.2f}" for a in entry["look_alikes"][:2])


def _note(entry: Mapping[str, Any]) -> str:
    """Return the size below which another effect would be named."""
    named, smallest, taken = entry["named"], entry["smallest"], entry["taken_for"]
    limit = None if entry["share_of_limit"] is None else smallest / entry["share_of_limit"]
    never = named is None or (limit is not None and named > limit)
    if taken:
        return f"named as {taken}" + ("" if never else f" below {size_text(named, entry['unit'])}")
    if never:
        return "not distinguishable from those"
    return f"named from {size_text(named, entry['unit'])}" if named > CLEARLY_LARGER * smallest else ""


def size_text(value: float, unit: str) -> str:
    """Return a size with its unit."""
    return f"{value:.2g}" + ("" if unit == "1" else f" {unit}")


def share_text(value: float | None) -> str:
    """Return a share of a limit in per cent."""
    if value is None:
        return "no limit"
    return f"{100.0 * value:.2g} %" if value >= 1e-3 else "< 0.1 %"


def _compared(first: Mapping[str, Any], second: Mapping[str, Any]) -> list[list[str]]:
    """Return two plans of a sensor as a table; empty without effects."""
    a, b = ({entry["effect"]: entry for entry in part["effects"]} for part in (first, second))
    rows = []
    hidden = {e["effect"] for part in (first, second) for e in part["not_observable"]}
    for name in sorted(a.keys() | b.keys() | hidden):
        cells = [name]
        for e in (a.get(name), b.get(name)):
            cells += [size_text(e["smallest"], e["unit"]), share_text(e["share_of_limit"])] if e else ["-", ""]
        both = name in a and name in b
        rows.append([*cells, f"{b[name]['smallest'] / a[name]['smallest']:.2f}" if both else ""])
    return [["effect", "smallest in A", "of limit", "smallest in B", "of limit", "B / A"], *rows] if rows else []


@dataclass(frozen=True)
class ProcedureChange:
    """A change of the procedure or an additional recording."""

    what: str  # as advice to the reader
    options: str  # of the command line, empty if no option has this effect
    unit: UnitDescription
    extra: tuple[Planned, ...] = ()


def changes(unit: UnitDescription) -> list[ProcedureChange]:
    """Return the proposed changes of a unit's procedure."""
    course, on_table = course_of(unit), unit.procedure in TABLE_PROCEDURES
    full = shipped_settings(sensor=unit.sensor).sensor.gyroscope.full_scale
    fixed = replace(unit, samples=None, course=asdict(course))
    found: list[ProcedureChange] = []

    def propose(what: str, options: str, **values: Any) -> None:  # noqa: ANN401  (any attribute of the course)
        found.append(ProcedureChange(what, options, replace(fixed, course={**fixed.course, **values})))

    if on_table and not course.both_directions:
        propose("make every turn in the other direction too", "--both-directions", both_directions=True)
    faster = [r for r in FASTER_DPS * on_table if CLEARLY_FASTER * max(course.rates_dps) < r <= USABLE_SHARE * full]
    if faster:
        rates = (*course.rates_dps, *faster)
        what = f"turn at {' and '.join(f'{r:g}' for r in faster)} deg/s too, both sensors recorded"
        propose(what, "--rate " + " ".join(f"{r:g}" for r in rates), rates_dps=rates)
    if not (on_table and course.accelerometer_rates_dps):
        dwell = 2.0 * course.dwell_s
        propose("rest twice as long at each stop", f"--dwell {dwell:g}", dwell_s=dwell)
    if unit.procedure == "three_axis_turns":
        what = f"heat and cool the unit by {course.thermal_ramp_degc:g} degC meanwhile, in a thermal chamber"
        found.append(ProcedureChange(what, "--procedure thermal_ramp", replace(fixed, procedure="thermal_ramp")))
    if on_table:
        propose("make twice as many turns", f"--turns {2 * course.turns}", turns=2 * course.turns)
        found += _further(fixed, course, full)
    elif unit.procedure == OF_A_SHEET:
        propose("soak the unit in one more attitude", f"--soaks {course.soaks + 1}", soaks=course.soaks + 1)
    elif unit.procedure == "multi_position":
        more = POSITIONS * course.positions
        propose(f"rest in {more} positions", f"--positions {more}", positions=more)
    else:
        what = f"instead of these, rest in {course.positions} positions, each with another inclination"
        found.append(ProcedureChange(what, "--procedure multi_position", replace(fixed, procedure="multi_position")))
    if course.static_s < LONG_REST_S:
        what = f"a long rest of {LONG_REST_S / 60.0:g} min, to determine the noise"
        propose(what, f"--static {LONG_REST_S:g}", static_s=LONG_REST_S)
    return found


def _further(unit: UnitDescription, course: Course, full: float) -> Iterator[ProcedureChange]:
    """Yield recordings for which the procedure has no option."""
    planned = plan(unit.procedure, replace(course, validation_s=0.0, static_s=0.0), np.random.default_rng(0))
    repeated = tuple(replace(p, name=f"{p.name}_again") for p in planned)
    yield ProcedureChange("run the whole procedure a second time, once the unit is warm", "", unit, repeated)
    if unit.table == "single_axis":
        return
    rate = min(MOTION_DPS, USABLE_SHARE * full)
    motion = random_gimbals(MOTION_S, rate, np.random.default_rng(0))
    what = f"random motion about all axes up to {rate:g} deg/s for {MOTION_S / 60.0:g} min, attitude logged, in the fit"
    yield ProcedureChange(what, "", unit, (Planned("motion", "gyroscope", None, motion),))
    still = np.zeros((3, 1))
    turn = Gimbals(np.array([0.0, 0.0, UPRIGHT_DPS]), still, still, still, 360.0 / UPRIGHT_DPS)
    what = "turn about z with z upright, attitude logged, in the fit"
    yield ProcedureChange(what, "", unit, (Planned("upright_z", "gyroscope", None, turn),))


@dataclass(frozen=True)
class PlanGain:
    """The improvement of a plan by a change."""

    change: ProcedureChange
    minutes: float  # additional time
    shown: tuple[str, ...]  # ``sensor.effect`` that become observable; of the table only if neither sensor showed it
    distinguished: tuple[str, ...]  # those that are no longer taken for a look-alike
    factor: float  # geometric mean of new over old smallest size, of effects that are observable in both


def best_changes(unit: UnitDescription, before: JSON) -> list[PlanGain]:
    """Return the gain of each change, the most helpful first; ``before`` is the plan of the unit's procedure.

    The order is by the number of effects that become observable, in one sensor or both, for each additional minute (at
    least one, to set up), then by the reduction of the smallest sizes for each minute, as a logarithm.
    """
    if all(before[sensor]["reason"] for sensor in SENSORS):
        return []
    gains = [_gain(change, before, plan_of(change.unit, change.extra, half_only=True)) for change in changes(unit)]

    def order(gain: PlanGain) -> tuple[float, float]:
        minutes = max(gain.minutes, 1.0)
        return -len({key.partition(".")[2] for key in gain.shown}) / minutes, float(np.log(gain.factor)) / minutes

    return sorted(gains, key=order)


def _gain(change: ProcedureChange, before: JSON, after: JSON) -> PlanGain:
    old, new = (  # observable effects by ``sensor.effect``
        {f"{s}.{entry['effect']}": entry for s in SENSORS for entry in document[s]["effects"]}
        for document in (before, after)
    )
    of_table = {entry["effect"] for entry in old.values() if effect(entry["effect"]).owner == Owner.TABLE}
    both = [key for key in new if key in old]
    ratios = [np.log(new[key]["smallest"] / old[key]["smallest"]) for key in both]
    shown = tuple(key for key, entry in new.items() if key not in old and entry["effect"] not in of_table)
    apart = tuple(key for key in both if old[key]["taken_for"] and not new[key]["taken_for"])
    factor = float(np.exp(np.mean(ratios))) if ratios else 1.0
    return PlanGain(change, after["minutes"] - before["minutes"], shown, apart, factor)


def helps_most(gains: Sequence[PlanGain]) -> list[str]:
    """Return the first changes that help as lines."""
    useful = [gain for gain in gains if gain.shown or gain.distinguished or 100.0 * gain.factor < CLEARLY_SMALLER]
    if not useful:
        return ["additional recordings: none of those examined shows more"] if gains else []
    lines = ["additional recordings, the most helpful first:"]
    for number, gain in enumerate(useful[:PRINTED_CHANGES], start=1):
        options = f" ({gain.change.options})" if gain.change.options else ""
        lines.append(f"  {number}. {gain.change.what}{options}: {gain.minutes:+.1f} min")
        parts = [f"shows {_listed(gain.shown)}"] if gain.shown else []
        parts += [f"distinguishes {_listed(gain.distinguished)} from similar effects"] if gain.distinguished else []
        percent = 100.0 * gain.factor
        size = f"at {percent:.0f} % of the size" if percent < CLEARLY_SMALLER else "at the same size"
        parts.append(f"finds {'the others' if parts else 'effects'} {size}")
        lines.append(f"     {'; '.join(parts)}")
    return lines


def _listed(keys: Sequence[str]) -> str:
    by_sensor = {s: [k.partition(".")[2] for k in keys if k.startswith(f"{s}.")] for s in SENSORS}
    return " and ".join(f"{', '.join(names)} of the {sensor}" for sensor, names in by_sensor.items() if names)


def readme(unit: UnitDescription, name: str) -> str:
    """Return the README of a campaign with the description of its first unit."""
    settings, course = shipped_settings(procedure=unit.procedure, table=unit.table), course_of(unit)
    text: str = template("campaign_readme.md").render(
        name=name,
        unit=unit,
        course=course,
        table=settings.table,
        procedure=settings.procedure,
        folder=settings.procedure.folder.replace("{unit}", unit.unit),
        planned=plan(unit.procedure, course, np.random.default_rng(0)),
        plan=plan_of(unit),
        axes=AXES,
        up=[usual_up(axis) for axis in AXES],
        settling_s=SETTLING_S,
        size_text=size_text,
        share_text=share_text,
    )
    return text
