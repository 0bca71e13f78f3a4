"""Fixtures of the file formats."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from sample_logs import REFERENCE, profile

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def canonical() -> dict[str, Any]:
    return profile("canonical_csv")


@pytest.fixture
def reference() -> Path:
    if not REFERENCE.is_dir():
        pytest.skip("reference data not beside the repository")
    return REFERENCE
