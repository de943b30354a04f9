"""The stage table: one line per kind.

A new stage is a network file, a LightningModule file, a line here and a recipe entry.
"""

from __future__ import annotations

from motionloom.pipeline.stages import (
    convert,
    data,
    diffusion,
    evaluate,
    generate,
    gpt,
    prepare,
    report,
    tma,
    tokenizer,
    tokens,
)
from motionloom.pipeline.stages.stage import StageConfig, StageKind

_ALL_MODELS = (
    "data",
    "stats",
    "text",
    "tokenizer",
    "tma?",
    "gpt",
    "face_tokenizer?",
    "face_gpt?",
    "face_vae?",
    "face_diffusion?",
)


def _tokenizer(name: str, summary: str, config: type[StageConfig]) -> StageKind:
    # Version 2: fingers in the palm's frame (`finger_gain`).
    run, inputs = tokenizer.run_tokenizer, ("data", "stats")
    return StageKind(name, summary, config, run, inputs, version=2, trains=True)


STAGES: dict[str, StageKind] = {
    kind.name: kind
    for kind in (
        StageKind("synth", "synthetic shards", data.SynthStageConfig, data.run_synth),
        *(
            StageKind(
                name, f"shards from {title}", config, convert.run_convert, external=convert.source_facts
            )
            for name, (title, config) in convert.CONVERTED.items()
        ),
        StageKind(
            "shards",
            "existing shards",
            data.ShardsStageConfig,
            data.run_shards,
            external=data.shards_source,
            settle=data.settle_shards,
        ),
        StageKind("stats", "mean and deviation", prepare.StatsConfig, prepare.run_stats, ("data",)),
        # Version 2: `similarity`.
        StageKind("text", "caption embeddings", prepare.TextConfig, prepare.run_text, ("data",), version=2),
        _tokenizer("h2vq", "H2VQ tokenizer", tokenizer.H2VQStageConfig),
        _tokenizer("vq", "VQ tokenizer", tokenizer.VqStageConfig),
        _tokenizer("rvq", "RVQ tokenizer", tokenizer.RvqStageConfig),
        _tokenizer("separate", "body and hands apart", tokenizer.SeparateStageConfig),
        _tokenizer("fsq", "FSQ tokenizer", tokenizer.FsqStageConfig),
        StageKind(
            "tma",
            "text-motion alignment",
            tma.TmaStageConfig,
            tma.run_tma,
            ("data", "stats", "text"),
            version=2,  # the filter of negatives is sBERT's
            trains=True,
        ),
        StageKind(
            "diffusion",
            "motion diffusion",
            diffusion.DiffusionStageConfig,
            diffusion.run_diffusion,
            ("data", "stats", "text"),
            trains=True,
        ),
        StageKind(
            "tokens", "token export", tokens.TokensConfig, tokens.run_tokens, ("data", "stats", "tokenizer")
        ),
        StageKind(
            "gpt",
            "GPT over motion tokens",
            gpt.GptStageConfig,
            gpt.run_gpt,
            ("data", "text", "tokenizer", "tokens", "tma?", "start?"),
            version=3,  # captions about parts of clips, clips without hands, sBERT's filter, dropped texts
            trains=True,
        ),
        # Version 2 of these three: captions about parts of clips; none without a caption.
        StageKind(
            "generate",
            "motions from captions",
            generate.GenerateConfig,
            generate.run_generate,
            _ALL_MODELS,
            version=2,
        ),
        StageKind(
            "evaluate",
            "figures on the test split",
            evaluate.EvaluateConfig,
            evaluate.run_evaluate,
            _ALL_MODELS,
            version=2,
        ),
        StageKind(
            "report",
            "the page to watch",
            report.ReportConfig,
            report.run_report,
            (*_ALL_MODELS, "generate?", "evaluate?"),
            version=2,
        ),
    )
}
