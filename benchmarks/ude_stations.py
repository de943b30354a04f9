"""Where a UDE run loses what music and captions ask for, station by station.

    motionloom run ude-learning
    python benchmarks/ude_stations.py runs/ude-learning --utt utt prefix_7 gru_7

Held-out clips as they are recorded; their true tokens decoded by the tokenizer and by DMD; tokens that each
UTT makes for their music or caption, with and without z, decoded by both and drawn twice. Beat Align of
dances (to their own music and to other songs), genre and tempo, attributes of captions (those of held-out
combinations apart too): all measured on the joints. `variety` is how far the two draws are apart. Stations
whose stage has not finished are left out. Writes `stations.json` (`--out`) into the run's folder.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from motionloom.datasets.motion.features.joints import joints_of, local_joints_of
from motionloom.datasets.synth.measure import agrees
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


def caption_figures(
    truths: Sequence[Mapping[str, Any]],
    motions: Sequence[Any],
    fps: float,
    apart: Sequence[Mapping[str, Any]],
) -> dict[str, float]:
    """Shares of right attributes, "every" all together, "whole" of clips with all right, and both of these of
    held-out combinations and of the other clips; faces play no part.

    A combination with a hand's shape holds out a hand beside a motion that is known ("new hand"); one without
    holds out the motion itself ("new motion"), which training has never seen.
    """
    found: dict[str, list[bool]] = {}
    for truth, joints in zip(truths, motions, strict=True):
        right = agrees(dict(truth), joints, None, fps)
        new = [c for c in apart if all(truth.get(k) == v for k, v in c.items())]
        groups = ["held out" if new else "other"]
        if new:
            hands = all("left_hand" in c or "right_hand" in c for c in new)
            groups.append("new hand" if hands else "new motion")
        for name, value in right.items():
            for title in (name, "every", *(f"{group} every" for group in groups)):
                found.setdefault(title, []).append(value)
        for title in ("whole", *(f"{group} whole" for group in groups)):
            found.setdefault(title, []).append(all(right.values()))
    return {name: float(np.mean(values)) for name, values in found.items()}


def show(console: Console, title: str, rows: Mapping[str, Mapping[str, float]]) -> None:
    names = list(next(iter(rows.values())))
    table = Table(title=title)
    for column in ("", *names):
        table.add_column(column)
    for station, figures in rows.items():
        table.add_row(station, *(f"{figures[n]:.3f}" if n in figures else "" for n in names))
    console.print(table)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("--clips", type=int, default=100, help="held-out dances, and captions, at most")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--temperature", type=float, default=1.0)
    parser.add_argument("--top-p", type=float, default=0.9)
    parser.add_argument("--cfg-scale", type=float, default=1.0)
    parser.add_argument("--music-cfg-scale", type=float, help="guidance of dances (default: --cfg-scale)")
    parser.add_argument("--split", default="test")
    parser.add_argument("--out", default="stations.json")
    parser.add_argument("--no-dances", action="store_true", help="for models of words alone")
    parser.add_argument("--no-dmd", action="store_true", help="decode by the tokenizer alone")
    parser.add_argument("--utt", nargs="*", default=["utt"], help="UTT stages to compare")
    args = parser.parse_args()
    console, engine = Console(width=220), Engine.of(args.run, args.utt)
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
    out: dict[str, Any] = {"arguments": {k: str(v) for k, v in vars(args).items()}}
    if not args.no_dances:
        clips = dances_of(dataset, args.clips, unit=GROUP_FRAMES)
        apart = other_songs(clips, 5, args.seed)
        recorded = [np.asarray(dataset.motion(c.index))[: len(c.joints)] for c in clips]
        prompts = [Prompt(sound=c.sound, conditions={"audio": c.music}) for c in clips]
        out["dances"] = {}
        for name, *both in engine.stations(recorded, prompts, sampling, args.seed):
            one, other = ([joints_of(m, layout) for m in motions] for motions in both)
            out["dances"][name] = dance_figures(clips, one, apart) | {"variety": variety(one, other, fps)}
        show(console, f"{len(clips)} dances to {len({c.song for c in clips})} songs", out["dances"])
    if has_caption(dataset).any():
        truths = [truth_of(dataset, i) for i in spread(dataset, 10 * args.clips)]
        said = [t for t in truths if t.truth and t.truth.get("action") != "dance"][: args.clips]
        place = {name: number for number, name in enumerate(dataset.ids)}
        recorded = [np.asarray(dataset.motion(place[t.id]))[: len(t.features)] for t in said]
        prompts, records = [Prompt(text=t.caption) for t in said], [t.truth or {} for t in said]
        held = [c for s in stages.values() for c in getattr(s.config, "hold_out", [])]
        out["captions"] = {}
        for name, *both in engine.stations(recorded, prompts, sampling, args.seed):
            one, other = ([joints_of(m, layout) for m in motions] for motions in both)
            found = caption_figures(records, one, fps, held) | {"variety": variety(one, other, fps)}
            out["captions"][name] = found
        show(console, f"{len(said)} captions", out["captions"])
    (args.run / args.out).write_text(json.dumps(out, indent=2))


if __name__ == "__main__":
    main()
