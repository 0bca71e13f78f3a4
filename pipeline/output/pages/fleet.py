"""The tables of a campaign: its summary, one row a unit, and statistics of its units.

Units of one sensor model that were calibrated by one method are compared with each other. For each parameter

    z = (value - median) / (1.4826 median(|value - median|))

is a unit's distance in robust standard deviations. A unit is far if |z| > 6, with 20 units or more. A parameter drifts
with the date if Spearman's rank correlation differs from zero, and differs between lots by the test of Kruskal and
Wallis, both at 0.001 after Bonferroni's correction for the number of parameters. The drift is the slope of Theil and
Sen. Repeatability is the pooled standard deviation of units that share a serial. It is compared with the stated
uncertainties: with weights ``w = 1 / u^2`` and the weighted mean m of each device,

    chi^2 = sum(w (value - m)^2),    E_n = |a - b| / sqrt(U_a^2 + U_b^2)

E_n is the largest of all pairs of calibrations of one device. If the p-value of chi^2 is below 0.001 after the same
correction, the calibrations of a device scatter more than their stated uncertainties.

References
----------
1. Rousseeuw & Croux, Alternatives to the median absolute deviation, J. Am. Stat. Assoc. 88 (1993) 1273.
2. Sen, Estimates of the regression coefficient based on Kendall's tau, J. Am. Stat. Assoc. 63 (1968) 1379.
3. ISO 13528:2022, 9.7 (E_n); JCGM 106:2012.

The changes from run to run: a section of a unit's page, and the data for the comparison on the campaign's page.

The page of a unit has the section from the second run on that changed the unit.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from pipeline.core.files import JSON, spreadsheet_cell, write_atomically
from pipeline.core.records import MEDIAN_SIZE, SENSOR_UNITS, SENSORS, Mask, Values
from pipeline.core.verdicts import Error
from pipeline.evaluation.diagnosis.words import plain
from pipeline.output.history import difference, dropped, errors_of, of_units
from pipeline.output.outcome import add_command, uncertainty_words
from pipeline.output.pages.chart import Figure
from pipeline.output.pages.group_charts import Point, bars
from pipeline.output.pages.pages import LINK_MARK, MARK, number, template
from pipeline.output.pages.parameters import PARAMETER_KEYS, SUMMARY_COLUMNS

Texts = NDArray[np.object_]


# units, below which a median absolute deviation is too uncertain: its standard deviation is 17 % of it
MIN_UNITS_OF_DEVIATION = 20
OUTLIER_DEVIATIONS = 6.0  # robust standard deviations, which noise does not exceed in 10,000 units with 24 parameters
FLEET_TEST_LEVEL = 0.001  # of the tests of drift and lots, for a whole fleet
MOST_PAIRED = 1000  # units from which the slope is computed: it needs all pairs of them, 50 MB
DAYS_OF_A_YEAR = 365.25
SIBLINGS = ["sensor", "method"]
SHOWN = 12  # runs in a chart: the first, and the last ones
LABEL_LETTERS = 50  # letters of a bar's text before the ratio; a bar is 66 letters long
STATES = 10_000  # of units in runs after the first that a campaign's page contains: 2 MB at 0.2 kB each
UNCHANGED_ERROR = 0.02  # relative change of an error that is not significant
NEAR_FLOOR = 1.5  # error over noise floor below which a bar is green


def parameter_table(units: Mapping[str, Sequence[Sequence[Any]]]) -> pd.DataFrame:
    """Return the parameters of some units (``unit_parameters``) as one table: ``unit`` and ``PARAMETER_KEYS``."""
    rows = [(unit, *row) for unit, of_unit in units.items() for row in of_unit]
    kinds = dict.fromkeys(("value", "u", "U", "limit"), float) | {"beyond": bool, "fitted": bool}
    return pd.DataFrame(rows, columns=["unit", *PARAMETER_KEYS]).astype(kinds)


def wide(parameters: pd.DataFrame, units: Sequence[str], name: str, *figures: str) -> list[pd.DataFrame]:
    """Return a frame for each figure: one row a unit, one column a parameter, named by the column ``name``."""
    names = parameters.drop_duplicates(name).sort_values("sensor", kind="stable")[name].tolist()
    cells = parameters.set_index(["unit", name]).reindex(pd.MultiIndex.from_product([units, names]))
    return [pd.DataFrame(cells[f].to_numpy().reshape(len(units), len(names)), units, names) for f in figures]


class ValuesOfUnits(NamedTuple):
    """The values of a parameter, one a unit; texts are None, figures NaN where nothing is stated."""

    unit: Texts
    lot: Texts
    serial: Texts
    day: Values  # since 1970
    value: Values
    u: Values
    U: Values

    def where(self, rows: Mask) -> ValuesOfUnits:
        """Return some of the units."""
        return ValuesOfUnits._make(column[rows] for column in self)


def fleet_statistics(rows: Sequence[JSON], parameters: pd.DataFrame) -> JSON:
    """Return the statistics of a fleet, ``fleet.json``: a list of dicts for each statistic, and ``missing``.

    ``rows``: of ``summary_row``, one a unit; ``parameters``: of ``parameter_table``, without failed units.
    """
    units = pd.DataFrame(rows, columns=["unit", "lot", "date", "serial", *SIBLINGS]).replace("", None)
    units = units.rename(columns={"sensor": "model"}).dropna(subset=["model", "method"])
    units["day"] = (pd.to_datetime(units["date"], format="%Y-%m-%d", errors="coerce") - pd.Timestamp(0)).dt.days
    known = units.merge(parameters[parameters["fitted"]], on="unit")
    texts = {key: known[key].astype(object).where(known[key].notna(), None).to_numpy() for key in ("lot", "serial")}
    figures = {key: known[key].to_numpy(np.float64, na_value=np.nan) for key in ("day", "value", "u", "U")}
    table = ValuesOfUnits(known["unit"].to_numpy(object), **texts, **figures)
    keys = list(zip(known["model"], known["method"], strict=True))
    groups: dict[tuple[str, str], dict[str, list[int]]] = {key: {} for key in keys}  # parameter to its rows
    names, measures = known["parameter"].tolist(), known["measure"].tolist()
    for row in np.argsort(known["sensor"].to_numpy(str), kind="stable").tolist():
        groups[keys[row]].setdefault(names[row], []).append(row)
    out: JSON = {key: [] for key in STATISTICS}
    for (model, method), of_siblings in groups.items():
        for name, members in of_siblings.items():
            about = {"sensor": model, "method": method, "parameter": name, "unit": measures[members[0]]}
            values = table.where(np.array(members))
            values = values.where(np.isfinite(values.value))
            for key, statistic in STATISTICS.items() if len(values.value) else ():
                out[key] += [about | found for found in statistic(values, len(of_siblings))]
    out["far"].sort(key=lambda f: -abs(f["z"]))
    out["missing"] = _missing_effects(rows)
    return out


def _spread(values: Values) -> float:
    """Return 1.4826 times the median absolute deviation: the standard deviation where the values are normal."""
    return float(MEDIAN_SIZE * np.median(np.abs(values - np.median(values))))


def _quantiles(table: ValuesOfUnits, _: int) -> Iterable[JSON]:
    v = table.value
    low, middle, high = np.percentile(v, [5.0, 50.0, 95.0]).tolist()
    found = {"units": len(v), "median": middle, "robust_standard_deviation": _spread(v)}
    yield found | {"quantile_05": low, "quantile_95": high, "smallest": float(v.min()), "largest": float(v.max())}


def _far(table: ValuesOfUnits, _: int) -> Iterable[JSON]:
    v, spread = table.value, _spread(table.value)
    if len(v) >= MIN_UNITS_OF_DEVIATION and spread > 0.0:
        z = (v - np.median(v)) / spread
        for i in np.flatnonzero(np.abs(z) > OUTLIER_DEVIATIONS):
            yield {"name": table.unit[i], "lot": table.lot[i], "value": float(v[i]), "z": float(z[i])}


def _drift(table: ValuesOfUnits, parameters: int) -> Iterable[JSON]:
    known = table.where(np.isfinite(table.day))
    if len(known.day) < MIN_UNITS_OF_DEVIATION or np.ptp(known.day) == 0.0 or np.ptp(known.value) == 0.0:
        return
    from scipy import stats  # noqa: PLC0415  (0.3 s that few fleets need)

    rho, p = stats.spearmanr(known.day, known.value)
    if p * parameters < FLEET_TEST_LEVEL:
        step = -(-len(known.day) // MOST_PAIRED)
        slope = float(stats.theilslopes(known.value[::step], known.day[::step]).slope)
        found = {"rank_correlation": float(rho), "p_value": float(p), "per_year": slope * DAYS_OF_A_YEAR}
        yield found | {"units": len(known.day)}


def _lots(table: ValuesOfUnits, parameters: int) -> Iterable[JSON]:
    values = table.value
    lots = {lot: values[rows] for lot, rows in _by_name(table.lot).items() if len(rows) >= 3}
    if len(values) < MIN_UNITS_OF_DEVIATION or len(lots) < 2 or np.ptp(values) == 0.0:
        return
    p = _kruskal(list(lots.values()))
    if p * parameters < FLEET_TEST_LEVEL:
        medians, middle = {lot: float(np.median(v)) for lot, v in lots.items()}, float(np.median(values))
        lot = max(medians, key=lambda lot: abs(medians[lot] - middle))
        yield {"p_value": p, "lot": lot, "lot_median": medians[lot], "median": middle}


def _kruskal(samples: Sequence[Values]) -> float:
    """Return the p-value of the test of Kruskal and Wallis; ``scipy.stats`` takes 0.4 s to import."""
    from scipy.special import chdtrc  # noqa: PLC0415  (only lots need it)

    _, of_rank, ties = np.unique(np.concatenate(samples), return_inverse=True, return_counts=True)
    last, total = np.cumsum(ties), len(of_rank)
    ranks = (last - 0.5 * (ties - 1.0))[of_rank]
    parts = np.split(ranks, np.cumsum([len(sample) for sample in samples])[:-1])
    squares = sum(float(np.sum(part)) ** 2 / len(part) for part in parts)
    h = 12.0 / (total * (total + 1)) * squares - 3 * (total + 1)
    tied = 1.0 - float(np.sum(ties.astype(float) ** 3 - ties)) / (total**3 - total)
    return float(chdtrc(len(samples) - 1, h / tied))


def _by_name(names: Texts) -> dict[str, list[int]]:
    """Return the rows of each name, in the order of the names; those without a name are left out."""
    rows: dict[str, list[int]] = {name: [] for name in sorted({name for name in names if name is not None})}
    for row, name in enumerate(names):
        if name is not None:
            rows[name].append(row)
    return rows


def _repeatability(table: ValuesOfUnits, parameters: int) -> Iterable[JSON]:
    """Return the scatter of the calibrations of one device, pooled over devices with several calibrations."""
    devices = [table.where(np.array(rows)) for rows in _by_name(table.serial).values() if len(rows) > 1]
    if not devices:
        return
    calibrations = sum(len(device.value) for device in devices)
    squares = sum(float(np.sum((device.value - np.mean(device.value)) ** 2)) for device in devices)
    scatter = math.sqrt(squares / (calibrations - len(devices)))
    found = {"devices": len(devices), "calibrations": calibrations, "standard_deviation": scatter}
    yield found | _against_stated(devices, parameters)


def _against_stated(devices: Sequence[ValuesOfUnits], parameters: int) -> JSON:
    """Return chi-square, its degrees of freedom and p-value, and the largest E_n; nothing without uncertainties."""
    known = [device.where((device.u > 0.0) & np.isfinite(device.U)) for device in devices]
    known = [device for device in known if len(device.value) > 1]
    if not known:
        return {}
    from scipy.special import chdtrc  # noqa: PLC0415  (0.1 s that only repeated calibrations need)

    chi, freedom, largest = 0.0, 0, 0.0
    for device in known:
        value, w, U = device.value, 1.0 / device.u**2, device.U
        chi += float(np.sum(w * (value - np.sum(w * value) / np.sum(w)) ** 2))
        freedom += len(value) - 1
        largest = max(largest, float(np.max(np.abs(value[:, None] - value) / np.hypot(U[:, None], U))))
    p = float(chdtrc(freedom, chi))
    found = {"chi_square": chi, "degrees_of_freedom": freedom, "p_value": p, "largest_en": largest}
    return found | {"beyond_uncertainty": p * parameters < FLEET_TEST_LEVEL}


STATISTICS = {"distributions": _quantiles, "far": _far, "drift": _drift, "lots": _lots, "repeatability": _repeatability}


def _missing_effects(rows: Sequence[JSON]) -> list[str]:
    """Return a sentence for each missing effect, with the number of units and their lots."""
    frame = pd.DataFrame(rows).reindex(columns=["lot", *(f"{s}_{c}" for s in SENSORS for c in ("verdict", "selected"))])
    lots = frame["lot"].replace("", None).value_counts()
    sentences = []
    for sensor in SENSORS:
        judged = frame[frame[f"{sensor}_verdict"].notna()]
        effects = judged[f"{sensor}_selected"].fillna("").astype(str).str.split(";").explode()
        for name, count in effects[effects != ""].value_counts().items():
            of = judged.loc[effects.index[effects == name], "lot"].replace("", None).value_counts()
            sentence = f"missing effect: {name} ({count} of {len(judged)} units, {sensor})"
            if len(lots) > 1 and len(of):
                lot, most = of.index[0], int(of.iloc[0])
                share = f"from lot {lot} ({most} of its {lots[lot]})"
                if most == count:
                    sentence += f", all {share}"
                else:
                    sentence += f", {most} of them {share}" if most > count / 2 else f", from {len(of)} lots"
            sentences.append(sentence)
    return sentences


def write_parameters(path: Path, rows: Sequence[JSON], parameters: pd.DataFrame) -> None:
    """Write ``parameters.parquet``: one row a unit with all columns of ``summary.csv`` and every fitted parameter.

    Columns of a parameter: ``<name>`` and ``<name>_expanded_uncertainty``, with the unit in the column's metadata.
    """
    arrays, fields = [], []
    for column in dict.fromkeys(key for row in rows for key in row):
        values = pa.array([row.get(column) for row in rows])
        arrays.append(values if values.type != pa.null() else values.cast(pa.string()))
        fields.append(pa.field(column, arrays[-1].type))
    fitted = parameters[parameters["fitted"]]
    measures = dict(zip(fitted["parameter"], fitted["measure"], strict=True))
    value, expanded = wide(fitted, [row["unit"] for row in rows], "parameter", "value", "U")
    for name in value:
        for suffix, frame in (("", value), ("_expanded_uncertainty", expanded)):
            arrays.append(pa.array(frame[name], pa.float64(), from_pandas=True))
            fields.append(pa.field(name + suffix, pa.float64(), metadata={"unit": measures[name]}))
    buffer = io.BytesIO()
    pq.write_table(pa.Table.from_arrays(arrays, schema=pa.schema(fields)), buffer, compression="zstd")
    write_atomically(path, buffer.getvalue())


def write_summary(path: Path, rows: list[JSON]) -> None:
    """Write ``summary.csv`` from rows of ``summary_row``; other columns may differ from unit to unit.

    Texts of the user that a spreadsheet would take as a formula are escaped.
    """
    columns = list(dict.fromkeys([*SUMMARY_COLUMNS, *(key for row in rows for key in row)]))
    frame = pd.DataFrame([{key: _cell(value) for key, value in row.items()} for row in rows], columns=columns)
    frame.columns = frame.columns.map(spreadsheet_cell)
    write_atomically(path, frame.to_csv(index=False, lineterminator="\n"))


def _cell(value: object) -> object:
    """Return a number to nine digits, a truth value in lower case, and a text that is no formula."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return spreadsheet_cell(value)
    return f"{value:.9g}" if isinstance(value, float) else value


def with_history(page: str, states: Sequence[tuple[int, JSON]], times: Mapping[int, str]) -> str:
    """Return a unit's page with the section on its runs.

    ``states``: number of each run that changed the unit, and the unit's state after it; ``times``: when each run was.
    """
    entries: list[JSON] = []
    before: JSON = {}
    for run, state in states:
        change = difference(before, state) if before else None
        words = change.words() if change else []
        for sensor in SENSORS:
            change_of_u = uncertainty_words(before.get(sensor) or {}, state.get(sensor) or {}, SENSOR_UNITS[sensor])
            words += [f"{sensor}: {change_of_u.replace('->', '→')}"] if change_of_u else []
        entries.append({"run": run, "time": times[run], "state": state, "change": change, "words": words})
        before = state
    figures = [figure for sensor in SENSORS if (figure := _chart(sensor, entries))]
    last = entries[-1]["change"]
    lost = [plain(name) for sensor in SENSORS for name in last.removed[sensor]] if last else []
    section = template("history.html").render(entries=entries, figures=figures, lost=lost, before=states[-2][0])
    return page.replace(MARK, section, 1).replace(LINK_MARK, '<li><a href="#history">Runs</a></li>', 1)


def _chart(sensor: str, entries: Sequence[JSON]) -> Figure | None:
    """Draw the held-out error of a sensor by run, with its noise floor; None where it never changed."""
    errors = errors_of([entry["state"] for entry in entries], sensor)
    known = [(e, error, error.after) for e, error in zip(entries, errors, strict=True) if error.after]
    if len({after for *_, after in known}) < 2:
        return None
    shown = known if len(known) <= SHOWN else [known[0], *known[1 - SHOWN :]]
    unit, rows = SENSOR_UNITS[sensor], [_row(entry, error, sensor) for entry, error, _ in shown]
    (*_, first), (_, error, last) = known[-2:]
    floor = error.floor
    if abs(last - first) <= UNCHANGED_ERROR * first:
        change = f"stays at {number(last)}"
    else:
        change = f"{'falls' if last < first else 'rises'} from {number(first)} to {number(last)}"
    ratio = f", {number(last / floor)} × the noise floor" if floor else ""
    finding = f"{sensor.capitalize()}: in the last run the error of the {error.kind} {change} {unit}{ratio}"
    caption = "Error after each run that changed the unit, on held-out motion where a run had any,"
    caption += " and the effects that it added or removed."
    figure = Figure(f"history-{sensor}", finding, caption)
    return bars(figure, rows, f"rms error, {unit} (logarithmic)", levels={f"noise floor {number(floor)}": floor or 0.0})


def _row(entry: JSON, error: Error, sensor: str) -> Point:
    change, ratio = entry["change"], error.ratio
    words = change.words(sensor) or ["effects of the other sensor"] if change else entry["state"][sensor]["effects"]
    label = f"run {entry['run']}" + (f"{':' if change else ' with'} {plain(', '.join(words))}" if words else "")
    label = label if len(label) <= LABEL_LETTERS else f"{label[: LABEL_LETTERS - 1]}…"
    label += f", {number(ratio)} × floor" if ratio else ""
    return Point(label, error.after, 1 if ratio and ratio < NEAR_FLOOR else 3)


def times_of(entries: Sequence[JSON]) -> dict[int, str]:
    """Return when each run was, to the minute (UTC)."""
    return {entry["run"]: str(entry["time"])[:16].replace("T", " ") for entry in entries}


def runs_data(entries: Sequence[JSON], settings: JSON) -> JSON | None:
    """Return the data with which the campaign's page compares any two runs; None if there is one run.

    Of many runs, the first and the last ones can be compared, as many as ``STATES`` allows.
    """
    if len(entries) < 2:
        return None
    last, count = [entries[-1]], len(entries[-1]["units"])
    for entry in reversed(entries[1:-1]):
        count += len(entry["units"])
        if count > STATES:
            break
        last.append(entry)
    compared, times = [entries[0], *reversed(last)], times_of(entries)
    units = []
    for unit, states in of_units(entries).items():
        after = [next((s for s in reversed(states) if s[0] <= e["run"]), None) for e in compared]
        shown = dict(filter(None, after))
        if len(shown) > 1:
            errors = {s: errors_of([*shown.values()], s) for s in SENSORS}
            of_runs = [{s: errors[s][i] for s in SENSORS} for i in range(len(shown))]
            short = [[run, _short(state, of)] for (run, state), of in zip(shown.items(), of_runs, strict=True)]
            units.append([unit, short])
    runs = [[e["run"], f"run {e['run']}, {times[e['run']]}: {_count(e)}"] for e in compared]
    lost = dropped(entries).items()
    gone = [{"unit": u, "run": run, "effects": e, "add": add_command(settings, u, e)} for (u, run), e in lost]
    return {"runs": runs, "units": units, "dropped": gone, "number": entries[-1]["run"]}


def _count(entry: JSON) -> str:
    count = len(entry["units"]) + len(entry.get("gone") or [])
    return f"{count} unit{'s' if count != 1 else ''} changed" if entry["run"] > 1 else f"{count} units"


def _short(state: JSON, errors: Mapping[str, Error]) -> JSON:
    if not state:
        return {"status": "not in units.csv"}
    parts = {s: state[s] for s in SENSORS if state.get(s)}
    shown = {s: [errors[s].after, errors[s].floor, part["verdict"], part["effects"]] for s, part in parts.items()}
    return {"status": state["status"], "overrides": state["overrides"], **shown}
