"""Speed of what runs often, beside the usual way to do the same: the table "Speed" of docs/results.md.

    python benchmarks/speed.py [--only features smpl audio loader batches streaming] [--record speed]
    python benchmarks/speed.py --only bvh --bvh FOLDER

All on one core, in CPU seconds, which other programs on the machine hardly change; two ways of one case take
turns. `streaming` makes ten minutes of motion with a model of the package and looks at its memory.
"""

from __future__ import annotations

import io
import itertools
import os
import subprocess
import sys
import tempfile
import warnings
from argparse import Namespace
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from bench import Column, Record, arguments, command_line, cpu_seconds, process_seconds, report
from numpy.typing import NDArray

from motionloom.datasets.audio.features import AudioSettings, audio_features, fitting_octaves
from motionloom.datasets.convert.common.scan import list_files, read_file
from motionloom.datasets.loading.batches import WindowBatches
from motionloom.datasets.loading.condition_batches import ConditionBatches
from motionloom.datasets.loading.statistics import FeatureStats, compute
from motionloom.datasets.motion.body.smpl import BodyModel, smpl_joints
from motionloom.datasets.motion.bvh.motion import read_bvh
from motionloom.datasets.motion.canonical import canonicalize
from motionloom.datasets.motion.features.codec import encode
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.schema import Caption
from motionloom.datasets.shards.options import DatasetFacts, WriteOptions
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.shards.sample import Sample
from motionloom.datasets.shards.writer import write_dataset
from motionloom.datasets.text.build import build_with_encoder
from motionloom.datasets.text.encoder import EncodedText
from motionloom.pipeline.inference.model import MotionModel
from motionloom.pipeline.inference.script import Script, ScriptSegment
from motionloom.pipeline.store.tokens import TokenBatches, TokenCaptions, TokenStore

COLUMNS = (Column("ours", "ours"), Column("the usual way", "usual"), Column("times faster", "ratio", 1))
CAPTIONS = ("a person walks forward", "a person waves with the left hand", "a person squats")
WINDOW, BATCH = 64, 256


def row(title: str, ours: str, usual: str = "", ratio: float | None = None) -> Record:
    """A row of the table; cells are text, since rows have units of their own."""
    return {"title": title, "cells": {"ours": ours, "usual": usual} | ({"ratio": [ratio]} if ratio else {})}


def features(args: Namespace) -> Record:
    """Frames a second from joints to the 133 features of a body: 32 clips of a swaying figure."""
    layout, rng = MotionLayout.named("body133"), np.random.default_rng(0)
    seconds = np.arange(196)[:, None, None] / layout.fps
    phase = rng.uniform(0, 6, size=(32, 1, len(layout.skeleton), 3))
    sway = 0.05 * np.sin(4.0 * seconds + phase)
    joints = np.asarray(canonicalize(layout.skeleton.rest_joints + sway + seconds * [0.3, 0.0, 1.0]))
    taken = cpu_seconds({"ours": lambda: encode(joints, layout)})["ours"]
    return row("joints to 133 features", f"{joints.shape[0] * joints.shape[1] / taken / 1e6:.2f} M frames/s")


def smpl(args: Namespace) -> Record:
    """300 frames of SMPL-X: forward kinematics on joints, beside a body layer that computes all vertices.

    The body is random, of the published size (10475 vertices, 55 joints). The layer does what public ones do
    in float32: shape blend, joint regression, pose blend and skinning, all frames in one batch.
    """
    skeleton, rng, vertices, joints = Skeleton.named("smplx52"), np.random.default_rng(0), 10475, 55
    draw = torch.Generator().manual_seed(0)
    # Jaw and eyes, which the skeleton lacks, are leaves: any parent will do.
    parents = [*skeleton.parents, *[0] * (joints - len(skeleton))]
    template, shapes = torch.randn(vertices, 3, generator=draw), torch.randn(vertices, 3, 10, generator=draw)
    regressor, weights = torch.zeros(joints, vertices), torch.rand(vertices, joints, generator=draw)
    for joint in range(joints):  # about 30 vertices a joint, as in the published regressors
        chosen = torch.randint(vertices, (30,), generator=draw)
        regressor[joint, chosen] = torch.rand(30, generator=draw)
    regressor /= regressor.sum(dim=1, keepdim=True)
    weights /= weights.sum(dim=1, keepdim=True)
    blends = 0.001 * torch.randn(9 * (joints - 1), 3 * vertices, generator=draw)

    @torch.no_grad()
    def mesh(rotvecs: torch.Tensor, trans: torch.Tensor, betas: torch.Tensor) -> torch.Tensor:
        frames = len(rotvecs)
        angle = torch.linalg.norm(rotvecs, dim=-1, keepdim=True)[..., None].clamp_min(1e-8)
        x, y, z = (rotvecs / angle[..., 0]).unbind(-1)
        zero = torch.zeros_like(x)
        cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(frames, joints, 3, 3)
        local = torch.eye(3) + angle.sin() * cross + (1 - angle.cos()) * (cross @ cross)
        shaped = template + torch.einsum("b,vcb->vc", betas, 0.01 * shapes)
        rest = regressor @ shaped
        posed = shaped + ((local[:, 1:] - torch.eye(3)).reshape(frames, -1) @ blends).reshape(frames, -1, 3)
        step = torch.zeros(frames, joints, 4, 4)
        step[:, :, :3, :3], step[:, :, :3, 3], step[:, :, 3, 3] = local, rest, 1.0
        step[:, 1:, :3, 3] -= rest[parents[1:]]
        chain = [step[:, 0]]
        for joint in range(1, joints):
            chain.append(chain[parents[joint]] @ step[:, joint])
        moves = torch.stack(chain, dim=1)
        world = moves[:, :, :3, 3] + trans[:, None]
        moves[:, :, :3, 3] -= torch.einsum("tjik,jk->tji", moves[:, :, :3, :3], rest)
        skin = (weights @ moves.reshape(frames, joints, 16)).reshape(frames, -1, 4, 4)
        (skin @ torch.cat([posed, torch.ones(frames, vertices, 1)], dim=2)[..., None])[:, :, :3, 0]
        return world

    mine = list(range(len(skeleton)))
    reduced = regressor.double().numpy()[mine]
    directions = np.tensordot(reduced, 0.01 * shapes.double().numpy(), axes=1)
    body = BodyModel(skeleton, reduced @ template.double().numpy(), directions, {})
    rotvecs, trans, betas = rng.normal(size=(300, joints, 3)), rng.normal(size=(300, 3)), rng.normal(size=10)
    ours = partial(smpl_joints, np.ascontiguousarray(rotvecs[:, mine]), trans, body, betas)
    theirs = partial(mesh, *(torch.from_numpy(array).float() for array in (rotvecs, trans, betas)))
    assert np.abs(theirs().numpy()[:, mine] - ours()).max() < 1e-3
    taken = cpu_seconds({"ours": ours, "mesh": theirs})
    ratio = taken["mesh"] / taken["ours"]
    title = "SMPL-X parameters to joints, 300 frames"
    return row(title, f"{1e3 * taken['ours']:.1f} ms", f"{1e3 * taken['mesh']:.0f} ms, all vertices", ratio)


def audio(args: Namespace) -> Record:
    """438 features of one minute: drum noise and decaying notes at 112 beats a minute."""
    import librosa

    settings, rng = AudioSettings(fps=60.0), np.random.default_rng(0)
    rate, octaves = settings.rate, fitting_octaves(settings.rate)
    sound = 0.01 * rng.standard_normal(60 * rate)
    for beat in range(112):
        start = int(beat * 60 / 112 * rate)
        at = np.arange(min(len(sound) - start, rate // 3)) / rate
        sound[start : start + len(at)] += 0.3 * np.exp(-20 * at) * rng.standard_normal(len(at))
        note = np.sin(2 * np.pi * 55 * 2 ** (rng.integers(0, 36) / 12) * at)
        sound[start : start + len(at)] += 0.3 * np.exp(-6 * at) * note
    y = sound.astype(np.float32)

    def separate_calls() -> NDArray[np.float32]:
        """Bailando's order of librosa calls, each of them on its own."""
        mfcc = librosa.feature.mfcc(
            S=librosa.power_to_db(librosa.feature.melspectrogram(y=y, sr=rate), ref=np.max)
        )
        harmonic, percussive = librosa.effects.hpss(y)
        notes = librosa.feature.chroma_cqt(y=harmonic, sr=rate, n_octaves=octaves)
        onsets = librosa.onset.onset_strength(y=percussive, sr=rate, aggregate=np.median)
        tempogram = librosa.feature.tempogram(onset_envelope=onsets, sr=rate)
        _, beats = librosa.beat.beat_track(onset_envelope=onsets, sr=rate)
        flags = np.zeros_like(onsets)
        flags[beats] = 1
        delta = librosa.feature.delta(mfcc, width=3)
        return np.concatenate([mfcc, delta, notes, onsets[None], flags[None], tempogram]).T

    warnings.simplefilter("ignore")
    calls: dict[str, Callable[[], object]] = {
        "ours": lambda: audio_features(y, rate, settings), "librosa": separate_calls,
    }  # fmt: skip
    taken = cpu_seconds(calls, 3)
    usual = f"{taken['librosa']:.1f} s, librosa's calls"
    title = "438 audio features of one minute"
    return row(title, f"{taken['ours']:.2f} s", usual, taken["librosa"] / taken["ours"])


@dataclass(frozen=True)
class NoiseClips:
    """Clip i: `least` to 196 frames of noise in `layout`, with three captions."""

    layout: MotionLayout
    least: int

    def __call__(self, i: int) -> Sample:
        rng = np.random.default_rng(i)
        frames = int(rng.integers(self.least, 197))
        motion = rng.standard_normal((frames, self.layout.dim), dtype=np.float32)
        meta = self.layout.clip_meta(str(i), source="noise", split="train", frames=frames, licence="CC0")
        return Sample(meta, motion, [Caption(text=f"{caption} {i}") for caption in CAPTIONS])


class NoiseText:
    """Captions as twelve words of noise, as wide as the sentence encoder of the recipes."""

    name, dim = "noise", 384

    def encode(self, captions: Sequence[str]) -> EncodedText:
        tokens = np.random.default_rng(0).standard_normal((len(captions), 12, self.dim), dtype=np.float32)
        return EncodedText(tokens.mean(axis=1), tokens, np.ones(tokens.shape[:2], dtype=bool))


def noise(folder: str, layout: MotionLayout, clips: int, least: int) -> tuple[ShardDataset, FeatureStats]:
    """Clips of noise in shards, and their statistics."""
    facts = DatasetFacts("noise", layout, "CC0", converter="noise", converter_version=1, options={})
    items = [("train", i) for i in range(clips)]
    write_dataset(Path(folder), items, NoiseClips(layout, least), facts, WriteOptions(workers=1))
    dataset = ShardDataset.open(Path(folder), "train")
    return dataset, compute(dataset)


def batches(args: Namespace) -> Record:
    """Batches of 256 as the paper trains on them, of 512 whole-body clips of 196 frames."""
    layout, count, groups = MotionLayout.named("wholebody363"), 512, 49
    columns, draw = layout.part("bodyhand"), torch.Generator().manual_seed(0)
    with tempfile.TemporaryDirectory() as folder:
        dataset, stats = noise(folder, layout, count, 196)
        texts = [caption.text for i in range(count) for caption in dataset.texts(i)]
        cache = build_with_encoder(Path(folder, "text"), texts, NoiseText(), progress=False)
        per_group = {"body": 2, "hand": 1}
        codes = {k: torch.randint(512, (count * groups * n,), generator=draw) for k, n in per_group.items()}
        store = TokenStore(codes, np.arange(count + 1) * groups, per_group, np.ones(count, bool))
        captions = TokenCaptions.of([[(3 * i + k, 0, groups) for k in range(3)] for i in range(count)])
        latents, alike = torch.zeros(3 * count, 256), torch.zeros(3 * count, NoiseText.dim)
        pattern, ends = ("body", "body", "hand"), dict.fromkeys(per_group, 512)
        clips = {"max_frames": 196, "captioned": "body", "columns": columns, "batch_size": BATCH}
        made = {
            "tokenizer": WindowBatches(dataset, stats, window=WINDOW, batch_size=BATCH, columns=columns),
            "TMA": ConditionBatches(dataset, stats, {"text": cache}, **clips),
            "GPT": TokenBatches(store, captions, latents, alike, pattern, ends, groups, BATCH, 0),
        }
        step = itertools.count()
        taken = cpu_seconds({name: lambda own=own: own[next(step)] for name, own in made.items()}, 20)
    times = ", ".join(f"{name} {1e3 * seconds:.1f} ms" for name, seconds in taken.items())
    return row("a training batch of 256 at the paper's size", times)


def loader(args: Namespace) -> Record:
    """Normalised windows of 64 x 263, 256 a batch, from the same tar files: ours and webdataset's."""
    import webdataset

    layout = MotionLayout.named("h3d263")
    with tempfile.TemporaryDirectory() as folder:
        dataset, stats = noise(folder, layout, 2048, WINDOW)
        names = [str(Path(folder) / shard.name) for shard in dataset.manifest.shards]

        def ours() -> None:
            batches = WindowBatches(dataset, stats, window=WINDOW, batch_size=BATCH, windows_per_clip=4)
            for step in range(40):
                batches[step]["motion"]

        def windows() -> Iterator[NDArray[np.float32]]:
            for sample in itertools.chain.from_iterable(
                webdataset.WebDataset(names, shardshuffle=False, empty_check=False) for _ in itertools.count()
            ):
                motion = np.load(io.BytesIO(sample["motion.npy"]), allow_pickle=False)
                start = np.random.randint(0, len(motion) - WINDOW + 1)
                yield (motion[start : start + WINDOW] - stats.mean) / stats.std

        def theirs() -> None:
            endless = windows()
            for _ in range(5):
                torch.from_numpy(np.stack(list(itertools.islice(endless, BATCH))))

        taken = cpu_seconds({"ours": ours, "webdataset": theirs})
    rates = {"ours": 40 * BATCH / taken["ours"], "webdataset": 5 * BATCH / taken["webdataset"]}
    usual = f"{rates['webdataset'] / 1e3:.1f} k/s, webdataset"
    ratio = rates["ours"] / rates["webdataset"]
    return row("training windows of 64 × 263 from shards", f"{rates['ours'] / 1e3:.0f} k/s", usual, ratio)


def streaming(args: Namespace) -> Record:
    """How soon a stream's first frames come, its speed, and how far its memory grows."""
    model = MotionModel(args.model, "cpu")
    next(model.stream(CAPTIONS[0]))  # loads the text encoder
    first = cpu_seconds({"first": lambda: next(model.stream(CAPTIONS[1], seed=1))})["first"]
    begin, frames, early, largest = process_seconds(), 0, 0.0, 0.0
    captions = itertools.islice(itertools.cycle(CAPTIONS), round(6 * args.minutes) + 1)
    segments = [ScriptSegment(text=caption, seconds=10.0) for caption in captions]
    for chunk in model.stream(Script(segments=segments), seed=1):
        frames += len(chunk.joints)
        if frames >= 60 * model.fps:
            pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
            now = pages * os.sysconf("SC_PAGE_SIZE") / 2**20
            early, largest = early or now, max(largest, now)
        if frames >= 60 * args.minutes * model.fps:
            break
    speed = frames / model.fps / (process_seconds() - begin)
    grown = f"memory +{largest - early:.0f} MiB in {args.minutes:g} minutes"
    return row("streaming", f"{speed:.1f} × real time, first frames after {first:.2f} s; {grown}")


def bvh(args: Namespace) -> Record:
    """BVH to shards with one worker, beside parsing alone."""
    motion, begin = 0.0, process_seconds()
    folder, names = list_files(args.bvh)
    for name in names:
        clip = read_bvh(read_file(folder / name, name), name=name)
        motion += clip.frames / clip.fps
    parsing = process_seconds() - begin
    command = [sys.executable, "-P", "-m", "motionloom.pipeline.cli.main", "data", "convert", "bvh"]
    with tempfile.TemporaryDirectory() as out:
        begin = process_seconds()
        options = ["--licence", "CC0", "--workers", "1"]
        subprocess.run([*command, str(args.bvh), f"{out}/shards", *options], check=True)
        taken = process_seconds() - begin
    title = "BVH to shards"
    return row(title, f"{motion / taken:.0f} × real time", f"{motion / parsing:.0f} ×, parsing alone")


CASES = {case.__name__: case for case in (features, smpl, bvh, audio, loader, batches, streaming)}


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--only", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--bvh", type=Path, help="a folder of BVH files; without one `bvh` is left out")
    parser.add_argument("--model", type=Path, default=Path("synthetic"), help="of `streaming`")
    parser.add_argument("--minutes", type=float, default=10.0, help="of `streaming`'s motion")
    args = arguments(parser)
    chosen = [name for name in args.only if name != "bvh" or args.bvh]
    report("Speed on one core", COLUMNS, [CASES[name](args) for name in chosen], args.record)


if __name__ == "__main__":
    main()
