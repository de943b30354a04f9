"""`motionloom data convert SOURCE-KIND …`: one command per converter, made from its config class.

The options of a command are the fields of the converter's config and their docstrings are the help, so the
command line, a recipe's stage and the Python API can never differ. A converter is imported when asked for.
"""

from __future__ import annotations

import inspect
import time
import types
import typing
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from pydantic.fields import FieldInfo
from typer.core import TyperGroup
from typer.main import get_command

from motionloom.datasets.convert.table import CONVERTERS
from motionloom.datasets.schema import Config, UserError
from motionloom.pipeline.cli.json_output import AsJson
from motionloom.pipeline.launch.console import make_console

_RUN_OPTIONS: dict[str, tuple[Any, Any]] = {
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
    "cluster": (
        Annotated[
            list[str] | None,
            typer.Option(
                "--cluster",
                help="Convert on SLURM: KEY=VALUE (partition, tasks, time_minutes, ...). May be repeated.",
            ),
        ],
        None,
    ),
    "as_json": (AsJson, False),
    "wait": (
        Annotated[bool, typer.Option("--wait/--no-wait", help="With --cluster: wait for the jobs to end.")],
        True,
    ),
}


class ConverterGroup(TyperGroup):
    """The converters by name, each built when it is asked for."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Names of the converters."""
        return list(CONVERTERS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """The command of one converter."""
        return _command(cmd_name) if cmd_name in CONVERTERS else None


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
    entry = CONVERTERS[name]
    config = entry.config()
    fields = {key: field for key, field in config.model_fields.items() if key != "source"}

    def run(source: Path, out: Path, **values: Any) -> None:
        started = time.perf_counter()  # the imports are the larger part of a short conversion
        from motionloom.pipeline.cli.data_commands import convert_command

        steering = {key: values.pop(key) for key in _RUN_OPTIONS}
        given = {key: _plain(fields[key], value) for key, value in values.items()}
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
    app = typer.Typer(add_completion=False, rich_markup_mode="markdown")
    app.command(name)(run)
    return get_command(app)


def _parameter(name: str, annotation: Any, default: Any = inspect.Parameter.empty) -> inspect.Parameter:
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


def _choices(annotation: Any) -> list[str]:
    """The words of a field that takes one of several; none where it takes any path as well."""
    if typing.get_origin(annotation) is Literal:
        return [str(value) for value in typing.get_args(annotation)]
    if Path in typing.get_args(annotation):
        return []
    return [word for part in typing.get_args(annotation) for word in _choices(part)]


def _simple(annotation: Any) -> Any:
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


def _plain(field: FieldInfo, value: Any) -> Any:
    if value is None and typing.get_origin(field.annotation) is tuple:
        return ()
    return value


def _help(config: type[Config], key: str) -> str:
    return " ".join((config.model_fields[key].description or "").split())
