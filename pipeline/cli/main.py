"""The command line: a thin layer on the Python API.

Exit codes: 0 done; 1 the check found problems; 2 a mistake in the call, the recipe or the data (one sentence
on standard error says which and how to fix it), or what the system refuses: a full disk, no permission; 75
a signal has stopped a training, which is saved and goes on with the same command; 76 another process of the
run has ended; 130 interrupted; 141 nobody reads the output any more. A bug shows its
traceback and gives 1.
"""

from __future__ import annotations

import os
import shlex
import sys
import traceback
from importlib import metadata
from pathlib import Path
from typing import Annotated

import typer

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.os_errors import sentence_of
from motionloom.datasets.base.register import discover
from motionloom.pipeline.cli.data import data_app
from motionloom.pipeline.cli.evaluate import evaluate
from motionloom.pipeline.cli.generate import generate
from motionloom.pipeline.cli.options import (
    PROGRAM,
    AsJson,
    At,
    Commands,
    GoOn,
    RunFolder,
    Sets,
    Settings,
    fields_of,
    print_json,
)
from motionloom.pipeline.launch.console import SafeConsole, make_console, quiet_libraries
from motionloom.pipeline.launch.process import Interrupted, JointError, TeamError, leave, process_rank

app = Commands(
    name=PROGRAM,
    help="Text or music to whole-body motion: data, training and generation (HumanTOMATO, UDE).",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.add_typer(data_app, name="data")

_INTERRUPTED = 130
_CLOSED_PIPE = 141


def _say_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"motionloom {metadata.version('motionloom')}")
        raise typer.Exit


@app.callback()
def _program(
    version: Annotated[
        bool, typer.Option("--version", help="Show the version.", callback=_say_version, is_eager=True)
    ] = False,
) -> None:
    """Text or music to whole-body motion: data, training and generation (HumanTOMATO, UDE)."""


@app.command()
def info(as_json: AsJson = False) -> None:
    """Versions, devices, text encoder, shipped models and recipes.

    Example: `motionloom info`
    """
    from motionloom.pipeline.cli import info as facts

    if as_json:
        print_json(facts.info())
    else:
        facts.show_info(make_console())


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
    sizes: Annotated[
        bool, typer.Option("--sizes", help="A dry run that also measures what each training takes.")
    ] = False,
    first: Annotated[
        str | None, typer.Option("--from", help="Run this stage and all below it again.")
    ] = None,
    until: Annotated[
        str | None, typer.Option(help="Only this stage and what it needs; several as A,B.")
    ] = None,
    go_on: GoOn = None,
    replace: Annotated[
        bool,
        typer.Option(
            "--replace",
            help="Go on in this folder even where that replaces trainings, or another recipe's run.",
        ),
    ] = False,
    verify: Annotated[
        bool, typer.Option("--verify", help="First compare all files of finished stages with their sha256.")
    ] = False,
    mirror: Annotated[
        str | None, typer.Option(help="Bucket (s3://BUCKET/RUN) that keeps the run, and gives it back.")
    ] = None,
) -> None:
    """Run a recipe: every stage that is not finished, in order.

    Finished stages are skipped, changed ones and those below them run again; before a training is replaced
    that is finished or took ten minutes, it asks for --replace, or for another folder. Kill it at any moment
    and start it again: it goes on where it was, also with other steps, precision, accumulation or processes.

    Example: `motionloom run humantomato-tiny --dry-run`

    Example: `motionloom run humantomato-paper --sizes`

    Example: `motionloom run humantomato-tiny -o runs/second --set tma.optim.lr=2e-4 --until tma`

    Example: `motionloom run humantomato-tiny --set face_gpt.train.steps=900 --replace`

    Example: `motionloom run humantomato-tiny --set gpt.optim.lr=1e-4 --go-on gpt`

    Example: `motionloom run humantomato-tiny --mirror s3://my-bucket/runs/first`
    """
    from motionloom.pipeline.runs.layers import require_recipe

    require_recipe(recipe, sets or ())  # before all that trains is imported
    from motionloom.pipeline.runs.api import run_recipe
    from motionloom.pipeline.runs.plan import Selection

    run_recipe(
        recipe,
        out,
        overrides=sets or (),
        select=Selection(first, until),
        go_on=go_on or (),
        dry_run=dry_run,
        sizes=sizes,
        replace=replace,
        verify=verify,
        mirror=mirror,
        console=make_console(),
    )


app.command()(generate)
app.command()(evaluate)


@app.command()
def retrieval(
    run_folder: RunFolder,
    stage: Annotated[
        str | None, typer.Option(help="What judges, for example temos or evaluator; default: tma.")
    ] = None,
) -> None:
    """Text-motion retrieval by a run's TMA, TEMOS or evaluator, under the paper's protocols A to D.

    Example: `motionloom retrieval runs/humantomato-tiny`

    Example: `motionloom retrieval runs/baselines-tiny --stage temos`
    """
    from motionloom.pipeline.evaluation.retrieval import retrieval_command

    retrieval_command(run_folder, stage=stage, console=make_console())


@app.command()
def report(
    run_folder: RunFolder,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="The page; default RUN/report/report.html.")
    ] = None,
    at: At = None,
) -> None:
    """One page: motions to watch, figures, where the model errs, training curves, codebooks, what was run.

    Of an unfinished run it shows what there is and says what is missing.

    Example: `motionloom report runs/humantomato-tiny`
    """
    from motionloom.pipeline.runs.api import report_run

    report_run(run_folder, out, at=at, console=make_console())


@app.command()
def export(
    run_folder: RunFolder,
    out: Annotated[Path, typer.Option("--out", "-o", help="New folder.")] = Path("exported"),
    half: Annotated[bool, typer.Option("--half", help="Weights in half precision: half the size.")] = False,
    settings: Settings = None,
    at: At = None,
) -> None:
    """One folder with all that generate needs: weights (safetensors), configs, statistics.

    Settings of `--set`, such as cfg_scale, go with it: generation takes them where nobody says otherwise.

    Example: `motionloom export runs/humantomato-tiny -o model && motionloom generate model "a person jumps"`

    Example: `motionloom export runs/humantomato-tiny -o model --half --set top_p=0.9`
    """
    from motionloom.pipeline.contract.sampling import SamplingConfig
    from motionloom.pipeline.runs.api import export_run

    sampling = SamplingConfig.parse(fields_of(settings, "--set"), "--set")
    export_run(run_folder, out, at=at, half=half, sampling=sampling, console=make_console())


def main() -> None:
    """Entry point: runs the command and ends the process with its exit code."""
    quiet_libraries()
    leave(_exit_code())


def _exit_code() -> int:
    """Run the command; a user's mistake becomes one sentence on standard error."""
    errors = SafeConsole(stderr=True, highlight=False, soft_wrap=True)
    try:
        discover()  # formats, sources and metrics of other packages are in the help, too
        code = app(prog_name=PROGRAM, standalone_mode=False) or 0
        sys.stdout.flush()  # here a full disk can still be answered
    except JointError as error:
        if process_rank() == 0:
            errors.print(f"error: {error}", style="red", markup=False)
        return error.exit_code
    except UserError as error:
        errors.print(f"error: {error}", style="red", markup=False)
        return 2
    except TeamError as error:
        errors.print(f"process {process_rank()}: {error}", style="red", markup=False)
        return error.exit_code
    except BrokenPipeError:  # `motionloom info | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return _CLOSED_PIPE
    except Interrupted as stop:
        if process_rank() == 0:
            command = shlex.join(["motionloom", *sys.argv[1:]])
            errors.print(f"{stop}; the same command goes on: {command}", style="yellow", markup=False)
        return stop.exit_code
    except (typer.Abort, KeyboardInterrupt):
        code = _INTERRUPTED
    except Exception as error:
        if type(error).__module__.startswith(("click", "typer")) and hasattr(error, "show"):
            error.show()
            return 2
        words = sentence_of(error)
        if words is not None:
            errors.print(f"error: {words}", style="red", markup=False)
            return 2
        traceback.print_exc()
        return 1
    if code == _INTERRUPTED:  # typer may have answered Ctrl-C itself
        errors.print("interrupted; the same command goes on from here", style="yellow")
    return int(code)


if __name__ == "__main__":
    main()
