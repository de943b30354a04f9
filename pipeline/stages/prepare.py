"""Statistics and text conditions: what every training stage reads beside the motion."""

from __future__ import annotations

from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.shards.statistics import compute
from motionloom.datasets.text.cache import TextCache
from motionloom.datasets.text.encoder import load_text_encoder
from motionloom.pipeline.sources import captions_of, open_split, splits_of
from motionloom.pipeline.stage import StageConfig, StageContext


class StatsConfig(StageConfig):
    """Mean and standard deviation per feature dimension, from the training split only."""

    group: bool = False
    """Average the deviation over each kind of feature, as HumanML3D does."""


class TextConfig(StageConfig):
    """Sentence and token embeddings of every caption, computed once."""

    encoder: str = "minilm"
    """`minilm` (comes with the installation), a local sentence-transformers folder, or a hub name."""


def run_stats(context: StageContext) -> None:
    """One streaming pass over the training split."""
    dataset = open_split(context.input("data"), "train")
    compute(dataset, group=context.config.group).save(context.folder / "stats.safetensors")
    context.console.print(
        f"    {len(dataset)} clips, {int(dataset.frames.sum())} frames, {dataset.layout.dim} dimensions"
    )


def run_text(context: StageContext) -> None:
    """Embed the captions of all splits."""
    captions: set[str] = set()
    for split in splits_of(context.input("data")):
        dataset: ShardDataset = open_split(context.input("data"), split)
        for index in range(len(dataset)):
            captions.update(c.text for c in captions_of(dataset, index, face=False))
            captions.update(c.text for c in captions_of(dataset, index, face=True))
    encoder = load_text_encoder(context.config.encoder)
    TextCache.build(context.folder / "cache", captions, encoder, progress=context.console.is_terminal)
    context.console.print(
        f"    {len(captions)} different captions, {encoder.dim}-d embeddings by {encoder.name}"
    )
