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
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    Values = NDArray[np.float64]

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
    whites = [w for terms in axes if (w := _white(terms)) is not None]
    if whites:
        out["white"], *out["white_interval"] = _rms(whites)
        out["white_origin"] = f"measured at rest ({found['source']}), root mean square of the axes"
    walks = [_walk(terms) for terms in axes]
    seen = [w for w in walks if w is not None]
    limits = [t["random_walk"].get("upper_limit") for t, w in zip(axes, walks, strict=True) if w is None]
    lesser = [least for limit in limits if (least := min((v for v in (limit, walk) if v), default=None)) is not None]
    if seen or lesser:
        out["walk"] = _rms([w[0] for w in seen] + lesser)
    if seen and lesser:
        out["walk_origin"] = (
            f"measured at rest on {len(seen)} of {len(axes)} axes; on the others it is the lesser of the sensor's "
            "configuration and the upper limit"
        )
    elif seen:
        out |= {"walk_origin": "measured at rest", "walk_interval": _rms(seen)[1:]}
    elif lesser:
        most = f"{FACTORS[sensor] * max(v for v in limits if v):.3g} {SI[sensor]}/sqrt(s)"
        out["walk_origin"] = (
            f"not seen at rest ({found['length_s']:.3g} s), below {most}: the lesser of the sensor's configuration and "
            "this limit"
        )
    return out


def _white(terms: JSON) -> Values | None:
    """Return the white noise of an axis and the ends of its interval, (3,); None where none was seen."""
    processes = [(part, part["correlation_time_s"]["value"]) for part in terms["gauss_markov"]]
    fast = [np.sqrt(2.0 * time) * _ends(part) for part, time in processes if time < FAST_S]
    return _root_sum_square([*_seen(terms["white"]), *fast])


def _walk(terms: JSON) -> Values | None:
    """Return the walk of an axis and the ends of its interval, (3,); None where no slow term was seen."""
    processes = [(part, part["correlation_time_s"]["value"]) for part in terms["gauss_markov"]]
    slow = [np.sqrt(2.0 / time) * _ends(part) for part, time in processes if time >= FAST_S]
    white = _white(terms)
    flicker = [] if white is None else [np.sqrt(3.0) * FLAT / white[0] * b**2 for b in _seen(terms["bias_instability"])]
    return _root_sum_square([*_seen(terms["random_walk"]), *slow, *flicker])


def _ends(term: JSON) -> Values:
    """Return a term and the ends of its interval: (3,)."""
    return np.array([term["value"], *term["interval"]], float)


def _seen(term: JSON) -> list[Values]:
    return [] if term["value"] is None else [_ends(term)]


def _root_sum_square(parts: list[Values]) -> Values | None:
    return np.sqrt(np.sum(np.square(parts), axis=0)) if parts else None


def _rms(values: Sequence[Any]) -> Any:  # noqa: ANN401  (numbers, or lists of them)
    return np.sqrt(np.mean(np.square(values), axis=0)).tolist()
