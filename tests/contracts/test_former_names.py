"""Import paths and commands that the documents of version 0.1 name work, with one DeprecationWarning."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib import import_module

import pytest

# Of README and docs of version 0.1, and where each stands now.
DOCUMENTED = {
    "pipeline.signal.quiet_motion": "pipeline.physics.signal.quiet_motion",
    "pipeline.signal.rests": "pipeline.physics.signal.rests",
    "pipeline.planning.guide": "pipeline.app.guide",
    "pipeline.model.kinematics": "pipeline.physics.kinematics",
    "pipeline.model.effects.base": "pipeline.physics.effects.base",
}
SAME = (
    "pipeline.simulation.trajectory", "pipeline.simulation.description", "pipeline.estimation.uncertainty_budget",
    "pipeline.estimation.engine",
)  # fmt: skip


@pytest.mark.parametrize(("former", "now"), DOCUMENTED.items())
def test_a_module_that_moved_is_found_under_its_former_name(former: str, now: str) -> None:
    package = ".".join(former.split(".")[:2])
    for name in [name for name in sys.modules if name == package or name.startswith(f"{package}.")]:
        del sys.modules[name]
    with pytest.warns(DeprecationWarning, match=f"{package} is now pipeline.") as warned:
        module = import_module(former)
    assert len(warned) == 1
    assert module is import_module(now)
    assert module.__name__ == now
    assert module.__spec__ is not None
    assert module.__spec__.name == now


@pytest.mark.parametrize("name", SAME)
def test_a_module_that_stayed_has_its_name(name: str) -> None:
    assert import_module(name).__name__ == name


def test_the_public_names_of_an_effect_in_python() -> None:
    import pipeline  # noqa: PLC0415

    base = import_module("pipeline.physics.effects.base")
    for name in ("Effect", "Layout", "Owner", "axis_parameters"):
        assert getattr(pipeline, name) is getattr(base, name)
    with pytest.raises(AttributeError, match="nothing_of_this_name"):
        _ = pipeline.nothing_of_this_name


def test_a_command_under_its_former_name_runs() -> None:
    command = [sys.executable, "-W", "default", "-m", "pipeline.field_logs.ros2_node", "--help"]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ, check=False)
    assert "pipeline.field_logs is now pipeline.app.field_logs" in done.stderr
    assert "rclpy" in done.stderr  # the node asks for ROS, which is not here
