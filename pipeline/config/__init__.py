"""From Hydra groups and ``units.csv`` to checked configurations, batches and each stage's part of them.

Only this package knows Hydra; jobs read the JSON that it writes.
"""

from pipeline.config.campaign import Campaign, UnitRow, load_campaign
from pipeline.config.stage_settings import code_digest, settings_of_jobs

__all__ = ["Campaign", "UnitRow", "code_digest", "load_campaign", "settings_of_jobs"]
