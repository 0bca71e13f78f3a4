"""Residuals of the fit, reading minus model, and their dependence on covariates.

    e[n] = reading[n] - predicted[n],    predicted = bias + matrix^-1 truth + effects

The prediction passes the filter of the readings, so that the lag of the filter causes no residual.

Covariates: e is averaged in bins of angle, rate, force, temperature and time, with the standard error by white noise.
The mean of ``(mean / standard error)^2`` is about 1 where e does not depend on the covariate; the charts are in the
order of this mean.

Harmonics of the turn: ``e = sum_k a_k cos kA + b_k sin kA`` over the angle A of the rate table, with the amplitude
``sqrt(a_k^2 + b_k^2)``. Causes of 1 cycle a turn are misalignment, tilt and encoder; of 2 and 4 cycles quadratic
nonlinearity and scale factor asymmetry; of 3 cycles cubic nonlinearity; of more cycles gears and steps of the table.

The evidence of a diagnosis as charts and rows: ranking of effects, added-variable plots, unexplained residuals.

Ranking: bars of delta BIC. Brackets join effects with nearly equal signals: the data identify the group, but not the
effect within it. Added-variable plot: readings against the column of one coefficient, both minus their regression on
all other columns; the slope through the origin is the coefficient. If the points are off the line, the effect has
another shape. All points are the binned data of the diagnosis: nothing is fitted here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pipeline.core.errors import shortened
from pipeline.core.files import JSON
from pipeline.core.records import (
    AXES,
    MEDIAN_SIZE,
    SENSOR_UNITS,
    Integers,
    Mask,
    Motion,
    Recording,
    SensorCalibration,
    Values,
    finite_rows,
)
from pipeline.core.settings import DataSheet, Table
from pipeline.core.verdicts import Verdict
from pipeline.estimation.candidates import limits_of
from pipeline.estimation.gates import MIN_DELTA_BIC, MIN_DELTA_BIC_OF_SLOW, min_delta_bic
from pipeline.estimation.posterior import prior_limit
from pipeline.evaluation.diagnosis.words import plain
from pipeline.output.pages.chart import (
    AXES_LEGEND,
    Area,
    ChartLayer,
    Dots,
    Figure,
    LineMark,
    Panel,
    SampleMarks,
    chart,
    worded,
)
from pipeline.output.pages.group_charts import Point, bars, stems
from pipeline.output.pages.pages import measured, number, percent, unit_text
from pipeline.physics.effects import catalogue
from pipeline.physics.effects.base import largest_by_unit
from pipeline.physics.kinematics import table_motion
from pipeline.physics.measurement import predicted_reading
from pipeline.physics.signal.encoder_rate import rate_by_angle
from pipeline.physics.signal.filters import filtered

RESIDUAL_BINS = 36  # of a covariate, and of a turn: 10 deg each
MIN_BIN_SAMPLES = 5  # samples of a bin, below which it counts as empty: its scatter is unknown
HARMONICS = 12  # cycles a turn; averaging over 36 bins reduces the amplitude of the last one by 16 %
ONE_IN_A_THOUSAND = float(np.sqrt(2.0 * np.log(1000.0)))  # quantile 0.999 of the Rayleigh distribution
FLAT = 2.0  # mean square of the means over noise and wander, below which the page calls them flat
NOISE_ALONE_RATIO = 1.1  # residual over noise below which the page states that the residual is noise
MODEL_POINTS = 150  # of a model's line: about the number of ranges in a chart
COVARIATES: dict[str, Callable[[Residual], Values | None]] = {
    "angle, deg": lambda r: None if r.motion.angle is None else np.mod(r.motion.angle, 360.0),
    "rate, deg/s": lambda r: r.motion.rate,
    "specific force x, g": lambda r: r.motion.specific_force[:, 0],
    "specific force y, g": lambda r: r.motion.specific_force[:, 1],
    "specific force z, g": lambda r: r.motion.specific_force[:, 2],
    "temperature, degC": lambda r: r.motion.temperature,
    "time, s": lambda r: r.motion.time if r.recording.clock_shared else r.motion.time - r.motion.time[0],
}
RIVAL_SHARE = 0.8  # share of the selected effect's delta BIC above which another effect is named as a rival
# effects and brackets that a chart or its caption shows
MAX_CHART_EFFECTS, MIN_CHART_EFFECTS, MOST_HIDDEN, MAX_CAPTION_BRACKETS = 9, 3, 6, 2
EXCLUDED = 0.5  # of the upper limit by the prior alone, below which the recordings exclude an effect: convention
MOST_LIMITS = 8  # upper limits that a chart shows
ON_THE_LINE = 3.0  # mean square of the points about the line, in standard errors: 1 for noise, more for correlated bins
MOST_EXPLAINED = 0.97  # share of the points' variance that a line must explain where they are farther off
SIGNAL_NAMES = {
    "temperature": "temperature, degC",
    "time": "time since power-on, s",
    "speed": "magnitude of the angular rate, deg/s",
    "rate": "angular rate of the rate table, deg/s",
    "angle": "angle of the rate table, deg",
    **{f"f{a}": f"specific force along {a}, g" for a in AXES},
    **{f"w{a}": f"angular rate about {a}, deg/s" for a in AXES},
}


@dataclass(frozen=True)
class Residual:
    """Reading and prediction of one recording, (n, 3) in g or deg/s."""

    recording: Recording
    motion: Motion
    reading: Values
    predicted: Values
    reference_noise: Values  # (3,), rms error of the rate by a coarse encoder, by axis

    @cached_property
    def error(self) -> Values:
        """Reading minus prediction: (n, 3) array, g or deg/s."""
        return self.reading - self.predicted

    @cached_property
    def angle_bins(self) -> tuple[Integers, Integers]:
        """The bin, of 36 in a turn, of each angle, and the number of angles in each bin."""
        cell = (np.mod(np.asarray(self.motion.angle), 360.0) * (RESIDUAL_BINS / 360.0)).astype(np.int64) % RESIDUAL_BINS
        return cell, np.bincount(cell, minlength=RESIDUAL_BINS)


def residuals(calibration: SensorCalibration, recordings: list[Recording], table: Table) -> list[Residual]:
    """Return the residuals of the recordings for a sensor whose motion is known."""
    sensor, out = calibration.sensor, []
    for recording in recordings:
        reading = recording.reading(sensor) if recording.role == sensor else None
        motion = None if reading is None else table_motion(recording, table)
        if reading is not None and motion is not None:
            predicted = filtered(predicted_reading(calibration, motion), recording)
            by_encoder = np.zeros(3)
            by_angle = rate_by_angle(recording) if sensor == "gyroscope" else None
            if by_angle is not None and motion.axis is not None:
                by_encoder[motion.axis] = np.sqrt(np.mean(by_angle.noise**2))
            out.append(Residual(recording, motion, reading, predicted, by_encoder))
    return out


def white_noise(residual: Residual, noise: JSON | None) -> Values:
    """Return the standard deviation of a sample by white noise after the filter and by the reference: (3,) array.

    Without a noise model it is ``1.4826 median |e[n+1] - e[n]| / sqrt(2)``, robust to slow errors and outliers.
    """
    if noise and noise.get("white"):
        gain = float(residual.recording.filter.get("noise_gain", 1.0))
        return np.asarray(np.hypot(gain * np.array(noise["white"], float), residual.reference_noise))
    return np.asarray(MEDIAN_SIZE * np.median(np.abs(np.diff(residual.error, axis=0)), axis=0) / np.sqrt(2.0))


@dataclass(frozen=True)
class _BinnedMean:
    """Means of a residual in bins of a covariate: centres (m,), means and standard errors (m, 3); NaN in empty bins."""

    centre: Values
    mean: Values
    error: Values

    def excess(self, wander: Values) -> float:
        """Return the mean square of the means over the variance of noise and wander, of the worst axis."""
        filled = np.isfinite(self.mean[:, 0])
        ratio = self.mean[filled] ** 2 / (self.error[filled] ** 2 + wander**2)
        return float(ratio.mean(axis=0).max())


def _of_errors(error: Values) -> tuple[Values, Mask, Values]:
    """Return what ``_binned_mean`` needs of residuals (n, 3), for any covariate."""
    mean_square = np.einsum("ij,ij->j", error, error) / max(len(error), 1)  # without the squares, which may have 50 MB
    return error, finite_rows(error), np.asarray(mean_square)


def _binned_mean(covariate: Values, error: Values, finite: Mask, mean_square: Values) -> _BinnedMean | None:
    """Return the means of ``error`` (n, 3) in 36 equal bins of the covariate (n,); None where it does not vary.

    ``finite``: (n,), samples with an error on all axes; ``mean_square``: (3,), of the errors.
    """
    known = np.isfinite(covariate) & finite
    if not known.all():
        covariate, (error, _, mean_square) = covariate[known], _of_errors(error[known])
    low, high = (float(covariate.min()), float(covariate.max())) if len(covariate) else (0.0, 0.0)
    if not high - low > 1e-9 * max(1.0, abs(low)):
        return None
    cell = np.minimum(((covariate - low) * (RESIDUAL_BINS / (high - low))).astype(np.int64), RESIDUAL_BINS - 1)
    count = np.bincount(cell, minlength=RESIDUAL_BINS).astype(float)
    count[count < MIN_BIN_SAMPLES] = np.nan
    filled = np.isfinite(count)
    if filled.sum() < 2:
        return None
    mean = np.stack([np.bincount(cell, e, RESIDUAL_BINS) / count for e in error.T], 1)
    between = np.sum(mean[filled] ** 2 * count[filled, None], axis=0) / count[filled].sum()
    scatter = np.sqrt(np.maximum(mean_square - between, 0.0)) + 1e-300
    centre = low + (np.arange(RESIDUAL_BINS) + 0.5) * (high - low) / RESIDUAL_BINS
    return _BinnedMean(centre, mean, scatter / np.sqrt(count)[:, None])


def covariates(found: list[Residual], wander: Values) -> dict[str, _BinnedMean]:
    """Return binned means over all recordings by covariate, the largest excess first; of one force component only."""
    out: dict[str, _BinnedMean] = {}
    errors: dict[tuple[int, ...], tuple[Values, Mask, Values]] = {}  # by the recordings that have a covariate
    for label, value in COVARIATES.items():
        values = {i: v for i, r in enumerate(found) if (v := value(r)) is not None}
        if values:
            if (used := tuple(values)) not in errors:
                errors[used] = _of_errors(np.concatenate([found[i].error for i in used]))
            binned = _binned_mean(np.concatenate([*values.values()]), *errors[used])
            out |= {label: binned} if binned else {}
    order = sorted(out, key=lambda label: -out[label].excess(wander))
    forces = [label for label in order if label.startswith("specific force")]
    return {label: out[label] for label in order if label not in forces[1:]}


def harmonics(residual: Residual) -> Values | None:
    """Return the amplitudes of 0 to 12 cycles a turn: (13, 3) array, None where a bin of the turn has no sample.

    They are computed from means in 36 bins of the angle; the division by ``sinc`` corrects for averaging over a bin.
    """
    if residual.motion.angle is None:
        return None
    cell, count = residual.angle_bins
    if not count.all():
        return None
    mean = np.stack([np.bincount(cell, e, RESIDUAL_BINS) / count for e in residual.error.T], 1)
    amplitude = np.abs(np.fft.rfft(mean, axis=0))[: HARMONICS + 1] * (2.0 / RESIDUAL_BINS)
    amplitude[0] /= 2.0
    return np.asarray(amplitude / np.sinc(np.arange(HARMONICS + 1) / RESIDUAL_BINS)[:, None])


def harmonic_noise(residual: Residual, white: Values, wander: Values, time: float) -> Values:
    """Return the amplitude that noise alone exceeds with a probability of 0.001, by cycles a turn: (13,) array.

    The mean of ``a^2 + b^2`` of a harmonic is ``2 (2 white^2 / n + 2 S(f) / D)`` with the two-sided spectrum of the
    wander ``S = 2 s^2 T / (1 + (2 pi f T)^2)``, the recorded time D and the effective number of samples n, where
    ``1 / n`` is the mean of ``1 / (36 n_bin)``. ``white, wander``: (3,) standard deviations, the largest one is used;
    ``time``: correlation time of the wander, s.
    """
    motion = residual.motion
    duration = max(float(np.ptp(motion.time)), 1e-9)
    turns = max(float(np.abs(np.diff(np.asarray(motion.angle))).sum()) / 360.0, 1.0)
    frequency = np.arange(HARMONICS + 1) * turns / duration
    spectrum = 2.0 * float(wander.max()) ** 2 * time / (1.0 + (2.0 * np.pi * frequency * time) ** 2)
    of_white = float(white.max()) ** 2 * float(np.mean(1.0 / np.maximum(residual.angle_bins[1], 1))) / RESIDUAL_BINS
    spread = np.sqrt(2.0 * of_white + 2.0 * spectrum / duration)
    spread[0] = np.hypot(np.sqrt(of_white), wander.max())  # a mean, not an amplitude
    return np.asarray(ONE_IN_A_THOUSAND * spread)


def residual_figures(sensor: str, found: list[Residual], noise: JSON | None) -> list[Figure]:
    """Draw binned means of the residuals against each covariate (worst first), and their harmonics of the turn."""
    wander = np.array((noise or {}).get("wander") or [0.0] * 3, float)
    time = float((noise or {}).get("correlation_time_s") or 100.0)
    figures = [_covariate(sensor, label, mean, wander) for label, mean in covariates(found, wander).items()]
    for residual in found:
        amplitudes = harmonics(residual)
        if amplitudes is not None:
            level = harmonic_noise(residual, white_noise(residual, noise), wander, time)
            figures.append(_harmonics(sensor, residual.recording.name, amplitudes, level))
    return figures


def _covariate(sensor: str, label: str, mean: _BinnedMean, wander: Values) -> Figure:
    """Draw the binned means of each axis with the band of the wander."""
    unit, (name, covariate_unit) = SENSOR_UNITS[sensor], label.split(", ")
    words, excess = name.replace("force ", "force along "), mean.excess(wander)
    top = 1.05 * max(float(np.nanmax(np.abs(mean.mean) + 2 * mean.error)), 2.2 * float(wander.max()))
    panels = []
    for i, axis in enumerate(AXES):
        m, U = mean.mean[:, i], 2 * mean.error[:, i]
        layers: list[ChartLayer] = [Area(-2 * wander[i], 2 * wander[i])] if wander[i] > 0 else []
        layers.append(Dots(mean.centre, m, i, m - U, m + U))
        panels.append(Panel(layers, f"{axis}, {unit}", height=64, levels={"": 0.0}, limits=(-top, top)))
    finding = f"Flat against {words}, within the noise"
    if excess >= FLAT:
        spread = np.abs(mean.mean) / np.sqrt(mean.error**2 + wander**2)
        row, worst = np.unravel_index(int(np.nanargmax(spread)), spread.shape)
        at, size, sigmas = (float(v) for v in (mean.centre[row], mean.mean[row, worst], spread[row, worst]))
        finding = f"Not flat against {words}:"
        finding += f" {number(size)} {unit} on {AXES[worst]} at {number(at)} {covariate_unit}, {number(sigmas, 2)} σ"
    figure = Figure(f"{sensor}-residual-{name.replace(' ', '-')}", finding, quiet=excess < FLAT)
    means = f"Means in bins; on the worst axis their mean square is {number(excess)} times that of noise and wander."
    return chart(figure, means, panels, label, kind="angle" if name == "angle" else "")


def _harmonics(sensor: str, name: str, amplitudes: Values, level: Values) -> Figure:
    """Draw the amplitudes by cycles a turn, with the level of the noise."""
    unit = SENSOR_UNITS[sensor]
    ratio = amplitudes / np.maximum(level[:, None], 1e-300)
    ratio[0] = 0.0  # a bias
    cycles, axis = np.unravel_index(int(np.argmax(ratio)), ratio.shape)
    significant = bool(ratio.max() > 1.0)
    finding = f"{name}: no harmonic of the turn above the noise"
    if significant:
        size, plural = number(float(amplitudes[cycles, axis]), 2), "s" if cycles != 1 else ""
        finding = f"{name}: {cycles} cycle{plural} a turn on {AXES[axis]}, {size} {unit}, above the noise"
    figure = Figure(f"{sensor}-harmonics-{name}", finding, legend=AXES_LEGEND, quiet=not significant)
    groups = {str(k): row for k, row in enumerate(amplitudes.tolist())}
    return stems(figure, groups, f"amplitude, {unit}", "cycles a turn", level.tolist())


def measurement_and_model(sensor: str, residual: Residual, noise: JSON | None) -> Figure:
    """Draw readings and model over a turn, and below them the residual of each axis with the band of +-2 sigma."""
    unit, motion, name = SENSOR_UNITS[sensor], residual.motion, residual.recording.name
    turns = motion.angle is not None and np.ptp(motion.angle) > 1.0
    x = motion.angle if turns and motion.angle is not None else motion.time
    known = bool(noise and noise.get("white"))
    sigma = np.hypot(white_noise(residual, noise), ((noise or {}).get("wander") or 0.0) if known else 0.0)
    every = slice(None, None, -(-len(x) // MODEL_POINTS))  # of the model, which has no noise, few points are enough
    layers: list[ChartLayer] = [SampleMarks(x, residual.reading)]
    at = x[every]
    layers += [LineMark(at, residual.predicted[every, i], 5, "model") for i in range(3)]
    top = max(float(np.abs(residual.error).max()), 2.2 * float(sigma.max()))
    panels = [Panel(layers, f"reading, {unit}")]
    for i, axis in enumerate(AXES):
        layers = [Area(-2 * sigma[i], 2 * sigma[i]), SampleMarks(x, residual.error[:, i], i, mean=True)]
        panels.append(Panel(layers, f"{axis}, {unit}", height=56, limits=(-top, top)))
    rms = np.sqrt(np.einsum("ij,ij->j", residual.error, residual.error) / len(residual.error))
    outside = np.count_nonzero(np.abs(residual.error) > 2 * sigma) / residual.error.size
    ratio, by_encoder = float((rms / sigma).max()), float(residual.reference_noise.max())
    by_reference = (AXES[int(np.argmax(residual.reference_noise))], by_encoder) if known and by_encoder else None
    about = {"name": name, "ratio": ratio, "outside": outside, "reference": by_reference, "known": known}
    about |= {"rms": rms.tolist(), "unit": unit, "noise": NOISE_ALONE_RATIO}
    figure, description = worded("model", f"{sensor}-{name}", (*AXES_LEGEND, ("c5", "model")), **about)
    label, kind = ("angle of the rate table, deg", "angle") if turns else ("time, s", "")
    return chart(figure, description, panels, label, kind=kind)


def limit_rows(sensor: str, found: JSON, data_sheet: DataSheet) -> list[JSON]:
    """Return the upper limits of each effect that was not selected as text, and as share of the data sheet's limit.

    ``share`` is None where the sensor file has no limit; the largest come first. ``excluded``: whether the recordings
    exclude an effect of the size of that limit, and no answer of the answer set contains it.
    """
    if found.get("verdict") == Verdict.UNEXPLAINED:  # a model that does not explain the residual limits nothing
        return []
    rows, open_effects = [], {name for answer in found.get("answer_set") or [] for name in answer["effects"]}
    known, sizes = catalogue(), limits_of(sensor, data_sheet)
    for name, limits in (found.get("upper_limit") or {}).items():
        names = [p.name for p in known[name].parameters(sensor)] if name in sizes else []
        stated = dict(zip(names, sizes[name].tolist() if names else (), strict=True))
        text = ", ".join(f"{number(v, 2)} {unit_text(unit)}".rstrip() for unit, v in largest_by_unit(limits).items())
        shares = {key: v["value"] / stated[key] for key, v in limits.items() if np.isfinite(stated.get(key, np.inf))}
        share = max(shares.values(), default=None)
        excluded = share is not None and share < EXCLUDED * prior_limit() and name not in open_effects
        row: JSON = {"effect": name, "text": text, "share": share, "excluded": excluded}
        if shares:
            most = limits[max(shares, key=shares.__getitem__)]
            row["label"] = f"{plain(name)}: below {number(most['value'], 2)} {unit_text(most['unit'])}".rstrip()
        rows.append(row)
    return sorted(rows, key=lambda row: -float(f"{row['share'] or 0.0:.6g}"))  # equal ones in the order of their names


def upper_limits(sensor: str, rows: Sequence[JSON]) -> Figure | None:
    """Draw upper limits as shares of the data sheet's limits; None without any."""
    shown = [row for row in rows if row["share"]]
    if not shown:
        return None
    excluded, prior = sum(row["excluded"] for row in shown), prior_limit()
    counts = {"count": len(shown), "excluded": excluded, "others": len(shown) - MOST_LIMITS}
    figure, _ = worded("limits", f"{sensor}-limits", **counts, below=EXCLUDED * prior, prior=prior)
    points = [Point(row["label"], row["share"], 3) for row in shown[:MOST_LIMITS]]
    label = "upper limit over the data sheet's limit (logarithmic)"
    return bars(figure, points, label, levels={"limit of the sensor file": 1.0})


def ranking_rows(found: JSON) -> list[JSON]:
    """Return the ranked effects, whether each is ``selected``, and ``supported``: selected or with evidence for it."""
    chosen = found.get("selected") or []
    rows = [(r, r["effect"] in chosen) for r in found.get("ranking") or []]
    return [{**r, "selected": selected, "supported": selected or _evidence(r) > 0.0} for r, selected in rows]


def ranking(sensor: str, found: JSON) -> Figure | None:
    """Draw the ranking of a diagnosis, and list the effects that are not observable; None without ranked effects."""
    entries, hidden = found.get("ranking") or [], found.get("not_observable") or []
    selected = found.get("selected") or []
    if not entries:
        return None
    helpful = [r for r in entries if _evidence(r) > 0 or r["effect"] in selected][:MAX_CHART_EFFECTS]
    shown = helpful if len(helpful) >= MIN_CHART_EFFECTS else entries[:MIN_CHART_EFFECTS]
    rows = [_ranking_row(r, selected, passes=_passes(r, sensor)) for r in shown]
    brackets = _brackets(shown, selected)
    best = max((r for r in entries if r["effect"] not in selected), key=_evidence, default=None)
    value = _evidence(next((r for r in entries if r["effect"] == (selected or [None])[0]), {}))
    figure, _ = worded(
        "ranking",
        f"{sensor}-ranking",
        selected=selected,
        value=value,
        best=best,
        close=best is not None and _evidence(best) > RIVAL_SHARE * value,
        passes=best is not None and _passes(best, sensor),
        slow=MIN_DELTA_BIC_OF_SLOW,
        brackets=brackets,
        others=len(entries) - len(shown),
        hidden=shortened([plain(h["effect"]) for h in hidden], MOST_HIDDEN),
    )
    label = "ΔBIC (linear to ±10, logarithmic beyond)"
    levels = {f"threshold {MIN_DELTA_BIC:g}": MIN_DELTA_BIC}
    return bars(figure, rows, label, levels=levels, kind="symlog", brackets=brackets)


def _evidence(entry: JSON) -> float:
    return float(entry.get("delta_bic") or 0.0)


def _passes(entry: JSON, sensor: str) -> bool:
    """Return whether the evidence for an effect passes the gate of a first selection."""
    this = catalogue().get(entry["effect"])
    return _evidence(entry) > (min_delta_bic(this, sensor) if this else MIN_DELTA_BIC)


def _ranking_row(entry: JSON, selected: Sequence[str], *, passes: bool) -> Point:
    value, alike, chosen = _evidence(entry), entry.get("look_alikes") or [], entry["effect"] in selected
    beyond = passes and not entry.get("plausible", True)
    label = plain(entry["effect"]) + ", selected" * chosen + ", departs from the data sheet" * beyond
    note = "like " + ", ".join(f"{plain(a['effect'])} {percent(a['share'])}" for a in alike) if alike else ""
    return Point(label, value, 2 if chosen else 4 if passes else 3, note=note)


def _brackets(shown: Sequence[JSON], selected: Sequence[str]) -> list[dict[int, str]]:
    """Return the groups of similar effects, selected ones first: row of each member, and its share as text."""
    rows = {r["effect"]: i for i, r in enumerate(shown)}
    brackets: list[dict[int, str]] = []
    joined: set[frozenset[str]] = set()
    for entry in sorted(shown, key=lambda r: r["effect"] not in selected):
        alike = {a["effect"]: a["share"] for a in entry.get("look_alikes") or [] if a["effect"] in rows}
        alike = {n: share for n, share in alike.items() if frozenset((n, entry["effect"])) not in joined}
        if alike and len(brackets) < MAX_CAPTION_BRACKETS:
            joined |= {frozenset((n, m)) for n in (*alike, entry["effect"]) for m in alike}
            brackets.append({rows[entry["effect"]]: "", **{rows[n]: percent(s) for n, s in alike.items()}})
    return brackets


def added_variable(sensor: str, found: JSON) -> Figure | None:
    """Draw the added-variable plot of the first selected effect; None where the diagnosis has none."""
    shown = (found.get("pictures") or {}).get("added_variable")
    if not shown or not shown["panels"]:
        return None
    unit, effect, panels = shown["unit"], plain(shown["effect"]), []
    points = [_points(p) for p in shown["panels"]]
    ends = np.array([min(x.min() for x, _, _ in points), max(x.max() for x, _, _ in points)])
    scatter, residual, total = [], 0.0, 0.0
    for panel, (x, mean, error) in zip(shown["panels"], points, strict=True):
        line_x = np.array([x.min(), x.max()]) if panel["value"] else ends
        line = LineMark(line_x, panel["value"] * line_x, 5, "model")
        panels.append(Panel([line, _binned(panel)], f"{panel['axis']}, {unit}", 92, {"": 0.0}))
        squares = ((mean - panel["value"] * x) / error) ** 2
        scatter.append(float(np.mean(squares)))
        residual, total = residual + float(squares.sum()), total + float(np.sum((mean / error) ** 2))
    straight = max(scatter) < ON_THE_LINE or 1.0 - residual / max(total, 1e-300) > MOST_EXPLAINED
    best = max(shown["panels"], key=lambda p: abs(p["value"]) / max(p["standard_uncertainty"], 1e-300))
    what = best["parameter"] if len({p["parameter"] for p in shown["panels"]}) == 1 else "each parameter"
    slopes = "; ".join(dict.fromkeys(_coefficient(p) for p in shown["panels"]))
    x_unit = _column_unit(best["unit"], unit)
    shown = {"coefficient": _coefficient(best), "slopes": slopes, "straight": straight, "scatter": scatter}
    legend = (("c5", "slope = parameter"),)
    figure, description = worded("added_variable", f"{sensor}-added-variable", legend, effect=effect, **shown)
    label = f"column of {what}, minus all other columns" + (f", {x_unit}" if x_unit else "")
    return chart(figure, description, panels, label)


def _points(panel: JSON) -> tuple[Values, Values, Values]:
    x, mean, error = (np.array(panel[key], float) for key in ("x", "mean", "standard_error"))
    return x, mean, np.maximum(error, 1e-300)


def _binned(panel: JSON) -> Dots:
    x, mean, error = _points(panel)
    return Dots(x, mean, AXES.index(panel["axis"]), mean - 2.0 * error, mean + 2.0 * error)


def _coefficient(panel: JSON) -> str:
    value = measured(panel["value"], 2.0 * panel["standard_uncertainty"])
    return f"{panel['parameter']} = {value} {unit_text(panel['unit'])}".rstrip()


def _column_unit(parameter: str, unit: str) -> str:
    """Return the unit of the column that a parameter multiplies: the sensor's unit over the parameter's unit."""
    if parameter == unit:
        return ""
    if parameter == "1":
        return unit
    if parameter.startswith(f"{unit}/"):
        return parameter.removeprefix(f"{unit}/").removeprefix("(").removesuffix(")")
    if parameter.startswith("1/"):
        base, _, power = parameter.removeprefix("1/").partition("^")
        if base.strip("()") == unit:
            return f"{base}^{int(power or 1) + 1}"
        return f"{unit} {parameter.removeprefix('1/')}"
    return f"{unit}/{parameter}"


def unexplained(sensor: str, found: JSON) -> list[Figure]:
    """Draw the residual against each covariate on which it depends, with the suggested shape."""
    entries = {e["covariate"]: e for e in found.get("unexplained") or []}
    figures = []
    for shown in (found.get("pictures") or {}).get("unexplained") or []:
        unit, covariate, panels, scatter = shown["unit"], shown["covariate"], [], []
        for panel in shown["panels"]:
            x, mean, error = _points(panel)
            layers: list[ChartLayer] = [_binned(panel)]
            if "curve" in panel:
                curve_x, curve = (np.array(panel[key], float) for key in ("curve_x", "curve"))
                layers.insert(0, LineMark(curve_x, curve, 5, "model"))
                scatter.append(float(np.mean(((mean - np.interp(x, curve_x, curve)) / error) ** 2)))
            panels.append(Panel(layers, f"{panel['axis']}, {unit}", 76, {"": 0.0}))
        reaches = [f"{p['axis']} up to {number(float(np.abs(p['mean']).max()))} {unit}" for p in shown["panels"]]
        about = {"covariate": covariate, "entry": entries.get(covariate, {}), "reaches": reaches}
        about |= {"fitted": bool(scatter), "follow": all(mean_square < ON_THE_LINE for mean_square in scatter)}
        legend = (("c5", "suggested shape"),) if scatter else ()
        figure, description = worded("unexplained", f"{sensor}-unexplained-{covariate}", legend, **about)
        label = SIGNAL_NAMES.get(shown["signal"], f"what the axis should read, {SENSOR_UNITS[sensor]}")
        kind = "angle" if shown["signal"] == "angle" else ""
        figures.append(chart(figure, description, panels, label, kind=kind))
    return figures
