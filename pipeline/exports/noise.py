"""White noise and random walk for estimators that know these two alone, from the terms that were identified.

    n^2 = N^2 + sum 2 G^2 T  (T < ``FAST_S``)
    k^2 = K^2 + sum 2 G^2 / T  (other processes) + 3 (2 ln 2 / pi)^2 B^4 / n^2

A fast Gauss-Markov process is white over the times that estimators average over; a slow one starts as the walk of the
same increments. The walk for a bias instability B has its Allan variance where that of white noise has it. n is
continuous: the standard deviation of a sample is n sqrt(rate). An axis without any slow term has the walk that stands
for the bias wander of the sensor's configuration, s sqrt(2 / T), or its own upper limit where that is less. The figure
of a sensor is the root mean square of its axes. Where nothing was identified, the configuration gives both,
``n = noise_density / sqrt(2)``, as that is one-sided. Quantisation, ramps and sinusoids are in neither.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.io.units import STANDARD_GRAVITY
from pipeline.model.calibration_file import FAST_S
from pipeline.records import SENSORS

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

JSON = dict[str, Any]
FACTORS = {"accelerometer": STANDARD_GRAVITY, "gyroscope": np.pi / 180.0}  # to m/s^2 and rad/s
SI = {"accelerometer": "m/s^2", "gyroscope": "rad/s"}
AVERAGING_S = 1.0  # of the effective density in remarks; the diagnosis has others
FLAT = 2.0 * np.log(2.0) / np.pi  # Allan variance of a bias instability of 1


def noise(settings: Mapping[str, Any], document: Mapping[str, Any]) -> dict[str, float | None]:
    """Return Kalibr's four noise parameters in m/s^2 and rad/s; None where neither recording nor configuration tell."""
    found: dict[str, float | None] = {}
    for sensor in SENSORS:
        figures = _figures(sensor, settings, document)
        for name, key in (("noise_density", "white"), ("random_walk", "walk")):
            value = figures[key]
            found[f"{sensor}_{name}"] = None if value is None else float(value * FACTORS[sensor])
    return found


def noise_remarks(settings: Mapping[str, Any], document: Mapping[str, Any], diagnosis: JSON | None) -> list[str]:
    """Return where the noise parameters come from, their intervals, and the effective densities."""
    lines = []
    for sensor in SENSORS:
        figures, factor, si = _figures(sensor, settings, document), FACTORS[sensor], SI[sensor]
        for key, unit in (("white", f"{si}/sqrt(Hz)"), ("walk", f"{si}/sqrt(s)")):
            if figures[key] is None:
                lines.append(f"{sensor}, {key}: not known; null has to be replaced.")
                continue
            interval = figures[f"{key}_interval"]
            within = f", 95 %: {factor * interval[0]:.3g} to {factor * interval[1]:.3g}" if interval else ""
            lines.append(f"{sensor}, {key}: {factor * figures[key]:.4g} {unit}{within}; {figures[f'{key}_origin']}.")
        found = (document.get("noise") or {}).get(sensor) or {}
        axes = (found.get("axes") or {}).values()
        doubts = dict.fromkeys([*(found.get("doubts") or []), *(d for axis in axes for d in axis.get("doubts") or [])])
        lines += [f"{sensor}, in doubt: {doubt}." for doubt in doubts]
        effective = ((diagnosis or {}).get(sensor) or {}).get("effective_noise")
        lines += [effective_text(sensor, effective)] if effective else []
    return lines


def effective_text(sensor: str, effective: Mapping[str, Any]) -> str:
    """Return a sentence on the effective density of a sensor, in m/s^2 or rad/s, over about ``AVERAGING_S``."""
    factor, si, motion = FACTORS[sensor], SI[sensor], effective["motion"]
    found = min(effective["densities"], key=lambda d: abs(np.log(d["averaging_time_s"] / AVERAGING_S)))
    shares = [f"{e['effect'].replace('_', ' ')} {factor * e['density']:.3g}" for e in found["effects"] if e["density"]]
    of_effects = f"; of effects that the diagnosis found and nothing compensates: {', '.join(shares)}" if shares else ""
    moving = [
        f"{value:.3g} {unit} rms"
        for value, unit in ((motion["rate_dps"], "deg/s"), (motion["force_change_g"], "g"))
        if value is not None
    ]
    return (
        f"{sensor}, effective density in the motion of {', '.join(effective['recordings'])} ({', '.join(moving)}), "
        f"averaged over {found['averaging_time_s']:g} s: {factor * found['density']:.3g} {si}/sqrt(Hz), "
        f"{found['over_white']:.3g} times the white noise{of_effects}."
    )


def _figures(sensor: str, settings: Mapping[str, Any], document: Mapping[str, Any]) -> JSON:
    """Return white noise and walk of a sensor in its own unit, their intervals (None: none) and origins.

    ``KeyError`` where nothing was measured and there is no configuration.
    """
    found = (document.get("noise") or {}).get(sensor) or {}
    axes = [axis["terms"] for axis in (found.get("axes") or {}).values() if axis["terms"]]
    keys = ("noise_density", "bias_wander", "wander_time_s")
    density, wander, time = (settings["sensor"][sensor].get(k) if axes else settings["sensor"][sensor][k] for k in keys)
    white = None if density is None else density / np.sqrt(2.0)
    walk = None if wander is None or not time else wander * np.sqrt(2.0 / time)
    converted = settings["sensor"][sensor].get("noise_origin")  # of another program's file
    out: JSON = {"white": white, "white_interval": None, "white_origin": converted or "of the sensor's configuration"}
    out |= {"walk": walk, "walk_interval": None}
    out["walk_origin"] = converted or "for the bias wander of the sensor's configuration"
    if not axes:
        return out
    whites = [value for terms in axes if (value := _white(terms))]
    if whites:
        out |= {"white": _rms(w[0] for w in whites), "white_interval": [_rms(w[k] for w in whites) for k in (1, 2)]}
        out["white_origin"] = f"measured at rest ({found['source']}), root mean square of the axes"
    walks = [_walk(terms) for terms in axes]
    seen = [w for w in walks if w]
    limits = [terms["random_walk"].get("upper_limit") for terms, w in zip(axes, walks, strict=True) if not w]
    lesser = [least for limit in limits if (least := min((v for v in (limit, walk) if v), default=None)) is not None]
    if seen or lesser:
        out["walk"] = _rms([*(w[0] for w in seen), *lesser])
    if seen:
        out["walk_origin"] = "measured at rest"
        if lesser:
            out["walk_origin"] += (
                f" on {len(seen)} of {len(axes)} axes; on the others it is the lesser of the sensor's "
            )
            out["walk_origin"] += "configuration and the upper limit"
        else:
            out["walk_interval"] = [_rms(w[k] for w in seen) for k in (1, 2)]
    elif lesser:
        most = f"{FACTORS[sensor] * max(v for v in limits if v):.3g} {SI[sensor]}/sqrt(s)"
        out["walk_origin"] = (
            f"not seen at rest ({found['length_s']:.3g} s), below {most}: the lesser of the sensor's configuration and "
            "this limit"
        )
    return out


def _white(terms: JSON) -> tuple[float, float, float] | None:
    """Return the white noise of an axis and its interval; None where none was seen."""
    parts = [(terms["white"], 1.0)] if terms["white"]["value"] is not None else []
    for part in terms["gauss_markov"]:
        time = part["correlation_time_s"]["value"]
        if time < FAST_S:
            parts.append((part, np.sqrt(2.0 * time)))
    return _sum(parts)


def _walk(terms: JSON) -> tuple[float, float, float] | None:
    """Return the walk of an axis and its interval; None where no slow term was seen."""
    parts = [(terms["random_walk"], 1.0)] if terms["random_walk"]["value"] is not None else []
    for part in terms["gauss_markov"]:
        time = part["correlation_time_s"]["value"]
        if time >= FAST_S:
            parts.append((part, np.sqrt(2.0 / time)))
    white, flicker = _white(terms), terms["bias_instability"]
    if flicker["value"] is not None and white:
        squares = {"value": flicker["value"] ** 2, "interval": [v**2 for v in flicker["interval"]]}
        parts.append((squares, np.sqrt(3.0) * FLAT / white[0]))
    return _sum(parts)


def _sum(parts: list[tuple[JSON, float]]) -> tuple[float, float, float] | None:
    """Return the root of the sum of squares of values and of the ends of their intervals, each times a factor."""
    if not parts:
        return None
    value = _rms([f * p["value"] for p, f in parts]) * np.sqrt(len(parts))
    low, high = (_rms([f * p["interval"][k] for p, f in parts]) * np.sqrt(len(parts)) for k in (0, 1))
    return float(value), float(low), float(high)


def _rms(values: Iterable[float]) -> float:
    return float(np.sqrt(np.mean(np.square(list(values)))))
