"""Fixtures that more than one test folder uses."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of golden vectors and real data: `MOTIONLOOM_SHARED`, else `../shared` beside the repository."""
    named = os.environ.get("MOTIONLOOM_SHARED")
    if named:
        folder = Path(named)
        if not folder.is_dir():
            pytest.fail(f"MOTIONLOOM_SHARED={named}: no such folder")
        return folder.resolve()
    folder = Path(__file__).resolve().parents[2] / "shared"
    if not folder.is_dir():
        pytest.skip("golden vectors and real data are not here: set MOTIONLOOM_SHARED to their folder")
    return folder
