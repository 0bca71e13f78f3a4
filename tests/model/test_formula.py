"""Formulas of strangers: what they may say is computed by numpy, all else is refused and never run."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.core.errors import ConfigurationError
from pipeline.physics.formula import FUNCTIONS, SIGNALS, Formula, parse

if TYPE_CHECKING:
    from pathlib import Path

X = np.linspace(-2.0, 3.0, 11)
MALICIOUS = [
    "__import__('os').system('touch owned')",
    "__import__",
    "().__class__",
    "u.__class__.__mro__",
    "u.tofile",
    "sin.__globals__",
    "exec(u)",
    "eval(fx)",
    "open(fx)",
    "getattr(u, fx)",
    "(lambda: u)()",
    "[u for u in fx]",
    "{u: fx}",
    "u[0]",
    "'a' * 9",
    "b'a'",
    'f"{u}"',
    "9**9**9",
    "u**9999999",
    "u**temperature",
    "(" * 200 + "u" + ")" * 200,
    "sin(" * 100 + "u" + ")" * 100,
    "-" * 300 + "u",
    "u" + " + u" * 120,
    "1" * 5000,
    "u * 1" + "0" * 400,
    "sin(x=u)",
    "sin(*u)",
    "sin(u, u)",
    "u := 1",
    "u; u",
    "u if u else fx",
    "u and fx",
    "not u",
    "~u",
    "u < 1",
    "u @ u",
    "u // 2",
    "u % 2",
    "u ^ 2",
    "1j * u",
    "True",
    "None",
    "...",
    "await u",
    "(yield u)",
    "u, u",
    "u\x00",
    "\uff55",
    "\u2160 + u",
    "# u",
    "import os",
    "1or 2",
    "u +",
    "",
    "sin",
    "print",
    "self",
    "np.sin(u)",
]


@pytest.mark.parametrize("text", MALICIOUS)
def test_what_is_no_formula_is_refused_with_its_place(
    text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigurationError, match="formula") as caught:
        parse(text)
    assert len(str(caught.value)) < 700
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("cos(5 * radian(angle))", r"position 9: no function is called 'radian'; functions: sin, .*; signals: u, fx"),
        ("2 * temprature", r"position 5: no signal is called 'temprature'; signals: u, .*; functions: sin"),
        ("fx^2", r"position 3: '\^' is not allowed in a formula; write \*\* for a power"),
        ("maximum(fx)", r"position 1: maximum takes 2 values in brackets"),
        ("fx ** fy", r"position 7: an exponent is a number from -20 to 20"),
    ],
)
def test_a_message_tells_position_and_what_is_known(text: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        parse(text)


@settings(max_examples=300, deadline=None)
@given(st.text(alphabet="ufxsincoabe_().,*+-/ 0159'\"[]{}:=<>\n", max_size=40))
def test_any_text_is_either_a_formula_or_refused(text: str) -> None:
    try:
        found = parse(text)
    except ConfigurationError:
        return
    assert found.signals <= set(SIGNALS)
    signals = dict.fromkeys(found.signals, X)
    assert np.broadcast_to(found(signals), X.shape).dtype == np.float64


EXPECTED = {
    "3 + 2 * u - u / 4": [3 + 2 * x - x / 4 for x in X],
    "-u ** 2": [-(x**2) for x in X],
    "(-u) ** 3": [-(x**3) for x in X],
    "(u ** 2 + 1) ** -0.5": [1 / math.sqrt(x * x + 1) for x in X],
    "+pi * 1e-3 * u": [math.pi * 1e-3 * x for x in X],
    "sin(u) + cos(u) * tan(u)": [math.sin(x) + math.cos(x) * math.tan(x) for x in X],
    "tanh(u) + exp(u)": [math.tanh(x) + math.exp(x) for x in X],
    "log(abs(u) + 1) * sqrt(abs(u))": [math.log(abs(x) + 1) * math.sqrt(abs(x)) for x in X],
    "sign(u) * radians(u)": [math.copysign(1, x) * math.radians(x) if x else 0.0 for x in X],
    "minimum(u, 1) + maximum(u, -1)": [min(x, 1) + max(x, -1) for x in X],
    "step(u)": [0.0 if x < 0 else 1.0 for x in X],
    "band(u, -1, 2)": [1.0 if -1 <= x <= 2 else 0.0 for x in X],
    "7": [7.0] * len(X),
}


@pytest.mark.parametrize("text", EXPECTED)
def test_a_formula_is_what_mathematics_says(text: str) -> None:
    found = np.broadcast_to(parse(text)({"u": X}), X.shape)
    np.testing.assert_allclose(found, EXPECTED[text], rtol=1e-14, atol=1e-15)


def test_every_function_is_tried_above() -> None:
    assert [name for name in FUNCTIONS if not any(f"{name}(" in text for text in EXPECTED)] == []


def test_a_formula_knows_its_signals() -> None:
    found = parse(" fx * fy\n  + temperature ")
    assert isinstance(found, Formula)
    assert found.signals == {"fx", "fy", "temperature"}
    assert found.text == "fx * fy + temperature"


def test_what_is_missing_stays_missing_and_nothing_warns() -> None:
    values = np.array([np.nan, -1.0, 0.0])
    for text in ("step(u)", "band(u, 0, 1)", "log(u)", "1 / u"):
        assert np.isnan(parse(text)({"u": values})[0])
    assert not np.isfinite(parse("log(u)")({"u": values})[1:]).any()
