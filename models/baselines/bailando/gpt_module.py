"""Training of `CrossGpt`: cross-entropy of the upper codes and of the lower ones (Bailando, section 3.2)."""

from __future__ import annotations

from torch import Tensor

from motionloom.models.baselines.bailando.gpt import CrossGpt, code_errors
from motionloom.models.baselines.bailando.vq import HALVES, DanceVq, places
from motionloom.models.gpt.frozen import Frozen
from motionloom.models.training.distributed import masked_mean
from motionloom.models.training.optim import OptimConfig
from motionloom.models.training.stage_module import Batch, StageModule


class CrossGptModule(StageModule):
    """Trains on windows of joints with music; codes are made on the way, by the frozen `DanceVq`."""

    net: CrossGpt

    def __init__(self, net: CrossGpt, optim: OptimConfig, *, seed: int, max_steps: int, vq: DanceVq) -> None:
        super().__init__(net, optim, seed=seed, max_steps=max_steps)
        self.vq = Frozen(vq)

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Of "motion" [B, T, 3 N], joints in metres, and "conditions" with "audio".

        Rows without music do not count.
        """
        codes, music, heard = codes_of(self.net, self.vq.module, batch)
        logits, true = self.net(codes[:, :-1], music[:, 1:]), codes[:, 1:]
        counts = heard[:, None].expand(true.shape[:2])
        each, hits = code_errors(logits, true), (logits.argmax(-1) == true).float()
        loss = masked_mean(each.sum(2), counts)
        found = {f"accuracy_{name}": masked_mean(hits[..., k], counts) for k, name in enumerate(HALVES)}
        return {"loss": loss, **found}


def codes_of(gpt: CrossGpt, vq: DanceVq, batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
    """Codes [B, L, 2] of a batch's joints, the music [B, L, E] of each, and who has music, bool [B]."""
    features, mask, _ = batch["conditions"]["audio"]
    codes = vq.encode(places(batch["motion"]))
    return codes, gpt.heard(features, vq.config.code_frames, codes.shape[1]), mask.any(1)
