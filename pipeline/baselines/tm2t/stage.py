"""TM2T (Guo et al. 2022): motion tokens to words, and words to motion tokens."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from pydantic import Field
from torch import Tensor
from torch.utils.data import Dataset

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.modalities.table import MODALITIES
from motionloom.datasets.text.cache import TextCache
from motionloom.models.training.optim import OptimConfig
from motionloom.pipeline.baselines.tm2t.generator import (
    Seq2SeqGenerator,
    TokenCaptioner,
    captioner_names,
    published_words,
)
from motionloom.pipeline.baselines.tm2t.network import (
    Captioner,
    CaptionerConfig,
    CaptionLossConfig,
    Seq2SeqLossConfig,
    Vocabulary,
)
from motionloom.pipeline.baselines.tm2t.seq2seq import Seq2Seq, Seq2SeqConfig
from motionloom.pipeline.baselines.tm2t.tokenizer import Tm2tStage, Tm2tStageConfig
from motionloom.pipeline.contract.captioning import MotionCaptioner
from motionloom.pipeline.contract.generation import MotionGenerator
from motionloom.pipeline.contract.showing import Curve
from motionloom.pipeline.contract.stage import CAPTIONER, GENERATOR, CompletedStage, Inputs, register
from motionloom.pipeline.stages.networks.tokens import Tokens, token_batches, token_example
from motionloom.pipeline.store.data import Data, DataPreview, captions_of
from motionloom.pipeline.store.networks import TrainedTokenizer, require_streams, stream_facts
from motionloom.pipeline.store.text import TextSource
from motionloom.pipeline.store.tokens import GptClips, TokenBatches, gpt_clips
from motionloom.pipeline.store.weights import ModelFacts, Release
from motionloom.pipeline.training.config import TrainConfig, TrainedStageConfig
from motionloom.pipeline.training.trained_stage import Batches, Example, Log, TrainedStage


class CaptionerStageConfig(TrainedStageConfig):
    """Motion tokens to words."""

    net: CaptionerConfig = CaptionerConfig()
    loss: CaptionLossConfig = CaptionLossConfig()
    optim: OptimConfig = OptimConfig(optimizer="adam", lr=2e-4, betas=(0.9, 0.999), grad_clip=0.5)
    train: TrainConfig = TrainConfig(steps=100_000, batch_size=64)
    vocabulary: int = Field(4000, ge=1)
    """Most words; the frequent ones are kept. Others are read as one unknown word and never written."""
    least_uses: int = Field(2, ge=1)
    """Training captions that must have a word for it to be kept."""
    min_frames: int = Field(16, ge=1)
    """Captions about fewer frames are left out where the clip has a longer one."""


class CaptionerInputs(Inputs):
    """Captioned clips and their tokens."""

    data: Data
    tokenizer: TrainedTokenizer
    tokens: Tokens


class CaptionerStage(TrainedStage[CaptionerStageConfig, CaptionerInputs, Captioner]):
    """TM2T's captioner (section 3.3), on the tokens of any tokenizer."""

    name = "captioner"
    summary = "motion tokens to words"
    trainer = "motionloom.pipeline.baselines.tm2t.module:CaptionerModule"
    config = CaptionerStageConfig
    offers = frozenset({CAPTIONER})
    inputs = CaptionerInputs
    curves = (Curve("ce"), Curve("accuracy"))
    exports = ("tokenizer",)

    def facts(self, config: CaptionerStageConfig, inputs: CaptionerInputs) -> ModelFacts:
        published = config.published
        words = published_words(published) if published else _vocabulary(config, inputs.data).words
        extra = {"words": list(words), **stream_facts(inputs.tokenizer.net)}
        return ModelFacts.of(self.name, config.net, inputs.data.layout, extra)

    def network(self, facts: ModelFacts, inputs: CaptionerInputs) -> Captioner:
        tokenizer = inputs.tokenizer.net
        require_streams(facts, tokenizer, "captioner")
        config = CaptionerConfig.parse(facts.config, facts.where)
        return Captioner(config, tokenizer.streams, tokenizer.pattern, len(_words(facts)))

    def release(self, net: Captioner) -> Release | None:
        """TM2T's, of one codebook."""
        if len(net.names) > 1:
            return None
        return Release(captioner_names(net), unread=("trg_word_prj.weight", "*.positional_encoding"))

    def batches(
        self, config: CaptionerStageConfig, net: Captioner, inputs: CaptionerInputs, seed: int, log: Log
    ) -> Batches:
        vocabulary = _vocabulary(config, inputs.data)
        if len(vocabulary.words) == config.vocabulary:
            log(f"the {config.vocabulary} most frequent words of the training captions are kept")

        def words(clips: GptClips) -> dict[str, Tensor]:
            return _unlike(clips, vocabulary.encode(clips.texts, net.config.max_words))

        return token_batches(net, _clips(config, inputs), inputs.data.held_out().split, seed, words)

    def example(
        self, config: CaptionerStageConfig, net: Captioner, inputs: CaptionerInputs, batch: int
    ) -> Example:
        longest = config.net.max_words
        words = torch.ones(batch, longest + 1, dtype=torch.int64)
        tensors = token_example(net, batch)
        frames = net.max_groups * inputs.tokenizer.net.group_frames
        count = tensors["tokens"].shape[1]
        return Example(tensors | {"text": words}, f"{count} tokens for {frames} frames, {longest} words")

    def captioner(self, stage: CompletedStage, given: Inputs, device: torch.device) -> MotionCaptioner:
        loaded: TokenCaptioner = self.load(stage, given, device)
        return loaded

    def loaded(self, net: Captioner, facts: ModelFacts, inputs: CaptionerInputs) -> TokenCaptioner:
        return TokenCaptioner(net, inputs.tokenizer, _words(facts))


class Seq2SeqStageConfig(TrainedStageConfig):
    """Words to motion tokens."""

    net: Seq2SeqConfig = Seq2SeqConfig()
    loss: Seq2SeqLossConfig = Seq2SeqLossConfig()
    optim: OptimConfig = OptimConfig(optimizer="adam", lr=2e-4, betas=(0.9, 0.999), grad_clip=0.5)
    train: TrainConfig = TrainConfig(steps=100_000, batch_size=64)
    min_frames: int = Field(16, ge=1)
    """Captions about fewer frames are left out where the clip has a longer one."""


class Seq2SeqInputs(Inputs):
    """The same, encoded words, and the captioner of inverse alignment."""

    data: Data
    text: TextSource
    tokenizer: TrainedTokenizer
    tokens: Tokens
    captioner: TokenCaptioner | None


@dataclass(frozen=True)
class _WordBatches(Dataset[dict[str, object]]):
    """Batches whose "text" is the number of a caption, with the states of its words in place of it."""

    batches: TokenBatches
    texts: list[str]
    cache: TextCache
    said: Tensor | None
    """The captions as the captioner's vocabulary has them, [m, W]."""

    def __len__(self) -> int:
        return len(self.batches)

    def __getitem__(self, k: int) -> dict[str, object]:
        batch = self.batches[k]
        rows = batch.pop("text")[:, 0]
        states, mask = self.cache.tokens([self.texts[row] for row in rows.tolist()])
        batch |= {"words": torch.from_numpy(states), "mask": torch.from_numpy(mask)}
        return batch if self.said is None else batch | {"said": self.said[rows]}


class Seq2SeqStage(TrainedStage[Seq2SeqStageConfig, Seq2SeqInputs, Seq2Seq]):
    """TM2T's text to motion (sections 3.2 and 3.4), on the tokens of any tokenizer."""

    name = "seq2seq"
    summary = "words to motion tokens by a GRU"
    trainer = "motionloom.pipeline.baselines.tm2t.module:Seq2SeqModule"
    config = Seq2SeqStageConfig
    offers = frozenset({GENERATOR})
    inputs = Seq2SeqInputs
    curves = (Curve("ce"), Curve("accuracy"), Curve("inverse"))
    exports = ("tokenizer", "text")

    def facts(self, config: Seq2SeqStageConfig, inputs: Seq2SeqInputs) -> ModelFacts:
        extra = {"text_dim": inputs.text.dim, **stream_facts(inputs.tokenizer.net)}
        return ModelFacts.of(self.name, config.net, inputs.data.layout, extra)

    def network(self, facts: ModelFacts, inputs: Seq2SeqInputs) -> Seq2Seq:
        tokenizer = inputs.tokenizer.net
        require_streams(facts, tokenizer, "GRU")
        config = Seq2SeqConfig.parse(facts.config, facts.where)
        return Seq2Seq(config, tokenizer.streams, tokenizer.pattern, facts.fact("text_dim", int))

    def module_settings(
        self, config: Seq2SeqStageConfig, net: Seq2Seq, inputs: Seq2SeqInputs
    ) -> dict[str, object]:
        judge = _captioner(config, net, inputs)
        return {"captioner": None if judge is None else judge.net}

    def batches(
        self, config: Seq2SeqStageConfig, net: Seq2Seq, inputs: Seq2SeqInputs, seed: int, log: Log
    ) -> Batches:
        judge = _captioner(config, net, inputs)
        text = inputs.text.cache

        def numbers(clips: GptClips) -> dict[str, Tensor]:
            return _unlike(clips, torch.arange(len(clips.texts))[:, None])

        def worded(clips: GptClips, batches: TokenBatches) -> _WordBatches:
            said = None
            if judge is not None:
                said = judge.vocabulary.encode(clips.texts, judge.net.config.max_words)
            return _WordBatches(batches, clips.texts, text, said)

        held_out = inputs.data.held_out().split
        return token_batches(net, _clips(config, inputs), held_out, seed, numbers, worded)

    def example(self, config: Seq2SeqStageConfig, net: Seq2Seq, inputs: Seq2SeqInputs, batch: int) -> Example:
        words = MODALITIES["text"].example(batch, 0, inputs.text.dim)
        judge = _captioner(config, net, inputs)
        tensors = token_example(net, batch) | {"words": words.features, "mask": words.mask}
        if judge is not None:
            tensors["said"] = torch.ones(batch, judge.net.config.max_words + 1, dtype=torch.int64)
        frames = net.max_groups * inputs.tokenizer.net.group_frames
        return Example(tensors, f"{tensors['tokens'].shape[1]} tokens for {frames} frames")

    def generator(self, stage: CompletedStage, given: Inputs, device: torch.device) -> MotionGenerator:
        return Seq2SeqGenerator(self.load(stage, given, device), given)


def _clips(
    config: CaptionerStageConfig | Seq2SeqStageConfig, inputs: CaptionerInputs | Seq2SeqInputs
) -> Callable[[str], GptClips]:
    """Return what opens the captioned clips of a split with their tokens."""

    def clips_of(split: str) -> GptClips:
        dataset = inputs.data.split(split)
        store = inputs.tokens.open(split)
        return gpt_clips(dataset, store, inputs.tokenizer.net, face=False, min_frames=config.min_frames)

    return clips_of


def _unlike(clips: GptClips, prior: Tensor) -> dict[str, Tensor]:
    """Tables of batches in which nothing asks which captions are alike."""
    return {"prior": prior, "similarity": torch.zeros(len(clips.texts), 0)}


def _captioner(config: Seq2SeqStageConfig, net: Seq2Seq, inputs: Seq2SeqInputs) -> TokenCaptioner | None:
    """The captioner of inverse alignment; None where that is turned off."""
    if not config.loss.inverse_weight:
        return None
    found = inputs.captioner
    if found is None:
        raise UserError("loss.inverse_weight > 0 needs a captioner stage before it; add one, or set it to 0")
    if (found.net.pattern, found.net.num_codes) != (net.pattern, net.num_codes):
        raise UserError(
            f"the captioner reads streams {found.net.num_codes} in the order {list(found.net.pattern)}, this "
            f"model writes {net.num_codes} in the order {list(net.pattern)}; train both on one tokenizer"
        )
    if found.net.max_groups < net.max_groups:
        raise UserError(
            f"the captioner reads {found.net.max_groups} groups of tokens and this model writes up to "
            f"{net.max_groups}; raise the captioner's net.block_size or lower net.max_tokens"
        )
    return found


def _words(facts: ModelFacts) -> Vocabulary:
    return Vocabulary(tuple(map(str, facts.fact("words", list))))


def _vocabulary(config: CaptionerStageConfig, data: Data | DataPreview) -> Vocabulary:
    """The words of the training captions; before there are any, as many as may be."""
    if isinstance(data, DataPreview):
        return Vocabulary(tuple(f"word{number}" for number in range(config.vocabulary)))
    train = data.split("train")
    captioned = [int(clip) for clip in train.has("texts.json").nonzero()[0]]
    found = [caption.text for clip in captioned for caption in captions_of(train, clip, face=False)]
    return Vocabulary.of(found, most=config.vocabulary, least_uses=config.least_uses)


register(Tm2tStage("tm2t", "TM2T's tokenizer", Tm2tStageConfig))
register(CaptionerStage())
register(Seq2SeqStage())
