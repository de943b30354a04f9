"""Arguments and options that several commands share, and `--json`: JSON alone on standard output."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer
from pydantic_core import to_jsonable_python
from typer.core import TyperGroup
from typer.main import get_command

from motionloom.datasets.base.config import require_local
from motionloom.datasets.base.errors import UserError, nearest
from motionloom.datasets.base.register import discover
from motionloom.pipeline.contract.command import COMMANDS

ModelFolder = Annotated[
    str,
    typer.Argument(
        help="A run folder (runs/NAME), an exported folder, a model of the package (see info), or "
        "OWNER/NAME of one on the hub."
    ),
]
RunFolder = Annotated[Path, typer.Argument(help="A run folder (runs/NAME).")]
Sets = Annotated[
    list[str] | None,
    typer.Option("--set", "-s", help="Override one value: stage.field=value. May be repeated."),
]
GoOn = Annotated[
    list[str] | None,
    typer.Option(
        "--go-on",
        metavar="STAGE",
        help="Go on with this training's weights although its optim, loss or train settings changed.",
    ),
]
At = Annotated[
    str | None,
    typer.Option(
        "--at",
        metavar="STEP",
        help="Take trainings that are not finished from a checkpoint: `newest`, a step, or STAGE:STEP.",
    ),
]
Device = Annotated[
    str, typer.Option(help="auto (a GPU if there is one; stages go by the recipe), cpu, cuda or cuda:N.")
]
Rig = Annotated[Path | None, typer.Option(help="Your own character, a .vrm or .glb, as --set rig=FILE.")]
Workers = Annotated[int, typer.Option(help="Processes; the shards are the same bytes for any number.")]


F = TypeVar("F", bound=Callable[..., object])


PROGRAM = "motionloom"


class Group(TyperGroup):
    """The commands of a `Commands`, and those of `COMMANDS` that belong to its group, each built when it is
    asked for."""

    def list_commands(self, ctx: Any) -> list[str]:
        return [*self.commands, *self._added()]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        added = self._added()
        if cmd_name not in added:
            return super().get_command(ctx, cmd_name)
        app = Commands(add_completion=False, rich_markup_mode="markdown")
        app.command(cmd_name)(COMMANDS[added[cmd_name]].function)
        return get_command(app)

    def _added(self) -> dict[str, str]:
        """Names in `COMMANDS` by the word that is typed in this group; none of them is imported for it."""
        discover()
        group = [] if self.name == PROGRAM else [self.name]
        words = {name: name.split() for name in COMMANDS}
        added = {word: name for name, (*before, word) in words.items() if before == group}
        for word in added.keys() & self.commands.keys():
            raise UserError(f"command '{added[word]}': motionloom has one of this name; choose a new one")
        return added


class Commands(typer.Typer):
    """A `typer.Typer` whose commands refuse a URL for any of their paths before they do anything."""

    def __init__(self, **how: Any) -> None:
        super().__init__(**{"cls": Group, **how})

    def command(self, name: str | None = None) -> Callable[[F], F]:  # type: ignore[override]
        decorate = super().command(name)

        def register(function: F) -> F:
            @wraps(function)
            def called(**values: object) -> object:
                require_local(list(values.values()))
                return function(**values)

            decorate(called)
            return function

        return register


def set_option(help: str) -> Any:
    """`--set KEY=VALUE`, for the fields of a config."""
    return typer.Option("--set", "-s", metavar="KEY=VALUE", help=f"{help} May be repeated.")


Settings = Annotated[
    list[str] | None,
    set_option(
        "How motions are drawn: temperature (0: the likeliest), top_k, top_p, candidates (keep the nearest "
        "of so many), cfg_scale, guidance.audio, face_cfg_scale, face_model (gpt, vae, diffusion), sampler "
        "(ddpm, ddim, dpm++), denoising_steps; default: as the model recommends."
    ),
]


def fields_of(words: Sequence[str] | None, option: str) -> dict[str, Any]:
    """Settings from `KEY=VALUE` words, as YAML has them; `a.b=1` is `{"a": {"b": 1}}`."""
    from motionloom.pipeline.store.yaml import load_yaml, merge

    fields: dict[str, Any] = {}
    for word in words or ():
        key, equals, value = word.partition("=")
        if not equals:
            raise UserError(f"{option} {word}: write it as KEY=VALUE")
        entry = load_yaml(value, f"{option} {word}")
        for part in reversed(key.strip().split(".")):
            entry = {part: entry}
        fields = merge(fields, entry)
    return fields


def settings_of(words: Sequence[str] | None, *groups: Iterable[str]) -> list[dict[str, object]]:
    """The fields of `--set` options, one mapping for each group of keys; a key of no group is refused."""
    fields = fields_of(words, "--set")
    known = [list(group) for group in groups]
    for key in fields:
        if not any(key in group for group in known):
            raise UserError(
                f"--set {key}: no such key{nearest(key, [name for keys in known for name in keys])}"
            )
    return [{key: fields[key] for key in group if key in fields} for group in known]


AsJson = Annotated[
    bool, typer.Option("--json", help="Print JSON for programs; all else goes to standard error.")
]


def print_json(result: object) -> None:
    """Print a result: plain data, a config, a dataclass, or any of these within each other."""
    typer.echo(json.dumps(plain(result), indent=1, ensure_ascii=False, allow_nan=False))


def plain(value: object) -> Any:
    """`value` as JSON knows it: paths become text, sets and tuples lists; JSON has no NaN: null."""
    return to_jsonable_python(value, inf_nan_mode="null")
