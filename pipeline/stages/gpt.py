"""GPT stages: Hierarchical-GPT over body and hand tokens, and the face GPT (HumanTOMATO sections 3.3-3.6)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import Dataset

from motionloom.datasets.schema import UserError
from motionloom.datasets.shards.clips import ClipDataset, in_order
from motionloom.models.gpt.module import GptLossConfig, GptModule
from motionloom.models.gpt.network import GptConfig, InterleavedGPT
from motionloom.pipeline.model_store import LayoutFacts, ModelFacts, save_model
from motionloom.pipeline.networks import LoadedTma, load_tokenizer
from motionloom.pipeline.sources import captions_of, held_out, open_split, open_text
from motionloom.pipeline.stage import StageContext
from motionloom.pipeline.token_store import TokenBatches, TokenStore
from motionloom.pipeline.training import TrainConfig, TrainedStageConfig, fit

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


def run_gpt(context: StageContext) -> None:
    """Train on exported tokens."""
    config: GptStageConfig = context.config
    tokenizer = load_tokenizer(context.input("tokenizer"))
    tma_folder = context.optional("tma")
    align = config.loss.align_weight > 0
    needed = config.prior == "tma" or align
    if needed and tma_folder is None:
        raise UserError(f"stage {context.name}: prior 'tma' and align_weight > 0 need a tma stage before it")
    tma = LoadedTma.load(tma_folder) if needed and tma_folder is not None else None
    text = open_text(context.input("text"))
    text_dim = tma.net.config.latent if config.prior == "tma" and tma else text.dim
    torch.manual_seed(context.seed)
    net = InterleavedGPT(config.net, tokenizer.streams, tokenizer.pattern, text_dim)
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

    def batches(split: str, batch: int, rank: int = 0, world: int = 1, *, training: bool) -> TokenBatches:
        dataset = open_split(data, split)
        store = TokenStore.load(
            context.input("tokens") / f"tokens-{split}.safetensors",
            {s.name: s.per_group for s in tokenizer.streams},
        )
        clips = np.flatnonzero(store.whole)
        if len(clips) == 0:
            raise UserError(
                f"stage {context.name}: no clip of split '{split}' holds all that the tokenizer models "
                f"(hands, face): train a tokenizer of another `part`, or take other data"
            )
        captions, known = captions_by_row(dataset, clips, face=config.face)
        sentences = torch.as_tensor(text.sentence(known))
        latents = tma.embed_captions(known, text) if tma is not None else None
        prior = latents if config.prior == "tma" and latents is not None else sentences
        return TokenBatches(
            store.whole_clips(),
            captions,
            prior,
            sentences,
            net.pattern,
            net.num_codes,
            net.max_groups,
            batch,
            context.seed,
            rank,
            world,
            training,
            # Weights count; the order of shards does not, as the tokens are all in memory.
            tuple(replace(source, shards=None) for source in dataset.sources(clips)),
            latents=latents if align and config.prior != "tma" else None,
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


def captions_by_row(
    dataset: ClipDataset, clips: NDArray[np.int64], *, face: bool
) -> tuple[list[list[int]], list[str]]:
    """For each of `clips` the rows of its captions in the list of all of them, and that list."""
    names: dict[str, int] = {}
    captions = []
    for index in in_order(dataset, "face_texts.json" if face else "texts.json", clips=clips.tolist()):
        found = [c.text for c in captions_of(dataset, index, face=face)]
        if not found:
            raise UserError(
                f"clip {dataset.ids[index]}: no {'face ' if face else ''}caption to train a GPT on"
            )
        captions.append([names.setdefault(caption, len(names)) for caption in found])
    return captions, list(names)
