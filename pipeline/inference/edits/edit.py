"""A clip edited by the generators of a model."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.conditions import Conditions
from motionloom.datasets.schema import UserError
from motionloom.models.gpt.drawing import sample_seeds
from motionloom.pipeline.contract.editing import EditingGenerator, EditRequest, Said
from motionloom.pipeline.contract.generation import MotionGenerator
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.inference.edits.frames import EditFrames
from motionloom.pipeline.inference.edits.result import Edit, finish

Encoded = Callable[[str], Conditions]
"""Words, encoded for a generator as one row."""


def require_editor(generator: MotionGenerator) -> EditingGenerator:
    """The generator, if it can fill in what a clip leaves free."""
    if isinstance(generator, EditingGenerator):
        return generator
    raise UserError(
        f"this model ({generator.method}) makes whole motions and edits none; take one whose body is made by "
        f"diffusion, such as the package's `inbetween`"
    )


def edited(
    asked: EditFrames,
    body: MotionGenerator,
    encode: Encoded,
    face: tuple[MotionGenerator, Encoded] | None,
    *,
    samples: int,
    seed: int,
    sampling: SamplingConfig,
) -> list[Edit]:
    """`samples` results of a task; `face` is what makes the face, where the body's generator does not."""
    seeds = sample_seeds(seed, 2 * samples)
    generator = require_editor(body)
    words = [Said(encode(text) if text.strip() else {}, share) for text, share in asked.shares()]
    request = EditRequest(
        features=asked.features[:, asked.layout.part(generator.part)],
        pieces=asked.pieces,
        words=words,
        seeds=seeds[:samples],
        way=asked.way,
        pins=asked.model_pins(),
        strength=asked.task.strength,
        likeness=asked.task.likeness,
        sampling=sampling,
    )
    made = generator.edit(request)
    whole = np.zeros((len(made), asked.frames, asked.layout.dim), dtype=np.float32)
    whole[..., asked.layout.part(generator.part)] = np.stack(made)
    faces: Sequence[NDArray[np.float32] | None] = [None] * samples
    if asked.layout.has("face"):
        columns = asked.layout.part("face")
        if generator.part == "all":
            faces = list(whole[..., columns])
        elif face is not None and isinstance(face[0], EditingGenerator):
            said = asked.task.face or asked.task.caption
            shares = np.ones(asked.frames)
            faces = face[0].edit(
                replace(
                    request,
                    features=asked.features[:, columns],
                    words=[Said(face[1](said) if said.strip() else {}, shares)],
                    seeds=seeds[samples:],
                    way=None,
                    pins=(),
                )
            )
        elif asked.face is not None:
            faces = [asked.features[:, columns]] * samples
    columns = asked.layout.part("bodyhand")
    return [finish(asked, one[:, columns], own) for one, own in zip(whole, faces, strict=True)]
