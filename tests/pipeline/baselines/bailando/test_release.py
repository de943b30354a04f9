"""Bailando's release: loaded by its names, it dances as slow networks with those names do."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from rich.console import Console
from safetensors.torch import load_file, save_file
from torch import Tensor
from torch.nn import functional as F

from motionloom.datasets.audio.sound import Sound
from motionloom.pipeline.baselines.bailando.codes import DanceVq, DanceVqConfig
from motionloom.pipeline.baselines.bailando.network import ActorCritic, CrossGpt, CrossGptConfig, tiled_causal
from motionloom.pipeline.baselines.bailando.release import release_of_codes, release_of_gpt
from motionloom.pipeline.contract.stage import StageCache
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.inference.generation import generate
from motionloom.pipeline.inference.request import Request
from motionloom.pipeline.runs.api import run_recipe

Weights = dict[str, Tensor]
WIDE, DEPTH, HALVINGS, LATENT, CODES = 8, 2, 2, 6, 16
DIM, HEADS, CONTEXT, MUSIC = 16, 2, 5, 438
LAYERS = {"gpt_base": 1, "gpt_head": 2, "critic_net": 1}
PARTS = {"up": [3, 6, 9, *range(12, 22)], "down": [0, 1, 2, 4, 5, 7, 8, 10, 11]}
FINGERS = 30
"""Joints that the layout of whole bodies has besides."""


def drawn(shapes: dict[str, tuple[int, ...]]) -> Weights:
    torch.manual_seed(0)
    return {name: torch.randn(shape) * 0.3 for name, shape in shapes.items()}


def codes_release(more: int = 0) -> Weights:
    """The file of encoders, decoders and codes, at small widths; `more` upper joints than 13."""
    shapes: dict[str, tuple[int, ...]] = {}

    def layer(name: str, *weight: int, out: int | None = None) -> None:
        shapes[f"{name}.weight"], shapes[f"{name}.bias"] = weight, (weight[0] if out is None else out,)

    def stack(name: str) -> None:
        for block in range(DEPTH):
            layer(f"{name}.model.{block}.model.1", WIDE, WIDE, 3)
            layer(f"{name}.model.{block}.model.3", WIDE, WIDE, 1)

    def decoder(name: str, columns: int) -> None:
        at = f"{name}.0.level_blocks.0.model"
        layer(f"{at}.0", WIDE, LATENT, 3)
        for level in range(HALVINGS):
            stack(f"{at}.{level + 1}.0")
            wide = LATENT if level == HALVINGS - 1 else WIDE
            layer(f"{at}.{level + 1}.1", WIDE, wide, 4, out=wide)
        layer(f"{name}.0.out", columns, LATENT, 3)

    for half, joints in PARTS.items():
        at, columns = f"vqvae_{half}.encoders.0.level_blocks.0.model", 3 * len(joints)
        columns += 3 * more * (half == "up")
        for level in range(HALVINGS):
            layer(f"{at}.{level}.0", WIDE, WIDE if level else columns, 4)
            stack(f"{at}.{level}.1")
        layer(f"{at}.{HALVINGS}", LATENT, WIDE, 3)
        decoder(f"vqvae_{half}.decoders", columns)
        shapes[f"vqvae_{half}.bottleneck.level_blocks.0.k"] = (CODES, LATENT)
    decoder("vqvae_down.decoders_root", 3)
    return drawn(shapes)


def gpt_release() -> Weights:
    """The file of the GPT and its critic."""
    shapes: dict[str, tuple[int, ...]] = {
        "gpt_base.pos_emb": (1, 3 * CONTEXT, DIM), "gpt_base.tok_emb_up.weight": (CODES, DIM),
        "gpt_base.tok_emb_down.weight": (CODES, DIM), "gpt_base.cond_emb.weight": (DIM, MUSIC),
        "gpt_base.cond_emb.bias": (DIM,),
    }  # fmt: skip
    for stack, layers in LAYERS.items():
        norms = [f"{stack}.blocks.{n}.{name}" for n in range(layers) for name in ("ln1", "ln2")]
        if stack != "gpt_base":
            rows = 1 if stack == "critic_net" else CODES
            shapes |= {f"{stack}.head_{half}.weight": (rows, DIM) for half in PARTS}
            norms.append(f"{stack}.ln_f")
        shapes |= {f"{name}.{kind}": (DIM,) for name in norms for kind in ("weight", "bias")}
        for n in range(layers):
            at = f"{stack}.blocks.{n}"
            shapes[f"{at}.attn.mask"] = (1, 1, CONTEXT, CONTEXT)
            sizes = {f"attn.{name}": (DIM, DIM) for name in ("key", "query", "value", "proj")}
            for name, size in (sizes | {"mlp.0": (4 * DIM, DIM), "mlp.2": (DIM, 4 * DIM)}).items():
                shapes |= {f"{at}.{name}.weight": size, f"{at}.{name}.bias": size[:1]}
    return drawn(shapes)


def slow_stack(w: Weights, name: str, x: Tensor, dilations: list[int]) -> Tensor:
    for block, apart in enumerate(dilations):
        at = f"{name}.model.{block}.model"
        inner = F.conv1d(x.relu(), w[f"{at}.1.weight"], w[f"{at}.1.bias"], padding=apart, dilation=apart)
        x = x + F.conv1d(inner.relu(), w[f"{at}.3.weight"], w[f"{at}.3.bias"])
    return x


def slow_codes(w: Weights, half: str, x: Tensor) -> Tensor:
    """[B, T, D] -> [B, L]."""
    at, x = f"vqvae_{half}.encoders.0.level_blocks.0.model", x.transpose(1, 2)
    for level in range(HALVINGS):
        x = F.conv1d(x, w[f"{at}.{level}.0.weight"], w[f"{at}.{level}.0.bias"], stride=2, padding=1)
        x = slow_stack(w, f"{at}.{level}.1", x, [1, 3])
    x = F.conv1d(x, w[f"{at}.{HALVINGS}.weight"], w[f"{at}.{HALVINGS}.bias"], padding=1)
    return torch.cdist(x.transpose(1, 2), w[f"vqvae_{half}.bottleneck.level_blocks.0.k"]).argmin(-1)


def slow_frames(w: Weights, half: str, decoder: str, codes: Tensor) -> Tensor:
    """[B, L] -> [B, T, D]."""
    x = w[f"vqvae_{half}.bottleneck.level_blocks.0.k"][codes].transpose(1, 2)
    at = f"vqvae_{half}.{decoder}.0"
    model = f"{at}.level_blocks.0.model"
    x = F.conv1d(x, w[f"{model}.0.weight"], w[f"{model}.0.bias"], padding=1)
    for level in range(1, HALVINGS + 1):
        x = slow_stack(w, f"{model}.{level}.0", x, [3, 1])
        up = f"{model}.{level}.1"
        x = F.conv_transpose1d(x, w[f"{up}.weight"], w[f"{up}.bias"], stride=2, padding=1)
    return F.conv1d(x, w[f"{at}.out.weight"], w[f"{at}.out.bias"], padding=1).transpose(1, 2)


def slow_blocks(w: Weights, stack: str, x: Tensor) -> Tensor:
    """Through a stack, a head at a time; a row sees what is not later in each of the three blocks."""

    def linear(name: str, x: Tensor) -> Tensor:
        return F.linear(x, w[f"{name}.weight"], w.get(f"{name}.bias"))

    def norm(name: str, x: Tensor) -> Tensor:
        return F.layer_norm(x, (DIM,), w[f"{name}.weight"], w[f"{name}.bias"])

    time = torch.arange(x.shape[1]) % (x.shape[1] // 3)
    later, wide = time[None] > time[:, None], DIM // HEADS
    for n in range(LAYERS[stack]):
        at = f"{stack}.blocks.{n}"
        read = norm(f"{at}.ln1", x)
        q, k, v = (linear(f"{at}.attn.{name}", read) for name in ("query", "key", "value"))
        heads = []
        for head in range(HEADS):
            mine = slice(head * wide, (head + 1) * wide)
            scores = q[..., mine] @ k[..., mine].transpose(1, 2) / wide**0.5
            heads.append(scores.masked_fill(later, -torch.inf).softmax(-1) @ v[..., mine])
        x = x + linear(f"{at}.attn.proj", torch.cat(heads, dim=-1))
        x = x + linear(f"{at}.mlp.2", F.gelu(linear(f"{at}.mlp.0", norm(f"{at}.ln2", x))))
    return x if f"{stack}.ln_f.weight" not in w else norm(f"{stack}.ln_f", x)


def test_codes_and_joints_are_those_of_the_release(tmp_path: Path) -> None:
    w = codes_release()
    save_file(w, tmp_path / "vqvae.safetensors")
    sizes = {"width": WIDE, "depth": DEPTH, "halvings": HALVINGS, "code_dim": LATENT, "num_codes": CODES}
    net = DanceVq(DanceVqConfig(**sizes), 22).eval()  # type: ignore[arg-type]
    release_of_codes(net).fill(tmp_path / "vqvae.safetensors", net)
    joints = torch.randn(2, 16, 22, 3)
    joints[:, :, 0] = 0
    codes, made = net.encode(joints), net.decode(net.encode(joints))
    assert codes.unique().numel() > 3
    for k, (half, own) in enumerate(PARTS.items()):
        assert torch.equal(codes[..., k], slow_codes(w, half, joints[:, :, own].flatten(2)))
        frames = slow_frames(w, half, "decoders", codes[..., k]).view(2, 16, -1, 3)
        moved = made - made[:, :, :1]
        shown = slice(1 if half == "down" else 0, None)
        torch.testing.assert_close(moved[:, :, own][:, :, shown], frames[:, :, shown], rtol=1e-4, atol=1e-5)
    steps = slow_frames(w, "down", "decoders_root", codes[..., 1])
    torch.testing.assert_close(made[:, 1:, 0] - made[:, :-1, 0], steps[:, :-1], rtol=1e-4, atol=1e-5)


def test_logits_and_values_are_those_of_the_release(tmp_path: Path) -> None:
    w = gpt_release()
    save_file(w, tmp_path / "gpt.safetensors")

    def fresh() -> CrossGpt:
        config = CrossGptConfig(dim=DIM, heads=HEADS, ff=4 * DIM, layers=1, context=CONTEXT)
        gpt = CrossGpt(config, CODES, MUSIC)
        gpt.head = type(gpt.head)(config, LAYERS["gpt_head"])  # of another depth, so that none is the other
        return gpt

    both = ActorCritic(fresh(), LAYERS["critic_net"])
    release_of_gpt(both).fill(tmp_path / "gpt.safetensors", both)
    alone = fresh()
    release_of_gpt(alone).fill(tmp_path / "gpt.safetensors", alone)
    assert all(torch.equal(value, both.gpt.state_dict()[name]) for name, value in alone.state_dict().items())
    both.double().eval()
    w = {name: value.double() for name, value in w.items()}
    codes, music = torch.randint(CODES, (2, 4, 2)), torch.randn(2, 4, MUSIC, dtype=torch.float64)
    heard = F.linear(music, w["gpt_base.cond_emb.weight"], w["gpt_base.cond_emb.bias"])
    read = [w[f"gpt_base.tok_emb_{half}.weight"][codes[..., k]] for k, half in enumerate(PARTS)]
    places = w["gpt_base.pos_emb"].view(3, CONTEXT, DIM)[:, :4].flatten(0, 1)
    states = slow_blocks(w, "gpt_base", torch.cat([heard, *read], dim=1) + places)
    out = slow_blocks(w, "gpt_head", states)
    worth = slow_blocks(w, "critic_net", states)
    logits = both.gpt(codes, music)
    values = both.critic(both.gpt.states(codes, music), tiled_causal(4, torch.device("cpu")))
    for k, half in enumerate(PARTS):
        block = slice(4 * (k + 1), 4 * (k + 2))
        torch.testing.assert_close(logits[:, :, k], out[:, block] @ w[f"gpt_head.head_{half}.weight"].T)
        wanted = worth[:, block] @ w[f"critic_net.head_{half}.weight"].T
        torch.testing.assert_close(values[..., k], wanted[..., 0])


RECIPE = f"""
extends: ude-small
name: bailando
stages:
  audio: {{kind: audio, raw: true, rate: 7.5}}
  dance_vq:
    kind: dance_vq
    net:
      {{width: {WIDE}, depth: {DEPTH}, halvings: {HALVINGS}, code_dim: {LATENT}, num_codes: {CODES},
        reset_below: 0.05}}
    window: 24
    published: vqvae.safetensors
  cross_gpt: &gpt
    kind: cross_gpt
    net: {{dim: {DIM}, heads: {HEADS}, ff: {4 * DIM}, layers: 1, context: {CONTEXT}, music: first}}
    published: gpt.safetensors
  actor_critic: {{kind: actor_critic, reward: {{critic_layers: 1}}, published: gpt.safetensors}}
  of_bailando: {{kind: evaluate_dances, clips: 4, repeats: 1, inputs: {{generators: [actor_critic]}}}}
  evaluate: null
  evaluate_dances: null
  generate: null
  report: null
"""


@pytest.mark.slow
def test_a_release_is_evaluated_and_dances_to_a_song(
    ude_run: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: Callable[..., Any]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(LAYERS, "gpt_head", 1)
    w = gpt_release()
    save_file(codes_release(FINGERS), "vqvae.safetensors")
    save_file(w, "gpt.safetensors")
    shutil.copy(ude_run.recipe, "ude-small.yaml")
    Path("bailando.yaml").write_text(RECIPE)
    shutil.copytree(ude_run.folder, "run")
    run = run_recipe(Path("bailando.yaml"), Path("run"), replace=True, console=Console(quiet=True))
    loaded = load_file(run / "stages/actor_critic/model.safetensors")
    assert torch.equal(loaded["gpt.music.weight"], w["gpt_base.cond_emb.weight"])
    assert loaded["gpt.kept"].unique().numel() > 1  # codes that dances of the data begin with
    stats = load_file(run / "stages/audio/audio.safetensors")
    assert not stats["mean"].any() and (stats["std"] == 1).all()

    done = call("export", run, "--out", "model")
    assert done.code == 0, done.err
    [only] = [one for one in Bundle.open(tmp_path / "model").stages if one.name == "actor_critic"]
    beats = (np.arange(8000 * 4) % 4000) < 800
    song = Sound((0.2 * beats * np.random.default_rng(0).normal(size=len(beats))).clip(-1, 1), 8000)
    made = generate(Bundle([only], StageCache()), Request.of(sounds=[song], seconds=3.0, seed=1))
    assert made[0].joints.shape == (60, 22 + FINGERS, 3) and np.isfinite(made[0].joints).all()
    assert [key[3] for key in song.analysed] == [7.5]
