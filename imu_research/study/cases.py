"""Draw the cases of a study: the hidden effects of a unit with their sizes, and how the unit is recorded.

The family, the number and the study's seed determine a case. Families:

    single, small, tiny  one observable effect at the sensor file's size, x0.3, x0.1
    pairs, pairs_wander  two of them; with five times the bias wander
    triples              three
    null_<noise>         nothing; both sensors are judged
    null_sensors         nothing, in any sensor of ``sensor_files`` on any shipped table
    null_hand_<noise>    nothing, in any of them by hand, 15 to 40 rests
    hand_<procedure>     one effect of the sensor by hand, at the sensor file's size
    unseen               an effect that the procedure cannot show
    removed              one effect, which is then removed from the catalogue
    one_axis             an effect on one axis only
    shape_<shape>        physics in a functional form that is not in the catalogue
    lost, coarse, cold   one effect; a tenth of the samples lost, temperature in steps of 0.5 degC, no temperature
    cycle_<shape>        such a function of temperature, in a room that warms and cools by some degrees
    staged               one effect, in a unit whose base is calibrated stage by stage
    limit_<percent>      one effect at 30, 60 or 100 % of its detection size (``imu_research.study.bench.at_detection``)
    lag                  bias over temperature, x0.3, and a lag of the thermometer, in a chamber that heats and cools

Effects have the size that the data sheet states: for the MPU-6050 the MPU-6000/6050 product specification 3.4, for the
STIM300 its data sheet TS1524 and that of the STIM210's gyroscopes. Other sizes, like the shares and rates below, are
assumptions. One number stands for all parameters, with random signs. A lag is at least the shortest of the register
map.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from imu_logs.yaml_file import read_yaml
from pipeline.core.files import CONFIGS
from pipeline.core.records import SENSORS, Values
from pipeline.core.settings import DataSheet
from pipeline.estimation.uncertainty_budget import DITHERED
from pipeline.physics.effects import effect
from pipeline.physics.kinematics import EARTH_RATE_DPS
from pipeline.simulation.description import shipped_settings

NOISES = ("white", "normal", "wander", "random_walk", "one_over_f", "ar_06", "ar_09")
SHAPES = ("gear_mesh", "temperature_step", "saturation", "exponential", "band")
OF_TEMPERATURE = ("temperature_step", "saturation", "exponential")
FAMILIES = (
    "single", "small", "tiny", "pairs", "pairs_wander", "triples", *(f"null_{noise}" for noise in NOISES), "unseen",
    "removed", "one_axis", *(f"shape_{shape}" for shape in SHAPES), "lost", "coarse", "cold",
    *(f"cycle_{shape}" for shape in OF_TEMPERATURE), "staged", "limit_30", "limit_60", "limit_100", "null_sensors",
    *(f"null_hand_{noise}" for noise in ("white", "normal", "wander", "random_walk")),
    *(f"hand_{procedure}" for procedure in ("multi_position", "ferraris", "orientations_24")), "lag",
)  # fmt: skip  # a new one goes last: its place is part of every case's random numbers
# Long recordings at several rates, so that each observable effect can be detected.
LONG: dict[str, Any] = {"rates_dps": (20.0, 60.0, 100.0, 200.0), "static_s": 300.0}
COURSES: dict[str, dict[str, Any]] = {
    "stop_and_go": {**LONG, "step_deg": 3.0, "dwell_s": 2.0, "both_directions": True},
    "continuous": {**LONG, "accelerometer_rates_dps": (2.0, 5.0, 30.0), "both_directions": True},
    "one_way": {**LONG, "step_deg": 3.0, "dwell_s": 2.0},
}
ALTERNATIVES = [  # not hidden together: their signals are nearly alike
    {"time_offset", "low_pass_lag"},
    {"lever_arm", "inner_lever_arms"},
    {"bias_temperature", "bias_temperature_quadratic"},
    {"table_rate_ripple", "table_encoder_error"},
]
FACTOR = {"small": 0.3, "tiny": 0.1, "lag": 0.3}  # of the sensor file's size
WANDER = {"white": 0.0, "normal": 1.0, "wander": 5.0, "random_walk": 0.0, "one_over_f": 0.0}  # of the sensor file's
STIM_SHARE = 0.25  # of the units of the families that have both models
# that fit a base
METHODS = REFERENCE, STAGED, METHODS_OF_HAND_HELD_CASES = "reference_least_squares", "staged", "rests_and_moves"
INTERVAL_S, INTERVAL_BY_HAND_S = 0.12, 0.01  # of a sample: the default of a simulation; by hand, moves are faster
# tables of null_sensors and their shares; the last takes 20 times as long
TABLE_SHARES = {"acutronic": 0.5, "mark2": 0.45, "single_axis": 0.05}
RESTS_BY_HAND = 15, 40  # by hand; from 15 on, some are held out of a fit
CYCLE_DEGC = 4.0  # swing of a room without air conditioning over hours
LAG_S = 10.0, 60.0  # of a thermometer, by assumption: packages of grams
SIZES_FILE = Path(__file__).with_name("sizes.yaml")
_OF_FILE = read_yaml(SIZES_FILE)
SIZES: dict[str, dict[str, dict[str, float | list[float]]]] = _OF_FILE["sizes"]  # by model and sensor
FAINT: dict[str, dict[str, list[str]]] = _OF_FILE["faint"]  # effects that hide in the noise
UNSEEN: dict[str, dict[str, list[str]]] = _OF_FILE["unseen"]  # by procedure and sensor
SHOWN_BY_HAND: dict[str, list[str]] = _OF_FILE["by_hand"]  # that rests in many attitudes, or moves, can show


@dataclass(frozen=True)
class StudyCase:
    """The truth of one unit of a study."""

    family: str
    number: int
    seed: int
    model: str
    sensor: str  # the sensor with the hidden effects
    procedure: str
    hidden: dict[str, list[float]] = field(default_factory=dict)  # effects and their parameters
    wander: float = 1.0  # bias wander, relative to the sensor file
    noise: str = "normal"
    left_out: tuple[str, ...] = ()  # effects that are removed from the catalogue
    shape: str = ""  # of physics that is not in the catalogue
    amplitude: tuple[float, ...] = ()  # of that physics on each axis, relative to ``bench.AMPLITUDE``
    room_degc: float | None = None  # swing of the room's temperature; None: the simulator's
    method: str = REFERENCE  # by which the base is calibrated
    table: str = "acutronic"  # ``hand``: rests and moves by hand
    rests: int = 0  # of multi_position

    @property
    def by_hand(self) -> bool:
        """Whether the unit is recorded without a table."""
        return self.table == "hand"

    @property
    def key(self) -> str:
        """The identifier of the case in a study's files."""
        return f"{self.family}-{self.number:05d}"

    @property
    def kind(self) -> str:
        """The first word of the family."""
        return self.family.partition("_")[0]

    def to_json(self) -> dict[str, Any]:
        """Return the case as a JSON document."""
        return {"key": self.key, **asdict(self)}


def draw(family: str, number: int, seed: int) -> StudyCase:
    """Draw the case that family, number and seed determine."""
    rng = np.random.default_rng([seed, FAMILIES.index(family), number])
    kind, _, detail = family.partition("_")
    model = "stim300" if kind in ("single", "null") and rng.random() < STIM_SHARE else "mpu6050"
    sensor = str(rng.choice(SENSORS))
    procedure = str(rng.choice(["stop_and_go", "continuous", "one_way"], p=[0.5, 0.3, 0.2]))
    if kind == "null":
        by_hand, noise = detail.startswith("hand_"), detail.removeprefix("hand_")
        case = StudyCase(family, number, seed, model, sensor, procedure, noise=noise, wander=WANDER.get(noise, 1.0))
        if detail == "sensors" or by_hand:
            case = replace(case, model=str(rng.choice(sensor_files(INTERVAL_BY_HAND_S if by_hand else INTERVAL_S))))
        if detail == "sensors":
            return replace(case, noise="normal", table=str(rng.choice([*TABLE_SHARES], p=[*TABLE_SHARES.values()])))
        rests = int(rng.integers(RESTS_BY_HAND[0], RESTS_BY_HAND[1] + 1)) if by_hand else 0
        return (
            replace(case, procedure="multi_position", method=METHODS_OF_HAND_HELD_CASES, table="hand", rests=rests)
            if by_hand
            else case
        )
    if kind in ("shape", "cycle"):
        procedure = "continuous" if detail == "band" else "stop_and_go"
        amplitude = tuple((rng.uniform(0.7, 1.3, 3) * rng.choice([-1.0, 1.0], 3)).tolist())
        room = CYCLE_DEGC if kind == "cycle" else None
        return StudyCase(
            family, number, seed, model, sensor, procedure, shape=detail, amplitude=amplitude, room_degc=room
        )
    if kind == "hand":
        name = str(rng.choice(SHOWN_BY_HAND[sensor]))
        hidden = {name: drawn("mpu6050", sensor, name, rng).tolist()}
        rests = int(rng.integers(RESTS_BY_HAND[0], RESTS_BY_HAND[1] + 1)) if detail == "multi_position" else 0
        case = StudyCase(family, number, seed, "mpu6050", sensor, detail, hidden, rests=rests, table="hand")
        return replace(case, method=METHODS_OF_HAND_HELD_CASES)
    if kind == "unseen":
        return _unseen(number, seed, rng)
    if kind in ("staged", "lag"):
        procedure = "stop_and_go"  # the method needs rests, and turns in both directions; a lag needs time
    names = _names(kind, model, sensor, procedure, rng)
    hidden = _hidden(kind, names, model, sensor, rng)
    return replace(
        StudyCase(family, number, seed, model, sensor, procedure),
        hidden={name: values.tolist() for name, values in hidden.items()},
        wander=5.0 if detail == "wander" else 1.0,
        noise=family if family in ("lost", "coarse", "cold") else "normal",
        left_out=tuple(names) if kind == "removed" else (),
        method=STAGED if kind == "staged" else REFERENCE,
    )


def _hidden(kind: str, names: list[str], model: str, sensor: str, rng: np.random.Generator) -> dict[str, Values]:
    """Draw the parameters of effects."""
    hidden = {name: drawn(model, sensor, name, rng, FACTOR.get(kind, 1.0)) for name in names}
    if kind == "one":  # parameters are in the order of the axes
        for values in hidden.values():
            values.reshape(3, -1)[np.arange(3) != rng.integers(3)] = 0.0
    if kind == "lag":
        hidden["temperature_lag"] = hidden["bias_temperature"] * rng.uniform(*LAG_S)
    return hidden


def _names(kind: str, model: str, sensor: str, procedure: str, rng: np.random.Generator) -> list[str]:
    pool = ["bias_temperature"] if kind == "lag" else observable(model, sensor, procedure)
    if kind == "one":
        pool = [name for name in pool if len(effect(name).parameters(sensor)) % 3 == 0 and name != "lever_arm"]
    if kind == "cold":
        pool = [name for name in pool if "temperature" not in effect(name).needs]
    count = {"pairs": 2, "triples": 3}.get(kind, 1)
    while True:
        names = [str(name) for name in rng.choice(pool, count, replace=False)]
        if not any(len(same & set(names)) > 1 for same in ALTERNATIVES):
            return names


def _unseen(number: int, seed: int, rng: np.random.Generator) -> StudyCase:
    """Draw an effect that is not observable: in turns in one direction, of the table to a gyroscope, or at rest."""
    cells = [("one_way", "gyroscope", name) for name in sorted(UNSEEN["one_way"]["gyroscope"])]
    cells += [(way, "gyroscope", name) for way in ("stop_and_go", "one_way") for name in UNSEEN["any"]["gyroscope"]]
    cells += [("at_rest", "accelerometer", name) for name in UNSEEN["at_rest"]["accelerometer"]]
    procedure, sensor, name = cells[int(rng.integers(len(cells)))]
    hidden = {name: drawn("mpu6050", sensor, name, rng).tolist()}
    return StudyCase("unseen", number, seed, "mpu6050", sensor, procedure, hidden)


@cache
def sensor_files(interval_s: float) -> list[str]:
    """Return the shipped sensor files whose rounding to counts is noise: white noise dithers it in both sensors."""

    def dithered(data_sheet: DataSheet) -> bool:
        return data_sheet.white(interval_s) * data_sheet.counts_per_unit >= DITHERED

    names = sorted(path.stem for path in (CONFIGS / "sensor").glob("*.yaml"))
    models = {name: shipped_settings(sensor=name).sensor for name in names}
    return [name for name, model in models.items() if all(dithered(model.of(sensor)) for sensor in SENSORS)]


def observable(model: str, sensor: str, procedure: str) -> list[str]:
    """Return the effects that are observable with a procedure at their size."""
    hidden = set(FAINT[model][sensor])
    for kind in ("any", "alike", procedure):
        hidden.update(UNSEEN.get(kind, {}).get(sensor, ()))
    return [name for name in SIZES[model][sensor] if name not in hidden]


def drawn(model: str, sensor: str, name: str, rng: np.random.Generator, factor: float = 1.0) -> Values:
    """Return the parameters of an effect at its size times ``factor``, within 30 %, with random signs."""
    count = len(effect(name).parameters(sensor))
    size = SIZES[model][sensor][name]
    values = np.broadcast_to(np.atleast_1d(np.array(size, float)), count) * factor * rng.uniform(0.7, 1.3)
    values = values * rng.choice([-1.0, 1.0], count)
    if name == "low_pass_lag":
        values = np.abs(values)
    if name == "earth_rotation":  # a sensor cannot sense more than Earth turns
        values *= min(1.0, EARTH_RATE_DPS / float(np.linalg.norm(values)))
    if name == "warm_up":
        values[3] = np.exp(rng.uniform(np.log(90.0), np.log(400.0)))
    return np.asarray(values, np.float64)
