"""Stage `beats`: trains the beat network (`datasets/audio/beat_net.py`) on songs whose beats are known.

The weights in the package are those of the recipe `ude-beats`:

    motionloom run ude-beats -o runs/beats
    python -c "from motionloom.pipeline.songs import stage; from pathlib import Path; \\
        stage.put_into_package(Path('runs/beats/stages/beats'))"
"""

from __future__ import annotations

import json
from pathlib import Path

import torch
from pydantic import Field
from safetensors.torch import save

from motionloom.datasets.audio.beat_net import BANDS, ROWS, WEIGHTS, BeatNet, BeatNetConfig
from motionloom.datasets.base.files import atomic_path
from motionloom.datasets.loading.plan import Share
from motionloom.models.training.optim import OptimConfig
from motionloom.pipeline.contract.showing import Curve
from motionloom.pipeline.contract.stage import Inputs, register
from motionloom.pipeline.songs.songs import SongPool
from motionloom.pipeline.store.weights import LayoutFacts, ModelFacts, load_facts, load_weights
from motionloom.pipeline.training.config import TrainConfig, TrainedStageConfig
from motionloom.pipeline.training.trained_stage import Batches, Example, Log, TrainedStage

_NO_MOTION = LayoutFacts(name="none", fps=ROWS, family="none")


class BeatsConfig(TrainedStageConfig):
    """A recipe's `kind: beats`."""

    net: BeatNetConfig = BeatNetConfig()
    window_seconds: float = Field(20.0, gt=0)
    """Seconds of a song, in training."""
    optim: OptimConfig = OptimConfig(lr=2e-3, warmup_steps=50, schedule="cosine")
    train: TrainConfig = TrainConfig(steps=2000, batch_size=16)

    @property
    def rows(self) -> int:
        """Rows of a training window."""
        return round(self.window_seconds * ROWS)


class BeatsInputs(Inputs):
    """Songs to learn from."""

    songs: SongPool


class BeatsStage(TrainedStage[BeatsConfig, BeatsInputs, BeatNet]):
    """Music to beats."""

    name = "beats"
    summary = "beats and downbeats of music"
    trainer = "motionloom.pipeline.songs.training:BeatsModule"
    config = BeatsConfig
    inputs = BeatsInputs
    curves = (Curve("beat", "cross-entropy of beats"), Curve("downbeat", "cross-entropy of downbeats"))

    def facts(self, config: BeatsConfig, inputs: BeatsInputs) -> ModelFacts:
        return ModelFacts(kind=self.name, config=config.net.dump(), layout=_NO_MOTION)

    def network(self, facts: ModelFacts, inputs: BeatsInputs) -> BeatNet:
        return BeatNet(BeatNetConfig.parse(facts.config, facts.where))

    def batches(self, config: BeatsConfig, net: BeatNet, inputs: BeatsInputs, seed: int, log: Log) -> Batches:
        from motionloom.pipeline.songs.training import SongBatches

        trained, kept = (inputs.songs.songs(validation=which) for which in (False, True))
        rows = config.rows

        def train(batch: int, share: Share) -> SongBatches:
            return SongBatches(trained, rows, batch, seed, share)

        return Batches(train, lambda: SongBatches(kept, rows, min(16, len(kept)), seed, augment=False))

    def example(self, config: BeatsConfig, net: BeatNet, inputs: BeatsInputs, batch: int) -> Example:
        rows = config.rows
        levels = torch.empty(batch, rows, BANDS)
        targets = torch.empty(batch, rows, 2)
        example = {"levels": levels, "targets": targets, "length": torch.full((batch,), rows)}
        return Example(example, f"{rows} rows")


def put_into_package(stage: Path, target: Path = WEIGHTS) -> None:
    """Write the network of a finished stage, in half precision, where `load_beat_net` reads it."""
    facts = load_facts(stage)
    net = BeatNet(BeatNetConfig.parse(facts.config, facts.where))
    load_weights(stage, net)
    state = {name: value.detach().half().contiguous() for name, value in net.state_dict().items()}
    with atomic_path(target) as temporary:
        temporary.write_bytes(save(state, {"config": json.dumps(net.config.dump())}))


register(BeatsStage())
