"""Write a recording as a log."""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING

import imu_logs
from imu_logs.log import Log
from pipeline.ingest.arrow import columns_of

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from pipeline.core.records import Recording


def write_recording(path: Path, recording: Recording, decimals: Mapping[str, int] = MappingProxyType({})) -> None:
    """Write a recording as a log, along the body axes: MCAP or canonical CSV by the suffix (``imu_logs.write``)."""
    columns = columns_of(recording)
    time_ns, flags = columns.pop("time_ns"), columns.pop("flags", None)
    imu_logs.write(Log(str(path), time_ns, columns, {}, flags=flags), path, decimals)
