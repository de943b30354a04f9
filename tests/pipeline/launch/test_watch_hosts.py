"""A process of two hosts dies or stalls, under torchrun: both hosts' jobs end, and one sentence says why."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import pytest
from two_networks import two_networks, why_not
from watched_training import Jobs, descendants, end_of, pid_of, wait_for_step

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(600),
    pytest.mark.skipif(bool(why_not()), reason=why_not()),
]
NUMBERS = {
    "dies": (signal.SIGKILL, "has died"),
    "stalls": (signal.SIGSTOP, "has stalled: it has not answered"),
}


@pytest.mark.parametrize("how", NUMBERS)
def test_the_process_of_another_host(jobs: Jobs, tmp_path: Path, how: str) -> None:
    number, words = NUMBERS[how]
    with two_networks() as nodes:
        meet = ("--nnodes=2", "--nproc-per-node=1", "--rdzv-backend=c10d", "--rdzv-id=cable")
        meet += (f"--rdzv-endpoint={nodes[0].address}:29400",)
        both = []
        for node in nodes:
            launcher = (sys.executable, "-P", "-m", "torch.distributed.run", *meet)
            words_of_node = node.words(*launcher, f"--local-addr={node.address}")
            both.append(jobs.start(tmp_path, "goes", words_of_node, "2", GLOO_SOCKET_IFNAME=node.device))
        wait_for_step(tmp_path, 30)
        pids = descendants(*both)
        os.kill(pid_of(tmp_path, 1), number)
        said = "\n".join(end_of(both, pids))
    assert said.count(f"{words}") == 1, said
    # Which of the two became rank 1 the rendezvous decides.
    line = next(line for line in said.splitlines() if words in line)
    assert any(f"rank 1 on {node.name} (process " in line for node in nodes), line
    assert "it was at stage duel, step" in line
