"""Text-motion alignment stage; without InfoNCE it is TEMOS, of the face the facial cVAE (HumanTOMATO 3.5,
B.5.1, D).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import model_validator

from motionloom.datasets.base.errors import UserError
from motionloom.models.tma.losses import TmaLossConfig
from motionloom.models.tma.network import Tma, TmaConfig
from motionloom.pipeline.contract.generation import GenerationRequest, MotionGenerator
from motionloom.pipeline.contract.showing import Curve
from motionloom.pipeline.contract.stage import (
    ALIGNMENT,
    FACE_ALIGNMENT,
    GENERATOR,
    CompletedStage,
    Inputs,
    Stage,
    filled_by,
    register,
)
from motionloom.pipeline.inference.generators.base import WholeMotion
from motionloom.pipeline.stages.networks.captions import (
    CaptionInputs,
    CaptionStage,
    CaptionStageConfig,
    part_columns,
    part_of,
)
from motionloom.pipeline.store.networks import LoadedTma
from motionloom.pipeline.store.weights import ModelFacts
from motionloom.pipeline.training.config import TrainConfig
from motionloom.pipeline.training.warm_start import require_same_start, require_start_layout

_FREE = frozenset({"dropout", "attention_dropout", "text_dropout", "text_noise"})
"""Settings that are of the training and not of the network: another one may go on with others."""


class TmaStageConfig(CaptionStageConfig):
    """Motion and text encoders in one latent space."""

    net: TmaConfig = TmaConfig()
    loss: TmaLossConfig = TmaLossConfig()
    train: TrainConfig = TrainConfig(steps=50_000, batch_size=256)
    part: Literal["bodyhand", "face"] = "bodyhand"
    """The aligned columns; `face` takes the face captions. Without InfoNCE (`loss.contrastive: 0`) it is
    TEMOS, or, of the face, the paper's facial cVAE (B.5.1)."""

    @model_validator(mode="after")
    def _faces_have_every_frame(self) -> TmaStageConfig:
        if self.part == "face" and self.net.frame_stride != 1:
            raise ValueError("a face is generated frame by frame: net.frame_stride must be 1 with part: face")
        return self


class TmaInputs(CaptionInputs):
    """Captioned clips, and a TMA to go on from."""

    start: LoadedTma | None = filled_by("tma")


class TmaStage(CaptionStage[TmaStageConfig, TmaInputs, Tma]):
    """Motion and text encoders, trained on whole clips and their captions."""

    name = "tma"
    summary = "text-motion alignment"
    trainer = "motionloom.models.tma.module:TmaModule"
    config = TmaStageConfig
    inputs = TmaInputs
    curves = (Curve("contrastive"), Curve("loss"))

    def gives(self, config: TmaStageConfig) -> frozenset[str]:
        """One space for text and motion, or for text and faces; without InfoNCE motion of text: the facial
        cVAE (B.5.1), and TEMOS (4.1.2), whose latents are compared with TMA's.
        """
        names = super().gives(config)
        if config.loss.contrastive == 0:
            names |= {GENERATOR}
        if config.part != "face":
            return names | {ALIGNMENT}
        return names if config.loss.contrastive == 0 else names | {FACE_ALIGNMENT}

    def check(self, stage: Stage, others: Mapping[str, Stage]) -> None:
        """A TMA that it starts from must be the same network, over the same text and statistics."""
        require_same_start(stage, others, _FREE, ("stats", "text"))

    def facts(self, config: TmaStageConfig, inputs: TmaInputs) -> ModelFacts:
        layout = inputs.data.layout
        if inputs.start is not None:
            require_start_layout(layout, inputs.start.layout)
        part_columns(layout, config.part)
        extra = {"text_dim": inputs.text.dim, "max_frames": config.max_frames, "part": config.part}
        return ModelFacts.of(self.name, config.net, layout, extra)

    def network(self, facts: ModelFacts, inputs: TmaInputs) -> Tma:
        layout = facts.layout.layout()
        part = part_of(facts)
        if not layout.has_part(part):
            raise UserError(f"{facts.where}: layout {layout.name} has no {part} columns; run the stage again")
        config = TmaConfig.parse(facts.config, facts.where)
        return Tma.of_layout(config, layout, part, facts.fact("text_dim", int))

    def prepare(self, config: TmaStageConfig, net: Tma, inputs: TmaInputs) -> None:
        """The coordinates it reads depend on how features are normalised; or all comes from a start."""
        if inputs.start is not None:
            net.load_state_dict(inputs.start.net.state_dict())
        elif net.basis is not None:
            columns = part_columns(inputs.data.layout, config.part)
            stats = inputs.stats
            net.basis.learn(stats.mean[columns], stats.std[columns])

    def loaded(self, net: Tma, facts: ModelFacts, inputs: TmaInputs) -> LoadedTma:
        frames = facts.fact("max_frames", int)
        part = part_of(facts)
        return LoadedTma(net, facts.layout.layout(), frames, part, inputs)

    def generator(self, stage: CompletedStage, given: Inputs, device: torch.device) -> MotionGenerator:
        tma: LoadedTma = self.load(stage, given, device)
        return VaeMotion(tma.layout, tma.part, given, tma)


@dataclass(frozen=True)
class VaeMotion(WholeMotion):
    """One latent of the text, decoded to all frames at once: TEMOS, and the facial cVAE (B.5.1)."""

    tma: LoadedTma
    who = "this VAE"
    method = "vae"
    settings = frozenset({"temperature"})

    def normalised(self, request: GenerationRequest, frames: Sequence[int]) -> list[NDArray[np.float32]]:
        """The latent is drawn from the text's Gaussian; temperature scales its width. Of a network that
        writes every n-th frame, those between are on the straight line.
        """
        device = self.tma.device
        net = self.tma.net
        text = request.text(self.who)
        mu, logvar = net.encode_text(text.features.to(device), text.mask.to(device))
        draws = [torch.Generator().manual_seed(seed) for seed in request.seeds]
        noise = torch.stack([torch.randn(mu.shape[1], generator=draw) for draw in draws])
        z = mu + request.sampling.temperature * (0.5 * logvar).exp() * noise.to(device)
        made = net.decode(z, torch.tensor(list(frames)).to(device), max(frames))
        stride = net.config.frame_stride
        return [between(made[row].cpu().numpy(), count, stride) for row, count in enumerate(frames)]


def between(values: NDArray[np.float32], frames: int, stride: int) -> NDArray[np.float32]:
    """Every `stride`-th frame [L, D] to `frames` frames [T, D]: linear between, constant after the last."""
    if stride == 1:
        return values[:frames]
    last = (frames - 1) // stride
    at = np.minimum(np.arange(frames) / stride, last)
    low = at.astype(int)
    high = np.minimum(low + 1, last)
    share = (at - low)[:, None].astype(values.dtype)
    out: NDArray[np.float32] = values[low] * (1 - share) + values[high] * share
    return out


register(TmaStage())
