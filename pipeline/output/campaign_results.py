"""The results of a campaign as pandas DataFrames, for notebooks and scripts.

    results = pipeline.load_campaign("results/demo")
    results.errors.query("step == 'calibrated'").pivot(index="unit", columns="sensor", values="rms_error")

A table is read from the published files at its first use. Accelerometer figures are in g (9.80665 m/s^2), gyroscope
figures in deg/s; parameters have a column with their unit.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cached_property
from pathlib import Path

import pandas as pd

from pipeline.core.errors import InputError, MissingInputError
from pipeline.core.files import JSON, read_json, text_of_cell
from pipeline.core.pack import DOCUMENT_FOLDERS, read_published
from pipeline.core.records import SENSORS
from pipeline.output.pages.parameters import SUMMARY_COLUMNS, fitted_parameters, reading_errors

OF_PARAMETER = ("parameter", "value", "value_unit", "expanded_uncertainty", "coverage_factor", "uncertainty_with_open")
ERROR_COLUMNS = (
    "step", "rms_error", "mean_abs_error", "max_error", "min_error", "sum_abs_error", "change_percent",
    "vector_rms_error", "noise_floor", "vector_noise_floor",
)  # fmt: skip
DIAGNOSIS = ("verdict", "residual_over_noise", "selected", "reason", "next_experiment", "override")
EFFECT_COLUMNS = (
    "effect", "delta_bic", "p_value", "explained_share", "held_out_error_before", "held_out_error_after", "plausible",
    "selected", "look_alikes",
)  # fmt: skip
CHIPS = ["board", "reference", "unit", "parameter", "value", "value_unit", "expanded_uncertainty", "observable"]
NOISE_COLUMNS = (
    "axis", "term", "value", "value_unit", "low", "high", "upper_limit", "correlation_time_s", "frequency_hz", "reason",
)  # fmt: skip
FIGURE_ENDINGS = ("_before", "_after", "_floor", "_answers", "_over_noise")  # of columns of summary.csv with numbers


@dataclass(frozen=True)
class UnitResults:
    """The published documents of one unit; if the unit failed, ``calibration["error"]`` states the cause."""

    name: str
    calibration: JSON
    validation: JSON | None
    diagnosis: JSON | None

    def __repr__(self) -> str:
        if self.calibration["status"] != "ok":
            error = self.calibration.get("error") or {}
            return f"<unit {self.name}: failed, {error.get('code')}: {error.get('message')}>"
        calibrated = [s for s in SENSORS if self.calibration[s]]
        verdicts = [f"{s} {((self.diagnosis or {}).get(s) or {}).get('verdict')}" for s in calibrated]
        return f"<unit {self.name}: {', '.join(verdicts)}>"


class CampaignResults:
    """The published results of one campaign; see ``pipeline.load_campaign``."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        if not (self.folder / "summary.csv").is_file():
            parent = self.folder if self.folder.is_dir() else self.folder.parent
            known = sorted(str(file.parent) for file in parent.glob("*/summary.csv"))
            hint = f"there are {', '.join(known)}" if known else f"{parent} holds no results of a campaign"
            raise MissingInputError(f"holds no summary.csv of a campaign; {hint}", str(folder))
        self._documents: dict[str, UnitResults] = {}

    def __repr__(self) -> str:
        failed = int((self.summary["status"] != "ok").sum())
        return f"<campaign {self.folder.name}: {len(self.units)} units, {failed} failed>"

    @property
    def units(self) -> list[str]:
        """Names of the units, in the order of ``units.csv``."""
        return list(self.summary["unit"])

    @cached_property
    def summary(self) -> pd.DataFrame:
        """``summary.csv``, one row a unit.

        Columns: ``unit, serial, lot, date, status`` ("ok", "failed"), ``error, sensor, method``; for each sensor
        ``<sensor>_error_before``, ``_error_after`` (rms), ``_mean_abs_before``, ``_mean_abs_after``, ``_noise_floor``
        (g or deg/s), ``_verdict``, ``_selected`` (missing effects, joined by ";"), ``_reason``, ``_answers`` (number of
        answers in the answer set), ``_beyond_limits`` (parameters beyond the sensor file's limits), ``_implausible``,
        ``_not_in_uncertainty``, ``_not_held_out`` (why nothing was held out), ``_not_converged``,
        ``_worse_than_raw`` (why the sensor is not calibrated then), ``_decided_by`` (the figure that
        decided the verdict); ``gyroscope_moves_over_noise`` (angle after held-out moves by hand); ``pass``;
        ``state`` ("ready", or the most urgent kind of problem, as on the campaign's page);
        ``left_out`` (rows that no fit uses); ``incomplete`` (stages after the fit that failed, and why); and other
        columns of ``units.csv``.
        """
        kinds = {n: "float" if n.endswith(FIGURE_ENDINGS) else "str" for n in SUMMARY_COLUMNS} | {"pass": "boolean"}
        table = pd.read_csv(self.folder / "summary.csv", dtype=kinds, keep_default_na=False, na_values=[""])
        texts = [column for column in table if pd.api.types.is_string_dtype(table[column])]
        table[texts] = table[texts].map(text_of_cell, na_action="ignore")
        return table.rename(columns=text_of_cell)

    @cached_property
    def parameters(self) -> pd.DataFrame:
        """One row for each unit, sensor and parameter.

        Columns: ``unit, sensor, parameter, value, value_unit, expanded_uncertainty`` (95 %, in the unit of the value)
        and ``coverage_factor`` (k; the standard uncertainty is expanded_uncertainty / k), ``uncertainty_with_open``
        (the expanded uncertainty with the open effects of bias and matrix, where it is larger by more than 10 %).

        Parameters of ``truth = matrix (reading - bias - effects)``: ``bias_x``, ``matrix_xy``, ``<effect>.<symbol>``.
        Elements of ``K = matrix^-1``: ``scale_factor_error_x`` (``K_xx - 1``) and
        ``cross_axis_xy`` (what axis x reads of a truth along y).
        """
        rows = (
            about | dict(zip(OF_PARAMETER, parameter, strict=True))
            for about, part in self._parts("calibration")
            for parameter in fitted_parameters(part) + reading_errors(part)
        )
        return pd.DataFrame(rows, columns=["unit", "sensor", *OF_PARAMETER])

    @cached_property
    def errors(self) -> pd.DataFrame:
        """Errors on held-out motion, one row for each unit, sensor and step, in the order in which steps are added.

        Columns: ``unit, sensor, step`` ("raw", "stage:<name>", "calibrated", "+ <effect>"), ``rms_error,
        mean_abs_error, max_error, min_error, sum_abs_error`` (g or deg/s, of the magnitude minus its reference),
        ``change_percent`` (of mean_abs_error, relative to raw), ``vector_rms_error`` (empty without an attitude
        reference), ``noise_floor`` and ``vector_noise_floor`` (rms error that noise alone causes).
        """
        steps = ((about, part, step) for about, part in self._parts("validation") for step in part.get("steps") or [])
        rows = ({**part, **step, **about, "step": step["name"]} for about, part, step in steps)
        return pd.DataFrame(rows, columns=["unit", "sensor", *ERROR_COLUMNS])

    @cached_property
    def diagnosis(self) -> pd.DataFrame:
        """The verdicts, one row for each unit and sensor.

        Columns: ``unit, sensor, verdict, residual_over_noise`` (rms residual of the fit of the diagnosis, divided by
        the noise), ``selected`` (missing effects, joined by ";"), ``reason, next_experiment, override`` (text).
        """
        parts = self._parts("diagnosis")
        rows = ({**part, **about, "selected": ";".join(part.get("selected") or [])} for about, part in parts)
        return pd.DataFrame(rows, columns=["unit", "sensor", *DIAGNOSIS])

    @cached_property
    def effects(self) -> pd.DataFrame:
        """The ranking of candidate effects, one row for each unit, sensor and effect, strongest evidence first.

        Columns: ``unit, sensor, effect, delta_bic`` (above 10: strong evidence), ``p_value, explained_share`` (of the
        residual above the noise), ``held_out_error_before, held_out_error_after`` (rms of the vector, g or deg/s),
        ``plausible`` (within the sensor file's limits), ``selected`` (bool), ``look_alikes`` (effects with a similar
        signal, joined by ";").
        """
        rows = (
            about
            | entry
            | {"selected": entry["effect"] in (part.get("selected") or [])}
            | {"look_alikes": ";".join(a["effect"] for a in entry.get("look_alikes") or [])}
            for about, part in self._parts("diagnosis")
            for entry in part.get("ranking") or []
        )
        return pd.DataFrame(rows, columns=["unit", "sensor", *EFFECT_COLUMNS])

    @cached_property
    def noise(self) -> pd.DataFrame:
        """The noise at rest, one row for each unit, sensor, axis and term (docs/noise.md).

        Columns: ``unit, sensor, axis, term`` ("white", "random_walk" ...), ``value, value_unit, low, high`` (95 %),
        ``upper_limit`` and ``reason`` (of a term that was not detected), ``correlation_time_s, frequency_hz``.
        """
        rows = (
            {"unit": unit.name, "sensor": sensor, "axis": axis, "term": name, "value_unit": part["unit"]}
            | {key: part.get(key) for key in ("value", "upper_limit", "reason")}
            | {key: (part.get(key) or {}).get("value") for key in ("correlation_time_s", "frequency_hz")}
            | dict(zip(("low", "high"), part["interval"] or (None, None), strict=True))
            for unit in map(self.unit, self.units)
            for sensor, noise in (unit.calibration.get("noise") or {}).items()
            for axis, identified in (noise["axes"] or {}).items()
            for name, parts in (identified["terms"] or {}).items()
            for part in (parts if isinstance(parts, list) else [parts])
        )
        return pd.DataFrame(rows, columns=["unit", "sensor", *NOISE_COLUMNS])

    @cached_property
    def chips(self) -> pd.DataFrame:
        """Position of each chip of a board relative to its reference chip, one row for each parameter (docs/boards.md).

        Columns: ``board, reference, unit, parameter`` ("rotation_x", "lever_arm_y", "time_offset_gyroscope" ...),
        ``value, value_unit, expanded_uncertainty`` (95 %), ``observable`` (bool).
        """
        rows = (
            {"board": board["name"], "reference": board["reference"], "unit": chip, "parameter": name}
            | parameter
            | {"value_unit": parameter["unit"], "unit": chip}
            for unit in map(self.unit, self.units)
            for board in [unit.calibration.get("board") or {"chips": {}}]
            for chip, part in board["chips"].items()
            for name, parameter in part.get("parameters", {}).items()
        )
        return pd.DataFrame(rows, columns=CHIPS)

    def unit(self, name: str) -> UnitResults:
        """Return the documents of one unit; ``InputError`` if the campaign has no such unit."""
        if name not in self._documents:
            if name not in self.units:
                near = get_close_matches(name, self.units, n=5) or self.units[:5]
                raise InputError(f"has no unit {name!r}; there are {', '.join(near)}", str(self.folder))
            folder, *others = DOCUMENT_FOLDERS
            calibration = self._document(folder, name)
            ok = calibration["status"] == "ok"
            found = (self._document(folder, name) if ok else None for folder in others)
            self._documents[name] = UnitResults(name, calibration, *found)
        return self._documents[name]

    def _document(self, folder: str, name: str) -> JSON:
        document: JSON = read_json(self.folder / folder / f"{name}.json", read_published)
        return document

    def _parts(self, document: str) -> Iterator[tuple[JSON, JSON]]:
        """Yield ``{unit, sensor}`` and the part of a document about this sensor, if it has one."""
        for unit in map(self.unit, self.units):
            for sensor in SENSORS:
                part = (getattr(unit, document) or {}).get(sensor)
                if part:
                    yield {"unit": unit.name, "sensor": sensor}, part
