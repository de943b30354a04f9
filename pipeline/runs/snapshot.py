"""A run in the middle of its trainings: those that are not finished, with the weights of a checkpoint.

`run_at` writes a run folder for as long as it is needed. In it each such training is a finished stage, and so
are generators that train nothing and are made of it; evaluation and report read these. The finished stages of
the run are inputs from outside. So every command takes it as any other run, also while the run goes on.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from rich.console import Console

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import temporary_folder, write_text
from motionloom.pipeline.contract.lookup import finished_stages
from motionloom.pipeline.contract.stage import (
    CAPTIONER,
    GENERATOR,
    CompletedStage,
    Every,
    Stage,
    StageCache,
    StageContext,
)
from motionloom.pipeline.inference.shipped_models import shipped_models
from motionloom.pipeline.launch.console import make_console, say
from motionloom.pipeline.runs.continuation import Started
from motionloom.pipeline.runs.plan import terms_of
from motionloom.pipeline.runs.recipe import Recipe, load_recipe
from motionloom.pipeline.store.artifact import Artifact, InputStage
from motionloom.pipeline.store.files import fingerprint_of
from motionloom.pipeline.store.run_folder import identity_of, place_from, require_run, stage_folder
from motionloom.pipeline.store.training_log import FILE_NAME
from motionloom.pipeline.store.weights import save_model

if TYPE_CHECKING:
    from motionloom.pipeline.training.checkpointing import Checkpoint

NEWEST = "newest"

P = TypeVar("P", Path, str)


@contextmanager
def run_at(run: P, at: str | None, what: str = GENERATOR) -> Iterator[P]:
    """Give a run folder that holds `run` as of a checkpoint until the block ends; `run` itself without `at`.

    `at` is "newest", or the step of one training, others that are not finished being taken at their newest;
    "gpt:443" names the training. A step may also be of a finished training. Where two trainings have it, it
    is of one that is not finished, then of one that gives `what`.

    Raises:
        UserError: There is no checkpoint, or not of this step, or it was made from other inputs.
    """
    if at is None:
        yield run
        return
    folder = Path(run)
    if not folder.exists() and str(run) in shipped_models():
        raise UserError(f"--at {at}: {run} comes with the package and is finished; leave --at out")
    require_run(folder)
    recipe = load_recipe(folder / "recipe.yaml")
    finished = finished_stages(folder)
    chosen = _chosen(folder, recipe, finished, at, what)
    if not chosen:
        yield run  # all trainings that have begun are finished
        return
    with temporary_folder() as temporary:
        made = _write(temporary, folder, recipe, finished, chosen, exact=not at.endswith(NEWEST))
        try:
            yield type(run)(made)
        except UserError as error:
            if str(made) not in str(error):
                raise
            # Who reads it finds the run, and no folder that is gone.
            raise UserError(str(error).replace(str(made), str(folder))) from error


def _chosen(
    run: Path, recipe: Recipe, finished: Mapping[str, CompletedStage], at: str, what: str
) -> dict[str, int]:
    """Trainings and the steps to take them at, the one that is asked for first."""
    from motionloom.pipeline.training.checkpointing import step_of

    steps: dict[str, list[int]] = {}
    for stage in recipe.stages:
        found = [step_of(path) for path in (stage_folder(run, stage.name) / "checkpoints").glob("*.ckpt")]
        if own := sorted(step for step in found if step is not None):
            steps[stage.name] = own
    newest = {name: own[-1] for name, own in steps.items() if name not in finished}
    named, _, when = at.rpartition(":")
    if named:
        there = steps.get(recipe.stage(named, "--at").name, [])
        own = [step for step in there if when in (str(step), NEWEST)]
        having = {named: own[-1]} if own else {}
    elif when == NEWEST:
        having = newest
    else:
        having = {name: int(when) for name, own in steps.items() if when in map(str, own)}
    if not having:
        if at == NEWEST and any(stage.name in finished for stage in recipe.stages if stage.kind.trains):
            return {}
        listed = "; ".join(f"{name}: {', '.join(map(str, own))}" for name, own in steps.items())
        raise UserError(f"{run}: no such checkpoint for --at {at}; there is {listed or 'none yet'}")
    first = min(having, key=lambda name: (name in finished, not _gives(recipe.stage(name), what)))
    return {first: having[first]} | {**newest, first: having[first]}


def _gives(stage: Stage, *what: str) -> bool:
    return not stage.kind.gives(stage.config).isdisjoint(what)


def _write(
    place: Path,
    run: Path,
    recipe: Recipe,
    finished: Mapping[str, CompletedStage],
    chosen: Mapping[str, int],
    *,
    exact: bool,
) -> Path:
    """Write the run folder into `place`, and say how far each training is; returns it. `exact`: the first was
    asked for by its step.
    """
    first = next(iter(chosen))
    aside = make_console(aside=True)
    label = f"{first}-{chosen[first]}"
    folder = place / f"{run.resolve().name}-{label}"
    own = list[Stage]()
    outside = dict(recipe.outside)
    names = {name: name for name in outside}  # in the new recipe: stages outside it have paths
    for stage in recipe.stages:
        given = {role: names[source] for role, source in stage.inputs.items() if source in names}
        lacking = stage.inputs.keys() - given.keys()
        if stage.name in chosen:
            try:
                content = _read(run, stage.name, chosen[stage.name], aside, exact and stage.name == first)
                own.append(_take(stage.name, *content, folder, outside, aside))
            except UserError as error:
                if stage.name == first:
                    raise
                say(aside, f"without {stage.name}: {error}", "yellow")
                continue
            names[stage.name] = stage.name
        elif stage.name in finished and not lacking and outside.keys() >= set(given.values()):
            names[stage.name] = str(finished[stage.name].folder.resolve())
            outside[names[stage.name]] = finished[stage.name]
        elif not stage.kind.trains and _remains(stage, given, lacking):
            own.append(replace(stage, inputs=given))
            names[stage.name] = stage.name
        elif not stage.kind.trains and _gives(stage, GENERATOR, CAPTIONER):
            needed = ", ".join(sorted(stage.inputs[role] for role in lacking))
            say(aside, f"without {stage.name}: there is no checkpoint yet of {needed}", "yellow")
        elif stage.name in finished and _gives(stage, GENERATOR, CAPTIONER):
            changed = ", ".join(one.name for one in recipe.above(stage) if one.name in chosen)
            say(aside, f"without {stage.name}, which was trained with the finished {changed}", "yellow")
    name = f"{recipe.name}-{label}"
    own = _asked_first(own, first)
    new = replace(recipe, name=name, stages=tuple(own), outside=outside)
    write_text(folder / "recipe.yaml", new.to_yaml(folder))
    for stage in own:
        if not stage.kind.trains and _gives(stage, GENERATOR, CAPTIONER):
            home = stage_folder(folder, stage.name)
            cache = StageCache()
            seed = new.seed
            home.mkdir(parents=True)
            there = {**outside, **finished_stages(folder)}
            inputs = {role: there[source] for role, source in stage.inputs.items()}
            settings = stage.config, home, inputs, seed, new.hardware, aside, cache
            stage.kind.run(StageContext(stage.name, new.name, *settings))
            _finish(stage, folder, outside, seed)
    return folder


def _asked_first(stages: Sequence[Stage], first: str) -> list[Stage]:
    """Stages, each behind its inputs, and as early as can be the generators that `first` is part of: the
    first generator is the default, of a run as of a stage that reads every one.
    """
    named = {stage.name: stage for stage in stages}
    ordered = dict[str, Stage]()

    def above(stage: Stage) -> list[Stage]:
        return [named[name] for name in stage.inputs.values() if name in named]

    def asked(stage: Stage) -> bool:
        return stage.name == first or any(map(asked, above(stage)))

    def add(stage: Stage) -> None:
        for one in above(stage):
            add(one)
        ordered.setdefault(stage.name, stage)

    for stage in sorted(stages, key=lambda one: not (_gives(one, GENERATOR, CAPTIONER) and asked(one))):
        add(stage)
    places = [*ordered, *(name for stage in stages for name in stage.inputs.values() if name not in named)]
    return [
        replace(stage, inputs=dict(sorted(stage.inputs.items(), key=lambda item: places.index(item[1]))))
        for stage in ordered.values()
    ]


def _remains(stage: Stage, given: Iterable[str], lacking: Set[str]) -> bool:
    """Whether a stage that trains nothing is of use: a generator with all inputs, or one that reads any."""
    if _gives(stage, GENERATOR, CAPTIONER):
        return not lacking
    roles = stage.kind.roles()
    required = {role.name for role in roles if not role.optional}
    every = [role for role in roles if isinstance(role, Every)]
    there = {key.partition(".")[0] for key in given}
    return bool(every) and not lacking & required and {role.name for role in every if role.needed} <= there


def _take(
    name: str,
    path: Path,
    content: Checkpoint,
    folder: Path,
    outside: dict[str, CompletedStage],
    aside: Console,
) -> Stage:
    """Write a training's checkpoint as a finished stage of the run `folder`; returns its stage there."""
    from motionloom.models.training.averaging import AveragedWeights
    from motionloom.pipeline.training.trained_stage import describe

    source = path.parents[1]
    home = stage_folder(folder, name)
    hyper = content["hyper_parameters"]
    run = path.parents[3]
    for role, place in hyper["inputs"].items():
        if identity_of((source / place).resolve()) != hyper["identities"][role]:
            raise UserError(
                f"{path}: was trained on another '{role}' than is there now; "
                f"go on with the run: motionloom run {run / 'recipe.yaml'} -o {run}"
            )
    kind, config, given, seed = describe(content, path, {})
    net, facts = kind.build(config, kind.inputs.of(StageCache().given(given)), seed)
    weights = content["state_dict"]
    prefix = "net."
    try:
        net.load_state_dict({k.removeprefix(prefix): v for k, v in weights.items() if k.startswith(prefix)})
    except RuntimeError as error:
        raise UserError(f"{path}: of another version; {' '.join(str(error).split())[:200]}") from None
    if content["average"] is not None:
        AveragedWeights(config.train.ema).fill(net, content["average"])
    home.mkdir(parents=True)
    save_model(home, net, facts)
    rows = json.loads(content["log"]["rows"])
    write_text(home / FILE_NAME, "".join(f"{json.dumps(row)}\n" for row in rows))
    places = {role: str(stage.folder.resolve()) for role, stage in given.items()}
    outside.update(zip(places.values(), given.values(), strict=True))
    stage = Stage(name, kind, config, places)
    done = content["global_step"]
    _finish(stage, folder, outside, seed, done, Started.find(source))
    averaged = "" if content["average"] is None else ", averaged weights"
    say(aside, f"{name} at step {done:,} of {content['steps']:,}{averaged}")
    return stage


def _read(run: Path, name: str, step: int, aside: Console, exact: bool) -> tuple[Path, Checkpoint]:
    """A training's checkpoint and its content: a newer one where the training deletes it meanwhile, the one
    before where it is damaged and not `exact`ly this step was asked for.
    """
    from motionloom.pipeline.training.checkpointing import DamagedError, name_of, read_checkpoint, step_of

    folder = stage_folder(run, name) / "checkpoints"
    while True:
        path = folder / name_of(step)
        try:
            return path, read_checkpoint(path)
        except DamagedError as error:
            there = [step_of(file) or 0 for file in folder.glob("*.ckpt")]
            other = [one for one in there if (one < step and not exact if path.is_file() else one > step)]
            if not other:
                raise UserError(f"{path}: {error}; take another one by --at") from None
            if path.is_file():
                say(aside, f"{path}: {error}; the one before is used", "yellow")
            step = max(other)


def _finish(
    stage: Stage,
    folder: Path,
    outside: Mapping[str, CompletedStage],
    seed: int,
    step: int | None = None,
    started: Started | None = None,
) -> None:
    """Write the artifact of a stage of the new run; of a training, with what had changed by its `step`."""
    changed = tuple(change for change in started.changed if change.step < (step or 0)) if started else ()
    inputs = {}
    for role, name in stage.inputs.items():
        place = outside[name].folder if name in outside else stage_folder(folder, name)
        made = str(identity_of(place))
        seen = place_from(folder, place)
        inputs[role] = InputStage(stage=place.name, fingerprint=made, folder=seen)
    config = stage.config.dump()
    made_of = [source.fingerprint for source in inputs.values()]
    home = stage_folder(folder, stage.name)
    Artifact(
        stage=stage.name,
        kind=stage.kind.name,
        version=stage.kind.version,
        fingerprint=fingerprint_of([config, seed, step, made_of]),
        changed=changed,
        seed=seed,
        config=config,
        step=step,
        inputs=inputs,
        terms=terms_of(stage, home, inputs.values()),
    ).finish(home)
