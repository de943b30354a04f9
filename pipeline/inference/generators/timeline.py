"""Motion tokens along a time line whose conditions may change: windows that go on from one another.

A model of tokens is trained on windows of some frames. A longer stretch, such as a song, is made window by
window: each window begins with the last groups of the one before (`context`), and the music of a
window begins and ends where its groups do, as in training. Where a stretch begins, music from before it is
masked. Noise z is drawn once a motion.

Legend: B rows, G groups of four frames, L positions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from motionloom.datasets.conditions import Condition, Conditions
from motionloom.datasets.modalities.table import MODALITIES
from motionloom.models.gpt.rows import Drawing
from motionloom.models.gpt.tokens import Codes
from motionloom.models.tokenizer.base import GROUP_FRAMES
from motionloom.models.utt.network import ConditionedUtt
from motionloom.models.utt.sampling import draw_z, generate, join
from motionloom.pipeline.contract.generation import Stretch
from motionloom.pipeline.contract.sampling import SamplingConfig


@dataclass(frozen=True)
class TokenTimeline:
    """Makes tokens for stretches of conditions."""

    net: ConditionedUtt
    window_groups: int
    """Groups of a training window."""
    context: int
    """Groups that a window sees of what came before."""
    prepared: Mapping[str, object]
    """Outputs of the stages of the modalities, by name, such as the statistics of music."""
    inject_z: bool
    """Draw z."""

    @torch.no_grad()
    def tokens(self, stretches: Sequence[Stretch], seeds: Sequence[int], sampling: SamplingConfig) -> Codes:
        """Codes of all stretches, one after another; B rows, a seed each."""
        utt = self.net.utt
        count = len(seeds)
        device = next(self.net.parameters()).device
        empty = torch.zeros(count, 0, dtype=torch.int64, device=device)
        made = Codes(dict.fromkeys(utt.names, empty), torch.zeros(count, dtype=torch.int64, device=device))
        z = draw_z(seeds, utt.config.z_dim).to(device) if self.inject_z and utt.config.z_dim else None
        for number, stretch in enumerate(stretches):
            conditions = self.normalised(stretch.conditions)
            if stretch.frames is None:  # it stands alone
                return self.window(conditions, made, z, None, window_seeds(seeds, 0, 0), sampling)
            wanted = torch.tensor([-(-n // GROUP_FRAMES) for n in stretch.frames], device=device)
            made = self._stretch(conditions, made, z, wanted, seeds, number, sampling)
        return made

    def _stretch(
        self,
        conditions: Conditions,
        before: Codes,
        z: Tensor | None,
        wanted: Tensor,
        seeds: Sequence[int],
        number: int,
        sampling: SamplingConfig,
    ) -> Codes:
        """The timeline extended by `wanted` [B] groups."""
        made = before
        done = torch.zeros_like(wanted)
        turn = 0
        while bool((done < wanted).any()):
            rows = torch.nonzero(done < wanted)[:, 0]
            here = _rows(made, rows)
            seen = here.groups.clamp(max=self.context)
            new = torch.minimum(wanted[rows] - done[rows], self.window_groups - seen)
            first = (done[rows] - seen) * GROUP_FRAMES
            frames = (seen + new) * GROUP_FRAMES
            part = {name: _rows_of(condition, rows) for name, condition in conditions.items()}
            part |= {name: cut(part[name], first, frames) for name in part.keys() & set(self.net.mate.timed)}
            own = [seeds[row] for row in rows.tolist()]
            noise = None if z is None else z[rows]
            more = self.window(part, here, noise, new, window_seeds(own, number, turn), sampling)
            made = _with(made, rows, join(here, more, self.net.utt.pattern))
            done[rows] += more.groups
            turn += 1
        return made

    def window(
        self,
        conditions: Conditions,
        before: Codes,
        z: Tensor | None,
        groups: Tensor | None,
        seeds: Sequence[int],
        sampling: SamplingConfig,
    ) -> Codes:
        """New codes that follow `before`."""
        count = len(seeds)
        encoded = self.net.mate(conditions, count)
        present = {name: condition.present.tolist() for name, condition in conditions.items()}
        scales = [sampling.scale({name: rows[row] for name, rows in present.items()}) for row in range(count)]
        guided = any(scale != 1 for scale in scales)
        return generate(
            self.net.utt,
            encoded,
            null=self.net.mate.unconditional(count) if guided else None,
            inject_z=self.inject_z,
            z=z,
            start=before,
            context=self.context,
            max_groups=min(self.window_groups, self.net.utt.max_groups) if groups is None else None,
            groups=groups,
            how=Drawing(sampling.temperature, sampling.top_k or None, sampling.top_p),
            cfg_scale=scales,
            seed=list(seeds),
        )

    def normalised(self, conditions: Conditions) -> dict[str, Condition]:
        """Encoded conditions as training saw them."""
        return {
            name: MODALITIES[name].normalise(self.prepared.get(name), condition)
            for name, condition in conditions.items()
        }


def window_seeds(seeds: Sequence[int], stretch: int, turn: int) -> list[int]:
    """Seeds of one window's draws; those of the first window are the motions' own."""
    if stretch == turn == 0:
        return list(seeds)
    return [
        int(np.random.SeedSequence([seed, stretch, turn]).generate_state(1, np.uint64)[0]) for seed in seeds
    ]


def _rows_of(condition: Condition, rows: Tensor) -> Condition:
    features, mask, pooled = condition
    return Condition(features[rows], mask[rows], None if pooled is None else pooled[rows])


def cut(condition: Condition, first: Tensor, frames: Tensor) -> Condition:
    """Positions first [B] .. first + frames [B] of a timed modality; those outside of it are masked."""
    features, mask, pooled = condition
    order = torch.arange(int(frames.max()), device=first.device)
    at = first[:, None] + order
    inside = (at >= 0) & (at < mask.shape[1]) & (order < frames[:, None])
    index = at.clamp(0, mask.shape[1] - 1)
    cut_mask = mask.gather(1, index) & inside
    cut = features.gather(1, index[..., None].expand(-1, -1, features.shape[2]))
    return Condition(cut.masked_fill(~cut_mask[..., None], 0.0), cut_mask, pooled)


def _rows(codes: Codes, rows: Tensor) -> Codes:
    return Codes({name: values[rows] for name, values in codes.codes.items()}, codes.groups[rows])


def _with(codes: Codes, rows: Tensor, new: Codes) -> Codes:
    """`codes` with some rows replaced, padded to the longest."""
    groups = codes.groups.clone()
    groups[rows] = new.groups
    out = {}
    for name, values in codes.codes.items():
        width = max(values.shape[1], new.codes[name].shape[1])
        whole = torch.nn.functional.pad(values, (0, width - values.shape[1]))
        whole[rows] = torch.nn.functional.pad(new.codes[name], (0, width - new.codes[name].shape[1]))
        out[name] = whole
    return Codes(out, groups)
