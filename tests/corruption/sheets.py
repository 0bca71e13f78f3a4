"""Corrupt the recordings of a sheet, or the sheet, at random, calibrate each unit, and count what came of it.

python tests/corruption/sheets.py --units 210 --seed 1 [--first 0] [--cores 1] [--figures FILE]

Good units are those of ``tests/study/listed_recordings.py``: turns, attitudes, slow movement, soaks and tables, by a
simulation that shares no code with the package. One way of ``WAYS`` changes each. Outcomes are those of ``judged``,
here with U that includes the effects that the recordings leave open.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import pandas as pd

sys.path.insert(0, str(Path(__file__).parents[2]))
sys.path.insert(0, str(Path(__file__).parent))

from judged import DOUBTFUL, LEAST_U, MANY_U, MARKED, NAMED, OUTCOMES, REFUSED, RIGHT, SILENT, UNSEEN, shares_of
from unit_copy import ANGLE, COLUMNS, RATE, TEMPERATURE, TIME, NotApplicableError

from imu_research.figures import write_figures
from pipeline.app.one_unit import try_unit, unit_without_campaign
from pipeline.core.errors import PipelineError
from tests.study.listed_recordings import KINDS, WHITE, Unit

if TYPE_CHECKING:
    from collections.abc import Callable

SIZE = {"accelerometer": 1.0, "gyroscope": 100.0}  # g and deg/s: what a recording typically spans
Outcome = tuple[str, str]  # and what it says of the unit


class Recorded:
    """The files and the sheet of a good unit, and what is changed in them."""

    def __init__(self, unit: Unit, kind: str, rng: np.random.Generator) -> None:
        self.unit, self.kind, self.rng = unit, kind, rng
        self.files = {file.stem: pd.read_csv(file) for file in sorted(unit.folder.glob("*.csv"))}
        del self.files["recordings"]
        self.rows = [row.split(",") for row in unit.rows]
        self.said: list[str] = []
        self.hidden = self.unseen = ""

    def draw(self, *values: Any) -> Any:
        """Draw one of some values, and note it."""
        found = values[int(self.rng.integers(len(values)))]
        self.said.append(f"{found:.4g}" if isinstance(found, float) else str(found))
        return found

    def sensor(self) -> str:
        """Draw a sensor that is logged."""
        return str(self.draw(*(s for s in COLUMNS if self.named(COLUMNS[s][0]))))

    def named(self, column: str) -> list[str]:
        """Return the files with a column."""
        return [name for name, table in self.files.items() if column in table]

    def file(self, column: str) -> pd.DataFrame:
        """Draw a file with a column."""
        if not self.named(column):
            raise NotApplicableError(f"no {column}")
        return self.files[self.draw(*self.named(column))]

    def row(self, *kinds: str) -> list[str]:
        """Draw a row of the sheet of one of some kinds."""
        rows = [row for row in self.rows[1:] if row[1] in kinds]
        if not rows:
            raise NotApplicableError(f"no row of {kinds}")
        return list(self.draw(*rows))

    def replace(self, row: list[str], *cells: str) -> None:
        """Replace the cells after the name of a row."""
        self.rows[self.rows.index(row)] = [row[0], *cells]

    def map_readings(self, sensor: str, A: np.ndarray) -> None:
        """Replace readings of a sensor by A @ reading: in one file, or in all, where that is another sensor."""
        names, columns = self.named(COLUMNS[sensor][0]), COLUMNS[sensor]
        chosen = names if self.draw("one", "one", "all") == "all" else [self.draw(*names)]
        for name in chosen:
            self.files[name][columns] = self.files[name][columns].to_numpy() @ A.T
        if len(chosen) == len(names):
            self.unit.bias[sensor], self.unit.K[sensor] = A @ self.unit.bias[sensor], A @ self.unit.K[sensor]
            if self.kind == "soak":
                self.unseen = "a unit at rest shows neither scale factor nor sign of its gyroscope"

    def write(self) -> None:
        for name, table in self.files.items():
            table.to_csv(self.unit.folder / f"{name}.csv", index=False, float_format="%.10g")
        (self.unit.folder / "recordings.csv").write_text("\n".join(map(",".join, self.rows)) + "\n")


def scaled(made: Recorded) -> None:
    """Another unit or range, or the sign."""
    sensor = made.sensor()
    unit = {"accelerometer": 9.80665, "gyroscope": np.pi / 180.0}[sensor]
    made.map_readings(sensor, np.eye(3) * made.draw(unit, 2.0, 0.5, 1.05, 1.005, -1.0))


def scaled_axis(made: Recorded) -> None:
    """One axis by a factor."""
    made.map_readings(made.sensor(), np.diag(made.rng.permutation([1.0, 1.0, made.draw(2.0, 0.7, 1.2, -1.0)])))


def reordered(made: Recorded) -> None:
    """Axes exchanged."""
    made.map_readings(made.sensor(), np.eye(3)[list(made.draw((1, 0, 2), (1, 2, 0), (2, 1, 0)))])


def offset(made: Recorded) -> None:
    """Another bias in one of several files."""
    sensor = made.sensor()
    if len(made.named(COLUMNS[sensor][0])) < 2:
        raise NotApplicableError("in a single file, this is the sensor's bias")
    table, size = made.file(COLUMNS[sensor][0]), made.draw(0.003, 0.02, 0.2) * SIZE[sensor]
    table[COLUMNS[sensor]] += size * made.rng.choice([-1.0, 1.0], 3)


def part_changed(made: Recorded) -> None:
    """Spikes, a step, an axis that stops, clipping, noise, a line in time or a vibration in one file."""
    sensor = made.sensor()
    columns = COLUMNS[sensor]
    table, how = made.file(columns[0]), made.draw("spike", "step", "stuck", "clip", "noise", "drift", "shaken")
    n, column, size = len(table), str(made.rng.choice(columns)), SIZE[sensor] * made.draw(0.02, 0.1, 1.0)
    first, shape = int(made.rng.integers(n)), made.rng.choice([-1.0, 1.0], 3)
    if how == "spike":
        table.loc[first : first + made.draw(1, 5, 30) - 1, column] += size
    elif how == "step":
        table.loc[first:, column] += size
    elif how == "stuck":
        table.loc[first : first + int(made.draw(0.3, 1.0) * n), column] = table[column].iloc[first]
    elif how == "clip":
        largest = made.draw(0.8, 0.95) * np.abs(table[columns].to_numpy()).max()
        table[columns] = table[columns].clip(-largest, largest)
    elif how == "noise":
        table[columns] += made.draw(5.0, 30.0) * WHITE[sensor] * made.rng.standard_normal((n, 3))
    else:
        line = np.linspace(0.0, 1.0, n) if how == "drift" else np.sin(2.0 * np.pi * 3.1 * np.arange(n) / 100.0)
        table[columns] += 0.3 * size * np.outer(line, shape)


def times(made: Recorded) -> None:
    """Times in another unit, or of a clock that runs at another speed, in one file or all."""
    factor = made.draw(1e3, 1e6, 1.1, 0.5, 1.0 / 60.0)
    names = made.named(TIME)
    if not names:
        raise NotApplicableError("no times")
    for name in names if made.draw("all", "one") == "all" else [made.draw(*names)]:
        made.files[name][TIME] *= factor


def rows(made: Recorded) -> None:
    """Rows lost, repeated or in the wrong order."""
    table, how = made.file(TIME), made.draw("block", "random", "cut", "repeated", "reversed")
    name, n = made.said[-2], len(table)
    first, later = int(made.rng.integers(n)), table.assign(**{TIME: table[TIME] + table[TIME].iloc[-1] + 0.01})
    made.files[name] = {
        "block": table.drop(table.index[first : first + n // 5]),
        "random": table[made.rng.random(n) > 0.1],
        "cut": table.iloc[: n // 2],
        "repeated": pd.concat([table, later]),
        "reversed": table.iloc[::-1].assign(**{TIME: table[TIME].to_numpy()}),
    }[how].reset_index(drop=True)


def column_changed(made: Recorded) -> None:
    """The temperature or a table's channel in another unit, late, reversed, constant or noisy."""
    column = made.draw(*([c] if made.named(c) else [] for c in (TEMPERATURE, ANGLE, RATE)))
    if not column:
        raise NotApplicableError("no such column")
    table = made.file(column[0])
    x, late = table[column[0]].to_numpy(), len(table) // 30
    table[column[0]] = {
        "fahrenheit": 1.8 * x + 32.0,
        "radian": np.radians(x),
        "negative": 50.0 * (column[0] == TEMPERATURE) - x,
        "reversed": x[::-1],
        "late": np.r_[np.full(late, x[0]), x[: len(x) - late]],
        "constant": np.full(len(x), x[0]),
        "noise": x + 2.0 * made.rng.standard_normal(len(x)),
        "1.02": 1.02 * x,
    }[made.draw("fahrenheit", "radian", "negative", "reversed", "late", "constant", "noise", "1.02")]


def of_another(made: Recorded) -> None:
    """A file of another unit, beside others."""
    if len(made.files) < 2:
        raise NotApplicableError("no recording shows of which unit it is")
    name = made.draw(*made.files)
    with tempfile.TemporaryDirectory() as folder:
        KINDS[made.kind](Unit(Path(folder), made.rng))
        if not (Path(folder) / f"{name}.csv").is_file():
            raise NotApplicableError("it has no such file")
        made.files[name] = pd.read_csv(Path(folder) / f"{name}.csv")


def exchanged(made: Recorded) -> None:
    """Two files exchanged in the sheet."""
    one, other = made.row(*KINDS_OF_ROWS), made.row(*KINDS_OF_ROWS)
    if one[1:] == other[1:]:
        raise NotApplicableError("their rows are equal")
    made.replace(one, *other[1:])
    made.replace(other, *one[1:])


def wrong_axis(made: Recorded) -> None:
    """Another axis in the sheet."""
    row = made.row("turn", "table")
    made.replace(row, row[1], {"x": "y", "y": "z", "z": "x"}[row[2]], *row[3:])


def wrong_angle(made: Recorded) -> None:
    """Another angle in the sheet, or another accuracy of all angles."""
    row = made.row("turn")
    angle = float(row[3] or 360.0)
    stated = made.draw(-angle, angle / 2.0, 2.0 * angle, angle + 10.0, angle + 90.0, angle - 3.0)
    made.replace(row, *row[1:3], f"{stated:g}", *row[4:])


def wrong_accuracy(made: Recorded) -> None:
    """A tenth, or ten times, the accuracy of all angles."""
    factor = made.draw(0.1, 10.0)
    made.row("turn")
    made.rows = [[*r[:4], f"{float(r[4]) * factor:.3g}", *r[5:]] if r[1] == "turn" else r for r in made.rows]


def wrong_kind(made: Recorded) -> None:
    """Another kind in the sheet."""
    row = made.row(*KINDS_OF_ROWS)
    kind = made.draw(*(k for k in KINDS_OF_ROWS if k != row[1]))
    axis = (row[2] or "x") if kind in ("turn", "table") else ""
    made.replace(row, kind, axis, *(("360", "1") if kind == "turn" else ("", "")), *row[5:])


def attitudes_changed(made: Recorded) -> None:
    """Outliers, two units, repeated rows or too few of means."""
    if made.kind != "attitudes":
        raise NotApplicableError("no means")
    mean, how = made.files["means"].to_numpy(), made.draw("outlier", "outliers", "units", "repeated", "half", "few")
    off = made.rng.random(len(mean)) < {"outlier": 1.5 / len(mean), "outliers": 0.15}.get(how, 0.0)
    mean = mean + off[:, None] * 0.05 * made.rng.standard_normal(mean.shape)
    mean = mean * np.where(np.arange(len(mean)) >= len(mean) // 2, 9.80665 if how == "units" else 1.0, 1.0)[:, None]
    kept = {"repeated": np.r_[mean, mean[:5], mean[:5]], "half": mean[mean[:, 2] > 0.3], "few": mean[:8]}
    made.files["means"] = pd.DataFrame(kept.get(how, mean), columns=COLUMNS["accelerometer"])


def hidden_effect(made: Recorded) -> None:
    """An effect that the catalogue holds, of a size beyond its limit."""
    sensor = made.sensor()
    made.hidden = (
        "quadratic_nonlinearity" if sensor == "accelerometer" else made.draw("g_sensitivity", "quadratic_nonlinearity")
    )
    sensitivity, size = made.rng.standard_normal((3, 3)), made.draw(0.01, 0.05)
    for name in made.named(COLUMNS[sensor][0]):
        table = made.files[name]
        reading = table[COLUMNS[sensor]].to_numpy()
        if made.hidden == "quadratic_nonlinearity":
            added = size * SIZE[sensor] * np.square(reading / SIZE[sensor])
        elif COLUMNS["accelerometer"][0] in table:
            added = 10.0 * size * table[COLUMNS["accelerometer"]].to_numpy() @ sensitivity
        else:
            raise NotApplicableError("no specific force")
        table[COLUMNS[sensor]] = reading + added


KINDS_OF_ROWS = ("rest", "turn", "moves", "slow", "soak", "attitudes", "table")
WAYS: tuple[Callable[[Recorded], None], ...] = (
    scaled, scaled_axis, reordered, offset, part_changed, part_changed, times, rows, column_changed, of_another,
    exchanged, wrong_axis, wrong_angle, wrong_accuracy, wrong_kind, attitudes_changed, hidden_effect,
)  # fmt: skip


def judged_unit(number: int, seed: int) -> list[Outcome]:
    """Corrupt, calibrate and judge a unit; returns the outcome of each sensor, with what was done and found."""
    rng, kind = np.random.default_rng([seed, number]), [*KINDS][number % len(KINDS)]
    while True:
        way = WAYS[int(rng.integers(len(WAYS)))]
        with tempfile.TemporaryDirectory() as folder:
            unit = Unit(Path(folder), np.random.default_rng([seed, number, 1]))
            KINDS[kind](unit)
            unit.sheet()
            made = Recorded(unit, kind, rng)
            try:
                way(made)
            except NotApplicableError:
                continue
            made.write()
            did = f"{number} {kind} {way.__name__} {' '.join(made.said)}"
            return [(outcome, f"{did}: {found}") for outcome, found in _outcomes(made)]


def _outcomes(made: Recorded) -> list[Outcome]:
    table = "single_axis" if made.kind.startswith("table") else "hand"
    overrides = ["table.seat_deg=null"] if table != "hand" else []
    chosen = {"sensor": "mpu6050", "table": table, "procedure": "listed", "method": None}
    try:
        state, failure = try_unit(unit_without_campaign(made.unit.folder, chosen, overrides, ()), "calibration")
    except PipelineError as error:
        return [(REFUSED, error.message)]
    if failure:
        assert failure["code"] != "internal_error", failure
        return [(REFUSED, f"{failure['code']}: {failure['message']}")]
    document, diagnosis = state.calibration, state.diagnosis
    assert document is not None
    assert diagnosis is not None
    logged = [sensor for sensor in COLUMNS if made.named(COLUMNS[sensor][0])]
    return [
        _outcome(made, document, diagnosis[sensor], sensor)
        if document[sensor]
        else (REFUSED, document["not_calibrated"].get(sensor, ""))
        for sensor in logged
    ]


def _outcome(made: Recorded, document: dict[str, Any], said: dict[str, Any], sensor: str) -> Outcome:
    part, truth = document[sensor], made.unit.truth(sensor, in_case=document["accelerometer"] is None)
    value = np.concatenate([part["bias"], np.ravel(part["matrix"])])
    stated = part.get("uncertainty_with_open") or part["expanded_uncertainty"]
    U = np.concatenate([stated["bias"], np.ravel(stated["matrix"])]).astype(float)
    off = np.abs(value - truth) / np.maximum(np.nan_to_num(U), LEAST_U)
    verdict = str(said["verdict"])
    found = f"{sensor} {verdict} {','.join(said['selected'])}, worst of 12 parameters {off.max():.3g} U"
    if verdict not in ("nothing_missing", "missing_effect"):
        return DOUBTFUL, found
    if verdict == "missing_effect" and made.hidden in said["selected"]:
        return NAMED, found
    if off.max() <= MANY_U:
        return RIGHT, found
    return (UNSEEN if made.unseen else MARKED if part.get("implausible") else SILENT), found


def main() -> int:
    """Run it; exit code 1 with a silent error."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--units", type=int, default=210)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--cores", type=int, default=1)
    parser.add_argument("--figures", type=Path, help="file for the shares with their 95 % intervals")
    options = parser.parse_args()
    count: Counter[str] = Counter()
    numbers = range(options.first, options.first + options.units)
    with ProcessPoolExecutor(options.cores) as pool:
        for outcomes in pool.map(partial(judged_unit, seed=options.seed), numbers):
            for outcome, line in outcomes:
                count[outcome] += 1
                sys.stdout.write(f"{outcome}: {line}"[:300] + "\n")
    outcomes = ", ".join(f"{outcome} {count[outcome]}" for outcome in OUTCOMES)
    sys.stdout.write(f"{outcomes} of {count.total()} sensors\n")
    write_figures(options.figures, shares_of(count))
    return int(bool(count[SILENT]))


if __name__ == "__main__":
    sys.exit(main())
