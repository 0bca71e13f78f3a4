"""Compare ``check`` with a run on good campaigns with a random fault in the text of one log, or of all.

    python tests/corruption/check_agrees.py --cases 300 --seed 1 --out cases.jsonl

``check`` must refuse what a run refuses up to the calibration, and nothing else; a log checked alone must not be
refused where the run accepts it. Where the run accepts a fault, the calibration is compared with that of the good
files: it is listed as silent where a parameter is off by over 5 U of both and the held-out error stays within 3 noise
floors.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import shutil
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from whole_run import run_jobs

from pipeline.__main__ import main as command
from pipeline.app.config import load_campaign
from pipeline.core.pack import Pack

if TYPE_CHECKING:
    from collections.abc import Callable

ROOT = Path(__file__).parents[2]
SHEETS = {  # campaign that ships, and its unit
    "demo": "mpu6050-1",
    "published mpu6050": "mpu6050",
    "published wearable": "wearable",
}
UNTIL = ("ingest", "filter", "fit", "validate", "diagnose", "calibration")
MANY_U, MANY_FLOORS = 5.0, 3.0
Rows = list[list[str]]


class Log:
    """A text log as cells: ``header`` is its first line, ``sign`` separates its columns."""

    def __init__(self, path: Path, rng: np.random.Generator) -> None:
        self.path, self.rng, self.said = path, rng, ""
        lines = path.read_text(encoding="utf-8").splitlines()
        self.sign = max(",;\t", key=lines[-1].count)
        self.rows: Rows = [line.split(self.sign) for line in lines]
        self.tail = ""

    @property
    def columns(self) -> int:
        return len(self.rows[0])

    def numbers(self, column: int) -> np.ndarray:
        return np.array([float(row[column] or "nan") for row in self.rows[1:]])

    def put(self, column: int, values: np.ndarray) -> None:
        whole = all("." not in row[column] for row in self.rows[1:100]) and bool(np.all(values == np.round(values)))
        for row, value in zip(self.rows[1:], values.tolist(), strict=True):
            row[column] = f"{value:.0f}" if whole else f"{value:.10g}"

    def some(self, least: int = 0) -> int:
        found = int(self.rng.integers(least, self.columns))
        self.said += f" {self.rows[0][found]}"
        return found

    def write(self) -> None:
        self.path.unlink()  # it may be a link
        text = "\n".join(self.sign.join(row) for row in self.rows) + "\n"
        self.path.write_bytes(text.encode() + self.tail.encode("latin-1"))


def _middle(log: Log) -> int:
    return int(log.rng.integers(len(log.rows) // 4, 3 * len(log.rows) // 4))


def scaled(log: Log) -> None:
    column = log.some()
    factor = float(log.rng.choice([0.001, 0.01745329, 1 / 6, 0.5, 2.0, 9.80665, 57.29578, 1000.0, -1.0]))
    log.said += f" x {factor:.4g}"
    log.put(column, factor * log.numbers(column))


def exchanged(log: Log) -> None:
    one, two = log.some(), log.some()
    for row in log.rows[1:]:
        row[one], row[two] = row[two], row[one]


def renamed(log: Log) -> None:
    log.rows[0][log.some()] += "_2"


def reordered(log: Log) -> None:
    order = log.rng.permutation(log.columns)
    log.rows = [[row[i] for i in order] for row in log.rows]


def named_twice(log: Log) -> None:
    log.rows[0][log.some()] = log.rows[0][log.some()]


def left_out(log: Log) -> None:
    column = log.some()
    log.rows = [[*row[:column], *row[column + 1 :]] for row in log.rows]


def without_header(log: Log) -> None:
    log.rows = log.rows[1:]


def with_units(log: Log) -> None:
    log.rows.insert(1, ["unit"] * log.columns)


def header_again(log: Log) -> None:
    log.rows.insert(_middle(log), list(log.rows[0]))


def time_scaled(log: Log) -> None:
    factor = float(log.rng.choice([1e-6, 1e-3, 1e3, 1e6, 60.0, 1.01]))
    log.said += f" x {factor:g}"
    log.put(0, factor * log.numbers(0))


def time_restarts(log: Log) -> None:
    time, at = log.numbers(0), _middle(log)
    log.put(0, np.append(time[:at], time[at:] - time[at] + time[0]))


def time_wraps(log: Log) -> None:
    time = log.numbers(0)
    counter = 2.0**32 if time[1] - time[0] > 1 else 2.0**32 / 1e6
    log.put(0, np.where(np.arange(len(time)) >= _middle(log), time - counter, time))


def time_rounded(log: Log) -> None:
    step = np.median(np.diff(log.numbers(0)))
    log.put(0, np.floor(log.numbers(0) / (3 * step)) * 3 * step)


def time_constant(log: Log) -> None:
    log.put(0, np.full(len(log.rows) - 1, log.numbers(0)[0]))


def time_of_day(log: Log) -> None:
    for k, row in enumerate(log.rows[1:]):
        row[0] = f"12:{k // 6000:02d}:{k % 6000 / 100:05.2f}"


def since_1970(log: Log) -> None:
    log.put(0, log.numbers(0) + 1.7e9 * (1e6 if log.numbers(0)[1] - log.numbers(0)[0] > 1 else 1.0))


def rows_missing(log: Log) -> None:
    keep = log.rng.random(len(log.rows)) > float(log.rng.choice([0.001, 0.02, 0.2]))
    log.rows = [log.rows[0], *(row for row, k in zip(log.rows[1:], keep[1:], strict=True) if k)]


def rows_cut(log: Log) -> None:
    log.rows = log.rows[: _middle(log)]


def rows_repeated(log: Log) -> None:
    at = _middle(log)
    log.rows[at:at] = [list(row) for row in log.rows[at - 500 : at]]


def rows_reversed(log: Log) -> None:
    log.rows[1:] = log.rows[:0:-1]


def rows_exchanged(log: Log) -> None:
    at = _middle(log)
    log.rows[1:] = [*log.rows[at:], *log.rows[1:at]]


def cells_replaced(log: Log) -> None:
    column = log.some()
    text = str(log.rng.choice(["", "nan", "NULL", "inf", "-", "0", "1e999", "0x1F", "1,5", "1'000"]))
    log.said += f" {text!r}"
    for k in log.rng.integers(1, len(log.rows), int(log.rng.choice([1, 5, 200]))):
        log.rows[int(k)][column] = text


def decimal_comma(log: Log) -> None:
    log.rows[1:] = [[cell.replace(".", ",") for cell in row] for row in log.rows[1:]]


def another_separator(log: Log) -> None:
    log.sign = str(log.rng.choice([s for s in (";", "\t", "|", " ") if s != log.sign]))


def wrapped(log: Log) -> None:
    column = log.some(1)
    values = log.numbers(column)
    half = 0.6 * np.nanmax(np.abs(values))
    log.put(column, (values + half) % (2 * half) - half if half else values)


def unsigned(log: Log) -> None:
    column = log.some(1)
    values = log.numbers(column)
    log.put(column, np.where(values < 0, values + 65536.0, values))


def clipped(log: Log) -> None:
    column = log.some(1)
    values = log.numbers(column)
    largest = 0.7 * np.nanmax(np.abs(values))
    log.put(column, np.clip(values, -largest, largest))


def stuck(log: Log) -> None:
    column, at = log.some(1), _middle(log)
    values = log.numbers(column)
    values[at : at + int(log.rng.choice([50, 500, 5000]))] = values[at]
    log.put(column, values)


def shifted(log: Log) -> None:
    column, rows = log.some(1), int(log.rng.choice([2, 10, 100]))
    log.said += f" {rows} rows"
    log.put(column, np.roll(log.numbers(column), rows))


def restarted(log: Log) -> None:
    column, at = log.some(1), _middle(log)
    values = log.numbers(column)
    values[at:] -= values[at]
    log.put(column, values)


def offset(log: Log) -> None:
    column, at = log.some(1), _middle(log)
    values = log.numbers(column)
    values[at:] += float(log.rng.choice([0.01, 0.1, 1.0])) * np.nanstd(values)
    log.put(column, values)


def coarse(log: Log) -> None:
    column = log.some(1)
    values = log.numbers(column)
    step = max(float(np.nanstd(values)) * float(log.rng.choice([0.02, 0.2])), 1e-9)
    log.put(column, np.round(values / step) * step)


def garbage_at_the_end(log: Log) -> None:
    log.tail = str(log.rng.choice(["\x00" * 200, "1,2", "# end\n", "\xff\xfe\xfd", log.sign.join(log.rows[-1])[:9]]))


def quoted(log: Log) -> None:
    log.rows = [[f'"{cell}"' for cell in row] for row in log.rows]


def spaced(log: Log) -> None:
    log.rows = [[f" {cell} " for cell in row] for row in log.rows]


WAYS: tuple[Callable[[Log], None], ...] = (
    scaled, scaled, exchanged, renamed, reordered, named_twice, left_out, without_header, with_units, header_again,
    time_scaled, time_restarts, time_wraps, time_rounded, time_constant, time_of_day, since_1970, rows_missing,
    rows_cut, rows_repeated, rows_reversed, rows_exchanged, cells_replaced, cells_replaced, decimal_comma,
    another_separator, wrapped, unsigned, clipped, stuck, shifted, restarted, offset, coarse,
    garbage_at_the_end, quoted, spaced,
)  # fmt: skip


def good_campaigns(folder: Path, more: list[Path]) -> dict[str, Path]:
    """Return campaigns of one unit each, below a folder: those that ship, and others."""
    found = {}
    for name, unit in SHEETS.items():
        source = ROOT / "data" / name.partition(" ")[0]
        target = folder / name.replace(" ", "_")
        shutil.copytree(source / "raw" / unit, target / "raw" / unit)
        for part in ("configs", "campaign.yaml"):
            if (source / part).is_dir():
                shutil.copytree(source / part, target / part)
        head, *rows = (source / "units.csv").read_text(encoding="utf-8").splitlines()
        row = next(r for r in rows if r.split(",")[0] == unit)
        (target / "units.csv").write_text(f"{head}\n{row}\n", encoding="utf-8")
        found[name] = target
    for source in more:
        shutil.copytree(source, folder / source.name)
        found[source.name] = folder / source.name
    return found


def ran(campaign: Path, results: Path) -> tuple[dict[str, Any] | None, dict[str, Any], dict[str, Any]]:
    """Return failure, calibration and validation of the only unit, by the jobs of a run."""
    shutil.rmtree(results, ignore_errors=True)
    loaded = load_campaign({"campaign": str(campaign), "results": str(results)})
    run_jobs(loaded, UNTIL)
    ((batch, (unit,)),) = loaded.batches.items()
    packs = {stage: Pack(loaded.results / "batches" / batch / f"{stage}.zip") for stage in UNTIL[3:]}
    failed = f"{unit}.failed.json"
    if failed in packs["calibration"]:
        return packs["calibration"].json(failed), {}, {}
    return None, packs["calibration"].json(f"{unit}.json"), packs["validate"].json(f"{unit}.json")


def checked(*words: str | Path) -> tuple[int, str, str]:
    """Return exit code and outputs of ``check``."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = command(["check", *map(str, words)])
        except Exception as error:  # noqa: BLE001  (that is what is looked for)
            return 99, out.getvalue(), f"{type(error).__name__}: {error}"
    return code, out.getvalue(), err.getvalue()


def silent(good: dict[str, Any], found: dict[str, Any], held: dict[str, Any]) -> list[str]:
    """Return what is wrong with a calibration, and is not visible in its held-out error."""
    wrong = []
    for sensor in ("accelerometer", "gyroscope"):
        if not good.get(sensor) or not found.get(sensor):
            continue
        steps, floor = (held.get(sensor) or {}).get("steps"), (held.get(sensor) or {}).get("noise_floor")
        if steps and floor and steps[-1]["rms_error"] > MANY_FLOORS * floor:
            continue
        for name in ("bias", "matrix"):
            one, two = (np.array(d[sensor][name], float) for d in (good, found))
            U = [np.nan_to_num(np.array(d[sensor]["expanded_uncertainty"][name], float)) for d in (good, found)]
            ratio = np.abs(one - two) / np.maximum(np.hypot(*U), 1e-9)
            if ratio.max() > MANY_U:
                wrong.append(f"{sensor} {name} off by {np.abs(one - two).max():.3g}, {ratio.max():.3g} U")
    return wrong


def case(number: int, seed: int, goods: dict[str, Path], known: dict[str, Any], work: Path) -> dict[str, Any]:
    """Return what came of one corrupted campaign."""
    rng = np.random.default_rng([seed, number])
    name = list(goods)[number % len(goods)]
    way = WAYS[(number // len(goods)) % len(WAYS)]
    copy = work / "case"
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(goods[name], copy)
    files = sorted(f for f in copy.glob("raw/*/*") if f.suffix in (".csv", ".txt"))
    chosen = files if rng.random() < 0.3 else [files[int(rng.integers(len(files)))]]
    said, state = "", rng.bit_generator.state
    for file in chosen:
        rng.bit_generator.state = state
        log = Log(file, rng)
        try:
            way(log)
        except (ValueError, IndexError) as error:
            return {"number": number, "base": name, "way": way.__name__, "skipped": str(error)}
        log.write()
        said = log.said
    which = "all" if len(chosen) > 1 else chosen[0].stem
    line: dict[str, Any] = {"number": number, "base": name, "way": f"{way.__name__}{said}", "file": which}
    failure, calibration, held = ran(copy, work / "results")
    stage = failure["stage"] if failure else ""
    line["run"] = f"{stage}: {failure['code']}" if failure else "ok"
    whole, of_files = checked("--campaign", copy), checked(*files)
    elsewhere = work / "elsewhere" / chosen[0].name
    elsewhere.parent.mkdir(exist_ok=True)
    shutil.copyfile(chosen[0], elsewhere)
    alone = checked("--campaign", copy, elsewhere)
    line["check"] = [whole[0], of_files[0], alone[0]]
    early = bool(failure) and stage.partition("/")[0] in ("ingest", "filter", "fit") and not stage.endswith("/effects")
    wrong = []
    if whole[0] != 2 * bool(failure):
        wrong.append(f"check --campaign gives {whole[0]}: {whole[2][-300:]}")
    elif failure and f"({failure['code']})" not in whole[2] and len(whole[2].splitlines()) == 1:
        wrong.append(f"check --campaign names another code: {whole[2][-300:]}")
    if of_files[0] != 2 * early:
        wrong.append(f"check FILES gives {of_files[0]}: {of_files[2][-300:]}")
    if alone[0] not in ({0, 2} if failure else {0}):
        wrong.append(f"check alone gives {alone[0]}: {alone[2][-300:]}")
    if any("internal_error" in text or "Traceback" in text for _, *texts in (whole, of_files, alone) for text in texts):
        wrong.append("internal error")
    if failure and failure["code"] == "internal_error":
        wrong.append(failure["message"])
    line["disagree"] = wrong
    line["silent"] = [] if failure else silent(known[name], calibration, held)
    return line


def main() -> int:
    """Run it; exit code 1 where check and run disagree."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=300)
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--more", type=Path, nargs="*", default=[], help="further campaigns of one unit")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    lines = []
    with tempfile.TemporaryDirectory() as folder, options.out.open("a", encoding="utf-8") as stream:
        work = Path(folder)
        goods = good_campaigns(work / "good", options.more)
        known = {}
        for name, campaign in goods.items():
            failure, known[name], _ = ran(campaign, work / "results")
            if failure:
                raise SystemExit(f"{name} is not good: {failure}")
        for number in range(options.start, options.start + options.cases):
            line = case(number, options.seed, goods, known, work)
            lines.append(line)
            stream.write(json.dumps(line) + "\n")
            stream.flush()
    count = Counter(line.get("run", "not applicable") for line in lines)
    sys.stdout.write("\n".join(f"{n:>5} {what}" for what, n in count.most_common()) + "\n")
    for key in ("disagree", "silent"):
        found = [line for line in lines if line.get(key)]
        sys.stdout.write(
            f"{key}: {len(found)} of {len(lines)}\n" + "".join(f"  {json.dumps(line)}\n" for line in found)
        )
    return int(any(line.get("disagree") for line in lines))


if __name__ == "__main__":
    sys.exit(main())
