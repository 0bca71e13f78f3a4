"""The loop of a user: see what is missing, paste the command that is shown, watch the held-out error fall.

The commands are taken from the end of the run, from ``explain`` and from the page in a browser, and run by bash as they
stand. The campaign is a copy of two units of the demo, in a directory whose name has a space.
"""

import csv
import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass, field
from html import unescape
from pathlib import Path

import pytest
from playwright.sync_api import sync_playwright

from .conftest import ROOT

pytestmark = pytest.mark.workflow

HIDDEN, OTHER = "mpu6050-2-hidden", "mpu6050-2"
AT_FLOOR = 1.1  # of the noise floor; the hidden effect leaves 11 times the floor


@dataclass
class Loop:
    """A user's working directory, and what was seen on the way round."""

    directory: Path
    said: dict[str, str] = field(default_factory=dict)
    errors: dict[str, tuple[float, float]] = field(default_factory=dict)  # of the hidden gyroscope, and its floor
    other: dict[str, dict[str, bytes]] = field(default_factory=dict)  # files of the other unit
    pages: dict[str, str] = field(default_factory=dict)

    @property
    def results(self) -> Path:
        return self.directory / "results" / "my demo"

    def bash(self, command: str) -> str:
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        environment = os.environ | {"PATH": path, "PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "", "NO_COLOR": "1"}
        done = subprocess.run(
            ["bash", "-e", "-c", command],
            cwd=self.directory,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
            timeout=300,
        )
        assert done.returncode == 0, done.stdout
        return done.stdout

    def note(self, when: str, said: str) -> None:
        """Keep what a run has said and left."""
        part = json.loads((self.results / "validations" / f"{HIDDEN}.json").read_text())["gyroscope"]
        self.said[when] = said
        self.errors[when] = part["steps"][-1]["vector_rms_error"], part["vector_noise_floor"]
        files = [
            f for f in self.results.rglob("*") if f.is_file() and f.relative_to(self.results).parts[0] != "batches"
        ]
        self.other[when] = {str(f): f.read_bytes() for f in files if OTHER in (f.stem, f.parent.name)}
        self.pages[when] = (self.results / "reports" / f"{HIDDEN}.html").read_text()


def shown_on_the_page(file: Path) -> list[str]:
    """Return the commands that the card of the gyroscope shows."""
    program = next((p for p in map(shutil.which, ("chromium", "chromium-browser", "google-chrome")) if p), None)
    if program is None:
        pytest.skip("there is no Chromium on this machine")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        page = browser.new_page()
        page.goto(file.as_uri())
        card = page.locator(".card", has=page.get_by_role("heading", name="Gyroscope"))
        commands = card.first.locator(".copy code").all_text_contents()
        browser.close()
    return commands


@pytest.fixture(scope="module")
def loop(tmp_path_factory: pytest.TempPathFactory) -> Loop:
    made = Loop(tmp_path_factory.mktemp("loop"))
    campaign = made.directory / "my demo"
    with (ROOT / "data" / "demo" / "units.csv").open(newline="") as stream:
        rows = [row for row in csv.DictReader(stream) if row["unit"] in (HIDDEN, OTHER)]
    campaign.mkdir()
    with (campaign / "units.csv").open("w", newline="") as stream:
        writer = csv.DictWriter(stream, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    for row in rows:
        shutil.copytree(ROOT / "data" / "demo" / "raw" / row["unit"], campaign / "raw" / row["unit"])
    run = f"snakemake --cores 2 --snakefile '{ROOT / 'Snakefile'}' --config 'campaign=my demo'"
    made.note("first", made.bash(run))
    made.said["again"] = made.bash(run)
    made.said["explain"] = made.bash(f"python -m pipeline explain 'my demo' {HIDDEN}")
    made.said["page"] = shown_on_the_page(made.results / "reports" / f"{HIDDEN}.html")[0]
    made.note("added", made.bash(made.said["page"]))
    made.said["diagnose"] = next(made.results.glob("logs/*/diagnose.log")).read_text()
    made.note("removed", made.bash(made.said["page"].replace(" add ", " remove ")))
    return made


def test_the_run_its_repetition_explain_and_the_page_show_the_same_command(loop: Loop) -> None:
    assert "Nothing to be done" in loop.said["again"]
    command = f"python -m pipeline add 'my demo' {HIDDEN} gyroscope.g_sensitivity"
    assert loop.said["page"] == command
    for when in ("first", "again"):
        *_, missing, shown, counts = loop.said[when].rstrip().splitlines()
        assert counts == "2 units: 1 ready, 1 effect missing, 0 failed; look at results/my demo/index.html"
        assert re.fullmatch(rf"effect missing: {HIDDEN}; gyroscope: g sensitivity; [\d.]+ x noise", missing)
        assert shown == f"  {command}"
    lines = [line.strip() for line in loop.said["explain"].splitlines()]
    assert lines[:2] == [HIDDEN, "gyroscope"]
    assert lines[lines.index("To add it:") + 1] == command
    assert any(line.startswith("U of the accelerometer does not include local gravity") for line in lines)


def test_the_held_out_error_falls_to_its_floor_and_the_other_unit_stays(loop: Loop) -> None:
    (before, floor), (after, floor_after) = loop.errors["first"], loop.errors["added"]
    assert before > 10 * floor
    assert after < AT_FLOOR * floor_after
    assert (loop.directory / "my demo" / "units.csv").is_file()
    assert loop.other["added"] == loop.other["first"]
    assert len(loop.other["first"]) > 20
    assert f"diagnose: {OTHER} unchanged, taken from the last run\n" in loop.said["diagnose"]
    assert f"diagnose: {HIDDEN} unchanged" not in loop.said["diagnose"]
    assert "missing:" not in loop.said["added"]
    told = f"{HIDDEN}, gyroscope: + g_sensitivity; held-out error of the vector {before:.3g} -> {after:.3g} deg/s, "
    told += f"{after / floor_after:.3g} times the noise floor"
    assert told + "\n" in loop.said["added"]
    assert told in (ROOT / "README.md").read_text()
    assert f"motion is {before:.3g} deg/s, {before / floor:.3g} times" in " ".join(loop.said["explain"].split())
    assert re.search(r"largest expanded uncertainty \(95 %\): .*matrix [\d.]+ -> [\d.]+ %\n", loop.said["added"])


def test_the_history_draws_the_fall_with_what_was_added(loop: Loop) -> None:
    assert 'id="history"' not in loop.pages["first"]
    page = loop.pages["added"]
    section = page[page.index('id="history"') : page.index("</section>", page.index('id="history"'))]
    drawn = [unescape(t) for t in re.findall(r"<text[^>]*>([^<]*)</text>", section)]
    (first,) = (i for i, t in enumerate(drawn) if t.startswith("run 1, "))
    (second,) = (i for i, t in enumerate(drawn) if t.startswith("run 2: + g sensitivity, "))
    assert second == first + 1
    assert drawn[second + 1].startswith("noise floor ")  # then the values of the bars, above the line of the floor
    values = [float(t) for t in drawn[second + 2 : second + 4]]
    assert values == pytest.approx([loop.errors["first"][0], loop.errors["added"][0]], rel=0.005)
    assert "error of the vector falls from" in section


def test_removing_undoes_it_and_says_what_the_run_no_longer_has(loop: Loop) -> None:
    assert not (loop.directory / "my demo" / "devices").exists()
    assert loop.errors["removed"] == loop.errors["first"]
    said = " ".join(loop.said["removed"].split())
    assert f"{HIDDEN}: this run no longer has gyroscope.g_sensitivity, which run 2 had; to have it" in said
    assert "The last run no longer has g sensitivity, which run 2 had." in loop.pages["removed"]
    assert [f.name for f in sorted((loop.results / "history").iterdir())] == ["0001.json", "0002.json", "0003.json"]
