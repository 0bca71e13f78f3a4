"""The package ``pipeline`` under the name of its distribution: ``import imu_calibration`` returns ``pipeline`` itself.

``import imu_calibration.core.errors`` returns ``pipeline.core.errors``, so that no module is loaded twice, with classes
that differ.
"""

from __future__ import annotations

import sys

import pipeline
from pipeline import *  # noqa: F403  (for tools that read this file and do not run it)
from pipeline.core.other_names import SameModule, former_name

ALIAS = f"{__name__}."


def _name_in_pipeline(name: str) -> str | None:
    if not name.startswith(ALIAS):
        return None
    own = f"{pipeline.__name__}.{name.removeprefix(ALIAS)}"
    return former_name(own) or own


sys.meta_path.insert(0, SameModule(_name_in_pipeline))
sys.modules[__name__] = pipeline
