"""What a recipe's trainings will take, before they run: parameters, tokens, bits, memory of one process.

Each network is built and its loss computed on fake tensors, which have shapes but no values, so the figures
come from the code that will run, under the precision it will run in. Memory counts weights, gradients,
AdamW's two moments, codebooks with their averages and everything kept for the backward pass; workspaces of
kernels and the allocator's rounding come on top. Attention weights are not counted: a GPU's fused kernels
keep none. A CPU keeps them where `attention_dropout` is above 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from rich.table import Table
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode

from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import UserError
from motionloom.models.diffusion.module import DiffusionModule
from motionloom.models.diffusion.network import MotionDiffusion
from motionloom.models.gpt.module import GptModule
from motionloom.models.gpt.network import InterleavedGPT
from motionloom.models.layers.transformer import SelfAttention
from motionloom.models.quantize.ema import EmaQuantizer
from motionloom.models.tma.module import TmaModule
from motionloom.models.tma.network import Tma
from motionloom.models.tokenizer.build import build_tokenizer
from motionloom.models.tokenizer.module import TokenizerModule
from motionloom.models.training.stage_module import StageModule
from motionloom.pipeline.runs.recipe import Recipe, Stage
from motionloom.pipeline.stages.data import ShardsStageConfig
from motionloom.pipeline.stages.training import TrainedStageConfig, prepare_module

_TEXT_WIDTH = {"minilm": 384}
_USUAL_WIDTH = 768
"""Of DistilBERT and CLIP ViT-L/14, assumed for encoders that are not loaded to look."""

_CAPTION_TOKENS = 24
_BYTES_A_PARAMETER = 16
"""Weight, gradient and AdamW's two moments in float32."""

_HALF = {"bf16-mixed": torch.bfloat16, "16-mixed": torch.float16}


@dataclass(frozen=True)
class Estimate:
    """One training stage."""

    stage: str
    parameters: int
    codebook: int
    """Values of the codebooks, which learn by averages and have no gradient."""
    local_batch: int
    memory_bytes: int
    note: str
    """What its tokens are."""


def estimate(recipe: Recipe) -> list[Estimate]:
    """One row per training stage; `UserError` when the layout of the data is not known."""
    layout = data_layout(recipe)
    world = recipe.hardware.world()
    rows = []
    for stage in recipe.stages:
        if not stage.kind.trains:
            continue
        config = stage.config
        assert isinstance(config, TrainedStageConfig)
        batch = config.train.local_batch(world)
        with FakeTensorMode(allow_non_fake_inputs=True):
            try:
                module, inputs, note = _fake(recipe, stage, layout, batch)
            except UserError as error:
                raise UserError(f"stage {stage.name}: {error}") from None
            for part in module.modules():
                if isinstance(part, SelfAttention):
                    part.attention_dropout = 0.0
            prepare_module(module, config.train)
            parameters = sum(p.numel() for p in module.net.parameters())
            buffers = sum(b.numel() * b.element_size() for b in module.net.buffers())
            books = [m for m in module.net.modules() if isinstance(m, EmaQuantizer)]
            kept = _saved_bytes(module, inputs, _HALF.get(config.train.precision))
        holders = world if config.train.strategy == "fsdp" else 1
        memory = parameters * _BYTES_A_PARAMETER // holders + buffers + kept
        codebook = sum(book.codebook.numel() for book in books)
        rows.append(Estimate(stage.name, parameters, codebook, batch, memory, note))
    return rows


def estimate_table(rows: list[Estimate]) -> Table:
    """For a terminal."""
    table = Table(title="what the trainings take (one process)", title_justify="left")
    for column in ("stage", "parameters", "batch", "memory", "tokens"):
        table.add_column(column, overflow="fold")
    for row in rows:
        parameters = f"{row.parameters / 1e6:.1f} M"
        if row.codebook:
            parameters += f" + {row.codebook / 1e6:.1f} M codebook"
        table.add_row(
            row.stage, parameters, str(row.local_batch), f"{row.memory_bytes / 2**30:.1f} GiB", row.note
        )
    return table


def data_layout(recipe: Recipe) -> MotionLayout:
    """Layout of the recipe's data: as its data stage says, or as existing shards are."""
    config: Any = recipe.stage("data").config
    if isinstance(config, ShardsStageConfig):
        return config.found_layout()
    name, fps = getattr(config, "layout", None), getattr(config, "fps", None)
    if name is None:
        raise UserError("the layout of the data is not known; set data.layout to see what the trainings take")
    return MotionLayout.named(name, fps=fps or 30.0)


def _fake(
    recipe: Recipe, stage: Stage, layout: MotionLayout, batch: int
) -> tuple[StageModule, dict[str, Any], str]:
    """The stage's module and a batch of the shapes it will see."""
    config: Any = stage.config
    kind = stage.kind.name
    width = text_width(recipe)
    if kind == "gpt":
        return _fake_gpt(recipe, stage, layout, batch)
    if kind in ("tma", "diffusion"):
        dim = len(layout.part(config.part))
        inputs = _captioned(batch, config.max_frames, dim, width)
        if kind == "tma":
            tma = Tma.of_layout(config.net, layout, config.part, width)
            return TmaModule(tma, config.optim, seed=0, max_steps=1, loss=config.loss), inputs, ""
        denoiser = MotionDiffusion(config.net, dim, width)
        return DiffusionModule(denoiser, config.optim, seed=0, max_steps=1), inputs, ""
    net = build_tokenizer(config.net, layout)
    module = TokenizerModule(net, config.optim, seed=0, max_steps=1, **config.net.loss_terms())
    inputs = {
        "motion": torch.empty(batch, config.window, net.dim),
        "length": torch.full((batch,), config.window),
    }
    per_group = " + ".join(f"{s.per_group} {s.name}" for s in net.streams)
    return module, inputs, f"{per_group} per 4 frames, {net.bits_per_second:.0f} bit/s"


def _fake_gpt(
    recipe: Recipe, stage: Stage, layout: MotionLayout, batch: int
) -> tuple[StageModule, dict[str, Any], str]:
    config: Any = stage.config
    book_config: Any = recipe.stage(stage.inputs["tokenizer"]).config
    book = build_tokenizer(book_config.net, layout)
    width = text_width(recipe)
    tma = None
    if "tma" in stage.inputs:
        tma_config: Any = recipe.stage(stage.inputs["tma"]).config
        tma = Tma.of_layout(tma_config.net, layout, tma_config.part, width)
    prior = tma.config.latent if config.prior == "tma" and tma is not None else width
    net = InterleavedGPT(config.net, book.streams, book.pattern, prior)
    align = config.loss.align_weight > 0 and tma is not None
    module = GptModule(
        net, config.optim, seed=0, max_steps=1, loss=config.loss,
        tokenizer=book.freeze() if align else None, tma=tma if align else None,
    )  # fmt: skip
    if align and config.loss.align_on == "samples":
        # The backward pass goes through the samples as through more rows; what judges them keeps nothing.
        module.tokenizer, batch = None, batch * (1 + config.loss.samples)
    groups = net.max_groups
    ends = len(net.names)
    length = groups * len(net.pattern) + ends
    order = torch.tensor([net.names.index(name) for name in (net.pattern * groups + net.names)])
    inputs = {
        "tokens": torch.zeros(batch, length, dtype=torch.int64),
        "kinds": order.expand(batch, -1),
        "text": torch.empty(batch, prior),
        "similarity": torch.empty(batch, width),
    }
    if align and tma is not None:
        inputs["tma_text"] = torch.empty(batch, tma.config.latent)
    parts = " + ".join(f"{groups * s.per_group} {s.name}" for s in book.streams)
    return module, inputs, f"{parts} + {ends} End = {length} for {groups * book.group_frames} frames"


def text_width(recipe: Recipe) -> int:
    """Width of the recipe's text features, or what most encoders have."""
    text = next((s for s in recipe.stages if s.kind.name == "text"), None)
    encoder = getattr(text.config, "encoder", "minilm") if text is not None else "minilm"
    return _TEXT_WIDTH.get(encoder, _USUAL_WIDTH)


def _captioned(batch: int, frames: int, dim: int, width: int) -> dict[str, Any]:
    return {
        "motion": torch.empty(batch, frames, dim),
        "length": torch.full((batch,), frames),
        "text_tokens": torch.empty(batch, _CAPTION_TOKENS, width),
        "text_mask": torch.ones(batch, _CAPTION_TOKENS, dtype=torch.bool),
        "sentence": torch.empty(batch, width),
        "similarity": torch.empty(batch, width),
    }


def _saved_bytes(module: StageModule, inputs: dict[str, Any], half: torch.dtype | None) -> int:
    """Bytes that the backward pass of one loss keeps, parameters apart; `half` is the type of autocast."""
    own = {p.untyped_storage()._cdata for p in module.parameters()}
    sizes: dict[int, int] = {}

    def pack(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        if storage._cdata not in own:
            sizes[storage._cdata] = storage.nbytes()
        return tensor

    module.train()
    hooks = torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor)
    with hooks, torch.autocast("cpu", dtype=half, enabled=half is not None):
        module.losses(inputs)["loss"]
    return sum(sizes.values())
