"""The page of the thesis, rendered from the kept study and a run of which nothing or little is known."""

from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from unit_settings import filter_of

from imu_logs.yaml_file import read_yaml
from imu_research.thesis.findings import CONFIRMED, REFUTED, agreements, conclusions, gain_of_filter, scatters
from imu_research.thesis.page import key_of, render
from imu_research.thesis.seeds import INTERVAL_S, TIME_CONSTANT_S, sets_of
from imu_research.thesis.tables import Results, all_tables, with_differences
from pipeline.core.records import Recording
from pipeline.physics.signal.filters import apply_filter

CAMPAIGN = Path(__file__).parents[2] / "data" / "thesis"
ROWS = pd.read_csv(CAMPAIGN / "seeds.csv")


class Text(HTMLParser):
    """Collects the text of a page and the targets within it."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.text, self.ids, self.links = "", set[str](), set[str]()
        self.feed(page)

    def handle_data(self, data: str) -> None:
        self.text += data

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        own = dict(attrs)
        self.ids.add(own.get("id") or "")
        if tag == "a" and (own.get("href") or "").startswith("#"):
            self.links.add(str(own["href"])[1:])


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Text:
    """The page without a run."""
    return Text(render(CAMPAIGN, tmp_path_factory.mktemp("no_run")))


def test_the_page_holds_every_table_and_stands_without_a_run(page: Text) -> None:
    for number in (*(f"5.{k}" for k in range(1, 27)), "paper 1", "paper 2", "paper 3", "paper 4"):
        assert f"Table {number}\n" in page.text
    assert page.links <= page.ids
    assert "nan" not in page.text.lower().replace("nan.", "")


def test_the_cells_of_all_tables_are_the_printed_ones(tmp_path: Path) -> None:
    cells = all_tables(CAMPAIGN / "printed", Results(tmp_path)).set_index(["table", "row"])
    assert cells.index.get_level_values("table").nunique() == 30
    first = cells.loc[("5.1", "Sz")]
    assert first[first["block"].str.startswith("as printed")]["printed"].tolist() == [0.945, 0.962, 0.975]
    changes = cells.loc[("5.20", "largest e: change, %")]
    printed = changes[changes["block"] == "as printed"]["printed"].tolist()
    assert printed == [447.08, 444.624, 439.385, 439.666, 445.08]


def test_a_difference_within_the_rounding_of_the_print_is_not_large() -> None:
    for printed, ours, large in ((0.003, 0.004, False), (0.003, 0.0045, True), (0.8, 0.99, False)):
        found = with_differences(pd.DataFrame({"printed": [printed], "ours": [ours], "digits": [3]}))
        assert bool(found["large"].iloc[0]) is large


def test_the_study_has_fifty_seeds_of_every_set() -> None:
    seeds = ROWS.groupby("set")["seed"].nunique()
    assert set(seeds.index) == set(sets_of(CAMPAIGN))
    assert (seeds == 50).all()


@pytest.mark.parametrize(
    ("conclusion", "verdict"), [("delay", REFUTED), ("least_squares", REFUTED), ("table_gyroscope", CONFIRMED)]
)
def test_a_conclusion_is_judged_by_its_interval_over_seeds(conclusion: str, verdict: str) -> None:
    judged = [line for line in conclusions(ROWS)[conclusion] if line.verdict == verdict]
    assert judged
    for line in judged:
        low, high = line.difference.interval
        assert line.difference.count == 50
        assert (low > 0.0) if verdict == CONFIRMED else (high < 0.0)


def test_the_campaign_s_filter_takes_of_a_turn_what_the_page_says() -> None:
    time = np.arange(0.0, 120.0, INTERVAL_S)
    turn = np.radians(30.0) * time
    settings = filter_of("rc_low_pass", cutoff_hz=None, time_constant_s=TIME_CONSTANT_S, zero_phase=False)
    reading = np.column_stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)])
    turning = Recording("x", "accelerometer", "x", np.round(time * 1e9).astype(np.int64), accelerometer=reading)
    left = np.linalg.norm(np.asarray(apply_filter(turning, settings).accelerometer)[100:], axis=1)
    assert left == pytest.approx(gain_of_filter(30.0), rel=1e-9)
    assert 1.0 - gain_of_filter(30.0) == pytest.approx(0.0039, abs=1e-4)


def test_without_a_run_no_parameter_is_said_to_agree(tmp_path: Path) -> None:
    found = agreements(CAMPAIGN / "printed", Results(tmp_path))
    assert len(found) == 9
    assert found["largest"].isna().all()
    assert (found["within"] == 0).all()


def test_picked_peaks_explain_the_scatter_of_o_on_the_first_device_and_not_on_the_tactical_one() -> None:
    found = scatters(CAMPAIGN / "printed", ROWS).set_index(["device", "quantity"])
    share = found["unexplained"] / found["printed"]
    assert share["mpu6050-1", "O"] < 0.3
    assert share["stim300", "O"] > 0.9


def test_every_explanation_has_a_key_of_its_own_and_is_found() -> None:
    explanations = read_yaml(CAMPAIGN / "printed" / "explanations.yaml")
    assert len({e["key"] for e in explanations}) == len(explanations) == 16
    for place, key in (
        (("5.1", "as printed: the largest and smallest samples", "bx, g", "stop 1 s"), "b"),
        (("5.25", "inverted: Cholesky and LU's matrix", "R12", "STIM300, Cholesky and LU"), "a"),
        (("5.26", "as printed", "mean |e|, deg/s: after", "STIM300, staged"), "l"),
    ):
        assert key_of(explanations, dict(zip(("table", "block", "row", "column"), place, strict=True))) == key


def test_the_page_names_every_conclusion_that_is_judged(page: Text) -> None:
    text = page.text
    assert text.count(" comparisons\n") + text.count("1 comparison\n") == len(conclusions(ROWS)) == 10
