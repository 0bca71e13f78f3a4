"""Units on benches that depart from the convention: faces, senses, zeros, and a mounting of its own in each turn.

    python tests/study/bench_units.py --units 1000 --seed 1 --out units.jsonl

Each unit goes through the steps of a run up to the diagnosis. The line of
a unit holds the error of each parameter over its expanded uncertainty, in the frame of the mean of the mountings. A
unit of one number is the same sensor with the same hidden effect on every bench, so that benches compare in pairs. A
unit that is in the file is not run again. Without --units the table of the file is printed.

With --coverage the units are fitted only, hide nothing, and each bench has units of its own. ``--coverage sheet``: the
bias wander is that of the sensor file. ``--coverage drawn``: each sensor has another one, whose standard deviation and
correlation time are drawn from the prior that a fit takes from the sensor file (``pipeline.estimation.gauss_markov``).
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from imu_research.figures import wilson
from imu_research.study.run import read_lines
from pipeline.app.one_unit import ConfiguredUnit, unit_of_recordings
from pipeline.core.errors import PipelineError
from pipeline.core.records import SENSORS, NotCalibrated, coverage_factor
from pipeline.estimation.gauss_markov import TIME_FACTORS, TIME_PRIOR
from pipeline.estimation.noise import wander_prior
from pipeline.physics.effects import built_in
from pipeline.physics.kinematics import reference_motion
from pipeline.simulation.campaign import simulate_unit
from pipeline.simulation.description import UnitDescription, shipped_settings
from pipeline.unit import UnitState

TURNS = [f"{kind}_{axis}" for kind in ("accel", "gyro") for axis in "xyz"]
COURSE: dict[str, Any] = {
    "validation_s": 90.0, "static_s": 90.0, "warm_up_rest_s": 15.0, "step_deg": 10.0, "dwell_s": 1.5,
    "rates_dps": (30.0, 100.0), "both_directions": True,
}  # fmt: skip
FACES = Rotation.create_group("O")
# each with the bench that it is compared with: the same table, all by the convention
KINDS = {
    "plain": "plain", "remounted": "plain", "single": "single", "seats": "single", "seats_remounted": "single",
}  # fmt: skip
LARGEST_SEAT_DEG = 5.0
INDEPENDENT = 100_000  # between the numbers of units of two benches
NOT_HIDDEN = {"mounting", "encoder_zero", "table_axis_nonorthogonality", "earth_rotation", "table_tilt"}


def drawn(
    kind: str, seed: int, number: int, hidden: float, coverage: str = ""
) -> tuple[UnitDescription, dict[str, Any]]:
    """Return a unit and what is departed from: the rotation of each recording and the hidden effect."""
    rng = np.random.default_rng([seed, number, 1 + list(KINDS).index(kind)])
    of_unit = np.random.default_rng([seed, number, 0])
    face = FACES[int(rng.integers(24))] if "remounted" in kind else Rotation.identity()
    seats = {name: np.zeros(3) for name in [*TURNS, "validation"]}
    if "seats" in kind:
        size = rng.uniform(0.0, LARGEST_SEAT_DEG)
        for name in seats:
            direction = rng.standard_normal(3)
            seats[name] = size * rng.uniform(0.0, 1.0) * direction / np.linalg.norm(direction)
    leans = coverage and kind == "single"  # as the table states; seats contain it
    bench: dict[str, Any] = {
        "rate_error": [0.0, 0.0, 0.0],  # encoders keep the angle over any number of turns; see ``judged``
        "mounting_deg": {n: (face * Rotation.from_rotvec(s, degrees=True)).as_rotvec(degrees=True).tolist()
                         for n, s in seats.items()},
    }  # fmt: skip
    if KINDS[kind] == "single" and not leans:
        bench["direction_deg"] = np.zeros((3, 2)).tolist()
    if "remounted" in kind:
        bench |= {
            "sense": int(rng.choice([-1, 1])),
            "zero_deg": dict.fromkeys(TURNS, float(rng.uniform(-180.0, 180.0))),
        }
    sensor = str(of_unit.choice(SENSORS))
    no_chamber = {n: e for n, e in built_in().items() if not (e.shown_by or e.needs_swing)}
    possible = {n: e for n, e in no_chamber.items() if n not in NOT_HIDDEN}
    names = [n for n, e in possible.items() if sensor in e.sensors and sensor not in e.unseen]
    effect = str(of_unit.choice(names)) if of_unit.random() < hidden else ""
    table = "acutronic" if KINDS[kind] == "plain" else "single_axis"
    model = ("mpu6050", "stim300")[number % 2]
    description = UnitDescription(
        f"u{number}",
        sensor=model,
        table=table,
        course=COURSE,
        **({s: _drawn_wander(model, s, of_unit) for s in SENSORS} if coverage == "drawn" else {}),
        imperfections=bench,
        effects={f"{sensor}.{effect}": None} if effect else {},
    )
    rate_error = rng.normal(0.0, shipped_settings(table=table).table.rate_accuracy, 3)
    departure = {"seats": seats, "face": face, "rate_error": rate_error}
    return description, {**departure, "hidden": f"{sensor}.{effect}" if effect else ""}


def _drawn_wander(model: str, sensor: str, rng: np.random.Generator) -> dict[str, float]:
    """Return a bias wander of the prior that a fit takes from the sensor file."""
    prior = wander_prior(None, shipped_settings(sensor=model).sensor.of(sensor))
    return {
        "bias_wander": prior.wander * float(np.exp(prior.width * rng.standard_normal())),
        "wander_time_s": prior.time * float(rng.choice(TIME_FACTORS, p=TIME_PRIOR)),
    }


def of_accelerometer(unit: ConfiguredUnit) -> UnitState:
    """Run the steps to the diagnosis, which is made of the accelerometer alone: it takes nothing of the gyroscope."""
    state = unit.run_to("validate")
    fits = state.fits | {"gyroscope": NotCalibrated("not asked for")}
    diagnosed = unit.run_to("diagnose", first="diagnose", state=replace(state, fits=fits)).diagnosed
    return replace(state, diagnosed=diagnosed)


def judged(
    kind: str, seed: int, number: int, hidden: float, coverage: str = "", *, sensors: Sequence[str] = SENSORS
) -> dict[str, Any]:
    """Return what is said of one unit, or of its accelerometer alone, by the steps of a run.

    The rate of each turn axis has an error as its table states, without one of the angle, as by a wrong clock of the
    table: the true matrix of the gyroscope is ``diag(1 + error)`` times that of the simulation.
    """
    description, bench = drawn(kind, seed, number, hidden, coverage)
    recordings, truth = simulate_unit(description, seed, number)
    nominal = {r.name: _nominal(r, description.imperfections) for r in recordings if r.name in TURNS}
    if bench["face"].magnitude() > 0.0 or "seats" in kind:
        recordings = [_without_attitude(r) for r in recordings]
    layers = [f"sensor={description.sensor}", f"table={description.table}", "method=reference_least_squares"]
    unit = unit_of_recordings(recordings, layers + ["table.seat_deg=null"] * (kind == "single"))
    line: dict[str, Any] = {"kind": kind, "seed": seed, "number": number, "model": description.sensor}
    line |= {"hidden": bench["hidden"], "refused": None, "sensors": {}}
    try:
        one = tuple(sensors) == ("accelerometer",)
        state = of_accelerometer(unit) if one else unit.run_to("fit" if coverage else "diagnose")
    except PipelineError as error:
        return line | {"refused": error.message}
    if refused := [fit.reason for fit in state.fits.values() if isinstance(fit, NotCalibrated)]:
        return line | {"refused": refused[0]}
    mean = _mean_mounting(nominal, state.checked, bench) if "seats" in kind else Rotation.identity()
    for sensor in sensors:
        found = state.fits[sensor]
        matrix = mean.as_matrix() @ np.array(truth[sensor]["matrix"])
        if sensor == "gyroscope":
            matrix = np.diag(1.0 + bench["rate_error"]) @ matrix
        error = np.concatenate([found.bias - truth[sensor]["bias"], (found.matrix - matrix).ravel()])
        U = coverage_factor(found.freedom[:12]) * np.sqrt(np.diag(found.covariance)[:12])
        line["sensors"][sensor] = {"error_over_U": (error / U).tolist()}
        if coverage:
            continue
        held, said = state.validation[sensor], state.diagnosis[sensor]
        inside = held["expected_rms_error"][0] <= held["steps"][-1]["rms_error"] <= held["expected_rms_error"][1]
        line["sensors"][sensor] |= {
            "over_floor": held["steps"][-1]["rms_error"] / held["noise_floor"],
            "inside": bool(inside), "verdict": said["verdict"], "selected": said["selected"], "reason": said["reason"],
            "not_observable": [entry["effect"] for entry in said["not_observable"]],
        }  # fmt: skip
    return line


def _nominal(recording: Any, bench: dict[str, Any]) -> Any:
    """Return the motion before it is remounted: by the angle without sense and zero."""
    angle = bench.get("sense", 1) * (recording.table_angle - bench.get("zero_deg", {}).get(recording.name, 0.0))
    return reference_motion(
        replace(recording, table_angle=angle, table_rate=bench.get("sense", 1) * recording.table_rate)
    )


def _mean_mounting(nominal: dict[str, Any], recordings: list[Any], bench: dict[str, Any]) -> Rotation:
    """Return the mean of the true mountings against the convention that the checks applied, exactly."""
    found = []
    for recording in recordings:
        if recording.name in nominal:
            true, used = nominal[recording.name], reference_motion(recording)
            body = bench["face"] * Rotation.from_rotvec(bench["seats"][recording.name], degrees=True)
            size = np.abs(used.angular_rate).max()
            seen = np.concatenate([true.specific_force, true.angular_rate / size]) @ body.as_matrix()
            assumed = np.concatenate([used.specific_force, used.angular_rate / size])
            found.append(Rotation.align_vectors(assumed, seen)[0])
    mean = Rotation.identity()
    for _ in range(10):  # the rotation after which the mean of the rotation vectors is 0
        left = np.mean([(each * mean.inv()).as_rotvec() for each in found], axis=0)
        mean = Rotation.from_rotvec(left) * mean
    return mean


def _without_attitude(recording: Any) -> Any:
    return recording if recording.role != "validation" else replace(recording, table_attitude=None)


def table(lines: list[dict[str, Any]]) -> str:
    """Return the rows of a study as text."""
    rows = []
    for kind in KINDS:
        chosen = [line for line in lines if line["kind"] == kind]
        if not chosen:
            continue
        refused = [line for line in chosen if line["refused"]]
        fine = [line for line in chosen if not line["refused"]]
        rows.append(f"{kind}: {len(chosen)} units, {len(refused)} refused")
        for sensor in SENSORS:
            plain = [line["sensors"][sensor] for line in fine if not line["hidden"].startswith(sensor)]
            hidden = [line for line in fine if line["hidden"].startswith(sensor)]
            if plain:
                covered = np.abs([p["error_over_U"] for p in plain]) <= 1.0
                low, high = wilson(int(covered.sum()), covered.size)
                each = 100.0 * covered.mean(axis=0)
                text = (
                    f"  {sensor}: coverage {100 * covered.mean():.1f} % ({100 * low:.1f} to {100 * high:.1f}), "
                    f"parameters {each.min():.1f} to {each.max():.1f} %: {' '.join(f'{e:.1f}' for e in each)}"
                )
                if "verdict" in plain[0]:
                    verdicts = dict(Counter(p["verdict"] for p in plain))
                    text += f"; held-out inside {sum(p['inside'] for p in plain)} of {len(plain)}; {verdicts}"
                rows.append(text)
            if hidden:
                rows.append(f"  {sensor}: hidden effect named first {sum(map(_named, hidden))} of {len(hidden)}")
        rows += _in_pairs(kind, fine, lines)
    return "\n".join(rows) + "\n"


def _named(line: dict[str, Any]) -> bool:
    sensor, _, effect = line["hidden"].partition(".")
    return effect in line["sensors"][sensor]["selected"][:1]


def _in_pairs(kind: str, lines: list[dict[str, Any]], every: list[dict[str, Any]]) -> list[str]:
    """Return how often the hidden effect is named here and on the bench by the convention, for the same units.

    An effect that is named there alone, and reported as not observable here, is counted by itself.
    """
    plain = {(o["seed"], o["number"]): o for o in every if o["kind"] == KINDS[kind] != kind and not o["refused"]}
    pairs = [(line, plain[line["seed"], line["number"]]) for line in lines
             if line["hidden"] and (line["seed"], line["number"]) in plain]  # fmt: skip
    if not pairs:
        return []
    named = np.array([(_named(here), _named(there)) for here, there in pairs], float)
    reported = sum(named[k, 0] < named[k, 1] and _reported(here) for k, (here, _) in enumerate(pairs))
    change = np.diff(named, axis=1)
    error = 1.96 * change.std(ddof=1) / np.sqrt(len(pairs)) if len(pairs) > 1 else np.inf
    here, there = named.sum(axis=0)
    text = f"  named {here:.0f} of {len(pairs)}, on {KINDS[kind]} {there:.0f}: {-100 * change.mean():+.1f}"
    lost = f"{reported} of those that are named there alone are reported as not observable"
    return [f"{text} +- {100 * error:.1f} %; {lost}"]


def _reported(line: dict[str, Any]) -> bool:
    sensor, _, effect = line["hidden"].partition(".")
    return effect in line["sensors"][sensor]["not_observable"]


def main() -> None:
    """Run the units that are not in the file, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--units", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kinds", nargs="+", default=list(KINDS))
    parser.add_argument("--hidden", type=float, default=0.4, help="share of units with a hidden effect")
    parser.add_argument("--coverage", choices=["sheet", "drawn"], default="")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    hidden = 0.0 if options.coverage else options.hidden
    lines = read_lines(options.out)
    known = {(line["kind"], line["seed"], line["number"]) for line in lines}
    for place in range(options.units):
        number, kind = place // len(options.kinds), options.kinds[place % len(options.kinds)]
        if options.coverage:
            number += INDEPENDENT * list(KINDS).index(kind)
        if (kind, options.seed, number) in known:
            continue
        lines.append(judged(kind, options.seed, number, hidden, options.coverage))
        with options.out.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(lines[-1]) + "\n")
    sys.stdout.write(table(lines))


if __name__ == "__main__":
    main()
