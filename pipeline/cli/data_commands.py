"""What the `data` commands do, as functions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from motionloom.datasets.check.dataset import examine
from motionloom.datasets.check.files import FILE_SUFFIXES, FileRules, check_file, check_folder
from motionloom.datasets.convert.common.conversion import run_conversion
from motionloom.datasets.convert.common.plan import ConversionPlan
from motionloom.datasets.convert.table import converter_named
from motionloom.datasets.loading.statistics import compute
from motionloom.datasets.schema import Manifest, UserError
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.synth.generate import SynthConfig, synthesize
from motionloom.pipeline.render.labels import label
from motionloom.pipeline.store.files import require_file_place, require_folder


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
        f"{manifest.fps:g} fps, {', '.join(manifest.licences) or manifest.licence}"
    )


def synth_command(fields: dict[str, Any], out: Path, *, workers: int, console: Console) -> None:
    """Write synthetic clips."""
    config = SynthConfig.parse(fields, "data synth")
    require_folder(out)
    say_manifest(synthesize(config, out, workers=workers), out, console)


def convert_command(
    kind: str,
    fields: dict[str, Any],
    out: Path,
    *,
    plan: bool,
    strict: bool,
    workers: int,
    clips_per_shard: int,
    cluster: list[str] | None,
    wait: bool,
    console: Console,
) -> None:
    """Plan a conversion, run it here, or hand it to SLURM."""
    converter = converter_named(kind)
    config = converter.config().parse(fields, f"data convert {kind}")
    shown = console.is_terminal
    if plan:
        conversion = converter.prepare(config, workers=workers, progress=shown)
        say_plan(conversion.estimated(workers), console)
        return
    if cluster:
        from motionloom.pipeline.launch.slurm_convert import ClusterConfig, submit_conversion, wait_for

        submission = submit_conversion(
            kind,
            config.model_dump(),
            out,
            cluster=ClusterConfig.from_words(cluster),
            strict=strict,
            clips_per_shard=clips_per_shard,
            console=console,
        )
        if wait:
            say_manifest(wait_for(submission, console), out, console)
        return
    require_folder(out)
    conversion = converter.prepare(config, out=out, workers=workers, progress=shown)
    manifest = run_conversion(
        conversion, out, workers=workers, strict=strict, clips_per_shard=clips_per_shard, progress=shown
    )
    say_manifest(manifest, out, console)
    if conversion.plan.captions:
        _say(console, conversion.plan.captions)


def say_plan(plan: ConversionPlan[Any], console: Console) -> None:
    """The plan, per subset beside the official release where the source has subsets."""
    subsets = plan.subset_table()
    if subsets is not None:
        console.print(subsets)
    console.print(plan.table())


def check_command(path: Path, rules: dict[str, Any], *, strict: bool, console: Console) -> int:
    """Check a dataset, a file or a folder of files; prints all there is to say, returns the problems."""
    if not path.exists():
        raise UserError(f"{path}: no such folder or file")
    files = path.is_file() or _holds_files(path)
    of_files = [f"--{name}" for name, value in rules.items() if value not in (None, "auto")]
    if of_files and not files:
        raise UserError(
            f"{path}: {', '.join(of_files)} is for single files; a data set says this in its manifest.json; "
            f"leave it out"
        )
    count, warned = _check_files(path, rules, console) if files else _check_dataset(path, console)
    if strict:
        count += warned
    console.print(f"{path}: {count} problems" if count else f"{path}: no problems", markup=False)
    return count


def _holds_files(folder: Path) -> bool:
    """Whether a folder is no dataset, finished or not, but holds files that can be checked one by one."""
    if (folder / "manifest.json").exists() or any(folder.glob("*.index.json")):
        return False
    return any(path.suffix.lower() in FILE_SUFFIXES for path in folder.rglob("*"))


def _check_dataset(root: Path, console: Console) -> tuple[int, int]:
    report = examine(root, progress=console.is_terminal)
    for warning in report.warnings:
        _say(console, f"warning: {warning}")
    for problem in report.errors:
        _say(console, str(problem))
    if report.warning_kinds:
        told = ", ".join(f"{count} {kind}" for kind, count in sorted(report.warning_kinds.items()))
        _say(console, f"{root}: warnings: {told}")
    return sum(report.error_kinds.values()), sum(report.warning_kinds.values())


def _check_files(path: Path, given: dict[str, Any], console: Console) -> tuple[int, int]:
    rules = FileRules(**given)
    bad = warned = 0
    for verdict in [check_file(path, rules)] if path.is_file() else check_folder(path, rules):
        _say(console, str(verdict))
        for note in verdict.notes:
            _say(console, f"{verdict.path}: note: {note}")
        bad += not verdict.ok
        warned += bool(verdict.ok and verdict.notes)
    return bad, warned


def _say(console: Console, text: str) -> None:
    """Print text from a stranger's file: one line, and no control characters for the terminal to obey."""
    shown = "".join(c if c.isprintable() else f"\\x{ord(c):02x}" for c in text)
    console.print(shown, markup=False, highlight=False, soft_wrap=True)


def report_command(root: Path, out: Path | None, *, check: bool, clips: int, console: Console) -> None:
    """Write the page about a data set."""
    from motionloom.pipeline.data_page.page import write_data_report  # drawing is imported when it is needed

    path = out or root / "report.html"
    require_file_place(path)
    write_data_report(root, path, check=check, clips=clips, progress=console.is_terminal)
    console.print(str(path), markup=False, soft_wrap=True)


def stats_command(root: Path, *, group: bool, out: Path | None, console: Console) -> None:
    """Describe a data set."""
    manifest = Manifest.load_json(root / "manifest.json")
    if out is not None:
        require_file_place(out)
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
        table.add_row(label(name), str(size), f"{mean:.4f}", f"{std.mean():.4f}", f"{std.max():.4f}")
    console.print(table)
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        stats.save(out)
        console.print(str(out))
