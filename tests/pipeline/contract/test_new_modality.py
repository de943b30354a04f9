"""A third modality is one file (`helpers/pulse_modality.py`) and one line: it trains and generates."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

HELPERS = Path(__file__).resolve().parents[2] / "helpers"

PROGRAM = '''
import sys
from dataclasses import replace
from pathlib import Path

from motionloom.pipeline import register
from pulse_modality import PULSE

register(PULSE)  # the one line

import numpy as np
from rich.console import Console

from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.shards.options import (DatasetFacts, WriteOptions)
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.shards.writer import write_dataset
from motionloom.datasets.synth.generate import SynthConfig, make_sample
from motionloom.pipeline.contract.generation import Prompt
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.runs.api import run_recipe

folder = Path(sys.argv[1])
LAYOUT = MotionLayout.named("body133")
CONFIG = SynthConfig(layout="body133", clips=16, max_seconds=5.0)


def pulse(frames):
    phase = np.arange(frames) / 5
    return np.stack([np.sin(phase), np.cos(phase)], axis=1).astype(np.float32)


def clip(number):
    sample = make_sample(number, CONFIG)
    frames = len(sample.motion)
    sound = np.random.default_rng(number).standard_normal((frames, 438)).astype(np.float32)
    return replace(sample, audio=sound, arrays={"pulse.npy": pulse(frames)} if number % 4 else {})


facts = DatasetFacts(
    name="made", layout=LAYOUT, licence="CC0", converter="test", converter_version=1, options={}
)
items = [("train" if n < 12 else "test", n) for n in range(16)]
write_dataset(folder / "data", items, clip, facts, WriteOptions(progress=False))
assert ShardDataset.open(folder / "data", "test").array(1, "pulse.npy").shape[1] == 2
recipe = folder / "pulse.yaml"
train = "train: {steps: 2, batch_size: 4, checkpoint_every: 2, validate_every: 2}"
recipe.write_text(f"""
name: pulse
hardware: {{accelerator: cpu, devices: 1, threads: 1, loggers: []}}
stages:
  data: {{kind: shards, path: {folder / "data"}}}
  stats: {{kind: stats}}
  audio: {{kind: audio}}
  pulse: {{kind: pulse}}
  tokenizer: {{kind: mq, net: {{width: 8, code_dim: 8, num_codes: 8}}, {train}}}
  utt:
    kind: utt
    modalities: [audio, pulse]
    drop: {{pulse: 0.3, audio: 0.3}}
    balance: {{audio: 1, audio+pulse: 3}}
    max_frames: 16
    net: {{layers: 1, dim: 16, heads: 2, ff: 16, block_size: 48, z_dim: 2}}
    mate: {{dim: 16, layers: 1, heads: 2, ff: 16, stride: 2}}
    loss: {{adversarial_start: 99}}
    {train}
  ude: {{kind: ude, context_frames: 8}}
""")
run_recipe(recipe, out=folder / "run", console=Console(quiet=True))
bundle = Bundle.open(folder / "run")
assert bundle.generator.modalities == {"audio", "pulse"}
rows = {"pulse": [pulse(40), None], "audio": [None, np.ones((32, 438), np.float32)]}
driven, danced = bundle.generate(
    conditions=rows, seconds=1.6, seed=1, strict=True, sampling=SamplingConfig(guidance={"pulse": 1e4})
)
assert len(driven.joints) == len(danced.joints) == 32
assert driven.prompt.modalities == {"pulse"} and danced.prompt.modalities == {"audio"}
(plain,) = bundle.generate(conditions={"pulse": [pulse(40)]}, seconds=1.6, seed=1)
assert not np.array_equal(plain.joints, driven.joints), "guidance by the name of the modality"
print("drove", Prompt(conditions={"pulse": pulse(4)}).modalities)
'''


@pytest.mark.slow
def test_a_modality_is_one_file_and_one_line(tmp_path: Path) -> None:
    script = tmp_path / "program.py"
    script.write_text(PROGRAM)
    path = os.pathsep.join(filter(None, (str(HELPERS), os.environ.get("PYTHONPATH"))))
    made = subprocess.run(
        [sys.executable, "-P", script, tmp_path],
        env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=240,
    )
    assert made.returncode == 0, made.stderr[-3000:] + made.stdout[-2000:]
    assert "drove frozenset({'pulse'})" in made.stdout
