"""The cases of a study: what is hidden in a unit, and how it is recorded.

Every case follows from its family, number and the study's seed. Families:

    single, small, tiny  one observable effect at its data sheet's size, x0.3, x0.1
    pairs, pairs_wander  two of them; with five times the bias wander
    triples              three
    null_<noise>         nothing; both sensors are judged
    unseen               an effect that the procedure cannot show
    removed              one effect, which the catalogue is then left without
    one_axis             an effect on one axis only
    shape_<shape>        physics in another functional form than the catalogue's
    lost, coarse, cold   one effect; a tenth of the samples lost, temperature in steps of 0.5 degC, no temperature
    cycle_<shape>        a form of the temperature's, in a room that warms and cools by some degrees
    staged               one effect, in a unit whose base is calibrated stage by stage
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from pipeline.model.effects import effect
from pipeline.records import SENSORS
from pipeline.study.sizes import AT_REST, ONE_WAY, UNSEEN_GYROSCOPE, drawn, observable

NOISES = ("white", "normal", "wander", "random_walk", "one_over_f", "ar_06", "ar_09")
SHAPES = ("gear_mesh", "temperature_step", "saturation", "exponential", "band")
OF_TEMPERATURE = ("temperature_step", "saturation", "exponential")
FAMILIES = (
    "single", "small", "tiny", "pairs", "pairs_wander", "triples", *(f"null_{noise}" for noise in NOISES), "unseen",
    "removed", "one_axis", *(f"shape_{shape}" for shape in SHAPES), "lost", "coarse", "cold",
    *(f"cycle_{shape}" for shape in OF_TEMPERATURE), "staged",
)  # fmt: skip  # a new one goes last: its place is part of every case's random numbers
LONG: dict[str, Any] = {"rates_dps": (20.0, 60.0, 100.0, 200.0), "static_s": 300.0}
COURSES: dict[str, dict[str, Any]] = {
    "stop_and_go": {**LONG, "step_deg": 3.0, "dwell_s": 2.0, "both_directions": True},
    "continuous": {**LONG, "accelerometer_rates_dps": (2.0, 5.0, 30.0), "both_directions": True},
    "one_way": {**LONG, "step_deg": 3.0, "dwell_s": 2.0},
}
ALTERNATIVES = [
    {"time_offset", "low_pass_lag"},
    {"lever_arm", "inner_lever_arms"},
    {"bias_temperature", "bias_temperature_quadratic"},
    {"table_rate_ripple", "table_encoder_error"},
]
FACTOR = {"small": 0.3, "tiny": 0.1}
WANDER = {"white": 0.0, "normal": 1.0, "wander": 5.0, "random_walk": 0.0, "one_over_f": 0.0}
STIM_SHARE = 0.25
REFERENCE, STAGED = "reference_least_squares", "staged"
CYCLE_DEGC = 4.0


@dataclass(frozen=True)
class Case:
    """One unit of a study, its truth.

    Attributes
    ----------
    family : str
    number, seed : int
    model, sensor, procedure : str
        Sensor model, the sensor in which something is hidden, and how it is recorded.
    hidden : dict of str to list of float
        Effects and their parameters.
    wander : float
        Bias wander over that of the data sheet.
    noise : str
    left_out : tuple of str
        Effects that the catalogue is left without.
    shape : str
        Of physics that is not in the catalogue; empty for none.
    amplitude : tuple of float
        Of that physics on each axis, over ``pipeline.study.bench.AMPLITUDE``.
    room_degc : float or None
        Swing of the room's temperature, where it is not the usual one.
    method : str
        By which the base is calibrated.
    """

    family: str
    number: int
    seed: int
    model: str
    sensor: str
    procedure: str
    hidden: dict[str, list[float]] = field(default_factory=dict)
    wander: float = 1.0
    noise: str = "normal"
    left_out: tuple[str, ...] = ()
    shape: str = ""
    amplitude: tuple[float, ...] = ()
    room_degc: float | None = None
    method: str = REFERENCE

    @property
    def key(self) -> str:
        """What identifies it in a study's files."""
        return f"{self.family}-{self.number:05d}"

    @property
    def kind(self) -> str:
        """The first word of its family."""
        return self.family.partition("_")[0]

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON holds it."""
        return {"key": self.key, **asdict(self)}


def draw(family: str, number: int, seed: int) -> Case:
    """Draw one case.

    Parameters
    ----------
    family : str
    number, seed : int
        They determine it, with the family.
    """
    rng = np.random.default_rng([seed, FAMILIES.index(family), number])
    kind, _, detail = family.partition("_")
    model = "stim300" if kind in ("single", "null") and rng.random() < STIM_SHARE else "mpu6050"
    sensor = str(rng.choice(SENSORS))
    procedure = str(rng.choice(["stop_and_go", "continuous", "one_way"], p=[0.5, 0.3, 0.2]))
    if kind == "null":
        wander = WANDER.get(detail, 1.0)
        return Case(family, number, seed, model, sensor, procedure, noise=detail, wander=wander)
    if kind in ("shape", "cycle"):
        procedure = "continuous" if detail == "band" else "stop_and_go"
        amplitude = tuple((rng.uniform(0.7, 1.3, 3) * rng.choice([-1.0, 1.0], 3)).tolist())
        room = CYCLE_DEGC if kind == "cycle" else None
        return Case(family, number, seed, model, sensor, procedure, shape=detail, amplitude=amplitude, room_degc=room)
    if kind == "unseen":
        return _unseen(number, seed, rng)
    if kind == "staged":
        procedure = "stop_and_go"  # the method needs rests, and turns in both directions
    wander = 5.0 if detail == "wander" else 1.0
    names = _names(kind, model, sensor, procedure, rng)
    hidden = {name: drawn(model, sensor, name, rng, FACTOR.get(family, 1.0)) for name in names}
    if kind == "one":
        hidden = {name: _on_one_axis(sensor, name, values, rng) for name, values in hidden.items()}
    return Case(
        family,
        number,
        seed,
        model,
        sensor,
        procedure,
        {name: values.tolist() for name, values in hidden.items()},
        wander,
        noise=family if family in ("lost", "coarse", "cold") else "normal",
        left_out=tuple(names) if kind == "removed" else (),
        method=STAGED if kind == "staged" else REFERENCE,
    )


def _names(kind: str, model: str, sensor: str, procedure: str, rng: np.random.Generator) -> list[str]:
    pool = observable(model, sensor, procedure)
    if kind == "one":
        pool = [name for name in pool if len(effect(name).parameters(sensor)) % 3 == 0 and name != "lever_arm"]
    if kind == "cold":
        pool = [name for name in pool if "temperature" not in effect(name).needs]
    count = {"pairs": 2, "triples": 3}.get(kind, 1)
    while True:
        names = [str(name) for name in rng.choice(pool, count, replace=False)]
        if not any(len(same & set(names)) > 1 for same in ALTERNATIVES):
            return names


def _on_one_axis(sensor: str, name: str, values: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the parameters of one axis, the others zero; per-axis parameters are named ``.._x`` or ``.._x?``."""
    each = values.reshape(3, -1).copy()
    each[np.arange(3) != rng.integers(3)] = 0.0
    found: np.ndarray = each.ravel() if len(values) == len(effect(name).parameters(sensor)) else values
    return found


def _unseen(number: int, seed: int, rng: np.random.Generator) -> Case:
    """Draw an effect that the procedure cannot show: in one direction, of the table to a gyroscope, at rest."""
    cells = [("one_way", "gyroscope", name) for name in sorted(ONE_WAY["gyroscope"])]
    cells += [(way, "gyroscope", name) for way in ("stop_and_go", "one_way") for name in UNSEEN_GYROSCOPE]
    cells += [("at_rest", "accelerometer", name) for name in AT_REST]
    procedure, sensor, name = cells[int(rng.integers(len(cells)))]
    hidden = {name: drawn("mpu6050", sensor, name, rng).tolist()}
    return Case("unseen", number, seed, "mpu6050", sensor, procedure, hidden)
