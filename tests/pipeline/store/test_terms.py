"""Licences and credits of data travel into everything that is made from it; the strictest holds."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from bvh_clips import write_clip
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.licences import CMU, CREDITS, UNKNOWN, credits_of, strictest
from motionloom.datasets.base.records import Manifest
from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.synth.generate import SynthConfig, synthesize
from motionloom.datasets.text.build import build_with_encoder
from motionloom.datasets.text.encoder import EncodedText
from motionloom.models.diffusion.network import TextDenoiserConfig
from motionloom.pipeline.baselines.mdm.network import Mdm
from motionloom.pipeline.baselines.mdm.stage import published_names
from motionloom.pipeline.contract.stage import Stage, stage_kind
from motionloom.pipeline.inference.model import MotionModel
from motionloom.pipeline.stages.data.prepare import TextConfig
from motionloom.pipeline.store import text
from motionloom.pipeline.store.artifact import Artifact, InputStage, Terms
from motionloom.pipeline.store.files import write_json
from motionloom.pipeline.store.text import TextSource
from motionloom.pipeline.store.weights import Release, Rows, halve_weights
from motionloom.pipeline.training.warm_start import same_encoder

ORDER = (
    "CC0-1.0", CMU, "CC-BY-3.0", "CC-BY-SA-3.0", "CC-BY-NC-4.0", "CC-BY-NC-SA-4.0", "CC-BY-NC-ND-4.0",
    "bones-seed-license",
)  # fmt: skip
NAMES = (
    *ORDER, "MIT", "CC-BY-4.0", "CC-BY-2.1-JP", "AMASS-noncommercial", UNKNOWN, "",
    "CC-BY-4.0 AND LicenseRef-AIST-Dance-DB",
)  # fmt: skip


def test_order() -> None:
    assert all(strictest(pair) == pair[1] for pair in pairwise(ORDER))
    assert strictest(["CC-BY-4.0", CMU, "CC-BY-3.0"]) == "CC-BY-3.0 AND CC-BY-4.0"
    assert strictest([]) == strictest(["", "CC0-1.0"]) == UNKNOWN
    assert strictest(["CC-BY-4.0 AND LicenseRef-AIST-Dance-DB"]) == "LicenseRef-AIST-Dance-DB"


def test_who_is_to_be_named() -> None:
    assert credits_of(["CC0-1.0", "MIT", UNKNOWN], "x") == []
    assert credits_of([CMU], "x") == [CREDITS[CMU]]
    [asked] = credits_of(["CC-BY-4.0"], "walks")
    assert "'walks'" in asked and "CC-BY-4.0" in asked
    assert credits_of([CMU, "CC-BY-4.0"], "x", ["by A"]) == ["by A", CREDITS[CMU]]


def test_any_mix_of_any_stages_knows_all_of_its_data(tmp_path: Path) -> None:
    """Random graphs of stages: a stage has what all data above it has, whatever way it came."""
    random = np.random.default_rng(0)
    for number in range(60):
        stages: list[tuple[Path, set[str]]] = []
        for at in range(int(random.integers(2, 9))):
            folder = tmp_path / str(number) / "stages" / str(at)
            folder.mkdir(parents=True)
            above = [stages[i] for i in random.choice(at, size=min(at, 3), replace=False)] if at > 1 else []
            own = (
                set(random.choice(NAMES, size=random.integers(0, 3)))
                if above
                else {str(random.choice(NAMES))}
            )
            terms = Terms.union([Terms(licences=tuple(own)), Terms.of(place for place, _ in above)])
            inputs = {place.name: InputStage(stage=place.name, fingerprint="0") for place, _ in above}
            Artifact(
                stage=str(at), kind="mix", version=1, fingerprint="0", seed=0, config={}, inputs=inputs,
                terms=terms,
            ).finish(folder)  # fmt: skip
            stages.append((folder, own.union(*(found for _, found in above))))
        for folder, wanted in stages:
            terms = Terms.of([folder])
            assert set(terms.licences) == wanted and terms.licence == strictest(wanted)
        parts = [Terms.of([folder]) for folder, _ in stages]
        everything = {name for _, found in stages for name in found}
        assert (
            Terms.union(parts).licence == strictest(part.licence for part in parts) == strictest(everything)
        )
    (folder / "artifact.json").write_text((folder / "artifact.json").read_text().replace('"terms"', '"code"'))
    assert Terms.of([tmp_path / "gone"]).licence == UNKNOWN


RECIPE = """
name: credited
hardware: {accelerator: cpu, threads: 1, convert_workers: 1}
defaults: {trained: {train: {steps: 2, batch_size: 2}}}
stages:
  cmu: &clips
    {kind: bvh, source: AT/cmu, captions: AT/cmu/words.csv, licence: CMU-mocap, splits: AT/cmu}
  walks:
    {<<: *clips, source: AT/walks, captions: AT/walks/words.csv, licence: CC-BY-4.0, splits: AT/walks,
     name: walks}
  data: {kind: mix, inputs: {data: [cmu, walks]}, allow_leaks: true}
  stats: {kind: stats}
  text: {kind: text}
  tokenizer: {kind: rvq, net: {part: body, width: 8, depth: 1, code_dim: 8, num_codes: 8, levels: 1}}
  tokens: {kind: tokens}
  gpt: {kind: gpt, net: {layers: 1, dim: 16, heads: 2, ff: 16}, prior: sentence, loss: {align_weight: 0.0}}
"""


def test_from_files_to_card_and_page(tmp_path: Path, call: Callable[..., Any]) -> None:
    for number, name in enumerate(("cmu", "walks")):
        (tmp_path / name).mkdir()
        for clip in range(4):
            write_clip(tmp_path / name / f"{name}{clip}.bvh", 10 * number + clip)
        rows = [f"{name}{clip},a person walks" for clip in range(4)]
        (tmp_path / name / "words.csv").write_text("\n".join(["name,caption", *rows]))
        for split, clips in (("train", "01"), ("val", "2"), ("test", "3")):
            (tmp_path / name / f"{split}.txt").write_text("\n".join(f"{name}{clip}" for clip in clips))
    (tmp_path / "recipe.yaml").write_text(RECIPE.replace("AT", str(tmp_path)))
    run, model = tmp_path / "run", tmp_path / "model"
    assert call("run", tmp_path / "recipe.yaml", "-o", run).code == 0
    manifest = Manifest.load_json(run / "stages/cmu/shards/manifest.json")
    assert manifest.credits == [CREDITS[CMU]]
    [walks] = Manifest.load_json(run / "stages/walks/shards/manifest.json").credits
    expected = {"licences": [*sorted([CMU, "CC-BY-4.0"])], "credits": [CREDITS[CMU], walks]}
    for stage in ("data", "tokenizer", "gpt"):
        assert json.loads((run / f"stages/{stage}/artifact.json").read_text())["terms"] == expected
    done = call("export", run, "-o", model)
    assert done.code == 0 and "CC-BY-4.0, the strictest of its data" in done.out + done.err
    assert json.loads((model / "gpt/artifact.json").read_text())["terms"] == expected
    card = (model / "README.md").read_text()
    assert "\nlicense: cc-by-4.0\n" in card and CREDITS[CMU] in card and walks in card
    assert call("generate", model, "a person walks", "-o", tmp_path / "out", "--format", "html").code == 0
    assert CREDITS[CMU].split(". ")[0] in next((tmp_path / "out").glob("*.html")).read_text()


# Weights in half precision: half the bytes, the nearest 16-bit numbers, a model that generates.


def test_what_has_no_room_in_half_precision_stays(tmp_path: Path) -> None:
    path = tmp_path / "model.safetensors"
    small = torch.tensor([1.0, 1e-3, -65504.0])
    state = {
        "small": small,
        "large": torch.tensor([1.0, 1e6]),
        "infinite": torch.tensor([1.0, float("inf")]),
        "whole": torch.tensor([70000, 1]),
        "double": torch.tensor([0.1], dtype=torch.float64),
    }
    save_file(state, path)
    halve_weights(path)
    found = load_file(path)
    assert found["small"].dtype == torch.float16 and torch.equal(found["small"], small.half())
    for name in ("large", "infinite", "whole", "double"):
        assert found[name].dtype == state[name].dtype and torch.equal(found[name], state[name])


def test_a_half_export_generates(small_run: Any, call: Any, tmp_path: Path) -> None:
    assert call("export", small_run.folder, "-o", tmp_path / "half", "--half").code == 0
    halves = sorted((tmp_path / "half").glob("*/model.safetensors"))
    wholes = [small_run.folder / "stages" / path.parent.name / path.name for path in halves]
    sizes = [sum(path.stat().st_size for path in paths) for paths in (halves, wholes)]
    assert sizes[0] < 0.6 * sizes[1]
    for path, whole in zip(halves, wholes, strict=True):
        halved = load_file(path)
        for name, value in load_file(whole).items():
            # Half precision rounds to 11 bits, and to steps of 2^-24 below its smallest normal number.
            torch.testing.assert_close(
                halved[name].to(value.dtype), value, rtol=2**-11, atol=2**-25, msg=name
            )
    model = MotionModel.from_pretrained(tmp_path / "half", device="cpu")
    made = model.generate(["a person walks forward"], seconds=1.0)[0]
    assert len(made.joints) == made.layout.fps and np.isfinite(made.joints).all()


# Published weights in place of a training: read under their names, refused where they differ.

LAYERS = Release({"weight": Rows("joined", (7, 4, 5, 6), 12), "bias": "below"}, unread=("pe", "clip.*"))


def stored(**changed: Tensor) -> dict[str, Tensor]:
    fine = {"joined": torch.arange(24.0).reshape(12, 2), "below": torch.arange(4.0)[:, None]}
    return fine | changed


def test_rows_are_picked(tmp_path: Path) -> None:
    net = nn.Linear(2, 4)
    save_file(stored(pe=torch.zeros(7), **{"clip.x": torch.ones(3)}), tmp_path / "theirs")
    LAYERS.fill(tmp_path / "theirs", net)
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
        LAYERS.fill(tmp_path / "theirs.safetensors", nn.Linear(2, 4))
    (tmp_path / "theirs.safetensors").write_bytes(b"no weights")
    with pytest.raises(UserError, match="cannot be read"):
        LAYERS.fill(tmp_path / "theirs.safetensors", nn.Linear(2, 4))


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


PUBLISHED = """
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
    (tmp_path / "recipe.yaml").write_text(PUBLISHED.format(root=tmp_path))
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


# A text stage read by another run: words that its own data did not say, and an export exported again.

CPU = torch.device("cpu")


class Letters:
    """Every letter a token: its place in the alphabet, in 4 columns."""

    name, dim = "letters:1", 4

    def encode(self, captions: Sequence[str]) -> EncodedText:
        longest = max(map(len, captions))
        tokens, mask = (
            np.zeros((len(captions), longest, 4), np.float32),
            np.zeros((len(captions), longest), bool),
        )
        for row, caption in enumerate(captions):
            tokens[row, : len(caption)] = np.array([[ord(c) - 96] * 4 for c in caption])
            mask[row, : len(caption)] = True
        return EncodedText(np.full((len(captions), 4), 0.5, np.float32), tokens, mask)


@pytest.fixture
def loaded(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Encoders that were loaded."""
    names: list[str] = []

    def load(name: str, device: str) -> Letters:
        names.append(name)
        return Letters()

    monkeypatch.setattr(text, "load_text_encoder", load)
    return names


def test_captions_come_from_the_cache_if_it_has_them_all(tmp_path: Path, loaded: list[str]) -> None:
    build_with_encoder(tmp_path / "cache", {"walk", "jump"}, Letters(), progress=False)
    source = TextSource(tmp_path, "own", CPU)
    tokens, mask = source.tokens(["jump", "walk"])
    assert not loaded
    want = Letters().encode(["jump", "walk"])
    np.testing.assert_array_equal(tokens, want.tokens)
    np.testing.assert_array_equal(mask, want.mask)
    tokens, mask = source.tokens(["jump", "run"])
    assert loaded == ["own"], "another run says other things"
    want = Letters().encode(["jump", "run"])
    np.testing.assert_array_equal(tokens, want.tokens)
    np.testing.assert_array_equal(mask, want.mask)


def exported(folder: Path) -> TextSource:
    """The text stage of an export, with an encoder of its own."""
    (folder / "text/encoder").mkdir(parents=True)
    (folder / "text/encoder/model.safetensors").write_bytes(b"weights")
    (folder / "text/encoder/code.py").write_text("print('no')")
    write_json(folder / "text/text.json", {"encoder": "encoder", "dim": 4})
    write_json(folder / "bundle.json", {})
    return TextSource(folder / "text", "minilm", CPU, exported=True)


def test_an_export_has_no_cache_and_brings_its_encoder_along(tmp_path: Path, loaded: list[str]) -> None:
    source = exported(tmp_path)
    tokens, _ = source.tokens(["walk"])
    np.testing.assert_array_equal(tokens, Letters().encode(["walk"]).tokens)
    assert loaded == [str(tmp_path / "text/encoder")]
    source.export(tmp_path / "again")
    there = {path.relative_to(tmp_path / "again").as_posix() for path in (tmp_path / "again").rglob("*.*")}
    assert there == {"text.json", "encoder/model.safetensors"}, "and no code"
    assert TextSource(tmp_path / "again", "", CPU, exported=True).dim == 4


def test_text_stages_of_one_encoder(tmp_path: Path) -> None:
    """An export's says nothing in its config; the same folder may be written in several ways."""
    exported(tmp_path)
    place, kind = str(tmp_path / "text"), stage_kind("text", "here")
    other = str(tmp_path / "run/stages/text")
    given = {"near": "minilm", "far": f"{tmp_path}/text/../text/encoder", other: "minilm", place: "minilm"}
    stages = {n: Stage(n, kind, TextConfig(encoder=encoder), {"data": n}) for n, encoder in given.items()}
    assert same_encoder("near", other, stages) and same_encoder("near", "unknown", stages)
    assert same_encoder("far", place, stages)
    assert not same_encoder("near", place, stages) and not same_encoder("near", "far", stages)
