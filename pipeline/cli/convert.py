"""`motionloom data convert SOURCE-KIND …`: one command per converter, made from its config class.

The options of a command are the fields of the converter's config that are used every day (`_EVERYDAY`), and
their docstrings are the help; `--set KEY=VALUE` sets any other, which the help lists. So the command line, a
recipe's stage and the Python API can never differ. A converter is imported when asked for.
"""

from __future__ import annotations

import inspect
import shlex
import time
import types
import typing
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from pydantic.fields import FieldInfo
from rich.console import Console
from rich.table import Table
from typer.core import TyperGroup
from typer.main import get_command

from motionloom.datasets.base.printable import printable
from motionloom.datasets.convert.registry import converter_named, names
from motionloom.datasets.schema import MANIFEST_FILE, Config, Manifest, UserError
from motionloom.datasets.shards.left_out import LEFT_OUT_FILE, grouped, tally
from motionloom.pipeline.cli.options import AsJson, fields_of, print_json
from motionloom.pipeline.launch.console import make_console
from motionloom.pipeline.store.files import require_folder

if typing.TYPE_CHECKING:
    from motionloom.datasets.convert.common.config import ConvertConfig
    from motionloom.datasets.convert.common.plan import ConversionPlan

_REASONS = 12
"""Reasons for clips that were left out, a line each; the file has every clip."""

_EVERYDAY = (
    "layout", "fps", "licence", "limit", "use", "subsets", "captions", "splits", "uncaptioned", "joint_map",
    "unit", "up", "music", "body_model", "humanml_index", "humanml_texts", "where", "sound", "tasks",
    "variant",
)  # fmt: skip
"""Fields with an option of their own, where a converter has them."""

_RUN_OPTIONS: dict[str, tuple[object, object]] = {
    "plan": (
        Annotated[bool, typer.Option("--plan", help="Only list what would be done, with disk and time.")],
        False,
    ),
    "strict": (
        Annotated[bool, typer.Option("--strict", help="Stop when a clip is missing or cannot be read.")],
        False,
    ),
    "workers": (
        Annotated[int, typer.Option(help="Processes; the shards are the same bytes for any number.")],
        2,
    ),
    "clips_per_shard": (Annotated[int, typer.Option(help="Clips in one tar file.")], 256),
    "sets": (
        Annotated[
            list[str] | None,
            typer.Option("--set", "-s", metavar="KEY=VALUE", help="Any other setting, as below."),
        ],
        None,
    ),
    "as_json": (AsJson, False),
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
            from motionloom.pipeline.runs.resolve import nearest

            raise UserError(f"data convert {args[0]}: no such source{nearest(args[0], list(names()))}")
        return super().resolve_command(ctx, args)


convert_app = typer.Typer(
    cls=ConverterGroup,
    help="Real motion capture to shards. Begin with --plan.",
    no_args_is_help=True,
    rich_markup_mode="markdown",
)


@convert_app.callback()
def _convert() -> None:
    """Real motion capture to shards. Begin with --plan."""


def _command(name: str) -> Any:
    entry = converter_named(name)
    config = entry.config_class
    fields = {
        key: field
        for key, field in config.model_fields.items()
        if key != "source" and (key in _EVERYDAY or field.is_required())
    }

    def run(source: Path, out: Path, **values: Any) -> None:
        started = time.perf_counter()  # the imports are the larger part of a short conversion
        steering = {key: values.pop(key) for key in _RUN_OPTIONS}
        given = {key: _plain(fields[key], value) for key, value in values.items()}
        given |= fields_of(steering.pop("sets"), "--set")
        if steering["as_json"] and not steering["plan"]:
            raise UserError("--json is for the plan: give --plan too")
        console = make_console(aside=steering["as_json"])
        fields_given = {"source": source, **given}
        convert_command(name, fields_given, out, console=console, started=started, **steering)

    parameters = [
        _parameter("source", Annotated[Path, typer.Argument(help=_help(config, "source"))]),
        _parameter("out", Annotated[Path, typer.Argument(help="Folder for the shards.")]),
        *(_option(key, field) for key, field in fields.items()),
        *(_parameter(key, kind, default) for key, (kind, default) in _RUN_OPTIONS.items()),
    ]
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    run.__doc__ = f"{entry.summary}\n\nExample: `motionloom data convert {name} {entry.example} --plan`"
    others = [key for key in config.model_fields if key != "source" and key not in fields]
    if others:
        listed = "\n".join(f"- `{key}`: {_help(config, key)}" for key in others)
        run.__doc__ += f"\n\nBy `--set KEY=VALUE`:\n\n{listed}"
    app = typer.Typer(add_completion=False, rich_markup_mode="markdown")
    app.command(name)(run)
    return get_command(app)


def _parameter(name: str, annotation: object, default: object = inspect.Parameter.empty) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def _option(key: str, field: FieldInfo) -> inspect.Parameter:
    """A command line option for one field: its type, default and docstring."""
    kind, name = _simple(field.annotation), key.replace("_", "-")
    text = " ".join((field.description or "").split())
    choices = _choices(field.annotation)
    if choices:
        text = f"{text} One of: {', '.join(choices)}."
    info = typer.Option(f"--{name}/--no-{name}" if kind is bool else f"--{name}", help=text)
    if field.is_required():
        return _parameter(key, Annotated[kind, info])
    default = field.get_default(call_default_factory=True)
    if typing.get_origin(kind) is list:
        kind, default = kind | None, list(default) or None
    return _parameter(key, Annotated[kind, info], default)


def _choices(annotation: object) -> list[str]:
    """The words of a field that takes one of several; none where it takes any path as well."""
    if typing.get_origin(annotation) is Literal:
        return [str(value) for value in typing.get_args(annotation)]
    if Path in typing.get_args(annotation):
        return []
    return [word for part in typing.get_args(annotation) for word in _choices(part)]


def _simple(annotation: object) -> Any:
    """The command line's type for a field: constraints are the config's business."""
    origin = typing.get_origin(annotation)
    if origin is Literal:
        return str
    if origin is tuple:
        return list[typing.get_args(annotation)[0]]  # type: ignore[misc]
    if origin in (typing.Union, types.UnionType):
        kinds = [_simple(kind) for kind in typing.get_args(annotation) if kind is not type(None)]
        return kinds[0] | None
    return annotation


def _plain(field: FieldInfo, value: object) -> object:
    if value is None and typing.get_origin(field.annotation) is tuple:
        return ()
    return value


def _help(config: type[Config], key: str) -> str:
    return " ".join((config.model_fields[key].description or "").split())


def convert_command(
    kind: str,
    fields: dict[str, object],
    out: Path,
    *,
    plan: bool,
    strict: bool,
    workers: int,
    clips_per_shard: int,
    console: Console,
    started: float | None = None,
    as_json: bool = False,
) -> None:
    """Plan a conversion, or run it.

    `started` is when the command began (`time.perf_counter()`), for the time that a plan estimates.
    """
    from motionloom.datasets.convert.common.conversion import run_conversion
    from motionloom.datasets.convert.registry import converter_named, prepare

    started = time.perf_counter() if started is None else started
    config = converter_named(kind).config_class.parse(fields, f"data convert {kind}")
    shown = not console.quiet
    if plan:
        conversion = prepare(config, maps=out, workers=workers, progress=shown).looked()
        planned = conversion.estimated(workers, started)
        licensed = bool(conversion.converter.licence(planned))
        line = proposed(kind, config, out, planned, licensed=licensed) if planned.items else ""
        if as_json:
            print_json(planned.dump() | {"command": line})
        else:
            _say_plan(planned, console)
            say(console, f"convert it: {line}" if line else "nothing of it can be converted")
        return
    require_folder(out)
    conversion = prepare(config, out=out, workers=workers, progress=shown)
    for note in conversion.plan.notes:
        say(console, f"note: {note}")
    manifest = run_conversion(
        conversion,
        out,
        workers=workers,
        strict=strict,
        clips_per_shard=clips_per_shard,
        progress=shown,
        say=lambda line: say(console, line),
    )
    say_manifest(manifest, out, console)
    for note in manifest.notes:
        if note not in conversion.plan.notes:  # said before
            say(console, f"note: {note}")
    if conversion.plan.captions:
        say(console, conversion.plan.captions)


def proposed(
    kind: str, config: ConvertConfig, out: Path, plan: ConversionPlan[Any], *, licensed: bool
) -> str:
    """The command that converts what was planned: the settings given, and what else the plan found needed."""
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
        option = f"--{key.replace('_', '-')}"
        if key not in _EVERYDAY and not field.is_required():
            listed = f"[{','.join(map(str, value))}]" if isinstance(value, tuple) else value
            words += ["--set", f"{key}={str(listed).lower() if isinstance(value, bool) else listed}"]
        elif isinstance(value, bool):
            words.append(option if value else f"--no-{option[2:]}")
        else:
            for one in value if isinstance(value, tuple) else (value,):
                words += [option, str(one)]
    return shlex.join(words)


def _say_plan(plan: ConversionPlan[Any], console: Console) -> None:
    """Print the plan, and what a few clips showed."""
    console.print(plan.table())
    if (audit := plan.audit_table()) is not None:
        console.print(audit)
    if plan.look is None:
        return
    console.print(plan.look.table())
    for line in plan.look.lines():
        say(console, line)


def say_manifest(manifest: Manifest, out: Path, console: Console) -> None:
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
        f"{out / 'manifest.json'}: layout {manifest.layout} ({manifest.family}), "
        f"{manifest.fps:g} fps, {', '.join(manifest.licences) or manifest.licence}",
    )


def _say_left_out(manifest: Manifest, out: Path, console: Console) -> None:
    """How much was left out, a line for each reason, and where the whole list is."""
    if not manifest.dropped:
        return
    listed = out / LEFT_OUT_FILE
    place = listed if listed.exists() else out / MANIFEST_FILE
    console.print(f"left out: {tally(manifest.dropped)}; all in {place}", markup=False, soft_wrap=True)
    groups = grouped(manifest.dropped)
    for group in groups[:_REASONS]:
        say(console, f"  {group}")
    if len(groups) > _REASONS:
        console.print(f"  … and {len(groups) - _REASONS} more reasons")


def say(console: Console, text: str) -> None:
    """Print text from a stranger's file: one line, and no control characters for the terminal to obey."""
    console.print(printable(text), markup=False, highlight=False, soft_wrap=True)
