"""JSON with indents beside that of the standard library."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest

from pipeline.json_text import json_text

VALUES: list[Any] = [
    {},
    [],
    "",
    None,
    True,
    -0.0,
    1e300,
    5e-324,
    2**70,
    [[], {}, [[]], {"a": {}}],
    {"a": [1, 2.5, None, False], "b": {"c": [{"d": "x"}, ("y", [0.1])]}},
    {"ключ \"'\\ \n\t\0\x7f": "g·m/s² ± \u2028 \U0001f600"},
    [np.float64(0.1), {"k": np.float64(-3e-9)}],
]


@pytest.mark.parametrize("indent", [1, 2, 4])
def test_the_text_is_that_of_the_standard_library(indent: int) -> None:
    for value in VALUES:
        assert json_text(value, indent) == json.dumps(value, indent=indent, ensure_ascii=False)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_number_that_json_cannot_hold_is_refused(bad: float) -> None:
    for value in (bad, [1.0, bad], {"a": [{"b": bad}]}):
        with pytest.raises(ValueError, match="not JSON compliant"):
            json_text(value)


def test_what_is_no_json_is_refused() -> None:
    with pytest.raises(TypeError):
        json_text({"a": [object()]})
    with pytest.raises(TypeError):
        json_text({1: "a"})
