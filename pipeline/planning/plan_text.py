"""A plan as text: aligned tables."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.records import SENSORS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.planning.changes import Gain

CLEARLY_LARGER = 1.2  # times the smallest size, from which on the size at which an effect is named is printed
CLEARLY_SMALLER = 99.5  # per cent
TOP = 3  # changes that are printed


def plan_text(document: Mapping[str, Any]) -> list[str]:
    """Return a plan (``plan.plan_of``) as lines."""
    lines = [_heading(document), *(f"note: {text}" for text in document["warnings"])]
    for sensor in SENSORS:
        lines += ["", *_of_sensor(sensor, document[sensor])]
    return lines


def _heading(document: Mapping[str, Any]) -> str:
    """Return what is planned, as a line."""
    what = f"{document['sensor']} on {document['table']}, {document['procedure']}"
    where = " at the table" if document["at_a_table"] else ""
    return f"{what}: {document['minutes']:.1f} min{where}, {document['samples']} samples"


def _of_sensor(sensor: str, part: Mapping[str, Any]) -> list[str]:
    if part["reason"]:
        return [f"{sensor}: nothing can be planned: {part['reason']}"]
    noise, unit = part["noise"], part["unit"]
    lines = [f"{sensor} (noise {noise['white']:.2g} {unit} a sample, bias wander {noise['wander']:.2g} {unit})"]
    head = ["effect", "smallest size", "of limit", "similar signal", "note"]
    if part["effects"]:
        lines += _aligned([head, *(_row(entry) for entry in part["effects"])])
    if part["not_observable"]:
        lines.append("  not observable:")
        lines += _aligned([[e["effect"], e["reason"]] for e in part["not_observable"]])
    return lines


def _row(entry: Mapping[str, Any]) -> list[str]:
    alike = ", ".join(f"{a['effect']} {a['share']:.2f}" for a in entry["look_alikes"][:2])
    return [
        entry["effect"],
        size_text(entry["smallest"], entry["unit"]),
        share_text(entry["share_of_limit"]),
        alike,
        _note(entry),
    ]


def _note(entry: Mapping[str, Any]) -> str:
    """Return up to which size another effect would be named in place of this one."""
    named, smallest, taken = entry["named"], entry["smallest"], entry["taken_for"]
    limit = None if entry["share_of_limit"] is None else smallest / entry["share_of_limit"]
    never = named is None or (limit is not None and named > limit)
    if taken:
        return f"named as {taken}" + ("" if never else f" below {size_text(named, entry['unit'])}")
    if never:
        return "not distinguishable from those"
    return f"named from {size_text(named, entry['unit'])}" if named > CLEARLY_LARGER * smallest else ""


def size_text(value: float, unit: str) -> str:
    """Return a size with its unit."""
    return f"{value:.2g}" + ("" if unit == "1" else f" {unit}")


def share_text(value: float | None) -> str:
    """Return a share of a limit in per cent."""
    if value is None:
        return "no limit"
    return f"{100.0 * value:.2g} %" if value >= 1e-3 else "< 0.1 %"


def side_by_side(first: Mapping[str, Any], second: Mapping[str, Any]) -> list[str]:
    """Return two plans as lines, side by side."""
    lines = [f"A: {_heading(first)}", f"B: {_heading(second)}"]
    a, b = first["course"], second["course"]
    lines += [f"   {name}: {a[name]} in A, {b[name]} in B" for name in a if a[name] != b[name]]
    for name, document in (("A", first), ("B", second)):
        lines += [f"note on {name}: {text}" for text in document["warnings"]]
    for sensor in SENSORS:
        lines += ["", sensor, *_compared(first[sensor], second[sensor])]
    return lines


def _compared(first: Mapping[str, Any], second: Mapping[str, Any]) -> list[str]:
    reasons = [f"  {n}: nothing can be planned: {p['reason']}" for n, p in (("A", first), ("B", second)) if p["reason"]]
    a, b = ({entry["effect"]: entry for entry in part["effects"]} for part in (first, second))
    rows = [["effect", "smallest in A", "of limit", "smallest in B", "of limit", "B / A"]]
    hidden = {e["effect"] for part in (first, second) for e in part["not_observable"]}
    for name in sorted(a.keys() | b.keys() | hidden):
        cells = [name]
        for found in (a.get(name), b.get(name)):
            cells += (
                [size_text(found["smallest"], found["unit"]), share_text(found["share_of_limit"])]
                if found
                else ["-", ""]
            )
        both = name in a and name in b
        rows.append([*cells, f"{b[name]['smallest'] / a[name]['smallest']:.2f}" if both else ""])
    return [*reasons, *(_aligned(rows) if len(rows) > 1 else [])]


def helps_most(gains: Sequence[Gain]) -> list[str]:
    """Return the changes that help most as lines, in the given order."""
    useful = [gain for gain in gains if gain.shown or gain.distinguished or 100.0 * gain.factor < CLEARLY_SMALLER]
    if not useful:
        return ["additional recordings: none of those examined shows more"] if gains else []
    lines = ["additional recordings, the most helpful first:"]
    for number, gain in enumerate(useful[:TOP], start=1):
        options = f" ({gain.change.options})" if gain.change.options else ""
        lines.append(f"  {number}. {gain.change.what}{options}: {gain.minutes:+.1f} min")
        lines.append(f"     {_brought(gain)}")
    return lines


def _brought(gain: Gain) -> str:
    """Return the effect of a change on what can be found; the factor is a mean over effects and sensors."""
    parts = [f"shows {_listed(gain.shown)}"] if gain.shown else []
    parts += [f"distinguishes {_listed(gain.distinguished)} from similar effects"] if gain.distinguished else []
    percent = 100.0 * gain.factor
    whose = "the others" if parts else "effects"
    smaller = percent < CLEARLY_SMALLER
    parts.append(f"finds {whose} " + (f"at {percent:.0f} % of the size" if smaller else "at the same size"))
    return "; ".join(parts)


def _listed(keys: Sequence[str]) -> str:
    by_sensor = {s: [k.partition(".")[2] for k in keys if k.startswith(f"{s}.")] for s in SENSORS}
    return " and ".join(f"{', '.join(names)} of the {sensor}" for sensor, names in by_sensor.items() if names)


def _aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return rows as lines whose columns begin at the same place."""
    widths = [max(len(cell) for cell in column) for column in zip(*rows, strict=True)]
    return [
        "  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    ]
