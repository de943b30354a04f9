"""The UDE engine: tokens of text, music or both in turn, decoded to one motion (UDE section 3.5, 4.4).

Nothing is trained here: a `utt` stage makes tokens, a `dmd` stage decodes them, or the tokenizer's own
decoder where the recipe has none (Table 5).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor

from motionloom.datasets.motion.layout import MotionLayout, Part
from motionloom.datasets.schema import UserError
from motionloom.models.diffusion.dmd_sampling import decode_motions
from motionloom.models.diffusion.dmd_streaming import DmdStream
from motionloom.models.diffusion.schedule import Sampler
from motionloom.models.gpt.tokens import Codes
from motionloom.models.tokenizer.base import GROUP_FRAMES
from motionloom.pipeline.contract.generation import GenerationRequest, MotionGenerator, Stretch
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.stage import (
    GENERATOR,
    Finished,
    Given,
    Stage,
    StageConfig,
    StageContext,
    StageKind,
)
from motionloom.pipeline.contract.streaming import FrameFlow, StreamConfig, TokenFlow
from motionloom.pipeline.inference.decoding import Frames
from motionloom.pipeline.inference.timeline import TokenTimeline
from motionloom.pipeline.inference.timeline_flow import TimelineFlow
from motionloom.pipeline.stages.dmd import LoadedDmd
from motionloom.pipeline.stages.utt import LoadedUtt
from motionloom.pipeline.store.files import write_json
from motionloom.pipeline.store.networks import TrainedTokenizer
from motionloom.pipeline.store.text import TextSource


class UdeConfig(StageConfig):
    """How tokens are carried on and decoded."""

    inject_z: bool = True
    """Draw z; without it a model trained with z is conditioned on its inputs alone (Tables 3 and 5)."""
    context_frames: int = Field(40, ge=0, multiple_of=4)
    """Frames of motion that a new stretch, or the next window of a long one, sees of what came before."""
    sampler: Sampler = "dpm++"
    """Of the diffusion decoder, unless a request says otherwise."""
    denoising_steps: int = Field(20, ge=1)
    overlap_frames: int = Field(32, ge=0, multiple_of=4)
    """Frames that neighbouring windows of the diffusion decoder share."""
    bridge_frames: int = Field(0, ge=0, multiple_of=4)
    """Frames around a change of conditions whose tokens the diffusion decoder is not shown: it bridges them
    [ours]. It must be trained for that (`net.hide` of its stage); 0 decodes every token."""


class UdeStage(StageKind):
    """A token model and a decoder as one generator."""

    name = "ude"
    summary = "text, music or both in turn to motion"
    config = UdeConfig
    takes = ("utt", "dmd?")

    def gives(self, config: Any) -> frozenset[str]:
        """Motion."""
        return frozenset({GENERATOR})

    def check(self, stage: Stage, others: Mapping[str, Stage]) -> None:
        """Both halves must speak of the same tokens, and the context must leave room in a window."""
        utt, dmd = others.get(stage.inputs.get("utt", "")), others.get(stage.inputs.get("dmd", ""))
        if utt is None:
            return
        if dmd is not None and utt.inputs.get("tokenizer") != dmd.inputs.get("tokenizer"):
            raise UserError(
                f"stage '{stage.name}': '{utt.name}' makes tokens of '{utt.inputs.get('tokenizer')}' and "
                f"'{dmd.name}' decodes those of '{dmd.inputs.get('tokenizer')}'; name one tokenizer for both"
            )
        if stage.config.bridge_frames and not (dmd and dmd.config.net.hide):
            raise UserError(
                f"stage '{stage.name}': bridge_frames {stage.config.bridge_frames} need a diffusion decoder "
                f"that is trained to fill in; give its stage net: {{hide: 0.5}}, or set bridge_frames to 0"
            )
        window = getattr(utt.config, "max_frames", None)
        if window is not None and stage.config.context_frames >= window:
            raise UserError(
                f"stage '{stage.name}': context_frames {stage.config.context_frames} fill the window of "
                f"{window} frames that '{utt.name}' is trained on; lower them"
            )

    def run(self, context: StageContext) -> None:
        """Write the settings down; there is nothing to train."""
        write_json(context.folder / "ude.json", context.config.dump())

    def generator(self, stage: Finished, given: Given, device: torch.device) -> MotionGenerator:
        """The engine."""
        return UdeGenerator(given["utt"], given.get("dmd"), stage.config)

    def exported(self, config: Any) -> tuple[str, ...]:
        """Both halves."""
        return ("utt", "dmd")

    def export(self, stage: Finished, target: Path) -> None:
        """Its settings are in the list of stages."""
        target.mkdir(parents=True, exist_ok=True)


@dataclass(frozen=True)
class UdeGenerator:
    """Motion of text, music or both, of any length."""

    utt: LoadedUtt
    dmd: LoadedDmd | None
    config: UdeConfig
    method = "ude"
    max_frames = None

    @property
    def tokenizer(self) -> TrainedTokenizer:
        """Whose tokens these are."""
        tokenizer: TrainedTokenizer = self.utt.given["tokenizer"]
        return tokenizer

    @property
    def layout(self) -> MotionLayout:
        """Layout of whole frames."""
        return self.tokenizer.layout

    @property
    def part(self) -> Part:
        """The columns that the tokenizer models."""
        return self.tokenizer.net.part

    @property
    def text(self) -> TextSource | None:
        """What encodes its words."""
        return self.utt.given.get("text")

    @property
    def modalities(self) -> frozenset[str]:
        """What the token model was trained on."""
        return self.utt.modalities

    @property
    def settings(self) -> frozenset[str]:
        """How tokens are drawn and decoded."""
        more = {"sampler", "denoising_steps"} if self.dmd is not None else set()
        more |= {"music_cfg_scale"} if "audio" in self.modalities else set()
        return frozenset({"temperature", "top_k", "top_p", "cfg_scale"} | more)

    @property
    def unit_frames(self) -> int:
        """A group of tokens."""
        return GROUP_FRAMES

    @cached_property
    def timeline(self) -> TokenTimeline:
        """What makes tokens window by window."""
        return TokenTimeline(
            self.utt.net,
            window=self.utt.max_frames // GROUP_FRAMES,
            context=self.config.context_frames // GROUP_FRAMES,
            audio=self.utt.given.get("audio"),
            inject_z=self.config.inject_z,
        )

    def generate(self, request: GenerationRequest) -> list[NDArray[np.float32]]:
        """One stretch."""
        stretch = Stretch(request.conditions, request.frames)
        return self.drive([stretch], request.seeds, request.sampling)

    def drive(
        self, stretches: Sequence[Stretch], seeds: Sequence[int], sampling: SamplingConfig
    ) -> list[NDArray[np.float32]]:
        """Tokens that go on from stretch to stretch, then all of them decoded at once."""
        codes = self.timeline.tokens(stretches, seeds, sampling)
        given = [stretch.frames for stretch in stretches if stretch.frames is not None]
        if len(given) < len(stretches):
            return self.decode(codes, seeds, sampling)
        lengths = torch.tensor([list(frames) for frames in given], device=codes.groups.device)
        hidden = None
        if self.config.bridge_frames and len(stretches) > 1:
            groups = (lengths + GROUP_FRAMES - 1) // GROUP_FRAMES
            hidden = bridged(groups, self.config.bridge_frames // GROUP_FRAMES)
        motions = self.decode(codes, seeds, sampling, hidden)
        totals = lengths.sum(0).tolist()
        return [motion[:count] for motion, count in zip(motions, totals, strict=True)]

    def flow(self, seed: int, sampling: SamplingConfig, streaming: StreamConfig) -> TokenFlow:
        """Tokens as they come, those of `drive` where the lengths of all stretches are known."""
        return TimelineFlow(self.timeline, seed, sampling, hop=max(1, streaming.hop_frames // GROUP_FRAMES))

    def decoding(self, seed: int, sampling: SamplingConfig, streaming: StreamConfig) -> FrameFlow:
        """The tokenizer's own decoder, or windows of the diffusion decoder."""
        if self.dmd is None and streaming.decoder == "diffusion":
            raise UserError("this model has no diffusion decoder; leave streaming's decoder out")
        if self.dmd is None or streaming.decoder == "tokenizer":
            return Frames.of_tokenizer(self.tokenizer, streaming)
        sampler, steps = self._denoising(sampling)
        decoder = DmdStream(
            self.dmd.net,
            {stream.name: stream.per_group for stream in self.tokenizer.net.streams},
            seed=seed,
            sampler=sampler,
            steps=steps,
            window=self.dmd.window,
            overlap=self.config.overlap_frames,
        )
        return Frames(decoder, self.tokenizer.of_coordinates)

    def _denoising(self, sampling: SamplingConfig) -> tuple[Sampler, int]:
        """Sampler and steps, as asked for or else the stage's."""
        asked = sampling.model_fields_set
        return (
            sampling.sampler if "sampler" in asked else self.config.sampler,
            sampling.denoising_steps if "denoising_steps" in asked else self.config.denoising_steps,
        )

    def decode(
        self, codes: Codes, seeds: Sequence[int], sampling: SamplingConfig, hidden: Tensor | None = None
    ) -> list[NDArray[np.float32]]:
        """Features in their own units, [T, C] a row; `hidden` as `decode_motions` takes it."""
        if self.dmd is None:
            return self.tokenizer.decode(codes.codes, codes.groups.tolist())
        sampler, steps = self._denoising(sampling)
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
        count: Half of them before the border, the others behind it.
    """
    ends = groups.cumsum(0)
    at = torch.arange(int(ends[-1].max()), device=groups.device)
    hidden = torch.zeros(groups.shape[1], len(at), dtype=torch.bool, device=groups.device)
    for number, end in enumerate(ends[:-1]):
        before = (groups[number] // 2).clamp(max=count // 2)
        behind = (groups[number + 1] // 2).clamp(max=count - count // 2)
        hidden |= (at >= (end - before)[:, None]) & (at < (end + behind)[:, None])
    return hidden
