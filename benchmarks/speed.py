"""Speed of what runs often, beside the usual way to do the same: the table "Speed" of docs/results.md.

    python benchmarks/speed.py [--only audio batches workers] [--t2m-gpt FOLDER] [--record speed]

All on one core, in CPU seconds, which other programs on the machine hardly change; two ways of one case take
turns. `workers` adds up a loader process and the one that reads from it. `vq` needs T2M-GPT's public code,
https://github.com/Mael-zys/T2M-GPT, in FOLDER.
"""

from __future__ import annotations

import importlib
import itertools
import multiprocessing
import os
import sys
import tempfile
import time
import warnings
from argparse import Namespace
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import numpy as np
import torch
from bench import Column, Record, arguments, command_line, cpu_seconds, report
from numpy.typing import NDArray
from torch.utils.data import DataLoader

from motionloom.datasets.audio.features import AudioSettings, audio_features, fitting_octaves
from motionloom.datasets.base.records import Caption
from motionloom.datasets.loading.batches import WindowBatches
from motionloom.datasets.loading.condition_batches import ConditionBatches
from motionloom.datasets.loading.statistics import FeatureStats, compute
from motionloom.datasets.loading.steps import Numbered, Steps
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.shards.options import DatasetFacts, WriteOptions
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.shards.sample import Sample
from motionloom.datasets.shards.writer import write_dataset
from motionloom.datasets.text.build import build_with_encoder
from motionloom.datasets.text.encoder import EncodedText
from motionloom.models.tokenizer.module import TokenizerModule
from motionloom.models.training.stage_module import Batch
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.runs.recipe import load_recipe
from motionloom.pipeline.store.tokens import TokenBatches, TokenCaptions, TokenStore
from motionloom.pipeline.training.loaders import ROOMS, Loader

COLUMNS = (Column("ours", "ours"), Column("the usual way", "usual"), Column("times faster", "ratio", 1))
CAPTIONS = ("a person walks forward", "a person waves with the left hand", "a person squats")
WINDOW = 64
BATCH = 256


def row(title: str, ours: str, usual: str = "", ratio: float | None = None) -> Record:
    """A row of the table; cells are text, since rows have units of their own."""
    return {"title": title, "cells": {"ours": ours, "usual": usual} | ({"ratio": [ratio]} if ratio else {})}


def audio(args: Namespace) -> Record:
    """438 features of one minute: drum noise and decaying notes at 112 beats a minute."""
    import librosa

    settings = AudioSettings(fps=60.0)
    rng = np.random.default_rng(0)
    rate = settings.rate
    octaves = fitting_octaves(settings.rate)
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

    name = "noise"
    dim = 384

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


def paper_batches(folder: str) -> dict[str, Numbered[Batch]]:
    """Batches of 256 as the paper trains on them, of 512 whole-body clips of 196 frames in `folder`."""
    layout = MotionLayout.named("wholebody363")
    count = 512
    groups = 49
    columns = layout.part("bodyhand")
    draw = torch.Generator().manual_seed(0)
    dataset, stats = noise(folder, layout, count, 196)
    texts = [caption.text for i in range(count) for caption in dataset.texts(i)]
    cache = build_with_encoder(Path(folder, "text"), texts, NoiseText(), progress=False)
    per_group = {"body": 2, "hand": 1}
    codes = {k: torch.randint(512, (count * groups * n,), generator=draw) for k, n in per_group.items()}
    store = TokenStore(codes, np.arange(count + 1) * groups, per_group, np.ones(count, bool))
    rows = np.array([(row, 0, groups) for row in range(3 * count)])
    captions = TokenCaptions.of(np.full(count, 3), rows, np.arange(count))
    latents = torch.zeros(3 * count, 256)
    alike = torch.zeros(3 * count, NoiseText.dim)
    pattern = ("body", "body", "hand")
    ends = dict.fromkeys(per_group, 512)
    clips = {"max_frames": 196, "captioned": "body", "columns": columns, "batch_size": BATCH}
    return {
        "tokenizer": WindowBatches(dataset, stats, window=WINDOW, batch_size=BATCH, columns=columns),
        "TMA": ConditionBatches(dataset, stats, {"text": cache}, **clips),
        "GPT": TokenBatches(store, captions, latents, alike, pattern, ends, groups, BATCH, 0),
    }


def batches(args: Namespace) -> Record:
    """CPU time of one batch."""
    with tempfile.TemporaryDirectory() as folder:
        step = itertools.count()
        made = paper_batches(folder)
        motion = np.zeros((2, *made["TMA"][0]["motion"].shape), dtype=np.float32)
        calls: dict[str, Callable[[], object]] = {
            name: lambda own=own: own[next(step)] for name, own in made.items()
        }
        taken = cpu_seconds(calls | {"copy": lambda: np.copyto(motion[0], motion[1])}, 20)
    copied = f"one copy of TMA's motion {1e3 * taken.pop('copy'):.1f} ms"
    times = ", ".join(f"{name} {1e3 * seconds:.1f} ms" for name, seconds in taken.items())
    return row("a training batch of 256 at the paper's size", times, copied)


def busy() -> float:
    """CPU seconds of this process and of its loader processes so far."""
    seconds = time.process_time()
    for child in multiprocessing.active_children():
        times = Path(f"/proc/{child.pid}/stat").read_text().rpartition(")")[2].split()[11:13]
        seconds += sum(map(int, times)) / os.sysconf("SC_CLK_TCK")
    return seconds


def workers(args: Namespace) -> Record:
    """CPU time of a batch of one loader process and its reader, as for a GPU, and as torch alone sends it."""
    begins = 10
    count = 100
    ours = []
    usual = []
    with tempfile.TemporaryDirectory() as folder:
        for own in paper_batches(folder).values():
            # More than are read, so that the process is as far ahead at the end as at the beginning.
            steps = Steps(lambda rank, world, own=own: own, begins + count + 10)
            one = Hardware(accelerator="cpu", workers=1)
            packed = Loader(steps, one, torch.device("cpu"), once=True)
            packed._opened = packed._open()
            packed._opened.dataset.rooms = ROOMS  # type: ignore[attr-defined]
            plain = DataLoader(steps, batch_size=None, num_workers=1, multiprocessing_context="spawn")
            for load, times in ((packed, ours), (plain, usual)):
                coming = iter(load)
                for k in range(begins + count):
                    if k == begins:
                        began = busy()
                    next(coming)
                times.append(f"{1e3 * (busy() - began) / count:.0f}")
                for _ in coming:  # so that the process ends by itself
                    pass
            packed.close()
    return row("from one loader process", f"{', '.join(ours)} ms", f"sent by torch: {', '.join(usual)} ms")


def vq(args: Namespace) -> Record:
    """A training step of T2M-GPT's tokenizer, here and by its public code, in float32 and in bfloat16."""
    config = load_recipe("t2m-gpt-paper").stage("tokenizer").config
    module = TokenizerModule(
        config.net.build(MotionLayout.named("h3d263")), config.optim, seed=0, max_steps=100
    )
    own = module.train().configure_optimizers()[0]["optimizer"]
    sys.path.insert(0, args.t2m_gpt)
    losses = importlib.import_module("utils.losses").ReConsLoss("l1_smooth", 22)
    network = importlib.import_module("models.vqvae").HumanVQVAE
    options = Namespace(quantizer="ema_reset", dataname="t2m", mu=0.99)
    with mock.patch.object(torch.Tensor, "cuda", lambda tensor: tensor):
        theirs = network(options, down_t=2, stride_t=2).train()
    other = torch.optim.AdamW(theirs.parameters(), lr=2e-4, betas=(0.9, 0.99), weight_decay=0.0)
    motion = torch.randn(BATCH, WINDOW, 263)
    batch = {"motion": motion, "length": torch.full((BATCH,), WINDOW), "full": True}

    def ours() -> None:
        loss = module.training_step(batch, 0)
        own.zero_grad()
        loss.backward()
        module.configure_gradient_clipping(own)
        own.step()
        module.step += 1

    def public() -> None:
        made, commit, _ = theirs(motion)
        loss = losses(made, motion) + 0.02 * commit + 0.5 * losses.forward_vel(made, motion)
        other.zero_grad()
        loss.backward()
        other.step()

    taken = []
    for half in (False, True):
        with torch.autocast("cpu", torch.bfloat16, enabled=half):
            taken.append(cpu_seconds({"ours": ours, "public": public}, 5))
    times = {name: ", in bfloat16 ".join(f"{one[name]:.2f} s" for one in taken) for name in taken[0]}
    shown = row("a step of T2M-GPT's tokenizer", times["ours"], f"{times['public']}, its public code")
    shown["cells"]["ratio"] = [one["public"] / one["ours"] for one in taken]
    return shown


CASES = {case.__name__: case for case in (audio, batches, workers, vq)}


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--only", nargs="+", choices=CASES)
    parser.add_argument("--t2m-gpt", metavar="FOLDER", help="its public code, for the case vq")
    args = arguments(parser)
    torch.set_num_threads(1)
    only = args.only or [name for name in CASES if name != "vq" or args.t2m_gpt]
    report("Speed on one core", COLUMNS, [CASES[name](args) for name in only], args.record)


if __name__ == "__main__":
    main()
