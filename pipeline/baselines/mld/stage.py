"""MLD's stages: an auto-encoder of motion, and diffusion of its latents from text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from pydantic import model_validator
from torch import Tensor

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.models.diffusion.sampling import sample_guided
from motionloom.models.diffusion.schedule import Sampler
from motionloom.models.layers.transformer import length_mask, name_in_torch
from motionloom.models.training.optim import OptimConfig
from motionloom.pipeline.baselines.mld.network import (
    LatentDenoiser,
    LatentDiffusionConfig,
    LoadedMotionVae,
    MotionVae,
    MotionVaeConfig,
    MotionVaeLossConfig,
)
from motionloom.pipeline.contract.generation import GenerationRequest, MotionGenerator
from motionloom.pipeline.contract.showing import Curve
from motionloom.pipeline.contract.stage import GENERATOR, CompletedStage, Inputs, Stage, register
from motionloom.pipeline.inference.generators.diffusion import DenoisedMotion
from motionloom.pipeline.stages.networks.captions import (
    CaptionInputs,
    CaptionStage,
    CaptionStageConfig,
    clips_of,
    joint_loss_settings,
    part_columns,
)
from motionloom.pipeline.stages.networks.clips import clip_batches, motion_example
from motionloom.pipeline.store.data import Data
from motionloom.pipeline.store.networks import device_of
from motionloom.pipeline.store.weights import ModelFacts, Release
from motionloom.pipeline.training.config import TrainConfig
from motionloom.pipeline.training.trained_stage import Batches, Example, Log, TrainedStage

_OPTIM = OptimConfig(weight_decay=0.01, betas=(0.9, 0.999))
"""AdamW as published, at 1e-4."""


def sample_latents(
    net: LatentDenoiser,
    text: Tensor,
    *,
    seeds: Sequence[int],
    sampler: Sampler = "ddim",
    steps: int = 50,
    guidance: float = 7.5,
) -> Tensor:
    """Latents [n, K, C] for text vectors [n, E], one seed each (`sample_guided`)."""
    sizes = [net.latent_tokens] * len(text)
    how = {"sampler": sampler, "steps": steps, "guidance": guidance}
    return torch.stack(sample_guided(net, net, text, sizes, net.config.dim, seeds=seeds, **how))  # type: ignore[arg-type]


@dataclass(frozen=True)
class LatentMotion(DenoisedMotion):
    """A latent is denoised under a sentence embedding and decoded to all frames at once."""

    net: LatentDenoiser
    vae: LoadedMotionVae
    who = "this latent diffusion model"
    method = "mld"
    settings = frozenset({"cfg_scale", "sampler", "denoising_steps"})
    usual = "ddim"

    @property
    def max_frames(self) -> int | None:
        """Return the longest motion of the decoder's training."""
        return self.vae.max_frames

    def normalised(self, request: GenerationRequest, frames: Sequence[int]) -> list[Tensor]:
        sampler, steps = self.denoising(request.sampling)
        text = request.pooled_text(self.who).to(device_of(self.net))
        latents = sample_latents(
            self.net, text, seeds=request.seeds, sampler=sampler, steps=steps,
            guidance=request.sampling.cfg_scale,
        )  # fmt: skip
        mask = length_mask(torch.as_tensor(frames, device=latents.device), max(frames))
        return [made[:count] for made, count in zip(self.vae.net.decode(latents, mask), frames, strict=True)]


class MotionVaeStageConfig(CaptionStageConfig):
    """An auto-encoder of body and hands."""

    net: MotionVaeConfig = MotionVaeConfig()
    loss: MotionVaeLossConfig = MotionVaeLossConfig()
    optim: OptimConfig = _OPTIM
    train: TrainConfig = TrainConfig(steps=1_000_000, batch_size=128)
    part: Literal["bodyhand"] = "bodyhand"
    """The modelled columns: losses compare joints in metres, which a face has none of."""

    @model_validator(mode="after")
    def _has_positions(self) -> MotionVaeStageConfig:
        needed = self.max_frames + 2 * self.net.latent_tokens
        if needed > self.net.positions:
            raise ValueError(
                f"max_frames {self.max_frames} and {2 * self.net.latent_tokens} tokens need {needed} "
                f"positions, and net.positions is {self.net.positions}; raise it, or lower max_frames"
            )
        return self


class MotionVaeInputs(Inputs):
    """Clips and their statistics; captions are not read."""

    data: Data
    stats: FeatureStats


class MotionVaeStage(TrainedStage[MotionVaeStageConfig, MotionVaeInputs, MotionVae]):
    """MLD's first stage, trained on whole clips."""

    name = "motion_vae"
    summary = "auto-encoder of motion (MLD)"
    trainer = "motionloom.pipeline.baselines.mld.module:MotionVaeModule"
    config = MotionVaeStageConfig
    inputs = MotionVaeInputs
    curves = tuple(Curve(name) for name in ("features", "joints", "kl"))
    exports = ("stats",)

    def facts(self, config: MotionVaeStageConfig, inputs: MotionVaeInputs) -> ModelFacts:
        layout = inputs.data.layout
        extra = {"motion_dim": len(part_columns(layout, config.part)), "max_frames": config.max_frames}
        return ModelFacts.of(self.name, config.net, layout, extra)

    def network(self, facts: ModelFacts, inputs: MotionVaeInputs) -> MotionVae:
        return MotionVae(MotionVaeConfig.parse(facts.config, facts.where), facts.fact("motion_dim", int))

    def release(self, net: MotionVae) -> Release:
        """`vae.safetensors` of MLD's release."""
        return Release(mld_names(net))

    def module_settings(
        self, config: MotionVaeStageConfig, net: MotionVae, inputs: MotionVaeInputs
    ) -> dict[str, object]:
        return joint_loss_settings(inputs.data.layout, config.part, inputs.stats, config.loss)

    def batches(
        self, config: MotionVaeStageConfig, net: MotionVae, inputs: MotionVaeInputs, seed: int, log: Log
    ) -> Batches:
        clips = clips_of(config, inputs.data.layout, None)
        return clip_batches(inputs.data, inputs.stats, {}, seed, clips=clips)

    def example(
        self, config: MotionVaeStageConfig, net: MotionVae, inputs: MotionVaeInputs, batch: int
    ) -> Example:
        note = f"{net.config.latent_tokens} latents of {net.config.dim} a motion"
        return Example(motion_example(batch, config.max_frames, net.motion_dim), note)

    def loaded(self, net: MotionVae, facts: ModelFacts, inputs: MotionVaeInputs) -> LoadedMotionVae:
        return LoadedMotionVae(net, facts.layout.layout(), facts.fact("max_frames", int))


class LatentDiffusionStageConfig(CaptionStageConfig):
    """A denoiser of the latents of a `motion_vae`."""

    net: LatentDiffusionConfig = LatentDiffusionConfig(schedule=LatentDiffusionConfig().schedule)
    optim: OptimConfig = _OPTIM
    train: TrainConfig = TrainConfig(steps=700_000, batch_size=64)
    part: Literal["bodyhand"] = "bodyhand"


class LatentDiffusionInputs(CaptionInputs):
    """Captioned clips and the auto-encoder of the latents."""

    motion_vae: LoadedMotionVae


class LatentDiffusionStage(CaptionStage[LatentDiffusionStageConfig, LatentDiffusionInputs, LatentDenoiser]):
    """MLD's second stage."""

    name = "latent_diffusion"
    summary = "diffusion of a motion's latents (MLD)"
    trainer = "motionloom.pipeline.baselines.mld.module:LatentDiffusionModule"
    config = LatentDiffusionStageConfig
    offers = frozenset({GENERATOR})
    inputs = LatentDiffusionInputs
    curves = (Curve("loss"),)
    exports = ("stats", "text", "motion_vae")

    def check(self, stage: Stage, others: Mapping[str, Stage]) -> None:
        """It is as wide as the latents, and reads no longer motion than the auto-encoder was trained on."""
        vae = others.get(stage.inputs["motion_vae"])
        if vae is None or not isinstance(vae.config, MotionVaeStageConfig):
            return
        for key, own, theirs in (
            ("net.dim", stage.config.net.dim, vae.config.net.dim),
            ("max_frames", stage.config.max_frames, vae.config.max_frames),
        ):
            if own != theirs:
                raise UserError(
                    f"stage '{stage.name}': {key} {own} must be that of '{vae.name}', {theirs}, whose "
                    f"latents it denoises"
                )

    def facts(self, config: LatentDiffusionStageConfig, inputs: LatentDiffusionInputs) -> ModelFacts:
        extra = {"latent_tokens": inputs.motion_vae.net.config.latent_tokens, "text_dim": inputs.text.dim}
        return ModelFacts.of(self.name, config.net, inputs.data.layout, extra)

    def network(self, facts: ModelFacts, inputs: LatentDiffusionInputs) -> LatentDenoiser:
        config = LatentDiffusionConfig.parse(facts.config, facts.where)
        vae = inputs.motion_vae
        tokens, text_dim = (facts.fact(key, int) for key in ("latent_tokens", "text_dim"))
        here = (vae.net.config.latent_tokens, vae.net.config.dim)
        if (tokens, config.dim) != here:
            raise UserError(
                f"{facts.where}: denoises {tokens} latents of {config.dim}, and its auto-encoder makes "
                f"{here[0]} of {here[1]}; run both stages again"
            )
        return LatentDenoiser(config, tokens, text_dim)

    def prepare(
        self, config: LatentDiffusionStageConfig, net: LatentDenoiser, inputs: LatentDiffusionInputs
    ) -> None:
        """Set the embedding of hidden texts: that of an empty text."""
        empty = inputs.text.encoder.encode([""]).sentence
        net.empty.copy_(torch.as_tensor(empty[0]))

    def release(self, net: LatentDenoiser) -> Release:
        """`denoiser.safetensors`. Texts must be encoded as the release's were: by CLIP ViT-L/14 (768 wide) in
        the paper's, by SentenceT5-Large in the one of MotionLCM's authors.
        """
        return Release(mld_names(net), unread=("mem_pos.pe",))

    def module_settings(
        self, config: LatentDiffusionStageConfig, net: LatentDenoiser, inputs: LatentDiffusionInputs
    ) -> dict[str, object]:
        return {"vae": inputs.motion_vae.net}

    def generator(self, stage: CompletedStage, given: Inputs, device: torch.device) -> MotionGenerator:
        vae: LoadedMotionVae = given["motion_vae"]
        return LatentMotion(vae.layout, "bodyhand", given, self.load(stage, given, device), vae)


_NAMES = {
    "queries": "global_motion_token",
    "enter": "skel_embedding",
    "leave": "final_layer",
    "encoder_positions.table": "query_pos_encoder.pe",
    "decoder_positions.table": "query_pos_decoder.pe",
    "positions.table": "query_pos.pe",
    "time.0": "time_embedding.linear_1",
    "time.2": "time_embedding.linear_2",
    "text.1": "emb_proj.1",
}


def mld_names(net: MotionVae | LatentDenoiser) -> dict[str, str]:
    """Names of either network's tensors -> their names in MLD's release."""
    out = {}
    for name, _ in net.named_parameters():
        stack, _, rest = name.partition(".")
        layer, _, kind = name.rpartition(".")
        if stack in ("encoder", "decoder", "stack"):
            there = "decoder" if stack == "decoder" else "encoder"
            out[name] = f"{there}.{_in_u(rest, net.config.layers // 2, memory=stack == 'decoder')}"
        else:
            out[name] = _NAMES[name] if name in _NAMES else f"{_NAMES[layer]}.{kind}"
    return out


def _in_u(name: str, half: int, *, memory: bool) -> str:
    """Name of a `SkipTransformer`'s tensor there: into the U, its bottom, and out of it."""
    if name.startswith("merge."):
        return name.replace("merge.", "linear_blocks.")
    if not name.startswith("blocks."):
        return name
    _, number, inner = name.split(".", 2)
    index = int(number)
    tensor = name_in_torch(inner, memory=memory)
    if index == half:
        return f"middle_block.{tensor}"
    return f"{'input' if index < half else 'output'}_blocks.{index % (half + 1)}.{tensor}"


register(MotionVaeStage())
register(LatentDiffusionStage())
