"""Columns that a clip does not hold change no loss, gradient or codebook, whatever stands in them."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from motionloom.datasets.conditions import Condition
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.diffusion.module import TextDenoiserModule
from motionloom.models.diffusion.network import TextDenoiserConfig
from motionloom.models.tma.module import TmaModule
from motionloom.models.tma.network import Tma, TmaConfig
from motionloom.models.tokenizer.base import TokenizerConfig
from motionloom.models.tokenizer.body_hand import H2VQConfig, SeparateConfig
from motionloom.models.tokenizer.module import TokenizerModule
from motionloom.models.tokenizer.single import FsqConfig, RvqConfig, VqConfig
from motionloom.models.training.stage_module import OptimConfig, StageModule
from motionloom.pipeline.baselines.mdm.network import Mdm

LAYOUT = MotionLayout.named("wholebody363")
SMALL: dict[str, Any] = {"width": 8, "depth": 1, "code_dim": 8, "velocity_weight": 0.5}
BOOK: dict[str, Any] = {**SMALL, "num_codes": 8, "reset_below": 0.1}
CONFIGS: dict[str, TokenizerConfig] = {
    "h2vq": H2VQConfig(**BOOK),
    "separate": SeparateConfig(**BOOK),
    "vq all": VqConfig(**BOOK, part="all"),
    "rvq bodyhand": RvqConfig(**BOOK, part="bodyhand"),
    "fsq": FsqConfig(**SMALL, steps=(4, 4)),
}
HELD = [3, 1, 2, 0]
LENGTH = torch.tensor([16, 12, 16, 9])


def module_of(config: TokenizerConfig) -> TokenizerModule:
    torch.manual_seed(0)
    net = config.build(LAYOUT)
    return TokenizerModule(net, OptimConfig(), seed=0, max_steps=1)


def batch_of(columns: Tensor, present: list[int], garbage: float = 0.0) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(5)
    motion = torch.randn(len(present), 16, len(columns), generator=generator)
    mask = torch.from_numpy(LAYOUT.present_columns[present])[:, columns]
    motion = torch.where(mask[:, None], motion, garbage * (1 + motion))
    return {"motion": motion, "length": LENGTH[: len(present)], "present": mask}


def trained(module: StageModule, batches: list[dict[str, Tensor]]) -> tuple[list[dict], list, dict]:
    """Losses of each batch, gradients of the last, and all weights and buffers after it."""
    losses = []
    for batch in batches:
        module.zero_grad()
        torch.manual_seed(3)
        values = module.losses(batch)
        values["loss"].backward()
        losses.append({k: v.detach().clone() for k, v in values.items()})
    return losses, [p.grad for p in module.parameters()], module.state_dict()


def same(one: Any, other: Any) -> None:
    torch.testing.assert_close(one, other, rtol=0, atol=0)


@pytest.mark.parametrize("kind", list(CONFIGS))
def test_garbage_in_missing_columns_changes_nothing(kind: str) -> None:
    runs = []
    for garbage in (0.0, 50.0):
        module = module_of(CONFIGS[kind])
        columns = module.net.columns
        batches = [batch_of(columns, present, garbage) for present in (HELD, [1, 2, 0, 0], HELD[::-1])]
        runs.append((*trained(module, batches), module.net.encode(**encode_arguments(batches[0]))))
    same(*runs)
    assert all(grad is not None for grad in runs[0][1])
    told = [batch_of(columns, [3, 3, 3, 3])] * 2
    untold = [{"motion": one["motion"], "length": one["length"]} for one in told]
    same(*(trained(module_of(CONFIGS[kind]), batches) for batches in (told, untold)))


def encode_arguments(batch: dict[str, Tensor]) -> dict[str, Tensor]:
    return {"x": batch["motion"], "length": batch["length"], "present": batch["present"]}


@pytest.mark.parametrize("kind", ["h2vq", "separate"])
def test_a_batch_without_hands_teaches_the_hands_nothing(kind: str) -> None:
    module = module_of(CONFIGS[kind])
    columns = module.net.columns
    trained(module, [batch_of(columns, HELD)])
    book = module.net.codebooks()["hand"]
    before = {k: v.clone() for k, v in book.state_dict().items() if k != "draws"}  # type: ignore[attr-defined]
    losses, _, _ = trained(module, [batch_of(columns, [0, 2, 0])])
    after = {k: v for k, v in book.state_dict().items() if k != "draws"}  # type: ignore[attr-defined]
    torch.testing.assert_close(after, before, rtol=1e-6, atol=0)
    assert losses[0]["resets_hand"] == 0 and losses[0]["penalty_hand"] == 0
    for name, parameter in module.net.named_parameters():
        if "hand_encoder" in name or "encoders.hand" in name or "decoders.hand" in name:
            assert (parameter.grad == 0).all(), name


def captioned(present: list[int], columns: Tensor) -> dict[str, Tensor]:
    size = len(present)
    torch.manual_seed(2)
    return batch_of(columns, present) | {
        "conditions": {
            "text": Condition(
                torch.randn(size, 3, 6), torch.ones(size, 3, dtype=torch.bool), torch.randn(size, 6)
            )
        },
        "similarity": torch.eye(size, 6),
    }


@pytest.mark.parametrize("kind", ["tma", "diffusion"])
def test_missing_columns_are_not_reconstructed(kind: str) -> None:
    columns = torch.from_numpy(LAYOUT.part("bodyhand"))
    torch.manual_seed(0)
    module: StageModule
    if kind == "tma":
        net = Tma(TmaConfig(latent=8, ff=8, layers=1, heads=2, dropout=0, attention_dropout=0), 313, 6)
        module, bias = TmaModule(net, OptimConfig(), seed=0, max_steps=1), net.motion_decoder.out.bias
    else:
        denoiser = Mdm(TextDenoiserConfig(dim=8, ff=8, layers=1, heads=2), 313, 6)
        module = TextDenoiserModule(denoiser, OptimConfig(), seed=0, max_steps=1)
        bias = next(p for p in denoiser.parameters() if p.shape == (313,))
    hand = torch.from_numpy(LAYOUT.part("hand"))
    losses, _, _ = trained(module, [captioned([0, 2, 0, 2], columns)])
    assert bias.grad is not None and (bias.grad[hand] == 0).all() and bias.grad[:60].abs().min() > 0
    told = captioned([3, 3, 3, 3], columns)
    whole, _, _ = trained(module, [told])
    del told["present"]
    same(trained(module, [told])[0], whole)
    assert torch.isfinite(losses[0]["loss"]) and losses[0]["loss"] != whole[0]["loss"]
