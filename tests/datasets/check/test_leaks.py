"""One recording in two splits of a mix: found by motion and by id, and refused by the stages that mix."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from motionloom.datasets.check.leaks import find_leaks, leaks_across
from motionloom.datasets.schema import Split, UserError
from motionloom.datasets.synth.generate import SynthConfig, synthesize
from motionloom.pipeline.runs.api import run_recipe


class Clips:
    def __init__(self, split: Split, clips: dict[str, np.ndarray]) -> None:
        self.split, self.ids, self._motions = split, list(clips), list(clips.values())
        self.frames = np.array([len(motion) for motion in self._motions])

    def motion(self, i: int) -> np.ndarray:
        return self._motions[i]


def test_a_recording_in_two_splits_is_found_whatever_it_is_called() -> None:
    rng = np.random.default_rng(0)
    walk, run, jump, sit = (rng.normal(size=(9, 4)).astype(np.float32) for _ in range(4))
    again = run + np.float32(1e-4)
    other = {
        "train": Clips("train", {"x": walk, "run": again, "sit": jump}),
        "test": Clips("test", {"j": jump}),
    }
    one = {
        "train": Clips("train", {"sit": sit, "j": jump}),
        "test": Clips("test", {"walk": walk, "run": run}),
    }
    assert find_leaks({"one": one, "other": other}) == [  # type: ignore[dict-item]
        "'j' of one (train) is 'j' of other (test)",
        "'walk' of one (test) is 'x' of other (train)",
        "'run' of one (test) is 'run' of other (train)",
    ]
    assert find_leaks({"one": one, "same": one}) == []  # type: ignore[dict-item]


RECIPE = """
name: leaky
hardware: {{accelerator: cpu, convert_workers: 1}}
stages:
  one: {{kind: shards, path: {folder}/one}}
  two: {{kind: shards, path: {folder}/two}}
  data: {{kind: mix, allow_leaks: {allowed}}}
"""


def test_a_leaking_mix_is_refused_unless_it_is_allowed(tmp_path: Path) -> None:
    for name, val in (("one", 0.0), ("two", 0.9)):
        given = SynthConfig(layout="body133", clips=6, seed=3, val_fraction=val, test_fraction=0.0)
        synthesize(given, tmp_path / name)
    leaks = leaks_across([tmp_path / "one", tmp_path / "two"])
    assert leaks and all(f"of {tmp_path / 'two'} (val)" in leak for leak in leaks)
    recipe = tmp_path / "recipe.yaml"
    for allowed in (False, True):
        recipe.write_text(RECIPE.format(folder=tmp_path, allowed=str(allowed).lower()))
        if allowed:
            run_recipe(recipe, tmp_path / "run", console=Console(quiet=True))
            continue
        with pytest.raises(UserError, match=r"clips are in two splits of a mix.*allow_leaks"):
            run_recipe(recipe, tmp_path / "run", console=Console(quiet=True))
