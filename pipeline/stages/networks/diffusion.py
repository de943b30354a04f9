"""Motion diffusion stage: MDM, and of the face the paper's second facial baseline (HumanTOMATO B.5.2)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.motion.layout import Part
from motionloom.models.diffusion.network import DiffusionConfig, MotionDiffusion
from motionloom.models.diffusion.observed import Showing
from motionloom.models.layers.transformer import name_in_torch
from motionloom.pipeline.contract.generation import MotionGenerator
from motionloom.pipeline.contract.showing import Curve
from motionloom.pipeline.contract.stage import GENERATOR, Finished, Inputs, register
from motionloom.pipeline.inference.generators.diffusion import DiffusionMotion
from motionloom.pipeline.stages.networks.captions import (
    CaptionInputs,
    CaptionStage,
    CaptionStageConfig,
    part_columns,
    part_of,
)
from motionloom.pipeline.store.weights import ModelFacts, Release, load_facts
from motionloom.pipeline.training.config import TrainConfig

if TYPE_CHECKING:
    from motionloom.models.diffusion.module import DiffusionModule


class DiffusionStageConfig(CaptionStageConfig):
    """A denoiser of motions, conditioned on a sentence embedding."""

    net: DiffusionConfig = DiffusionConfig()
    train: TrainConfig = TrainConfig(steps=200_000, batch_size=64)
    part: Part = "face"
    """What is denoised; `face` takes the face captions, any other the body's. Of MDM it is `bodyhand`, or
    `body`."""


class DiffusionStage(CaptionStage[DiffusionStageConfig, CaptionInputs, MotionDiffusion]):
    """A denoiser, trained on whole clips and their captions."""

    name = "diffusion"
    summary = "motion diffusion"
    version = 2  # MDM's time steps, positions, hidden texts and mean over clips
    config = DiffusionStageConfig
    offers = frozenset({GENERATOR})
    inputs = CaptionInputs
    curves = (Curve("loss"),)

    def facts(self, config: DiffusionStageConfig, inputs: CaptionInputs) -> ModelFacts:
        layout = inputs.data.layout
        width = len(part_columns(layout, config.part))
        extra = {"motion_dim": width, "text_dim": inputs.text.dim, "part": config.part}
        return ModelFacts.of(self.name, config.net, layout, extra)

    def network(self, facts: ModelFacts, inputs: CaptionInputs) -> MotionDiffusion:
        config = DiffusionConfig.parse(facts.config, facts.where)
        dims = (facts.fact(key, int) for key in ("motion_dim", "text_dim"))
        return MotionDiffusion(config, *dims)

    def release(self, net: MotionDiffusion) -> Release | None:
        """MDM's `trans_enc`."""
        config = net.config
        ours = config.observed or config.quieted or config.spread or config.frames_per_token > 1
        if config.norm == "pre" or ours:
            return None
        return Release(mdm_names(net), unread=("*.pe", "clip_model.*"))

    def module(
        self, config: DiffusionStageConfig, net: MotionDiffusion, inputs: CaptionInputs, seed: int
    ) -> DiffusionModule:
        from motionloom.models.diffusion.module import DiffusionModule

        showing = None
        if net.config.observed:
            columns = part_columns(inputs.data.layout, config.part)
            # A dry run has no statistics.
            stats = inputs.stats or FeatureStats.unit(inputs.data.layout)
            showing = Showing.of(stats.layout, columns, stats.mean, stats.std, net.config.observed)
        return DiffusionModule(net, config.optim, seed=seed, max_steps=config.train.steps, showing=showing)

    def generator(self, stage: Finished, given: Inputs, device: torch.device) -> MotionGenerator:
        net, part = self.load(stage, given, device), part_of(load_facts(stage.folder))
        return DiffusionMotion(given["stats"].layout, part, given, net, self._window(stage))

    @staticmethod
    def _window(stage: Finished) -> int:
        """The longest motion that the network was trained on."""
        config = stage.config
        assert isinstance(config, DiffusionStageConfig)
        return config.max_frames


_AROUND = {
    "enter": "input_process.poseEmbedding",
    "leave": "output_process.poseFinal",
    "text": "embed_text",
    "time": "embed_timestep.time_embed",
}


def mdm_names(net: MotionDiffusion) -> dict[str, str]:
    """Names of the network's tensors -> their names in MDM's release."""
    out = {}
    for name in net.state_dict():
        first, _, rest = name.partition(".")
        if first == "stack":
            _, number, inner = rest.split(".", 2)
            out[name] = f"seqTransEncoder.layers.{number}.{name_in_torch(inner)}"
        else:
            out[name] = f"{_AROUND[first]}.{rest}"
    return out


register(DiffusionStage())
