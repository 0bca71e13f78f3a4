"""Files are complete or absent, and JSON holds finite numbers only."""

from __future__ import annotations

import json
import os
from typing import TYPE_CHECKING, NoReturn

import pytest

from pipeline.core.files import json_text, write_atomically, write_json

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_a_number_that_json_cannot_hold_is_refused_and_the_file_stays(tmp_path: Path, bad: float) -> None:
    path = tmp_path / "unit.json"
    write_json(path, {"bias": [0.5]})
    for value in (bad, [1.0, bad], {"a": [{"b": bad}]}):
        with pytest.raises(ValueError, match="not JSON compliant"):
            write_json(path, value)
    assert json.loads(path.read_text(encoding="utf-8")) == {"bias": [0.5]}


def test_a_write_that_fails_leaves_the_file_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: int) -> NoReturn:
        raise OSError(28, "No space left on device")

    path = tmp_path / "new" / "summary.csv"
    write_atomically(path, "first\n")
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        write_atomically(path, "second\n")
    assert path.read_text(encoding="utf-8") == "first\n"


def test_a_number_that_is_not_finite_is_refused_with_its_place() -> None:
    with pytest.raises(ValueError, match=r"not JSON compliant: value\.far\[0\]\.z \(gyroscope_bias_x U1\) is nan"):
        json_text({"far": [{"parameter": "gyroscope_bias_x", "name": "U1", "z": float("nan")}]})
    with pytest.raises(ValueError, match=r"value\[1\] is inf"):
        json_text([1.0, float("inf")])
