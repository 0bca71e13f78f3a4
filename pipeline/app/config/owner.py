"""The campaign to which a results folder belongs: a run replaces no results of another campaign of the same name.

The first run records the path of its campaign in ``.owner.json``. A campaign at the same path owns the results, also
after its sheet or its recordings have changed. A campaign at another path (moved, mounted, cloned, extended) owns them
where at least one unit is in both, and the recordings of each unit that is in both have equal SHA-256. Results without
a record, of the version before, follow the same rule. Recordings are read only where the path differs.

Recordings that a run simulates do not exist before it: the SHA-256 of their description stands for them; where no
record holds it, the true parameters that were written with them.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from pipeline.app.config.campaign import Campaign, load_campaign
from pipeline.app.results_folder import (
    BESIDE,
    NEW_FOLDER,
    OPEN_LOCKS,
    OWNER_FILE,
    PUBLISHED_PATHS,
    REPLACED,
    ResultsOwner,
    finish_publishing,
    is_owner,
    read_owner,
    recorded_directories,
    set_aside,
    take_run,
    write_owner,
)
from pipeline.app.run_progress import Countdown, wait_for_jobs
from pipeline.core.errors import PipelineError, shortened
from pipeline.core.files import read_json
from pipeline.core.pack import Pack, read_published
from pipeline.ingest.files import digests_in_pack, digests_of_entries, digests_of_files


class OtherCampaignError(PipelineError):
    """The results folder belongs to another campaign of the same name."""

    code = "other_campaign"


class Checked(NamedTuple):
    """The record that was found in order, and the folder to which older results have moved."""

    owner: ResultsOwner | None
    moved: Path | None = None


def check_owner(campaign: Campaign, *, move: bool = False) -> Checked:
    """Raise ``OtherCampaignError`` where the results belong to another campaign and ``take_over`` is not set.

    ``move``: with ``take_over``, move all older results to ``replaced-<date>/``; in a folder that no run has written,
    only files with the names of Snakemake's outputs.
    """
    results, owner = campaign.results, read_owner(campaign.results)
    if is_owner(results, campaign.directory):
        strays = [] if owner or not move else [results / name for name in BESIDE if (results / name).is_file()]
        return Checked(owner, set_aside({item.name: item for item in strays}, results))
    reason = _difference(campaign)
    if not reason:
        return Checked(owner)
    if not campaign.take_over or _is_campaign(results):
        raise _refusal(campaign, reason)
    return Checked(None, _move_all(campaign)) if move else Checked(owner)


def require_own_results(directory: Path, results: Path, settings: Mapping[str, Any]) -> None:
    """Raise ``OtherCampaignError`` where a command would use the results of another campaign of the same name.

    ``results``: folder of all results; ``settings``: of ``--config``, without campaign and results.
    """
    if not is_owner(results / directory.name, directory):
        check_owner(load_campaign({**settings, "campaign": str(directory), "results": str(results)}))


def claim(campaign: Campaign, checked: Checked) -> None:
    """Record the owner of the results, under the lock of the run.

    Raises ``OtherCampaignError`` if another run has recorded its campaign since the check.
    """
    owner = read_owner(campaign.results)
    same = is_owner(campaign.results, campaign.directory)
    if not same and (owner != checked.owner or campaign.take_over) and (reason := _difference(campaign)):
        raise _refusal(campaign, reason)
    units = owner.units if owner else {} if same else _recorded(campaign, {})
    write_owner(campaign.results, ResultsOwner(str(campaign.directory), _description(campaign), units))


def complete_record(campaign: Campaign) -> None:
    """Record the digests of the units that no stage states, because ingest refused their recordings."""
    owner = read_owner(campaign.results)
    unknown = [unit for unit in campaign.units if owner and unit not in owner.units]
    if owner and unknown:
        write_owner(campaign.results, owner._replace(units=owner.units | {u: _digests(campaign, u) for u in unknown}))


def _digests(campaign: Campaign, unit: str) -> list[str]:
    config = campaign.units[unit].config
    return digests_of_files(config.procedure, config.ingest, campaign.folder(unit))


def _refusal(campaign: Campaign, reason: str) -> OtherCampaignError:
    results, owner = campaign.results, read_owner(campaign.results)
    places = ", ".join(shortened(sorted(recorded_directories(results)), 3))
    known = f"the campaign {owner.campaign}" if owner else f"another campaign ({places or 'of unknown folder'})"
    message = f"other_campaign: holds the results of {known}; this campaign is {campaign.directory}, and {reason}"
    message += ". Write its results to another folder: results=DIR (--results DIR)"
    if not _is_campaign(results):
        message += f", or set take_over=true (--take-over): the older results then move to {results}/{REPLACED}<date>/"
    return OtherCampaignError(message, str(results))


def _is_campaign(results: Path) -> bool:
    """Return whether a results folder is also the directory of a campaign, whose files must not be moved."""
    return (results / "units.csv").exists()


def _difference(campaign: Campaign) -> str:
    """Return why the results are not those of a campaign at another path; empty where they are."""
    owner = read_owner(campaign.results)
    if campaign.simulation:
        if owner is None:
            return _difference_of_truth(campaign)
        same = owner.simulation == _description(campaign)
        return "" if same else f"{campaign.simulation.name} differs from the description of the results"
    known = _recorded(campaign, owner.units if owner else {})
    both = [unit for unit in campaign.units if unit in known]
    countdown, files = Countdown(len(both)), 0
    for number, unit in enumerate(both):
        countdown(number, f"recordings of {unit}: compared with those of the results in {campaign.results}")
        digests = _digests(campaign, unit)
        if digests != known[unit]:
            countdown.end()
            return f"the recordings of unit {unit} are others"
        files += len(digests)
    countdown.end()
    return "" if files else "no unit with the same recordings is in both"


def _recorded(campaign: Campaign, known: Mapping[str, list[str]]) -> dict[str, list[str]]:
    """Return the digests of the recordings of each unit: ``known``, or of published documents or outputs of ingest."""
    results, found = campaign.results, dict(known)
    for unit in campaign.units.keys() - found.keys():
        with suppress(OSError, PipelineError, ValueError, AttributeError, TypeError):
            document = json.loads(read_published(results / "calibrations" / f"{unit}.json"))
            if digests := digests_of_entries(document.get("inputs") or ()):
                found[unit] = digests
    for file in sorted(results.glob("batches/*/ingest.zip")):
        for unit in campaign.units.keys() - found.keys():
            with suppress(PipelineError, ValueError):
                if (ingested := digests_in_pack(Pack(file), unit)) is not None:
                    found[unit] = ingested
    return found


def _description(campaign: Campaign) -> str | None:
    """Return the SHA-256 of the description of simulated recordings; None for real recordings."""
    return hashlib.sha256(campaign.simulation.read_bytes()).hexdigest() if campaign.simulation else None


def _difference_of_truth(campaign: Campaign) -> str:
    """Compare the true parameters in the results with those that follow from the campaign's description."""
    from pipeline.physics.effects import read_effect_files, register  # noqa: PLC0415  (numpy, where results are compared)
    from pipeline.simulation.campaign import true_parameters  # noqa: PLC0415
    from pipeline.simulation.description import read_description  # noqa: PLC0415

    assert campaign.simulation is not None  # noqa: S101  (for the type checker)
    description, equal = read_description(campaign.simulation), 0
    for effect in read_effect_files(sorted((campaign.directory / "effects").glob("*.yaml"))).values():
        register(effect)
    names = [unit.unit for unit in description.units]
    for unit in description.units:
        file = campaign.recorded / "truth" / f"{unit.unit}.json"
        if not file.is_file():
            continue
        origin = names.index(unit.copy_of or unit.unit)
        expected: dict[str, Any] = true_parameters(description.units[origin], description.seed, origin)
        written = read_json(file)
        true = json.loads(json.dumps(expected))
        if not isinstance(written, dict) or any(written.get(k) != v for k, v in true.items()):
            return f"the true parameters of unit {unit.unit} are others"
        equal += 1
    return "" if equal else "no unit is in both"


def _move_all(campaign: Campaign) -> Path | None:
    """Move all that runs have written to ``replaced-<date>/``, the record last."""
    results = campaign.results
    take_run(results)
    try:
        wait_for_jobs(results, sys.stderr)
        if is_owner(results, campaign.directory):  # another process has moved them
            return None
        finish_publishing(results)
        names = [n for n in (*PUBLISHED_PATHS, *BESIDE, NEW_FOLDER, OWNER_FILE) if os.path.lexists(results / n)]
        return set_aside({name: results / name for name in names}, results)
    finally:
        OPEN_LOCKS.pop().close()
