"""Shared by the tests of `datasets`: the helper modules, and data that several need."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture(scope="session")
def made() -> ModuleType:
    """Clips and converters to write shards with."""
    import shard_samples

    return shard_samples


@pytest.fixture(scope="session")
def loopback() -> ModuleType:
    """Servers of shards on this machine."""
    import loopback

    return loopback


@pytest.fixture(scope="session")
def amass() -> ModuleType:
    """Clips in AMASS's form."""
    import amass_clips

    return amass_clips


@pytest.fixture(scope="module")
def root(made: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sixty clips in shards, not to be changed."""
    root = tmp_path_factory.mktemp("data")
    made.write(root)
    return root


@pytest.fixture
def copy(fixture: Path, tmp_path: Path) -> Path:
    """The module's `fixture`, free to change."""
    return Path(shutil.copytree(fixture, tmp_path / "source", copy_function=shutil.copyfile))
