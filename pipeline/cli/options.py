"""Arguments and options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

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

Temperature = Annotated[
    float | None,
    typer.Option(
        help="0: the likeliest tokens; below 1: safer, above 1: more varied. Default: the model's, or 1."
    ),
]
TopK = Annotated[
    int | None, typer.Option(help="Draw from the k likeliest tokens; 0 = all. Default: the model's, or 0.")
]
TopP = Annotated[
    float | None,
    typer.Option(
        help="Draw from the likeliest tokens of this total probability. Default: the model's, or 0.95."
    ),
]
Candidates = Annotated[
    int | None,
    typer.Option(
        help="Draw so many motions of each caption and keep the one nearest to it, by TMA. Default: the "
        "model's, or 1."
    ),
]
CfgScale = Annotated[
    float | None, typer.Option(help="Classifier-free guidance; 1 = off. Default: the model's, or 1.")
]
FaceCfgScale = Annotated[float | None, typer.Option(help="Guidance of the face; default: as --cfg-scale.")]
MusicCfgScale = Annotated[
    float | None, typer.Option(help="Guidance where there is music; default: as --cfg-scale.")
]
DiffusionSampler = Annotated[
    str | None, typer.Option("--sampler", help="Of diffusion models: ddpm (default), ddim or dpm++.")
]
DenoisingSteps = Annotated[
    int | None,
    typer.Option(help="Denoising steps of diffusion models, default 50, at most those trained (1000)."),
]


def given(**options: Any) -> dict[str, Any]:
    """The options that were given."""
    return {name: value for name, value in options.items() if value is not None}
