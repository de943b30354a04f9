"""What a code of few numbers keeps of a frame, by the frame's coordinates (models/layers/basis.py).

    python benchmarks/principal_axes.py RUN        # a run with synthetic shards and their statistics

Frames are projected on the first principal components of the training split and back. The share of hand
shapes and actions that can still be read on test clips, and the error, say what a tokenizer with a plain loss
would spend its bits on.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from motionloom.datasets.motion.features.joints import joints_of
from motionloom.datasets.synth.measure import agrees
from motionloom.models.layers.basis import Basis
from motionloom.pipeline.contract.lookup import finished_stages
from motionloom.pipeline.contract.stage import StageCache
from motionloom.pipeline.evaluation.answers import local_joints
from motionloom.pipeline.evaluation.reconstruction import pose_errors
from motionloom.pipeline.evaluation.truth import truth_of

GAINS = {"the paper's features": (1.0, 0.0), "fingers in the palm's frame": (5.0, 4.0)}


def seen(basis: Basis, features: NDArray[np.float32], mean: NDArray, std: NDArray) -> NDArray[np.float32]:
    return np.asarray(basis.encode(torch.from_numpy((features - mean) / std)).numpy(), dtype=np.float32)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("--components", type=int, nargs="*", default=[16, 32, 48, 64, 96])
    parser.add_argument("--clips", type=int, default=100, help="test clips")
    args = parser.parse_args()
    stages, stage_cache = finished_stages(args.run), StageCache()
    train, test = (stage_cache.get(stages["data"]).split(split) for split in ("train", "test"))
    stats, layout = stage_cache.get(stages["stats"]), train.layout
    columns = train.layout.part("bodyhand")
    mean, std = stats.mean[columns], stats.std[columns]
    chosen = np.random.default_rng(0).permutation(len(train))[:1000]
    frames = [np.asarray(train.motion(int(i)), dtype=np.float32)[::6, columns] for i in chosen]
    truths = [truth_of(test, i) for i in range(min(args.clips, len(test)))]
    table = Table("features", "components", "hand shapes", "actions", "pose, mm", "fingers, mm")
    for title, (root, finger) in GAINS.items():
        basis = Basis(train.layout, columns, root_gain=root, finger_gain=finger)
        basis.learn(mean, std)
        sample = np.concatenate([seen(basis, x, mean, std) for x in frames])
        center = sample.mean(0)
        axes = np.linalg.svd(sample - center, full_matrices=False)[2]
        for count in args.components:
            found: dict[str, list[float]] = defaultdict(list)
            for truth in truths:
                few = (seen(basis, truth.features, mean, std) - center) @ axes[:count].T @ axes[:count]
                features = basis.decode(torch.from_numpy(few + center)).numpy() * std + mean
                right = agrees(truth.truth or {}, joints_of(features, layout), None, layout.fps)
                found["action"].append(right["action"])
                for name in ("left_hand", "right_hand"):
                    if (truth.truth or {})[name] != "relaxed":
                        found["shape"].append(right[name])
                real = torch.from_numpy(local_joints(truth.features, layout))
                for name, value in pose_errors(
                    torch.from_numpy(local_joints(features, layout)), real
                ).items():
                    found[name].append(float(value.mean()))
            rates = [f"{100 * np.mean(found[name]):.0f} %" for name in ("shape", "action")]
            errors = [f"{np.mean(found[name]):.1f}" for name in ("pose", "pose_hand")]
            table.add_row(title, str(count), *rates, *errors)
    Console().print(table)


if __name__ == "__main__":
    main()
