"""What the `data` commands do, as functions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from motionloom.datasets.convert.bvh import BvhConfig, convert_bvh, plan_bvh
from motionloom.datasets.schema import Manifest, UserError
from motionloom.datasets.shards.check import check
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.shards.statistics import compute


def say_manifest(manifest: Manifest, out: Path, console: Console) -> None:
    """Counts per split, what was dropped, where it lies."""
    table = Table("split", "shards", "clips", "minutes", "MiB")
    for split in ("train", "val", "test"):
        shards = [s for s in manifest.shards if s.split == split]
        if shards:
            minutes = sum(s.frames for s in shards) / manifest.fps / 60
            size = sum(s.bytes for s in shards) / 2**20
            table.add_row(
                split, str(len(shards)), str(sum(s.samples for s in shards)), f"{minutes:.1f}", f"{size:.1f}"
            )
    console.print(table)
    for dropped in manifest.dropped[:20]:
        console.print(f"dropped {dropped.source}: {dropped.reason}")
    if len(manifest.dropped) > 20:
        console.print(f"… and {len(manifest.dropped) - 20} more, all in {out / 'manifest.json'}")
    console.print(
        f"{out / 'manifest.json'}: layout {manifest.layout} ({manifest.family}), "
        f"{manifest.fps:g} fps, {manifest.licence}"
    )


def convert_bvh_command(
    fields: dict[str, Any], out: Path, *, plan: bool, strict: bool, workers: int, console: Console
) -> None:
    """Plan or convert."""
    config = BvhConfig.parse(fields, "data convert bvh")
    if plan:
        console.print(plan_bvh(config, workers=workers, progress=console.is_terminal).table())
        return
    say_manifest(convert_bvh(config, out, workers=workers, strict=strict), out, console)


def check_command(root: Path, console: Console) -> int:
    """Print every problem; returns their number."""
    if not root.is_dir():
        raise UserError(f"{root}: no such folder")
    problems = check(root)
    for problem in problems:
        console.print(str(problem), markup=False)
    console.print(f"{root}: {len(problems)} problems" if problems else f"{root}: no problems")
    return len(problems)


def stats_command(root: Path, *, group: bool, out: Path | None, console: Console) -> None:
    """Describe a data set."""
    manifest = Manifest.load_json(root / "manifest.json")
    say_manifest(manifest, root, console)
    dataset = ShardDataset.open(root, "train")
    lengths = np.asarray(dataset.frames) / dataset.layout.fps
    low, middle, high = np.percentile(lengths, [5, 50, 95])
    console.print(f"clip length: median {middle:.1f} s, 5 % below {low:.1f} s, 5 % above {high:.1f} s")
    stats = compute(dataset, group=group)
    table = Table("feature", "dims", "mean |mean|", "mean deviation", "largest deviation")
    for name, size in dataset.layout.fields:
        columns = dataset.layout.slice(name)
        mean, std = np.abs(stats.mean[columns]).mean(), stats.std[columns]
        table.add_row(name, str(size), f"{mean:.4f}", f"{std.mean():.4f}", f"{std.max():.4f}")
    console.print(table)
    if out is not None:
        stats.save(out)
        console.print(str(out))
