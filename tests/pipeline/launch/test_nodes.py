"""Ranks that were given different recipes, evicted nodes and ranks that die: who ends, who is named; and the
same commands go on with the same bytes, by torchrun and without it, on one node and on two."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from contextlib import nullcontext
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
OTHER = "from motionloom.pipeline.launch import team\nteam.metadata.version = lambda name: '0.0'\n"
RUN = (str(Path(sys.executable).with_name("motionloom")), "run")
TORCHRUN = (sys.executable, "-P", "-m", "torch.distributed.run", "--no-python", "--rdzv-backend=c10d")
NODES = pytest.param(True, marks=pytest.mark.skipif(bool(why_not()), reason=why_not()), id="two nodes")
HELPERS = str(Path(__file__).parents[2] / "helpers")


class Starts:
    """Starts commands in a folder."""

    def __init__(self, folder: Path, start: Callable[..., subprocess.Popen[str]]) -> None:
        self.folder, self.start, self.processes, self.said = folder, start, list[subprocess.Popen[str]](), ""
        (folder / "toys.yaml").write_text(RECIPE)
        (folder / "wider.yaml").write_text(RECIPE.replace("kind: toy,", "kind: toy, width: 9,"))
        (folder / "other_version.py").write_text(OTHER)
        (folder / "records").mkdir()
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]

    def __call__(self, place: Any, *words: object, pause: float = 0.0, **variables: object) -> None:
        known = {"MOTIONLOOM_STAGES": "toy_training_stage,watched_steps", PAUSE: pause, RECORDS: "records"}
        known |= {"PYTHONPATH": f"{HELPERS}:{self.folder}", **variables}
        there = ("env", f"--chdir={self.folder}", *(f"{key}={value}" for key, value in known.items()))
        self.processes.append(self.start(*words, program=(*place, *there)))

    def nodes(
        self, *words: Any, on: Any = ((), ()), address: str = "127.0.0.1", second: Any = (), **how: Any
    ) -> None:
        """One command a node: the second one, which may be another, is told its number by an Indexed Job."""
        meet = {"MASTER_ADDR": address, "MASTER_PORT": self.port, **how}
        self(on[0], *RUN, *words, NODE_RANK=0, **meet)
        meet |= second if isinstance(second, dict) else {}
        words = words if isinstance(second, dict) else second or words
        self(on[1], *RUN, *words, JOB_COMPLETION_INDEX=1, **meet)

    def end_with(self, *codes: int) -> None:
        ended = self.processes[-len(codes) :]
        self.said += "\n".join(process.communicate(timeout=100)[0] for process in ended)
        assert [process.returncode for process in ended] == [*codes], self.said

    def reach(self, step: int) -> None:
        place = self.folder / "run/stages/toy/checkpoints"
        there = lambda: any(int(path.stem[5:]) >= step for path in place.glob("s*.ckpt"))  # noqa: E731
        until(lambda: there() or any(one.poll() for one in self.processes), "no checkpoint", 120)
        assert there()


@pytest.fixture
def starts(tmp_path: Path, start: Any) -> Starts:
    return Starts(tmp_path, start)


@pytest.fixture(scope="module")
def calm(tmp_path_factory: pytest.TempPathFactory, start: Any) -> dict[str, str]:
    """The files of the undisturbed training of two ranks."""
    starts = Starts(tmp_path_factory.mktemp("calm"), start)
    starts.nodes("toys.yaml", "-o", "run")
    starts.end_with(0, 0)
    return finished_files(starts.folder / "run/stages/toy")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("second", "said"),
    [
        (("toys.yaml", "--set", "toy.train.seed=1"), "toy.train.seed: 1 there, None here"),
        (("toys.yaml", "--set", "toy.train.steps=61"), "toy.train.steps: 61 there, 60 here"),
        (("toys.yaml", "-o", "elsewhere"), "the run folder: "),
        (("wider.yaml",), "toy.width: 9 there, 8 here"),
        (("toys.yaml", "--set", "hardware.devices=2"), "node 1 has hardware.nodes 2 and hardware.devices 2"),
        ({"MOTIONLOOM_STAGES": "toy_training_stage,other_version"}, "motionloom: 0.0 "),
    ],
)
def test_ranks_that_differ_are_named_before_anything_is_written(
    starts: Starts, second: Any, said: str
) -> None:
    starts.nodes("toys.yaml", second=second)
    starts.end_with(2, 2)
    assert said in starts.said and ("node 1 " in said or "rank 1 differs from rank 0 in " in starts.said)
    assert not [*starts.folder.glob("**/stages")]


@pytest.mark.slow
@pytest.mark.parametrize("apart", [False, NODES])
def test_torchrun_restarts_what_died_with_the_same_bytes(starts: Starts, calm: Any, apart: bool) -> None:
    nodes, each = (2, 1) if apart else (1, 2)
    with two_nodes() if apart else nullcontext([()]) as places:
        for number, place in enumerate(places, start=1):
            own, first = (f"10.77.0.{number}", "10.77.0.1") if apart else ("127.0.0.1", "127.0.0.1")
            meet = (f"--rdzv-endpoint={first}:{starts.port}", f"--local-addr={own}", "--rdzv-id=1")
            sizes = (f"--nnodes={nodes}", f"--nproc-per-node={each}", "--max-restarts=3")
            words = ("toys.yaml", "-o", "run", "--set", f"hardware.nodes={nodes}")
            words += ("--set", f"hardware.devices={each}")
            heals: dict[str, Any] = {"pause": 0.05, "TORCH_DISABLE_SHARE_RDZV_TCP_STORE": 1}
            starts(place, *TORCHRUN, *meet, *sizes, *RUN, *words, **heals)
        starts.reach(10)
        agent = starts.processes[-1].pid
        children = Path(f"/proc/{agent}/task/{agent}/children").read_text().split()
        os.kill(int(children[-1]), signal.SIGKILL)
        starts.end_with(*[0] * nodes)
    assert "resuming" in starts.said
    assert finished_files(starts.folder / "run/stages/toy") == calm


@pytest.mark.slow
@pytest.mark.parametrize("apart", [False, NODES])
def test_an_evicted_node_has_all_save_and_the_same_commands_go_on(
    starts: Starts, calm: Any, apart: bool
) -> None:
    with two_nodes() if apart else nullcontext(((), ())) as places:
        how = {"on": places, "address": "10.77.0.1" if apart else "127.0.0.1"}
        starts.nodes("toys.yaml", "-o", "run", pause=0.05, **how)
        starts.reach(10)
        starts.processes[-1].terminate()
        starts.end_with(SAVED, SAVED)
        starts.nodes("toys.yaml", "-o", "run", **how)
        starts.end_with(0, 0)
    assert finished_files(starts.folder / "run/stages/toy") == calm


@pytest.mark.slow
@pytest.mark.parametrize("dead", [0, 1])
def test_a_node_that_dies_is_named_by_the_other(starts: Starts, dead: int) -> None:
    starts.nodes("toys.yaml", "-o", "run", pause=0.05)
    starts.reach(5)
    starts.processes[dead].kill()
    starts.end_with(*[-signal.SIGKILL, LOST][:: 1 - 2 * dead])
    named = f": rank {dead} (process {starts.processes[dead].pid} on "
    assert named in starts.said and ".cpp:" not in starts.said


APART = (
    RECIPE.partition("stages:")[0].replace("devices: 1", "devices: 2")
    + """
stages:
  data: {kind: synth, clips: 24, min_seconds: 2.0, max_seconds: 5.0, layout: body133}
  stats: {kind: stats}
  toy:
    kind: vq
    net: {width: 16, depth: 1, code_dim: 8, num_codes: 16}
    train: {steps: 24, batch_size: 8, checkpoint_every: 2, validate_every: 12}
  tokens: {kind: tokens, inputs: {tokenizer: toy}, batch_frames: 256}
"""
)


@pytest.mark.slow
def test_machines_with_disks_of_their_own_have_all_by_the_mirror(starts: Starts) -> None:
    """Each is lost in turn with its disk, and the bytes are those of two that share one.

    Sums of more than two ranks depend on their order, so there are four.
    """
    (starts.folder / "toys.yaml").write_text(APART)
    starts.nodes("toys.yaml", "-o", "shared")
    starts.end_with(0, 0)
    words = [("toys.yaml", "--mirror", "mirror", "-o", run) for run in ("run", "own/run")]
    for lost in (1, 0):
        starts.processes.clear()
        starts.nodes(*words[0], second=words[1], pause=0.05)
        steps = [int(path.stem[5:]) for path in starts.folder.glob("run/stages/toy/checkpoints/s*.ckpt")]
        starts.reach(max(steps, default=0) + 4)
        starts.processes[lost - 2].kill()
        starts.end_with(*[-signal.SIGKILL, LOST][:: 1 - 2 * lost])
        shutil.rmtree(starts.folder / ("run", "own")[lost])
    starts.nodes(*words[0], second=words[1])
    starts.end_with(0, 0)
    for stage in ("data", "toy", "tokens"):
        assert finished_files(starts.folder / f"run/stages/{stage}") == finished_files(
            starts.folder / f"shared/stages/{stage}"
        )
    assert "fetched from" in starts.said and "resuming toy" in starts.said
    assert len([*starts.folder.glob("mirror/stages/*/artifact.json")]) == 4


@pytest.mark.parametrize(
    ("given", "nodes", "said"),
    [
        ("", 2, "NODE_RANK not set and MASTER_ADDR not set"),
        ("NODE_RANK=2 MASTER_ADDR=a", 2, "NODE_RANK 2 and"),
        ("NODE_RANK=1", 1, r"hardware.nodes is 1"),
        ("JOB_COMPLETION_INDEX=1", 2, "NODE_RANK 1 and MASTER_ADDR not set"),
        ("SKYPILOT_NODE_RANK=3 SKYPILOT_NODE_IPS=10.0.0.1\n10.0.0.2", 2, "MASTER_ADDR 10.0.0.1:"),
        ("RANK=0 TORCHELASTIC_MAX_RESTARTS=1 TORCHELASTIC_USE_AGENT_STORE=True", 2, "TORCH_DISABLE_SHARE"),
    ],
)
def test_places_that_cannot_be_are_refused(
    given: str, nodes: int, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("NODE_RANK", "MASTER_ADDR", "MASTER_PORT"):
        monkeypatch.setenv(name, "")  # what is taken up is gone behind the test
        monkeypatch.delenv(name)
    for name, _, value in (word.partition("=") for word in given.split(" ") if word):
        monkeypatch.setenv(name, value)
    take_place(nodes)
    with pytest.raises(UserError, match=said):
        Team.start(Hardware(accelerator="cpu", devices=1, nodes=nodes))
