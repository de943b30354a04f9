"""GPT stages: Hierarchical-GPT over body and hand tokens, and the face GPT (HumanTOMATO sections 3.3-3.6)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor, nn
from torch.utils.data import Dataset

from motionloom.datasets.motion.layout import MotionLayout, Part
from motionloom.datasets.schema import UserError
from motionloom.models.gpt.drawing import Drawing
from motionloom.models.gpt.losses import GptLossConfig
from motionloom.models.gpt.network import GptConfig, InterleavedGPT
from motionloom.models.gpt.sampling import generate
from motionloom.models.gpt.streaming import TokenStream
from motionloom.models.training.lora import LoraConfig, add_lora, merge_lora, require_peft
from motionloom.pipeline.contract.fingerprint import LATER
from motionloom.pipeline.contract.generation import GenerationRequest, MotionGenerator
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.showing import Curve
from motionloom.pipeline.contract.stage import GENERATOR, Finished, Given, Stage
from motionloom.pipeline.contract.streaming import FrameFlow, StreamConfig, TokenFlow
from motionloom.pipeline.inference.candidates import candidate_seeds, nearest_candidates, repeated
from motionloom.pipeline.inference.decoding import Frames
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.stages.gpt_data import GptClips, gpt_clips
from motionloom.pipeline.stages.gpt_flow import GptFlow
from motionloom.pipeline.stages.gpt_start import require_own_text, require_start
from motionloom.pipeline.stages.starting import START, require_start_layout
from motionloom.pipeline.stages.streams import require_streams, stream_facts
from motionloom.pipeline.stages.train_config import TrainConfig, TrainedStageConfig
from motionloom.pipeline.stages.trained import Batches, Example, Say, TrainedStage
from motionloom.pipeline.store.networks import LoadedGpt, LoadedTma, TrainedTokenizer, device_of
from motionloom.pipeline.store.text import TextSource
from motionloom.pipeline.store.tokens import TokenBatches
from motionloom.pipeline.store.weights import LayoutFacts, ModelFacts

if TYPE_CHECKING:
    from motionloom.models.gpt.module import GptModule

Prior = Literal["tma", "sentence"]

_CANDIDATES_AT_ONCE = 64
"""Motions sampled together where several are drawn for each text."""


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
    lora: LoraConfig | None = Field(None, json_schema_extra=LATER)
    """Train adapters beside the weights that `inputs.start` brings; null trains all. What is saved is one
    network of plain weights either way."""

    def require_fit(self, hardware: Hardware) -> None:
        """A model that samples as it trains is neither one graph nor cut over ranks, nor are adapters."""
        super().require_fit(hardware)
        if self.lora is not None:
            require_peft()
            if self.train.compile or self.train.strategy == "fsdp":
                raise UserError(
                    "lora trains adapters, which train.compile and train.strategy fsdp do not know; set "
                    "compile: false and strategy: ddp, or lora: null"
                )
        if self.aligned_on_samples and (self.train.compile or self.train.strategy == "fsdp"):
            raise UserError(
                "loss.align_on samples draws motions token by token, which train.compile and train.strategy "
                "fsdp cannot do; set compile: false and strategy: ddp, or align_on: predictions"
            )

    @property
    def aligned(self) -> bool:
        """Whether L_align is part of the loss."""
        return self.loss.align_weight > 0

    @property
    def aligned_on_samples(self) -> bool:
        """Whether it samples as it trains."""
        return self.aligned and self.loss.align_on == "samples"


class GptStage(TrainedStage):
    """A GPT, trained on exported tokens."""

    name = "gpt"
    summary = "GPT over motion tokens"
    config = GptStageConfig
    takes = ("data", "text", "tokenizer", "tokens", "tma?", "start?: gpt")
    version = 3  # captions about parts of clips, clips without hands, sBERT's filter, dropped texts

    def gives(self, config: GptStageConfig) -> frozenset[str]:
        """Motion of text."""
        return super().gives(config) | {GENERATOR}

    def check(self, stage: Stage, others: Mapping[str, Stage]) -> None:
        """Its TMA must read captions as it does, and a GPT that it starts from must be the same network."""
        require_own_text(stage, others)
        require_start(stage, others)

    def facts(self, config: GptStageConfig, given: Given) -> ModelFacts:
        """Config, streams and the width of the prior."""
        if (config.prior == "tma" or config.aligned) and "tma" not in given:
            raise UserError("prior 'tma' and align_weight > 0 need a tma stage before it")
        tokenizer: TrainedTokenizer = given["tokenizer"]
        text_dim = given["tma"].net.config.latent if config.prior == "tma" else given["text"].dim
        extra = {
            "text_dim": text_dim,
            "prior": config.prior,
            **stream_facts(tokenizer.net),
        }
        if START in given:
            require_start_layout(given["data"].layout, tokenizer.layout)
        layout = LayoutFacts.of(given["data"].layout)
        return ModelFacts(kind="gpt", config=config.net.dump(), layout=layout, extra=extra)

    def network(self, facts: ModelFacts, given: Given) -> InterleavedGPT:
        """The GPT over the tokenizer's streams, which must be those it was made for."""
        tokenizer = given["tokenizer"].net
        require_streams(facts, tokenizer, "GPT")
        config = GptConfig.parse(facts.config, facts.where)
        return InterleavedGPT(config, tokenizer.streams, tokenizer.pattern, facts.fact("text_dim", int))

    def prepare(self, config: GptStageConfig, net: InterleavedGPT, given: Given) -> None:
        """Go on from another GPT's weights, where the recipe names one."""
        if START in given:
            net.load_state_dict(given[START].net.state_dict())

    def module(self, config: GptStageConfig, net: Any, given: Given, seed: int) -> GptModule:
        """Cross-entropy, and L_align on what the frozen tokenizer and TMA make of its tokens."""
        from motionloom.models.gpt.module import GptModule

        if config.lora is not None:
            add_lora(net, config.lora)
        return GptModule(
            net,
            config.optim,
            seed=seed,
            max_steps=config.train.steps,
            loss=config.loss,
            tokenizer=given["tokenizer"].net if config.aligned else None,
            tma=given["tma"].net if config.aligned else None,
        )

    def trained(self, config: GptStageConfig, net: Any) -> None:
        """Adapters become part of the weights."""
        if config.lora is not None:
            merge_lora(net)

    def batches(self, config: GptStageConfig, net: nn.Module, given: Given, seed: int, say: Say) -> Batches:
        """Token sequences with one caption each."""
        assert isinstance(net, InterleavedGPT)
        data, text, tokenizer = given["data"], given["text"].cache, given["tokenizer"].net
        tma = given["tma"] if config.prior == "tma" or config.aligned else None

        @cache
        def clips_of(split: str) -> GptClips:
            store = given["tokens"].open(split)
            dataset = data.split(split)
            clips = gpt_clips(dataset, store, tokenizer, face=config.face, min_frames=config.min_frames)
            if clips.uncaptioned:
                kind = "face caption" if config.face else "caption"
                say(f"{split}: {clips.uncaptioned} clips without a {kind} are left out")
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
                seed,
                rank,
                world,
                training,
                clips.sources,
                ids=clips.ids,
                latents=latents if config.aligned and config.prior != "tma" else None,
                present=clips.present,
            )

        def train(batch: int, rank: int, world: int) -> Dataset[Any]:
            return batches("train", batch, rank, world, training=True)

        def validation() -> Dataset[Any]:
            return batches(data.held_out().split, 32, training=False)

        return Batches(train, validation)

    def dry_module(self, config: GptStageConfig, net: Any, given: Given) -> GptModule:
        """Without the judge of sampled motions, which keeps nothing for the backward pass, and without
        adapters, which peft cannot make of tensors without values: a bound from above.
        """
        module = self.module(config.model_copy(update={"lora": None}), net, given, seed=0)
        if config.aligned_on_samples:
            module.tokenizer = None
        return module

    def example(self, config: GptStageConfig, net: Any, given: Given, batch: int) -> Example:
        """The longest sequences; samples that are judged are so many more rows."""
        assert isinstance(net, InterleavedGPT)
        if config.aligned_on_samples:
            batch *= 1 + config.loss.samples
        tokenizer, groups, ends = given["tokenizer"].net, net.max_groups, len(net.names)
        length = groups * len(net.pattern) + ends
        order = torch.tensor([net.names.index(name) for name in (net.pattern * groups + net.names)])
        inputs = {
            "tokens": torch.zeros(batch, length, dtype=torch.int64),
            "kinds": order.expand(batch, -1),
            "text": torch.empty(batch, net.text_dim),
            "similarity": torch.empty(batch, given["text"].dim),
        }
        if config.aligned and "tma" in given:
            inputs["tma_text"] = torch.empty(batch, given["tma"].net.config.latent)
        parts = " + ".join(f"{groups * s.per_group} {s.name}" for s in tokenizer.streams)
        frames = groups * tokenizer.group_frames
        return Example(inputs, f"{parts} + {ends} End = {length} for {frames} frames")

    def loaded(self, net: InterleavedGPT, facts: ModelFacts, given: Given) -> LoadedGpt:
        """The network and its kind of prior."""
        return LoadedGpt(net, facts.fact("prior", str))

    def generator(self, stage: Finished, given: Given, device: torch.device) -> MotionGenerator:
        """Motion, or expressions, of text."""
        return GptGenerator(self.load(stage, given, device), given, stage.config.face)

    def exported(self, config: GptStageConfig) -> tuple[str, ...]:
        """What decodes its tokens and encodes its words."""
        return ("tokenizer", "text", "tma") if config.prior == "tma" else ("tokenizer", "text")

    def curves(self, config: Any) -> tuple[Curve, ...]:
        """Cross-entropy and accuracy."""
        return (Curve("ce"), Curve("accuracy"), Curve("align"))


@dataclass(frozen=True)
class GptGenerator:
    """Tokens sampled from a GPT, then decoded: body and hands, or the face's residual codes (B.4)."""

    gpt: LoadedGpt
    given: Mapping[str, Any]
    face: bool
    method = "gpt"
    modalities = frozenset({"text"})

    @property
    def tokenizer(self) -> TrainedTokenizer:
        """What decodes the tokens."""
        tokenizer: TrainedTokenizer = self.given["tokenizer"]
        return tokenizer

    @property
    def layout(self) -> MotionLayout:
        """Layout of whole frames."""
        return self.tokenizer.layout

    @property
    def text(self) -> TextSource | None:
        """What encodes its words."""
        text: TextSource | None = self.given.get("text")
        return text

    @property
    def part(self) -> Part:
        """The columns that the tokenizer models."""
        return self.tokenizer.net.part

    @property
    def settings(self) -> frozenset[str]:
        """How tokens are drawn."""
        more = {"face_cfg_scale"} if self.face else set()
        more |= {"candidates"} if self.judge is not None else set()
        return frozenset({"temperature", "top_k", "top_p", "cfg_scale"} | more)

    @property
    def judge(self) -> LoadedTma | None:
        """The TMA that tells its motions apart: the one its prior comes from, if that reads what it makes."""
        tma: LoadedTma | None = self.given.get("tma") if self.gpt.prior == "tma" else None
        return tma if tma is not None and tma.part == self.part else None

    @property
    def unit_frames(self) -> int:
        """A group of tokens."""
        return self.tokenizer.net.group_frames

    @property
    def max_frames(self) -> int:
        """What the GPT's block holds."""
        return self.gpt.net.max_groups * self.unit_frames

    def prior(self, request: GenerationRequest) -> Tensor:
        """First input of the GPT [B, E]: the TMA text latent or the sentence embedding."""
        if self.gpt.prior == "sentence":
            return request.pooled_text("this GPT").to(device_of(self.gpt.net))
        if "tma" not in self.given:
            raise UserError("this GPT needs the TMA text encoder, and no tma stage is here")
        text = request.text("this GPT")
        latent: Tensor = self.given["tma"].embed_text(text.features, text.mask)
        return latent

    def generate(self, request: GenerationRequest) -> list[NDArray[np.float32]]:
        """Lengths that are no whole groups are made of one group more, and cut. Of several candidates the
        one nearest to its text is kept.
        """
        prior, judge, count = self.prior(request), self.judge, request.sampling.candidates
        if judge is None or count == 1:
            return self._drawn(prior, request.frames, request.seeds, request.sampling)
        out: list[NDArray[np.float32]] = []
        at_once = max(1, _CANDIDATES_AT_ONCE // count)
        for start in range(0, len(prior), at_once):
            rows = slice(start, start + at_once)
            frames = None if request.frames is None else repeated(request.frames[rows], count)
            texts, seeds = prior[rows], candidate_seeds(request.seeds[rows], count)
            drawn = self._drawn(texts.repeat_interleave(count, dim=0), frames, seeds, request.sampling)
            out += nearest_candidates(judge, texts, drawn)
        return out

    @torch.no_grad()
    def _drawn(
        self, prior: Tensor, frames: Sequence[int] | None, seeds: Sequence[int], sampling: SamplingConfig
    ) -> list[NDArray[np.float32]]:
        """One motion for each row of the prior [B, E]."""
        unit = self.unit_frames
        groups = None if frames is None else torch.tensor([-(-n // unit) for n in frames])
        codes = generate(
            self.gpt.net,
            prior,
            groups=groups,
            temperature=sampling.temperature,
            top_k=sampling.top_k or None,
            top_p=sampling.top_p,
            cfg_scale=sampling.face_guidance if self.face else sampling.cfg_scale,
            seed=list(seeds),
        )
        motions = self.tokenizer.decode(codes.codes, codes.groups.tolist())
        if frames is None:
            return motions
        return [motion[:count] for motion, count in zip(motions, frames, strict=True)]

    def flow(self, seed: int, sampling: SamplingConfig, streaming: StreamConfig) -> TokenFlow:
        """Tokens as they come; a full block, or another text, goes on from the last frames."""
        tokens = TokenStream(
            self.gpt.net,
            how=Drawing(sampling.temperature, sampling.top_k or None, sampling.top_p),
            context=streaming.context_frames // self.unit_frames,
            cfg_scale=sampling.face_guidance if self.face else sampling.cfg_scale,
            seed=seed,
        )
        return GptFlow(tokens, lambda conditions: self.prior(GenerationRequest(conditions, None, [seed])))

    def decoding(self, seed: int, sampling: SamplingConfig, streaming: StreamConfig) -> FrameFlow:
        """The tokenizer's own decoder."""
        if streaming.decoder == "diffusion":
            raise UserError("this model has no diffusion decoder; leave streaming's decoder out")
        return Frames.of_tokenizer(self.tokenizer, streaming)
