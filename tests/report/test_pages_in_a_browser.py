"""The pages in headless Chromium: nothing leaves them, nothing fails in them, and what they offer works."""

import csv
import re
import shutil
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, Page, sync_playwright

from pipeline.output.pages import campaign_page, unit_page
from pipeline.output.pages.chart import CHART_WIDTH, LEFT, RIGHT, Figure, LineMark, Panel, SampleMarks, chart
from pipeline.output.pages.fleet import runs_data
from pipeline.output.pages.pages import asset

from .conftest import build_unit

UNITS = 1200
FAILED = UNITS // 200
WIDTH = CHART_WIDTH - LEFT - RIGHT  # of the panels of a chart
TEXTS = """charts => charts.flatMap((svg) => {
  const box = svg.getBoundingClientRect();
  const all = [...svg.querySelectorAll("text")].map((e) => [e.textContent, e.getBoundingClientRect()]);
  const [ticks, names] = [".panel > .ticks text", ".panel > text[transform]"].map((selector) =>
    [...svg.querySelectorAll(selector)].map((e) => [e.textContent, e.getBoundingClientRect()]));
  const across = (a, b) => Math.min(a.right, b.right) - Math.max(a.left, b.left) > 2
    && Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top) > 4;
  return [...all.filter(([, r]) => r.left < box.left - 2 || r.right > box.right + 2).map(([text]) => text),
    ...ticks.flatMap(([text, a]) => names.filter(([, b]) => across(a, b)).map(([name]) => `${text} on ${name}`))];
})"""  # texts of charts that are cut, and ticks on the name of their axis
PHONE: Any = {"width": 390, "height": 844}
DESKTOP: Any = {"width": 1280, "height": 720}


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    program = next((p for p in map(shutil.which, ("chromium", "chromium-browser", "google-chrome")) if p), None)
    if program is None:
        pytest.skip("there is no Chromium on this machine")
    with sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        yield started
        started.close()


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pages")
    unit = build_unit()
    words = {"accelerometer": ["Quadratic nonlinearity is missing."], "gyroscope": []}
    (folder / "unit.html").write_text(unit_page.render(*unit.arguments, words=words))
    (folder / "campaign.html").write_text(campaign_page.render("factory", fleet(), failures(), history=runs()))
    failed = {"unit": "U1", "status": "failed", "error": {"code": "bad_input", "message": "x", "file": None}}
    (folder / "failed.html").write_text(unit_page.render(failed, None, None, [], unit.settings))
    x = np.linspace(0.0, 10.0, 11)
    (folder / "chart.html").write_text(one_chart(LineMark(x, 3.0 * x - 1.0, 0)))
    (folder / "samples.html").write_text(one_chart(SampleMarks(*noisy_samples(), mean=True)))
    return folder


def fleet() -> list[dict[str, Any]]:
    """Units in an order that no column sorts them by; every 200th failed, every ninth lacks an effect."""
    rng = np.random.default_rng(7)
    rows = []
    for i in rng.permutation(UNITS).tolist():
        row: dict[str, Any] = {"unit": f"U{i}", "serial": f"S{i}", "lot": f"L{i // 240}", "date": "2026-02-03"}
        row |= {"status": "failed" if i % 200 == 7 else "ok", "sensor": "mpu6050", "pass": i % 17 != 0}
        row["method"] = "staged" if i % 3 == 0 else "reference_least_squares"
        for sensor in ("accelerometer", "gyroscope"):
            lacks = i % 9 == 0
            row |= {
                f"{sensor}_error_before": 0.05,
                f"{sensor}_error_after": float(rng.uniform(0.0008, 0.02)),
                f"{sensor}_noise_floor": 0.0008,
                f"{sensor}_verdict": "missing_effect" if lacks else "nothing_missing",
                f"{sensor}_selected": "g_sensitivity" if lacks else None,
            }
        rows.append(row if row["status"] == "ok" else {k: v for k, v in row.items() if "_" not in k})
    return rows


def runs() -> dict[str, Any]:
    """Return three runs: the first, one that adds an effect to two units, and one that drops it from one of them."""

    def state(effects: list[str], error: float) -> dict[str, Any]:
        part = {"effects": effects, "error": error, "floor": 0.0008, "verdict": "nothing_missing", "selected": []}
        return {"status": "ok", "overrides": {}, "accelerometer": None, "gyroscope": part}

    changes = [
        {"U0": state([], 0.1), "U9": state([], 0.2), "U1": state([], 0.3)},
        {"U0": state(["g_sensitivity"], 0.001), "U9": state(["g_sensitivity"], 0.1)},
        {"U9": state([], 0.2)},
    ]
    entries = [{"run": i, "time": "2026-02-03T04:05:06", "units": u, "gone": []} for i, u in enumerate(changes, 1)]
    return runs_data(entries, {"campaign": "factory"}) or {}


def failures() -> list[dict[str, Any]]:
    failed = [r["unit"] for r in fleet() if r["status"] == "failed"]
    return [
        {"unit": u, "stage": "ingest", "code": "bad_input", "message": "no number", "file": "x.csv"} for u in failed
    ]


def noisy_samples() -> tuple[np.ndarray, np.ndarray]:
    """Return 5,000 samples: a slope with noise, which the drawing shows in 140 ranges."""
    x = np.sort(np.random.default_rng(3).uniform(0.0, 10.0, 5000))
    return x, x + np.random.default_rng(4).standard_normal(len(x))


def one_chart(layer: LineMark | SampleMarks) -> str:
    """Return a page with a chart."""
    svg = chart(Figure("line", "A line"), "It rises.", [Panel([layer], "height, m")], "way, km").svg
    legend = '<ul class="legend"><li><i class="c0"></i>the line</li></ul>'
    style, script = asset("page.css"), asset("chart.js") + asset("chart_files.js")
    figure = f"<figure>{svg}<figcaption>{legend}</figcaption></figure>"
    return f"<!doctype html><title>line</title><style>{style}</style>{figure}<script>{script}</script>"


def watched(page: Page) -> Page:
    """Have what a page asks for, and the errors that it reports, listed."""
    page.set_default_timeout(20_000)
    page.on("request", lambda r: page.asked.append(r.url))  # type: ignore[attr-defined]
    page.on("console", lambda m: page.wrong.append(m.text) if m.type in ("error", "warning") else None)  # type: ignore[attr-defined]
    page.on("pageerror", lambda e: page.wrong.append(str(e)))  # type: ignore[attr-defined]
    return page


@cache
def shared(browser: Browser) -> Page:
    """Return a page for all tests without settings of their own: a new one takes more than most of them."""
    return watched(browser.new_context().new_page())


def opened(
    browser: Browser, path: Path, *, folded: bool = False, size: Any = DESKTOP, scheme: Any = "light", **settings: Any
) -> Page:
    """Open a page, its parts unfolded; ``left_alone`` tells whether it asks for anything or reports an error."""
    page = watched(browser.new_context(**settings).new_page()) if settings else shared(browser)
    if not settings:
        page.emulate_media(media="screen", color_scheme=scheme)
        page.set_viewport_size(size)
    page.mouse.move(0, 0)
    page.asked, page.wrong = [], []  # type: ignore[attr-defined]
    page.goto(path.as_uri())
    if not folded:
        page.evaluate("document.querySelectorAll('details.part').forEach((part) => { part.open = true })")
    return page


def left_alone(page: Page, path: Path) -> bool:
    """Return whether the page asked for itself only, and reported nothing."""
    asked = [u for u in page.asked if not u.startswith("data:")]  # type: ignore[attr-defined]
    return (asked, page.wrong) == ([path.as_uri()], [])  # type: ignore[attr-defined]


def scroll(page: Page, share: float) -> None:
    """Scroll the table of all units, and wait until its rows are drawn."""
    page.eval_on_selector(".tall", "(e, share) => { e.scrollTop = share * (e.scrollHeight - e.clientHeight) }", share)
    page.evaluate(
        "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => setTimeout(done, 50))))"
    )


def column(page: Page, number: int) -> list[str]:
    cells = page.eval_on_selector_all(
        f"#all tbody tr > :nth-child({number})", "c => c.map((e) => e.textContent.trim())"
    )
    return list(cells)


@pytest.mark.parametrize("name", ["unit.html", "campaign.html"])
@pytest.mark.parametrize("settings", [{}, {"color_scheme": "dark"}, {"viewport": PHONE, "has_touch": True}])
def test_a_page_asks_for_nothing_reports_no_error_and_fits(
    browser: Browser, pages: Path, name: str, settings: dict[str, Any]
) -> None:
    page = opened(browser, pages / name, **settings)
    for picture in page.locator("svg[data-scale]").all()[:4]:
        picture.scroll_into_view_if_needed()
        picture.hover()
    assert left_alone(page, pages / name)
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
    ground = [int(v) for v in re.findall(r"\d+", page.evaluate("getComputedStyle(document.body).backgroundColor"))[:3]]
    assert (max(ground) < 60) == (settings.get("color_scheme") == "dark")
    if settings:
        page.context.close()


@pytest.mark.parametrize("name", ["unit.html", "campaign.html"])
def test_every_chart_has_a_name_and_a_description_for_those_who_cannot_see_it(
    browser: Browser, pages: Path, name: str
) -> None:
    page = opened(browser, pages / name)
    told = page.eval_on_selector_all(
        "svg",
        """all => all.map((svg) => [svg.getAttribute("role"), ...(svg.getAttribute("aria-labelledby") ?? "").split(" ")
            .map((id) => document.getElementById(id)?.textContent ?? "")])""",
    )
    assert len(told) >= 2
    assert all(role == "img" and len(title) > 5 and len(words) > 5 for role, title, words in told)
    identifiers = page.eval_on_selector_all("[id]", "all => all.map((e) => e.id)")
    assert len(identifiers) == len(set(identifiers))


def test_what_a_page_hides_without_its_script_is_little(browser: Browser, pages: Path) -> None:
    page = opened(browser, pages / "unit.html", java_script_enabled=False)
    assert page.locator("svg").count() > 10
    assert page.locator("button:visible").count() == 0
    page.context.close()


def test_the_table_of_all_units_sorts_by_keyboard_with_empty_cells_last(browser: Browser, pages: Path) -> None:
    page = opened(browser, pages / "campaign.html")
    heading = page.locator("#all thead tr:nth-child(2) th:nth-child(9)")  # error after, accelerometer
    heading.locator("button").focus()
    page.keyboard.press("Enter")
    assert heading.get_attribute("aria-sort") == "ascending"
    known = sorted(1e3 * r["accelerometer_error_after"] for r in fleet() if "accelerometer_error_after" in r)  # mg
    first = [float(v) for v in column(page, 9)]
    assert first == pytest.approx(known[: len(first)], rel=5e-3)
    page.keyboard.press("Enter")
    assert heading.get_attribute("aria-sort") == "descending"
    assert [float(v) for v in column(page, 9)] == pytest.approx(known[::-1][: len(first)], rel=5e-3)
    scroll(page, 1.0)
    last = column(page, 9)
    assert [i for i, v in enumerate(last) if v == ""] == list(range(len(last) - FAILED, len(last)))
    page.locator("#all thead tr:nth-child(2) th:nth-child(1) button").click()
    names = column(page, 1)
    assert names == [f"U{i}" for i in range(len(names))]  # U10 after U9


def test_of_a_long_table_the_rows_in_view_are_in_the_page_and_all_of_them_in_print(
    browser: Browser, pages: Path
) -> None:
    page = opened(browser, pages / "campaign.html")
    expected = [r["unit"] for r in fleet()]
    page.eval_on_selector(".tall", "e => e.scrollIntoView()")
    for share in (0.0, 0.5, 1.0):
        scroll(page, share)
        middle = "document.querySelector('.tall').getBoundingClientRect().top + 300"
        row = f"document.elementFromPoint(100, {middle})?.closest('#all tbody tr')"
        at = int(page.evaluate(f"{row}.ariaRowIndex")) - 3
        assert at == pytest.approx(share * UNITS, abs=0.03 * UNITS)
        shown = column(page, 1)
        assert len(shown) <= 100
        start = expected.index(shown[0])
        assert shown == expected[start : start + len(shown)]
        assert start <= at < start + len(shown)
    assert page.get_attribute("#all", "aria-rowcount") == str(UNITS + 2)
    page.evaluate("dispatchEvent(new Event('beforeprint'))")
    assert column(page, 1) == expected
    page.evaluate("dispatchEvent(new Event('afterprint'))")
    assert len(column(page, 1)) <= 100
    assert left_alone(page, pages / "campaign.html")


def test_the_table_of_all_units_needs_no_horizontal_scrolling_on_a_desktop(browser: Browser, pages: Path) -> None:
    page = opened(browser, pages / "campaign.html", viewport={"width": 1200, "height": 900})
    page.evaluate(
        "document.querySelectorAll('#all tbody a').forEach((a) => { a.textContent = 'mpu6050-1-mark2-thesis' })"
    )
    wide, shown = page.eval_on_selector(".tall", "e => [e.scrollWidth, e.clientWidth]")
    assert wide <= shown
    page.context.close()


def test_the_filter_finds_rows_by_words_and_leaves_out_others(browser: Browser, pages: Path) -> None:
    page = opened(browser, pages / "campaign.html")
    box = page.get_by_label("Filter:")
    box.fill("missing effect staged")
    wanted = [i for i in range(UNITS) if i % 9 == 0 and i % 200 != 7]
    assert page.locator("#shown").text_content() == f"{len(wanted)} of {UNITS} units match"
    assert set(column(page, 7)) == {"staged"}
    box.fill("missing effect -l0 -l1 -l2 -l3")
    assert sorted(column(page, 1)) == sorted(f"U{i}" for i in wanted if i >= 960)
    box.fill("no unit has this")
    assert column(page, 1) == []
    box.fill("")
    assert 20 < len(column(page, 1)) <= 100


def test_a_dot_of_the_fleet_is_named(browser: Browser, pages: Path) -> None:
    page = opened(browser, pages / "campaign.html")
    picture = page.locator("svg[data-names]").first
    picture.focus()
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowRight")
    assert page.locator(".readout b").first.text_content() == fleet()[1]["unit"]


def test_a_chart_of_many_units_shows_quantiles_and_names_the_farthest(
    browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(campaign_page, "MOST_DOTS", UNITS // 2)
    file = tmp_path / "campaign.html"
    file.write_text(campaign_page.render("factory", fleet(), failures(), history=runs()))
    known = sorted((r for r in fleet() if r["status"] == "ok"), key=lambda r: -r["accelerometer_error_after"])
    farthest = {r["unit"]: f"{r['accelerometer_error_after']:.6g}" for r in known[: campaign_page.FARTHEST_UNITS]}
    page = opened(browser, file)
    picture = page.locator("svg[data-names]").first
    dots = "e => [...e.querySelectorAll('.layers .dots')].reduce((n, p) => n + p.dataset.units.split(' ').length, 0)"
    assert picture.evaluate(dots) == campaign_page.FARTHEST_UNITS
    assert picture.locator(".band").count() == 3
    picture.focus()
    told = {}
    for _ in range(4):
        page.keyboard.press("ArrowRight")
        unit, row = page.locator(".readout b, .readout span").all_text_contents()[:2]
        told[unit] = row.split()[-2]
    assert told.items() <= farthest.items()
    assert len(told) == 4
    with page.expect_download() as saved:
        page.locator("figure", has=picture).first.hover()
        page.locator("figure", has=picture).first.get_by_role("button", name="CSV").click()
    rows = csv.DictReader(saved.value.path().read_text().splitlines())
    assert {row["unit"]: row["stated"] for row in rows if row["unit"]} == farthest
    assert left_alone(page, file)


def test_a_dot_tells_the_value_of_the_unit_and_not_a_rounded_coordinate(browser: Browser, pages: Path) -> None:
    page = opened(browser, pages / "campaign.html")
    picture = page.locator("svg[data-names]").first
    picture.focus()
    box, told = picture.bounding_box() or {}, set()
    for share in np.linspace(0.2, 0.9, 8):
        page.mouse.move(box["x"] + box["width"] * share, box["y"] + box["height"] * 0.3)
        unit, row = page.locator(".readout b, .readout span").all_text_contents()[:2]
        known = next(r for r in fleet() if r["unit"] == unit)
        values = [f"{known[f'accelerometer_{k}']:.6g}" for k in ("error_before", "error_after", "noise_floor")]
        assert row.split()[-2] in values
        told.add(row.split()[-2])
    assert len(told) > 2


def test_units_that_are_chosen_are_marked_in_every_chart_and_list(browser: Browser, pages: Path) -> None:
    page = opened(browser, pages / "campaign.html")
    picture = page.locator("svg[data-names]").first
    picture.focus()
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowRight")
    page.keyboard.press("Enter")
    name = fleet()[1]["unit"]
    rings = "all => all.map((e) => e.getAttribute('d').split('M').length - 1)"
    assert page.eval_on_selector_all("svg .chosen", rings) == [3, 3]  # before, after and floor, of either sensor
    assert page.locator("tr.chosen th").all_text_contents() == [name]
    assert page.locator(".brush [role=status]").text_content() == f"1 unit marked: {name}"
    page.locator("#all tbody tr td:nth-child(4)").first.click()
    assert page.locator("tr.chosen").count() == 2
    page.get_by_role("button", name="Clear").click()
    page.get_by_label("Filter:").fill("missing effect -l0 -l1 -l2 -l3")
    page.get_by_role("button", name="Mark in the charts").click()
    wanted = [i for i in range(960, UNITS) if i % 9 == 0 and i % 200 != 7]
    assert page.eval_on_selector_all("svg .chosen", rings) == [3 * len(wanted)] * 2
    assert left_alone(page, pages / "campaign.html")


def test_any_two_runs_are_compared_with_the_largest_change_first(browser: Browser, pages: Path) -> None:
    page = opened(browser, pages / "campaign.html")

    def rows() -> list[list[str]]:
        return [r.split("\t") for r in page.locator("#runs-table tbody").inner_text().splitlines()]

    same = ["nothing missing", "nothing missing"]
    assert rows() == [["U9", "gyroscope", "0.100", "0.200", "125", "250", *same, "− g sensitivity"]]
    page.locator("#run-a").select_option("1")
    page.locator("#run-b").select_option("2")
    assert [(r[0], r[2], r[3], r[8]) for r in rows()] == [
        ("U0", "0.100", "0.00100", "+ g sensitivity"),
        ("U9", "0.200", "0.100", "+ g sensitivity"),
    ]
    page.locator("#run-b").select_option("1")
    assert page.locator("#runs-said").text_content() == "No unit differs between these runs."
    told = page.locator(".card", has_text="no longer has").inner_text()
    assert "U9: run 3 no longer has gyroscope.g_sensitivity, which run 2 had." in told
    assert f"python -m pipeline add factory U9 gyroscope.g_sensitivity --results {pages.parent}" in told
    assert left_alone(page, pages / "campaign.html")


def test_arrow_keys_and_pointer_read_the_values_that_were_drawn(browser: Browser, pages: Path) -> None:
    page = opened(browser, pages / "chart.html")
    readout = page.locator(".readout")
    page.locator("svg").focus()
    for k in range(4):
        page.keyboard.press("ArrowRight")
        told = [float(v) for v in re.findall(r"-?[\d.]+", (readout.text_content() or "").replace("−", "-"))]
        assert told == pytest.approx([k, 3.0 * k - 1.0], abs=0.05)
    assert "way, km" in (readout.text_content() or "")
    page.locator("svg").blur()
    assert readout.is_hidden()
    box = page.locator("svg").bounding_box() or {}
    page.mouse.move(box["x"] + box["width"] * (LEFT + WIDTH * 0.7) / 420, box["y"] + 60)
    told = [float(v) for v in re.findall(r"[\d.]+", readout.text_content() or "")]
    assert told == pytest.approx([7.0, 20.0], abs=0.025)  # coordinates are drawn to a tenth of a pixel
    assert left_alone(page, pages / "chart.html")


def test_dragging_zooms_into_what_was_marked_and_escape_goes_back(browser: Browser, pages: Path) -> None:
    page = opened(browser, pages / "chart.html")

    def labels() -> list[str]:
        return list(page.eval_on_selector_all("svg > .ticks text", "all => all.map((e) => e.textContent)"))

    before = labels()
    box = page.locator("svg").bounding_box() or {}
    left, right = (box["x"] + box["width"] * (LEFT + WIDTH * share) / 420 for share in (0.395, 0.605))
    page.mouse.move(left, box["y"] + 40)
    page.mouse.down()
    page.mouse.move(right, box["y"] + 42, steps=3)
    page.mouse.up()
    assert [float(v) for v in labels()] == pytest.approx([4.0, 4.5, 5.0, 5.5, 6.0])
    page.mouse.move((left + right) / 2, box["y"] + 60)
    assert float(re.findall(r"[\d.]+", page.locator(".readout b").text_content() or "")[0]) == pytest.approx(
        5.0, abs=0.01
    )
    page.keyboard.press("Escape")
    assert labels() == before


def test_a_chart_moves_with_shift_and_is_saved_with_its_values(browser: Browser, pages: Path) -> None:
    page = opened(browser, pages / "chart.html")
    page.locator("svg.chart").focus()
    page.keyboard.press("+")
    ticks = "all => all.map((e) => parseFloat(e.textContent))"
    before = page.eval_on_selector_all("svg > .ticks text", ticks)
    box = page.locator("svg.chart").bounding_box() or {}
    page.keyboard.down("Shift")
    page.mouse.move(box["x"] + box["width"] * 0.5, box["y"] + 40)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] * (0.5 - WIDTH * 0.2 / 420), box["y"] + 40, steps=3)
    page.mouse.up()
    page.keyboard.up("Shift")
    after = page.eval_on_selector_all("svg > .ticks text", ticks)
    assert before[0] == pytest.approx(2.5, abs=0.5)
    assert after[0] == pytest.approx(before[0] + 1.0)  # a fifth of the 5 km in view
    page.locator("figure").hover()
    with page.expect_download() as saved:
        page.get_by_role("button", name="CSV").click()
    rows = [row.split(",") for row in saved.value.path().read_text().splitlines()]
    assert rows[0] == ["panel", "series", '"way', ' km"', "value", "low", "high"]
    assert [float(row[3]) for row in rows[1:]] == pytest.approx(np.arange(11.0), abs=0.005)
    assert [float(row[4]) for row in rows[1:]] == pytest.approx(3.0 * np.arange(11.0) - 1.0, abs=0.02)
    with page.expect_download() as saved:
        page.get_by_role("button", name="PNG").click()
    head = saved.value.path().read_bytes()[:24]
    assert head.startswith(b"\x89PNG")
    assert int.from_bytes(head[16:20], "big") == 4 * 420


def test_a_zoom_shows_the_samples_within_it_and_the_file_holds_all(browser: Browser, pages: Path) -> None:
    page = opened(browser, pages / "samples.html")
    x, y = noisy_samples()
    page.locator("svg.chart").focus()
    drawn = page.locator("svg .layers path").first.get_attribute("d")
    for _ in range(5):
        page.keyboard.press("+")
    low, high = page.evaluate("(() => { const t = [...document.querySelectorAll('svg > .ticks text')]; "
                              "return [t[0], t.at(-1)].map((e) => +e.textContent); })()")  # fmt: skip
    within = (x > low) & (x < high)
    dots = page.locator("svg .dots").get_attribute("d") or ""
    assert within.sum() <= dots.count("M") <= 5000 / 2**5 * 1.3
    page.keyboard.press("ArrowRight")
    at, value = (float(v) for v in re.findall(r"-?[\d.]+", page.locator(".readout").inner_text().replace("−", "-")))
    nearest = int(np.argmin(np.abs(x - at)))
    assert (at, value) == pytest.approx((x[nearest], y[nearest]), abs=4e-4)  # 1 / 65,534 of either axis
    page.keyboard.press("Escape")
    assert page.locator("svg .layers path").first.get_attribute("d") == drawn
    with page.expect_download() as saved:
        page.locator("figure").hover()
        page.get_by_role("button", name="CSV").click()
    rows = [row.split(",") for row in saved.value.path().read_text().splitlines()[1:]]
    assert np.array([row[3:5] for row in rows], float) == pytest.approx(np.stack([x, y], 1), abs=4e-4)
    assert left_alone(page, pages / "samples.html")


def test_a_wide_table_is_folded_on_a_phone_and_on_no_other_screen(browser: Browser, pages: Path) -> None:
    page = opened(browser, pages / "campaign.html", viewport=PHONE)
    page.locator("#all.folded").wait_for()
    wide, shown = page.eval_on_selector(".tall", "e => [e.scrollWidth, e.clientWidth]")
    assert wide <= shown
    before = "e => getComputedStyle(e, '::before').content"
    told = [page.locator(f"#all tbody tr:first-child > :nth-child({k})").evaluate(before) for k in (2, 8, 9)]
    assert told == ['"state"', '"Accelerometer, before"', '"after"']
    page.set_viewport_size({"width": 900, "height": 900})
    page.locator("#all:not(.folded)").wait_for()
    page.context.close()


def test_a_series_is_switched_off_and_a_chart_enlarged_and_put_back(browser: Browser, pages: Path) -> None:
    page = opened(browser, pages / "chart.html")
    name = page.get_by_role("button", name="the line")
    assert name.get_attribute("aria-pressed") == "true"
    name.click()
    assert name.get_attribute("aria-pressed") == "false"
    assert page.locator(".layers .line").is_hidden()
    name.click()
    narrow = (page.locator("svg").bounding_box() or {})["width"]
    page.get_by_role("button", name="Enlarge").click()
    assert page.locator("dialog[open] svg").count() == 1
    page.keyboard.press("Escape")
    page.locator("body > figure svg").wait_for()
    assert (page.locator("svg").bounding_box() or {})["width"] == narrow


def test_the_contents_stay_in_view_and_tell_where_the_reader_is(browser: Browser, pages: Path) -> None:
    page = opened(browser, pages / "unit.html")
    page.locator(".contents a[href='#gyroscope']").click()
    page.locator(".contents a[aria-current]", has_text="Gyroscope").wait_for()
    box = page.locator(".contents").bounding_box() or {}
    assert box["y"] == 0.0 < page.evaluate("scrollY")
    below = page.locator(".contents .parts a").all_text_contents()
    assert below == page.locator("#gyroscope h3").all_text_contents()
    assert left_alone(page, pages / "unit.html")


def test_a_link_into_a_folded_part_opens_it(browser: Browser, pages: Path) -> None:
    page = opened(browser, pages / "unit.html", folded=True)
    assert page.locator("details.part[open]").count() == 0
    page.locator(".contents a[href='#provenance']").click()
    page.locator("#provenance-part[open]").wait_for()
    page.goto(f"{(pages / 'unit.html').as_uri()}#gyroscope-parameters")
    page.locator("#gyroscope-parameters-part[open]").wait_for()


@pytest.mark.parametrize("units", [9, 100])
def test_every_row_is_printed(browser: Browser, tmp_path: Path, units: int) -> None:
    (tmp_path / "index.html").write_text(campaign_page.render("bench", fleet()[:units], []))
    page = opened(browser, tmp_path / "index.html")
    page.emulate_media(media="print")
    page.evaluate("dispatchEvent(new Event('beforeprint'))")
    box, rows = page.locator(".tall").bounding_box() or {}, page.locator("#all tbody tr")
    last = rows.nth(units - 1).bounding_box() or {}
    assert rows.count() == units
    assert last["y"] + last["height"] <= box["y"] + box["height"] + 1.0


@pytest.mark.parametrize("width", [390, 900, 1300, 1900])
def test_pages_fit_every_window_with_few_words_and_a_first_screen(browser: Browser, pages: Path, width: int) -> None:
    page = opened(browser, pages / "unit.html", folded=True, size={"width": width, "height": 900})
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
    assert len(page.inner_text("body").split()) < 1200
    if width == 1300:
        assert page.evaluate("document.documentElement.scrollHeight") < 3500
    clipped = (
        """all => all.filter((e) => e.checkVisibility() && e.scrollWidth > e.clientWidth + 1).map((e) => e.outerHTML)"""
    )
    assert page.eval_on_selector_all(".card .scroll, figure, .big", clipped) == []
    page.evaluate("document.querySelectorAll('details').forEach((part) => part.open = true)")
    page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    assert page.eval_on_selector_all("svg.chart", TEXTS) == []
    unreached = "all => all.filter((e) => e.scrollWidth > e.clientWidth && e.tabIndex !== 0).map((e) => e.innerText)"
    assert page.eval_on_selector_all(".scroll", unreached) == []  # by keys
    assert page.locator("th:empty").count() == 0


def test_on_paper_a_page_has_no_controls(browser: Browser, pages: Path) -> None:
    page = opened(browser, pages / "unit.html", color_scheme="dark")
    page.emulate_media(media="print")
    assert page.locator("nav:visible, .tools:visible, input:visible, .chart-hint:visible").count() == 0
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    page.context.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("name", ["unit", "campaign", "failed"])
def test_axe_finds_nothing(browser: Browser, pages: Path, name: str, scheme: Literal["light", "dark"]) -> None:
    page = opened(browser, pages / f"{name}.html", folded=True, scheme=scheme)
    found = Axe().run(page).response["violations"]
    assert [(rule["id"], [node["target"] for node in rule["nodes"]][:5]) for rule in found] == []


@pytest.mark.parametrize(("name", "shown"), [("unit", True), ("failed", False)])
def test_charts_are_explained_where_there_is_one(browser: Browser, pages: Path, name: str, *, shown: bool) -> None:
    page = opened(browser, pages / f"{name}.html", folded=True)
    assert (page.locator("svg[data-scale]").count() > 0) == shown
    assert page.locator(".chart-hint").is_visible() == shown
