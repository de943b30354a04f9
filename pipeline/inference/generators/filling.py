"""A diffusion model fills in what an edit leaves free (`models/diffusion/editing.py`)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from motionloom.datasets.conditions import Conditions
from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.motion.layout import Part
from motionloom.datasets.schema import UserError
from motionloom.models.diffusion.editing import CaptionSpan, Filling, KnownMotion, Pins
from motionloom.models.diffusion.network import TextDenoiser
from motionloom.models.diffusion.observed import Places, Recovery, known_columns
from motionloom.models.diffusion.schedule import Sampler
from motionloom.pipeline.inference.edits.frames import EditFrames
from motionloom.pipeline.store.networks import device_of


def fill_in(
    net: TextDenoiser,
    stats: FeatureStats,
    part: Part,
    frames: EditFrames,
    words: Sequence[tuple[Conditions, NDArray[np.float64]]],
    seeds: Sequence[int],
    *,
    window: int,
    sampler: Sampler,
    steps: int,
    guidance: float,
) -> list[NDArray[np.float32]]:
    """Motions [T, C] of the part's columns in their own units, one for each seed (`Editor`).

    `window` is the longest motion that the network was trained on.
    """
    if guidance != 1 and net.config.condition_dropout == 0:
        raise UserError(
            "guidance needs a diffusion model trained with condition_dropout > 0; set cfg_scale to 1"
        )
    layout, columns, device = stats.layout, stats.layout.part(part), device_of(net)
    features = torch.from_numpy(frames.features[:, columns])
    known = known_columns(torch.from_numpy(frames.pieces)[None], layout, columns)[0]
    if known.all():
        return [features.numpy().copy() for _ in seeds]
    recovery = places = pins = None
    if Recovery.possible(layout, columns):
        recovery = Recovery(layout, columns, stats.mean, stats.std)
        row = frames.places
        known_places = (row.anchor, row.heading, row.place, row.heading_known, row.place_known)
        places = Places(*(values.to(device) for values in known_places))
        if frames.pins:
            at, joints = torch.tensor(list(frames.pins), device=device).T
            pins = Pins(at, joints, torch.tensor(frames.model_pins, device=device))
    filling = Filling(
        net,
        KnownMotion(stats.normalize(features, columns).to(device), known.to(device), places, pins),
        [_caption_span(*pair, net, device) for pair in words],
        recovery,
        window=window,
        overlap=window // 4,
        guidance=guidance,
        strength=frames.task.strength,
        likeness=frames.task.likeness,
    )
    made = filling(seeds, sampler, steps).cpu()
    # What is kept is taken from where it came from: normalising there and back rounds.
    own = torch.where(known, features, stats.denormalize(made, columns))
    return [np.asarray(one, dtype=np.float32) for one in own.numpy()]


def _caption_span(
    conditions: Conditions, share: NDArray[np.float64], net: TextDenoiser, device: torch.device
) -> CaptionSpan:
    """The sentence embedding of encoded words, and zeros without any."""
    text, of = conditions.get("text"), torch.from_numpy(share).float().to(device)
    if text is None or text.pooled is None:
        return CaptionSpan(torch.zeros(net.text_dim, device=device), False, of)
    return CaptionSpan(text.pooled[0].float().to(device), True, of)
