"""A converter from outside is one file: command line and recipes find it where it is registered."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from motionloom.datasets.schema import Manifest

TOY = '''
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from motionloom.datasets.convert.common.config import ConvertConfig
from motionloom.datasets.convert.common.converter import Converter, PlanSettings
from motionloom.datasets.convert.common.features import features_of
from motionloom.datasets.convert.common.look import SourceJoints
from motionloom.datasets.convert.common.plan import ConversionPlan
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.schema import Caption, Split
from motionloom.datasets.shards.sample import Sample
from motionloom.pipeline import register


class ToyConfig(ConvertConfig):
    name: str = "toy"
    layout: str = "body133"
    fps: float = 20.0
    size: float = 1.0
    """Scale of the figure."""


class ToyClip(NamedTuple):
    id: str
    split: Split
    path: Path

    def label(self) -> str:
        return self.path.name


@register
class Toy(Converter[ToyConfig, ToyClip]):
    name, title, summary, example = "toy", "Toys", "Toys to shards.", "toys shards"
    config_class = ToyConfig

    def plan(self, settings: PlanSettings) -> ConversionPlan[ToyClip]:
        draft = ConversionPlan[ToyClip](self.config)
        for path in sorted(self.config.source.glob("*.toy")):
            draft.take(ToyClip(path.stem, "train", path))
        return draft.finish(found=len(draft.items), frames=lambda clip: 40, licence=lambda clip: "CC0")

    def depends_on(self, clip: ToyClip) -> list[Any]:
        return [clip.id, clip.path.read_text()]

    def joints(self, clip: ToyClip) -> SourceJoints:
        rest = Skeleton.named("smpl22").rest_joints + [0.0, 1.0, 0.0]
        return SourceJoints(np.repeat(rest[None] * self.config.size, 40, axis=0), 20.0)

    def convert(self, clip: ToyClip) -> Sample:
        motion = features_of(self.joints(clip).joints, 20.0, self.layout)
        meta = self.meta(clip, motion, licence="CC0")
        return Sample(meta, motion, texts=[Caption(text=clip.path.read_text())])
'''

RECIPE = """
name: toys
stages:
  data: {kind: toy, source: %s}
  stats: {kind: stats}
"""


@pytest.fixture
def toys(tmp_path: Path) -> Path:
    (tmp_path / "toys.py").write_text(TOY)
    source = tmp_path / "toys"
    source.mkdir()
    for number in range(3):
        (source / f"{number}.toy").write_text(f"toy {number}")
    return tmp_path


def motionloom(folder: Path, *words: str) -> str:
    command = [sys.executable, "-P", "-m", "motionloom.pipeline.cli.main", *words]
    given = {**os.environ, "MOTIONLOOM_STAGES": str(folder / "toys.py")}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=given)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_a_file_is_a_command_and_a_stage(toys: Path) -> None:
    assert "Toys to shards" in motionloom(toys, "data", "convert", "toy", "--help")
    motionloom(toys, "data", "convert", "toy", str(toys / "toys"), str(toys / "out"), "-s", "size=1.05")
    made = Manifest.load_json(toys / "out" / "manifest.json")
    assert (made.converter, made.licence, made.options["size"]) == ("toy", "CC0", 1.05)
    assert made.shards[0].samples == 3
    recipe = toys / "recipe.yaml"
    recipe.write_text(RECIPE % (toys / "toys"))
    motionloom(toys, "run", str(recipe), "-o", str(toys / "run"))
    assert list((toys / "run").rglob("toy-train-000000.tar"))
