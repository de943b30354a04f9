"""`MotionStream`: motion that is watched while it is made, under captions that may change on the way.

Tokens are drawn group by group and decoded as soon as the groups that a frame's decoding looks at are known
(`models/tokenizer/streaming.py`); the root goes on from chunk to chunk (`JointFlow`). So every
frame is final: it is the one that decoding all tokens at once would give. What is kept is one block of the
networks and the decoder's window, whatever the length of the motion.

A UDE's diffusion decoder denoises all windows of a motion together. A stream has a choice: the tokenizer's
own decoder, which answers at once, or windows that are denoised one after another
(`models/diffusion/dmd_streaming.py`) [ours].
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from motionloom.datasets.motion.features.joints import JointFlow
from motionloom.datasets.schema import UserError
from motionloom.models.layers.seeds import sample_seeds
from motionloom.pipeline.contract.generation import Prompt
from motionloom.pipeline.contract.sampling import SamplingConfig, StreamConfig
from motionloom.pipeline.contract.stage import CompletedStage
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.inference.generators.idle_pose import IdleBlend
from motionloom.pipeline.inference.motion import MotionChunk
from motionloom.pipeline.inference.requests import (
    require_driven,
    require_seed,
    require_words,
    split_columns,
    weight_bytes,
)
from motionloom.pipeline.inference.script import DrivenSegment, Script, segment_frames
from motionloom.pipeline.launch.hardware import threads_for
from motionloom.pipeline.store.known_captions import Unknown

if TYPE_CHECKING:
    from motionloom.datasets.audio.sound import Sound


GUIDANCE = 3.0
"""At 2 `synthetic`'s walk loses a third of its speed in ten minutes, and `dance` at the 1.5 of single clips
comes to a stand."""


class MotionStream(Iterator[MotionChunk]):
    """Chunks of one motion, made as they are asked for.

    `say` may be called at any time, also from another thread; the rest belongs to one thread.

    Args:
        bundle: The model.
        segments: What drives the motion, one after another; taken when its time comes, so it may be endless
            itself. A segment of infinite length goes on until `say`.
        seed: Equal seeds, segments and settings give equal motions.
        sampling: How tokens are drawn.
        config: How much at a time.
        notice: Is given each caption that the model does not know and what is said of a sound that is no
            music, once, when its segment begins.
    """

    def __init__(
        self,
        bundle: Bundle,
        segments: Iterable[DrivenSegment],
        *,
        seed: int,
        sampling: SamplingConfig,
        config: StreamConfig | None = None,
        notice: Callable[[Unknown | str], object] | None = None,
    ) -> None:
        require_seed(seed)
        bundle.require_used(None, sampling)
        if sampling.candidates > 1:
            raise UserError(
                "a stream shows its motion as it is drawn, so there is none to choose: leave candidates out"
            )
        self.layout, self.seed = bundle.layout, seed
        seeds, config = sample_seeds(seed, 2), config or StreamConfig()
        self._segments, self._said = iter(segments), deque[DrivenSegment]()
        sampling = drawing(bundle, sampling)
        self._bundle, self._face_model = bundle, sampling.face_model
        self._notice, self._noticed = notice, set[str]()
        self._weights = weight_bytes(bundle.stages)
        self._body = _Maker(bundle, bundle.main, seeds[0], sampling, config)
        # The face generator that was asked for, or the first that can stream.
        able = (stage for stage in bundle.faces.values() if bundle.of(stage).capabilities.streaming)
        face = next(able, None) if sampling.face_model is None else bundle.choose_face(sampling.face_model)
        self._face = None if face is None else _Maker(bundle, face, seeds[1], sampling, config)
        self._idle = IdleBlend(bundle.layout, self._body.generator.part)
        self._joints = JointFlow(bundle.layout)
        self._least = config.chunk_frames
        self._bounds: deque[tuple[int, Prompt]] = deque()
        """First frames of segments that were begun, and what drives them."""
        self._left: int | None = 0
        """Groups that are left of the segment; None = without an end."""
        self._given = self._number = 0
        """Frames given, segments begun."""
        self._ended = False

    def say(self, caption: str, *, seconds: float | None = None, face: str = "") -> None:
        """Go on with another caption from the next tokens on; what is left of the present one is left out.

        It lasts `seconds`, then the next segment comes; without them, until `say`. Frames that are drawn
        already still come: those that the decoder looks ahead, and of a UDE at most `hop_frames` more.
        """
        require_words([caption])
        length = math.inf if seconds is None else seconds
        segment = DrivenSegment(Prompt(caption, face), length, caption)
        self._check(segment, self._number)
        self._said.append(segment)

    def close(self) -> None:
        """No more tokens are drawn; what is drawn already still comes."""
        self._segments, self._left = iter(()), 0
        self._said.clear()

    def __iter__(self) -> MotionStream:
        return self

    def __next__(self) -> MotionChunk:
        """The next frames; raises `StopIteration` after the last ones."""
        with threads_for(1, self._weights):
            while not self._ended and self._ready() < self._least:
                self._draw()
        count = self._ready()
        if not count:
            raise StopIteration
        while len(self._bounds) > 1 and self._bounds[1][0] <= self._given:
            self._bounds.popleft()
        if len(self._bounds) > 1:
            count = min(count, self._bounds[1][0] - self._given)
        body = self._idle(self._body.take(count), self._bounds[0][1].idle)
        features, with_it = split_columns(body, self._body.generator, self.layout)
        face = with_it if self._face is None else self._face.take(count)
        chunk = MotionChunk(
            self._bounds[0][1], features, self._joints(features), face, self.layout, start=self._given
        )
        self._given += count
        return chunk

    def _ready(self) -> int:
        makers = [self._body, *filter(None, [self._face])]
        return min(maker.ready for maker in makers)

    def _draw(self) -> None:
        """More tokens, of the next segment where this one is over or another one is called for."""
        if self._said or self._left == 0:
            segment = self._said.popleft() if self._said else next(self._segments, None)
            if segment is None:
                self._ended = True
                self._body.finish()
                if self._face is not None:
                    self._face.finish()
                return
            self._begin(segment)
        before = self._body.groups
        self._body.draw(self._left)
        if self._face is not None:
            while self._face.groups < self._body.groups:
                self._face.draw(self._body.groups - self._face.groups)
        if self._left is not None:
            self._left -= self._body.groups - before

    def _begin(self, segment: DrivenSegment) -> None:
        frames = self._check(segment, self._number)
        unit = self._body.generator.unit_frames
        self._left = None if frames is None else frames // unit
        self._number += 1
        self._bounds.append((self._body.groups * unit, segment.prompt))
        # Each unknown caption and each sound without a beat is told once.
        prompt = segment.prompt
        for note in () if self._notice is None else self._bundle.notes([prompt], (), self._face_model):
            key = note.caption if isinstance(note, Unknown) else note
            if key not in self._noticed and self._notice is not None:
                self._noticed.add(key)
                self._notice(note)
        self._body.condition(segment.prompt, segment.prompt.text)
        if self._face is not None:
            self._face.condition(segment.prompt, segment.prompt.words)

    def _check(self, segment: DrivenSegment, number: int) -> int | None:
        require_driven(self._body.generator, [segment.prompt])
        if segment.seconds == math.inf:
            return None
        if not segment.seconds > 0:
            raise UserError(f"segments.{number} lasts {segment.seconds:g} s; give a length above 0")
        return segment_frames(self._body.generator, segment, number)


def drawing(bundle: Bundle, asked: SamplingConfig) -> SamplingConfig:
    """How a stream draws: as the model recommends, but one that is guided at least by `GUIDANCE` [ours]."""
    out = bundle.drawing(asked)
    if 1 < out.cfg_scale < GUIDANCE and "cfg_scale" not in asked.model_fields_set:
        return out.model_copy(update={"cfg_scale": GUIDANCE})
    return out


class _Maker:
    """One generator's side of a stream: its conditions, its tokens, its frames."""

    def __init__(
        self, bundle: Bundle, stage: CompletedStage, seed: int, sampling: SamplingConfig, config: StreamConfig
    ) -> None:
        generator = bundle.of(stage)
        streaming = generator.capabilities.streaming
        if streaming is None:
            raise UserError(
                f"this model ({generator.method}) makes a motion as a whole; streams need a GPT or a UDE"
            )
        self.generator = generator
        self._stream, self._per_group = next(iter(streaming.group_tokens.items()))
        self._bundle, self._stage = bundle, stage
        self._flow = streaming.tokens(seed, sampling, config)
        self._decoder, self._units = streaming.frames(seed, sampling, config)
        self._frames: NDArray[np.float32] = np.zeros(
            (0, len(generator.layout.part(generator.part))), np.float32
        )
        self.groups = 0
        """Groups drawn."""

    @property
    def ready(self) -> int:
        """Frames that are final and not taken."""
        return len(self._frames)

    def condition(self, prompt: Prompt, words: str) -> None:
        self._flow.condition(self._bundle.encode(self._stage, [prompt], [words]))

    def draw(self, left: int | None) -> None:
        codes = self._flow.draw(left)
        self.groups += codes[self._stream].shape[1] // self._per_group
        self._add(self._decoder.push(codes))

    def finish(self) -> None:
        self._add(self._decoder.finish())

    def take(self, count: int) -> NDArray[np.float32]:
        out, self._frames = self._frames[:count], self._frames[count:].copy()
        return out

    def _add(self, made: Tensor | None) -> None:
        if made is not None:
            self._frames = np.concatenate([self._frames, np.asarray(self._units(made), np.float32)])


def segments_of(
    bundle: Bundle,
    caption: str | Script | None,
    *,
    face: str = "",
    sound: Sound | None = None,
    seconds: float | None = None,
) -> list[DrivenSegment]:
    """The segments that drive the motion of `MotionModel.stream`'s arguments, one after another."""
    if isinstance(caption, Script):
        if face or sound is not None or seconds is not None:
            raise UserError("a script says everything: leave face, sound and seconds out")
        segments = caption.open()
    else:
        if seconds is not None and not 0 < seconds < math.inf:
            raise UserError(f"{seconds:g} s: give a length above 0, or none for a stream without an end")
        if caption is not None or sound is None:
            require_words([caption or ""])
        if face and bundle.choose_face(None) is None:
            raise UserError("this model makes no face: leave the face caption out")
        prompt = Prompt(caption or "", face, sound)
        longest = math.inf if sound is None else sound.seconds
        length = longest if seconds is None else min(seconds, longest)
        segments = [DrivenSegment(prompt, length, prompt.text or "music")]
    require_driven(bundle.generator, [segment.prompt for segment in segments])
    return segments
