"""A modality of another package (`docs/example/sway/extras.py`) trains, in loader workers too, and drives."""

from __future__ import annotations

from pathlib import Path

import pytest
from own_package import installed, program, python

DATA = """
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import sway.extras

from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.shards.options import DatasetFacts, WriteOptions
from motionloom.datasets.shards.writer import write_dataset
from motionloom.datasets.synth.generate import SynthConfig, make_sample

CONFIG = SynthConfig(layout="body133", clips=16, max_seconds=5.0)


def clip(number):
    sample = make_sample(number, CONFIG)
    frames = len(sample.motion)
    sound = np.random.default_rng(number).standard_normal((frames, 438)).astype(np.float32)
    phase = np.arange(frames) / 5
    pulse = np.stack([np.sin(phase), np.cos(phase)], axis=1).astype(np.float32)
    return replace(sample, audio=sound, arrays={"pulse.npy": pulse} if number % 4 else {})


layout = MotionLayout.named("body133")
facts = DatasetFacts(
    name="made", layout=layout, licence="CC0", converter="test", converter_version=1, options={}
)
items = [("train" if n < 12 else "test", n) for n in range(16)]
write_dataset(Path(sys.argv[1]), items, clip, facts, WriteOptions(progress=False))
"""

RECIPE = """
name: pulse
hardware: {accelerator: cpu, devices: 1, threads: 1, workers: 1, loggers: []}
defaults: {trained: {train: {steps: 2, batch_size: 4, checkpoint_every: 2, validate_every: 2}}}
stages:
  data: {kind: shards, path: DATA}
  stats: {kind: stats}
  audio: {kind: audio}
  pulse: {kind: pulse}
  tokenizer: {kind: mq, net: {width: 8, code_dim: 8, num_codes: 8}}
  utt:
    kind: utt
    modalities: [audio, pulse]
    drop: {pulse: 0.3, audio: 0.3}
    balance: {audio: 1, audio+pulse: 3}
    max_frames: 16
    net: {layers: 1, dim: 16, heads: 2, ff: 16, block_size: 48, z_dim: 2}
    mate: {dim: 16, layers: 1, heads: 2, ff: 16, stride: 2}
    loss: {adversarial_start: 99}
  ude: {kind: ude, context_frames: 8}
"""

GENERATE = """
import sys

import numpy as np

from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.inference.generation import generate
from motionloom.pipeline.inference.request import Request
from motionloom.pipeline.inference.bundle import Bundle

bundle, pulse = Bundle.open(sys.argv[1]), np.ones((40, 2), np.float32)
assert bundle.generator.modalities == {"audio", "pulse"}
rows = {"pulse": [pulse, None], "audio": [None, np.ones((32, 438), np.float32)]}
driven, danced = generate(bundle, Request.of(
    conditions=rows, seconds=1.6, seed=1, sampling=SamplingConfig(guidance={"pulse": 1e4})
))
assert len(driven.joints) == len(danced.joints) == 32
assert driven.prompt.modalities == {"pulse"} and danced.prompt.modalities == {"audio"}
(plain,) = generate(bundle, Request.of(conditions={"pulse": [pulse]}, seconds=1.6, seed=1))
assert not np.array_equal(plain.joints, driven.joints), "guidance by the name of the modality"
print("drove", sorted(bundle.generator.modalities))
"""


@pytest.mark.slow
def test_a_modality_trains_and_drives(tmp_path: Path) -> None:
    site = installed(tmp_path)
    python(site, DATA, tmp_path / "data")
    recipe = tmp_path / "pulse.yaml"
    recipe.write_text(RECIPE.replace("DATA", str(tmp_path / "data")))
    program(site, "run", recipe, "--out", tmp_path / "run")
    assert "drove ['audio', 'pulse']" in python(site, GENERATE, tmp_path / "run")
