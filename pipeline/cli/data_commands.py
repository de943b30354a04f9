"""What the `data` commands do, as functions."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from motionloom.datasets.schema import Dropped, Manifest, UserError
from motionloom.datasets.shards.left_out import LEFT_OUT_FILE, grouped, tally
from motionloom.pipeline.cli.json_output import plain, print_json
from motionloom.pipeline.render.labels import label
from motionloom.pipeline.store.files import require_file_place, require_folder

if TYPE_CHECKING:
    from motionloom.datasets.convert.common.plan import ConversionPlan
    from motionloom.datasets.motion.joint_guess.result import JointGuess

_ALIKE = 5
"""Findings that say the same and are still listed one by one."""

_REASONS = 12
"""Reasons for clips that were left out, a line each; the file has every clip."""


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
    say_left_out(manifest, out, console)
    console.print(
        f"{out / 'manifest.json'}: layout {manifest.layout} ({manifest.family}), "
        f"{manifest.fps:g} fps, {', '.join(manifest.licences) or manifest.licence}",
        markup=False,
    )


def say_left_out(manifest: Manifest, out: Path, console: Console) -> None:
    """How much was left out, a line for each reason, and where the whole list is."""
    if not manifest.dropped:
        return
    from motionloom.datasets.shards.index import MANIFEST_FILE

    listed = out / LEFT_OUT_FILE
    place = listed if listed.exists() else out / MANIFEST_FILE
    console.print(f"left out: {tally(manifest.dropped)}; all in {place}", markup=False, soft_wrap=True)
    groups = grouped(manifest.dropped)
    for group in groups[:_REASONS]:
        _say(console, f"  {group}")
    if len(groups) > _REASONS:
        console.print(f"  … and {len(groups) - _REASONS} more reasons")


def synth_command(fields: dict[str, Any], out: Path, *, workers: int, console: Console) -> None:
    """Write synthetic clips."""
    from motionloom.datasets.synth.generate import SynthConfig, synthesize

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
    started: float | None = None,
    as_json: bool = False,
) -> None:
    """Plan a conversion, run it here, or hand it to SLURM.

    `started` is when the command began (`time.perf_counter()`), for the time that a plan estimates.
    """
    from motionloom.datasets.convert.common.conversion import run_conversion
    from motionloom.datasets.convert.table import converter_named

    started = time.perf_counter() if started is None else started
    converter = converter_named(kind)
    config = converter.config().parse(fields, f"data convert {kind}")
    shown = not console.quiet
    if plan:
        conversion = converter.prepare(config, maps=out, workers=workers, progress=shown).looked()
        planned = conversion.estimated(workers, started)
        if as_json:
            print_json(planned.dump())
        else:
            say_plan(planned, console)
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
    for note in conversion.plan.notes:
        _say(console, f"note: {note}")
    manifest = run_conversion(
        conversion,
        out,
        workers=workers,
        strict=strict,
        clips_per_shard=clips_per_shard,
        progress=shown,
        say=lambda line: _say(console, line),
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
    if plan.look is None:
        return
    console.print(plan.look.table())
    for line in plan.look.lines():
        _say(console, line)


def check_command(
    path: Path,
    rules: dict[str, Any],
    *,
    strict: bool,
    console: Console,
    every: bool = False,
    as_json: bool = False,
) -> int:
    """Check a dataset, a file or a folder of files; prints what there is to say, returns the problems.

    Many findings of a data set that say the same are one line, unless `every` one is asked for. With
    `as_json` what was found goes to standard output too, as JSON.
    """
    if not path.exists():
        raise UserError(f"{path}: no such folder or file")
    files = path.is_file() or _holds_files(path)
    of_files = [f"--{name}" for name, value in rules.items() if value not in (None, "auto")]
    if of_files and not files:
        raise UserError(
            f"{path}: {', '.join(of_files)} is for single files; a data set says this in its manifest.json; "
            f"leave it out"
        )
    check = _check_files(path, rules, console) if files else _check_dataset(path, every, console)
    count, warned, found = check
    if strict:
        count += warned
    console.print(f"{path}: {count} problems" if count else f"{path}: no problems", markup=False)
    if as_json:
        print_json({"path": path, "problems": count, **found})
    return count


def _holds_files(folder: Path) -> bool:
    """Whether a folder is no dataset, finished or not, but holds files that can be checked one by one."""
    from motionloom.datasets.check.files import FILE_SUFFIXES

    if (folder / "manifest.json").exists() or any(folder.glob("*.index.json")):
        return False
    return any(path.suffix.lower() in FILE_SUFFIXES for path in folder.rglob("*"))


def _check_dataset(root: Path, every: bool, console: Console) -> tuple[int, int, dict[str, Any]]:
    from motionloom.datasets.check.dataset import examine

    report = examine(root, progress=console.is_terminal)
    for title, problems in (("warning: ", report.warnings), ("", report.errors)):
        findings = [Dropped(source=problem.where, reason=problem.message) for problem in problems]
        for group in grouped(findings):
            if group.count > _ALIKE and not every:
                _say(console, f"{title}{group}; each of them: --all")
                continue
            for finding in group.members:
                _say(console, f"{title}{finding.source}: {finding.reason}")
    if report.warning_kinds:
        told = ", ".join(f"{count} {kind}" for kind, count in sorted(report.warning_kinds.items()))
        _say(console, f"{root}: warnings: {told}")
    return sum(report.error_kinds.values()), sum(report.warning_kinds.values()), plain(report)


def _check_files(path: Path, given: dict[str, Any], console: Console) -> tuple[int, int, dict[str, Any]]:
    from motionloom.datasets.check.files import FileRules, check_file, check_folder

    rules = FileRules(**given)
    bad, warned, found = 0, 0, []
    for verdict in [check_file(path, rules)] if path.is_file() else check_folder(path, rules):
        _say(console, str(verdict))
        for note in verdict.notes:
            _say(console, f"{verdict.path}: note: {note}")
        bad += not verdict.ok
        warned += bool(verdict.ok and verdict.notes)
        found.append({**plain(verdict), "ok": verdict.ok})
    return bad, warned, {"files": found}


def _say(console: Console, text: str) -> None:
    """Print text from a stranger's file: one line, and no control characters for the terminal to obey."""
    console.print(_printable(text), markup=False, highlight=False, soft_wrap=True)


def _printable(text: str) -> str:
    return "".join(c if c.isprintable() else f"\\x{ord(c):02x}" for c in text)


def joints_command(source: str, skeleton: str, out: Path | None, *, console: Console) -> None:
    """List the joints of a skeleton, or guess the joint map of a BVH file."""
    from motionloom.datasets.base.files import write_text
    from motionloom.datasets.convert.bvh.maps import guess_source
    from motionloom.datasets.motion.joint_map import map_text
    from motionloom.datasets.motion.skeleton import Skeleton

    if out is not None:
        require_file_place(out)
    if Path(source).exists():
        guess = guess_source(Path(source), Skeleton.named(skeleton))
        _show_guess(guess, console)
        text = guess.text()
    else:
        try:
            target = Skeleton.named(source)
        except UserError as error:
            raise UserError(f"{source}: no such file or folder, and {error}") from None
        table = Table("", "joint", "parent", title=target.name)
        for index, (joint, parent) in enumerate(zip(target.joints, target.parents, strict=True)):
            table.add_row(str(index), joint, target.joints[parent] if parent >= 0 else "")
        console.print(table)
        text = map_text(target, [None] * len(target), note="a joint map to be filled in")
    if out is not None:
        write_text(out, text)
        _say(console, str(out))


def _show_guess(guess: JointGuess, console: Console) -> None:
    table = Table("", guess.target.name, "stands for it", "found")
    for index, row in enumerate(guess.rows):
        names = " + ".join(row.sources) or " or ".join(row.candidates)
        cells = (str(index), row.joint, names if row.sources else f"{names}?", row.how)
        table.add_row(*(Text(_printable(cell)) for cell in cells))
    console.print(table)
    _say(console, f"{guess.source}: {guess.summary()}")
    if guess.unmapped:
        _say(console, f"stand for nothing: {', '.join(guess.unmapped)}")
    _say(console, "certain" if guess.certain else f"not certain: {guess.doubts()}")


def report_command(root: Path, out: Path | None, *, check: bool, clips: int, console: Console) -> None:
    """Write the page about a data set."""
    from motionloom.pipeline.data_page.page import write_data_report  # drawing is imported when it is needed

    path = out or root / "report.html"
    require_file_place(path)
    write_data_report(root, path, check=check, clips=clips, progress=console.is_terminal)
    console.print(str(path), markup=False, soft_wrap=True)


def stats_command(root: Path, *, group: bool, out: Path | None, console: Console) -> None:
    """Describe a data set."""
    import numpy as np

    from motionloom.datasets.loading.statistics import compute
    from motionloom.datasets.shards.reader import ShardDataset

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
        console.print(str(out), markup=False)
