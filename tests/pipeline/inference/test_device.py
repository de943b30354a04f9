"""Networks on another device get their inputs there, and give what the CPU gives (`second_device.py`)."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from second_device import second_device

from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.inference.generation import generate
from motionloom.pipeline.inference.request import Request
from motionloom.pipeline.launch.hardware import Hardware, choose_device

CAPTIONS = ["a person waves with the left hand", "a person walks"]


def test_the_second_device_is_strict() -> None:
    with second_device() as device:
        far = torch.ones(3).to(device)
        assert far.device == (far + far).device == device and (far + 1).cpu().tolist() == [2, 2, 2]
        with pytest.raises(RuntimeError, match="expected all tensors on second_device:0"):
            far + torch.ones(3)
        with pytest.raises(RuntimeError):
            far.numpy()
        far[1] = 5
        assert far.tolist() == [1, 5, 1]


@pytest.mark.slow
@pytest.mark.parametrize("face", ["gpt", "vae", "diffusion ddpm", "diffusion ddim", "diffusion dpm++"])
def test_motions_are_made_where_the_networks_lie(face: str, small_run: Any) -> None:
    kind, _, sampler = face.partition(" ")
    fields = {"face_model": kind, "cfg_scale": 1.5, "denoising_steps": 3, "sampler": sampler or "ddpm"}
    asked = Request.of(CAPTIONS, seconds=2.0, seed=3, sampling=fields)
    near = Bundle.open(small_run.folder)
    with second_device() as device:
        far = Bundle.open(small_run.folder, device)
        given = far.stage_cache.given(far.main.inputs)
        assert far.device == given["tma"].device == device
        made = generate(far, asked)
    assert {str(weight.device) for weight in given["text"].encoder._weights.values()} == {str(device)}
    for ours, theirs in zip(made, generate(near, asked), strict=True):
        np.testing.assert_allclose(ours.features, theirs.features, atol=1e-4)
        np.testing.assert_allclose(ours.face, theirs.face, atol=1e-4)


def test_a_choice_of_device(monkeypatch: pytest.MonkeyPatch) -> None:
    assert choose_device("cpu") == choose_device(torch.device("cpu")) == torch.device("cpu")
    for count, accelerator in ((0, "cpu"), (2, "cuda:0")):
        monkeypatch.setattr(torch.cuda, "is_available", lambda count=count: count > 0)
        monkeypatch.setattr(torch.cuda, "device_count", lambda count=count: count)
        assert choose_device("auto") == Hardware().device() == torch.device(accelerator)
        assert Hardware(accelerator="cpu").device() == torch.device("cpu")
        with pytest.raises(UserError, match=r"device 'gpu': .*cuda:N"):
            choose_device("gpu")
    assert choose_device("cuda:1") == torch.device("cuda", 1)
    with pytest.raises(UserError, match="cuda:2"):
        choose_device("cuda:2")
    monkeypatch.setenv("LOCAL_RANK", "1")
    assert Hardware().device() == torch.device("cuda", 1), "each process of a run takes its own GPU"
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    with pytest.raises(UserError, match="device 'cuda'"):
        choose_device("cuda")
    with pytest.raises(UserError, match=r"hardware\.accelerator is gpu"):
        Hardware(accelerator="gpu").device()
