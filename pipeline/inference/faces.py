"""The three facial motion generators of HumanTOMATO (section 3.4, B.4, B.5) behind one interface.

The paper's own, a GPT over residual codes, and its two baselines: a text-conditioned VAE and a diffusion
model. Each makes an expression [T, 50] for a text and a given number of frames, so whichever is used shares
the body's time line.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import UserError
from motionloom.datasets.text.encoder import EncodedText
from motionloom.models.diffusion.network import DiffusionConfig, MotionDiffusion
from motionloom.models.diffusion.sampling import sample_motions
from motionloom.models.gpt.network import InterleavedGPT
from motionloom.models.gpt.sampling import generate
from motionloom.models.tokenizer.base import GROUP_FRAMES, Tokenizer
from motionloom.pipeline.inference.sampling import SamplingConfig
from motionloom.pipeline.store.networks import CPU, LoadedTma, device_of, freeze, load_gpt, load_tokenizer
from motionloom.pipeline.store.weights import load_facts, load_weights

FaceKind = Literal["gpt", "vae", "diffusion"]


@dataclass(frozen=True)
class FaceRequest:
    """What a generator is asked for: one expression for each text."""

    text: EncodedText
    prior: torch.Tensor | None
    """TMA's embedding of the texts [n, E], where there is one."""
    frames: Sequence[int]
    """Length of each expression, the body's."""
    seeds: Sequence[int]
    """One for each expression."""
    sampling: SamplingConfig


class FaceGenerator(Protocol):
    """Text to normalised expression, on the generator's device."""

    def make(self, request: FaceRequest) -> list[torch.Tensor]:
        """Normalised expressions [T, 50], in the order of the texts."""


@dataclass(frozen=True)
class GptFace:
    """Residual codes, level i before level ii, from a GPT (B.4)."""

    tokenizer: Tokenizer
    gpt: InterleavedGPT
    prior: str

    @torch.no_grad()
    def make(self, request: FaceRequest) -> list[torch.Tensor]:
        """See `FaceGenerator`; lengths are whole groups of four frames."""
        sampling = request.sampling
        given = torch.as_tensor(request.text.sentence) if self.prior == "sentence" else request.prior
        if given is None:
            raise UserError("this face GPT needs the TMA text encoder, and no tma part is here")
        groups = torch.tensor([-(-count // GROUP_FRAMES) for count in request.frames])
        codes = generate(
            self.gpt, given.to(device_of(self.gpt)), groups=groups, temperature=sampling.temperature,
            top_k=sampling.top_k or None, top_p=sampling.top_p, cfg_scale=sampling.face_guidance,
            seed=list(request.seeds),
        ).codes  # fmt: skip
        out = []
        for row, count in enumerate(request.frames):
            single = {
                s.name: codes[s.name][row : row + 1, : int(groups[row]) * s.per_group]
                for s in self.tokenizer.streams
            }
            out.append(self.tokenizer.decode(single)[0, :count])
        return out


@dataclass(frozen=True)
class VaeFace:
    """One latent of the text, decoded to all frames at once (B.5.1)."""

    net: LoadedTma

    @torch.no_grad()
    def make(self, request: FaceRequest) -> list[torch.Tensor]:
        """See `FaceGenerator`. The latent is drawn from the text's Gaussian; temperature scales its width."""
        frames, seeds, device = request.frames, request.seeds, self.net.device
        tokens, mask = torch.as_tensor(request.text.tokens), torch.as_tensor(request.text.mask)
        mu, logvar = self.net.net.encode_text(tokens.to(device), mask.to(device))
        noise = torch.stack(
            [torch.randn(mu.shape[1], generator=torch.Generator().manual_seed(seed)) for seed in seeds]
        )
        z = mu + request.sampling.temperature * (0.5 * logvar).exp() * noise.to(device)
        made = self.net.net.decode(z, torch.tensor(frames).to(device), max(frames))
        return [made[row, :count] for row, count in enumerate(frames)]


@dataclass(frozen=True)
class DiffusionFace:
    """Denoising from a sentence embedding (B.5.2)."""

    net: MotionDiffusion

    def make(self, request: FaceRequest) -> list[torch.Tensor]:
        """See `FaceGenerator`."""
        sampling = request.sampling
        text = torch.as_tensor(request.text.sentence).to(device_of(self.net))
        return sample_motions(
            self.net, text, request.frames, seeds=request.seeds,
            sampler=sampling.sampler, steps=sampling.denoising_steps, guidance=sampling.face_guidance,
        )  # fmt: skip


def load_faces(parts: dict[str, Path], device: torch.device = CPU) -> dict[FaceKind, FaceGenerator]:
    """The generators whose stages are finished; the paper's first."""
    out: dict[FaceKind, FaceGenerator] = {}
    if "face_gpt" in parts and "face_tokenizer" in parts:
        tokenizer = load_tokenizer(parts["face_tokenizer"], device)
        out["gpt"] = GptFace(tokenizer, *load_gpt(parts["face_gpt"], tokenizer))
    if "face_vae" in parts:
        out["vae"] = VaeFace(LoadedTma.load(parts["face_vae"], device))
    if "face_diffusion" in parts:
        out["diffusion"] = DiffusionFace(load_diffusion(parts["face_diffusion"], device))
    return out


def choose(faces: dict[FaceKind, FaceGenerator], wanted: FaceKind | None) -> FaceGenerator | None:
    """The generator asked for, else the first one there; None without any."""
    if wanted is None:
        return next(iter(faces.values()), None)
    if wanted not in faces:
        raise UserError(
            f"no face generator '{wanted}' here; there is {', '.join(faces) or 'none'}: "
            f"train its stage or choose another"
        )
    return faces[wanted]


def load_diffusion(folder: Path, device: torch.device = CPU) -> MotionDiffusion:
    """A trained denoiser."""
    facts = load_facts(folder)
    config = DiffusionConfig.parse(facts.config, str(folder))
    dims = (facts.fact(folder, key, int) for key in ("motion_dim", "text_dim"))
    net = MotionDiffusion(config, *dims)
    load_weights(folder, net)
    freeze(net.to(device))
    return net


def expression(made: torch.Tensor, layout: MotionLayout, stats: FeatureStats) -> NDArray[np.float32]:
    """Expression in its own units [T, 50] of a normalised one."""
    columns = layout.part("face")
    return np.asarray(made.cpu().numpy() * stats.std[columns] + stats.mean[columns], dtype=np.float32)
