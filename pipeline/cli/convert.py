"""`motionloom data convert SOURCE-KIND …`: one command per converter, made from its config class.

Options say how to run. What to make of the source is `--set KEY=VALUE`, with the fields of the converter's
config for keys, and their docstrings for help: so the command line, a recipe's stage and the Python API can
never differ. The few fields of `config.everyday` have an option too. A converter is imported when asked for.
"""

from __future__ import annotations

import ast
import inspect
import json
import shlex
import typing
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from textwrap import dedent
from typing import Annotated, Any, Literal

import typer
from rich.console import Console
from rich.table import Table
from typer.core import TyperGroup
from typer.main import get_command

from motionloom.datasets.base.config import Config
from motionloom.datasets.base.errors import UserError, nearest
from motionloom.datasets.base.records import MANIFEST_FILE, Manifest
from motionloom.datasets.convert.registry import converter_named, names, prepare
from motionloom.datasets.shards.finish import join_parts
from motionloom.datasets.shards.left_out import LEFT_OUT_FILE, grouped, tally
from motionloom.datasets.shards.options import Part
from motionloom.datasets.shards.reader import load_manifest
from motionloom.datasets.shards.staging import staged
from motionloom.datasets.shards.store import RemoteStore
from motionloom.pipeline.cli.options import Commands, Workers, fields_of, set_option
from motionloom.pipeline.launch.console import make_console, say
from motionloom.pipeline.store.files import require_folder

if typing.TYPE_CHECKING:
    from motionloom.datasets.convert.common.config import ConvertConfig
    from motionloom.datasets.convert.common.plan import ConversionPlan

_REASONS = 12
"""Reasons for clips that were left out, a line each; the file has every clip."""

_RUN_OPTIONS: dict[str, tuple[object, object]] = {
    "plan": (
        Annotated[bool, typer.Option("--plan", help="Only list what would be done, and the disk it takes.")],
        False,
    ),
    "part": (
        Annotated[
            str | None,
            typer.Option("--part", metavar="K/N", help="Make only the K-th of N parts, on any machine."),
        ],
        None,
    ),
    "workers": (Workers, 2),
    "sets": (Annotated[list[str] | None, set_option("A setting, as listed above.")], None),
}


class ConverterGroup(TyperGroup):
    """The converters by name, each built when it is asked for."""

    def list_commands(self, ctx: Any) -> list[str]:
        return names()

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        return _command(cmd_name) if cmd_name in names() else None

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """The command that `args` name; a misspelt one is answered with the nearest."""
        if args and args[0] not in names() and not args[0].startswith("-"):
            raise UserError(f"data convert {args[0]}: no such source{nearest(args[0], list(names()))}")
        return super().resolve_command(ctx, args)


convert_app = typer.Typer(
    cls=ConverterGroup,
    help="Real motion capture to shards. Begin with --plan.",
    no_args_is_help=True,
    rich_markup_mode="markdown",
)


def _command(name: str) -> Any:
    """The command of a converter: its arguments, its everyday fields, and how to run it."""
    entry = converter_named(name)
    config = entry.config_class
    docs = field_docs(config)

    def run(source: Path, out: str, plan: bool, part: str | None, workers: int, sets: list[str] | None,
            **everyday: Any) -> None:  # fmt: skip
        settings = {key: value for key, value in everyday.items() if value is not None}
        settings |= fields_of(sets, "--set")
        fields = {**settings, "source": source}
        share = None if part is None else Part.parse(part)
        how: dict[str, Any] = {"plan": plan, "workers": workers, "console": make_console()}
        with staged(out) as (folder, store):
            if store is not None and not plan:
                share = share or Part(1, 1)
            convert_command(name, fields, folder, part=share, store=store, place=out, **how)
        if store is not None and not plan and part is None:
            say_manifest(join_parts(out), out, how["console"])

    parameters = [
        _parameter("source", Annotated[Path, typer.Argument(help=_help(config, "source", docs))]),
        _parameter("out", Annotated[str, typer.Argument(help="Folder for the shards, or s3://BUCKET/SET.")]),
    ]
    for key in config.everyday:
        option = typer.Option(_flag(key), help=_help(config, key, docs))
        kind: Any = config.model_fields[key].annotation
        kind = list[str] | None if typing.get_origin(kind) is tuple else kind  # given again for each
        parameters.append(_parameter(key, Annotated[kind, option], None))
    parameters += [_parameter(key, kind, default) for key, (kind, default) in _RUN_OPTIONS.items()]
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    listed = "\n".join(f"- `{key}`: {_help(config, key, docs)}" for key in _settings(config))
    run.__doc__ = (
        f"{entry.summary}\n\nExample: `motionloom data convert {name} {entry.example} --plan`\n\n"
        f"In eight parts: `motionloom data convert {name} … --part 1/8` to `--part 8/8`, in any order on "
        f"machines that see both folders, or one bucket; then "
        f"`motionloom data join {entry.example.split()[1]}`\n\n"
        f"Settings for `--set KEY=VALUE`:\n\n{listed}"
    )
    app = Commands(add_completion=False, rich_markup_mode="markdown")
    app.command(name)(run)
    return get_command(app)


def _parameter(name: str, annotation: object, default: object = inspect.Parameter.empty) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def _flag(key: str) -> str:
    """The option of an everyday field."""
    return f"--{key.replace('_', '-')}"


def _settings(config: type[ConvertConfig]) -> list[str]:
    """Fields without an argument or option of their own."""
    return [key for key in config.model_fields if key not in ("source", *config.everyday)]


def field_docs(config: type[ConvertConfig]) -> dict[str, str]:
    """The docstrings of a config's fields; a class that gives a field another default may leave its out.

    Read from the source where help is made: pydantic would read it whenever the class is imported.
    """
    docs = {}
    for base in reversed(config.__mro__):
        if not issubclass(base, Config):
            continue
        body = ast.parse(dedent(inspect.getsource(base))).body[0]
        for field, text in pairwise(getattr(body, "body", ())):
            value = getattr(getattr(text, "value", None), "value", None)
            if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr) and isinstance(value, str):
                docs[ast.unparse(field.target)] = " ".join(value.split())
    return docs


def _help(config: type[ConvertConfig], key: str, docs: Mapping[str, str]) -> str:
    """The field's docstring, with the words that it takes and its default."""
    field = config.model_fields[key]
    text = docs.get(key, "")
    if choices := _choices(field.annotation):
        text += f" One of: {', '.join(choices)}."
    default = field.get_default(call_default_factory=True)
    shown = f" Default: {_yaml(default)}." if default not in (None, "", ()) else ""
    return text if field.is_required() else text + shown


def _choices(annotation: object) -> list[str]:
    """The words of a field that takes one of several; none where it takes any path as well."""
    if typing.get_origin(annotation) is Literal:
        return [str(value) for value in typing.get_args(annotation)]
    if Path in typing.get_args(annotation):
        return []
    return [word for part in typing.get_args(annotation) for word in _choices(part)]


def _yaml(value: object) -> str:
    """A setting as `--set` reads it."""
    from motionloom.pipeline.store.yaml import load_yaml

    if isinstance(value, tuple):
        return f"[{','.join(map(_yaml, value))}]"
    if isinstance(value, bool | int | float):
        return json.dumps(value)
    text = str(value)
    return text if load_yaml(text, "a setting") == text else json.dumps(text)


def convert_command(
    kind: str,
    fields: dict[str, object],
    out: Path,
    *,
    plan: bool,
    part: Part | None = None,
    workers: int,
    console: Console,
    store: RemoteStore | None = None,
    place: str = "",
) -> None:
    """Plan a conversion, or run it; `out` may stand for the bucket `store` at `place`."""
    from motionloom.datasets.convert.common.conversion import run_conversion
    from motionloom.datasets.convert.repeat import is_finished, note_finished, state_of_source

    converter = converter_named(kind)
    config = converter.config_class.parse(fields, f"data convert {kind}")
    shown = not console.quiet
    if plan:
        conversion = prepare(config, kind=converter, out=out, workers=workers, progress=shown).looked()
        planned = conversion.plan
        licensed = bool(conversion.converter.licence(planned))
        line = proposed(kind, config, place or out, planned, licensed=licensed) if planned.items else ""
        line += f" --part {part}" if part and line else ""
        _say_plan(planned, console)
        if conversion.moved:
            say(console, conversion.moved)
        if part:
            share = conversion.share(part)
            say(console, f"part {part}: {share['shards']:,} shards, {share['clips']:,} clips")
        say(console, f"convert it: {line}" if line else "nothing of it can be converted")
        return
    require_folder(out)
    read = "" if part or store else state_of_source(converter, config, out)
    if read and is_finished(out, read):
        manifest = load_manifest(out)
        say_manifest(manifest, out, console)
        say(console, f"{out}: finished already, {len(manifest.shards):,} shards; nothing has changed")
        return
    conversion = prepare(config, kind=converter, out=out, workers=workers, progress=shown, write=True)
    for note in conversion.plan.notes:
        say(console, f"note: {note}")
    try:
        manifest = run_conversion(
            conversion, out, workers=workers, progress=shown, part=part, store=store,
            say=lambda line: say(console, line.replace(str(out), place or str(out))),
        )  # fmt: skip
    finally:  # of what became of all, in a conversion of which too much was lost, too
        for line in conversion.plan.sums:
            say(console, line)
    if part is not None:
        clips = sum(shard.samples for shard in manifest.shards)
        say(
            console,
            f"part {part} is made: {len(manifest.shards):,} shards, {clips:,} clips; when all parts are: "
            f"{shlex.join(['motionloom', 'data', 'join', place or str(out)])}",
        )
        return
    say_manifest(manifest, out, console)
    for note in manifest.notes:
        if note not in conversion.plan.notes:  # said before
            say(console, f"note: {note}")
    if read:
        note_finished(out, read)


def proposed(
    kind: str, config: ConvertConfig, out: Path | str, plan: ConversionPlan[Any], *, licensed: bool
) -> str:
    """The command that converts what was planned: the settings given, and what else the plan found needed."""
    # Whatever would stop the conversion is decided here in the careful way, for the user to see and change.
    changes: dict[str, object] = {} if licensed else {"licence": "unknown"}
    if plan.stop:
        changes["uncaptioned"] = "drop"
    lost = len(plan.rejected) + len(plan.broken)
    if lost > config.most_rejected * (lost + len(plan.items)):
        changes["most_rejected"] = 1
    if plan.look is not None and plan.look.problems:
        tried = plan.look.suggestions
        helps = tried and all(one.option in ("unit", "up") for one in tried)
        changes.update({one.option: one.value for one in tried} if helps else {"look": 0})
    words = ["motionloom", "data", "convert", kind, str(config.source), str(out)]
    for key, field in type(config).model_fields.items():
        value = changes.get(key, getattr(config, key))
        if key == "source" or value is None or value == field.get_default(call_default_factory=True):
            continue
        if key in config.everyday:
            for one in value if isinstance(value, tuple) else (value,):
                words += [_flag(key), str(one)]
        else:
            words += ["--set", f"{key}={_yaml(value)}"]
    return shlex.join(words)


def _say_plan(plan: ConversionPlan[Any], console: Console) -> None:
    """Print the plan, and what a few clips showed."""
    console.print(plan.table())
    if plan.look is None:
        return
    console.print(plan.look.table())
    for line in plan.look.lines():
        say(console, line)


def say_manifest(manifest: Manifest, out: Path | str, console: Console) -> None:
    """Print the counts per split, what was dropped, and where the manifest is."""
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
    _say_left_out(manifest, out, console)
    say(
        console,
        f"{out}/{MANIFEST_FILE}: layout {manifest.layout} ({manifest.family}), "
        f"{manifest.fps:g} fps, {', '.join(manifest.licences) or manifest.licence}",
    )


def _say_left_out(manifest: Manifest, out: Path | str, console: Console) -> None:
    """Print how much was left out, a line for each reason, and where the whole list is."""
    if not manifest.dropped:
        return
    is_listed = isinstance(out, str) or (out / LEFT_OUT_FILE).exists()
    place = f"{out}/{LEFT_OUT_FILE if is_listed else MANIFEST_FILE}"
    console.print(f"left out: {tally(manifest.dropped)}; all in {place}", markup=False, soft_wrap=True)
    groups = grouped(manifest.dropped)
    for group in groups[:_REASONS]:
        say(console, f"  {group}")
    if len(groups) > _REASONS:
        console.print(f"  … and {len(groups) - _REASONS} more reasons")
