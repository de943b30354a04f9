"""A process of a training on two nodes stalls, under srun: the job ends, and one sentence says which one."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from slurm_cluster import Cluster, why_not
from watched_training import Jobs, descendants, end_of, pid_of, until, wait_for_step

pytestmark = [
    pytest.mark.slurm,
    pytest.mark.timeout(600),
    pytest.mark.skipif(bool(why_not()), reason=why_not()),
]
AS_A_HOST = ("unshare", "--uts", "sh", "-c", 'hostname $SLURMD_NODENAME && exec "$@"', "sh")
"""The nodes are one machine: no process of one is to be killed by the other as one of its own."""


@pytest.fixture
def jobs() -> Iterator[Jobs]:
    started = Jobs()
    yield started
    started.end()


def test_a_stopped_process_of_another_node_ends_the_job(jobs: Jobs, tmp_path: Path) -> None:
    with Cluster() as cluster:
        asked = ("--nodes=2", "--ntasks-per-node=1", "--cpus-per-task=2", "--kill-on-bad-exit=1")
        job = jobs.start(
            tmp_path, "goes", ("srun", *asked, *AS_A_HOST, sys.executable, "-P"), "2",
            MASTER_ADDR="127.0.0.1", GLOO_SOCKET_IFNAME="lo", **cluster.environment,
        )  # fmt: skip
        wait_for_step(tmp_path, 30)
        ranks = [pid_of(tmp_path, rank) for rank in range(2)]
        os.kill(ranks[1], signal.SIGSTOP)
        said = end_of([job], [*descendants(job), *ranks])[0]
        until(lambda: not cluster.ask("squeue", "--noheader"), "the job is still there")
    assert said.count("has stalled: it has not answered") == 1, said
    assert "error: rank 1 on n2 (process " in said and "it was at stage duel, step" in said, said
