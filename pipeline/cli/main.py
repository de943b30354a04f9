"""The command line: a thin layer on the Python API.

Exit codes: 0 done; 1 the check found problems; 2 a mistake in the call, the recipe or the data (one sentence
on standard error says which and how to fix it); 130 interrupted. A bug shows
its traceback and gives 1.
"""

from __future__ import annotations

import traceback
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from motionloom.datasets.schema import UserError
from motionloom.pipeline.cli.data import data_app
from motionloom.pipeline.cli.launch import Sets, launch
from motionloom.pipeline.launch.console import make_console, quiet_libraries
from motionloom.pipeline.launch.process import TeamError, leave, process_rank

app = typer.Typer(
    name="motionloom",
    help="Text or music to whole-body motion: data, training and generation (HumanTOMATO, UDE).",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.add_typer(data_app, name="data")

ModelFolder = Annotated[Path, typer.Argument(help="A run folder (runs/NAME), or a folder made by export.")]
RunFolder = Annotated[Path, typer.Argument(help="A run folder (runs/NAME).")]
Device = Annotated[
    str, typer.Option(help="auto (a GPU if there is one; stages go by the recipe), cpu, cuda or cuda:N.")
]
_INTERRUPTED = 130


@app.command()
def info(
    recipe_schema: Annotated[
        bool, typer.Option("--recipe-schema", help="Print the JSON schema of recipes, for editors.")
    ] = False,
) -> None:
    """Versions, devices, text encoder and shipped recipes.

    Example: `motionloom info`

    Example: `motionloom info --recipe-schema > recipe.schema.json`
    """
    if recipe_schema:
        import json

        from motionloom.pipeline.runs.schema import recipe_schema as schema

        typer.echo(json.dumps(schema(), indent=1))
        return
    from motionloom.pipeline.cli.info import show_info

    show_info(make_console())


@app.command()
def run(
    recipe: Annotated[str, typer.Argument(help="A shipped recipe's name (see info) or a .yaml file.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Run folder; default runs/NAME of the recipe.")
    ] = None,
    sets: Sets = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print the plan with the reason for each stage.")
    ] = False,
    first: Annotated[
        str | None, typer.Option("--from", help="Run this stage and all below it again.")
    ] = None,
    until: Annotated[
        str | None, typer.Option(help="Only this stage and what it needs; several as A,B.")
    ] = None,
    only: Annotated[str | None, typer.Option(help="Only this stage; its inputs must be finished.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Run the selected stages even if finished.")] = False,
    replace: Annotated[
        bool, typer.Option("--replace", help="Go on in the folder of another recipe's run.")
    ] = False,
) -> None:
    """Run a recipe: every stage that is not finished, in order.

    Finished stages are skipped, changed ones and those below them run again. Kill it at any moment and start
    it again: it goes on where it was.

    Example: `motionloom run humantomato-tiny --dry-run`

    Example: `motionloom run humantomato-tiny -o runs/second --set tma.optim.lr=2e-4 --until tma`
    """
    from motionloom.pipeline.runs.api import run_recipe
    from motionloom.pipeline.runs.graph import Selection

    run_recipe(
        recipe,
        out,
        overrides=sets or (),
        select=Selection(first, until, only, force),
        dry_run=dry_run,
        replace=replace,
        console=make_console(),
    )


app.command()(launch)


@app.command()
def generate(
    run_folder: ModelFolder,
    captions: Annotated[
        list[str] | None, typer.Argument(help="What the person does; one motion each.")
    ] = None,
    face: Annotated[
        list[str] | None, typer.Option("--face", help="What the face does, one for each caption.")
    ] = None,
    audio: Annotated[
        list[Path] | None,
        typer.Option("--audio", help="A wav, flac, mp3 or ogg file to move to; beside a caption, both."),
    ] = None,
    script: Annotated[
        Path | None, typer.Option("--script", help="YAML: segments of text and music, one motion.")
    ] = None,
    samples: Annotated[int, typer.Option(help="Motions of each caption, sound or script.")] = 1,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the files.")] = Path("motions"),
    formats: Annotated[
        str, typer.Option("--format", "-f", help="Comma-separated: npz, bvh, mp4, html.")
    ] = "npz,bvh,mp4,html",
    seconds: Annotated[float | None, typer.Option(help="Length; default: the model decides.")] = None,
    seed: Annotated[int, typer.Option(help="Same seed, captions and options: same motions.")] = 0,
    temperature: Annotated[
        float, typer.Option(help="0: the likeliest tokens; below 1: safer, above 1: more varied.")
    ] = 1.0,
    top_k: Annotated[int, typer.Option(help="Draw from the k likeliest tokens; 0 = all.")] = 0,
    top_p: Annotated[
        float, typer.Option(help="Draw from the likeliest tokens of this total probability.")
    ] = 0.95,
    cfg: Annotated[float, typer.Option(help="Classifier-free guidance; 1 = off.")] = 1.0,
    face_cfg: Annotated[float | None, typer.Option(help="Guidance of the face; default: as --cfg.")] = None,
    music_cfg: Annotated[
        float | None, typer.Option(help="Guidance where there is music; default: as --cfg.")
    ] = None,
    face_model: Annotated[
        str | None, typer.Option(help="gpt, vae or diffusion; default: the first the run has.")
    ] = None,
    sampler: Annotated[
        str | None, typer.Option(help="Of diffusion models: ddpm (default), ddim or dpm++.")
    ] = None,
    steps: Annotated[
        int | None,
        typer.Option(help="Denoising steps of diffusion models, default 50, at most those trained (1000)."),
    ] = None,
    device: Device = "auto",
) -> None:
    """Motions from captions, music or a script of both, as npz, BVH, MP4 and one page to watch.

    Example: `motionloom generate runs/humantomato-tiny "a person waves" --face "a happy face" -o out`

    Example: `motionloom generate runs/ude-tiny --audio song.ogg --samples 3 -o dances`
    """
    from motionloom.pipeline.runs.api import generate_motions

    of_models = {
        "face_cfg_scale": face_cfg,
        "music_cfg_scale": music_cfg,
        "sampler": sampler,
        "denoising_steps": steps,
    }
    generate_motions(
        run_folder,
        captions or [],
        face_captions=face,
        audio=audio or [],
        script=script,
        samples=samples,
        out=out,
        formats=formats,
        seconds=seconds,
        seed=seed,
        sampling={
            "temperature": temperature,
            "top_k": top_k,
            "top_p": top_p,
            "cfg_scale": cfg,
            "face_model": face_model,
            **{name: value for name, value in of_models.items() if value is not None},
        },
        device=device,
        console=make_console(),
    )


@app.command()
def evaluate(
    run_folders: Annotated[
        list[Path] | None,
        typer.Argument(help="A run folder (runs/NAME). With --table several, or none.", show_default=False),
    ] = None,
    clips: Annotated[int | None, typer.Option(help="At most this many test clips.")] = None,
    repeats: Annotated[
        int | None, typer.Option(help="Repetitions of everything that draws at random.")
    ] = None,
    device: Device = "auto",
    table: Annotated[
        str | None,
        typer.Option(help="Measure nothing; show a table of a paper with the finished runs' rows: ude/2."),
    ] = None,
    tables: Annotated[bool, typer.Option("--tables", help="List the tables of the papers.")] = False,
    format_: Annotated[
        str | None, typer.Option("--format", help="Of a table: text, markdown, csv, latex or json.")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="File for a table.")] = None,
) -> None:
    """Figures on the test split, each beside its trivial answer; with --table, beside a paper's.

    Example: `motionloom evaluate runs/humantomato-tiny --repeats 5`

    Example: `motionloom evaluate --table humantomato/7 runs/baselines-tiny runs/humantomato-tiny -o seven.md`
    """
    runs = run_folders or []
    if tables or table is not None:
        _show_table(table, tables, runs, format_, out, measuring=clips or repeats or device != "auto")
        return
    if format_ is not None or out is not None:
        raise UserError("--format and --out are of a table; name one, like --table humantomato/7")
    if len(runs) != 1:
        raise UserError(
            f"{len(runs)} run folders to evaluate; name one, like: motionloom evaluate runs/NAME "
            f"(several only with --table)"
        )
    from motionloom.pipeline.runs.api import evaluate_run

    evaluate_run(runs[0], clips=clips, repeats=repeats, device=device, share=True, console=make_console())


def _show_table(
    table: str | None,
    tables: bool,
    runs: list[Path],
    form: str | None,
    out: Path | None,
    *,
    measuring: object,
) -> None:
    """A table of a paper, or the list of all; what is not of tables is refused."""
    from motionloom.pipeline.published.compare import compare_with_paper, list_tables

    if measuring:
        raise UserError(
            "--clips, --repeats and --device measure anew, and a table shows what was measured; "
            "leave them out"
        )
    if table is not None:
        compare_with_paper(table, runs, format=form, out=out, console=make_console())
    elif runs or form is not None or out is not None:
        raise UserError("--tables lists the tables alone; to see one, give --table NAME RUN...")
    else:
        list_tables(make_console())


@app.command()
def retrieval(
    run_folder: RunFolder,
    stage: Annotated[
        str | None, typer.Option(help="The alignment stage, for example temos; default: tma.")
    ] = None,
    split: Annotated[str | None, typer.Option(help="train, val or test; default: the test split.")] = None,
    seed: Annotated[int, typer.Option(help="Shuffles the batches of protocols C and D.")] = 0,
    device: Device = "auto",
) -> None:
    """Text-motion retrieval by the run's TMA, or by TEMOS, under the paper's protocols A to D.

    Example: `motionloom retrieval runs/humantomato-tiny`

    Example: `motionloom retrieval runs/baselines-tiny --stage temos`
    """
    from motionloom.pipeline.evaluation.retrieval import retrieval_command

    retrieval_command(run_folder, stage=stage, split=split, seed=seed, device=device, console=make_console())


@app.command()
def report(
    run_folder: RunFolder,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="The page; default RUN/report/report.html.")
    ] = None,
    device: Device = "auto",
) -> None:
    """One self-contained page: motions to watch, figures, where they err, curves, codebooks, what was run.

    Of an unfinished run it shows what there is and says what is missing.

    Example: `motionloom report runs/humantomato-tiny`
    """
    from motionloom.pipeline.runs.api import report_run

    report_run(run_folder, out, device=device, console=make_console())


@app.command()
def compare(
    run_folders: Annotated[
        list[Path], typer.Argument(metavar="RUN RUN...", help="Two run folders or more, finished or not.")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="The page.")] = Path("compare.html"),
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the same here, for programs.")
    ] = None,
) -> None:
    """Several runs on one page: settings that differ, figures side by side, training curves over each other.

    The best of a figure is marked among runs that were measured alike. Nothing is computed again, and
    unfinished runs show what they have.

    Example: `motionloom compare runs/humantomato-tiny runs/second -o compare.html`
    """
    from motionloom.pipeline.compare.command import compare_runs

    compare_runs(run_folders, out, json_file=json_file, console=make_console())


@app.command()
def export(
    run_folder: RunFolder,
    out: Annotated[Path, typer.Option("--out", "-o", help="New folder.")] = Path("exported"),
) -> None:
    """One folder with all that generate needs: weights (safetensors), configs, statistics.

    Example: `motionloom export runs/humantomato-tiny -o model && motionloom generate model "a person jumps"`
    """
    from motionloom.pipeline.runs.api import export_run

    export_run(run_folder, out, console=make_console())


def main() -> None:
    """Entry point: runs the command and ends the process with its exit code."""
    quiet_libraries()
    leave(_exit_code())


def _exit_code() -> int:
    """Run the command; a user's mistake becomes one sentence on standard error."""
    errors = Console(stderr=True, highlight=False, soft_wrap=True)
    try:
        code = app(prog_name="motionloom", standalone_mode=False) or 0
    except UserError as error:
        errors.print(f"error: {error}", style="red", markup=False)
        return 2
    except TeamError as error:
        where = f"process {process_rank()}: another process of this run has stopped"
        errors.print(f"{where} ({error})", style="red", markup=False)
        return 1
    except (typer.Abort, KeyboardInterrupt):
        code = _INTERRUPTED
    except Exception as error:
        if type(error).__module__.startswith(("click", "typer")) and hasattr(error, "show"):
            error.show()
            return 2
        traceback.print_exc()
        return 1
    if code == _INTERRUPTED:  # typer may have answered Ctrl-C itself
        errors.print("interrupted; the same command goes on from here", style="yellow")
    return int(code)


if __name__ == "__main__":
    main()
