"""Where the real data lies: the folder that POLYMERGE_REAL_DATA names. Its licences forbid shipping it."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of the real data. Where the variable is set, a missing folder is a failure and not a skip."""
    named = os.environ.get("POLYMERGE_REAL_DATA")
    if not named:
        pytest.skip("POLYMERGE_REAL_DATA does not name the folder of the real data")
    folder = Path(named)
    if not folder.is_dir():
        pytest.fail(f"POLYMERGE_REAL_DATA names {folder}, which is no folder")
    return folder
