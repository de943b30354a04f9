"""GPT stages: Hierarchical-GPT over body and hand tokens, and the face GPT (HumanTOMATO sections 3.3-3.6)."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import TYPE_CHECKING, Literal

import torch
from pydantic import Field

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.text.cache import CaptionVectors
from motionloom.models.gpt.losses import GptLossConfig
from motionloom.models.gpt.network import GptConfig, InterleavedGPT
from motionloom.pipeline.contract.generation import MotionGenerator
from motionloom.pipeline.contract.showing import Curve
from motionloom.pipeline.contract.stage import GENERATOR, CompletedStage, Inputs, Stage, filled_by, register
from motionloom.pipeline.inference.generators.gpt import GptGenerator
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.stages.networks.tokens import Tokens, token_batches, token_example
from motionloom.pipeline.store.networks import (
    LoadedGpt,
    LoadedTma,
    TrainedTokenizer,
    require_streams,
    stream_facts,
)
from motionloom.pipeline.store.text import TextSource
from motionloom.pipeline.store.weights import ModelFacts
from motionloom.pipeline.training.config import TrainConfig, TrainedStageConfig
from motionloom.pipeline.training.trained_stage import Batches, Example, Log, TrainedStage
from motionloom.pipeline.training.warm_start import require_same_start, require_start_layout, same_encoder

if TYPE_CHECKING:
    from motionloom.models.training.stage_module import StageModule
    from motionloom.pipeline.store.data import Data
    from motionloom.pipeline.store.tokens import CaptionTable, GptClips

Prior = Literal["tma", "sentence"]

_FREE = frozenset({"dropout", "attention_dropout", "condition_dropout", "pkeep"})
"""Settings that are of the training and not of the network: another one may go on with others."""


class GptStageConfig(TrainedStageConfig):
    """A GPT over the tokens of one tokenizer."""

    shardable = True

    net: GptConfig = GptConfig()
    loss: GptLossConfig = GptLossConfig()
    train: TrainConfig = TrainConfig(steps=300_000, batch_size=256)
    prior: Prior = "tma"
    """First input of the GPT: the TMA text latent (section 3.5) or the plain sentence embedding."""
    face: bool = False
    """Train on the face captions."""
    min_frames: int = Field(16, ge=1)
    """Captions about fewer frames are left out where the clip has a longer one."""

    def require_fit(self, hardware: Hardware) -> None:
        """Reject what compile and FSDP do not support: sampling inside the loss."""
        super().require_fit(hardware)
        if self.aligned_on_samples and (self.train.compile or self.train.strategy == "fsdp"):
            raise UserError(
                "loss.align_on samples draws motions token by token, which train.compile and train.strategy "
                "fsdp cannot do; set compile: false and strategy: ddp, or align_on: predictions"
            )

    @property
    def aligned(self) -> bool:
        return self.loss.align_weight > 0

    @property
    def aligned_on_samples(self) -> bool:
        return self.aligned and self.loss.align_on == "samples"


class GptInputs(Inputs):
    """Captioned clips, their tokens, and the models of prior, alignment and start."""

    data: Data
    text: TextSource
    tokenizer: TrainedTokenizer
    tokens: Tokens
    tma: LoadedTma | None
    start: LoadedGpt | None = filled_by("gpt")


class GptStage(TrainedStage[GptStageConfig, GptInputs, InterleavedGPT]):
    """A GPT, trained on exported tokens."""

    name = "gpt"
    summary = "GPT over motion tokens"
    trainer = "motionloom.models.gpt.module:GptModule"
    config = GptStageConfig
    offers = frozenset({GENERATOR})
    inputs = GptInputs
    curves = (Curve("ce"), Curve("accuracy"), Curve("align"))

    def check(self, stage: Stage, others: Mapping[str, Stage]) -> None:
        """Its TMA must read captions as it does, and a GPT that it starts from must be the same network."""
        require_own_text(stage, others)
        roles = ("text", "tokenizer", *(("tma",) if stage.config.prior == "tma" else ()))
        require_same_start(stage, others, _FREE, roles, settings=("prior",))

    def facts(self, config: GptStageConfig, inputs: GptInputs) -> ModelFacts:
        if (config.prior == "tma" or config.aligned) and inputs.tma is None:
            raise UserError("prior 'tma' and align_weight > 0 need a tma stage before it")
        tokenizer: TrainedTokenizer = inputs.tokenizer
        prior_tma = inputs.tma if config.prior == "tma" else None
        text_dim = inputs.text.dim if prior_tma is None else prior_tma.net.config.latent
        extra = {"text_dim": text_dim, "prior": config.prior, **stream_facts(tokenizer.net)}
        if inputs.start is not None:
            require_start_layout(inputs.data.layout, tokenizer.layout)
        return ModelFacts.of(self.name, config.net, inputs.data.layout, extra)

    def network(self, facts: ModelFacts, inputs: GptInputs) -> InterleavedGPT:
        tokenizer = inputs.tokenizer.net
        require_streams(facts, tokenizer, "GPT")
        config = GptConfig.parse(facts.config, facts.where)
        return InterleavedGPT(config, tokenizer.streams, tokenizer.pattern, facts.fact("text_dim", int))

    def prepare(self, config: GptStageConfig, net: InterleavedGPT, inputs: GptInputs) -> None:
        """Go on from another GPT's weights, where the recipe names one."""
        if inputs.start is not None:
            net.load_state_dict(inputs.start.net.state_dict())

    def module_settings(
        self, config: GptStageConfig, net: InterleavedGPT, inputs: GptInputs
    ) -> dict[str, object]:
        """L_align is taken on what the frozen tokenizer and TMA make of its tokens."""
        if not config.aligned or inputs.tma is None:
            return {}
        return {"tokenizer": inputs.tokenizer.net, "tma": inputs.tma.net}

    def batches(
        self, config: GptStageConfig, net: InterleavedGPT, inputs: GptInputs, seed: int, log: Log
    ) -> Batches:
        from motionloom.pipeline.store.tokens import gpt_clips

        data = inputs.data
        text = inputs.text.cache
        # TMA's text latents are the prior, or the target of L_align, or both.
        tma = inputs.tma if config.prior == "tma" or config.aligned else None

        def of_texts(texts: list[str]) -> Mapping[str, object]:
            # TMA reads all captions once, before the first batch.
            latents = {} if tma is None else {"latents": tma.embed_captions(texts, text).numpy()}
            return text.places(texts) | latents

        @cache
        def clips_of(split: str) -> GptClips:
            dataset = data.split(split)
            note = inputs.work and inputs.work / (split if tma is None else f"{split} tma")
            clips = gpt_clips(
                dataset, inputs.tokens.open(split), inputs.tokenizer.net, face=config.face,
                min_frames=config.min_frames, of_texts=of_texts, note=note,
            )  # fmt: skip
            if clips.uncaptioned:
                kind = "face caption" if config.face else "caption"
                log(f"{split}: {clips.uncaptioned} clips without a {kind} are left out")
            return clips

        def tables(clips: GptClips) -> dict[str, CaptionTable | None]:
            latents = None if tma is None else CaptionVectors(clips.tables["latents"])
            similarity = text.similarities(clips.tables["similarity"])
            if config.prior == "tma":
                return {"prior": latents, "similarity": similarity}
            prior = text.sentences(clips.tables["sentence"])
            return {"prior": prior, "similarity": similarity, "latents": latents}

        return token_batches(net, clips_of, data.held_out().split, seed, tables)

    def dry_module(self, config: GptStageConfig, net: InterleavedGPT, inputs: GptInputs) -> StageModule:
        """Without the judge of sampled motions, which keeps nothing for the backward pass."""
        module = self.module(config, net, inputs, seed=0)
        if config.aligned_on_samples:
            module.tokenizer = None  # type: ignore[assignment]
        return module

    def example(self, config: GptStageConfig, net: InterleavedGPT, inputs: GptInputs, batch: int) -> Example:
        """The longest sequences; samples that are judged are so many more rows."""
        if config.aligned_on_samples:
            batch *= 1 + config.loss.samples
        tokenizer = inputs.tokenizer.net
        groups = net.max_groups
        ends = len(net.names)
        tensors = token_example(net, batch)
        length = tensors["tokens"].shape[1]
        tensors["text"] = torch.empty(batch, net.text_dim)
        tensors["similarity"] = torch.empty(batch, inputs.text.dim)
        if config.aligned and inputs.tma is not None:
            tensors["tma_text"] = torch.empty(batch, inputs.tma.net.config.latent)
        parts = " + ".join(f"{groups * s.per_group} {s.name}" for s in tokenizer.streams)
        frames = groups * tokenizer.group_frames
        return Example(tensors, f"{parts} + {ends} End = {length} for {frames} frames")

    def loaded(self, net: InterleavedGPT, facts: ModelFacts, inputs: GptInputs) -> LoadedGpt:
        return LoadedGpt(net, facts.fact("prior", str))

    def generator(self, stage: CompletedStage, given: Inputs, device: torch.device) -> MotionGenerator:
        return GptGenerator(self.load(stage, given, device), given, stage.config.face)

    def exported(self, config: GptStageConfig) -> tuple[str, ...]:
        return ("tokenizer", "text", "tma") if config.prior == "tma" else ("tokenizer", "text")


def require_own_text(stage: Stage, others: Mapping[str, Stage]) -> None:
    """A TMA must be given captions by the encoder that it was trained on."""
    tma = others.get(stage.inputs.get("tma", ""))
    own = stage.inputs.get("text", "")
    other = tma.inputs.get("text", "") if tma is not None else own
    if not same_encoder(own, other, others):
        raise UserError(
            f"stage '{stage.name}' reads captions as '{own}' encodes them, but its TMA "
            f"'{stage.inputs['tma']}' was trained on those of '{other}'; name one text stage for both, "
            f"or leave the TMA out (inputs: {{tma: null}})"
        )


register(GptStage())
