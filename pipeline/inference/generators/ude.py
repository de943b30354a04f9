"""The UDE engine: tokens of text, music or both in turn, decoded to one motion (UDE section 3.5, 4.4)."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor

from motionloom.models.diffusion.dmd import Dmd
from motionloom.models.diffusion.sampling import decode_motions
from motionloom.models.diffusion.schedule import Sampler
from motionloom.models.gpt.tokens import Codes
from motionloom.models.tokenizer.base import GROUP_FRAMES
from motionloom.models.utt.network import ConditionedUtt
from motionloom.pipeline.contract.generation import Capabilities, GenerationRequest, Stretch
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.stage import StageConfig
from motionloom.pipeline.inference.generators.base import OfTokens
from motionloom.pipeline.inference.generators.timeline import TokenTimeline
from motionloom.pipeline.store.networks import LoadedWindowed


class UdeConfig(StageConfig):
    """How tokens are carried on and decoded."""

    inject_z: bool = True
    """Draw z; without it a model trained with z is conditioned on its inputs alone (Tables 3 and 5)."""
    context_frames: int = Field(40, ge=0, multiple_of=4)
    """Frames of motion that a new stretch, or the next window of a long one, sees of what came before."""
    sampler: Sampler = "dpm++"
    """Sampler of the diffusion decoder, unless a request sets another."""
    denoising_steps: int = Field(20, ge=1)
    overlap_frames: int = Field(32, ge=0, multiple_of=4)
    """Frames that neighbouring windows of the diffusion decoder share."""
    bridge_frames: int = Field(0, ge=0, multiple_of=4)
    """Frames around a change of conditions whose tokens the diffusion decoder is not shown: it bridges them
    [ours]. It must be trained for that (`net.hide` of its stage); 0 decodes every token."""


@dataclass
class LastTokens:
    """The tokens that were drawn last, and what tells apart what they were drawn from."""

    key: str = ""
    codes: Codes | None = None


@dataclass(frozen=True)
class UdeGenerator(OfTokens):
    """Motion of text, music or both, of any length."""

    utt: LoadedWindowed[ConditionedUtt]
    dmd: LoadedWindowed[Dmd] | None
    config: UdeConfig
    last: LastTokens = field(default_factory=LastTokens, compare=False, repr=False)
    method = "ude"

    @property
    def given(self) -> Mapping[str, Any]:  # type: ignore[override]
        return self.utt.given

    @property
    def modalities(self) -> frozenset[str]:
        return frozenset(self.utt.net.mate.widths)

    @property
    def settings(self) -> frozenset[str]:
        more = {"sampler", "denoising_steps"} if self.dmd is not None else set()
        return frozenset({"temperature", "top_k", "top_p", "cfg_scale", "guidance"} | more)

    @property
    def capabilities(self) -> Capabilities:
        return Capabilities(drive=self.drive, denoising=None if self.dmd is None else self.denoising)

    @cached_property
    def timeline(self) -> TokenTimeline:
        return TokenTimeline(
            self.utt.net,
            window_groups=self.utt.window // GROUP_FRAMES,
            context=self.config.context_frames // GROUP_FRAMES,
            prepared=self.prepared,
            inject_z=self.config.inject_z,
        )

    def generate(self, request: GenerationRequest) -> list[NDArray[np.float32]]:
        stretches = [Stretch(request.conditions, request.frames)]
        if request.noise_seeds is None:
            return self.drive(stretches, request.seeds, request.sampling)
        # Decoded many times in a row: the tokens are drawn once.
        key = _digest(request)
        if self.last.key != key or self.last.codes is None:
            self.last.codes = self.timeline.tokens(stretches, request.seeds, request.sampling)
            self.last.key = key
        return self._decoded(self.last.codes, stretches, request.noise_seeds, request.sampling)

    def drive(
        self, stretches: Sequence[Stretch], seeds: Sequence[int], sampling: SamplingConfig
    ) -> list[NDArray[np.float32]]:
        """Tokens that go on from stretch to stretch, then all of them decoded at once."""
        codes = self.timeline.tokens(stretches, seeds, sampling)
        return self._decoded(codes, stretches, seeds, sampling)

    def _decoded(
        self, codes: Codes, stretches: Sequence[Stretch], noise: Sequence[int], sampling: SamplingConfig
    ) -> list[NDArray[np.float32]]:
        given = [stretch.frames for stretch in stretches if stretch.frames is not None]
        if len(given) < len(stretches):
            return self.decode(codes, noise, sampling)
        lengths = torch.tensor([list(frames) for frames in given], device=codes.groups.device)
        hidden = None
        if self.config.bridge_frames and len(stretches) > 1:
            groups = (lengths + GROUP_FRAMES - 1) // GROUP_FRAMES
            hidden = bridged(groups, self.config.bridge_frames // GROUP_FRAMES)
        motions = self.decode(codes, noise, sampling, hidden)
        totals = lengths.sum(0).tolist()
        return [motion[:count] for motion, count in zip(motions, totals, strict=True)]

    def denoising(self, sampling: SamplingConfig) -> tuple[Sampler, int]:
        return (
            sampling.sampler or self.config.sampler,
            sampling.denoising_steps or self.config.denoising_steps,
        )

    def decode(
        self, codes: Codes, seeds: Sequence[int], sampling: SamplingConfig, hidden: Tensor | None = None
    ) -> list[NDArray[np.float32]]:
        """Features in their own units, [T, C] a row; `hidden` as `decode_motions` takes it."""
        if self.dmd is None:
            return self.decoded(codes, None)
        sampler, steps = self.denoising(sampling)
        made = decode_motions(
            self.dmd.net,
            codes,
            seeds=seeds,
            sampler=sampler,
            steps=steps,
            window=self.dmd.window,
            overlap=min(self.config.overlap_frames, self.dmd.window - GROUP_FRAMES),
            hidden=hidden,
        )
        return [self.tokenizer.of_coordinates(motion) for motion in made]


def bridged(groups: Tensor, count: int) -> Tensor:
    """Which groups of motions lie in the `count` around a border, bool [B, G].

    Args:
        groups: int64 [N, B], groups of each of N stretches. Never more than half of a stretch is bridged.
        count: Half of them before the border, the others after it.
    """
    ends = groups.cumsum(0)
    at = torch.arange(int(ends[-1].max()), device=groups.device)
    hidden = torch.zeros(groups.shape[1], len(at), dtype=torch.bool, device=groups.device)
    for number, end in enumerate(ends[:-1]):
        before = (groups[number] // 2).clamp(max=count // 2)
        after = (groups[number + 1] // 2).clamp(max=count - count // 2)
        hidden |= (at >= (end - before)[:, None]) & (at < (end + after)[:, None])
    return hidden


def _digest(request: GenerationRequest) -> str:
    """Tells apart what tokens are drawn from."""
    found = hashlib.sha256(repr((request.frames, request.seeds, request.sampling)).encode())
    for name, condition in sorted(request.conditions.items()):
        found.update(name.encode())
        for part in condition:
            found.update(b"" if part is None else repr(part.shape).encode() + part.cpu().numpy().tobytes())
    return found.hexdigest()
