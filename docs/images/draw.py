"""Draw the images of docs/record.md and docs/mounting.md from the geometry that the product uses.

    python docs/images/draw.py         (writes the SVG files beside this script; a test compares them)

A level vector v is drawn at (a . v, b . v), a and b level unit vectors across the line of sight; ``level @ v`` is the
level vector of a body vector v.
"""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.app.guide import in_words
from pipeline.physics.kinematics import LEVEL_AT_ZERO
from pipeline.physics.signal.rests import SETTLING_S
from pipeline.simulation.description import Course, plan
from pipeline.simulation.trajectory import rotation_about

INK, GREY, TURN, FILL = "#1f2937", "#6b7280", "#b45309", ("#e5e7eb", "#f3f4f6", "#d1d5db")
FONT = 'font-family="sans-serif"'
AZIMUTH_DEG, ELEVATION_DEG = -55.0, 24.0  # from where the unit is seen
HALF = np.array([0.62, 0.42, 0.2])  # edges of the case
VERTICAL = np.array([0.0, 0.0, 1.0])
Array = np.ndarray


def rotation(axis: int, angle: float) -> Array:
    """Return the rotation about a coordinate axis."""
    return rotation_about(np.eye(3)[axis], np.array([angle]))[0]


TOWARDS = np.array([
    np.cos(np.radians(AZIMUTH_DEG)) * np.cos(np.radians(ELEVATION_DEG)),
    np.sin(np.radians(AZIMUTH_DEG)) * np.cos(np.radians(ELEVATION_DEG)),
    np.sin(np.radians(ELEVATION_DEG)),
])  # fmt: skip
RIGHT = np.array([-np.sin(np.radians(AZIMUTH_DEG)), np.cos(np.radians(AZIMUTH_DEG)), 0.0])
UP = np.cross(TOWARDS, RIGHT)


class Picture:
    """SVG elements, with a title and a text for those who do not see it."""

    def __init__(self, width: int, height: int, label: str) -> None:
        self.width, self.height, self.label = width, height, label
        self.parts: list[str] = []

    def line(self, points: Any, colour: str = INK, width: float = 1.5, **more: str) -> None:  # noqa: ANN401
        """Draw a line through points."""
        at = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
        extra = "".join(f' {k.replace("_", "-")}="{v}"' for k, v in {"fill": "none", **more}.items())
        self.parts.append(f'<polyline points="{at}" stroke="{colour}" stroke-width="{width}"{extra}/>')

    def text(self, x: float, y: float, text: str, size: int = 14, colour: str = INK, **more: str) -> None:
        """Write a text, in the middle unless stated."""
        extra = "".join(f' {k.replace("_", "-")}="{v}"' for k, v in {"text_anchor": "middle", **more}.items())
        self.parts.append(f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size}" fill="{colour}"{extra}>{text}</text>')

    def svg(self) -> str:
        """Return the file."""
        size = f'viewBox="0 0 {self.width} {self.height}"'
        marker = "".join(
            f'<marker id="{name}" viewBox="0 0 8 8" refX="6" refY="4" markerWidth="6" markerHeight="6" orient="auto">'
            f'<path d="M0 0L8 4L0 8z" fill="{colour}"/></marker>'
            for name, colour in (("k", INK), ("r", TURN))
        )
        head = f'<svg xmlns="http://www.w3.org/2000/svg" {size} {FONT} role="img" aria-label="{self.label}">'
        ground = f'<rect width="{self.width}" height="{self.height}" fill="#fff"/><defs>{marker}</defs>'
        return "\n".join([head, ground, *self.parts, "</svg>"]) + "\n"


def place(v: Any, centre: tuple[float, float], scale: float) -> Array:  # noqa: ANN401
    """Return where level vectors are drawn: (n, 2) array."""
    v = np.atleast_2d(v)
    return np.column_stack([centre[0] + scale * (v @ RIGHT), centre[1] - scale * (v @ UP)])


def unit(picture: Picture, level: Array, centre: tuple[float, float], scale: float) -> None:
    """Draw the case and its body axes; an arrow that points away from the eye is drawn behind the case."""
    axes = [(level[:, i], f"+{name}", HALF[i]) for i, name in enumerate("xyz")]
    for front in (False, True):
        for direction, _, half in axes:
            if (direction @ TOWARDS > -1e-9) == front:
                tip = place(np.array([direction * half, direction * (half + 0.65)]), centre, scale)
                picture.line(tip, INK, 2.4, marker_end="url(#k)")
        for axis, sign in product(range(3), (1, -1)) if not front else ():
            normal = sign * level[:, axis]
            if normal @ TOWARDS > 0:
                a, b = (level[:, i] * HALF[i] for i in range(3) if i != axis)
                corners = normal * HALF[axis] + np.array([a + b, a - b, -a - b, -a + b, a + b])
                picture.line(place(corners, centre, scale), GREY, 1.3, fill=FILL[int(np.argmax(np.abs(normal)))])
    for direction, name, half in axes:
        x, y = place(direction * (half + 0.88), centre, scale)[0]
        picture.text(x, y + 5, name, 15, stroke="#fff", stroke_width="5", paint_order="stroke")


def turn_axis(
    picture: Picture, along: Array, ends: tuple[float, float], centre: tuple[float, float], scale: float
) -> None:
    """Draw a dashed line along a level direction, between two distances from the centre."""
    picture.line(place(np.outer(ends, along), centre, scale), TURN, 1.5, stroke_dasharray="6 4")


def turn_arrow(picture: Picture, axis: Array, at: float, centre: tuple[float, float], scale: float) -> None:
    """Draw a right-handed arrow about a level direction, at a distance from the centre."""
    first = np.cross(axis, [0.3, 0.2, 1.0])
    first /= np.linalg.norm(first)
    angle = np.radians(np.linspace(-150.0, 130.0, 40))
    ring = 0.3 * (np.outer(np.cos(angle), first) + np.outer(np.sin(angle), np.cross(axis, first)))
    picture.line(place(axis * at + ring, centre, scale), TURN, 2, marker_end="url(#r)")


def axis_of(up: Array) -> str:
    """Return the body axis that points up."""
    i = int(np.argmax(np.abs(up)))
    return f"{'+' if up[i] > 0 else '-'}{'xyz'[i]}"


def turned(axis: int, angle: float) -> Array:
    """Return the attitude of a turn about a body axis by the convention."""
    return np.asarray(LEVEL_AT_ZERO[axis] @ rotation(axis, angle))


def face(axis: int, sign: float) -> Array:
    """Return the attitude with a face up, the next axis level to the right of x."""
    upward, side = sign * np.eye(3)[axis], np.eye(3)[(axis + 1) % 3]
    return np.array([side, np.cross(upward, side), upward])


def mounting(picture: Picture, *, one_axis: bool) -> None:
    """Draw the three turns at angle 0; with ``one_axis`` the turn axis is the same, and the unit is mounted anew."""
    for axis, name in enumerate("xyz"):
        centre, level = (150.0 + 300.0 * axis, 185.0), turned(axis, 0.0)
        if one_axis:
            along = level[:, axis]
            heading = np.degrees(np.arctan2(along[1], along[0]))
            level = rotation(2, -heading) @ level
        along = level[:, axis]
        turn_axis(picture, along, (-1.6, 1.9), centre, 80.0)
        unit(picture, level, centre, 80.0)
        turn_arrow(picture, along, 1.9, centre, 80.0)
        what = f"accel_{name}, gyro_{name}" if one_axis else f"turn about {name}"
        picture.text(centre[0], 30, f"{what}, angle 0", 17, font_weight="bold")
        up = [axis_of(turned(axis, angle)[2]) for angle in (0.0, 90.0)]
        picture.text(centre[0], 318, f"up: {up[0]}; at +90 deg: {up[1]}", 14, "#374151")


def benches(picture: Picture) -> None:
    """Draw the kinds of benches: their turn axes, and the setting of each."""
    level = turned(0, 0.0)
    for k, (title, axes, settings) in enumerate((
        ("three turn axes", np.eye(3), ("table=acutronic, or your own", "mounted once for all turns")),
        ("one level turn axis", level[:, :1].T, ("table=single_axis", "mounted anew for each turn")),
        ("a vertical turn axis", VERTICAL[None], ("procedure.recordings.gyro_z.up=+z", "gyroscope alone")),
        ("no table", np.zeros((0, 3)), ("table=hand", "rests, moves and turns by hand")),
    )):  # fmt: skip
        centre = (130.0 + 260.0 * k, 175.0)
        for along in axes:
            turn_axis(picture, along, (-1.4, 1.7), centre, 75.0)
        tilted = level if len(axes) else level @ rotation(1, 35.0) @ rotation(0, -20.0)
        unit(picture, tilted, centre, 75.0)
        for along in axes:
            turn_arrow(picture, along, 1.7, centre, 75.0)
        picture.text(centre[0], 30, title, 17, font_weight="bold")
        for row, words in enumerate(settings):
            picture.text(centre[0], 318 + 20 * row, words, 14, "#374151")


def attitudes(picture: Picture) -> None:
    """Draw attitudes by hand, with the words of the command guide."""
    for k, wanted in enumerate(np.array([[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, -1, 0]], float)):
        centre, up = (140.0 + 250.0 * k, 180.0), wanted / np.linalg.norm(wanted)
        first = next(i for i in (2, 1, 0) if abs(up[i]) > np.max(np.abs(up)) - 1e-6)
        level = face(first, np.sign(up[first]))
        about = np.cross(level[2], up)
        size = float(np.linalg.norm(about))
        if size > 0.0:
            level = level @ rotation_about(about / size, np.degrees([np.arctan2(size, level[2] @ up)]))[0].T
        turn_axis(picture, VERTICAL, (-1.25, 1.45), centre, 75.0)
        unit(picture, level, centre, 75.0)
        for row, words in enumerate(in_words(up).replace(", ", ",|").replace(" raised", "|raised").split("|")):
            picture.text(centre[0], 306 + 19 * row, words, 13, "#374151")
        kind = ("a face up", "an edge up", "a corner up", "a face up")[k]
        picture.text(centre[0], 30, kind, 17, font_weight="bold")


def ferraris(picture: Picture) -> None:
    """Draw the six faces, and a turn about the vertical."""
    for k, (axis, sign) in enumerate(product(range(3), (1, -1))):
        centre = (85.0 + 144.0 * k, 120.0)
        unit(picture, face(axis, sign), centre, 52.0)
        picture.text(centre[0], 232, f"{axis_of(face(axis, sign)[2])} up", 14, "#374151")
    for axis in range(3):
        centre = (150.0 + 300.0 * axis, 425.0)
        turn_axis(picture, VERTICAL, (-1.2, 2.1), centre, 60.0)
        unit(picture, face(axis, 1.0), centre, 60.0)
        turn_arrow(picture, VERTICAL, 1.95, centre, 60.0)
        words = f"turn about {'xyz'[axis]}: 360 deg and back, {axis_of(face(axis, 1.0)[2])} up"
        picture.text(centre[0], 528, words, 14, "#374151")
    picture.text(450, 26, "rests on the six faces", 17, font_weight="bold")
    picture.text(450, 276, "turns about the vertical, from rest to rest", 17, font_weight="bold")


def panel(picture: Picture, box: tuple[float, float, float, float], title: str, axes: tuple[Array, Array]) -> None:
    """Draw a curve over time with the ends of its axes."""
    x, y, width, height = box
    time, value = axes
    low, high = min(0.0, float(value.min())), max(float(value.max()), 1e-9)
    span = max(high - low, 1e-9)
    at = np.column_stack([
        x + width * (time - time[0]) / (time[-1] - time[0]), y + height * (high - value) / span
    ])  # fmt: skip
    picture.line([(x, y), (x, y + height), (x + width, y + height)], GREY, 1)
    picture.line(at, INK, 1.6)
    picture.text(x + width / 2, y - 12, title, 14, font_weight="bold")
    picture.text(x + width, y + height + 16, f"{time[-1]:.0f} s", 12, GREY, text_anchor="end")
    picture.text(x, y + height + 16, f"{time[0]:.0f}", 12, GREY)
    picture.text(x - 6, y + 10, f"{high:.0f}", 12, GREY, text_anchor="end")
    picture.text(x - 6, y + height, f"{low:.0f}", 12, GREY, text_anchor="end")


def session(picture: Picture) -> None:
    """Draw the table's angle in the recordings of three_axis_turns, and the whole session."""
    course = Course()
    planned = {p.name: p.trajectory for p in plan("three_axis_turns", course, np.random.default_rng(0))}

    def angle(name: str, stop: float | None = None) -> tuple[Array, Array]:
        time = np.linspace(0.0, stop or planned[name].duration, 1200)
        pose = planned[name].pose(time)
        return time, pose.angle if pose.angle is not None else np.linalg.norm(pose.omega, axis=1)

    panel(picture, (60, 60, 240, 130), "accel_x: table angle, deg", angle("accel_x"))
    panel(picture, (370, 60, 240, 130), "its first 8 s: step and dwell", angle("accel_x", 8.0))
    panel(picture, (680, 60, 240, 130), "gyro_x: table angle, deg", angle("gyro_x"))
    panel(picture, (60, 260, 240, 130), "validation: |rate|, deg/s", angle("validation"))
    notes = [
        f"step {course.step_deg:g} deg, dwell {course.dwell_s:g} s (its first {SETTLING_S:g} s are left out)",
        f"gyroscope: rest {course.warm_up_rest_s:g} s, turn at {course.rates_dps[0]:g} deg/s, rest {course.rest_s:g} s",
        f"validation: random motion, up to {course.validation_rate_dps:g} deg/s, {course.validation_s:g} s",
        f"static: rest {course.static_s:g} s; between recordings {course.pause_s:g} s",
    ]
    for row, note in enumerate(notes):
        picture.text(370, 280 + 26 * row, note, 14, "#374151", text_anchor="start")
    total = sum(t.duration + course.pause_s for t in planned.values())
    start = course.pause_s
    title = f"the session: {total / 60:.1f} min from power-on"
    picture.text(60, 440, title, 14, text_anchor="start", font_weight="bold")
    for name, trajectory in planned.items():
        x, width = 60 + 860 * start / total, 860 * trajectory.duration / total
        box = [(x, 455), (x + width, 455), (x + width, 481), (x, 481), (x, 455)]
        picture.line(box, GREY, 1, fill=FILL[name[0] == "g"])
        picture.text(x + width / 2, 472, name, 11)
        start += trajectory.duration + course.pause_s


def drawings() -> dict[str, str]:
    """Return the files by their name."""
    found = {}
    for name, size, draw, label in (
        ("mounting", (900, 335), lambda p: mounting(p, one_axis=False),
         "A box in the three turns at angle 0: body axes, turn axis and the direction in which the angle counts"),
        ("single_axis", (900, 335), lambda p: mounting(p, one_axis=True),
         "The box on a table with one level turn axis, mounted anew for the turns about x, y and z"),
        ("benches", (1040, 350), benches, "Benches with three turn axes, one level axis, a vertical axis, no table"),
        ("attitudes", (1030, 360), attitudes, "Attitudes by hand: a face, an edge or a corner of the case points up"),
        ("faces_and_turns", (900, 540), ferraris, "Six faces up, and turns about the vertical with +x, +y and +z up"),
        ("session", (960, 500), session, "Table angle over time in the recordings of three_axis_turns"),
    ):  # fmt: skip
        picture = Picture(*size, label)
        draw(picture)
        found[f"{name}.svg"] = picture.svg()
    return found


if __name__ == "__main__":
    for file, text in drawings().items():
        (Path(__file__).parent / file).write_text(text, encoding="utf-8")
