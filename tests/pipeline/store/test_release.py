"""Published weights in place of a training: read under their names, refused where they differ."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import UserError
from motionloom.datasets.synth.generate import SynthConfig, synthesize
from motionloom.models.diffusion.network import TextDenoiserConfig
from motionloom.pipeline.baselines.mdm.network import Mdm
from motionloom.pipeline.baselines.mdm.stage import published_names
from motionloom.pipeline.inference.model import MotionModel
from motionloom.pipeline.store.weights import Release, Rows

NAMES = Release({"weight": Rows("joined", (7, 4, 5, 6), 12), "bias": "below"}, unread=("pe", "clip.*"))


def stored(**changed: Tensor) -> dict[str, Tensor]:
    fine = {"joined": torch.arange(24.0).reshape(12, 2), "below": torch.arange(4.0)[:, None]}
    return fine | changed


def test_rows_are_picked(tmp_path: Path) -> None:
    net = nn.Linear(2, 4)
    save_file(stored(pe=torch.zeros(7), **{"clip.x": torch.ones(3)}), tmp_path / "theirs")
    NAMES.fill(tmp_path / "theirs", net)
    assert net.weight.tolist() == [[14, 15], [8, 9], [10, 11], [12, 13]]
    assert net.bias.tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"joined": torch.ones(12, 3)}, r"tensor 'joined' is \[12, 3\], and the published one \[12, 2\]"),
        ({"below": None}, r"tensor 'below' is no tensor, and the published one \[4\]"),
        ({"extra": torch.ones(2)}, r"tensor 'extra' is \[2\], and the published one no tensor"),
    ],
)
def test_what_differs_is_refused(changed: dict[str, Any], says: str, tmp_path: Path) -> None:
    kept = {name: value for name, value in stored(**changed).items() if value is not None}
    save_file(kept, tmp_path / "theirs.safetensors")
    with pytest.raises(UserError, match=rf"theirs\.safetensors: {says}; take weights"):
        NAMES.fill(tmp_path / "theirs.safetensors", nn.Linear(2, 4))
    (tmp_path / "theirs.safetensors").write_bytes(b"no weights")
    with pytest.raises(UserError, match="cannot be read"):
        NAMES.fill(tmp_path / "theirs.safetensors", nn.Linear(2, 4))


LAYOUT = MotionLayout.named("h3d263")


@pytest.mark.parametrize(
    ("name", "values", "says"),
    [
        ("mean", np.zeros(262), r"float64 \[262\] is not the 263 finite numbers of layout h3d263"),
        ("mean", np.full(263, np.nan), "finite numbers"),
        ("std", np.zeros(263), "deviations that are not above 0"),
        ("std", None, "cannot be read"),
    ],
)
def test_wrong_statistics_are_refused(name: str, values: Any, says: str, tmp_path: Path) -> None:
    for file in ("mean", "std"):
        np.save(tmp_path / f"{file}.npy", np.ones(263))
    (tmp_path / f"{name}.npy").unlink() if values is None else np.save(tmp_path / f"{name}.npy", values)
    with pytest.raises(UserError, match=rf"{name}\.npy: .*{says}"):
        FeatureStats.of_arrays(tmp_path / "mean.npy", tmp_path / "std.npy", LAYOUT)


RECIPE = """
name: published
hardware: {{accelerator: cpu, threads: 1, convert_workers: 1}}
stages:
  data: {{kind: shards, path: {root}/data}}
  stats: {{kind: stats, mean: {root}/Mean.npy, std: {root}/Std.npy}}
  text: {{kind: text}}
  mdm:
    kind: mdm
    net: {{dim: 16, ff: 24, layers: 1, heads: 2}}
    train: {{steps: 100000}}
    published: {root}/model.safetensors
"""


def test_a_release_of_mdm_is_run_and_generates(tmp_path: Path, call: Callable[..., Any]) -> None:
    synthesize(SynthConfig(clips=6, fps=20, layout="wholebody313"), tmp_path / "data")
    net = Mdm(TextDenoiserConfig(dim=16, ff=24, layers=1, heads=2), 313, 384)
    theirs = {there: net.state_dict()[here].clone() for here, there in published_names(net).items()}
    save_file(theirs | {"sequence_pos_encoder.pe": torch.zeros(9, 1, 16)}, tmp_path / "model.safetensors")
    np.save(tmp_path / "Mean.npy", np.arange(313.0))
    np.save(tmp_path / "Std.npy", np.full(313, 1e-6))
    (tmp_path / "recipe.yaml").write_text(RECIPE.format(root=tmp_path))
    done = call("run", tmp_path / "recipe.yaml", "-o", tmp_path / "run")
    assert done.code == 0, done.err
    loaded = load_file(tmp_path / "run/stages/mdm/model.safetensors")
    assert all(torch.equal(loaded[name], value) for name, value in net.state_dict().items())
    assert call("export", tmp_path / "run", "-o", tmp_path / "out").code == 0
    for place in ("run", "out"):
        model = MotionModel.from_pretrained(tmp_path / place, device="cpu")
        made = model.generate(["a person walks"], seconds=0.5, sampling={"denoising_steps": 2})[0]
        np.testing.assert_allclose(made.features, np.tile(np.arange(313.0), (10, 1)), atol=1e-3)
    assert str(tmp_path) not in (tmp_path / "out/bundle.json").read_text()
    # Equal files elsewhere are the same; other weights are loaded again, and those of another size refused.
    assert "nothing to do" in call("run", tmp_path / "recipe.yaml", "-o", tmp_path / "run").out.lower()
    save_file(theirs | {"embed_text.bias": torch.ones(17)}, tmp_path / "model.safetensors")
    done = call("run", tmp_path / "recipe.yaml", "-o", tmp_path / "run", "--replace")
    assert done.code == 2 and "model.safetensors: tensor 'embed_text.bias' is [17]" in done.err
    (tmp_path / "model.safetensors").unlink()
    done = call("run", tmp_path / "recipe.yaml", "-o", tmp_path / "run", "--replace")
    assert done.code == 2 and "model.safetensors: no such file" in done.err
