"""The runs of a unit on its page: the error beside the floor, and what each run added or removed."""

import re
from html import unescape
from typing import Any

from pipeline.output.pages import unit_page
from pipeline.output.pages.fleet import runs_data, with_history
from pipeline.output.pages.pages import LINK_MARK, MARK

from .conftest import Unit

TIMES = {1: "2026-02-03 04:05", 2: "2026-02-04 04:05", 5: "2026-02-07 04:05"}


def state(effects: list[str], error: float, accelerometer: float = 0.002) -> dict[str, Any]:
    def part(effects: list[str], error: float) -> dict[str, Any]:
        return {"effects": effects, "error": error, "floor": 0.01, "verdict": "unexplained", "selected": []}

    return {
        "status": "ok",
        "config_sha256": str(effects),
        "overrides": {},
        "accelerometer": part([], accelerometer),
        "gyroscope": part(effects, error),
    }


def texts(page: str) -> list[str]:
    return [unescape(text) for text in re.findall(r"<text[^>]*>([^<]*)</text>", page)]


def test_the_fall_stands_beside_what_was_added_and_a_rise_beside_what_was_removed() -> None:
    states = [(1, state([], 0.126)), (2, state(["g_sensitivity"], 0.0107))]
    page = with_history(f"<ul>{LINK_MARK}</ul>{MARK}", states, TIMES)
    assert '<a href="#history">' in page
    assert page.count("<svg") == 1  # the accelerometer has stayed as it was
    drawn = texts(page)
    assert [t for t in drawn if t.startswith("run")] == ["run 1, 12.6 × floor", "run 2: + g sensitivity, 1.07 × floor"]
    assert {"0.126", "0.0107", "noise floor 0.0100"} <= set(drawn)
    assert "the error of the magnitude falls from 0.126 to 0.0107 deg/s, 1.07 × the noise floor" in page
    assert "no longer has" not in page

    page = with_history(MARK, [*states, (5, state([], 0.126))], TIMES)
    assert "The last run no longer has g sensitivity, which run 2 had." in page
    assert "the error of the magnitude rises from 0.0107 to 0.126 deg/s" in page
    assert "Run 5, 2026-02-07 04:05 UTC: − gyroscope.g_sensitivity" in page


def test_a_long_history_shows_the_first_run_and_the_last_ones() -> None:
    states = [(n, state([], 0.1 + 0.001 * n, 0.002)) for n in range(1, 41)]
    drawn = texts(with_history(MARK, states, dict.fromkeys(range(1, 41), "2026")))
    shown = [int(found[1]) for t in drawn if (found := re.match(r"run (\d+)", t))]
    assert shown == [1, *range(30, 41)]


def test_the_data_of_a_comparison_stay_bounded_and_hold_the_first_run_and_the_last_ones() -> None:
    units = [f"U{i}" for i in range(4000)]
    entries = [
        {"run": run, "time": "2026-02-03T04:05:06", "units": {u: state([], 0.01 * run) for u in units}, "gone": []}
        for run in range(1, 7)
    ]
    data = runs_data(entries, {"campaign": "c"}) or {}
    assert [number for number, _ in data["runs"]] == [1, 5, 6]  # two of 4,000 states fit
    assert [[run, s["gyroscope"][0]] for run, s in data["units"][0][1]] == [[1, 0.01], [5, 0.05], [6, 0.06]]
    entries[4]["units"] = {}
    data = runs_data(entries, {"campaign": "c"}) or {}
    assert [number for number, _ in data["runs"]] == [1, 4, 5, 6]
    assert [run for run, _ in data["units"][0][1]] == [1, 4, 6]


def test_the_page_of_a_unit_that_failed_tells_its_runs_too(unit: Unit) -> None:
    failed = {"unit": "U1", "status": "failed", "error": {"code": "bad_input", "message": "no number"}, "inputs": []}
    page = unit_page.render(failed, None, None, [], unit.settings)
    states = [(1, state([], 0.126)), (2, {"status": "failed", "error": "bad_input", "overrides": {}})]
    told = with_history(page, states, TIMES)
    assert "Run 2, 2026-02-04 04:05 UTC: not calibrated: bad_input" in told
    assert unit_page.render(*unit.arguments).count(MARK) == 1
