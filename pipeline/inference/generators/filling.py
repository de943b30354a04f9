"""A diffusion model fills in what an edit leaves free (`models/diffusion/editing.py`)."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.motion.layout import Part
from motionloom.datasets.schema import UserError
from motionloom.models.diffusion.editing import CaptionSpan, Filling, KnownMotion, Pins
from motionloom.models.diffusion.network import TextDenoiser
from motionloom.models.diffusion.observed import Places, known_columns
from motionloom.models.diffusion.recovery import Recovery
from motionloom.models.diffusion.schedule import Sampler
from motionloom.pipeline.contract.editing import EditRequest, Said
from motionloom.pipeline.store.networks import device_of


def fill_in(
    net: TextDenoiser,
    stats: FeatureStats,
    part: Part,
    request: EditRequest,
    *,
    window: int,
    sampler: Sampler,
    steps: int,
    guidance: float,
) -> list[NDArray[np.float32]]:
    """Motions [T, C] of the part's columns in their own units, one for each seed of the request.

    `window` is the longest motion that the network was trained on.
    """
    if guidance != 1 and net.config.condition_dropout == 0:
        raise UserError(
            "guidance needs a diffusion model trained with condition_dropout > 0; set cfg_scale to 1"
        )
    layout, columns, device = stats.layout, stats.layout.part(part), device_of(net)

    def tensor(values: NDArray[np.generic] | list[object]) -> Tensor:
        made = torch.as_tensor(np.asarray(values), device=device)
        return made.float() if made.dtype == torch.float64 else made

    pieces = torch.from_numpy(request.pieces)
    known = known_columns(pieces[None], layout, columns)[0]
    if known.all():
        return [request.features.copy() for _ in request.seeds]
    motion = stats.normalize(torch.from_numpy(request.features), columns)
    rooted = Recovery.possible(layout, columns)
    recovery = Recovery(layout, columns, stats.mean, stats.std) if rooted else None
    places = pins = None
    if recovery is not None and request.way is not None:
        way = request.way
        places = Places(
            tensor([way.anchor]),
            *(tensor(one[None]) for one in (way.heading, way.place, way.heading_known, way.place_known)),
        )
        if request.pins:
            pins = Pins(
                *(
                    tensor([getattr(pin, name) for pin in request.pins])
                    for name in ("frame", "joint", "position")
                )
            )
    filling = Filling(
        net,
        KnownMotion(motion.to(device), known.to(device), places, pins),
        [_worded(said, net, device) for said in request.words],
        recovery,
        window=window,
        overlap=window // 4,
        guidance=guidance,
        strength=request.strength,
        likeness=request.likeness,
    )
    made = filling(request.seeds, sampler, steps).cpu()
    # What is given is taken from where it came from: normalising there and back rounds.
    own = torch.where(known, torch.from_numpy(request.features), stats.denormalize(made, columns))
    return [np.asarray(one, dtype=np.float32) for one in own.numpy()]


def _worded(said: Said, net: TextDenoiser, device: torch.device) -> CaptionSpan:
    text = said.conditions.get("text")
    share = torch.from_numpy(said.share).float().to(device)
    if text is None or text.pooled is None:
        return CaptionSpan(torch.zeros(net.text_dim, device=device), False, share)
    return CaptionSpan(text.pooled[0].float().to(device), True, share)
