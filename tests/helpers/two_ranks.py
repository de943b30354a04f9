"""Running a test file's own `worker` as the two ranks of one job."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

HELPERS = str(Path(__file__).parent)


def pair_of(script: str) -> Any:
    """A fixture: the folder in which both ranks of `script` have worked."""

    @pytest.fixture(scope="module")
    def pair(tmp_path_factory: pytest.TempPathFactory) -> Path:
        folder = tmp_path_factory.mktemp("pair")
        run_two_ranks(script, folder)
        return folder

    return pair


def work(worker: Callable[[Path], None]) -> None:
    """One rank: `worker` in the folder that the command names."""
    import torch

    torch.set_num_threads(1)
    worker(Path(sys.argv[1]))
    torch.distributed.barrier()
    os._exit(0)  # without destructors, as the program does: those of DDP and gloo can wait for each other


def run_two_ranks(script: str, folder: Path, timeout: float = 200) -> None:
    """`python script folder` twice, as torchrun starts them; both must end well."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    path = os.pathsep.join(filter(None, [os.environ.get("PYTHONPATH"), HELPERS]))
    meet = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
    job = {"WORLD_SIZE": 2, "LOCAL_WORLD_SIZE": 2, "NODE_RANK": 0, **meet}
    ranks = []
    for rank in range(2):
        place = {"RANK": rank, "LOCAL_RANK": rank, "OMP_NUM_THREADS": 1, "PYTHONPATH": path, **job}
        env = {**os.environ, **{key: str(value) for key, value in place.items()}}
        ranks.append(subprocess.Popen([sys.executable, "-P", script, str(folder)], env=env))
    try:
        assert [process.wait(timeout=timeout) for process in ranks] == [0, 0]
    finally:
        for process in ranks:
            process.kill()
