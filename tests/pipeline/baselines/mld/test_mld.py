"""MLD: its published names, its losses by a slow second version, and its sampling."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.features.joints import joints_of
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.layers.transformer import length_mask
from motionloom.models.training.stage_module import OptimConfig
from motionloom.pipeline.baselines.mld.module import MotionVaeModule
from motionloom.pipeline.baselines.mld.network import (
    LatentDenoiser,
    LatentDiffusionConfig,
    MotionVae,
    MotionVaeConfig,
    MotionVaeLossConfig,
)
from motionloom.pipeline.baselines.mld.stage import (
    LatentDiffusionStage,
    MotionVaeStage,
    mld_names,
    sample_latents,
)

SMALL = {"dim": 16, "ff": 32, "layers": 3, "heads": 2, "dropout": 0.0, "attention_dropout": 0.0}
LENGTH = torch.tensor([12, 7])


def published_u(kind: str) -> dict[str, tuple[int, ...]]:
    """Tensors of a U of nine layers, as torch's own layers have them."""
    layer = {"self_attn.in_proj_weight": (768, 256), "self_attn.in_proj_bias": (768,)}
    layer |= {"self_attn.out_proj.weight": (256, 256), "self_attn.out_proj.bias": (256,)}
    if kind == "decoder":
        layer |= {name.replace("self", "multihead"): shape for name, shape in layer.items()}
    layer |= {"linear1.weight": (1024, 256), "linear1.bias": (1024,)}
    layer |= {"linear2.weight": (256, 1024), "linear2.bias": (256,)}
    norms = (1, 2, 3) if kind == "decoder" else (1, 2)
    layer |= {f"norm{k}.{what}": (256,) for k in norms for what in ("weight", "bias")}
    blocks = [f"{side}_blocks.{k}" for side in ("input", "output") for k in range(4)] + ["middle_block"]
    out = {f"{kind}.{block}.{name}": shape for block in blocks for name, shape in layer.items()}
    for k in range(4):
        out |= {f"{kind}.linear_blocks.{k}.weight": (256, 512), f"{kind}.linear_blocks.{k}.bias": (256,)}
    return out | {f"{kind}.norm.{what}": (256,) for what in ("weight", "bias")}


def test_names_and_shapes_of_the_release() -> None:
    with torch.device("meta"):
        vae = MotionVae(MotionVaeConfig(), 263)
        net = LatentDenoiser(LatentDiffusionConfig(), 1, 768)
    first = published_u("encoder") | published_u("decoder")
    first |= {f"query_pos_{side}.pe": (500, 1, 256) for side in ("encoder", "decoder")}
    first |= {
        "global_motion_token": (2, 256),
        "skel_embedding.weight": (256, 263),
        "skel_embedding.bias": (256,),
    }
    first |= {"final_layer.weight": (263, 256), "final_layer.bias": (263,)}
    second = published_u("encoder") | {"query_pos.pe": (500, 1, 256)}
    for layer, wide in (
        ("time_embedding.linear_1", 768),
        ("time_embedding.linear_2", 256),
        ("emb_proj.1", 768),
    ):
        second |= {f"{layer}.weight": (256, wide), f"{layer}.bias": (256,)}
    for ours, theirs, count in ((vae, first, 297), (net, second, 125)):
        state = ours.state_dict()
        assert {there: tuple(state[here].shape) for here, there in mld_names(ours).items()} == theirs
        assert len(theirs) == count


def test_a_release_is_read_and_refused_where_it_differs(tmp_path: Path) -> None:
    """Random weights under the published names, with the table that nobody reads."""
    sizes = {**SMALL, "positions": 9}
    theirs = LatentDenoiser(LatentDiffusionConfig(**sizes, time_waves=8), 1, 5)
    state = {there: theirs.state_dict()[here].clone() for here, there in mld_names(theirs).items()}
    save_file(state | {"mem_pos.pe": torch.zeros(9, 1, 16)}, tmp_path / "denoiser.safetensors")
    ours = LatentDenoiser(LatentDiffusionConfig(**sizes, time_waves=8), 1, 5)
    ours.empty.fill_(3.0)
    stage = LatentDiffusionStage()
    stage.release(ours).fill(tmp_path / "denoiser.safetensors", ours)
    for name, value in theirs.named_parameters():
        assert torch.equal(ours.state_dict()[name], value), name
    assert (ours.empty == 3.0).all(), "what stands for no text is the text encoder's"
    wider = LatentDenoiser(LatentDiffusionConfig(**sizes, time_waves=8), 1, 7)
    with pytest.raises(UserError, match=r"tensor 'emb_proj\.1\.weight' is \[16, 5\].*\[16, 7\]"):
        stage.release(wider).fill(tmp_path / "denoiser.safetensors", wider)
    vae = MotionVae(MotionVaeConfig(**SMALL), 5)
    with pytest.raises(UserError, match=r"denoiser\.safetensors: tensor "):
        MotionVaeStage().release(vae).fill(tmp_path / "denoiser.safetensors", vae)


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("tokens", [1, 7])
@torch.no_grad()
def test_padding_and_what_a_clip_does_not_hold_change_nothing(tokens: int) -> None:
    net = MotionVae(MotionVaeConfig(**SMALL, latent_tokens=tokens), 6).eval()
    motion = torch.randn(2, 12, 6)
    mask = length_mask(LENGTH, 12)
    mu, logvar = net.encode(motion, mask)
    assert mu.shape == logvar.shape == (2, tokens, 16)
    made = net.decode(mu, mask)
    for row, count in enumerate(LENGTH.tolist()):
        alone = length_mask(LENGTH[row : row + 1], count)
        torch.testing.assert_close(net.encode(motion[row : row + 1, :count], alone)[0][0], mu[row])
        torch.testing.assert_close(net.decode(mu[row : row + 1], alone)[0], made[row, :count])
        assert (made[row, count:] == 0).all()
    present = torch.tensor([[True] * 4 + [False] * 2, [True] * 6])
    other = motion.clone()
    other[0, :, 4:] = 9.0
    torch.testing.assert_close(
        net.reconstruct(motion, LENGTH, present), net.reconstruct(other, LENGTH, present)
    )


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("name", ["body133", "wholebody313", "h3d263"])
def test_losses_of_the_auto_encoder_by_a_slow_version(name: str) -> None:
    layout, rng = MotionLayout.named(name), np.random.default_rng(0)
    mean, std = rng.normal(size=layout.dim), rng.uniform(0.01, 0.1, layout.dim)
    weights = MotionVaeLossConfig(features=0.7, joints=3.0, kl=0.01)
    net = MotionVae(MotionVaeConfig(**SMALL), layout.dim)
    module = MotionVaeModule(
        net, OptimConfig(), seed=0, max_steps=1, layout=layout, mean=mean, std=std, loss=weights
    ).eval()
    motion = torch.from_numpy(rng.normal(size=(2, 12, layout.dim)))
    present = torch.from_numpy(
        layout.present_columns[[0, 3]]
    )  # the first without hands, where there are some
    found = module.losses({"motion": motion, "length": LENGTH, "present": present})

    def smooth(error: float) -> float:
        return 0.5 * error * error if abs(error) < 1 else abs(error) - 0.5

    mask = length_mask(LENGTH, 12)
    mu, logvar = net.encode(motion.masked_fill(~present[:, None], 0.0), mask)
    rebuilt = net.decode(mu, mask)
    features, joints, kl = [], [], []
    for row, count in enumerate(LENGTH.tolist()):
        own, true = (motions[row, :count].detach().numpy() for motions in (rebuilt, motion))
        held = layout.present_columns[[0, 3][row]]
        features += [smooth(e) for e in (own - true)[:, held].ravel()]
        error = joints_of(own * std + mean, layout) - joints_of(true * std + mean, layout)
        number = 22 if row == 0 else layout.num_joints
        joints += [smooth(e) for e in error[:, :number].ravel()]
        for m, v in zip(mu[row, 0].tolist(), logvar[row, 0].tolist(), strict=True):
            kl.append(0.5 * (np.exp(v) + m * m - 1 - v))
    wanted = {"features": np.mean(features), "joints": np.mean(joints), "kl": np.mean(kl)}
    for key, value in wanted.items():
        # Joints and features are compared in float32, as in training.
        assert found[key].item() == pytest.approx(value, rel=2e-5), key
    total = 0.7 * wanted["features"] + 3.0 * wanted["joints"] + 0.01 * wanted["kl"]
    assert found["loss"].item() == pytest.approx(total, rel=2e-5)


def test_the_time_step_is_embedded_as_published() -> None:
    """Cosines first, 768 wide, of step 37."""
    heard: list[Tensor] = []
    net = LatentDenoiser(LatentDiffusionConfig(**SMALL), 1, 5)
    net.time[0].register_forward_pre_hook(lambda _, given: heard.append(given[0]))
    net(torch.zeros(1, 1, 16), torch.tensor([37]), torch.zeros(1, 5), torch.tensor([True]))
    waves = heard[0][0].tolist()
    assert waves[:3] == pytest.approx([0.76541405, -0.00521183, -0.75870692], abs=1e-5)
    assert waves[384:387] == pytest.approx([-0.64353813, -0.99998642, -0.65143212], abs=1e-5)


def test_a_hidden_text_is_the_empty_one() -> None:
    net = LatentDenoiser(LatentDiffusionConfig(**SMALL), 2, 5).eval()
    net.empty.copy_(torch.randn(5))
    z, step, text = torch.randn(2, 2, 16), torch.tensor([3, 900]), torch.randn(2, 5)
    found = net(z, step, text, torch.tensor([True, False]))
    both = net(z, step, torch.stack([text[0], net.empty]), torch.tensor([True, True]))
    torch.testing.assert_close(found, both)
    assert not torch.allclose(found, net(z, step, text, torch.tensor([True, True])))


@torch.no_grad()
def test_sampling_is_ddim_under_guidance_and_each_motion_its_own() -> None:
    torch.manual_seed(0)
    net = LatentDenoiser(LatentDiffusionConfig(**SMALL), 2, 5).eval()
    text = torch.randn(3, 5)
    found = sample_latents(net, text, seeds=[4, 5, 6], steps=10, guidance=3.0)
    alone = sample_latents(net, text[1:2], seeds=[5], steps=10, guidance=3.0)
    torch.testing.assert_close(found[1:2], alone, rtol=1e-4, atol=1e-4)

    # By hand: 1000 steps of scaled-linear noise, taken at 901, 801, ..., 1; the last ends at that of step 0.
    kept = (1 - np.linspace(0.00085**0.5, 0.012**0.5, 1000) ** 2).cumprod()
    x = torch.randn(2, 16, generator=torch.Generator().manual_seed(5))[None].double()
    for t in range(901, 0, -100):
        both = [
            net(x.float(), torch.tensor([t]), text[1:2], torch.tensor([with_text])).double()
            for with_text in (True, False)
        ]
        noise = both[1] + 3.0 * (both[0] - both[1])
        clean = (x - (1 - kept[t]) ** 0.5 * noise) / kept[t] ** 0.5
        after = kept[t - 100] if t > 100 else kept[0]
        x = after**0.5 * clean + (1 - after) ** 0.5 * noise
    # Errors of single precision grow by the guidance and 1 / sqrt(kept) = 11 at the first step.
    torch.testing.assert_close(alone.double(), x, rtol=1e-3, atol=1e-3)
