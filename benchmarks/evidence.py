"""Measure the evidence of docs/evidence.md, and write the page from what is stored.

    python benchmarks/evidence.py run [NAME ...] [--share 0.1] [--cores 2] [--imu-tk DIR] [--xsens DIR] [--sets DIR]
    python benchmarks/evidence.py page

``run`` executes the command of each measure in ``benchmarks/evidence/measures.yaml`` and stores its figures with date
and commit in ``benchmarks/evidence/stored/NAME.json``. A share below 1 runs that part of each, stores nothing, and
compares: exit code 1 where a stored figure is outside the interval of the part, widened to 99.9 %. ``page`` writes
docs/evidence.md from ``benchmarks/evidence/page.md``; a goal that is missed is bold. The measure ``peers`` needs
imucal 2.6.0 and the source of imu_tk, ``real`` the recording of an Xsens MTi (``benchmarks/peers.py`` states both) and
the sets of ``benchmarks/sets/sources.yaml``.
"""

from __future__ import annotations

import argparse
import json
import shlex
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Self

import jinja2
import numpy as np
import scipy
import yaml

from imu_research.figures import MeasuredFigure, wilson
from pipeline.output.pages.comparison import adjusted

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "benchmarks" / "evidence"
PAGE = ROOT / "docs" / "evidence.md"
LEVEL = 0.999  # of the interval of a part, which is compared with some 100 stored figures


@dataclass(frozen=True)
class Measure:
    """A command that measures, and its number of units."""

    command: str
    n: int = 0

    def words(self, folder: Path, options: argparse.Namespace) -> list[str]:
        """Return the command with its files in ``folder``, for a share of the units."""
        values = {**vars(options), "n": max(1, round(options.share * self.n))}
        text = self.command.format(**values, folder=folder, figures=folder / "figures.json")
        program, *rest = shlex.split(text)
        return [sys.executable if program == "python" else program, *rest]

    @property
    def shown(self) -> str:
        """The command as a reader types it."""
        return self.command.format(
            n=self.n, folder="DIR", cores=2, figures="FILE", imu_tk="IMU_TK", xsens="XSENS", sets="SETS"
        ).removesuffix(" --figures FILE")


@dataclass(frozen=True)
class Stored:
    """The figures of a measure, with the commit and the date on which they were measured."""

    command: str
    date: str
    commit: str
    figures: list[MeasuredFigure]

    @classmethod
    def of(cls, name: str) -> Self:
        document = json.loads((FOLDER / "stored" / f"{name}.json").read_text(encoding="utf-8"))
        return cls(**{**document, "figures": [MeasuredFigure.from_json(f) for f in document["figures"]]})

    def write(self, name: str) -> None:
        document = {**asdict(self), "figures": [figure.to_json() for figure in self.figures]}
        text = json.dumps(document, indent=1) + "\n"
        (FOLDER / "stored" / f"{name}.json").write_text(text, encoding="utf-8")

    def stated(self, of: str) -> list[MeasuredFigure]:
        """Return the figures of the probabilities of effects, single answers or answer sets."""
        return [figure for figure in self.figures if figure.name.startswith(f"{of}, stated")]

    def has(self, name: str) -> bool:
        """Return whether the name of a figure begins so."""
        return any(figure.name.startswith(name) for figure in self.figures)

    def __getitem__(self, name: str) -> MeasuredFigure:
        """Return the figure whose name begins so."""
        found = [figure for figure in self.figures if figure.name.startswith(name)]
        if not found:
            raise KeyError(f"no figure begins with {name!r}; known: {'; '.join(f.name for f in self.figures)}")
        return found[0]


def measures() -> dict[str, Measure]:
    listed: Mapping[str, Mapping[str, object]] = yaml.safe_load((FOLDER / "measures.yaml").read_text(encoding="utf-8"))
    return {name: Measure(**values) for name, values in listed.items()}


def measured(measure: Measure, options: argparse.Namespace) -> Stored:
    """Run a measure; raises ``SystemExit`` where its command writes no figures."""
    git = ["git", "-C", str(ROOT), "rev-parse", "--short=8", "HEAD"]
    commit = subprocess.run(git, capture_output=True, text=True, check=True).stdout.strip()
    date = time.strftime("%Y-%m-%d", time.gmtime())
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        words = measure.words(folder, options)
        run = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
        file = folder / "figures.json"
        if not file.is_file():
            raise SystemExit(f"{shlex.join(words)} wrote no figures:\n{run.stdout[-1000:]}{run.stderr[-2000:]}")
        figures = [MeasuredFigure.from_json(entry) for entry in json.loads(file.read_text(encoding="utf-8"))]
    return Stored(measure.shown, date, commit, figures)


def outside(stored: Stored, part: Stored) -> list[str]:
    """Return each stored share that is outside the widened interval of a part."""
    whole, found = {figure.name: figure for figure in stored.figures}, []
    for figure in part.figures:
        known = whole.get(figure.name)
        if known is None or not figure.is_share:
            continue
        low, high = wilson(round(figure.value * figure.total), figure.total, LEVEL)
        if not low <= known.value <= high:
            found.append(f"{figure.name}: stored {known.value:.4f}, now {figure.value:.4f} of {figure.total}")
    return found


def page() -> str:
    """Return docs/evidence.md."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(FOLDER),
        autoescape=False,  # noqa: S701  (Markdown of our own figures)
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters |= {each.__name__: each for each in (counted, percent, ratio, stated, ends)}
    stored = {name: Stored.of(name) for name in measures() if (FOLDER / "stored" / f"{name}.json").is_file()}
    for name in ("coverage", "listed"):
        stored[name] = replace(stored[name], figures=by_holm(stored[name].figures))
    return environment.get_template("page.md").render(
        stored=stored,
        methods=dict.fromkeys(figure.name.rpartition(", ")[0] for figure in stored["coverage"].figures),
        real=dict.fromkeys(f.name.rpartition(", ")[0] for f in stored["real"].figures if not f.name.startswith("CPU")),
    )


def by_holm(figures: Sequence[MeasuredFigure]) -> list[MeasuredFigure]:
    """Return the figures, those with a goal of an interval only where Holm's test over all of these rejects it.

    p of a row follows from its 99 % interval; the level is 1 % over all rows.
    """
    p = {}
    for figure in figures:
        if figure.goal.startswith("contains") and figure.interval:
            goal = float(figure.goal.split()[1]) / 100.0
            error = np.ptp(figure.interval) / 2.0 / scipy.stats.norm.isf(0.005)
            p[figure.name] = 2.0 * scipy.stats.norm.sf(abs(figure.value - goal) / error)
    kept = {name for name, value in zip(p, adjusted([*p.values()]), strict=True) if value > 0.01}
    return [figure._replace(goal="") if figure.name in kept else figure for figure in figures]


def counted(figure: MeasuredFigure) -> str:
    """Return ``299 of 300 (98.1 to 99.9 %)``, or value and unit; bold where the goal is missed."""
    _, total, value, ends, _ = figure.cells
    hits = f"{round(figure.value * total):,} of {total:,} ({ends})" if figure.is_share else f"{value} ({ends})"
    text = hits.replace(" ()", "")
    return f"**{text}**" if figure.missed else text


def percent(figure: MeasuredFigure) -> str:
    """Return share and interval in %; bold where the goal is missed."""
    _, _, value, ends, _ = figure.cells
    text = f"{value.removesuffix(' %')} ({ends.removesuffix(' %')})"
    return f"**{text}**" if figure.missed else text


def stated(figure: MeasuredFigure) -> str:
    """Return the mean stated probability of a bin, %."""
    return f"{100.0 * float(figure.name.rpartition(' ')[2]):.3g}"


def ratio(figure: MeasuredFigure) -> str:
    return f"{figure.value:.3g} ({ends(figure)})"


def ends(figure: MeasuredFigure) -> str:
    """Return an interval; empty without one."""
    return "" if figure.interval is None else "{:.2g} to {:.2g}".format(*figure.interval)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("run", "page"))
    parser.add_argument("names", nargs="*", help="measures; all by default")
    parser.add_argument("--share", type=float, default=1.0)
    parser.add_argument("--cores", type=int, default=2)
    parser.add_argument("--imu-tk", default="imu_tk", help="folder of its source, commit 7780270")
    parser.add_argument("--xsens", default="xsens", help="folder of accelerometer.txt and gyroscope.txt")
    parser.add_argument("--sets", default="sets", help="folder of the clones of benchmarks/sets/sources.yaml")
    options = parser.parse_intermixed_args()
    if options.what == "page":
        PAGE.write_text(page(), encoding="utf-8")
        return 0
    known, wrong = measures(), []
    for name in options.names or known:
        began = time.time()
        found = measured(known[name], options)
        print(f"{name}: {(time.time() - began) / 60.0:.1f} min", flush=True)
        for figure in found.figures:
            print(" ", *figure.cells, *["MISSED"] * figure.missed, flush=True)
        if options.share < 1.0:
            wrong += [f"{name}: {line}" for line in outside(Stored.of(name), found)]
        else:
            found.write(name)
    print("\n".join(wrong), end="\n" if wrong else "")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
