"""Motion tokens along a time line whose conditions may change: windows that go on from one another.

A model of tokens is trained on windows of some frames. A longer stretch, such as a song, is made window by
window: the last groups of what is there already stand before the new ones (`context`), and the music of a
window begins and ends where its groups do, as in training. Where a stretch begins, music from before it is
masked. Noise z is drawn once a motion.

Legend: B rows, G groups of four frames, L positions.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from motionloom.datasets.conditions import MODALITIES, Condition, Conditions
from motionloom.datasets.loading.audio_statistics import AudioStats
from motionloom.datasets.schema import UserError
from motionloom.models.gpt.tokens import Codes
from motionloom.models.tokenizer.base import GROUP_FRAMES
from motionloom.models.utt.conditioned import ConditionedUtt
from motionloom.models.utt.continuing import join
from motionloom.models.utt.sampling import draw_z, generate
from motionloom.pipeline.contract.generation import Stretch
from motionloom.pipeline.contract.sampling import SamplingConfig


class TokenTimeline:
    """Makes tokens for stretches of conditions.

    Args:
        net: MATE and UTT.
        window: Groups of a training window.
        context: Groups that a window sees of what came before.
        audio: Statistics that music is normalised by; None for a model without music.
        inject_z: Draw z.
    """

    def __init__(
        self,
        net: ConditionedUtt,
        *,
        window: int,
        context: int,
        audio: AudioStats | None,
        inject_z: bool,
    ) -> None:
        self.net, self.window_groups, self.context = net, window, context
        self.audio, self.inject_z = audio, inject_z

    @torch.no_grad()
    def tokens(self, stretches: Sequence[Stretch], seeds: Sequence[int], sampling: SamplingConfig) -> Codes:
        """Codes of all stretches, one after another; B rows, a seed each."""
        utt, count = self.net.utt, len(seeds)
        device = next(self.net.parameters()).device
        empty = torch.zeros(count, 0, dtype=torch.int64, device=device)
        made = Codes(dict.fromkeys(utt.names, empty), torch.zeros(count, dtype=torch.int64, device=device))
        z = draw_z(seeds, utt.config.z_dim).to(device) if self.inject_z and utt.config.z_dim else None
        for number, stretch in enumerate(stretches):
            conditions = self.normalised(stretch.conditions)
            if stretch.frames is None:
                if len(stretches) > 1:
                    raise UserError(
                        "a stretch without a length stands alone; give the length of each in seconds"
                    )
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
        """What is there with `wanted` [B] groups more."""
        made, done, turn = before, torch.zeros_like(wanted), 0
        while bool((done < wanted).any()):
            rows = torch.nonzero(done < wanted)[:, 0]
            here = _rows(made, rows)
            seen = here.groups.clamp(max=self.context)
            new = torch.minimum(wanted[rows] - done[rows], self.window_groups - seen)
            first = (done[rows] - seen) * GROUP_FRAMES
            frames = (seen + new) * GROUP_FRAMES
            part = {
                name: cut(_rows_of(condition, rows), first, frames)
                if MODALITIES[name].timed
                else _rows_of(condition, rows)
                for name, condition in conditions.items()
            }
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
        drawn: int = 0,
    ) -> Codes:
        """New codes that follow `before`, whose last `drawn` groups are of this window already."""
        count = len(seeds)
        encoded = self.net.mate(conditions, count)
        audio = conditions.get("audio")
        music = [False] * count if audio is None else audio.mask.any(1).tolist()
        scales = [sampling.music_guidance if heard else sampling.cfg_scale for heard in music]
        guided = any(scale != 1 for scale in scales)
        return generate(
            self.net.utt,
            encoded,
            null=self.net.mate.unconditional(count) if guided else None,
            inject_z=self.inject_z,
            z=z,
            start=before,
            context=self.context + drawn,
            max_groups=min(self.window_groups, self.net.utt.max_groups) if groups is None else None,
            groups=groups,
            temperature=sampling.temperature,
            top_k=sampling.top_k or None,
            top_p=sampling.top_p,
            cfg_scale=scales,
            seed=list(seeds),
            drawn=drawn,
        )

    def normalised(self, conditions: Conditions) -> dict[str, Condition]:
        """Audio features as training saw them."""
        out = dict(conditions)
        if "audio" in out:
            if self.audio is None:
                raise UserError("this model was trained without music; drive it by text")
            mean = torch.from_numpy(self.audio.mean).to(out["audio"].features)
            std = torch.from_numpy(self.audio.std).to(out["audio"].features)
            features, mask, pooled = out["audio"]
            features = ((features - mean) / std).masked_fill(~mask[..., None], 0.0)
            out["audio"] = Condition(features, mask, pooled)
        return out


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
