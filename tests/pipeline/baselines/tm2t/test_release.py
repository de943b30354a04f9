"""TM2T's release: what `docs/tm2t.py` makes of a copy is loaded by name, tokenizes as it, and captions."""

from __future__ import annotations

import json
import pickle
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

from motionloom.datasets.base.records import Caption
from motionloom.datasets.motion.features.h3d import encode_h3d
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.shards.sample import Sample
from motionloom.pipeline.contract.lookup import finished_stages
from motionloom.pipeline.contract.stage import StageCache

SCRIPT = Path(__file__).parents[4] / "docs" / "tm2t.py"
LAYOUT = MotionLayout.named("h3d263")
SPLITS = ("train", "train", "test")
CODES, LATENT, WIDE, DIM, FEED = 12, 8, 16, 16, 24
WORDS = ["sos", "eos", "unk", "a", "person", "walk", "left"]


class Residual(nn.Module):
    """The release's residual block, with its names."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.model = nn.Sequential(
            nn.Conv1d(width, width, 3, padding=1), nn.LeakyReLU(0.2), nn.Conv1d(width, width, 3, padding=1)
        )

    def forward(self, x: Tensor) -> Tensor:
        return x + self.model(x)


def networks() -> tuple[nn.Sequential, nn.Sequential]:
    """Encoder and decoder, layer by layer as published, at small widths."""
    encoder = nn.Sequential(
        nn.Conv1d(259, WIDE, 4, 2, 1), nn.LeakyReLU(0.2), Residual(WIDE),
        nn.Conv1d(WIDE, LATENT, 4, 2, 1), nn.LeakyReLU(0.2), Residual(LATENT),
    )  # fmt: skip
    decoder = nn.Sequential(
        *(Residual(LATENT) for _ in range(3)),
        nn.Upsample(scale_factor=2), nn.Conv1d(LATENT, WIDE, 3, padding=1), nn.LeakyReLU(0.2),
        nn.Upsample(scale_factor=2), nn.Conv1d(WIDE, 263, 3, padding=1), nn.LeakyReLU(0.2),
        nn.Conv1d(263, 263, 3, padding=1),
    )  # fmt: skip
    return encoder, decoder


def captioner() -> dict[str, Tensor]:
    """The transformer's tensors; one layer on each side."""
    shapes: dict[str, tuple[int, ...]] = {
        "encoder.src_word_emb.weight": (CODES + 3, DIM),
        "decoder.trg_word_emb.weight": (len(WORDS) + 1, DIM),
        "encoder.position_enc.positional_encoding": (100, DIM),
        "decoder.position_enc.positional_encoding": (50, DIM),
        "trg_word_prj.weight": (len(WORDS) + 1, DIM),
    }
    for side, attentions in (("encoder", ["slf_attn"]), ("decoder", ["slf_attn", "enc_attn"])):
        at = f"{side}.layer_stack.0"
        parts = ("w_qs", "w_ks", "w_vs", "fc")
        sizes = {f"{at}.{name}.{part}": (DIM, DIM) for name in attentions for part in parts}
        sizes |= {f"{at}.pos_ffn.w_1": (FEED, DIM), f"{at}.pos_ffn.w_2": (DIM, FEED)}
        shapes |= {f"{name}.weight": size for name, size in sizes.items()}
        shapes |= {f"{name}.bias": size[:1] for name, size in sizes.items()}
        for name in (*attentions, "pos_ffn"):
            shapes |= {f"{at}.{name}.layer_norm.{leaf}": (DIM,) for leaf in ("weight", "bias")}
    return {name: torch.randn(shape) * 0.3 for name, shape in shapes.items()}


@pytest.fixture
def release(tmp_path: Path) -> Path:
    """What the script makes of a copy of the authors' repository."""
    torch.manual_seed(0)
    source, random = tmp_path / "TM2T", np.random.default_rng(0)
    tokenizer = source / "checkpoints/t2m/VQVAEV3_CB1024_CMT_H1024_NRES3"
    words = source / "checkpoints/t2m/M2T_EL4_DL4_NH8_PS"
    for folder in (tokenizer / "model", tokenizer / "meta", words / "model", source / "glove"):
        folder.mkdir(parents=True)
    parts = {f"vq_{name}": {f"main.{key}": value for key, value in net.state_dict().items()}
             for name, net in zip(("encoder", "decoder"), networks(), strict=True)}  # fmt: skip
    codebook = {"embedding.weight": torch.randn(CODES, LATENT)}
    torch.save(parts | {"quantizer": codebook, "epoch": 3}, tokenizer / "model/finest.tar")
    torch.save({"m2t_transformer": captioner(), "total_it": 4}, words / "model/finest.tar")
    np.save(tokenizer / "meta/mean.npy", random.normal(size=263))
    np.save(tokenizer / "meta/std.npy", random.uniform(0.5, 2, size=263))
    rows = {word: row for row, word in enumerate(WORDS)}
    (source / "glove/our_vab_idx.pkl").write_bytes(pickle.dumps(rows))
    done = subprocess.run([sys.executable, SCRIPT, source, tmp_path / "made"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return tmp_path / "made"


def shards(out: Path, walk: Callable[..., Any]) -> None:
    """HumanML3D's features of walks."""

    def clip(number: int) -> Sample:
        # The same walk in two splits would be a leak.
        motion = encode_h3d(walk(frames=(60 + number) * (number + 1))[:: number + 1, :22], LAYOUT)
        about = {"source": "made", "split": SPLITS[number], "licence": "CC0", "has_hands": False}
        meta = LAYOUT.clip_meta(f"{number}", frames=len(motion), **about)  # type: ignore[arg-type]
        return Sample(meta, motion, texts=[Caption(text="a person walks")])

    items = [(split, number) for number, split in enumerate(SPLITS)]
    write_made(out, items, clip, LAYOUT)  # type: ignore[arg-type]


RECIPE = """
name: tm2t
hardware: {{accelerator: cpu, threads: 1, convert_workers: 1}}
stages:
  data: {{kind: shards, path: {root}/data}}
  stats: {{kind: stats, mean: {root}/made/mean.npy, std: {root}/made/std.npy}}
  tokenizer:
    kind: tm2t
    net: {{width: 16, code_dim: 8, num_codes: 12}}
    published: {root}/made/tokenizer.safetensors
  tokens: {{kind: tokens}}
  captioner:
    kind: captioner
    net: {{dim: 16, ff: 24, layers: 1, heads: 2, block_size: 60}}
    published: {root}/made/captioner.safetensors
"""


def test_a_release_tokenizes_as_it_does_and_captions(
    release: Path, tmp_path: Path, walk: Callable[..., Any], call: Callable[..., Any]
) -> None:
    shards(tmp_path / "data", walk)
    (tmp_path / "recipe.yaml").write_text(RECIPE.format(root=tmp_path))
    done = call("run", tmp_path / "recipe.yaml", "-o", tmp_path / "run")
    assert done.code == 0, done.err
    stage = finished_stages(tmp_path / "run")["tokenizer"]
    net = StageCache().get(stage).net
    motion, theirs = torch.randn(2, 24, 263), load_file(release / "tokenizer.safetensors")
    for part, own in zip(("vq_encoder", "vq_decoder"), networks(), strict=True):
        stem = f"{part}.main."
        own.load_state_dict({n.removeprefix(stem): v for n, v in theirs.items() if n.startswith(part)})
        own.eval()
        here = motion[..., :-4] if part == "vq_encoder" else torch.randn(2, 6, LATENT)
        wanted = own(here.transpose(1, 2)).transpose(1, 2)
        found = net.encoder(motion) if part == "vq_encoder" else net.decoder(here)
        torch.testing.assert_close(found, wanted)
    assert torch.equal(net.quantizer.codebook, theirs["quantizer.embedding.weight"])

    loaded = load_file(tmp_path / "run/stages/captioner/model.safetensors")
    given = load_file(release / "captioner.safetensors")
    tokens, words = given["encoder.src_word_emb.weight"], given["decoder.trg_word_emb.weight"]
    assert torch.equal(loaded["embeddings.0.weight"], torch.cat([tokens[:CODES], tokens[CODES + 1][None]]))
    assert torch.equal(loaded["start"][0], tokens[CODES])
    assert torch.equal(loaded["word_table.weight"], torch.cat([words[-1:], words[:-1]]))
    keys = given["decoder.layer_stack.0.enc_attn.w_ks.weight"]
    assert torch.equal(loaded["decoder.0.other.key.weight"], keys)
    np.savez(tmp_path / "walk.npz", joints=walk(frames=48), metadata=json.dumps({"fps": 20}))
    done = call("caption", tmp_path / "run", tmp_path / "walk.npz", "-o", tmp_path / "said.jsonl")
    assert done.code == 0, done.err
    record = json.loads((tmp_path / "said.jsonl").read_text())
    said = {word for found in record["captions"] for word in found["text"].split()}
    assert said and said <= set(WORDS[3:])


def test_a_captioner_without_its_words_is_refused(
    release: Path, tmp_path: Path, walk: Callable[..., Any], call: Callable[..., Any]
) -> None:
    shards(tmp_path / "data", walk)
    path = release / "captioner.safetensors"
    save_file(load_file(path), path)
    (tmp_path / "recipe.yaml").write_text(RECIPE.format(root=tmp_path))
    done = call("run", tmp_path / "recipe.yaml", "-o", tmp_path / "run")
    assert done.code == 2 and "no 'words' in" in done.err
