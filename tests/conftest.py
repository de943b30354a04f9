"""Fixtures that more than one test folder uses."""

from __future__ import annotations

import os
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

# Two processes that fill one cache of numba's at once, as librosa's functions do in a fresh environment, can
# mix their files and then crash (numba issue 10128): each test process has its own.
os.environ["NUMBA_CACHE_DIR"] = str(
    Path(__file__).resolve().parents[1]
    / ".pytest_cache"
    / "numba"
    / os.environ.get("PYTEST_XDIST_WORKER", "one")
)

# What a dry run remembers is no matter of a test, nor of whoever starts the tests.
os.environ["XDG_CACHE_HOME"] = str(Path(__file__).resolve().parents[1] / ".pytest_cache" / "home")

# As many test processes as cores leave no core for a second thread: threads that wait for one that does not
# run take several times as long as one thread alone. It works because
# torch is not imported yet.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")


# The tests import the helper modules by their bare names, and so do spawned workers, which inherit the path.
sys.path.append(str(Path(__file__).parent / "helpers"))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files of slow tests come first: with the last of them, one process would work and the others wait."""
    slow = Counter(item.path for item in items if item.get_closest_marker("slow"))
    items.sort(key=lambda item: -slow[item.path])


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


@pytest.fixture
def float64() -> Iterator[None]:
    """Networks and random inputs in float64: two ways to one result then agree to far below any bound here,
    whatever instructions and number of threads the machine sums with. What a network returns may still be
    rounded to float32."""
    import torch  # not before the environment is set

    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(before)
