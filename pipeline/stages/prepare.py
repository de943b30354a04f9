"""Statistics and text conditions: what every training stage reads beside the motion."""

from __future__ import annotations

from motionloom.datasets.loading.statistics import compute
from motionloom.datasets.shards.clips import in_order
from motionloom.datasets.text.build import build_text_cache
from motionloom.pipeline.stages.stage import StageConfig, StageContext
from motionloom.pipeline.store.data import captions_of, open_split, splits_of
from motionloom.pipeline.store.encoder_files import keep_place


class StatsConfig(StageConfig):
    """Mean and standard deviation per feature dimension, from the training split only."""

    group: bool = False
    """Average the deviation over each kind of feature, as HumanML3D does."""


class TextConfig(StageConfig):
    """Sentence and token embeddings of every caption, computed once."""

    encoder: str = "minilm"
    """`minilm` (comes with the installation), a folder with a sentence-transformers, BERT-like or CLIP model,
    or a name on the Hugging Face hub."""
    similarity: str = "minilm"
    """The encoder, named likewise, that says which captions mean the same: the paper's sBERT (D.1, D.2), for
    the filter of negatives and retrieval protocol B, whatever `encoder` is."""


def run_stats(context: StageContext) -> None:
    """One streaming pass over the training split."""
    dataset = open_split(context.input("data"), "train")
    compute(dataset, group=context.config.group).save(context.folder / "stats.safetensors")
    context.console.print(
        f"    {len(dataset)} clips, {int(dataset.frames.sum())} frames, {dataset.layout.dim} dimensions"
    )


def run_text(context: StageContext) -> None:
    """Embed the captions of all splits."""
    keep_place(context.config.encoder, context.folder)
    captions: set[str] = set()
    for split in splits_of(context.input("data")):
        dataset = open_split(context.input("data"), split)
        for index in in_order(dataset, "texts.json", "face_texts.json"):
            captions.update(c.text for c in captions_of(dataset, index, face=False))
            captions.update(c.text for c in captions_of(dataset, index, face=True))
    cache = build_text_cache(
        context.folder / "cache",
        captions,
        context.config.encoder,
        workers=context.hardware.convert_workers,
        progress=context.console.is_terminal,
        device=str(context.device),
        similarity=context.config.similarity,
    )
    context.console.print(
        f"    {len(captions)} different captions, {cache.dim}-d embeddings by {cache.encoder}"
    )
