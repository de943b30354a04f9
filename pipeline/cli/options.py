"""Arguments and options that several commands share, and `--json`: JSON alone on standard output."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from pydantic_core import to_jsonable_python

from motionloom.datasets.schema import UserError

if TYPE_CHECKING:
    from motionloom.pipeline.contract.sampling import SamplingConfig


ModelFolder = Annotated[
    Path,
    typer.Argument(
        help="A run folder (runs/NAME), an exported folder, or a model of the package (see info)."
    ),
]
RunFolder = Annotated[Path, typer.Argument(help="A run folder (runs/NAME).")]
Sets = Annotated[
    list[str] | None,
    typer.Option("--set", "-s", help="Override one value: stage.field=value. May be repeated."),
]
Device = Annotated[
    str, typer.Option(help="auto (a GPU if there is one; stages go by the recipe), cpu, cuda or cuda:N.")
]
Workers = Annotated[int, typer.Option(help="Processes; the shards are the same bytes for any number.")]

Sampling = Annotated[
    list[str] | None,
    typer.Option(
        "--sampling",
        help="How motions are drawn, KEY=VALUE; may be repeated. Keys: temperature (0: the likeliest), "
        "top_k, top_p, candidates (keep the nearest of so many), cfg_scale, guidance.audio, face_cfg_scale, "
        "face_model (gpt, vae, diffusion), sampler (ddpm, ddim, dpm++), denoising_steps. "
        "Default: as the model recommends.",
    ),
]


def set_option(help: str) -> Any:
    """`--set KEY=VALUE`, for the fields of a config."""
    return typer.Option("--set", "-s", metavar="KEY=VALUE", help=f"{help} May be repeated.")


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


def sampling_of(words: Sequence[str] | None) -> SamplingConfig:
    """The sampling settings of `--sampling` options."""
    from motionloom.pipeline.contract.sampling import SamplingConfig

    return SamplingConfig.parse(fields_of(words, "--sampling"), "--sampling")


AsJson = Annotated[
    bool, typer.Option("--json", help="Print JSON for programs; all else goes to standard error.")
]


def print_json(result: object) -> None:
    """Print a result: plain data, a config, a dataclass, or any of these within each other."""
    typer.echo(json.dumps(plain(result), indent=1, ensure_ascii=False, allow_nan=False))


def plain(value: object) -> Any:
    """`value` as JSON knows it: paths become text, sets and tuples lists; JSON has no NaN: null."""
    return to_jsonable_python(value, inf_nan_mode="null")
