"""Where a UDE run loses what music and captions ask for, station by station.

    motionloom run ude-dance
    python benchmarks/ude_stations.py runs/ude-dance

Held-out clips as they are recorded; their true tokens decoded by the tokenizer and by DMD; tokens that each
UTT makes for their music or caption, with and without z, decoded by both and drawn twice. Beat Align of
dances (to their own music and to other songs), genre and tempo, attributes of captions (those of held-out
combinations apart): all measured on the joints. `variety` is the distance of the two draws. Stations whose
stage has not finished are left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from bench import Column, arguments, command_line, judge, report
from numpy.typing import NDArray

from motionloom.datasets.motion.features.joints import joints_of, local_joints_of
from motionloom.models.diffusion.sampling import decode_motions
from motionloom.models.gpt.drawing import sample_seeds
from motionloom.models.gpt.tokens import Codes
from motionloom.models.tokenizer.base import GROUP_FRAMES
from motionloom.pipeline.contract.generation import Prompt, Stretch
from motionloom.pipeline.contract.lookup import finished_stages
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.stage import StageCache
from motionloom.pipeline.evaluation.clip_metrics import BEAT_ALIGN, DANCE_METRICS, Performance, measure_clip
from motionloom.pipeline.evaluation.dances import DanceClip, dances_of, other_songs
from motionloom.pipeline.evaluation.estimate import row_estimates
from motionloom.pipeline.evaluation.truth import has_caption, spread, truth_of
from motionloom.pipeline.inference.generators.timeline import TokenTimeline
from motionloom.pipeline.inference.generators.ude import UdeConfig
from motionloom.pipeline.inference.requests import PromptEncoder
from motionloom.pipeline.store.networks import TrainedTokenizer

Motion = NDArray[np.float32]


@dataclass
class Engine:
    """What of a run has finished."""

    tokenizer: TrainedTokenizer
    utts: dict[str, Any]
    dmd: Any
    ude: UdeConfig

    @staticmethod
    def of(run: Path, utts: Sequence[str]) -> Engine:
        stages, stage_cache = finished_stages(run), StageCache()
        if "tokenizer" not in stages:
            raise SystemExit(f"{run}: stage 'tokenizer' has not finished; run it first")
        ude = stages["ude"].config if "ude" in stages else UdeConfig()
        return Engine(
            stage_cache.get(stages["tokenizer"]),
            {name: stage_cache.get(stages[name]) for name in utts if name in stages},
            stage_cache.get(stages["dmd"]) if "dmd" in stages else None,
            ude,
        )

    def made_codes(
        self,
        utt: Any,
        prompts: Sequence[Prompt],
        frames: Sequence[int],
        sampling: SamplingConfig,
        seed: int,
        *,
        inject_z: bool,
    ) -> Codes:
        """Tokens that `utt` makes for prompts, of the lengths wanted."""
        encoder = PromptEncoder(utt.given.get("text"), torch.device("cpu"))
        conditions = encoder.encode(
            prompts, [p.text for p in prompts], utt.modalities, self.tokenizer.layout.fps
        )
        line = TokenTimeline(
            utt.net,
            window=utt.max_frames // GROUP_FRAMES,
            context=self.ude.context_frames // GROUP_FRAMES,
            prepared={name: utt.given.get(name) for name in utt.modalities},
            inject_z=inject_z,
        )
        return line.tokens([Stretch(conditions, frames)], sample_seeds(seed, len(prompts)), sampling)

    def decoded(self, codes: Codes, seed: int, *, by_dmd: bool) -> list[Motion]:
        """Motions of tokens, features in their own units."""
        if not by_dmd:
            return self.tokenizer.decode(codes.codes, codes.groups.tolist())
        made = decode_motions(
            self.dmd.net,
            codes,
            seeds=sample_seeds(seed, len(codes.groups)),
            sampler=self.ude.sampler,
            steps=self.ude.denoising_steps,
            window=self.dmd.window,
            overlap=self.ude.overlap_frames,
        )
        return [self.tokenizer.of_coordinates(motion) for motion in made]

    def stations(
        self, recorded: Sequence[Motion], prompts: Sequence[Prompt], sampling: SamplingConfig, seed: int
    ) -> Iterator[tuple[str, list[Motion], list[Motion]]]:
        """(station, its motions, other motions of the same: by other draws where it draws)."""
        yield "recorded", list(recorded), list(recorded)
        decoders = [("tokenizer", False)] + ([("DMD", True)] if self.dmd is not None else [])
        frames = [len(m) for m in recorded]
        true = self.tokenizer.encode([motion[:, self.tokenizer.columns] for motion in recorded])
        for decoder, by_dmd in decoders:
            both = [self.decoded(true, seed + n, by_dmd=by_dmd) for n in (0, 1)]
            yield f"true tokens, {decoder}", both[0], both[1]
        for name, utt in self.utts.items():
            for noise in (True, False) if utt.net.utt.config.z_dim else (False,):
                made = [
                    self.made_codes(utt, prompts, frames, sampling, seed + n, inject_z=noise) for n in (0, 1)
                ]
                for decoder, by_dmd in decoders:
                    both = [self.decoded(made[n], seed + n, by_dmd=by_dmd) for n in (0, 1)]
                    yield f"{name}, {'z' if noise else 'no z'}, {decoder}", both[0], both[1]


def variety(one: Sequence[NDArray[Any]], other: Sequence[NDArray[Any]], fps: float) -> float:
    """Mean distance of the joints of two motions for the same, root and heading aligned, millimetres."""
    pairs = zip(one, other, strict=True)
    return 1000 * float(
        np.mean(
            [
                np.linalg.norm(local_joints_of(a, fps) - local_joints_of(b, fps), axis=-1).mean()
                for a, b in pairs
            ]
        )
    )


def dance_figures(
    clips: Sequence[DanceClip], motions: Sequence[NDArray[Any]], apart: Sequence[Sequence[int]]
) -> dict[str, float]:
    """Of one motion a clip."""
    own = _means([measure_clip(DANCE_METRICS, _held(m, c)) for m, c in zip(motions, clips, strict=True)])
    crossed = [(m, clips[k]) for m, row in zip(motions, apart, strict=True) for k in row]
    wrong = _means([measure_clip((BEAT_ALIGN,), _held(m, c)) for m, c in crossed])
    names = ("bailando", "mint")
    return {
        **{f"beats_{name}": own[f"beat_align.{name}"] for name in names},
        **{f"other_music_{name}": wrong[f"beat_align.{name}"] for name in names},
        **{k.partition(".")[2]: v for k, v in own.items() if k.startswith(("recognition.", "feet."))},
    }


def _held(joints: NDArray[Any], clip: DanceClip) -> Performance:
    return Performance(joints, clip.joints, clip.fps, truth=clip.truth, beats=clip.beats)


def _means(rows: Sequence[Mapping[str, float]]) -> dict[str, float]:
    return {name: found.value for name, found in row_estimates([rows]).items()}


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--clips", type=int, default=100, help="held-out dances, and captions, at most")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--temperature", type=float, default=1.0)
    parser.add_argument("--top-p", type=float, default=0.9)
    parser.add_argument("--cfg-scale", type=float, default=1.0)
    parser.add_argument("--music-cfg-scale", type=float, help="guidance of dances (default: --cfg-scale)")
    parser.add_argument("--split", default="test")
    parser.add_argument("--no-dances", action="store_true", help="for models of words alone")
    parser.add_argument("--no-dmd", action="store_true", help="decode by the tokenizer alone")
    parser.add_argument("--utt", nargs="*", default=["utt"], help="UTT stages to compare")
    args = arguments(parser)
    engine = Engine.of(args.run, args.utt)
    if args.no_dmd:
        engine.dmd = None
    stages, stage_cache = finished_stages(args.run), StageCache()
    dataset = stage_cache.get(stages["data"]).split(args.split)
    layout, fps = dataset.layout, dataset.layout.fps
    sampling = SamplingConfig(
        temperature=args.temperature,
        top_p=args.top_p,
        cfg_scale=args.cfg_scale,
        guidance={} if args.music_cfg_scale is None else {"audio": args.music_cfg_scale},
    )
    out: dict[str, dict[str, float]] = {}
    if not args.no_dances:
        clips = dances_of(dataset, args.clips, unit=GROUP_FRAMES)
        apart = other_songs(clips, 5, args.seed)
        recorded = [np.asarray(dataset.motion(c.index))[: len(c.joints)] for c in clips]
        prompts = [Prompt(sound=c.sound, conditions={"audio": c.music}) for c in clips]
        for name, *both in engine.stations(recorded, prompts, sampling, args.seed):
            one, other = ([joints_of(m, layout) for m in motions] for motions in both)
            out[name] = dance_figures(clips, one, apart) | {"variety of dances": variety(one, other, fps)}
    if has_caption(dataset).any():
        truths = [truth_of(dataset, i) for i in spread(dataset, 10 * args.clips)]
        said = [t for t in truths if t.truth and t.truth.get("action") != "dance"][: args.clips]
        place = {name: number for number, name in enumerate(dataset.ids)}
        recorded = [np.asarray(dataset.motion(place[t.id]))[: len(t.features)] for t in said]
        prompts = [Prompt(text=t.caption) for t in said]
        held = [c for s in stages.values() for c in getattr(s.config, "hold_out", [])]
        for name, *both in engine.stations(recorded, prompts, sampling, args.seed):
            one, other = ([joints_of(m, layout) for m in motions] for motions in both)
            shares = judge(said, ((joints, None) for joints in one), fps, held)
            found = {f"{kind}: {name}": value for kind, row in shares.items() for name, value in row.items()}
            out.setdefault(name, {}).update(found, variety=variety(one, other, fps))
    columns = [Column(figure, figure, 3) for figure in dict.fromkeys(f for row in out.values() for f in row)]
    rows = [{"title": name, "cells": {k: [v] for k, v in row.items()}} for name, row in out.items()]
    report(f"Stations of {args.run.name}", columns, rows, args.record)


if __name__ == "__main__":
    main()
