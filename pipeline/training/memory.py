"""Estimate of parameters and memory of one training process, on fake tensors.

The network is built and its loss computed on tensors that have shapes but no values, so the figures come from
the code that will run, under the precision it will run in. Memory counts weights, gradients, the optimizer's
two moments, averaged weights, codebooks with their averages and everything kept for the backward pass;
workspaces of kernels and the allocator's rounding come on top. Attention weights are not counted: a GPU's
fused kernels keep none. A CPU keeps them where `attention_dropout` is above 0.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode

from motionloom.models.layers.attention import SelfAttention
from motionloom.models.quantize.ema import EmaQuantizer
from motionloom.models.training.alternating import AlternatingModule
from motionloom.models.training.stage_module import Batch, StageModule
from motionloom.pipeline.contract.showing import ModelCard
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.training.config import TrainConfig
from motionloom.pipeline.training.execution import prepare_module

_BYTES_A_PARAMETER = 16
"""Weight, gradient and two moments in float32."""


def model_card(
    make: Callable[[], tuple[StageModule, Batch, str]], train: TrainConfig, batch: int, hardware: Hardware
) -> ModelCard:
    """Sizes of a training: `make` gives its module, a batch of `batch` rows, and a note about its tokens."""
    with FakeTensorMode(allow_non_fake_inputs=True):
        module, example, note = make()
        # A fused kernel keeps no attention weights, which dropout would have the plain one keep.
        for layer in module.modules():
            if isinstance(layer, SelfAttention):
                layer.attention_dropout = 0.0
        prepare_module(module, train)
        parameters = sum(p.numel() for p in module.net.parameters())
        trained = sum(p.numel() for p in _trained(module))
        buffers = sum(b.numel() * b.element_size() for b in module.net.buffers())
        books = [m for m in module.net.modules() if isinstance(m, EmaQuantizer)]
        kept = _saved_bytes(module, example, half=train.precision == "bf16-mixed")
    copies = train.keep_checkpoints + (train.steps // train.keep_every if train.keep_every else 0)
    numbers = parameters + (3 if train.ema else 2) * trained
    # FSDP cuts weights, gradients and moments; activations it does not.
    holders = hardware.world() if train.strategy == "fsdp" else 1
    return ModelCard(
        parameters=parameters,
        codebook=sum(book.codebook.numel() for book in books),
        batch=train.batch_size,
        local_batch=batch,
        memory_bytes=trained * _BYTES_A_PARAMETER // holders + buffers + kept,
        note=note,
        steps=train.steps,
        checkpoint_bytes=copies * (4 * numbers + buffers),
    )


def _trained(module: StageModule) -> list[nn.Parameter]:
    """Parameters with gradients and moments: of the network, and of those that it is trained against."""
    nets = [module.net]
    if isinstance(module, AlternatingModule):
        nets += [net for group in module.optimizer_groups() for net in group.nets]
    return list({id(p): p for net in nets for p in net.parameters()}.values())


def _saved_bytes(module: StageModule, inputs: Batch, *, half: bool) -> int:
    """Return the bytes that one loss keeps for the backward pass, parameters apart; `half`: autocast."""
    own = {p.untyped_storage()._cdata for p in module.parameters()}
    sizes: dict[int, int] = {}

    def pack(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        if storage._cdata not in own:
            sizes[storage._cdata] = storage.nbytes()
        return tensor

    module.train()
    hooks = torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor)
    with hooks, torch.autocast("cpu", dtype=torch.bfloat16, enabled=half):
        module.losses(inputs)["loss"]
    return sum(sizes.values())
