"""Training of FACT: the squared error of the next frames (AI Choreographer, section 4.2)."""

from __future__ import annotations

from torch import Tensor
from torch.nn import functional

from motionloom.models.training.distributed import masked_mean
from motionloom.models.training.stage_module import Batch, StageModule
from motionloom.pipeline.baselines.fact.network import Fact, read_music


class FactModule(StageModule):
    """Trains a `Fact` on `ConditionBatches` of dances."""

    net: Fact

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """The loss, and `still`: that of standing still in the last frame that is read.

        "motion" [B, T, C] normalised, "length" [B], "present" bool [B, C] (optional: all) and
        "conditions" with "audio". Rows without music, or too short, count for nothing.
        """
        net = self.net
        config = self.net.config
        features, heard, _ = batch["conditions"]["audio"]
        end = config.clip_frames
        motion = net.columns.read(batch["motion"][:, :end])
        # Music that ends too early goes on as silence.
        lacking = max(0, config.music_frames - features.shape[1])
        music = read_music(functional.pad(features[:, : config.music_frames], (0, 0, 0, lacking)))
        before = motion[:, : config.motion_frames]
        after = motion[:, config.motion_frames :]
        counts = (heard.any(1) & (batch["length"] >= end))[:, None].expand(-1, config.predicted_frames)
        present = None if net.columns.matrices else batch.get("present")
        made = net(before, music).float()
        still = before[:, -1:].expand_as(after)
        loss, of_still = (
            masked_mean(functional.mse_loss(one, after, reduction="none"), counts, present)
            for one in (made, still)
        )
        return {"loss": loss, "still": of_still}
