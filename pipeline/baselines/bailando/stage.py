"""Bailando's stages: codes of both halves of the body, a GPT over them, actor-critic training (UDE Table 2).

dance_vq -> cross_gpt -> actor_critic
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, TypeVar

import torch
from pydantic import Field
from torch.utils.data import Dataset

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.loading.plan import Share
from motionloom.datasets.modalities.modality import FrameStats
from motionloom.datasets.modalities.table import MODALITIES
from motionloom.models.training.optim import OptimConfig
from motionloom.pipeline.baselines.bailando.codes import DanceVq, DanceVqConfig, places
from motionloom.pipeline.baselines.bailando.dances import BeatBatches, JointCrops, danced_joints
from motionloom.pipeline.baselines.bailando.generator import BailandoGenerator
from motionloom.pipeline.baselines.bailando.network import ActorCritic, CrossGpt, CrossGptConfig, RewardConfig
from motionloom.pipeline.baselines.bailando.release import release_of_codes, release_of_gpt
from motionloom.pipeline.contract.generation import MotionGenerator
from motionloom.pipeline.contract.showing import Curve
from motionloom.pipeline.contract.stage import GENERATOR, CompletedStage, Inputs, register
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.stages.networks.clips import MUSIC, clip_batches, spread_dances
from motionloom.pipeline.stages.networks.tokenizer import require_uses
from motionloom.pipeline.store.data import Data
from motionloom.pipeline.store.networks import device_of
from motionloom.pipeline.store.weights import ModelFacts, Release, load_facts
from motionloom.pipeline.training.config import TrainConfig, TrainedStageConfig
from motionloom.pipeline.training.trained_stage import Batches, Example, Log, TrainedStage

if TYPE_CHECKING:
    from motionloom.models.training.stage_module import StageModule

_ADAM = OptimConfig(optimizer="adam", lr=3e-5, betas=(0.5, 0.999), grad_clip=0.0)


class DanceVqStageConfig(TrainedStageConfig):
    """Codes of both halves, then the root; the steps of both together are `train.steps`."""

    net: DanceVqConfig = DanceVqConfig()
    optim: OptimConfig = _ADAM
    root_optim: OptimConfig = _ADAM.model_copy(update={"lr": 5e-5})
    root_start: int = Field(100_000, ge=1)
    """First step that trains the root's decoder and no more the codes."""
    train: TrainConfig = TrainConfig(steps=150_000, batch_size=32)
    window: int = Field(240, ge=4)
    """Frames of a training window; shorter clips are left out."""

    def require_fit(self, hardware: Hardware) -> None:
        """As for a tokenizer; the published sizes have 1.9 times the vectors."""
        super().require_fit(hardware)
        vectors = self.train.batch_size // self.train.accumulate * self.window // self.net.code_frames
        require_uses(vectors, self.net.num_codes, self.net.reset_below, times=1.5)


class DanceVqInputs(Inputs):
    """Clips; dances need no music here."""

    data: Data


class DanceVqStage(TrainedStage[DanceVqStageConfig, DanceVqInputs, DanceVq]):
    """Joints to codes of two halves of the body."""

    name = "dance_vq"
    summary = "Bailando: codes of upper and lower body"
    trainer = "motionloom.pipeline.baselines.bailando.module:DanceVqModule"
    config = DanceVqStageConfig
    inputs = DanceVqInputs
    curves = tuple(Curve(name) for name in ("codes_recon_up", "codes_recon_down", "root_loss"))

    def facts(self, config: DanceVqStageConfig, inputs: DanceVqInputs) -> ModelFacts:
        layout = inputs.data.layout
        if layout.family == "raw" and layout.name != "smpl75":
            raise UserError(
                f"Bailando makes joint positions, and layout {layout.name} is not made of them; take "
                f"body133, smpl75, or another layout of positions"
            )
        if config.window % config.net.code_frames:
            raise UserError(
                f"window {config.window} is no multiple of the {config.net.code_frames} frames of a code "
                f"(net.halvings {config.net.halvings})"
            )
        extra = {"joints": danced_joints(layout)}
        return ModelFacts.of(self.name, config.net, layout, extra)

    def network(self, facts: ModelFacts, inputs: DanceVqInputs) -> DanceVq:
        return DanceVq(DanceVqConfig.parse(facts.config, facts.where), facts.fact("joints", int))

    def release(self, net: DanceVq) -> Release:
        """Bailando's, with the decoder of the root."""
        return release_of_codes(net)

    def batches(
        self, config: DanceVqStageConfig, net: DanceVq, inputs: DanceVqInputs, seed: int, log: Log
    ) -> Batches:
        frames = {"max_frames": config.window, "min_frames": config.window}
        return clip_batches(inputs.data, JointCrops, {}, seed, clips=frames)

    def example(self, config: DanceVqStageConfig, net: DanceVq, inputs: DanceVqInputs, batch: int) -> Example:
        codes = config.window // config.net.code_frames
        motion = torch.zeros(batch, config.window, 3 * net.joints)
        return Example({"motion": motion}, f"2 x {codes} codes for {config.window} frames")


class CrossGptStageConfig(TrainedStageConfig):
    """The GPT over codes and music; a training window holds one code more than its context."""

    net: CrossGptConfig = CrossGptConfig()
    optim: OptimConfig = _ADAM.model_copy(update={"lr": 3e-4})
    train: TrainConfig = TrainConfig(steps=100_000, batch_size=32)
    kept: int = Field(8, ge=1)
    """First codes of training dances that it keeps to go on from, where no motion is given."""


class CrossGptInputs(Inputs):
    """Dances, their music and the trained codes."""

    data: Data
    audio: FrameStats
    dance_vq: DanceVq


C = TypeVar("C", bound=TrainedStageConfig)
I = TypeVar("I", bound=CrossGptInputs)  # noqa: E741
G = TypeVar("G", CrossGpt, ActorCritic)


class DanceGptStage(TrainedStage[C, I, G]):
    """A stage of a network that has the GPT; subclasses build it and its module."""

    offers = frozenset({GENERATOR})
    exports = ("dance_vq", "audio")

    def module_settings(self, config: C, net: G, inputs: I) -> dict[str, object]:
        return {"vq": inputs.dance_vq}

    def release(self, net: G) -> Release:
        """Bailando's; the critic is read where there is one."""
        return release_of_gpt(net)

    def example(self, config: C, net: G, inputs: I, batch: int) -> Example:
        gpt = gpt_in(net)
        vq = inputs.dance_vq
        frames = window_of(gpt, vq)["max_frames"]
        music = MODALITIES["audio"].example(batch, frames, gpt.music_dim)
        tensors = {"motion": torch.zeros(batch, frames, 3 * vq.joints), "conditions": {"audio": music}}
        return Example(tensors, f"3 x {gpt.config.context} positions")

    def generator(self, stage: CompletedStage, given: Inputs, device: torch.device) -> MotionGenerator:
        songs = getattr(stage.config, "reward_songs", "train")
        note = "" if songs == "train" else "rewarded on the songs of the test split"
        layout = load_facts(stage.folder).layout.layout()
        gpt = gpt_in(self.load(stage, given, device))
        return BailandoGenerator(layout, given, gpt, given["dance_vq"], note)


class CrossGptStage(DanceGptStage[CrossGptStageConfig, CrossGptInputs, CrossGpt]):
    """Music to codes of both halves of the body."""

    name = "cross_gpt"
    summary = "Bailando: music to codes"
    trainer = "motionloom.pipeline.baselines.bailando.module:CrossGptModule"
    config = CrossGptStageConfig
    inputs = CrossGptInputs
    curves = tuple(Curve(name) for name in ("loss", "accuracy_up", "accuracy_down"))

    def facts(self, config: CrossGptStageConfig, inputs: CrossGptInputs) -> ModelFacts:
        codes = inputs.dance_vq.config.num_codes
        extra = {"num_codes": codes, "music_dim": inputs.audio.dim, "kept": config.kept}
        return ModelFacts.of(self.name, config.net, inputs.data.layout, extra)

    def network(self, facts: ModelFacts, inputs: CrossGptInputs) -> CrossGpt:
        return gpt_of(facts)

    def prepare(self, config: CrossGptStageConfig, net: CrossGpt, inputs: CrossGptInputs) -> None:
        """First codes of training dances."""
        dataset = inputs.data.split("train")
        frames = inputs.dance_vq.config.code_frames
        clips = spread_dances(dataset, config.kept, frames)
        crops = JointCrops(dataset)
        starts = torch.zeros(len(clips), frames, crops.width)
        for row, clip in enumerate(clips):
            crops.fill(starts[row].numpy(), clip, 0, frames)
        vq = inputs.dance_vq
        net.kept.copy_(vq.encode(places(starts).to(device_of(vq)))[:, 0])

    def batches(
        self, config: CrossGptStageConfig, net: CrossGpt, inputs: CrossGptInputs, seed: int, log: Log
    ) -> Batches:
        return clip_batches(
            inputs.data, JointCrops, {"audio": inputs.audio}, seed, clips=window_of(net, inputs.dance_vq),
            balance=MUSIC,
        )  # fmt: skip


class ActorCriticStageConfig(TrainedStageConfig):
    """Actor-critic training of a finished `cross_gpt`."""

    reward: RewardConfig = RewardConfig()
    reward_songs: Literal["train", "test"] = "train"
    """The songs that dances are rewarded on. The published model was trained on those of the test split, on
    which it is then evaluated; figures of such a stage say so."""
    optim: OptimConfig = _ADAM.model_copy(update={"lr": 1e-5})
    train: TrainConfig = TrainConfig(steps=1_000, batch_size=32)


class ActorCriticInputs(CrossGptInputs):
    """The same, and the GPT to start from."""

    cross_gpt: CrossGpt


class ActorCriticStage(DanceGptStage[ActorCriticStageConfig, ActorCriticInputs, ActorCritic]):
    """The GPT taught to keep the beat."""

    name = "actor_critic"
    version = 2  # the last layers learn, from windows of dances
    summary = "Bailando: rewards for the beat"
    trainer = "motionloom.pipeline.baselines.bailando.module:ActorCriticModule"
    config = ActorCriticStageConfig
    inputs = ActorCriticInputs
    curves = (Curve("actor_reward"), Curve("critic_loss"))

    def facts(self, config: ActorCriticStageConfig, inputs: ActorCriticInputs) -> ModelFacts:
        gpt = inputs.cross_gpt
        extra = {
            "num_codes": gpt.num_codes,
            "music_dim": gpt.music_dim,
            "kept": len(gpt.kept),
            "critic_layers": config.reward.critic_layers,
        }
        return ModelFacts.of(self.name, gpt.config, inputs.data.layout, extra)

    def network(self, facts: ModelFacts, inputs: ActorCriticInputs) -> ActorCritic:
        return ActorCritic(gpt_of(facts), facts.fact("critic_layers", int))

    def prepare(self, config: ActorCriticStageConfig, net: ActorCritic, inputs: ActorCriticInputs) -> None:
        """The actor starts as the trained GPT."""
        net.gpt.load_state_dict(inputs.cross_gpt.state_dict())

    def module_settings(
        self, config: ActorCriticStageConfig, net: ActorCritic, inputs: ActorCriticInputs
    ) -> dict[str, object]:
        return {"vq": inputs.dance_vq, "fps": inputs.data.layout.fps}

    def dry_module(
        self, config: ActorCriticStageConfig, net: ActorCritic, inputs: ActorCriticInputs
    ) -> StageModule:
        module = self.module(config, net, inputs, seed=0)
        # Tensors of a dry run hold no numbers that a dance could be made of.
        module.rewards = lambda codes, _: codes.new_zeros(codes.shape[:2]).float()  # type: ignore[assignment]
        return module

    def batches(
        self, config: ActorCriticStageConfig, net: ActorCritic, inputs: ActorCriticInputs, seed: int, log: Log
    ) -> Batches:
        data = inputs.data
        audio = inputs.audio
        fps = inputs.data.layout.fps
        songs = data.held_out(prefer="test") if config.reward_songs == "test" else None
        found = clip_batches(
            data, JointCrops, {"audio": audio}, seed,
            clips=window_of(net.gpt, inputs.dance_vq, config.reward.contexts), dataset=songs, balance=MUSIC,
        )  # fmt: skip

        def train(batch: int, share: Share) -> Dataset[object]:
            return BeatBatches(found.train(batch, share), audio, fps)  # type: ignore[arg-type, return-value]

        assert found.validation is not None
        check = found.validation
        return Batches(train, lambda: BeatBatches(check(), audio, fps))  # type: ignore[arg-type, return-value]

    def example(
        self, config: ActorCriticStageConfig, net: ActorCritic, inputs: ActorCriticInputs, batch: int
    ) -> Example:
        tensors, note = super().example(config, net, inputs, batch)
        rows, frames = tensors["motion"].shape[:2]
        beats = torch.zeros(rows, frames, dtype=torch.bool)
        return Example({**tensors, "length": torch.full((rows,), frames), "beats": beats}, note)


def gpt_of(facts: ModelFacts) -> CrossGpt:
    """The untrained GPT that facts ask for."""
    sizes = {name: facts.fact(name, int) for name in ("num_codes", "music_dim", "kept")}
    return CrossGpt(CrossGptConfig.parse(facts.config, facts.where), **sizes)


def gpt_in(net: CrossGpt | ActorCritic) -> CrossGpt:
    """The GPT itself."""
    return net.gpt if isinstance(net, ActorCritic) else net


def window_of(gpt: CrossGpt, vq: DanceVq, contexts: int = 1) -> dict[str, int]:
    """Lengths of a training window: the context and one code more, or up to so many contexts."""
    context = gpt.config.context
    frames = vq.config.code_frames
    return {"max_frames": (contexts * context + 1) * frames, "min_frames": (context + 1) * frames}


register(DanceVqStage())
register(CrossGptStage())
register(ActorCriticStage())
