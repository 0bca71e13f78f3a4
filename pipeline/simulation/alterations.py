"""Effects of place, mounting, table and timing, made with exact geometry instead of the effect's own (linear) columns.

Each function takes the scene of one recording and the values of the effect's parameters, in the units and the order of
``pipeline.model.effects.<name>``, and returns the scene with that effect in it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.simulation.trajectory import Turn, rotation_about

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from pipeline.simulation.scene import Scene


def lever_arm(scene: Scene, values: NDArray[np.float64]) -> Scene:
    """Put the sensor at a position in m from the turn axes."""
    return replace(scene, lever_arm=scene.lever_arm + values)


def time_offset(scene: Scene, values: NDArray[np.float64]) -> Scene:
    """Let the reading at t show the motion at t + tau; tau in s."""
    return replace(scene, offset=scene.offset + values[0])


def clock_rate(scene: Scene, values: NDArray[np.float64]) -> Scene:
    """Let the sensor's clock run fast against the table's; ppm."""
    return replace(scene, clock=scene.clock + 1e-6 * values[0])


def low_pass_lag(scene: Scene, values: NDArray[np.float64]) -> Scene:
    """Filter what the sensor feels by a first-order low pass; time constant in s."""
    return replace(scene, lag=scene.lag + values[0])


def earth_rotation(scene: Scene, values: NDArray[np.float64]) -> Scene:
    """Add Earth's rotation in the level frame; deg/s."""
    before = np.zeros(3) if scene.earth is None else scene.earth
    return replace(scene, earth=before + np.pad(values, (0, 3 - len(values))))


def table_tilt(scene: Scene, values: NDArray[np.float64]) -> Scene:
    """Tilt the table about its level x and y; deg."""
    angle = float(np.linalg.norm(values))
    if angle == 0.0:
        return scene
    axis = np.array([values[0], values[1], 0.0]) / angle
    return replace(scene, up=scene.up @ rotation_about(axis, np.array([angle]))[0])


def table_axis_nonorthogonality(scene: Scene, values: NDArray[np.float64]) -> Scene:
    """Turn each axis' direction by two angles across it; deg."""
    return _with_errors(scene, "direction", np.radians(values.reshape(3, 2)))


def table_encoder_error(scene: Scene, values: NDArray[np.float64]) -> Scene:
    """Let the true angle differ from the logged one by ``A cos + B sin`` of it; deg, two values an axis."""
    return _with_errors(scene, "encoder", values.reshape(3, 2))


def table_rate_ripple(scene: Scene, values: NDArray[np.float64]) -> Scene:
    """Let the true rate differ by ``A cos + B sin`` of the angle, relative; two values an axis."""
    return _with_errors(scene, "ripple", values.reshape(3, 2))


def table_backlash(scene: Scene, values: NDArray[np.float64]) -> Scene:
    """Let the table lag behind its log in the direction of the last move; deg, one value an axis."""
    return _with_errors(scene, "backlash", values)


def _with_errors(scene: Scene, name: str, values: NDArray[np.float64]) -> Scene:
    if scene.axis is None or not isinstance(scene.trajectory, Turn):
        return scene
    turn = scene.trajectory
    errors = replace(turn.errors, **{name: getattr(turn.errors, name) + values[scene.axis]})
    return replace(scene, trajectory=replace(turn, errors=errors))


ALTERATIONS: dict[str, Callable[[Scene, NDArray[np.float64]], Scene]] = {
    function.__name__: function
    for function in (
        lever_arm,
        time_offset,
        clock_rate,
        low_pass_lag,
        earth_rotation,
        table_tilt,
        table_axis_nonorthogonality,
        table_encoder_error,
        table_rate_ripple,
        table_backlash,
    )
}


def alter(scene: Scene, effects: dict[str, NDArray[np.float64]]) -> Scene:
    """Return the scene with those of the effects in it that are not the sensor's own."""
    for name, values in effects.items():
        if name in ALTERATIONS:
            scene = ALTERATIONS[name](scene, values)
    return scene
