"""The published evaluator: what `docs/guo_evaluator.py` makes of a release is read back, judges as the
published definition says, written out slowly, and every fault of the folder is one sentence.

The release here is made up: weights by chance in the published shapes, a small vocabulary.
"""

from __future__ import annotations

import json
import pickle
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from shard_samples import write_made
from torch import Tensor, nn

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import sha256_of
from motionloom.datasets.base.records import Caption
from motionloom.datasets.motion.features.h3d import encode_h3d
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.shards.sample import Sample
from motionloom.pipeline.evaluation.figures import MODEL, FigureFile
from motionloom.pipeline.store.evaluator import embed_motions
from motionloom.pipeline.store.published_evaluator import load_published

SCRIPT = Path(__file__).parents[3] / "docs" / "guo_evaluator.py"
LAYOUT = MotionLayout.named("h3d263")
WORDS = ["the", "unk", "person", "eos", "walk", "left", "sos", "hop"]
CLASSES = [
    "VERB", "NOUN", "DET", "ADP", "NUM", "AUX", "PRON", "ADJ", "ADV", "Loc_VIP", "Body_VIP", "Obj_VIP",
    "Act_VIP", "Desc_VIP", "OTHER",
]  # fmt: skip
MODULE = f"""
import os

POS_enumerator = {{{", ".join(f"'{name}': {row}" for row, name in enumerate(CLASSES))}}}
PLACES = ('left', 'up')
ACTS = ('walk', 'left')
VIP_dict = {{'Loc_VIP': PLACES, 'Act_VIP': ACTS}}
raise RuntimeError("this is never run")
"""


class Reader(nn.Module):
    """The published encoder of one sequence."""

    def __init__(self, inputs: int, width: int, inside: int) -> None:
        super().__init__()
        self.hidden = nn.Parameter(torch.zeros(2, 1, width))
        self.input_emb = nn.Linear(inputs, width)
        self.gru = nn.GRU(width, width, batch_first=True, bidirectional=True)
        end = [nn.LayerNorm(inside), nn.LeakyReLU(0.2), nn.Linear(inside, 512)]
        self.output_net = nn.Sequential(nn.Linear(2 * width, inside), *end)

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = self.output_net(self.gru(self.input_emb(x)[None], self.hidden)[1].flatten())
        return out


def encoders() -> nn.ModuleDict:
    """The published networks, with the names of their weights."""
    layers = [nn.Dropout(), nn.LeakyReLU(0.2)]
    main = nn.Sequential(nn.Conv1d(259, 512, 4, 2, 1), *layers, nn.Conv1d(512, 512, 4, 2, 1), *layers)
    movement = nn.ModuleDict({"main": main, "out_net": nn.Linear(512, 512)})
    text = Reader(300, 512, 512)
    text.pos_emb = nn.Linear(15, 300)
    motion = Reader(512, 1024, 1024)
    return nn.ModuleDict({"movement_encoder": movement, "motion_encoder": motion, "text_encoder": text})


def slow_motion(net: Any, motion: Tensor) -> Tensor:
    """Latent [512] of normalised features [T, 263]."""
    units = len(motion) // 4
    x = torch.zeros(259, 196, dtype=motion.dtype)
    x[:, : units * 4] = motion[: units * 4, :-4].T
    movement = net["movement_encoder"]
    latent: Tensor = net["motion_encoder"](movement["out_net"](movement["main"](x).T)[:units])
    return latent


def slow_text(net: Any, words: list[tuple[Tensor, int]]) -> Tensor:
    """Latent [512] of words: each a vector [300] and the number of its class."""
    encoder, classes = net["text_encoder"], torch.eye(15, dtype=torch.float64)
    latent: Tensor = encoder(torch.stack([x + encoder.pos_emb(classes[kind]) for x, kind in words]))
    return latent


@pytest.fixture(scope="module")
def release(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the authors' repository, with weights."""
    root = tmp_path_factory.mktemp("release")
    generator = torch.Generator().manual_seed(0)
    checkpoint: dict[str, Any] = {"epoch": 3, "iter": 4, "opt_text_encoder": {"state": {}}}
    for encoder, net in encoders().items():
        checkpoint[encoder] = {
            name: torch.randn(x.shape, generator=generator) * (x.shape[-1] ** -0.5 if x.dim() > 1 else 0.3)
            for name, x in net.state_dict().items()
        }
    path = root / "checkpoints/t2m/text_mot_match/model/finest.tar"
    path.parent.mkdir(parents=True)
    torch.save(checkpoint, path)
    meta = root / "checkpoints/t2m/Comp_v6_KLD01/meta"
    meta.mkdir(parents=True)
    random = np.random.default_rng(0)
    np.save(meta / "mean.npy", random.normal(size=263))
    np.save(meta / "std.npy", random.uniform(0.5, 2, size=263))
    (root / "glove").mkdir()
    np.save(root / "glove/our_vab_data.npy", random.normal(size=(len(WORDS), 300)))
    order = random.permutation(len(WORDS)).tolist()
    (root / "glove/our_vab_words.pkl").write_bytes(pickle.dumps(WORDS))
    (root / "glove/our_vab_idx.pkl").write_bytes(pickle.dumps(dict(zip(WORDS, order, strict=True))))
    (root / "utils").mkdir()
    (root / "utils/word_vectorizer.py").write_text(MODULE)
    return root


def convert(release: Path, out: Path) -> subprocess.CompletedProcess[str]:
    words = [sys.executable, "-P", str(SCRIPT), str(release), str(out)]
    return subprocess.run(words, capture_output=True, text=True, timeout=120, check=False)


@pytest.fixture(scope="module")
def folder(release: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the script makes of it."""
    out = tmp_path_factory.mktemp("made") / "evaluator"
    done = convert(release, out)
    assert done.returncode == 0, done.stderr
    return out


def published(release: Path) -> Any:
    """The networks with the release's weights, float64."""
    path = release / "checkpoints/t2m/text_mot_match/model/finest.tar"
    checkpoint, nets = torch.load(path, weights_only=True), encoders()
    for name, net in nets.items():
        net.load_state_dict(checkpoint[name])
    return nets.double().eval().requires_grad_(False)


def test_latents_are_those_of_the_published_definition(release: Path, folder: Path) -> None:
    """Float64 to 1e-5: motions of many lengths in one batch, the longest without a frame behind it."""
    nets = published(release)
    judge = load_published(folder)
    judge.net.double()
    lengths = [196, 41, 64, 7, 195]
    random = np.random.default_rng(1)
    motions = [random.normal(size=(frames, 263)) for frames in lengths]
    meta = release / "checkpoints/t2m/Comp_v6_KLD01/meta"
    mean, std = (np.load(meta / f"{name}.npy").astype(np.float32) for name in ("mean", "std"))
    batch = torch.zeros(len(lengths), 196, 263, dtype=torch.float64)
    for row, motion in enumerate(motions):
        batch[row, : len(motion)] = torch.from_numpy((motion - mean) / std)
    found = judge.embed_motion(batch, torch.tensor(lengths))
    for row, motion in enumerate(motions):
        expected = slow_motion(nets, torch.from_numpy((motion - mean) / std))
        torch.testing.assert_close(found[row], expected, rtol=1e-5, atol=1e-5)
    assert found.std() > 0.1, "latents that say something"
    # As an evaluation embeds them, float32 in and cut to 196 frames.
    whole = embed_motions(
        load_published(folder), [m.astype(np.float32) for m in [*motions, np.concatenate([motions[0]] * 2)]]
    )
    torch.testing.assert_close(whole[:5].double(), found, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(whole[5], whole[0])


def test_captions_are_read_as_published(release: Path, folder: Path) -> None:
    """Marks at both ends, 20 words, lists before tags, unknown words and tags."""
    judge, nets = load_published(folder), published(release)
    judge.net.double()
    captions = {
        "the person walks": ["the/DET", "person/NOUN", "walk/VERB"],
        "left of the hop": ["left/ADJ", "hop/SPACE", "quokka/NOUN"],
        "the " * 30: ["the/DET"] * 30,
    }
    vectors = torch.from_numpy(np.load(release / "glove/our_vab_data.npy")).float().double()
    rows = pickle.loads((release / "glove/our_vab_idx.pkl").read_bytes())

    def word(name: str, kind: str) -> tuple[Tensor, int]:
        return vectors[rows[name]], CLASSES.index(kind)

    begin, end, the = word("sos", "OTHER"), word("eos", "OTHER"), word("the", "DET")
    expected = [
        [begin, the, word("person", "NOUN"), word("walk", "Act_VIP"), end],
        [begin, word("left", "Loc_VIP"), word("hop", "OTHER"), word("unk", "OTHER"), end],
        [begin, *[the] * 20, end],
    ]
    found = judge.embed_captions(list(captions), list(captions.values()))
    for row, words in enumerate(expected):
        torch.testing.assert_close(found[row], slow_text(nets, words), rtol=1e-5, atol=1e-5)


def test_a_caption_without_tags_is_refused(folder: Path) -> None:
    with pytest.raises(UserError, match=r"'The person hops' .*kind: evaluator"):
        load_published(folder).embed_captions(["The person hops"], [()])


def spoil(folder: Path, name: str, change: Callable[[dict[str, torch.Tensor]], None]) -> None:
    """Change tensors of a file, and its checksum with it."""
    tensors = load_file(folder / name)
    change(tensors)
    save_file(tensors, folder / name)
    sign(folder, name)


def sign(folder: Path, name: str) -> None:
    about = json.loads((folder / "evaluator.json").read_text())
    about["sha256"][name] = sha256_of(folder / name)
    (folder / "evaluator.json").write_text(json.dumps(about))


def rewrite(folder: Path, name: str, **changes: Any) -> None:
    about = json.loads((folder / name).read_text()) | changes
    (folder / name).write_text(json.dumps(about))
    if name != "evaluator.json":
        sign(folder, name)


BIAS = "movement_encoder.out_net.bias"
FAULTS: dict[str, tuple[Callable[[Path], Any], str]] = {
    "no folder": (shutil.rmtree, "no such folder"),
    "other layout": (lambda f: rewrite(f, "evaluator.json", layout="body133"), "key 'layout' = 'body133'"),
    "other bytes": (lambda f: (f / "words.json").write_text("{}"), r"words\.json: .* sha256"),
    "torn": (
        lambda f: ((f / "stats.safetensors").write_bytes(b"torn"), sign(f, "stats.safetensors")),
        r"stats\.safetensors: cannot be read",
    ),
    "missing": (
        lambda f: spoil(f, "model.safetensors", lambda t: t.pop(BIAS)),  # type: ignore[arg-type, return-value]
        f"tensor '{BIAS}' is no tensor",
    ),
    "shape": (
        lambda f: spoil(f, "model.safetensors", lambda t: t.update({BIAS: torch.ones(511)})),
        rf"tensor '{BIAS}' is \[511\]",
    ),
    "not finite": (
        lambda f: spoil(f, "stats.safetensors", lambda t: t["mean"].fill_(torch.nan)),  # type: ignore[arg-type, return-value]
        "tensor 'mean' holds numbers that are not finite",
    ),
    "other class": (lambda f: rewrite(f, "words.json", lists={"Nowhere": ["left"]}), "'classes' .*'Nowhere'"),
}


@pytest.mark.parametrize("fault", list(FAULTS))
def test_every_fault_is_one_sentence(fault: str, folder: Path, tmp_path: Path) -> None:
    broken = tmp_path / "evaluator"
    shutil.copytree(folder, broken)
    spoiler, sentence = FAULTS[fault]
    spoiler(broken)
    with pytest.raises(UserError, match=sentence) as caught:
        load_published(broken)
    assert "\n" not in str(caught.value) and str(broken) in str(caught.value)


def test_the_script_reads_no_objects_from_pickles(release: Path, tmp_path: Path) -> None:
    bad = tmp_path / "release"
    shutil.copytree(release, bad)
    (bad / "glove/our_vab_words.pkl").write_bytes(pickle.dumps([Path("x")]))
    done = convert(bad, tmp_path / "out")
    assert done.returncode == 1 and "a list of words" in done.stderr
    (bad / "glove/our_vab_words.pkl").write_bytes(pickle.dumps(WORDS))
    torch.save({"movement_encoder": Path("x")}, bad / "checkpoints/t2m/text_mot_match/model/finest.tar")
    done = convert(bad, tmp_path / "out")
    assert done.returncode == 1 and "weights_only" in done.stderr


RECIPE = """
name: judged
seed: 1
hardware: {accelerator: cpu, threads: 1, convert_workers: 1}
stages:
  data: {kind: shards, path: SHARDS}
  stats: {kind: stats}
  text: {kind: text}
  guo: {kind: guo_evaluator, folder: FOLDER}
  temos:
    {kind: tma, net: {latent: 8, ff: 16, layers: 1, heads: 2}, loss: {contrastive: 0.0},
     train: {steps: 2, batch_size: 4, validate_every: 0}}
  evaluate:
    {kind: evaluate, repeats: 4, size: 4, lengths: recorded, inputs: {evaluator: guo, generators: [temos]}}
"""


def shards(out: Path, walk: Callable[..., Any], tokens: bool) -> None:
    def clip(number: int) -> Sample:
        joints = walk(frames=45 + number, turn=0.2 * number)[:, :22]
        motion = encode_h3d(joints, LAYOUT)
        split = "test" if number % 2 else "train"
        meta = LAYOUT.clip_meta(
            f"{number:03d}", source="made", split=split, frames=len(motion), licence="CC0", has_hands=False
        )
        words = ["the/DET", "person/NOUN", "walk/VERB"] + ["left/ADV"] * number
        text = " ".join(word.partition("/")[0] for word in words)
        return Sample(meta, motion, texts=[Caption(text=text, tokens=words if tokens else None)])

    items = [("test" if number % 2 else "train", number) for number in range(20)]
    write_made(out, items, clip, LAYOUT, clips_per_shard=8)  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_run_is_judged_by_it(
    folder: Path, walk: Callable[..., Any], call: Callable[..., Any], tmp_path: Path
) -> None:
    recipe = RECIPE.replace("FOLDER", str(folder))
    for name, tokens in (("tagged", True), ("plain", False)):
        shards(tmp_path / name, walk, tokens)
        (tmp_path / f"{name}.yaml").write_text(recipe.replace("SHARDS", str(tmp_path / name)))
    done = call("run", tmp_path / "tagged.yaml", "--out", tmp_path / "run")
    assert done.code == 0, done.err
    file = FigureFile.read(tmp_path / "run/stages/evaluate/metrics.json")
    weights = sha256_of(folder / "model.safetensors")
    assert file.about["judges"]["evaluator"] == {"stage": "guo", "kind": "guo_evaluator", "sha256": weights}
    made = {one.name: one for one in file.figures if one.row == MODEL}
    facts = made["evaluator.top-1"].protocol
    assert (facts["clips"], facts["candidates"]) == (10, 4)
    assert made["evaluator.matching_score"].value > 0 and made["evaluator.multimodality"].value > 0
    done = call("run", tmp_path / "plain.yaml", "--out", tmp_path / "plain-run")
    assert done.code == 2 and "word/POS tags" in done.err
