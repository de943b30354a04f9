"""A small training of every kind of stage on made-up batches, for comparisons of ranks with one process."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor
from ude_training import draws_of_all

from motionloom.datasets.conditions import Condition
from motionloom.datasets.motion.layout import PIECES, MotionLayout
from motionloom.models.diffusion.module import DenoiserModule, TextDenoiserModule
from motionloom.models.diffusion.network import TextDenoiserConfig
from motionloom.models.evaluator.module import EvaluatorModule
from motionloom.models.evaluator.network import Evaluator, EvaluatorConfig
from motionloom.models.gpt.losses import GptLossConfig
from motionloom.models.gpt.module import GptModule
from motionloom.models.gpt.network import GptConfig, InterleavedGPT
from motionloom.models.gpt.tokens import interleave
from motionloom.models.tma.losses import TmaLossConfig
from motionloom.models.tma.module import TmaModule
from motionloom.models.tma.network import Tma, TmaConfig
from motionloom.models.tokenizer.base import Stream, TokenizerConfig
from motionloom.models.tokenizer.body_hand import H2VQConfig, SeparateConfig
from motionloom.models.tokenizer.module import TokenizerModule
from motionloom.models.tokenizer.single import FsqConfig, MqConfig, RvqConfig
from motionloom.models.training.distributed import rank, world_size
from motionloom.models.training.stage_module import OptimConfig, StageModule
from motionloom.pipeline.baselines.mdm.network import Mdm
from motionloom.pipeline.baselines.mld.module import LatentDiffusionModule, MotionVaeModule
from motionloom.pipeline.baselines.mld.network import (
    LatentDenoiser,
    LatentDiffusionConfig,
    MotionVae,
    MotionVaeConfig,
    MotionVaeLossConfig,
)
from motionloom.pipeline.baselines.motionclip.module import MotionClipModule
from motionloom.pipeline.baselines.motionclip.network import (
    MotionClip,
    MotionClipConfig,
    MotionClipLossConfig,
)
from motionloom.pipeline.baselines.motiondiffuse.network import (
    CaptionConfig,
    MotionDiffuse,
    MotionDiffuseConfig,
)
from motionloom.pipeline.baselines.tm2t.module import CaptionerModule, Seq2SeqModule
from motionloom.pipeline.baselines.tm2t.network import (
    Captioner,
    CaptionerConfig,
    CaptionLossConfig,
    Seq2SeqLossConfig,
)
from motionloom.pipeline.baselines.tm2t.seq2seq import Seq2Seq, Seq2SeqConfig
from motionloom.pipeline.baselines.tm2t.tokenizer import Tm2tConfig
from motionloom.pipeline.editing.inbetween.module import InBetweenModule
from motionloom.pipeline.editing.inbetween.network import InBetweenConfig, InBetweener
from motionloom.pipeline.editing.inbetween.observed import Observations

STEPS = 12
BATCH, FRAMES, TEXT = 6, 24, 6
LAYOUT = MotionLayout.named("wholebody313")
OPTIM = OptimConfig(lr=1e-3)
LENGTH = torch.tensor([24, 23, 9, 5, 24, 2])  # 56 real frames on the first rank, 31 on the second
SMALL: dict[str, Any] = {"width": 8, "depth": 1, "code_dim": 8, "velocity_weight": 0.5}
# Few enough uses that codes are reset, after the first step too.
BOOK: dict[str, Any] = {**SMALL, "num_codes": 12, "decay": 0.8, "alpha": 0.5, "reset_below": 0.6}

Batches = Callable[[int], dict[str, Tensor]]


def motion(step: int, dim: int) -> dict[str, Tensor]:
    """A moving distribution, so that codes die on the way; behind a clip's end there is rubbish."""
    generator = torch.Generator().manual_seed(step)
    values = torch.randn(BATCH, FRAMES, dim, generator=generator, dtype=torch.float64)
    return {"motion": values + 0.05 * step, "length": LENGTH}


def tokenizer(config: TokenizerConfig, handed: tuple[bool, ...] = ()) -> tuple[StageModule, Batches]:
    """`handed` says which clips of a batch hold hands; all when empty."""
    net = config.build(LAYOUT)
    net.basis.learn(
        np.zeros(net.dim), np.full(net.dim, 0.02)
    )  # independent noise in every column bends fingers wildly
    module = TokenizerModule(net, OPTIM, seed=0, max_steps=STEPS)
    present = torch.ones(BATCH, net.dim, dtype=torch.bool)
    for row in (row for row, has in enumerate(handed) if not has):
        present[row, np.searchsorted(net.columns.numpy(), LAYOUT.part("hand"))] = False
    return module, lambda step: motion(step, net.dim) | ({"present": present} if handed else {})


def captions(step: int) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(step)
    same = [0, 1, 2, 1, 3, 4]  # a caption that both ranks hold
    return {
        "conditions": {
            "text": Condition(
                torch.randn(BATCH, 4, TEXT, generator=generator, dtype=torch.float64),
                torch.arange(4)[None] < torch.tensor([4, 2, 3, 1, 4, 2])[:, None],
                torch.eye(TEXT, dtype=torch.float64)[same],
            )
        },
        "similarity": torch.eye(TEXT, dtype=torch.float64)[same],
    }


def tma() -> tuple[StageModule, Batches]:
    net = Tma(TmaConfig(latent=16, ff=32, layers=1, heads=2), 20, TEXT)
    loss = TmaLossConfig(kl=0.1, latent=0.1, contrastive=1.0)  # heavy, so that an error in a term would show
    module = TmaModule(net, OPTIM, seed=0, max_steps=STEPS, loss=loss)
    return module.eval(), lambda step: motion(step, 20) | captions(step)


def gpt() -> tuple[StageModule, Batches]:
    book = H2VQConfig(width=8, depth=1, code_dim=8, num_codes=9).build(LAYOUT)
    for quantizer in book.codebooks().values():
        quantizer.codebook.normal_()  # spread out, so that the alignment has something to gain
    aligned = Tma(TmaConfig(latent=16, ff=16, layers=1, heads=2), LAYOUT.dim, TEXT)
    config = GptConfig(layers=2, dim=16, heads=2, ff=32, block_size=20)
    net = InterleavedGPT(config, book.streams, book.pattern, text_dim=16)
    module = GptModule(
        net, OPTIM, seed=0, max_steps=STEPS, loss=GptLossConfig(align_weight=1.0),
        tokenizer=book, tma=aligned,
    )  # fmt: skip

    def batch(step: int) -> dict[str, Tensor]:
        tokens, generator = _interleaved(step)
        text = torch.randn(BATCH, 16, generator=generator, dtype=torch.float64)
        present = torch.ones(BATCH, LAYOUT.dim, dtype=torch.bool)
        present[HANDLESS.nonzero(), torch.from_numpy(LAYOUT.part("hand"))] = False
        return tokens | {"text": text, "similarity": captions(step)["similarity"], "present": present}

    return module.eval(), batch


def gpt_samples() -> tuple[StageModule, Batches]:
    """L_align on motions that the model draws: each row with its own seed, whatever rank it is on."""
    module, batch = gpt()
    assert isinstance(module, GptModule) and module.tokenizer is not None and module.tma is not None
    still = module.net.config.model_copy(
        update={"dropout": 0.0, "attention_dropout": 0.0, "condition_dropout": 0.0}
    )
    net = InterleavedGPT(still, module.tokenizer.module.streams, module.net.pattern, text_dim=16)
    drawn = UndrawnGpt(
        net, OPTIM, seed=0, max_steps=STEPS, loss=GptLossConfig(align_weight=1.0, align_on="samples"),
        tokenizer=module.tokenizer.module, tma=module.tma.module,
    )  # fmt: skip
    return drawn.train(), batch


class UndrawnGpt(GptModule):
    """The seeds of the samples are those of the whole batch, of which each rank takes its part."""

    def losses(self, batch: dict[str, Any]) -> dict[str, Tensor]:
        """As the base class, with the draws replaced."""
        whole = BATCH * self.loss_config.samples
        mine = slice(rank() * whole // world_size(), (rank() + 1) * whole // world_size())
        randint, generator = torch.randint, torch.Generator().manual_seed(0)
        try:
            torch.randint = lambda high, _: randint(high, (whole,), generator=generator)[mine]  # type: ignore[assignment]
            return super().losses(batch)
        finally:
            torch.randint = randint


def mdm() -> tuple[StageModule, Batches]:
    net = Mdm(TextDenoiserConfig(dim=16, ff=16, layers=1, heads=2), 20, TEXT)
    module = undrawn(TextDenoiserModule)(net, OPTIM, seed=0, max_steps=STEPS)
    return module.eval(), lambda step: motion(step, 20) | captions(step)


BODY: dict[str, Any] = {
    "layout": MotionLayout.named("body133"), "mean": np.zeros(133), "std": np.full(133, 0.05),
}  # fmt: skip


def inbetweener() -> tuple[StageModule, Batches]:
    layout, columns = BODY["layout"], BODY["layout"].part("all")
    config = InBetweenConfig(dim=16, ff=16, layers=1, heads=2, frames_per_token=1)
    net = InBetweener(config, 133, TEXT)
    observations = EndsObserved(layout, columns, BODY["mean"], BODY["std"], 1.0)
    module = undrawn(InBetweenModule)(net, OPTIM, seed=0, max_steps=STEPS, observations=observations)
    return module.eval(), lambda step: motion(step, 133) | captions(step)


def motion_vae() -> tuple[StageModule, Batches]:
    net = MotionVae(MotionVaeConfig(dim=16, ff=16, layers=3, heads=2), 133)
    module = MotionVaeModule(net, OPTIM, seed=0, max_steps=STEPS, loss=MotionVaeLossConfig(), **BODY)
    return module.eval(), lambda step: motion(step, 133)


def latent_diffusion() -> tuple[StageModule, Batches]:
    vae = MotionVae(MotionVaeConfig(dim=16, ff=16, layers=1, heads=2), 20).double()
    net = LatentDenoiser(LatentDiffusionConfig(dim=16, ff=16, layers=1, heads=2), 1, TEXT)
    module = undrawn(LatentDiffusionModule)(net, OPTIM, seed=0, max_steps=STEPS, vae=vae)
    return module.eval(), lambda step: motion(step, 20) | captions(step)


def motionclip() -> tuple[StageModule, Batches]:
    net = MotionClip(MotionClipConfig(latent=TEXT, ff=16, layers=1, heads=2), 133)
    module = MotionClipModule(net, OPTIM, seed=0, max_steps=STEPS, loss=MotionClipLossConfig(), **BODY)
    return module.eval(), lambda step: motion(step, 133) | captions(step)


def motiondiffuse() -> tuple[StageModule, Batches]:
    caption = CaptionConfig(dim=8, ff=8, layers=1, heads=2)
    config = MotionDiffuseConfig(dim=16, ff=16, layers=1, heads=2, caption=caption)
    module = undrawn(DenoiserModule)(MotionDiffuse(config, 20, TEXT), OPTIM, seed=0, max_steps=STEPS)
    return module.eval(), lambda step: motion(step, 20) | captions(step)


class Undrawn(StageModule):
    """Time steps and noise are those of the whole batch, of which each rank takes its part."""

    def losses(self, batch: dict[str, Any]) -> dict[str, Tensor]:
        """As the base class, with the draws replaced."""
        torch.manual_seed(0)
        with draws_of_all():
            return super().losses(batch)


def undrawn(kind: type[StageModule]) -> Any:
    """A kind of module whose losses draw for the whole batch."""
    return type(f"Undrawn{kind.__name__}", (Undrawn, kind), {})


class EndsObserved(Observations):
    """Observes all but the frames 2 to 5, and of clips of an odd length where the root is in these."""

    def _draw(self, length: Tensor, frames: int) -> tuple[Tensor, Tensor]:
        at = torch.arange(frames)
        inside, gap = at < length[:, None], (at >= 2) & (at < 6)
        pieces = (inside & ~gap)[..., None].expand(-1, -1, len(PIECES))
        return pieces, inside & gap & (length % 2 == 1)[:, None]


class Pairs(EvaluatorModule):
    """The evaluator's autoencoder and its pairs, which share no gradient, in one loss."""

    def losses(self, batch: dict[str, Any]) -> dict[str, Tensor]:
        values = super().losses(batch)
        return values | {"loss": values["movement_loss"] + values["matching_loss"]}


def evaluator() -> tuple[StageModule, Batches]:
    sizes = EvaluatorConfig(
        movement_hidden=8, movement=8, motion_hidden=8, text_hidden=8, latent=4, dropout=0
    )
    net = Evaluator(sizes, MotionLayout.named("body133"), TEXT, FRAMES)
    module = Pairs(net, OPTIM, seed=0, max_steps=STEPS, movement_optim=OPTIM, movement_steps=1)
    return module.double().eval(), lambda step: motion(step, 133) | captions(step)


def _interleaved(step: int) -> tuple[dict[str, Tensor], torch.Generator]:
    """Tokens of clips of which one on the first rank lacks hands, and two on the other."""
    generator = torch.Generator().manual_seed(step)
    codes = {
        "body": torch.randint(9, (BATCH, 10), generator=generator),
        "hand": torch.randint(9, (BATCH, 5), generator=generator),
    }
    groups = torch.tensor([5, 5, 4, 1, 2, 1])
    tokens, kinds, _ = interleave(codes, ("body", "body", "hand"), ends={"body": 9, "hand": 9}, groups=groups)
    known = ~(HANDLESS[:, None] & (kinds == 1)) | (tokens == 9)
    return {"tokens": tokens, "kinds": kinds, "known": known}, generator


HANDLESS = torch.tensor([False, False, True, False, True, True])
_STREAMS = (Stream("body", 9, 2), Stream("hand", 9, 1))
_PATTERN = ("body", "body", "hand")
_SAID = torch.tensor([[4, 5, 6, 2], [5, 2, 0, 0], [6, 6, 2, 0], [4, 2, 0, 0], [2, 0, 0, 0], [5, 4, 5, 2]])


def captioner(summed: bool = False) -> tuple[StageModule, Batches]:
    config = CaptionerConfig(layers=1, dim=16, heads=2, ff=32, block_size=20, max_words=4)
    net = Captioner(config, _STREAMS, _PATTERN, 7)
    module = CaptionerModule(net, OPTIM, seed=0, max_steps=STEPS, loss=CaptionLossConfig(summed=summed))
    return module.eval(), lambda step: _interleaved(step)[0] | {"text": _SAID}


def seq2seq() -> tuple[StageModule, Batches]:
    """With inverse alignment by the likeliest tokens."""
    net = Seq2Seq(Seq2SeqConfig(reader=8, dim=8, max_tokens=20), _STREAMS, _PATTERN, TEXT)
    judge = captioner()[0].net.double()
    assert isinstance(judge, Captioner)
    loss = Seq2SeqLossConfig()
    module = Seq2SeqModule(net, OPTIM, seed=0, max_steps=STEPS, loss=loss, captioner=judge)

    def batch(step: int) -> dict[str, Tensor]:
        tokens, generator = _interleaved(step)
        words = torch.randn(BATCH, 4, TEXT, generator=generator, dtype=torch.float64)
        mask = torch.arange(4)[None] < torch.tensor([4, 2, 3, 1, 4, 2])[:, None]
        return tokens | {"words": words, "mask": mask, "said": _SAID}

    return module.eval(), batch


CASES: dict[str, Callable[[], tuple[StageModule, Batches]]] = {
    "h2vq": lambda: tokenizer(H2VQConfig(**BOOK, root_gain=5.0, finger_gain=2.0)),
    "h2vq, one rank without hands": lambda: tokenizer(H2VQConfig(**BOOK), (True, False, True) + 3 * (False,)),
    "separate": lambda: tokenizer(SeparateConfig(**BOOK)),
    "rvq": lambda: tokenizer(RvqConfig(**BOOK)),
    "fsq": lambda: tokenizer(FsqConfig(**SMALL, steps=(5, 4))),
    "mq": lambda: tokenizer(MqConfig(**SMALL, num_codes=12, start="data")),
    "tm2t": lambda: tokenizer(Tm2tConfig(**SMALL, num_codes=12, start="data")),
    "tma": tma,
    "gpt": gpt,
    "gpt, compiled": gpt,
    "gpt, samples": gpt_samples,
    "mdm": mdm,
    "inbetween": inbetweener,
    "motion_vae": motion_vae,
    "latent_diffusion": latent_diffusion,
    "motionclip": motionclip,
    "motiondiffuse": motiondiffuse,
    "evaluator": evaluator,
    "captioner": captioner,
    "captioner, words added up": lambda: captioner(summed=True),
    "seq2seq": seq2seq,
}


def drawing_mdm() -> tuple[StageModule, Batches]:
    """As trained, with its own noise."""
    net = Mdm(TextDenoiserConfig(dim=16, ff=16, layers=1, heads=2, condition_dropout=0.3), 20, TEXT)
    return TextDenoiserModule(
        net, OPTIM, seed=0, max_steps=STEPS
    ), lambda step: motion(step, 20) | captions(step)


def rows_of(batch: dict[str, Any], rows: slice) -> dict[str, Any]:
    """The same batch with those rows alone."""
    return {name: _rows(value, rows) for name, value in batch.items()}


def _rows(value: Any, rows: slice) -> Any:
    if isinstance(value, dict):
        return rows_of(value, rows)
    if isinstance(value, Condition):
        return Condition(*(None if part is None else part[rows] for part in value))
    return value[rows]
