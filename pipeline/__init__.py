"""Calibration of inertial measurement units: the conventions of the whole package.

Units
    Specific force in g (standard, 9.80665 m/s^2), angular rate in deg/s, angles in deg, time in s since power-on
    (stored as integer ns), temperature in degC. Conversion happens at ingest and at export only.

Frames
    *body*: the right-handed axes x, y, z that the unit's readings are calibrated to, fixed to the table's turn axes.
    *level*: z up (against gravity), x and y level; where Earth's rotation matters, ``table.azimuth_deg`` is the azimuth
    of level x, clockwise from north seen from above. Attitudes are unit quaternions (w, x, y, z) that take body
    vectors to the level frame.
    A turn about body axis a by the table angle: at angle 0 the axis that points up is z for turns about x and y, and x
    for turns about z; the specific force at angle A is the up vector turned by -A about the turn axis (right-handed).
    At angle 0 the body axes coincide with the level axes for turns about x and y; for turns about z body x is level z,
    body y level y, body z level -x.

Signs
    At rest the upward axis reads ``+table.gravity_g``. Vectors are columns.

The measurement equation
    ``reading = bias + K @ truth + sum of effects + noise``, with ``K = matrix^-1``, so
    ``truth = matrix @ (reading - bias - effects)``, where

    reading : (3,) output of the sensor, g or deg/s
    bias    : (3,) same unit
    matrix  : (3, 3) the calibration matrix: scale factor, misalignment and non-orthogonality together
    effects : functions of the motion, the temperature and the time; see ``pipeline.physics.effects``
    noise   : white noise plus a Gauss-Markov bias wander; see ``pipeline.core.records.Noise``
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.core import VERSION
from pipeline.core.errors import PipelineError
from pipeline.core.other_names import know_former_names

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from os import PathLike
    from pathlib import Path

    import pandas as pd

    from pipeline.app.one_unit import UnitResult
    from pipeline.output.campaign_results import CampaignResults
    from pipeline.physics.compensation import Compensation

know_former_names()

__version__ = VERSION
EFFECT_NAMES = ("Effect", "Layout", "Owner", "axis_parameters")  # of an effect in Python; they import numpy
__all__ = ["PipelineError", "__version__", "calibrate", "calibrate_unit", "load_calibration", "load_campaign"]


def __getattr__(name: str) -> Any:  # noqa: ANN401  (of the protocol)
    """Return a name that an effect in Python needs (``docs/effects_of_your_own.md``)."""
    if name not in EFFECT_NAMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from pipeline.physics.effects import base  # noqa: PLC0415  (numpy is imported only where it is needed)

    return getattr(base, name)


def calibrate(
    recordings: str | PathLike[str] | Mapping[str, str | PathLike[str] | pd.DataFrame],
    *,
    sensor: str,
    table: str = "hand",
    procedure: str | None = None,
    method: str | None = None,
    overrides: Sequence[str] = (),
    python_effects: Sequence[str | PathLike[str]] = (),
) -> UnitResult:
    """Calibrate a unit from its recordings, in memory; no file is written.

    Parameters
    ----------
    recordings : str, Path or mapping
        A folder with the files that the procedure names, or the file or DataFrame of each recording by its name, for
        example ``{"accel_x": frame}``. A DataFrame has the columns of the canonical CSV (``time_s``, ``accel_x_g``,
        ``gyro_x_dps``, ``table_angle_deg`` ...), in its units; its index is not used. Messages count its rows as lines
        of that CSV: row 0 is line 2.
    sensor, table, procedure, method : str
        Options of these groups, with the defaults of ``units.csv``.
    overrides : sequence of str
        Further settings, as in ``overrides=`` of a run, for example ``["effects.gyroscope=[g_sensitivity]"]``.
    python_effects : sequence of str or Path
        Files of effects in Python. They are run.

    Raises
    ------
    PipelineError
        The error whose code, message and file a run publishes for a failed unit.
    """
    from pipeline.app.one_unit import UnitResult, unit_without_campaign  # noqa: PLC0415  (Hydra is imported only here)

    chosen = {"sensor": sensor, "table": table, "procedure": procedure, "method": method}
    configured = unit_without_campaign(recordings, chosen, overrides, python_effects)
    return UnitResult.of(configured, configured.calibrated())


def calibrate_unit(
    campaign: str | PathLike[str],
    unit: str,
    *,
    overrides: Sequence[str] = (),
    python_effects: Sequence[str | PathLike[str]] = (),
    results: str | PathLike[str] = "results",
) -> UnitResult:
    """Calibrate one unit of a campaign as a run does, in memory; no file is written.

    Parameters
    ----------
    campaign : str or Path
        A campaign's name or directory.
    unit : str
        A unit of its ``units.csv``.
    overrides : sequence of str
        Hydra overrides for this unit, as in ``overrides=`` of a run.
    python_effects : sequence of str or Path
        Files of effects in Python. They are run.
    results : str or Path
        Folder of the results of runs. Only a campaign with ``simulate: true`` needs it: its recordings are those that
        a run has simulated.

    Raises
    ------
    PipelineError
        ``ConfigurationError`` if the campaign, the unit or a setting is not valid; else the error whose code, message
        and file a run publishes for a failed unit.
    """
    from pipeline.app.config import load_campaign as load  # noqa: PLC0415  (Hydra is imported only where needed)
    from pipeline.app.config.layers import as_list  # noqa: PLC0415
    from pipeline.app.one_unit import (  # noqa: PLC0415
        UnitResult,
        files_of_effects,
        notes_of_campaign,
        require_simulated,
        unit_of_campaign,
    )
    from pipeline.output.outcome import DEFAULT_RESULTS  # noqa: PLC0415

    settings: Mapping[str, Any] = {
        "campaign": str(campaign),
        "results": "" if str(results) == DEFAULT_RESULTS else str(results),
        "overrides": as_list(overrides, "overrides"),
        "python_effects": files_of_effects(python_effects),
    }
    loaded = load({key: value for key, value in settings.items() if value})
    configured = unit_of_campaign(loaded, unit)
    require_simulated(loaded)
    return UnitResult.of(configured, configured.calibrated(), notes_of_campaign(loaded, unit))


def load_calibration(path: str | Path, python_effects: Sequence[str | Path] = ()) -> Compensation:
    """Load ``calibrations/<unit>.json``; ``.apply(accelerometer=..., gyroscope=..., ...)`` compensates arrays.

    Parameters
    ----------
    path : str or Path
    python_effects : sequence of str or Path
        Files of the Python effects that the calibration uses. The calibration itself contains effects by formula.

    Raises
    ------
    InputError
        If the file does not exist, is not a calibration, or is the record of a failed unit.
    ConfigurationError
        If an effect is unknown, or is a Python effect whose file is not in ``python_effects``.
    """
    from pipeline.physics.compensation import load  # noqa: PLC0415  (numpy is imported only where it is needed)

    return load(path, python_effects)


def load_campaign(folder: str | Path) -> CampaignResults:
    """Load ``results/<campaign>`` as pandas DataFrames; ``InputError`` if the folder has no results of a campaign.

    The tables are ``.summary``, ``.parameters``, ``.errors``, ``.diagnosis``, ``.effects``, ``.noise`` and ``.chips``;
    ``.unit(name)`` is one unit.
    """
    from pipeline.output.campaign_results import CampaignResults  # noqa: PLC0415  (pandas, only where it is needed)

    return CampaignResults(folder)
