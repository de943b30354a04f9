"""Our own stage kinds, registered: one line each (`contract/registry.py`)."""

from __future__ import annotations

from motionloom.pipeline.contract.registry import register
from motionloom.pipeline.stages.aligned_text import AlignedTextStage
from motionloom.pipeline.stages.audio import AudioStage
from motionloom.pipeline.stages.convert import CONVERTED, ConvertStage, run_convert
from motionloom.pipeline.stages.data import (
    DataStage,
    ShardsStage,
    ShardsStageConfig,
    SynthStageConfig,
    run_shards,
    run_synth,
)
from motionloom.pipeline.stages.diffusion import DiffusionStage
from motionloom.pipeline.stages.dmd import DmdStage
from motionloom.pipeline.stages.evaluate import EvaluateStage
from motionloom.pipeline.stages.evaluate_dances import EvaluateDancesStage
from motionloom.pipeline.stages.evaluator import EvaluatorStage
from motionloom.pipeline.stages.generate import GenerateStage
from motionloom.pipeline.stages.gpt import GptStage
from motionloom.pipeline.stages.guo_evaluator import GuoEvaluatorStage
from motionloom.pipeline.stages.mix import MixStage
from motionloom.pipeline.stages.prepare import StatsStage, TextStage
from motionloom.pipeline.stages.report import ReportStage
from motionloom.pipeline.stages.rewordings import RewordingsStage
from motionloom.pipeline.stages.tma import TmaStage
from motionloom.pipeline.stages.tokenizer import TOKENIZERS, TokenizerStage
from motionloom.pipeline.stages.tokens import TokensStage
from motionloom.pipeline.stages.ude import UdeStage
from motionloom.pipeline.stages.utt import UttStage

register(DataStage("synth", "synthetic shards", SynthStageConfig, run_synth))
for name, (title, config) in CONVERTED.items():
    register(ConvertStage(name, f"shards from {title}", config, run_convert))
register(ShardsStage("shards", "existing shards", ShardsStageConfig, run_shards))
register(MixStage())
register(StatsStage())
register(TextStage())
register(RewordingsStage())
register(AlignedTextStage())
register(AudioStage())
for name, summary, config in TOKENIZERS:
    register(TokenizerStage(name, summary, config))
register(TmaStage())
register(DiffusionStage())
register(EvaluatorStage())
register(GuoEvaluatorStage())
register(TokensStage())
register(GptStage())
register(UttStage())
register(DmdStage())
register(UdeStage())
register(GenerateStage())
register(EvaluateStage())
register(EvaluateDancesStage())
register(ReportStage())
