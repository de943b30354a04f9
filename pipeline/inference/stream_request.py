"""What a user asks of a stream, checked and made one list of segments."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.generation import Prompt
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.streaming import StreamConfig
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.inference.requests import require_driven, require_used, sampling_of
from motionloom.pipeline.inference.script import DrivenSegment, Script
from motionloom.pipeline.inference.streaming import MotionStream
from motionloom.pipeline.store.known_captions import Unknown

if TYPE_CHECKING:
    from motionloom.datasets.audio.sound import Sound

Captions = str | Iterable[str | tuple[str, float]] | Script | None


def stream_of(
    bundle: Bundle,
    captions: Captions,
    *,
    face: str = "",
    sound: Sound | None = None,
    seconds: float | None = None,
    seed: int = 0,
    sampling: SamplingConfig | Mapping[str, Any] | None = None,
    streaming: StreamConfig | Mapping[str, Any] | None = None,
    notice: Callable[[Unknown], object] | None = None,
) -> MotionStream:
    """A stream of `MotionModel.stream`'s arguments; `notice` is given captions that are unknown."""
    drawing = sampling_of(sampling)
    require_used(bundle, [face] if face else None, drawing)
    if drawing.candidates > 1:
        raise UserError(
            "a stream shows its motion as it is drawn, so there is none to choose: leave candidates "
            "(--candidates) out"
        )
    segments = segments_of(bundle, captions, face=face, sound=sound, seconds=seconds)
    config = StreamConfig.parse({} if streaming is None else streaming, "streaming")
    return MotionStream(bundle, segments, seed=seed, sampling=drawing, config=config, notice=notice)


def segments_of(
    bundle: Bundle,
    captions: Captions,
    *,
    face: str = "",
    sound: Sound | None = None,
    seconds: float | None = None,
) -> Iterator[DrivenSegment]:
    """What drives the motion, one segment after another."""
    if seconds is not None and not 0 < seconds < math.inf:
        raise UserError(f"{seconds:g} s: give a length above 0, or none for a stream without an end")
    if isinstance(captions, Script):
        if face or sound is not None or seconds is not None:
            raise UserError("a script says everything: leave face, sound and seconds out")
        opened = captions.open(Path())
        require_driven(bundle.generator, [segment.prompt for segment in opened])
        return iter(opened)
    if captions is None or isinstance(captions, str):
        prompt = Prompt(captions or "", face, sound)
        if captions is not None or sound is None:
            _require_text(captions or "", 0)
        require_driven(bundle.generator, [prompt])
        longest = math.inf if sound is None else sound.seconds
        length = longest if seconds is None else min(seconds, longest)
        return iter([DrivenSegment(prompt, length, prompt.text or "music")])
    if face or sound is not None:
        raise UserError("face and sound go with one caption; of several give a Script")
    return _several(captions, seconds)


def _several(captions: Iterable[str | tuple[str, float]], seconds: float | None) -> Iterator[DrivenSegment]:
    for number, given in enumerate(captions):
        text, length = (given, seconds) if isinstance(given, str) else given
        _require_text(text, number)
        if length is None:
            raise UserError(
                f"captions[{number}] ('{text}') says not how long it lasts; give (caption, seconds), or "
                f"seconds for all"
            )
        yield DrivenSegment(Prompt(text), float(length), text)


def _require_text(text: str, number: int) -> None:
    if not isinstance(text, str) or not text.strip():
        raise UserError(f"captions[{number}] is empty; say what the person does")
