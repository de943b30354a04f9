"""A training under SLURM leaves requeueing to the run itself, which resumes whatever happens."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
from lightning.fabric.plugins.environments.lightning import LightningEnvironment
from lightning.fabric.plugins.environments.slurm import SLURMEnvironment
from rich.console import Console

from motionloom.pipeline.run import run_recipe
from motionloom.pipeline.team import environment

RECIPE = """
name: x
hardware: {accelerator: cpu, threads: 1, convert_workers: 1}
stages:
  data: {kind: synth, clips: 16}
  stats: {kind: stats}
  tokenizer:
    kind: vq
    net: {width: 8, depth: 1, code_dim: 8, num_codes: 8}
    train: {steps: 2, batch_size: 4, validate_every: 0}
"""


@pytest.fixture
def slurm(monkeypatch: pytest.MonkeyPatch) -> None:
    """What `srun --ntasks 1` says to its task."""
    for name in ("PROCID", "LOCALID", "NODEID"):
        monkeypatch.setenv(f"SLURM_{name}", "0")
    for name in ("NTASKS", "STEP_NUM_TASKS", "NNODES", "JOB_ID"):
        monkeypatch.setenv(f"SLURM_{name}", "1")
    monkeypatch.setenv("SLURM_JOB_NAME", "train")


def test_a_checkpoint_of_lightnings_requeueing_is_not_taken_up(
    slurm: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "hpc_ckpt_1.ckpt").write_bytes(b"of another stage")
    (tmp_path / "x.yaml").write_text(RECIPE)
    before = signal.getsignal(signal.SIGUSR1)
    run = run_recipe(tmp_path / "x.yaml", tmp_path / "run", console=Console(quiet=True))
    assert (run / "stages/tokenizer/model.safetensors").is_file()
    assert signal.getsignal(signal.SIGUSR1) == before


def test_the_environment_is_slurms_only_under_srun(slurm: None, monkeypatch: pytest.MonkeyPatch) -> None:
    assert isinstance(environment(), LightningEnvironment), "alone"
    monkeypatch.setenv("SLURM_NTASKS", "2")
    monkeypatch.setenv("SLURM_NTASKS_PER_NODE", "2")
    assert isinstance(environment(), LightningEnvironment), "one process of a script that may use two"
    monkeypatch.setenv("SLURM_STEP_NUM_TASKS", "2")
    monkeypatch.setenv("SLURM_JOB_NAME", "interactive")  # srun inside salloc
    found = environment()
    assert isinstance(found, SLURMEnvironment) and not found.auto_requeue
    with monkeypatch.context() as inside:
        for name in ("TORCHELASTIC_RUN_ID", "RANK", "GROUP_RANK", "LOCAL_RANK", "LOCAL_WORLD_SIZE"):
            inside.setenv(name, "0")
        assert environment() is None, "torchrun inside SLURM"
    monkeypatch.delenv("SLURM_NTASKS")
    assert environment() is None
