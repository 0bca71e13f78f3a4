"""What the pages cost: ``python benchmarks/pages.py``.

CPU time of what is made of a unit of ``data/demo`` (5,902 samples); and with a Chromium at hand the CPU time of its
page thread until a campaign's page of 10,000 units is shown, sorted and filtered, with the wall time until it is shown.
The least of several runs each.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from measuring import least

from pipeline.app.config import load_campaign
from pipeline.app.one_unit import unit_of_campaign
from pipeline.core.records import SENSORS, calibrated
from pipeline.evaluation.held_out.attitude import attitude
from pipeline.output.pages import campaign_page
from pipeline.unit import Task, run_step

if TYPE_CHECKING:
    from playwright.sync_api import CDPSession

UNIT = "mpu6050-2-hidden"
SORT = "document.querySelector('#all thead tr:nth-child(2) th:nth-child(9) button').click()"
FILTER = """(() => {
  const box = document.querySelector("#filter");
  box.value = box.value ? "" : "missing staged";
  box.dispatchEvent(new Event("input"));
})()"""
DRAWN = "new Promise((done) => requestAnimationFrame(() => setTimeout(done, 0)))"


def unit_costs(runs: int) -> dict[str, float]:
    """Return CPU milliseconds of what is made of one unit."""
    unit = unit_of_campaign(load_campaign({"campaign": "demo"}), UNIT)
    state = unit.run_to("calibration")
    settings, fits = unit.settings(Task("report")), calibrated(state.fits)
    assert state.recordings is not None  # noqa: S101
    recordings = state.recordings.filtered
    work = {
        "page and calibration report of a unit": lambda: run_step(Task("report"), state, settings),
        "attitude": lambda: attitude(fits["accelerometer"], fits["gyroscope"], recordings),
    }
    return {name: 1e3 * least(runs, each)[0] for name, each in work.items()}


def fleet(units: int) -> list[dict[str, Any]]:
    """Return rows of a campaign; every ninth unit lacks an effect."""
    rng = np.random.default_rng(7)
    rows = []
    for i in rng.permutation(units).tolist():
        row = {"unit": f"U{i}", "serial": f"S{i}", "lot": f"L{i // 500}", "date": "2026-02-03", "status": "ok"}
        row |= {"sensor": "mpu6050", "method": "reference_least_squares" if i % 3 else "staged", "pass": bool(i % 17)}
        for sensor in SENSORS:
            row |= {f"{sensor}_error_before": float(rng.uniform(0.02, 0.1)), f"{sensor}_noise_floor": 0.0008}
            row |= {f"{sensor}_error_after": float(rng.uniform(0.0008, 0.002)) * (1 if i % 9 else 8)}
            row |= {f"{sensor}_verdict": "nothing_missing" if i % 9 else "missing_effect"}
            row |= {f"{sensor}_selected": None if i % 9 else "g_sensitivity"}
        rows.append(row)
    return rows


def spent(devtools: CDPSession) -> float:
    """Return the CPU time of a page's thread so far, s."""
    metrics = devtools.send("Performance.getMetrics")["metrics"]
    return float(next(m["value"] for m in metrics if m["name"] == "TaskDuration"))


def browser_costs(page: str, runs: int) -> dict[str, float] | None:
    """Return milliseconds of Chromium's page thread, and of wall time until a page is shown; None: no Chromium."""
    from playwright.sync_api import sync_playwright  # noqa: PLC0415

    program = next((p for p in map(shutil.which, ("chromium", "chromium-browser", "google-chrome")) if p), None)
    if program is None:
        return None
    found: dict[str, list[float]] = {"shown": [], "wall time": [], "sorted": [], "filtered": []}
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        file = Path(folder) / "index.html"
        file.write_text(page)
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        for _ in range(runs):
            opened = browser.new_page()
            devtools = opened.context.new_cdp_session(opened)
            devtools.send("Performance.enable", {"timeDomain": "threadTicks"})
            steps = (("shown", None), ("sorted", SORT), ("filtered", FILTER), ("filtered", FILTER))
            for name, script in steps:
                before = spent(devtools)
                if script is None:
                    opened.goto(file.as_uri())
                else:
                    opened.evaluate(script)
                opened.evaluate(DRAWN)
                found[name].append(1e3 * (spent(devtools) - before))
                if script is None:
                    found["wall time"].append(float(opened.evaluate("performance.now()")))
            opened.close()
        browser.close()
    return {name: min(costs) for name, costs in found.items()}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--units", type=int, default=10_000, help="units of the campaign's page")
    parser.add_argument("--runs", type=int, default=10)
    arguments = parser.parse_args()
    for name, cost in unit_costs(arguments.runs).items():
        print(f"{name}: {cost:.1f} ms CPU")
    rows = fleet(arguments.units)
    cost, page = least(3, lambda: campaign_page.render("fleet", rows, []))
    print(f"page of {arguments.units} units: {1e3 * cost:.0f} ms CPU, {len(page.encode()) / 1e6:.2f} MB")
    costs = browser_costs(page, max(3, arguments.runs // 2))
    print("no Chromium here" if costs is None else ", ".join(f"{k} {v:.0f} ms" for k, v in costs.items()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
