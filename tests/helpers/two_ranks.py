"""Running a test file's own `worker` as the two ranks of one job."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path

HELPERS = str(Path(__file__).parent)


def run_two_ranks(script: str, *arguments: object, numbered: bool = False, timeout: float = 200) -> None:
    """`python script arguments` twice, as torchrun starts them; both must end well.

    `numbered` puts the rank in front of the arguments, for workers that meet in another way.
    """
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    path = os.pathsep.join(filter(None, [os.environ.get("PYTHONPATH"), HELPERS]))
    meet = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
    job = {"WORLD_SIZE": 2, "LOCAL_WORLD_SIZE": 2, "NODE_RANK": 0, **meet}
    ranks = []
    for rank in range(2):
        place = {"RANK": rank, "LOCAL_RANK": rank, "OMP_NUM_THREADS": 1, "PYTHONPATH": path, **job}
        words = [str(rank)] * numbered + [str(argument) for argument in arguments]
        env = {**os.environ, **{key: str(value) for key, value in place.items()}}
        ranks.append(subprocess.Popen([sys.executable, "-P", script, *words], env=env))
    try:
        assert [process.wait(timeout=timeout) for process in ranks] == [0, 0]
    finally:
        for process in ranks:
            process.kill()
