"""``compare`` of ``campaign.yaml``: which units it becomes, and what of it is refused."""

from pathlib import Path

import pytest
import yaml

from pipeline.config import load_campaign
from pipeline.errors import ConfigurationError

SHEET = """unit,serial,method,rate_dps,overrides
A1,S1,,5,
A2,S2,,20,
B1,S1,staged,5,filter=rc_low_pass
B2,S2,staged,20,filter=rc_low_pass
C1,S1,,,method=cholesky_lu
"""


def resolved(tmp_path: Path, compare: object) -> list[dict[str, object]]:
    directory = tmp_path / "bench"
    directory.mkdir(exist_ok=True)
    (directory / "units.csv").write_text(SHEET)
    (directory / "campaign.yaml").write_text(yaml.safe_dump({"compare": compare}))
    return load_campaign({"campaign": str(directory)}).compare


def members(comparison: dict[str, object]) -> dict[str, list[str]]:
    return {g["name"]: g["units"] for g in comparison["groups"]}  # type: ignore[index, attr-defined]


def test_a_list_of_units_compares_unit_with_unit(tmp_path: Path) -> None:
    plain, titled = resolved(tmp_path, [["A1", "B1"], {"title": "Mine", "units": ["A2", "C1"], "against": "C1"}])
    assert (plain["title"], members(plain), plain["against"]) == ("Comparison 1", {"A1": ["A1"], "B1": ["B1"]}, "A1")
    assert (titled["title"], titled["against"]) == ("Mine", "C1")


def test_columns_choose_units_by_the_configuration_that_they_end_up_with(tmp_path: Path) -> None:
    groups = {"default": {"method": "reference_least_squares"}, "filtered": {"filter": "rc_low_pass"}, "one": ["C1"]}
    (made,) = resolved(tmp_path, [{"groups": groups, "pairs": "serial"}])
    assert members(made) == {"default": ["A1", "A2"], "filtered": ["B1", "B2"], "one": ["C1"]}
    assert made["pairs"] == {"A1": "S1", "A2": "S2", "B1": "S1", "B2": "S2", "C1": "S1"}


def test_values_of_columns_make_groups_whose_last_column_runs_along_a_curve(tmp_path: Path) -> None:
    where = {"method": ["staged", "reference_least_squares"]}
    (made,) = resolved(tmp_path, [{"by": ["method", "rate_dps"], "x": "rate_dps", "where": where}])
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
        ({"groups": {"a": {"method": "stagd"}, "b": ["A1"]}}, "group 'a' is empty: no unit is as it asks for"),
        ({"groups": {"a": {"metod": "staged"}, "b": ["A1"]}}, "units have no column 'metod'; nearest: method"),
        ({"title": "Mine", "groups": {"a": ["A1", "A2"], "b": ["A1"]}}, "'Mine': unit A1 is in 'a' and in 'b'"),
        ({"by": "serial", "where": {"serial": "S1"}}, "two groups or more are expected, got 1"),
        ({"units": ["A1"], "by": "method"}, "a list of units, or a mapping .* got units and by"),
        ({"title": "x"}, "got none of them"),
        ({"units": ["A1", "A2"], "agianst": "A1"}, "agianst: unknown key; nearest: against"),
        ({"units": ["A1", "A2"], "against": "A3"}, "against: no group is called 'A3'"),
        ({"by": "method", "x": "rate_dps"}, "x: unit C1 has '' in column 'rate_dps', which is no number"),
        ("A1", "a list of comparisons is expected, got {'compare"),
    ],
)
def test_what_cannot_be_compared_is_refused_before_any_job(tmp_path: Path, entry: object, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        resolved(tmp_path, {"compare": 1} if entry == "A1" else [entry])
