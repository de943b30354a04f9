"""What the network of beats learns by."""

from __future__ import annotations

from typing import Any

from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from motionloom.models.training.stage_module import StageModule


class BeatsModule(StageModule):
    """Binary cross-entropies of beats and of downbeats."""

    def losses(self, batch: dict[str, Any]) -> dict[str, Tensor]:
        """Each beat counts two rows beside it by half, as hands and rows are not exact."""
        both = binary_cross_entropy_with_logits(self.net(batch["levels"]), batch["targets"], reduction="none")
        beat, downbeat = both.mean(dim=(0, 1)).unbind()
        return {"loss": beat + downbeat, "beat": beat, "downbeat": downbeat}
