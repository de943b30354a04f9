"""GPT stages: Hierarchical-GPT over body and hand tokens, and the face GPT (HumanTOMATO sections 3.3-3.6)."""

from __future__ import annotations

from functools import cache
from typing import Any, Literal

import torch
from pydantic import Field
from torch.utils.data import Dataset

from motionloom.datasets.schema import UserError
from motionloom.models.gpt.module import GptLossConfig, GptModule
from motionloom.models.gpt.network import GptConfig, InterleavedGPT
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.stages.gpt_data import GptClips, gpt_clips
from motionloom.pipeline.stages.stage import StageContext
from motionloom.pipeline.stages.training import TrainConfig, TrainedStageConfig, fit
from motionloom.pipeline.store.data import held_out, open_split, open_text
from motionloom.pipeline.store.networks import LoadedTma, load_gpt, load_tokenizer
from motionloom.pipeline.store.tokens import TokenBatches, TokenStore
from motionloom.pipeline.store.weights import LayoutFacts, ModelFacts, save_model

Prior = Literal["tma", "sentence"]


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
        """A model that samples as it trains is neither one graph nor cut over ranks."""
        super().require_fit(hardware)
        sampled = self.loss.align_weight > 0 and self.loss.align_on == "samples"
        if sampled and (self.train.compile or self.train.strategy == "fsdp"):
            raise UserError(
                "loss.align_on samples draws motions token by token, which train.compile and train.strategy "
                "fsdp cannot do; set compile: false and strategy: ddp, or align_on: predictions"
            )


def run_gpt(context: StageContext) -> None:
    """Train on exported tokens."""
    config: GptStageConfig = context.config
    tokenizer = load_tokenizer(context.input("tokenizer"))
    tma_folder = context.optional("tma")
    align = config.loss.align_weight > 0
    needed = config.prior == "tma" or align
    if needed and tma_folder is None:
        raise UserError(f"stage {context.name}: prior 'tma' and align_weight > 0 need a tma stage before it")
    tma = LoadedTma.load(tma_folder, context.device) if needed and tma_folder is not None else None
    text = open_text(context.input("text"))
    text_dim = tma.net.config.latent if config.prior == "tma" and tma else text.dim
    torch.manual_seed(context.seed)
    net = InterleavedGPT(config.net, tokenizer.streams, tokenizer.pattern, text_dim)
    start = context.optional("start")
    if start is not None:
        net.load_state_dict(load_gpt(start, tokenizer)[0].state_dict())
    module = GptModule(
        net,
        config.optim,
        seed=context.seed,
        max_steps=config.train.steps,
        loss=config.loss,
        tokenizer=tokenizer if align else None,
        tma=tma.net if align and tma else None,
    )
    data = context.input("data")
    per_group = {s.name: s.per_group for s in tokenizer.streams}

    @cache
    def clips_of(split: str) -> GptClips:
        store = TokenStore.load(context.input("tokens") / f"tokens-{split}.safetensors", per_group)
        clips = gpt_clips(
            open_split(data, split), store, tokenizer, face=config.face, min_frames=config.min_frames
        )
        if clips.uncaptioned:
            kind = "face caption" if config.face else "caption"
            context.console.print(f"    {split}: {clips.uncaptioned} clips without a {kind} are left out")
        return clips

    def batches(split: str, batch: int, rank: int = 0, world: int = 1, *, training: bool) -> TokenBatches:
        clips = clips_of(split)
        latents = tma.embed_captions(clips.texts, text) if tma is not None else None
        if config.prior == "tma" and latents is not None:
            prior = latents
        else:
            prior = torch.as_tensor(text.sentence(clips.texts))
        return TokenBatches(
            clips.store,
            clips.captions,
            prior,
            torch.as_tensor(text.similarity(clips.texts)),
            net.pattern,
            net.num_codes,
            net.max_groups,
            batch,
            context.seed,
            rank,
            world,
            training,
            clips.sources,
            latents=latents if align and config.prior != "tma" else None,
            present=clips.present,
        )

    def train(batch: int, rank: int, world: int) -> Dataset[Any]:
        return batches("train", batch, rank, world, training=True)

    def validation() -> Dataset[Any]:
        return batches(held_out(data), 32, training=False)

    fit(context, module, config.train, train, validation, config.optim.grad_clip)
    if module.global_rank == 0:
        extra = {
            "text_dim": text_dim,
            "prior": config.prior,
            "streams": {s.name: s.num_codes for s in tokenizer.streams},
            "pattern": list(tokenizer.pattern),
        }
        layout = open_split(data, "train").layout
        facts = ModelFacts(kind="gpt", config=config.net.dump(), layout=LayoutFacts.of(layout), extra=extra)
        save_model(context.folder, net, facts)
