"""A complete stage in one file: motion paced by music, trained by a generator and a discriminator of its own.

`tests/pipeline/contract/test_new_stage.py` runs it. `MOTIONLOOM_STAGES=pacer_stage` names the module, and a
recipe says `kind: pacer`; nothing else knows of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypedDict

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor, nn
from torch.utils.data import Dataset

from motionloom.datasets.base.randomness import uniform
from motionloom.datasets.loading.plan import BatchPlan
from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.modalities.modality import FrameStats
from motionloom.datasets.motion.layout import MotionLayout, Part
from motionloom.datasets.schema import Config, UserError
from motionloom.datasets.shards.clips import ClipDataset
from motionloom.models.training.optim import OptimConfig
from motionloom.models.training.players import Player, PlayersModule
from motionloom.pipeline.contract.generation import GenerationRequest, MotionGenerator
from motionloom.pipeline.contract.showing import Curve
from motionloom.pipeline.contract.stage import GENERATOR, Finished, Inputs, register
from motionloom.pipeline.store.data import Data
from motionloom.pipeline.store.weights import LayoutFacts, ModelFacts
from motionloom.pipeline.training.config import TrainConfig, TrainedStageConfig
from motionloom.pipeline.training.trained_stage import Batches, Example, Log, TrainedStage

PART: Part = "bodyhand"


class PacerNetConfig(Config):
    """Sizes of the generator."""

    width: int = Field(32, ge=1)
    noise: int = Field(4, ge=1)
    """Width of the noise that tells two motions to one song apart."""


class PacerConfig(TrainedStageConfig):
    """A recipe's `kind: pacer`. `optim` and `train` come with the base class."""

    net: PacerNetConfig = PacerNetConfig()
    critic: OptimConfig = OptimConfig(lr=2e-4)
    adversarial: float = Field(0.1, ge=0)
    """Weight of what the critic says."""
    window: int = Field(32, ge=8)
    """Frames of a training window; shorter clips are left out."""
    train: TrainConfig = TrainConfig(steps=1000, batch_size=16)


def convolutions(inputs: int, width: int, outputs: int) -> nn.Sequential:
    """[B, inputs, T] -> [B, outputs, T]"""
    first, second = (nn.Conv1d(size, width, 9, padding=4) for size in (inputs, width))
    return nn.Sequential(first, nn.SiLU(), second, nn.SiLU(), nn.Conv1d(width, outputs, 1))


class Pacer(nn.Module):
    """Music [B, T, A] and noise [B, Z] to motion [B, T, D], both normalised."""

    def __init__(self, config: PacerNetConfig, audio: int, motion: int) -> None:
        super().__init__()
        self.audio, self.motion, self.noise = audio, motion, config.noise
        self.layers = convolutions(audio + config.noise, config.width, motion)

    def forward(self, audio: Tensor, noise: Tensor) -> Tensor:
        """The same noise in every frame."""
        made: Tensor = self.layers(torch.cat([audio, noise[:, None].expand(-1, audio.shape[1], -1)], -1).mT)
        return made.mT


class PacerBatch(TypedDict):
    """Windows of motion and the music that goes with them, frame for frame."""

    motion: Tensor
    """[B, window, D]"""
    audio: Tensor
    """[B, window, A]"""
    length: Tensor
    """[B]; all the window. A module counts the rows of a validation batch by it."""


class PacerInputs(Inputs):
    """What it takes: a role for each attribute."""

    data: Data
    stats: FeatureStats
    audio: FrameStats


class PacerBatches(Dataset[PacerBatch]):
    """Item k is one rank's rows of global batch k: a pure function of (data, seed, k), so runs resume."""

    def __init__(
        self, data: ClipDataset, inputs: PacerInputs, window: int, batch: int, seed: int, *at: int
    ) -> None:
        self.data, self.window, self.seed = data, window, seed
        self.at = at or (0, 1)  # rank, and number of ranks
        self.stats, self.audio = inputs.stats, inputs.audio
        self.columns = data.layout.part(PART)
        self.clips = np.flatnonzero(data.has("audio.npy") & (data.frames >= window))
        if not len(self.clips):
            raise UserError(f"{data.where}: no clip of split '{data.split}' has music and {window} frames")
        self.plan = BatchPlan(len(self.clips), batch, seed)

    def __len__(self) -> int:
        return self.plan.batches_per_epoch  # of validation; training asks for as many as it has steps

    def __getitem__(self, k: int) -> PacerBatch:
        turns, items = self.plan.local(k, *self.at)
        clips, draws = self.clips[items], uniform(self.seed, turns, self.clips[items])
        begins = (draws * (self.data.frames[clips] - self.window + 1)).astype(np.int64)
        motion, audio = [], []
        for clip, begin in zip(clips.tolist(), begins.tolist(), strict=True):
            rows, heard = slice(begin, begin + self.window), self.data.array(clip, "audio.npy")
            assert heard is not None
            motion.append(self.stats.normalize(self.data.motion(clip)[rows][:, self.columns], self.columns))
            audio.append(self.audio.normalize(heard[rows]))
        both = torch.from_numpy(np.stack(motion)), torch.from_numpy(np.stack(audio))
        return {"motion": both[0], "audio": both[1], "length": torch.full((len(clips),), self.window)}


class PacerModule(PlayersModule):
    """The generator follows the recording and the critic; the critic sets them apart."""

    net: Pacer

    def __init__(self, net: Pacer, config: PacerConfig, seed: int) -> None:
        super().__init__(net, config.optim, seed=seed, max_steps=config.train.steps)
        self.config = config
        self.critic = convolutions(net.motion + net.audio, config.net.width, 1)

    def players(self) -> Sequence[Player]:
        """In the order of their turns."""
        mine = Player("pacer", (self.net,), self.config.optim)
        return mine, Player("critic", (self.critic,), self.config.critic)

    def score(self, motion: Tensor, audio: Tensor) -> Tensor:
        """Of every frame; high for what looks recorded."""
        scores: Tensor = self.critic(torch.cat([motion, audio], -1).mT)
        return scores

    def play(self, player: str, batch: dict[str, Any], shared: dict[str, Tensor]) -> dict[str, Tensor]:
        """Least squares, with the distance to the recording for the generator."""
        motion, audio = batch["motion"], batch["audio"]
        if player == "pacer":
            noise = torch.randn(len(motion), self.net.noise, device=motion.device)
            made = shared["made"] = self.net(audio, noise)
            distance = (made - motion).abs().mean()
            adversarial = (self.score(made, audio) - 1).square().mean()
            return {"loss": distance + self.config.adversarial * adversarial, "distance": distance}
        real, fake = self.score(motion, audio), self.score(shared["made"], audio)
        return {"loss": (real - 1).square().mean() + fake.square().mean(), "margin": (real - fake).mean()}


@dataclass(frozen=True)
class PacerGenerator:
    """Motion as long as its music."""

    net: Pacer
    layout: MotionLayout
    stats: FeatureStats
    audio: FrameStats
    part: Part = PART
    method = "pacer"
    modalities = frozenset({"audio"})
    settings: frozenset[str] = frozenset()
    unit_frames = 1
    max_frames = None
    decides_length = False

    @property
    def prepared(self) -> dict[str, object]:
        """What the stage of its modality gives."""
        return {"audio": self.audio}

    @torch.no_grad()
    def generate(self, request: GenerationRequest) -> list[NDArray[np.float32]]:
        """Each row alone, so what it is batched with plays no part."""
        music = request.conditions.get("audio")
        if music is None or not bool(music.present.all()):
            raise UserError("the pacer is conditioned on music, and not every motion was given some")
        heard, device = music.mask.sum(1).tolist(), music.features.device
        out = []
        for row, (seed, frames) in enumerate(zip(request.seeds, request.frames or heard, strict=True)):
            # Music that ends before the motion does is present at its last frame.
            places = torch.arange(frames).clamp(max=heard[row] - 1)
            audio = self.audio.normalize(music.features[row].cpu().numpy()[places])
            noise = torch.randn(1, self.net.noise, generator=torch.Generator().manual_seed(seed))
            made = self.net(torch.from_numpy(audio)[None].to(device), noise.to(device))[0].cpu().numpy()
            out.append(np.asarray(self.stats.denormalize(made, self.layout.part(PART)), dtype=np.float32))
        return out


class PacerStage(TrainedStage[PacerConfig, PacerInputs, Pacer]):
    """Music to motion."""

    name = "pacer"
    summary = "motion paced by music"
    config = PacerConfig
    offers = frozenset({GENERATOR})
    inputs = PacerInputs
    curves = (Curve("pacer_distance"), Curve("critic_margin", "margin of the critic"))

    def facts(self, config: PacerConfig, inputs: PacerInputs) -> ModelFacts:
        """Written beside the weights: with the stages of `exported`, all that `network` needs."""
        layout, extra = LayoutFacts.of(inputs.data.layout), {"audio": inputs.audio.dim}
        return ModelFacts(kind=self.name, config=config.net.dump(), layout=layout, extra=extra)

    def network(self, facts: ModelFacts, inputs: PacerInputs) -> Pacer:
        """For training, for the dry run and for loading."""
        config = PacerNetConfig.parse(facts.config, facts.where)
        return Pacer(config, facts.fact("audio", int), len(facts.layout.layout().part(PART)))

    def module(self, config: PacerConfig, net: Pacer, inputs: PacerInputs, seed: int) -> PacerModule:
        """The generator and its critic."""
        return PacerModule(net, config, seed)

    def batches(self, config: PacerConfig, net: Pacer, inputs: PacerInputs, seed: int, log: Log) -> Batches:
        """Windows of clips with music."""
        data, window = inputs.data, config.window

        def train(batch: int, rank: int, world: int) -> PacerBatches:
            return PacerBatches(data.split("train"), inputs, window, batch, seed, rank, world)

        return Batches(train, lambda: PacerBatches(data.held_out(), inputs, window, 8, seed))

    def example(self, config: PacerConfig, net: Pacer, inputs: PacerInputs, batch: int) -> Example:
        """Shapes alone: the dry run has no data."""
        both = {name: torch.empty(batch, config.window, getattr(net, name)) for name in ("motion", "audio")}
        length = torch.full((batch,), config.window)
        return Example({**both, "length": length}, f"{config.window} frames")

    def generator(self, stage: Finished, given: Inputs, device: torch.device) -> MotionGenerator:
        """From a run and from an export alike."""
        stats: FeatureStats = given["stats"]
        return PacerGenerator(self.load(stage, given, device), stats.layout, stats, given["audio"])

    def exported(self, config: PacerConfig) -> tuple[str, ...]:
        """Stages that an export takes along."""
        return ("stats", "audio")


register(PacerStage())
