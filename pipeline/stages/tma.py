"""Text-motion alignment stage; without InfoNCE it is TEMOS, of the face the facial cVAE (HumanTOMATO 3.5,
B.5.1, D).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field, model_validator
from torch import nn
from torch.utils.data import Dataset

from motionloom.datasets.loading.batches import CaptionBatches, EvalBatches
from motionloom.datasets.motion.layout import MotionLayout, Part
from motionloom.datasets.schema import UserError
from motionloom.models.tma.losses import TmaLossConfig
from motionloom.models.tma.network import Tma, TmaConfig
from motionloom.pipeline.contract.generation import GenerationRequest, MotionGenerator
from motionloom.pipeline.contract.showing import Curve
from motionloom.pipeline.contract.stage import ALIGNMENT, FACE_ALIGNMENT, GENERATOR, Finished, Given, Stage
from motionloom.pipeline.stages.examples import caption_example
from motionloom.pipeline.stages.same_text import same_encoder
from motionloom.pipeline.stages.starting import START, require_same_start, require_start_layout
from motionloom.pipeline.stages.train_config import TrainConfig, TrainedStageConfig
from motionloom.pipeline.stages.trained import Batches, Example, Say, TrainedStage
from motionloom.pipeline.store.networks import LoadedTma
from motionloom.pipeline.store.text import TextSource
from motionloom.pipeline.store.weights import LayoutFacts, ModelFacts

if TYPE_CHECKING:
    from motionloom.models.tma.module import TmaModule

_FREE = frozenset({"dropout", "attention_dropout", "text_dropout", "text_noise"})
"""Settings that are of the training and not of the network: another one may go on with others."""


class TmaStageConfig(TrainedStageConfig):
    """Motion and text encoders in one latent space."""

    net: TmaConfig = TmaConfig()
    loss: TmaLossConfig = TmaLossConfig()
    train: TrainConfig = TrainConfig(steps=50_000, batch_size=256)
    max_frames: int = Field(196, ge=8)
    """Longer clips are cropped at random."""
    min_frames: int = Field(16, ge=1)
    """Shorter clips are left out."""
    part: Literal["bodyhand", "face"] = "bodyhand"
    """What is aligned; `face` takes the face captions. Without InfoNCE (`loss.contrastive: 0`) it is TEMOS,
    or, of the face, the paper's facial cVAE (B.5.1)."""

    @model_validator(mode="after")
    def _faces_have_every_frame(self) -> TmaStageConfig:
        if self.part == "face" and self.net.frame_stride != 1:
            raise ValueError("a face is generated frame by frame: net.frame_stride must be 1 with part: face")
        return self


def part_columns(layout: MotionLayout, part: Part) -> NDArray[np.int64]:
    """Columns of one part of a layout, which must have it."""
    if not layout.has_part(part):
        raise UserError(f"layout {layout.name} has no {part} columns; choose another part or data set")
    return layout.part(part)


class TmaStage(TrainedStage):
    """Motion and text encoders, trained on whole clips and their captions."""

    name = "tma"
    summary = "text-motion alignment"
    config = TmaStageConfig
    takes = ("data", "stats", "text", "rewordings?", "start?: tma")
    version = 2  # the filter of negatives is sBERT's

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
        require_same_start(stage, others, _FREE)
        start = others.get(stage.inputs.get(START, ""))
        if start is not None and not same_encoder(start.inputs.get("text", ""), stage.inputs["text"], others):
            raise UserError(
                f"stage '{stage.name}' starts from '{start.name}', which reads captions of another text "
                f"encoder; give '{stage.inputs['text']}' the encoder of '{start.inputs['text']}'"
            )

    def facts(self, config: TmaStageConfig, given: Given) -> ModelFacts:
        """Config, layout and the widths of both sides."""
        layout = given["data"].layout
        if START in given:
            require_start_layout(layout, given[START].layout)
        part_columns(layout, config.part)
        extra = {"text_dim": given["text"].dim, "max_frames": config.max_frames, "part": config.part}
        return ModelFacts(kind="tma", config=config.net.dump(), layout=LayoutFacts.of(layout), extra=extra)

    def network(self, facts: ModelFacts, given: Given) -> Tma:
        """Both encoders and the decoder."""
        layout, part = facts.layout.layout(), facts.extra.get("part", "bodyhand")
        if part not in get_args(Part) or not layout.has_part(part):
            raise UserError(
                f"{facts.where}: key 'extra.part' = {part!r} is no part of layout {layout.name}; "
                "run or export the stage again"
            )
        config = TmaConfig.parse(facts.config, facts.where)
        return Tma.of_layout(config, layout, part, facts.fact("text_dim", int))

    def prepare(self, config: TmaStageConfig, net: Tma, given: Given) -> None:
        """The coordinates it reads depend on how features are normalised; or all comes from a start."""
        if START in given:
            net.load_state_dict(given[START].net.state_dict())
        elif net.basis is not None:
            columns, stats = part_columns(given["data"].layout, config.part), given["stats"]
            net.basis.learn(stats.mean[columns], stats.std[columns])

    def module(self, config: TmaStageConfig, net: Any, given: Given, seed: int) -> TmaModule:
        """Reconstruction, KL, latents and InfoNCE."""
        from motionloom.models.tma.module import TmaModule

        return TmaModule(net, config.optim, seed=seed, max_steps=config.train.steps, loss=config.loss)

    def batches(self, config: TmaStageConfig, net: nn.Module, given: Given, seed: int, say: Say) -> Batches:
        """Whole clips with one caption each."""
        return caption_batches(config, given, seed)

    def example(self, config: TmaStageConfig, net: Any, given: Given, batch: int) -> Example:
        """The longest clips with captions of usual length."""
        return caption_example(batch, config.max_frames, net.motion_dim, net.text_dim)

    def loaded(self, net: Tma, facts: ModelFacts, given: Given) -> LoadedTma:
        """The model with the statistics of its motion."""
        frames, part = facts.fact("max_frames", int), facts.extra.get("part", "bodyhand")
        return LoadedTma(net, facts.layout.layout(), frames, part, given)

    def generator(self, stage: Finished, given: Given, device: torch.device) -> MotionGenerator:
        """The facial cVAE, or TEMOS."""
        return VaeMotion(self.load(stage, given, device))

    def exported(self, config: Any) -> tuple[str, ...]:
        """Statistics, and the encoder of its words."""
        return ("stats", "text")

    def curves(self, config: Any) -> tuple[Curve, ...]:
        """InfoNCE and the whole."""
        return (Curve("contrastive"), Curve("loss"))


def caption_batches(config: Any, given: Given, seed: int) -> Batches:
    """Captioned clips of one part: `config` has `part`, `max_frames` and `min_frames`."""
    data, stats, text = given["data"], given["stats"], given["text"].cache
    dataset = data.split("train", training=True)
    columns = part_columns(dataset.layout, config.part)
    frames = {"max_frames": config.max_frames, "min_frames": config.min_frames}
    face = config.part == "face"

    def train(batch: int, rank: int, world: int) -> Dataset[Any]:
        return CaptionBatches(
            dataset, stats, text, batch_size=batch, seed=seed, rank=rank, world=world, face=face,
            columns=columns, rewordings=given.get("rewordings"), **frames,
        )  # fmt: skip

    def validation() -> Dataset[Any]:
        return EvalBatches(data.held_out(), stats, text, batch_size=32, face=face, columns=columns, **frames)

    return Batches(train, validation)


@dataclass(frozen=True)
class VaeMotion:
    """One latent of the text, decoded to all frames at once: TEMOS, and the facial cVAE (B.5.1)."""

    tma: LoadedTma
    method = "vae"
    modalities = frozenset({"text"})
    settings = frozenset({"temperature"})
    unit_frames = 1
    max_frames = None

    @property
    def layout(self) -> MotionLayout:
        """Layout of whole frames."""
        return self.tma.layout

    @property
    def part(self) -> Part:
        """The columns that it reads and writes."""
        return self.tma.part

    @property
    def text(self) -> TextSource | None:
        """What encodes its words."""
        text: TextSource | None = self.tma.given.get("text")
        return text

    @torch.no_grad()
    def generate(self, request: GenerationRequest) -> list[NDArray[np.float32]]:
        """The latent is drawn from the text's Gaussian; temperature scales its width. Of a network that
        writes every n-th frame, those between are on the straight line.
        """
        if request.frames is None:
            raise UserError(
                "this VAE makes a motion of a length that it is given, and none was; give --seconds, or to "
                "evaluate it lengths: recorded"
            )
        frames, seeds, device, net = request.frames, request.seeds, self.tma.device, self.tma.net
        text = request.text("this VAE")
        mu, logvar = net.encode_text(text.features.to(device), text.mask.to(device))
        noise = torch.stack(
            [torch.randn(mu.shape[1], generator=torch.Generator().manual_seed(seed)) for seed in seeds]
        )
        z = mu + request.sampling.temperature * (0.5 * logvar).exp() * noise.to(device)
        made = net.decode(z, torch.tensor(list(frames)).to(device), max(frames))
        columns, stride = self.layout.part(self.part), net.config.frame_stride
        values = [between(made[row].cpu().numpy(), count, stride) for row, count in enumerate(frames)]
        return [np.asarray(self.tma.stats.denormalize(v, columns), dtype=np.float32) for v in values]


def between(values: NDArray[np.float32], frames: int, stride: int) -> NDArray[np.float32]:
    """Every `stride`-th frame [L, D] to `frames` frames [T, D]: linear between, constant behind the last."""
    if stride == 1:
        return values[:frames]
    last = (frames - 1) // stride
    at = np.minimum(np.arange(frames) / stride, last)
    low = at.astype(int)
    high = np.minimum(low + 1, last)
    share = (at - low)[:, None].astype(values.dtype)
    out: NDArray[np.float32] = values[low] * (1 - share) + values[high] * share
    return out
