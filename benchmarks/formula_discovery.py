"""How often the diagnosis finds a formula outside the catalogue, and how often it invents one.

    python benchmarks/formula_discovery.py hidden OUT.jsonl --n 200 --seed 1
    python benchmarks/formula_discovery.py null OUT.jsonl --n 500 --seed 1 [--depth full]

Each hidden formula is added to a simulated MPU-6050 whose room warms and cools by 4 degC, so that the temperature is no
function of time alone. Class, signals and constants are drawn:

    power        s ** p      u: 4, 5; fx fy fz: 3, 4; temperature - 25: 3, 4; speed, time: 2, 3
    product      a * b       of u, abs(u), u ** 2, fx, fy, fz, speed, temperature - 25, time
    step         step(s - a) temperature, time, speed, a in the middle 60 % of the span; half of them times a signal
    harmonic     cos(n * radians(angle) + phi), n = 3 to 8; half of those of a gyroscope times u
    exponential  exp(+-(s - a) / c), temperature or time, c = 0.1 to 0.6 of the span; half of them times a signal

A draw that base and one effect of the catalogue explain to 95 %, that is a warm-up with another time constant, or that
the base leaves less than 5 % of, is repeated.
Each axis has a coefficient of its own. What the base leaves of the formula has about twice the standard deviation of a
sample's white noise (1.5 mg, 0.02 deg/s rms), times 0.7 to 1.3, on the axis where it is largest.

exact  : the suggested effect has the same functions, signals, powers and cycles, and its formulas reproduce the hidden
         one to R^2 > 0.95 where all signals vary independently
floor  : with what the diagnosis proposes, the held-out error is at most 1.05 times the noise floor, or 1.05 times the
         error with the hidden formula itself
"""

from __future__ import annotations

import argparse
import ast
import json
import re
import sys
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from imu_research.figures import share, write_figures
from imu_research.study.bench import recordings_of
from imu_research.study.cases import CYCLE_DEGC, NOISES, StudyCase, draw
from imu_research.study.run import errors_with, read_lines
from pipeline.app.one_unit import ConfiguredUnit, unit_of_recordings
from pipeline.core.errors import PipelineError
from pipeline.core.records import SENSORS, Recording
from pipeline.estimation.candidates import candidates_for
from pipeline.estimation.observations import observe
from pipeline.physics.effects import effect_from, forget, register
from pipeline.physics.effects.base import Layout, per_axis, truth
from pipeline.physics.formula import parse
from pipeline.physics.kinematics import reference_motion
from pipeline.simulation.campaign import Streams, random_environment
from pipeline.simulation.description import shipped_settings

JSON = dict[str, Any]
MODEL = "mpu6050"
SIZE = {"accelerometer": 1.5e-3, "gyroscope": 0.02}
T = "(temperature - 25)"
POWERS = {"u": (4, 5), "fx": (3, 4), "fy": (3, 4), "fz": (3, 4), T: (3, 4), "speed": (2, 3), "time": (2, 3)}
FACTORS = ("u", "abs(u)", "u ** 2", "fx", "fy", "fz", "speed", T, "time")
MODULATORS = ("u", "abs(u)", "fx", "fy", "fz", "speed")
WARM_UP = re.compile(r"exp\(\([\d.]+ - time\)")
REPRODUCED, AT_FLOOR = 0.95, 1.05


def signals_of(case: StudyCase, recording: Recording) -> dict[str, Any]:
    """Return the true signals at every sample, u of all axes; None where a recording has no such signal."""
    room = random_environment(Streams(case.seed, case.number)["room"])
    if case.room_degc is not None:
        room = replace(room, drift=case.room_degc)
    motion = reference_motion(recording, 1.0)
    if motion is None:
        return {}
    found = {"time": recording.time, "temperature": room.temperature(recording.time), "u": truth(case.sensor, motion)}
    found |= {f"f{a}": motion.specific_force[:, i] for i, a in enumerate("xyz")}
    found["speed"] = np.linalg.norm(motion.angular_rate, axis=1)
    found["angle"] = recording.table_angle if recording.axis is not None else None
    return found


def values(text: str, signals: JSON) -> np.ndarray:
    """Return a formula on the three axes: (n, 3) array."""
    formula = parse(text)
    if not signals or any(signals[name] is None for name in formula.signals):
        return np.zeros((len(signals.get("time", ())), 3))
    own = ({k: v[:, c] if k == "u" else v for k, v in signals.items() if v is not None} for c in range(3))
    return np.stack([np.broadcast_to(formula(each), len(signals["time"])) for each in own], axis=1)


def drawn(rng: np.random.Generator, sensor: str, spans: dict[str, tuple[float, float]]) -> str:
    def one(options: Any) -> Any:  # noqa: ANN401
        return options[int(rng.integers(len(options)))]

    kind = one(("power", "product", "step", "harmonic", "exponential"))
    if kind == "power":
        signal = one(list(POWERS))
        return f"{signal} ** {one(POWERS[signal])}"
    if kind == "product":
        a, b = rng.choice(len(FACTORS), 2, replace=False)
        return f"{FACTORS[a]} * {FACTORS[b]}"
    times = f"{one(MODULATORS)} * " if rng.random() < 0.5 else ""
    if kind == "harmonic":
        times = "u * " if times and sensor == "gyroscope" else ""
        return f"{times}cos({rng.integers(3, 9)} * radians(angle) + {rng.uniform(0.0, 6.28):.3g})"
    signal = one(("temperature", "time", "speed") if kind == "step" else ("temperature", "time"))
    low, high = spans[signal]
    if kind == "step":
        return f"{times}step({signal} - {low + rng.uniform(0.2, 0.8) * (high - low):.5g})"
    scale = rng.uniform(0.1, 0.6) * (high - low)
    return f"{times}exp({one((f'({signal} - {high:.5g})', f'({low:.5g} - {signal})'))} / {scale:.4g})"


def left(target: np.ndarray, columns: np.ndarray) -> float:
    """Return the rms that columns leave of a target."""
    size = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    return float(np.std(target - (columns / size) @ np.linalg.lstsq(columns / size, target, rcond=1e-9)[0]))


def hide(case: StudyCase) -> tuple[list[Recording], str, list[float]]:
    """Return recordings with a formula hidden in them, the formula, and its coefficient on each axis."""
    recordings = recordings_of(case)
    signals = {r.name: signals_of(case, r) for r in recordings}
    rng = np.random.default_rng([case.seed, case.number, 2])
    used = [r.name for r in recordings if r.role in SENSORS]
    u = np.concatenate([signals[n]["u"] for n in used])
    base = np.column_stack([np.ones(len(u)), u])
    spans = {}
    for name in ("temperature", "time", "speed"):
        signal = np.concatenate([signals[n][name] for n in used])
        spans[name] = (float(signal.min()), float(signal.max()))
    observed = observe(case.sensor, recordings, shipped_settings(table="acutronic").table)
    known = [_columns(effect, case.sensor, recordings, used) for effect in candidates_for(observed, [])]
    while True:
        text = drawn(rng, case.sensor, spans)
        added = np.concatenate([values(text, signals[n]) for n in used])
        rms = [left(added[:, c], base) for c in range(3)]
        c = int(np.argmax(rms))
        if rms[c] < 0.05 * float(np.std(added[:, c])) or rms[c] < 1e-12 or WARM_UP.match(text):
            continue
        shares = [1.0 - (left(added[:, c], np.column_stack([base, z[:, c]])) / rms[c]) ** 2 for z in known]
        if max(shares) < 0.95:
            break
    size = (SIZE[case.sensor] / rms[c] * rng.uniform(0.7, 1.3, 3) * rng.choice([-1.0, 1.0], 3)).tolist()
    out = []
    for r in recordings:
        extra = values(text, signals[r.name]) * size if signals[r.name] else 0.0
        out.append(replace(r, **{case.sensor: np.asarray(r.reading(case.sensor)) + extra}))
    return out, text, size


def _columns(effect: Any, sensor: str, recordings: list[Recording], used: list[str]) -> np.ndarray:  # noqa: ANN401
    """Return what an effect of the catalogue adds per parameter: (n, 3, q) array."""
    parts = []
    for r in recordings:
        motion = reference_motion(r, 1.0) if r.name in used else None
        if motion is not None:
            z = effect.regressors(sensor, motion, np.eye(3), effect.starts(sensor)[0])
            parts.append(np.repeat(z[:, None], 3, axis=1) if effect.layout == Layout.EVERY_AXIS else per_axis(z))
    return np.nan_to_num(np.concatenate(parts))


def signature(texts: list[str]) -> set[tuple[Any, ...]]:
    """Return the factors of formulas, without their constants; sines and cosines of one angle are one term."""
    return {_product(ast.parse(text, mode="eval").body) for text in texts}


def _product(node: ast.expr) -> tuple[Any, ...]:
    powers: Counter[str] = Counter()
    _collect(node, 1, powers)
    return tuple(sorted(powers.items()))


def _collect(node: ast.expr, power: float, powers: Counter[str]) -> None:
    if isinstance(node, ast.BinOp) and isinstance(node.op, (ast.Mult, ast.Div)):
        _collect(node.left, power, powers)
        _collect(node.right, power if isinstance(node.op, ast.Mult) else -power, powers)
    elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.Pow):
        _collect(node.left, power * float(ast.unparse(node.right)), powers)
    elif isinstance(node, ast.BinOp) and not any(isinstance(n, ast.Call) for n in ast.walk(node)):
        powers[" ".join(sorted({n.id for n in ast.walk(node) if isinstance(n, ast.Name)}))] += power
    elif isinstance(node, ast.Call):
        name, inside = node.func.id, ast.unparse(node.args[0])  # type: ignore[attr-defined]
        if name in ("sin", "cos"):
            cycles = next(n.value for n in ast.walk(node) if isinstance(n, ast.Constant) and isinstance(n.value, int))
            powers[f"harmonic {cycles}"] += 1
            return
        signals = sorted({n.id for n in ast.walk(node.args[0]) if isinstance(n, ast.Name)})
        sign = inside.replace("(", "").startswith(signals[0]) if name == "exp" else ""
        powers[f"{name}{sign} {' '.join(signals)}"] += power
    elif isinstance(node, ast.Name):
        powers[node.id] += power
    elif not isinstance(node, ast.Constant):
        powers[ast.unparse(node)] += power


def same(hidden: str, found: list[str], recordings: list[Recording], case: StudyCase) -> bool:
    """Return whether formulas have the form of the hidden one, and reproduce it where all signals are independent."""
    if signature([hidden]) != signature(found):
        return False
    rng = np.random.default_rng(0)
    known = [s for r in recordings if r.role in SENSORS and (s := signals_of(case, r))]
    mixed = {}
    for name in known[0]:
        every = np.concatenate([s[name][:, 0] if name == "u" else s[name] for s in known if s[name] is not None])
        mixed[name] = rng.choice(every, 4000)
    mixed["u"] = np.repeat(mixed["u"][:, None], 3, axis=1)
    want = values(hidden, mixed)[:, 0]
    base = np.column_stack([np.ones(4000), mixed["u"][:, 0]])
    columns = np.column_stack([base, *(values(text, mixed)[:, 0] for text in found)])
    return bool(1.0 - (left(want, columns) / left(want, base)) ** 2 > REPRODUCED)


def unit_of(recordings: list[Recording], depth: str) -> ConfiguredUnit:
    """Return recordings as a unit, at a depth of the diagnosis."""
    return unit_of_recordings(recordings, [f"sensor={MODEL}", f"diagnosis.depth={depth}"])


def hidden(number: int, seed: int, depth: str) -> JSON:
    """Hide one formula and return what the diagnosis said."""
    rng = np.random.default_rng([seed, number])
    sensor = SENSORS[int(rng.integers(2))]
    way = str(rng.choice(["stop_and_go", "continuous"], p=[0.7, 0.3]))
    case = StudyCase("formula", number, seed, MODEL, sensor, way, room_degc=CYCLE_DEGC)
    recordings, text, size = hide(case)
    began = time.process_time()
    unit = unit_of(recordings, depth)
    state = unit.run_to("diagnose")
    part = state.diagnosis[sensor]
    spent = time.process_time() - began
    effect = part["suggested_effect"]
    texts = [term["formula"] for term in effect["terms"].values()] if effect else []
    if effect:
        register(effect_from(effect, "suggested"))
    names = [*part["selected"], *([effect["name"]] if effect else [])]
    truth_of = {"name": "hidden", "owner": "table", "sensors": [sensor], "meaning": "Hidden.",
                "terms": {"A": {"formula": text, "unit": "1"}}}  # fmt: skip
    register(effect_from(truth_of, "the hidden formula"))

    def error(names: list[str]) -> JSON:
        try:
            return errors_with(unit, state, sensor, names)[0]
        except PipelineError as refused:  # what is proposed is not observable: the floor is not reached
            return {"before": 0.0, "after": None, "floor": 0.0, "error": str(refused)}

    best, held = error(["hidden"])["after"] or 0.0, error(names)
    forget()
    return {
        "number": number, "sensor": sensor, "procedure": way, "hidden": text, "size": size, "cpu_s": spent,
        "verdict": part["verdict"], "selected": part["selected"], "found": texts,
        "exact": bool(texts) and same(text, texts, recordings, case), "held_out": {**held, "best": best},
        "floor": held["after"] is not None and held["after"] <= AT_FLOOR * max(held["floor"], best),
        "stability": (part.get("formulas") or [{}])[0].get("stability"),
    }  # fmt: skip


def null(number: int, seed: int, depth: str) -> JSON:
    """Return what the diagnosis invents in a unit in which nothing is hidden; both sensors."""
    case = draw(f"null_{NOISES[number % len(NOISES)]}", number, seed)
    recordings = recordings_of(case)
    document = unit_of(recordings, depth).run_to("diagnose").diagnosis if case.model == MODEL else {}
    parts = {sensor: document[sensor] for sensor in SENSORS if sensor in document}
    found = {s: list(p["suggested_effect"]["terms"].values()) for s, p in parts.items() if p["suggested_effect"]}
    return {"number": number, "noise": case.noise, "judged": bool(parts), "invented": found,
            "verdicts": [p["verdict"] for p in parts.values()]}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("hidden", "null"))
    parser.add_argument("out", type=Path)
    parser.add_argument("--n", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="number of the first one, to divide a long study")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--figures", type=Path, help="file for the shares with their 95 % intervals")
    parser.add_argument("--depth", default="standard", choices=("standard", "full"))
    arguments = parser.parse_args()
    lines = read_lines(arguments.out)
    done, of = {line["number"] for line in lines}, {"hidden": hidden, "null": null}[arguments.what]
    with arguments.out.open("a", encoding="utf-8") as file:
        for number in range(arguments.first, arguments.first + arguments.n):
            if number not in done:
                lines.append(of(number, arguments.seed, arguments.depth))
                file.write(json.dumps(lines[-1], default=float) + "\n")
                file.flush()
                print(f"\r{len(lines)} of {arguments.n}", end="", file=sys.stderr)
    print()
    if arguments.what == "hidden":
        found = share("exact form", pd.Series([line["exact"] for line in lines], dtype=bool), ">= 60 %")
        found += share("held-out error at the floor", pd.Series([line["floor"] for line in lines], dtype=bool))
    else:
        invented = pd.Series([bool(n["invented"]) for n in lines if n["judged"]], dtype=bool)
        found = share("units with an invented formula", invented, "<= 1 %")
    for figure in found:
        print(*figure.cells)
    write_figures(arguments.figures, found)


if __name__ == "__main__":
    main()
