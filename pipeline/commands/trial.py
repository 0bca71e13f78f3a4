"""Run the stages of one unit from ``ingest`` to ``calibration`` in this process and a temporary folder.

A trial uses the functions and settings of a run, so it refuses the same recordings. It has no diagnosis, exports or
pages.
"""

from __future__ import annotations

import json
import tempfile
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.config.campaign import Campaign, cut_batches
from pipeline.config.stage_settings import settings_of_jobs
from pipeline.io.arrow import from_parquet
from pipeline.model.effects import forget, register_user_effects
from pipeline.pack import Pack, as_bytes, new_pack
from pipeline.stages import MODULES
from pipeline.stages.batch import FITS, Job, failure_of, merge_common

if TYPE_CHECKING:
    from pipeline.records import Recording


@dataclass
class Trial:
    """The result of a trial.

    ``recordings``: output of ingest. ``failure``: the failure record of a run, None if the unit is calibrated.
    ``not_calibrated``: sensor that is not calibrated to the reason. ``not_determined``: calibrated sensor to the
    quantities that its rests do not determine.
    """

    recordings: list[Recording] = field(default_factory=list)
    failure: dict[str, Any] | None = None
    not_calibrated: dict[str, str] = field(default_factory=dict)
    not_determined: dict[str, str] = field(default_factory=dict)


def try_unit(campaign: Campaign, unit: str, until: str = "calibration", *, incomplete: bool = False) -> Trial:
    """Run the stages of a unit and return the result.

    ``until``: the last stage: ``ingest``, ``fit`` (without ``effects``, the slowest stage of a fit) or ``calibration``.
    ``incomplete``: accept missing recordings.
    """
    row = campaign.units[unit]
    if incomplete:
        procedure = row.config["procedure"]
        optional = {name: entry | {"optional": True} for name, entry in procedure["recordings"].items()}
        row = replace(row, config=row.config | {"procedure": procedure | {"recordings": optional}})
    batches, chains = cut_batches({unit: row}, 1)
    ((batch, _),) = batches.items()
    files = settings_of_jobs(replace(campaign, units={unit: row}, batches=batches, chains=chains, compare=[]))[batch]
    fits = [f"fit/{sensor}/{stage}" for sensor in FITS for stage in chains[batch][sensor]]
    base = [fit for fit in fits if not fit.endswith("/effects")]
    outputs = {"ingest": ["ingest"], "fit": ["ingest", "filter", *base]}.get(
        until, ["ingest", "filter", *fits, "validate", "calibration"]
    )
    packs: dict[str, Pack] = {}
    trial = Trial()
    with tempfile.TemporaryDirectory() as folder:
        for output in outputs:
            stage, sensor, name = [*output.split("/"), "", ""][:3]
            content = merge_common(json.loads(files[output].content))
            (settings,) = content.pop("units").values()
            last = "yes" if sensor and name == chains[batch][sensor][-1] else "no"
            inputs = packs | ({"previous": packs[sensor]} if sensor in packs else {})
            content |= {"sensor": sensor, "stage": name, "last": last}
            path = Path(folder) / f"{output.replace('/', '-')}.zip"
            register_user_effects(content.get("user_effects", {}))
            try:
                job = Job(stage, {unit: settings}, content, inputs, path, Path(folder))
                made = getattr(import_module(f"pipeline.stages.{MODULES[stage]}"), f"{stage}_unit")(job, unit, settings)
            except Exception as error:  # noqa: BLE001  (like in a run, it stops only this unit)
                trial.failure = failure_of(error, unit, output)
                break
            finally:
                forget()
            with new_pack(path) as add:
                add({file: as_bytes(member) for file, member in made.items()})
            packs[sensor or stage] = Pack(path)
            if stage == "ingest":
                trial.recordings = from_parquet(packs["ingest"].read(f"{unit}.parquet"), str(path))
            if stage == "calibration":
                document = packs["calibration"].json(f"{unit}.json")
                trial.not_calibrated = document["not_calibrated"]
                trial.not_determined = {s: document[s]["not_determined"] for s in FITS if document[s]}
    return trial
