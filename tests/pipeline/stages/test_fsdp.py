"""FSDP for the GPT: two gloo processes that share the weights train what two with all of them train.

Both go through `fit`, with everything on that can differ: dropout, dropped text, alignment with Gumbel draws,
clipping of the gradient, validation, checkpoints. The processes run this file as a script.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from pydantic import ValidationError
from rich.console import Console
from safetensors.torch import load_file, save_file
from tiny_adversaries import Steps, context
from torch import Tensor
from two_ranks import pair_of, work

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.gpt.losses import GptLossConfig
from motionloom.models.gpt.module import GptModule
from motionloom.models.gpt.network import GptConfig, InterleavedGPT
from motionloom.models.gpt.tokens import interleave
from motionloom.models.tma.network import Tma, TmaConfig
from motionloom.models.tokenizer.body_hand import H2VQConfig
from motionloom.models.training.stage_module import OptimConfig
from motionloom.pipeline.contract.fingerprint import fingerprint_fields
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.stages.networks.gpt import GptStageConfig
from motionloom.pipeline.stages.networks.tma import TmaStageConfig
from motionloom.pipeline.stages.networks.tokenizer import stage_config
from motionloom.pipeline.store.training_log import read_training_log
from motionloom.pipeline.training.config import TrainConfig
from motionloom.pipeline.training.trainer import fit

STEPS, BATCH = 8, 8
CLIP = 0.5  # below the norms met here


class Tokens(Steps):
    """Random token sequences of a network."""

    def __init__(self, net: InterleavedGPT, *place: Any, **options: Any) -> None:
        super().__init__(*place, **options)
        self.net = net

    def made(self, step: int, part: int) -> dict[str, Tensor]:
        generator = torch.Generator().manual_seed(step)
        codes = {
            "body": torch.randint(9, (self.batch, 8), generator=generator),
            "hand": torch.randint(9, (self.batch, 4), generator=generator),
        }
        groups = torch.randint(1, 5, (self.batch,), generator=generator)
        tokens, kinds, length = interleave(codes, self.net.pattern, ends=self.net.num_codes, groups=groups)
        text = torch.randn(self.batch, 16, generator=generator)
        sentence = torch.randn(self.batch, 6, generator=generator)
        batch = {"tokens": tokens, "kinds": kinds, "length": length, "text": text, "similarity": sentence}
        return {name: value[self.rows] for name, value in batch.items()}


def train(folder: Path, **settings: Any) -> None:
    """A stage of 8 steps in `folder`, from its newest checkpoint; the lead leaves `weights.safetensors`."""
    torch.manual_seed(0)
    book = H2VQConfig(width=8, depth=1, code_dim=8, num_codes=9).build(MotionLayout.named("wholebody313"))
    tma = Tma(TmaConfig(latent=16, ff=16, layers=1, heads=2), 313, 6)
    # An odd width: not every weight divides by two ranks.
    config = GptConfig(layers=2, dim=18, heads=2, ff=25, block_size=17, pkeep=0.8)
    net = InterleavedGPT(config, book.streams, book.pattern, text_dim=16)
    module = GptModule(
        net, OptimConfig(lr=1e-2, warmup_steps=2, grad_clip=CLIP), seed=0, max_steps=STEPS,
        loss=GptLossConfig(), tokenizer=book, tma=tma,
    )  # fmt: skip
    given = {"steps": STEPS, "batch_size": BATCH, "checkpoint_every": 4, "validate_every": 4, **settings}
    stage = context(folder, Console(quiet=True), devices=2)
    fit(
        stage,
        module,
        TrainConfig.model_validate(given),
        lambda *place: Tokens(net, *place),
        lambda: Tokens(net, 4, size=2),
    )
    assert module.net is net
    if torch.distributed.get_rank() == 0:
        save_file(net.state_dict(), folder / "weights.safetensors")


def resume(source: Path, folder: Path, **settings: Any) -> None:
    """Continue `source` behind step 4 in another folder."""
    if os.environ["RANK"] == "0":
        checkpoint = next((source / "checkpoints").glob("*0004.ckpt"))
        (folder / "checkpoints").mkdir(parents=True)
        shutil.copy(checkpoint, folder / "checkpoints" / checkpoint.name)
    torch.distributed.barrier()
    train(folder, **settings)


def worker(out: Path) -> None:
    train(out / "ddp")
    train(out / "fsdp", strategy="fsdp")
    resume(out / "fsdp", out / "resumed", strategy="fsdp")
    resume(out / "fsdp", out / "fsdp-ddp")
    train(out / "parts-ddp", accumulate=2)
    train(out / "parts-fsdp", accumulate=2, strategy="fsdp")
    train(out / "half-ddp", precision="bf16-mixed")
    train(out / "half-fsdp", precision="bf16-mixed", strategy="fsdp")


out = pair_of(__file__)


def weights(folder: Path) -> dict[str, Tensor]:
    return load_file(folder / "weights.safetensors")


@pytest.mark.slow
@pytest.mark.timeout(240)
@pytest.mark.parametrize(
    ("one", "two", "tolerance"),
    [
        ("ddp", "fsdp", 1e-5),
        ("fsdp", "resumed", 0.0),
        ("ddp", "fsdp-ddp", 1e-5),
        ("parts-ddp", "parts-fsdp", 1e-5),
        # A sum in another order may round to the next bfloat16.
        ("half-ddp", "half-fsdp", 2e-2),
    ],
)
def test_same_weights_and_log(out: Path, one: str, two: str, tolerance: float) -> None:
    first, second = weights(out / one), weights(out / two)
    assert first.keys() == second.keys()
    # The bias of attention keys has no effect and no true gradient: AdamW makes steps of its rounding errors.
    for name, value in first.items():
        assert second[name].shape == value.shape
        if tolerance == 0:
            assert torch.equal(second[name], value), name
        elif name.endswith("attention.qkv.bias"):
            query, _, values = (second[name] - value).chunk(3)
            assert max(query.abs().max(), values.abs().max()) < tolerance, name
        else:
            assert (second[name] - value).abs().max() < tolerance, name
    rows = [read_training_log(out / folder) for folder in (one, two)]
    assert [row["step"] for row in rows[0]] == [row["step"] for row in rows[1]] == [4, 8]
    for before, after in zip(*rows, strict=True):
        assert after == pytest.approx(before, rel=max(tolerance, 1e-6) * 10), (one, two)


@pytest.mark.slow
def test_training_changed_something(out: Path) -> None:
    """Otherwise all of the above would be equal for nothing."""
    state = torch.load(next((out / "fsdp/checkpoints").glob("*0004.ckpt")), weights_only=True)["state_dict"]
    for name, value in weights(out / "fsdp").items():
        assert not torch.equal(state[f"net.{name}"], value), name
    assert not torch.equal(
        weights(out / "half-fsdp")["text_in.weight"], weights(out / "fsdp")["text_in.weight"]
    )


TWO = Hardware(accelerator="cpu", devices=2)


def test_the_strategy_is_no_part_of_the_fingerprint() -> None:
    plain, cut = GptStageConfig(train=TrainConfig()), GptStageConfig(train=TrainConfig(strategy="fsdp"))
    assert fingerprint_fields(plain) == fingerprint_fields(cut)
    with pytest.raises(ValidationError):
        Hardware.model_validate({"strategy": "fsdp"})


@pytest.mark.parametrize(
    ("build", "train", "message"),
    [
        (TmaStageConfig, {}, "for gpt stages"),
        (stage_config(H2VQConfig()), {}, "codebooks must be whole"),
        (GptStageConfig, {"compile": True}, "train.compile makes one graph"),
    ],
)
def test_what_cannot_be_cut_is_refused(
    build: Callable[..., Any], train: dict[str, Any], message: str
) -> None:
    with pytest.raises(UserError, match=message):
        build(train=TrainConfig(strategy="fsdp", **train)).require_fit(TWO)


if __name__ == "__main__":
    work(worker)
