"""Compose Hydra groups and ``units.csv`` into checked configurations, batches, and the settings of each stage.

Only this package imports Hydra. Jobs read the JSON files that it writes.
"""

from pipeline.app.config.campaign import Campaign, UnitRow, load_campaign
from pipeline.app.config.stage_settings import code_digest, settings_of_jobs

__all__ = ["Campaign", "UnitRow", "code_digest", "load_campaign", "settings_of_jobs"]
