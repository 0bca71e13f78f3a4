"""The parameters of a calibration: their order and their selection by name."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import numpy as np
import pytest

import pipeline
from pipeline.core.records import (
    AFTER_BASE,
    BASE,
    BASE_NAMES,
    BIAS,
    MATRIX,
    MATRIX_ROWS,
    Coefficient,
    FittedEffect,
    SensorCalibration,
    base_values,
    matrix_of,
)

EFFECTS = (
    FittedEffect("bias_temperature", {f"c_{a}": Coefficient(float(k), "g/degC") for k, a in enumerate("xyz")}),
    FittedEffect("lever_arm", {f"r_{a}": Coefficient(10.0 + k, "m") for k, a in enumerate("xyz")}),
)


def test_blocks_hold_the_parameters_of_their_names() -> None:
    names = np.array([*BASE_NAMES, "warm_up.T"])
    assert names[BIAS].tolist() == ["bias_x", "bias_y", "bias_z"]
    assert [name.removeprefix("matrix_") for name in names[MATRIX]] == [
        "xx",
        "xy",
        "xz",
        "yx",
        "yy",
        "yz",
        "zx",
        "zy",
        "zz",
    ]
    assert [{name[-2] for name in names[row]} for row in MATRIX_ROWS] == [{"x"}, {"y"}, {"z"}]
    assert [*names[BASE], *names[AFTER_BASE]] == names.tolist()
    matrix = np.arange(9.0).reshape(3, 3)
    assert (matrix_of(base_values(np.zeros(3), matrix)) == matrix).all()


def test_parameters_are_selected_by_name_and_by_effect() -> None:
    root = np.random.default_rng(0).standard_normal((18, 18))
    covariance, freedom = root @ root.T, np.arange(1.0, 19.0)
    fit = SensorCalibration("accelerometer", effects=EFFECTS, covariance=covariance, freedom=freedom)
    parameters = fit.parameters
    assert parameters.units[:4] == ("g", "g", "g", "1")
    chosen = parameters.select(parameters.places(["lever_arm.r_y", "bias_z"]))
    assert (chosen.names, chosen.units, chosen.values.tolist()) == (
        ("lever_arm.r_y", "bias_z"),
        ("m", "g"),
        [11.0, 0.0],
    )
    assert (chosen.covariance == covariance[[[16], [2]], [16, 2]]).all()
    assert chosen.degrees_of_freedom.tolist() == [17.0, 3.0]
    lever = parameters.select(parameters.of_effect("lever_arm"))
    assert lever.names == ("lever_arm.r_x", "lever_arm.r_y", "lever_arm.r_z")
    assert lever.standard_uncertainty == pytest.approx(np.sqrt(np.diag(covariance)[15:]))
    assert len(parameters.select(parameters.of_effect("warm_up"))) == 0
    with pytest.raises(ValueError, match="no parameter warm_up"):
        parameters.places(["warm_up.T"])


def test_an_unknown_covariance_is_zero_and_all_parameters_have_the_common_degrees_of_freedom() -> None:
    parameters = SensorCalibration("gyroscope", degrees_of_freedom=4.0).parameters
    assert parameters.units[:4] == ("deg/s", "deg/s", "deg/s", "1")
    assert parameters.coverage_factor == pytest.approx(2.776, abs=5e-4)  # GUM, table G.2
    assert not parameters.expanded_uncertainty.any()


def test_no_module_selects_base_parameters_by_number() -> None:
    """A slice that starts or ends at 12, of values that no call returns, would be of bias and matrix."""

    def by_number(node: ast.AST) -> bool:
        if isinstance(node, ast.Subscript) and not isinstance(node.value, ast.Call):
            bounds = [b for s in ast.walk(node.slice) if isinstance(s, ast.Slice) for b in (s.lower, s.upper)]
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "slice":
            bounds = list(node.args)
        else:
            return False
        return any(isinstance(bound, ast.Constant) and bound.value == len(BASE_NAMES) for bound in bounds)

    number = re.compile(rf"\b{len(BASE_NAMES)}\b")
    found = []
    for file in Path(pipeline.__file__).parent.rglob("*.py"):
        text = file.read_text("utf-8")
        if number.search(text):
            found += [(file.name, ast.unparse(node)) for node in ast.walk(ast.parse(text)) if by_number(node)]
    assert found == []
    assert by_number(ast.parse("covariance[3:12, 3:12]", mode="eval").body)
