"""The plan of a run: the action for each stage of a recipe in a run folder, and the reason.

A stage's fingerprint covers its kind and version, its full resolved config, the seed, facts about outside
files, the fingerprints of its inputs and, of a kind from another package, that package's code. A stage is
finished when its folder holds an `artifact.json` with that fingerprint and every output it lists. Anything
else runs, and whatever is below it has another fingerprint and runs too.

A training whose settings have changed may go on from its newest checkpoint (`continuation.py`).

`--from` runs stages again: what they made is removed as the run begins, and the run folder notes the
selection until all of them are done, so that the same command after a kill goes on, not begins again.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.licences import UNKNOWN
from motionloom.datasets.base.register import code_of
from motionloom.pipeline.contract.fingerprint import fingerprint_fields
from motionloom.pipeline.contract.stage import Every, NotThereError, Stage
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.runs.continuation import Continuation, Started, continuation, training_facts
from motionloom.pipeline.runs.inputs import require_elsewhere
from motionloom.pipeline.runs.layers import Tree
from motionloom.pipeline.runs.recipe import Recipe
from motionloom.pipeline.store.artifact import Artifact, InputStage, Terms
from motionloom.pipeline.store.data import Data
from motionloom.pipeline.store.files import fingerprint_of, read_record
from motionloom.pipeline.store.run_folder import identity_of, stage_folder
from motionloom.pipeline.store.yaml import flatten
from motionloom.pipeline.training.config import TrainedStageConfig

REQUEST_FILE = ".again.json"
"""In the run folder, while stages are run again: the selection that names them."""

Action = Literal["skip", "run", "resume", "leave"]


@dataclass(frozen=True)
class Selection:
    """Which part of the graph to run."""

    first: str | None = None
    """Run this stage and all below it again."""
    until: str | None = None
    """Stop after this stage: only it and what it needs. Several with commas between them."""


@dataclass(frozen=True)
class PlannedStage:
    """One row of the plan."""

    stage: Stage
    action: Action
    reason: str
    started: Started
    """Content of `started.json` in the stage's folder."""
    again: Mapping[str, str | None] | None
    """The selection by which the stage is run again (`--from`)."""
    identities: Mapping[str, str]
    """Identities of its inputs from outside when the plan was made."""
    code: Mapping[str, str]
    """sha256 of the code from other packages that it runs, by module, when the plan was made."""
    goes_on: Continuation | None = None
    """How a training that is to be replaced could go on, if the user asked for it (`--go-on`)."""

    @property
    def fingerprint(self) -> str:
        return self.started.fingerprint


def make_plan(
    recipe: Recipe, run: Path, select: Selection | None = None, go_on: Collection[str] = ()
) -> list[PlannedStage]:
    """Decide for every stage, in order, what happens to it.

    Trainings in `go_on` go on from their newest checkpoints although what they compute has changed.
    """
    select = select or Selection()
    wanted = selected(recipe, select)
    forced = _descendants(recipe, select.first) & wanted if select.first else set()
    for name in go_on:
        if not recipe.stage(name, "--go-on").kind.trains:
            raise UserError(f"--go-on {name}: this stage trains nothing; name one that does")
        if name in forced:
            raise UserError(f"--go-on {name} --from {select.first}: the latter begins it anew; leave one out")
    goes_on_again = _begun_again(run, select, forced)
    rows: dict[str, PlannedStage] = {}
    # In the recipe's order, since a fingerprint needs those of the inputs.
    for stage in recipe.stages:
        require_elsewhere(run, stage, recipe.outside)
        facts = _facts(recipe, stage, rows)
        folder = stage_folder(run, stage.name)
        before = Started.find(folder)
        again = asdict(select) if stage.name in forced else None
        started = Started(fingerprint=fingerprint_of(facts), training=training_facts(stage, facts))
        action, reason = _decide(recipe, stage, started, before, folder, rows)
        if again is not None and not goes_on_again:
            action = "run"
            reason = f"from {select.first}"
        changed = before.changed if before is not None and action == "resume" else ()
        goes_on: Continuation | str | None = None
        if before is not None and action == "run" and again is None:
            goes_on = continuation(stage, started.training, before, folder)
            if isinstance(goes_on, Continuation) and (stage.name in go_on or not goes_on.knowingly):
                action = "resume"
                reason = goes_on.reason
                changed = goes_on.changed
            elif reason == _UNFINISHED:
                reason += f": {goes_on if isinstance(goes_on, str) else goes_on.differs}"
        if stage.name in go_on and action == "run":
            why = "it has not begun" if goes_on is None else goes_on
            raise UserError(f"--go-on {stage.name}: {why}")
        # A stage outside the selection is left as it is, outdated or not.
        if stage.name not in wanted and action != "skip":
            action = "leave"
            reason = "not selected"
        started = started.model_copy(update={"changed": changed})
        identities = {n: _fingerprint(recipe, n, rows) for n in stage.inputs.values() if n in recipe.outside}
        rows[stage.name] = PlannedStage(
            stage, action, reason, started, again, identities, facts.get("code", {}),
            goes_on if isinstance(goes_on, Continuation) else None,
        )  # fmt: skip
    return list(rows.values())


def require_fit(stages: Iterable[Stage], hardware: Hardware) -> None:
    """Refuse, before anything runs, stages whose settings cannot run on this hardware."""
    for stage in stages:
        try:
            stage.config.require_fit(hardware)
        except UserError as error:
            raise UserError(f"stage {stage.name}: {error}") from None


def selected(recipe: Recipe, select: Selection) -> set[str]:
    """Names of the stages that may run; refuses selections that contradict each other."""
    first = select.first
    until = select.until
    last = [name.strip() for name in until.split(",")] if until is not None else []
    named = [("--from", first), *(("--until", name) for name in last)]
    for option, name in named:
        if name is not None:
            recipe.stage(name, option)
    needed = _ancestors(recipe, *last)
    if first and until and first not in needed:
        raise UserError(
            f"--from {first} --until {until}: '{until}' does not need '{first}', so there is nothing between "
            f"them; leave one out"
        )
    return needed if until is not None else {stage.name for stage in recipe.stages}


def _facts(recipe: Recipe, stage: Stage, rows: dict[str, PlannedStage]) -> Tree:
    """The facts that a stage's fingerprint is the digest of."""
    try:
        external = stage.kind.external(stage.config)
    except NotThereError as error:
        raise UserError(f"{error}; name yours with --set {stage.name}.{error.field}=FOLDER") from None
    facts = {
        "kind": stage.kind.name,
        "version": stage.kind.version,
        "seed": recipe.seed,
        "config": json.loads(json.dumps(fingerprint_fields(stage.config), default=str)),
        "external": external,
        "inputs": {role: _fingerprint(recipe, name, rows) for role, name in stage.inputs.items()},
    }
    if any(isinstance(role, Every) for role in stage.kind.roles()):
        facts["order"] = list(stage.inputs)  # the first of several generators is the default
    if code := code_of(stage.kind.modules(stage.config)):
        facts["code"] = code
    return facts


def _fingerprint(recipe: Recipe, name: str, rows: Mapping[str, PlannedStage]) -> str:
    """An input's fingerprint, or its identity where it comes from outside."""
    if name in rows:
        return rows[name].fingerprint
    return str(identity_of(recipe.outside[name].folder))


def _begun_again(run: Path, select: Selection, forced: set[str]) -> bool:
    """Whether this very selection has begun to run stages again, and some of them are not done."""
    note = run / REQUEST_FILE
    if not note.is_file() or read_record(note) != asdict(select):
        return False
    return any(Artifact.find(stage_folder(run, name)) is None for name in forced)


_UNFINISHED = "changed before it finished"


def _decide(
    recipe: Recipe,
    stage: Stage,
    started: Started,
    before: Started | None,
    folder: Path,
    rows: Mapping[str, PlannedStage],
) -> tuple[Action, str]:
    artifact = Artifact.find(folder)
    if artifact is None or artifact.fingerprint != started.fingerprint:
        if before is not None and before.fingerprint == started.fingerprint:
            return "resume", "started earlier, not finished"
        if artifact is not None:
            return "run", _difference(recipe, artifact, stage, rows)
        if before is None:
            return "run", "never run"
        return "run", _UNFINISHED
    gone = artifact.missing(folder)
    if gone:
        return "run", f"output {gone} is gone or has another size"
    return "skip", "finished"


def _difference(recipe: Recipe, artifact: Artifact, stage: Stage, rows: Mapping[str, PlannedStage]) -> str:
    if artifact.kind != stage.kind.name or artifact.version != stage.kind.version:
        return f"{artifact.kind} v{artifact.version} is now {stage.kind.name} v{stage.kind.version}"
    old_fields = flatten(artifact.config)
    fields = flatten(stage.config.dump())
    changes = [
        f"{key} {old_fields.get(key)} -> {fields.get(key)}"
        for key in sorted(old_fields.keys() | fields.keys())
        if old_fields.get(key) != fields.get(key)
    ]
    if changes:
        more = f" (+{len(changes) - 1} more)" if len(changes) > 1 else ""
        return f"changed: {changes[0]}{more}"
    code = code_of(stage.kind.modules(stage.config))
    if edited := sorted({name for name, _ in code.items() ^ artifact.code.items()}):
        return f"code of {' and '.join(edited)} changed"
    for role, name in stage.inputs.items():
        old = artifact.inputs.get(role)
        if old is None or old.fingerprint != _fingerprint(recipe, name, rows):
            return f"input {name} changed"
    if artifact.seed != recipe.seed:
        keep = "" if stage.kind.trains else "; defaults.trained.train.seed is that of the trainings alone"
        return f"seed {artifact.seed} -> {recipe.seed}{keep}"
    return "source files or the order of inputs changed"


def _ancestors(recipe: Recipe, *names: str) -> set[str]:
    """These stages and all that they need."""
    out: set[str] = set()
    todo = list(names)
    while todo:
        current = todo.pop()
        out.add(current)
        todo += [stage.name for stage in recipe.above(recipe.stage(current))]
    return out


def _descendants(recipe: Recipe, name: str) -> set[str]:
    out = {name}
    for stage in recipe.stages:
        if out & set(stage.inputs.values()):
            out.add(stage.name)
    return out


def terms_of(stage: Stage, folder: Path, inputs: Iterable[InputStage]) -> Terms:
    """Licences and credits of all that a stage was made from."""
    sources = [source.place(folder) for source in inputs]
    own = Data(folder).terms()
    # Data of a kind that keeps no manifest, or weights that others have trained, may be under any licence.
    brought = "data" in stage.kind.gives(stage.config) and not sources and not own.licences
    if brought or getattr(stage.config, "published", None) is not None:
        own = Terms(licences=(UNKNOWN,))
    return Terms.union([own, Terms.of(sources)])


def doubts(recipe: Recipe, run: Path, stages: Iterable[Stage]) -> list[str]:
    """Return a sentence on each setting of these stages that runs, and will hardly do what is meant.

    How many clips there are is known where the stage that makes them is finished.
    """
    trained = [stage for stage in stages if isinstance(stage.config, TrainedStageConfig)]
    return [f"{stage.name}: {doubt}" for stage in trained for doubt in _doubts(recipe, run, stage)]


def _doubts(recipe: Recipe, run: Path, stage: Stage) -> Iterator[str]:
    yield from stage.config.doubts()
    batch = stage.config.train.batch_size
    steps = stage.config.train.steps
    for name in dict.fromkeys(stage.inputs.values()):
        outside = recipe.outside.get(name)
        source = outside or recipe.stage(name)
        folder = stage_folder(run, name) if outside is None else outside.folder
        if "data" not in source.kind.gives(source.config) or Artifact.find(folder) is None:
            continue
        clips = Data(folder).clips("train")
        if 0 < clips < batch:
            yield (
                f"{name} has {clips:,} training clips and a batch {batch:,}, so each of {steps:,} steps "
                f"sees every clip {batch / clips:.1f} times; set train.batch_size"
            )
