"""Ranks that were given different recipes, evicted nodes and ranks that die: who ends, who is named; and the
same commands go on with the same bytes, by torchrun and without it, on one node and on two."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from kill_matrix import finished_files
from step_records import PAUSE, RECORDS
from two_nodes import two_nodes, why_not
from watched_training import until

from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.launch.process import LOST, SAVED, take_place
from motionloom.pipeline.launch.team import Team

RECIPE = """
name: toys
seed: 4
hardware: {accelerator: cpu, devices: 1, nodes: 2, threads: 1, loggers: []}
stages:
  toy: {kind: toy, optim: {lr: 0.01}, train: {steps: 60, checkpoint_every: 5}}
"""
RUN = (str(Path(sys.executable).with_name("motionloom")), "run")
TORCHRUN = (sys.executable, "-P", "-m", "torch.distributed.run", "--no-python", "--rdzv-backend=c10d")
NO_SHARE = {"TORCH_DISABLE_SHARE_RDZV_TCP_STORE": "1"}
NODES = pytest.param(True, marks=pytest.mark.skipif(bool(why_not()), reason=why_not()), id="two nodes")
pytestmark = pytest.mark.slow


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


class Starts:
    """Starts commands in a folder, with a log each; nothing of them outlives the test."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.processes: list[subprocess.Popen[bytes]] = []
        (folder / "toys.yaml").write_text(RECIPE)
        (folder / "records").mkdir()

    def __call__(self, *words: object, pause: float = 0.0, **variables: object) -> subprocess.Popen[bytes]:
        helpers = str(Path(__file__).parents[2] / "helpers")
        known = {"MOTIONLOOM_STAGES": "toy_training_stage,watched_steps", "OMP_NUM_THREADS": 1, PAUSE: pause}
        known |= {RECORDS: self.folder / "records", "PYTHONPATH": helpers, **variables}
        with (self.folder / f"log{len(self.processes)}").open("wb") as log:
            process = subprocess.Popen(
                [*map(str, words)], cwd=self.folder, stdout=log, stderr=log, start_new_session=True,
                env={**os.environ, **{key: str(value) for key, value in known.items()}},
            )  # fmt: skip
        self.processes.append(process)
        return process

    def said(self) -> str:
        return "\n".join(path.read_text() for path in sorted(self.folder.glob("log*")))

    def ends(self, count: int = 2) -> list[int]:
        """Exit codes of the last commands."""
        return [process.wait(100) for process in self.processes[-count:]]

    def reached(self, run: str, step: int) -> None:
        place = self.folder / run / "stages/toy/checkpoints"
        there = lambda: any(int(path.stem[5:]) >= step for path in place.glob("s*.ckpt"))  # noqa: E731
        until(lambda: there() or any(one.poll() for one in self.processes), "no checkpoint", 120)
        assert there(), self.said()


@pytest.fixture
def starts(tmp_path: Path) -> Iterator[Starts]:
    made = Starts(tmp_path)
    yield made
    for process in made.processes:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)


def as_nodes(starts: Starts, *words: str, on: Any = ((), ()), address: str = "127.0.0.1", **how: Any) -> None:
    """One command a node: the second one is told its number as an Indexed Job tells it."""
    meet = {"MASTER_ADDR": address, "MASTER_PORT": free_port(), **how}
    starts(*on[0], *RUN, "toys.yaml", *words, NODE_RANK=0, **meet)
    starts(*on[1], *RUN, "toys.yaml", *words, JOB_COMPLETION_INDEX=1, **meet)


@pytest.fixture(scope="module")
def calm(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The files of the undisturbed training of two ranks."""
    starts = Starts(tmp_path_factory.mktemp("calm"))
    as_nodes(starts, "-o", "calm")
    assert starts.ends() == [0, 0], starts.said()
    return finished_files(starts.folder / "calm/stages/toy")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("toy.train.seed={}", "toy.train.seed: 1 there, 0 here"),
        ("toy.train.steps=1{}", "toy.train.steps: 11 there, 10 here"),
        ("name=a{}", "the run folder: "),
        ("code", "motionloom: "),
        ("files", "toy.width: 9 there, 8 here"),
    ],
)
def test_ranks_that_differ_are_named_before_anything_is_written(
    starts: Starts, change: str, said: str
) -> None:
    port, recipes = free_port(), ["toys.yaml", "toys.yaml"]
    if change == "files":
        recipes[1] = "other.yaml"
        (starts.folder / "other.yaml").write_text(RECIPE.replace("kind: toy,", "kind: toy, width: 9,"))
    for rank in (0, 1):
        place = {"RANK": rank, "GROUP_RANK": rank, "LOCAL_RANK": 0, "LOCAL_WORLD_SIZE": 1, "WORLD_SIZE": 2}
        words = ("--set", change.format(rank)) if "=" in change else ()
        stages = "toy_training_stage" + ",other_version" * (change == "code" and rank)
        (starts.folder / "other_version.py").write_text(
            "from motionloom.pipeline.launch import team\nteam.metadata.version = lambda name: '0.0'\n"
        )
        more = {"MOTIONLOOM_STAGES": stages, "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
        helpers = str(Path(__file__).parents[2] / "helpers")
        starts(*RUN, recipes[rank], *words, PYTHONPATH=f"{helpers}:{starts.folder}", **place, **more)
    assert starts.ends() == [2, 2]
    assert f"rank 1 differs from rank 0 in {said}" in starts.said()
    assert not [*starts.folder.glob("runs/*/stages")]


@pytest.mark.parametrize("apart", [False, NODES])
def test_torchrun_restarts_what_died_with_the_same_bytes(
    starts: Starts, calm: dict[str, str], apart: bool
) -> None:
    def start(node: tuple[str, ...], address: str, own: str, processes: int) -> None:
        where = (f"--rdzv-endpoint={address}:{port}", f"--local-addr={own}", f"--nnodes={2 // processes}")
        how = (f"--nproc-per-node={processes}", "--max-restarts=3", "--rdzv-id=1")
        sizes = ("--set", f"hardware.nodes={2 // processes}", "--set", f"hardware.devices={processes}")
        words = (*RUN, "toys.yaml", "-o", "run", *sizes)
        starts(*node, *TORCHRUN, *where, *how, *words, pause=0.05, **NO_SHARE)

    def kill_one() -> None:
        starts.reached("run", 10)
        agent = starts.processes[-1].pid
        children = Path(f"/proc/{agent}/task/{agent}/children").read_text().split()
        os.kill(int(children[-1]), signal.SIGKILL)

    port = free_port()
    if apart:
        with two_nodes() as nodes:
            for number, node in enumerate(nodes, start=1):
                start(node, "10.77.0.1", f"10.77.0.{number}", 1)
            kill_one()
            assert starts.ends() == [0, 0], starts.said()
    else:
        start((), "127.0.0.1", "127.0.0.1", 2)
        kill_one()
        assert starts.ends(1) == [0], starts.said()
    assert "resuming" in starts.said()
    assert finished_files(starts.folder / "run/stages/toy") == calm


@pytest.mark.parametrize("apart", [False, NODES])
def test_an_evicted_node_has_all_save_and_the_same_commands_go_on(
    starts: Starts, calm: dict[str, str], apart: bool
) -> None:
    def run(on: Any, address: str) -> None:
        as_nodes(starts, "-o", "run", on=on, address=address, pause=0.05)
        starts.reached("run", 10)
        starts.processes[-1].terminate()
        assert starts.ends() == [SAVED, SAVED], starts.said()
        as_nodes(starts, "-o", "run", on=on, address=address)
        assert starts.ends() == [0, 0], starts.said()

    if apart:
        with two_nodes() as nodes:
            run(nodes, "10.77.0.1")
    else:
        run(((), ()), "127.0.0.1")
    assert finished_files(starts.folder / "run/stages/toy") == calm


@pytest.mark.parametrize("dead", [0, 1])
def test_a_node_that_dies_is_named_by_the_other(starts: Starts, dead: int) -> None:
    as_nodes(starts, "-o", "run", pause=0.05)
    starts.reached("run", 5)
    victim = starts.processes[dead]
    victim.kill()
    assert starts.ends() == [-signal.SIGKILL, LOST][:: 1 - 2 * dead]
    assert f": rank {dead} (process {victim.pid} on " in starts.said() and ".cpp:" not in starts.said()


@pytest.mark.parametrize(
    ("given", "nodes", "said"),
    [
        ({}, 2, "NODE_RANK not set and MASTER_ADDR not set"),
        ({"NODE_RANK": "2", "MASTER_ADDR": "a"}, 2, "NODE_RANK 2 and"),
        ({"NODE_RANK": "1"}, 1, r"hardware.nodes is 1"),
        ({"JOB_COMPLETION_INDEX": "1"}, 2, "NODE_RANK 1 and MASTER_ADDR not set"),
        ({"SKYPILOT_NODE_RANK": "3", "SKYPILOT_NODE_IPS": "10.0.0.1\n10.0.0.2"}, 2, "MASTER_ADDR 10.0.0.1:"),
        ({"RANK": "0", "TORCHELASTIC_MAX_RESTARTS": "1", "TORCHELASTIC_USE_AGENT_STORE": "True"}, 2,
         "TORCH_DISABLE_SHARE_RDZV_TCP_STORE=1"),
    ],
)  # fmt: skip
def test_places_that_cannot_be_are_refused(
    given: dict[str, str], nodes: int, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as env:
        for name in ("NODE_RANK", "MASTER_ADDR", "MASTER_PORT"):
            env.setenv(name, "")  # what is taken up is gone behind the test
            env.delenv(name)
        for name, value in given.items():
            env.setenv(name, value)
        take_place(nodes)
        with pytest.raises(UserError, match=said):
            Team.start(Hardware(accelerator="cpu", devices=1, nodes=nodes))
