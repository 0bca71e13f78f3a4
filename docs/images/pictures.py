"""Take the pictures of the pages that the documents show.

    python docs/images/pictures.py     (two minutes; needs Chromium, playwright of requirements-dev.lock, and pillow)

Runs the demo and the tutorial (docs/find_the_missing_effect.md) in a temporary folder and writes the PNG files beside
this script. It prints the finding of each chart, which is its text alternative in the documents.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from PIL import Image
from playwright.sync_api import sync_playwright

if TYPE_CHECKING:
    from playwright.sync_api import Browser

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
TUTORIAL = ROOT / "docs" / "find_the_missing_effect.md"
HIDDEN = "mpu6050-2-hidden"
MARGIN = 4  # px, below the last element of a picture
COLOURS = 96  # of a picture: those of a page and the edges of its letters


def run(results: Path, campaign: str | Path, *config: str) -> Path:
    """Run a campaign and return the folder of its results."""
    command = [sys.executable, "-m", "snakemake", "--cores", "2", "--quiet", "all", "--config"]
    subprocess.run([*command, f"campaign={campaign}", f"results={results}", *config], cwd=ROOT, check=True)
    return results / Path(campaign).name


def smaller(name: str) -> None:
    """Write a picture anew with a palette of its colours: a third of the bytes."""
    with Image.open(HERE / name) as picture:
        few = picture.convert("RGB").quantize(COLOURS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    few.save(HERE / name, optimize=True)


def top(browser: Browser, page: Path, name: str, width: int, last: str) -> None:
    """Take the top of a page, up to the end of the first element that a selector finds."""
    view = browser.new_page(viewport={"width": width, "height": 900}, color_scheme="light")
    view.goto(page.as_uri())
    box = view.locator(last).first.bounding_box()
    assert box is not None
    clip = {"x": 0, "y": 0, "width": width, "height": box["y"] + box["height"] + MARGIN}
    view.screenshot(path=HERE / name, full_page=True, clip=clip)
    smaller(name)


def figures(browser: Browser, page: Path, name: str, *wanted: str) -> None:
    """Take charts of a page, one beside the other, by the beginnings of their identifiers."""
    view = browser.new_page(viewport={"width": 480 * len(wanted), "height": 900}, color_scheme="light")
    view.goto(page.as_uri())
    view.evaluate(
        """wanted => {
            const of = (name) => document.querySelector(`svg[aria-labelledby^="${name}"]`).closest("figure");
            const row = document.createElement("div"), shown = wanted.map(of);
            row.style = "display: flex; gap: 16px; padding: 8px; align-items: start";
            shown.forEach((figure) => { figure.style.flex = "1 1 0"; figure.querySelector(".tools").remove(); });
            row.append(...shown);
            document.body.replaceChildren(row);
        }""",
        list(wanted),
    )
    print(f"{name}: {' | '.join(view.locator('.finding').all_inner_texts())}")
    view.locator("body > div").screenshot(path=HERE / name)
    smaller(name)


def tutorial(browser: Browser, folder: Path) -> None:
    """Take the pictures of the tutorial, whose description of the unit is in its text."""
    campaign = folder / "tutorial"
    (campaign / "effects").mkdir(parents=True)
    text = re.search(r"simulation\.yaml <<'END'\n(.*?)^END$", TUTORIAL.read_text(), re.MULTILINE | re.DOTALL)
    assert text is not None
    (campaign / "simulation.yaml").write_text(text[1])
    subprocess.run([sys.executable, "-m", "pipeline", "simulate", campaign, "--quiet"], cwd=ROOT, check=True)
    results = run(folder / "results", campaign)
    page = results / "reports" / "bench-7.html"
    figures(browser, page, "tutorial_what_is_missing.png", "gyroscope-ranking", "gyroscope-unexplained")
    form = (results / "diagnoses" / "bench-7_gyroscope_unknown.yaml").read_text()
    run(folder / "results", campaign, "overrides=effects.gyroscope=[g_sensitivity]")
    figures(browser, page, "tutorial_behind_the_first.png", "gyroscope-ranking", "gyroscope-added-variable")
    (campaign / "effects" / "die_stress.yaml").write_text(re.sub(r"(?m)^name: .*", "name: die_stress", form))
    run(folder / "results", campaign, "overrides=effects.gyroscope=[g_sensitivity, bias_temperature, die_stress]")
    figures(browser, page, "tutorial_ladder.png", "gyroscope-staircase-vector")


def demo(browser: Browser, folder: Path) -> None:
    """Take the pictures of the demo's pages."""
    results = run(folder / "results", "demo")
    pages = results / "reports"
    top(browser, pages / f"{HIDDEN}.html", "page.png", 1180, ".cards")
    top(browser, results / "index.html", "page_campaign_light.png", 1440, "table.problems")


def main() -> None:
    """Take all pictures."""
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        program = shutil.which("chromium") or shutil.which("google-chrome")
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        tutorial(browser, Path(folder))
        demo(browser, Path(folder))
        browser.close()


if __name__ == "__main__":
    main()
