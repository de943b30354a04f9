"""A network that is cut over the ranks (FSDP2), and its whole weights again."""

from __future__ import annotations

from typing import TypeVar

from torch import Tensor, nn
from torch.distributed.device_mesh import DeviceMesh

from motionloom.models.layers.transformer import Block

N = TypeVar("N", bound=nn.Module)


def cut_over(net: N, mesh: DeviceMesh) -> N:
    """Cut `net` over the ranks of a mesh and return it.

    Every transformer block is one unit, gathered when it runs and resharded after it; the rest (embeddings,
    heads) is the last unit. Gradients are averaged over ranks as in DDP, and nothing is gathered in a lower
    precision than it is kept in, so training equals DDP up to the order of sums.
    """
    from torch.distributed.fsdp import fully_shard  # imported where it is used: it takes a second

    blocks: list[nn.Module] = [part for part in net.modules() if isinstance(part, Block)]
    for block in blocks:
        fully_shard(block, mesh=mesh)
    fully_shard(net, mesh=mesh)
    return net


def whole_weights(net: nn.Module) -> dict[str, Tensor]:
    """Return the weights of a network that was cut, whole on rank 0 alone; a collective."""
    from torch.distributed.checkpoint.state_dict import StateDictOptions, get_model_state_dict

    whole = StateDictOptions(full_state_dict=True, cpu_offload=True)
    return get_model_state_dict(net, options=whole)  # type: ignore[return-value]
