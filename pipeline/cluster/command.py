"""`motionloom launch`: a recipe on a cluster that another engine schedules."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Literal, get_args

from rich.console import Console

from motionloom.datasets.base.files import write_text
from motionloom.datasets.schema import UserError
from motionloom.pipeline.cluster.kubernetes_run import kubernetes_steps, kubernetes_yaml
from motionloom.pipeline.cluster.plan import LaunchPlan, make_launch_plan
from motionloom.pipeline.cluster.skypilot_run import skypilot_steps, skypilot_yaml
from motionloom.pipeline.cluster.slurm_run import RECIPE_FILE, slurm_scripts, submit_run
from motionloom.pipeline.launch.options import KubernetesOptions, SkyPilotOptions, SlurmOptions
from motionloom.pipeline.launch.slurm_convert import LOG_FOLDER
from motionloom.pipeline.runs.graph import make_plan
from motionloom.pipeline.runs.recipe import load_recipe
from motionloom.pipeline.runs.replace import replaced_stages, require_asked
from motionloom.pipeline.runs.shipped import nearest
from motionloom.pipeline.store.files import require_file_place, require_folder

Engine = Literal["slurm", "kubernetes", "skypilot"]


def launch_recipe(
    recipe: str | Path,
    engine: str,
    *,
    nodes: int = 1,
    gpus_per_node: int = 8,
    out: Path | None = None,
    overrides: Sequence[str] = (),
    options: Sequence[str] = (),
    file: Path | None = None,
    dry_run: bool = False,
    console: Console,
) -> LaunchPlan:
    """Submit a recipe to SLURM, or write the YAML for Kubernetes or SkyPilot and say how to start it.

    `options` are `KEY=VALUE` words of the engine's class in `options.py`. With `dry_run` everything is
    printed and nothing written.
    """
    if engine not in get_args(Engine):
        raise UserError(f"--engine {engine}: no such engine{nearest(engine, get_args(Engine))}")
    if engine == "slurm" and file is not None:
        raise UserError("--file is for Kubernetes and SkyPilot; SLURM's scripts go into the run folder")
    loaded = load_recipe(recipe, overrides)
    own = Path(recipe).suffix in {".yaml", ".yml"}
    given, folder = None if own else str(recipe), out or Path("runs") / loaded.name

    def plan(chosen: SlurmOptions | KubernetesOptions | SkyPilotOptions, place: PurePosixPath) -> LaunchPlan:
        made = make_launch_plan(
            loaded,
            chosen,
            given=given,
            overrides=overrides,
            out=place,
            nodes=nodes,
            gpus_per_node=gpus_per_node,
            parts=getattr(chosen, "parts", 1),
        )
        console.print(made.table())
        return made

    if engine == "slurm":
        require_folder(folder)
        if (folder / "recipe.yaml").is_file():
            require_asked(folder, loaded.name, replaced_stages(folder, make_plan(loaded, folder)))
        asked = SlurmOptions.from_words(options)
        made = plan(asked, PurePosixPath(folder.absolute()))
        if dry_run:
            _show_scripts(made, asked, console)
        else:
            submit_run(made, asked, console)
        return made
    file = file or Path(f"{loaded.name}-{engine}.yaml")
    require_file_place(file)
    if engine == "kubernetes":
        pods = KubernetesOptions.from_words(options)
        made = plan(pods, pods.mount / folder)
        text, steps = kubernetes_yaml(made, pods), kubernetes_steps(made, pods, str(file))
        resolved = None
    else:
        sky = SkyPilotOptions.from_words(options)
        made = plan(sky, sky.mount / folder)
        resolved = file.with_suffix(".recipe.yaml").absolute() if own else None
        text, steps = skypilot_yaml(made, sky, resolved), skypilot_steps(made, str(file))
    if dry_run:
        console.print(text, soft_wrap=True, markup=False)
    else:
        write_text(file, text)
    if resolved is not None:
        if not dry_run:
            write_text(resolved, loaded.to_yaml())
        console.print(f"recipe, resolved: {resolved}", soft_wrap=True, markup=False)
    console.print(f"{'would write' if dry_run else 'wrote'} {file}; start it:", soft_wrap=True, markup=False)
    for step in steps:
        console.print(f"  {step}", soft_wrap=True, markup=False)
    return made


def _show_scripts(plan: LaunchPlan, options: SlurmOptions, console: Console) -> None:
    folder = Path(plan.out) / LOG_FOLDER / "DATE-TIME"
    if plan.given is None:
        console.print(
            f"would write {folder / RECIPE_FILE}: the resolved recipe", soft_wrap=True, markup=False
        )
    before: str | None = None
    for script in slurm_scripts(plan, options, folder, Path.cwd()):
        console.print(f"\n{script.path}:\n{script.text}", soft_wrap=True, markup=False)
        console.print(" ".join(script.submit(before)), soft_wrap=True, markup=False)
        before = f"ID-OF-{script.group.name}"
