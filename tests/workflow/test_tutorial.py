"""The tutorial, typed along: its commands are run in order, and what they print is what the page says.

``[...]`` stands for anything; alone on a line, for any number of lines. Words are equal. Numbers agree to 2 % or to one
in their last decimal, as sums round otherwise where another build of the linear algebra adds them up.
"""

import html
import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from .conftest import ROOT

pytestmark = pytest.mark.workflow
typed_along = pytest.mark.documents  # half a minute; ``.ci/run`` runs it

PAGE = ROOT / "docs" / "find_the_missing_effect.md"
NEEDED = ("Snakefile", "configs", "pipeline", "profiles", "workflow")
STEP = re.compile(
    r"^```bash\n(?P<commands>.*?)^```\n\n```text\n(?P<said>.*?)^```$|^!\[(?P<findings>[^\]]*)\]\((?P<file>[^)]*)\)$",
    re.MULTILINE | re.DOTALL,
)
NUMBER = r"(?<![\w.-])[-+−]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?!\w)"
ANYTHING = "[...]"


def close(said: str, printed: str, *, uncertainty: float = 0.0) -> bool:
    """Whether two numbers agree to 2 %, to one in the last decimal of the first, or to a tenth of an uncertainty."""
    a, b = (float(text.replace("−", "-")) for text in (said, printed))
    decimals = said.partition(".")[2] if "e" not in said else ""
    last = 10.0 ** -len(decimals) if decimals else 0.0
    return abs(a - b) <= max(0.02 * abs(a), 1.001 * last, 0.1 * uncertainty)


def agree(said: str, printed: str) -> bool:
    """Whether a line of the page and a printed one have the same words and close numbers."""
    said, printed = (" ".join(text.split()) for text in (said, printed))
    numbers, pattern, at = [], "", 0
    for token in re.finditer(rf"{re.escape(ANYTHING)}|{NUMBER}", said):
        pattern += re.escape(said[at : token.start()]) + (".*?" if token[0] == ANYTHING else f"({NUMBER})")
        numbers += [token[0]] * (token[0] != ANYTHING)
        at = token.end()
    match = re.fullmatch(pattern + re.escape(said[at:]), printed)
    return match is not None and all(map(close, numbers, match.groups()))


def compare(said: str, printed: str) -> None:
    """Assert that a block of the page tells what was printed."""
    lines, at, skipping = printed.splitlines(), 0, False
    for line in said.splitlines():
        if line.strip() == ANYTHING:
            skipping = True
            continue
        places = range(at, len(lines) if skipping else min(at + 1, len(lines)))
        found = next((k for k in places if agree(line, lines[k])), None)
        assert found is not None, "\n".join(["the page says", line, "and printed was", *lines[at:]])
        at, skipping = found + 1, False
    assert skipping or at == len(lines), "\n".join(["the page does not say", *lines[at:]])


@dataclass
class Typed:
    """What came of typing the page along in a copy of the repository."""

    directory: Path
    printed: list[tuple[str, str, str]] = field(default_factory=list)  # commands, what the page says, what they print
    pictures: list[tuple[str, str, list[str]]] = field(default_factory=list)  # file, findings, those of the unit's page

    def type(self, commands: str) -> str:
        python = Path(sys.executable).parent
        paths = {"PATH": f"{python}{os.pathsep}{os.environ['PATH']}", "PYTHONPATH": str(self.directory)}
        done = subprocess.run(
            ["bash", "-e", "-c", commands],
            cwd=self.directory,
            env=os.environ | paths | {"PYTHONWARNINGS": "", "NO_COLOR": "1"},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
            timeout=900,
        )
        assert done.returncode == 0, f"{commands}\n{done.stdout}"
        return done.stdout

    def findings(self) -> list[str]:
        page = (self.directory / "results" / "tutorial" / "reports" / "bench-7.html").read_text()
        return [html.unescape(found) for found in re.findall(r'<p class="finding">(.*?)</p>', page)]

    def content(self, file: str) -> dict[str, Any]:
        content: dict[str, Any] = json.loads((self.directory / file).read_text())
        return content


@pytest.fixture(scope="module")
def page() -> str:
    return PAGE.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def typed(page: str, tmp_path_factory: pytest.TempPathFactory) -> Typed:
    done = Typed(tmp_path_factory.mktemp("tutorial"))
    for name in NEEDED:
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy2
        copy(ROOT / name, done.directory / name)
    for step in STEP.finditer(page):
        if step["commands"]:
            done.printed.append((step["commands"], step["said"], done.type(step["commands"])))
        else:
            done.pictures.append((step["file"], step["findings"], done.findings()))
    return done


def table(page: str, heading: str) -> list[list[str]]:
    """Return the cells of the table that has a heading."""
    lines = page[page.index(f"| {heading} |") :].partition("\n\n")[0].splitlines()
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def test_the_page_has_no_block_but_commands_and_what_they_print_and_its_pictures_exist(page: str) -> None:
    steps = [*STEP.finditer(page)]
    assert page.count("```") == 4 * sum(bool(step["commands"]) for step in steps) == 44
    assert [(PAGE.parent / step["file"]).is_file() for step in steps if step["file"]] == [True] * 3


@typed_along
def test_commands_print_what_the_page_says(typed: Typed) -> None:
    assert len(typed.printed) == 11
    for _, said, printed in typed.printed:
        compare(said, printed)


@typed_along
def test_pictures_show_the_findings_that_the_units_page_has_by_then(typed: Typed) -> None:
    assert len(typed.pictures) == 3
    for _, said, shown in typed.pictures:
        for finding in said.split(" | "):
            assert any(agree(finding, other) for other in shown), (finding, shown)


@typed_along
def test_the_table_of_runs_is_that_of_the_history(page: str, typed: Typed) -> None:
    runs = []
    for file in sorted((typed.directory / "results" / "tutorial" / "history").iterdir()):
        part = typed.content(str(file.relative_to(typed.directory)))["units"]["bench-7"]["gyroscope"]
        effects, ratio = ",".join(part["effects"]) or "none", str(part["vector_error"] / part["vector_floor"])
        runs.append((effects, str(part["vector_error"]), ratio, part["verdict"]))
    rows = table(page, "effects of the gyroscope")
    assert len(rows) == len(runs) == 3
    for row, run in zip(rows, runs, strict=True):
        assert (row[0].replace(" ", ""), row[3]) == (run[0], run[3])
        assert all(map(close, row[1:3], run[1:3]))


@typed_along
def test_the_table_of_parameters_is_that_of_fit_and_truth(page: str, typed: Typed) -> None:
    fitted = typed.content("results/tutorial/calibrations/bench-7.json")["gyroscope"]["effects"]
    hidden = typed.content("data/tutorial/truth/bench-7.json")["gyroscope"]["effects"]
    found = {name: (p, effect["name"]) for effect in fitted for name, p in effect["parameters"].items()}
    truth = {name: size for sizes in hidden.values() for name, size in sizes.items()}
    truth |= {f"A_{axis}": truth[f"d_{axis}"] for axis in "xyz"}
    rows = table(page, "parameter")
    assert {found[name.partition(",")[0]][1] for name, _, _ in rows} == {effect["name"] for effect in fitted}
    for heading, estimate, size in rows:
        name, _, unit = heading.partition(", ")
        value, uncertainty = estimate.split(" ± ")
        parameter = found[name][0]
        assert parameter["unit"] == unit
        assert close(value, str(parameter["value"]), uncertainty=parameter["expanded_uncertainty"])
        assert close(uncertainty, str(parameter["expanded_uncertainty"]))
        assert float(size) == truth[name]
    for name, (parameter, _) in found.items():
        assert abs(parameter["value"] - truth[name]) < parameter["expanded_uncertainty"], name


@pytest.mark.parametrize(
    "printed",
    [
        "U1: gains 3 effects\nerror 0.0412 deg/s\nverdict unexplained\n",
        "U1: misses 4 effects\nerror 0.0412 deg/s\nverdict unexplained\n",
        "U1: misses 3 effects\nerror 0.0422 deg/s\nverdict unexplained\n",
        "U1: misses 3 effects\nerror 0.0412 deg/s\nverdict missing_effect\n",
        "U1: misses 3 effects\nverdict unexplained\n",
        "U1: misses 3 effects\nerror 0.0412 deg/s\nverdict unexplained\nmore\n",
        "note\nU1: misses 3 effects\nerror 0.0412 deg/s\nverdict unexplained\n",
        "",
    ],
)
def test_what_differs_from_the_page_is_refused(printed: str) -> None:
    said = "U1: [...] 3 effects\n[...]\nerror 0.0410 deg/s\nverdict unexplained\n"
    compare(said, "U1: misses 3 effects\nby far\nerror 0.0412 deg/s\nverdict unexplained\n")
    with pytest.raises(AssertionError):
        compare(said.replace(ANYTHING, "misses", 1), printed)
