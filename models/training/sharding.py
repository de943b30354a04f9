"""Networks whose weights are cut over the ranks (FSDP), and back to whole.

FSDP2 (`fully_shard`): every transformer block is one unit, gathered when it runs and cut again behind it;
what is left (embeddings, heads) is the last unit. Gradients are averaged over ranks as DDP averages them, and
nothing is gathered in fewer bits than it is kept in, so training equals DDP up to the order of sums.

torch's modules for it are imported when they are used; they take a second.
"""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING, TypeVar

from torch import nn

from motionloom.models.layers.transformer import Block
from motionloom.models.training.distributed import rank

if TYPE_CHECKING:
    from torch.distributed.device_mesh import DeviceMesh

M = TypeVar("M", bound=nn.Module)


def sharded(net: M, mesh: DeviceMesh) -> M:
    """A copy of `net` cut over the ranks of `mesh`; `net` itself stays whole and where it is.

    Every rank must hold the same weights. The copy gathers its weights in `forward` only, so a network that
    is used through other methods cannot be cut this way.
    """
    from torch.distributed.fsdp import fully_shard

    cut = copy.deepcopy(net)
    for part in cut.modules():
        if isinstance(part, Block):
            fully_shard(part, mesh=mesh)
    fully_shard(cut, mesh=mesh)
    return cut


def make_whole(cut: nn.Module, net: nn.Module) -> None:
    """Fill `net` on rank 0 with the weights of its sharded copy; a collective, so every rank calls it."""
    from torch.distributed.checkpoint.state_dict import StateDictOptions, get_model_state_dict

    state = get_model_state_dict(cut, options=StateDictOptions(full_state_dict=True, cpu_offload=True))
    if rank() == 0:
        net.load_state_dict(state)
