"""Which of a run's generators a modality can drive."""

from __future__ import annotations

from collections.abc import Sequence

from motionloom.pipeline.contract.stage import Finished, Shelf
from motionloom.pipeline.inference.bundle import Bundle


def bundle_driven_by(modality: str, stages: Sequence[Finished], shelf: Shelf) -> Bundle | None:
    """The first generator of body motion that is conditioned on `modality`, with the face generators.

    None where there is none.
    """
    bundle = Bundle(stages, shelf)
    faces = [stage for stage in stages if bundle.of(stage).part == "face"]
    for stage in stages:
        maker = bundle.of(stage)
        if maker.part != "face" and modality in maker.modalities:
            # A face generator that is not conditioned on it would have nothing to go by.
            fitting = [face for face in faces if modality in bundle.of(face).modalities]
            return Bundle([stage, *fitting], shelf)
    return None
