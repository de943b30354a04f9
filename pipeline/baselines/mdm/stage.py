"""MDM's stage (HumanTOMATO Tables 1, 13 and 14; with `part: face` its second facial baseline, B.5.2)."""

from __future__ import annotations

from motionloom.models.layers.transformer import name_in_torch
from motionloom.pipeline.baselines.mdm.network import Mdm
from motionloom.pipeline.contract.stage import register
from motionloom.pipeline.stages.networks.denoiser import DenoiserStage, DenoiserStageConfig
from motionloom.pipeline.store.weights import Release


class MdmStage(DenoiserStage[DenoiserStageConfig, Mdm]):
    """Trains MDM on whole clips and their captions."""

    name = "mdm"
    summary = "MDM: motion diffusion"
    trainer = "motionloom.models.diffusion.module:TextDenoiserModule"
    config = DenoiserStageConfig
    denoiser = Mdm

    def release(self, net: Mdm) -> Release:
        """Return MDM's published names; text encoder and positions are not read."""
        return Release(published_names(net), unread=("*.pe", "clip_model.*"))


_AROUND = {
    "enter": "input_process.poseEmbedding",
    "leave": "output_process.poseFinal",
    "text": "embed_text",
    "time": "embed_timestep.time_embed",
}


def published_names(net: Mdm) -> dict[str, str]:
    """Return the names of the network's tensors -> their names in MDM's release."""
    names = {}
    for name in net.state_dict():
        first, _, rest = name.partition(".")
        if first == "stack":
            _, number, inner = rest.split(".", 2)
            names[name] = f"seqTransEncoder.layers.{number}.{name_in_torch(inner)}"
        else:
            names[name] = f"{_AROUND[first]}.{rest}"
    return names


register(MdmStage())
