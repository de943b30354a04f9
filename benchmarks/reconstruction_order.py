"""H2VQ against RVQ at equal bits, and at equal bits and parameters (HumanTOMATO Tables 3 and 7).

    python benchmarks/reconstruction_order.py clips.npz WORK --shards SHARDS
    python benchmarks/reconstruction_order.py clips.npz WORK --width 128 --batch 32 --lr 1e-3 --steps 1500

The second is for a CPU: some twenty minutes of a core for three seeds.

`--shards` makes clips.npz, an array file of some 20 MB, where it is missing. The bodies are real (SHARDS
holds `body133` clips), the hands synthetic: on the recorded forearms, each takes one random shape after
another, for about a second. All three tokenizers of a seed see the same windows. They train side by side; on
a GPU all seeds at once, each step as a CUDA graph on a stream of its own, on a CPU seed by seed. Features,
losses and optimizer are the paper's: standard deviations averaged over each kind of column, squared error,
AdamW, bf16 on a GPU. The rate is constant after a warm-up, so that a figure at a step does not depend on how
long the training was meant to be. The test windows are measured after a quarter, half and all of the steps;
each figure is appended to WORK/rows.jsonl at once, so what was reached is kept. Started again it goes on with
the first seed that has not finished.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import roma
import torch
from bench import Column, arguments, command_line, report
from numpy.typing import NDArray
from torch import Tensor

from motionloom.datasets.actions.hands import HANDS
from motionloom.datasets.loading.statistics import Moments, from_moments
from motionloom.datasets.motion.body.resting_hands import with_resting_hands
from motionloom.datasets.motion.canonical import canonicalize
from motionloom.datasets.motion.features.codec import encode
from motionloom.datasets.motion.features.joints import joints_of
from motionloom.datasets.motion.features.torch_joints import torch_joints_of
from motionloom.datasets.motion.layout import BODY_JOINTS, MotionLayout
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.synth.actions.maths import ease
from motionloom.datasets.synth.hands_and_face import grip_hand
from motionloom.models.metrics.reconstruction import mpjpe
from motionloom.models.tokenizer.body_hand import H2VQConfig
from motionloom.models.tokenizer.module import TokenizerModule
from motionloom.models.tokenizer.single import RvqConfig
from motionloom.models.training.optim import OptimConfig
from motionloom.pipeline.contract.stage import stage_kinds

LAYOUT = MotionLayout.named("wholebody313", fps=20)
WINDOW = 64
UNIT = 5e-4
"""Metres of one step of the stored positions."""
CLIPS = 1600
"""Clips of a split that are looked at."""
ARMS = ("H2VQ", "RVQ, 3 levels", "RVQ, 3 levels, as many parameters")
HELD = (0.6, 1.4)
"""Seconds for which a hand has a shape, with the way there."""
FINGERS = {"left": (20, range(22, 37)), "right": (21, range(37, 52))}
"""Wrist and finger joints of each hand."""
FIGURES = ("mpjpe", "body", "hands", "world")


def whole_bodies(shards: Path, split: str) -> Iterator[NDArray[np.int16]]:
    """Joints [T, 52, 3] in `UNIT`s of the clips that hold a window, with synthetic hands."""
    clips = ShardDataset.open(shards, split)
    rng = np.random.default_rng(7)
    for number in range(min(CLIPS, len(clips))):
        motion = clips.motion(number)
        if len(motion) < WINDOW:
            continue
        t = np.arange(len(motion)) / LAYOUT.fps
        fingers = [moving_hand(t, rng) for _ in FINGERS]
        joints = canonicalize(with_resting_hands(joints_of(motion, clips.layout), fingers))
        yield np.round(joints / UNIT).astype(np.int32).astype(np.int16)


def moving_hand(t: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Local finger rotations [T, 15, 3, 3] of a hand that goes from shape to shape."""
    made = np.zeros((len(t), 15, 3, 3))
    begin = -HELD[1]
    while begin < t[-1]:
        # The first shape is there when the clip begins; each way takes a third of a second.
        part = ease((t - begin) / 0.35)[:, None, None, None]
        shape = grip_hand(str(rng.choice(HANDS)), t, np.ones(len(t)), rng)
        made += part * (shape - made)
        begin += rng.uniform(*HELD)
    # Between two shapes the nearest rotation to their mean.
    return roma.special_procrustes(torch.from_numpy(made)).numpy()


def make(shards: Path, file: Path) -> None:
    """Write the joints of all clips as changes between frames, low and high bytes apart, to pack well."""
    arrays: dict[str, Any] = {}
    for split in ("train", "test"):
        clips = list(whole_bodies(shards, split))
        steps = np.diff(np.concatenate(clips), axis=0, prepend=np.int16(0))
        arrays[f"{split}_frames"] = [len(clip) for clip in clips]
        arrays[f"{split}_bytes"] = np.moveaxis(steps.view(np.uint8).reshape(*steps.shape, 2), -1, 0)
    np.savez_compressed(file, **arrays)


def read(file: Path, split: str) -> list[NDArray[np.float32]]:
    """Features [T, 313] of each clip."""
    with np.load(file, allow_pickle=False) as arrays:
        frames = arrays[f"{split}_frames"]
        planes = arrays[f"{split}_bytes"]
    steps = np.ascontiguousarray(np.moveaxis(planes, 0, -1)).view(np.int16)[..., 0]
    joints = np.cumsum(steps, axis=0, dtype=np.int16) * UNIT
    return [encode(clip, LAYOUT) for clip in np.split(joints, np.cumsum(frames)[:-1])]


class Data:
    """Clips on the device, and how a reconstruction of the test windows is measured."""

    def __init__(self, file: Path, device: torch.device) -> None:
        train, test = (read(file, split) for split in ("train", "test"))
        moments = Moments.none(LAYOUT.dim)
        for clip in train:
            moments = moments.merge(Moments.of(clip))
        stats = from_moments(moments, LAYOUT, group=True)
        self.lengths = np.array([len(clip) for clip in train])
        self.mean, self.std = (torch.from_numpy(a).to(device) for a in (stats.mean, stats.std))
        self.frames = torch.from_numpy(stats.normalize(np.concatenate(train))).to(device)
        windows = [clip[i : i + WINDOW] for clip in test for i in range(0, len(clip) - WINDOW + 1, WINDOW)]
        self.test = torch.from_numpy(stats.normalize(np.stack(windows))).to(device)
        self.truth = self.joints(self.test)
        self.steps = torch.arange(WINDOW, device=device)

    def joints(self, motion: Tensor) -> Tensor:
        """Joints [W, T, 52, 3] in metres of normalised windows [W, T, 313]."""
        return torch_joints_of(motion * self.std + self.mean, LAYOUT)

    def starts(self, seed: int, steps: int, batch: int) -> Tensor:
        """First frames [steps, batch] of windows of random clips."""
        rng = np.random.default_rng(seed)
        clips = rng.integers(len(self.lengths), size=(steps, batch))
        first = np.concatenate([[0], np.cumsum(self.lengths)[:-1]])[clips]
        within = rng.integers(0, self.lengths[clips] - WINDOW + 1)
        return torch.from_numpy(first + within).to(self.frames.device)

    def errors(self, motion: Tensor) -> dict[str, float]:
        """Errors in mm: of all joints and of the body from the root, of fingers from their wrists, with the
        path."""
        made = self.joints(motion)
        true = self.truth
        hands = [
            mpjpe(*(x[:, :, [wrist, *joints]] for x in (made, true))).mean().item() * 16 / 15
            for wrist, joints in FINGERS.values()
        ]
        return {
            "mpjpe": mpjpe(made, true).mean().item(),
            "body": mpjpe(*(x[:, :, :BODY_JOINTS] for x in (made, true))).mean().item(),
            "hands": statistics.mean(hands),
            "world": mpjpe(made, true, root=None).mean().item(),
        }

    def nearest(self) -> Tensor:
        """The training window nearest to each test window by its joints from the root, of every eighth."""
        columns = torch.arange(LAYOUT.dim, device=self.std.device)[LAYOUT.slice("positions")]
        ends = np.cumsum(self.lengths)
        starts = np.concatenate(
            [np.arange(end - n, end - WINDOW + 1, 8) for end, n in zip(ends, self.lengths, strict=True)]
        )
        at = torch.from_numpy(starts).to(self.std.device)
        seen = self.steps[::8]

        def flat(windows: Tensor) -> Tensor:
            return (windows * self.std[columns]).flatten(1)

        pool = flat(self.frames[:, columns][at[:, None] + seen])
        chosen = torch.cdist(flat(self.test[:, ::8, columns]), pool).argmin(1)
        return self.frames[at[chosen][:, None] + self.steps]


class Training:
    """One tokenizer of one seed, whose step is a CUDA graph on a GPU."""

    def __init__(self, arm: str, seed: int, data: Data, args: argparse.Namespace) -> None:
        self.arm = arm
        self.seed = seed
        self.data = data
        self.args = args
        sizes = {"width": args.width, "depth": args.depth, "code_dim": args.width, "reset_below": 0.05}
        torch.manual_seed(seed)
        net = (H2VQConfig(**sizes) if arm == "H2VQ" else rvq(arm, sizes)).build(LAYOUT)
        self.parameters = parameters_of(net)
        self.bits = net.bits_per_second
        optim = OptimConfig(lr=args.lr, warmup_steps=100)
        self.device = data.frames.device
        self.module = TokenizerModule(net, optim, seed=seed, max_steps=args.steps).to(self.device).train()
        self.optimizer = optim.build(list(net.parameters()))
        self.starts = data.starts(seed, args.steps, args.batch)
        rates = [args.lr * optim.factor(step, args.steps) for step in range(args.steps)]
        self.rates = torch.tensor(rates, device=self.device)
        self.count = torch.zeros(1, dtype=torch.int64, device=self.device)
        self.rate = torch.zeros((), device=self.device)
        for group in self.optimizer.param_groups:
            group |= {"lr": self.rate, "capturable": self.device.type == "cuda"}
        self.length = torch.full((args.batch,), WINDOW, device=self.device)
        self.graph: torch.cuda.CUDAGraph | None = None
        self.stream = torch.cuda.Stream() if self.device.type == "cuda" else None

    def eager(self) -> None:
        """Take a step; all that changes from step to step is read on the device."""
        self.rate.copy_(self.rates.index_select(0, self.count)[0])
        starts = self.starts.index_select(0, self.count)[0]
        window = self.data.frames[starts[:, None] + self.data.steps]
        self.count.add_(1)
        half = self.device.type == "cuda"
        with torch.autocast("cuda", torch.bfloat16, cache_enabled=False) if half else nullcontext():
            loss = self.module.losses({"motion": window, "length": self.length, "full": True})["loss"]
        loss.backward()
        self.module.clip(list(self.module.net.parameters()), self.module.optim_config.grad_clip)
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)

    def capture(self) -> None:
        """Record the step as a graph, after a few that allocate what it needs."""
        with torch.cuda.stream(self.stream):
            for _ in range(3):
                self.eager()
        torch.cuda.synchronize()
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, stream=self.stream):
            self.eager()
        self.graph = graph

    def step(self) -> None:
        if self.graph is None:
            return self.eager()
        with torch.cuda.stream(self.stream):
            self.graph.replay()

    @torch.no_grad()
    def measure(self, seconds: float) -> None:
        """Append the errors of the test windows to the rows."""
        net = self.module.net.eval()
        made = torch.cat([net.decode(net.encode(part)) for part in self.data.test.split(256)])
        net.train()
        row = {"arm": self.arm, "seed": self.seed, "step": int(self.count), **self.data.errors(made)}
        facts = {"parameters": self.parameters, "bits": self.bits, "seconds": seconds}
        write(self.args, row | facts)


def rvq(arm: str, sizes: dict[str, Any]) -> RvqConfig:
    """RVQ of three levels; wider convolutions give it as many parameters as H2VQ has."""
    plain = RvqConfig(levels=3, **sizes)
    if arm == ARMS[1]:
        return plain
    wanted = parameters_of(H2VQConfig(**sizes).build(LAYOUT))
    widths = (plain.model_copy(update={"width": w}) for w in range(plain.width, 2 * plain.width, 4))
    return min(widths, key=lambda config: abs(parameters_of(config.build(LAYOUT)) - wanted))


def parameters_of(net: torch.nn.Module) -> int:
    return sum(parameter.numel() for parameter in net.parameters())


def write(args: argparse.Namespace, row: dict[str, Any]) -> None:
    """Append a row, with what was asked for."""
    asked = {key: getattr(args, key) for key in ("batch", "width", "depth", "lr")}
    device = torch.cuda.get_device_name() if args.device == "cuda" else "CPU"
    with (args.work / "rows.jsonl").open("a", encoding="utf-8") as file:
        file.write(json.dumps(row | asked | {"device": device}) + "\n")
    print(json.dumps(row), flush=True)


def marks_of(args: argparse.Namespace) -> list[int]:
    """Steps after which the test windows are measured."""
    return [args.steps // 4, args.steps // 2, args.steps]


def train(args: argparse.Namespace) -> None:
    """Train the seeds that have not finished, until the steps or the minutes are over."""
    begin = time.monotonic()
    args.work.mkdir(parents=True, exist_ok=True)
    data = Data(args.file, torch.device(args.device))
    done = read_rows(args)
    if not done:
        for title, motion in (("nearest training window", data.nearest()), ("mean pose", 0 * data.test)):
            write(args, {"arm": title, "seed": 0, "step": 0, **data.errors(motion)})
    seeds = [seed for seed in args.seeds if any((arm, args.steps, seed) not in done for arm in ARMS)]
    # Streams of a GPU overlap; on a CPU a seed after the other can be gone on with.
    for group in [seeds] if args.device == "cuda" else [[seed] for seed in seeds]:
        train_group([Training(arm, seed, data, args) for seed in group for arm in ARMS], begin, args)


def train_group(trainings: list[Training], begin: float, args: argparse.Namespace) -> None:
    """Train side by side, and measure at the marks."""
    for training in trainings if args.device == "cuda" else []:
        training.capture()
    for step in range(int(trainings[0].count), args.steps) if trainings else []:
        for training in trainings:
            training.step()
        if args.device == "cuda" and step % 20 == 19:
            torch.cuda.synchronize()
        over = time.monotonic() - begin > 60 * args.minutes
        if over or step + 1 in marks_of(args):
            for training in trainings:
                training.measure(time.monotonic() - begin)
        if over:
            return


def read_rows(args: argparse.Namespace) -> dict[tuple[str, int, int], dict[str, Any]]:
    """Return the measured rows by (arm, step, seed); of a seed that was begun twice, the later."""
    path = args.work / "rows.jsonl"
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    rows = [json.loads(line) for line in lines]
    return {(row["arm"], row["step"], row["seed"]): row for row in rows}


def table(args: argparse.Namespace) -> None:
    """Print the figures at the last mark that all trainings reached, and the course of MPJPE."""
    found: dict[str, dict[int, list[dict[str, Any]]]] = defaultdict(lambda: defaultdict(list))
    for (arm, step, _), row in sorted(read_rows(args).items()):
        found[arm][step].append(row)
    steps = sorted({step for arm in ARMS for step in found[arm]})
    marks = [step for step in steps if len({len(found[arm][step]) for arm in ARMS}) == 1]
    rows = []
    for arm in [*(arm for arm in found if arm not in ARMS), *ARMS]:
        at = found[arm]
        last = at.get(marks[-1]) or at[0]
        cells = {figure: [row[figure] for row in last] for figure in FIGURES}
        courses = {m: at.get(m, last) for m in marks if m in at or m == marks[-1]}
        cells |= {f"mpjpe@{m}": [row["mpjpe"] for row in of_mark] for m, of_mark in courses.items()}
        out: dict[str, Any] = {"title": arm, "cells": cells}
        if arm in ARMS:
            cells |= {"bits": [last[0]["bits"]], "parameters": [last[0]["parameters"]]}
            kind = "h2vq" if arm == "H2VQ" else "rvq"
            out |= {"seeds": [row["seed"] for row in last], "code": {kind: stage_kinds()[kind].version}}
            out["protocol"] = {key: last[0][key] for key in ("width", "depth", "batch", "lr", "device")}
        rows.append(out)
    columns = [Column("bit/s", "bits", 0), Column("million parameters", "parameters", 2, 1e-6)]
    columns += [Column(f"MPJPE after {m:,} steps, mm", f"mpjpe@{m}") for m in marks]
    columns += [Column(title, title) for title in FIGURES[1:]]
    report(f"H2VQ and RVQ, {marks[-1]:,} steps", columns, rows, args.record)


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--shards", type=Path, help="make the file of these clips, if it is missing")
    parser.add_argument("--minutes", type=float, default=60.0, help="training ends after so many")
    device = "cuda" if torch.cuda.is_available() else "cpu"
    parser.add_argument("--device", choices=("cuda", "cpu"), default=device)
    parser.add_argument("--steps", type=int, default=10_000, help="0 prints the table of what was measured")
    for name, value in (("--batch", 64), ("--width", 256), ("--depth", 2)):
        parser.add_argument(name, type=int, default=value)
    parser.add_argument("--lr", type=float, default=4e-4)
    parser.add_argument("--seeds", type=int, nargs="+", default=[7, 8, 9])
    args = arguments(parser)
    if args.shards is not None and not args.file.is_file():
        make(args.shards, args.file)
    if args.steps:
        train(args)
    table(args)


if __name__ == "__main__":
    main()
