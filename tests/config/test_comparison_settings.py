"""``compare`` of ``campaign.yaml``: which units it becomes, and what of it is refused."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from pipeline.app.config import load_campaign
from pipeline.app.config.campaign import resolve_comparisons
from pipeline.core.errors import ConfigurationError

SHEET = """unit,serial,method,rate_dps,overrides
A1,S1,,5,
A2,S2,,20,
B1,S1,staged,5,filter=rc_low_pass
B2,S2,staged,20,filter=rc_low_pass
C1,S1,,,method=cholesky_lu
"""


Resolve = Callable[[Any], list[dict[str, Any]]]


@pytest.fixture(scope="module")
def resolved(tmp_path_factory: pytest.TempPathFactory) -> Resolve:
    directory = tmp_path_factory.mktemp("compared")
    (directory / "units.csv").write_text(SHEET)
    units = load_campaign({"campaign": str(directory)}).units
    return lambda compare: resolve_comparisons(compare, units, "campaign.yaml")


def test_the_campaigns_file_states_what_is_compared(tmp_path: Path) -> None:
    (tmp_path / "units.csv").write_text(SHEET)
    (tmp_path / "campaign.yaml").write_text(yaml.safe_dump({"compare": [["A1", "B1"]]}))
    (made,) = load_campaign({"campaign": str(tmp_path)}).compare
    assert members(made) == {"A1": ["A1"], "B1": ["B1"]}
    (tmp_path / "campaign.yaml").write_text(yaml.safe_dump({"compare": {"title": "Mine"}}))
    with pytest.raises(ConfigurationError, match=r"a list of comparisons is expected, got \{'title"):
        load_campaign({"campaign": str(tmp_path)})


def members(comparison: dict[str, object]) -> dict[str, list[str]]:
    return {g["name"]: g["units"] for g in comparison["groups"]}  # type: ignore[index, attr-defined]


def test_a_list_of_units_compares_unit_with_unit(resolved: Resolve) -> None:
    plain, titled = resolved([["A1", "B1"], {"title": "Mine", "units": ["A2", "C1"], "against": "C1"}])
    assert (plain["title"], members(plain), plain["against"]) == ("Comparison 1", {"A1": ["A1"], "B1": ["B1"]}, "A1")
    assert (titled["title"], titled["against"]) == ("Mine", "C1")


def test_columns_choose_units_by_the_configuration_that_they_end_up_with(resolved: Resolve) -> None:
    groups = {"default": {"method": "reference_least_squares"}, "filtered": {"filter": "rc_low_pass"}, "one": ["C1"]}
    (made,) = resolved([{"groups": groups, "pairs": "serial"}])
    assert members(made) == {"default": ["A1", "A2"], "filtered": ["B1", "B2"], "one": ["C1"]}
    assert made["pairs"] == {"A1": "S1", "A2": "S2", "B1": "S1", "B2": "S2", "C1": "S1"}


def test_values_of_columns_make_groups_whose_last_column_runs_along_a_curve(resolved: Resolve) -> None:
    where = {"method": ["staged", "reference_least_squares"]}
    (made,) = resolved([{"by": ["method", "rate_dps"], "x": "rate_dps", "where": where}])
    assert [(g["series"], g["label"], g["units"]) for g in made["groups"]] == [  # type: ignore[attr-defined]
        ("reference_least_squares", "5", ["A1"]),
        ("reference_least_squares", "20", ["A2"]),
        ("staged", "5", ["B1"]),
        ("staged", "20", ["B2"]),
    ]
    values = {"A1": 5.0, "A2": 20.0, "B1": 5.0, "B2": 20.0}
    assert made["x"] == {"label": "rate_dps", "values": values, "named": False}


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        (["A1", "A9"], r"entry 1: no unit 'A9' in units.csv; nearest: A2"),
        ({"groups": {"a": {"method": "stagd"}, "b": ["A1"]}}, "group 'a' is empty: no unit has these values"),
        ({"groups": {"a": {"metod": "staged"}, "b": ["A1"]}}, "units have no column 'metod'; nearest: method"),
        ({"title": "Mine", "groups": {"a": ["A1", "A2"], "b": ["A1"]}}, "'Mine': unit A1 is in 'a' and in 'b'"),
        ({"by": "serial", "where": {"serial": "S1"}}, "two groups or more are expected, got 1"),
        ({"units": ["A1"], "by": "method"}, "a list of units, or a mapping .* got units and by"),
        ({"title": "x"}, "got none of them"),
        ({"units": ["A1", "A2"], "agianst": "A1"}, "agianst: unknown key; nearest: against"),
        ({"units": ["A1", "A2"], "against": "A3"}, "against: no group is called 'A3'"),
        ({"by": "method", "x": "rate_dps"}, "x: unit C1 has '' in column 'rate_dps', which is no number"),
    ],
)
def test_what_cannot_be_compared_is_refused_before_any_job(resolved: Resolve, entry: object, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        resolved([entry])
