"""A training whose settings have changed: whether it goes on from its newest checkpoint, and what is noted.

- `train.steps`: what has been trained is the beginning of what is wanted. Only a learning-rate schedule that
  ends with the training is stretched by it, which is said and noted.
- How a step is computed (`HOW`): the same up to rounding, so it goes on without being asked, and it is noted.
- What a step computes (`optim`, `loss`, `train`): another training. It goes on where the user says so
  (`--go-on`), with the weights and the optimizer's state, and it is noted.
- All else (the network, its inputs, the seed of the recipe) cannot change.

What is noted stands in `artifact.json` (`changed`), so that nobody takes such a model for one that was
trained with its last settings from the first step on.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pydantic import JsonValue

from motionloom.datasets.base.config import Config
from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.contract.stage import Stage
from motionloom.pipeline.runs.layers import Tree
from motionloom.pipeline.store.artifact import Change
from motionloom.pipeline.store.files import fingerprint_of
from motionloom.pipeline.store.yaml import flatten, setting_text
from motionloom.pipeline.training.config import TrainedStageConfig, optimizers_of

HOW = {"train.accumulate", "train.precision", "train.compile"}
_STEPS = "train.steps"


class TrainingFacts(Config):
    """All that a training's fingerprint covers."""

    config: dict[str, JsonValue]
    """By dotted keys."""
    others: str
    """Digest of all but the config: inputs, seed, version of the kind."""


class Started(Config):
    """`started.json`: what is being made in a stage's folder."""

    fingerprint: str
    training: TrainingFacts | None = None
    """None of a stage that trains nothing."""
    changed: tuple[Change, ...] = ()
    """Settings that have changed since the training began."""

    @staticmethod
    def find(folder: Path) -> Started | None:
        """The stage that was last started in a folder."""
        path = folder / "started.json"
        try:
            return Started.load_json(path) if path.is_file() else None
        except UserError as error:
            raise UserError(f"{error}; delete that file, and the stage is made anew") from None


@dataclass(frozen=True)
class Continuation:
    """How a training goes on with other settings."""

    step: int
    """Step of its newest checkpoint."""
    differs: str
    """The changes, in words."""
    reason: str
    changed: tuple[Change, ...]
    knowingly: bool
    """Whether the user must ask for it, since it becomes another training."""


def training_facts(stage: Stage, facts: Tree) -> TrainingFacts | None:
    """The facts of a stage's fingerprint as `started.json` keeps them."""
    if not isinstance(stage.config, TrainedStageConfig):
        return None
    others = {name: fact for name, fact in facts.items() if name != "config"}
    return TrainingFacts(config=flatten(facts["config"]), others=fingerprint_of(others))


def continuation(
    stage: Stage, wanted: TrainingFacts | None, before: Started, folder: Path
) -> Continuation | str:
    """How the training in `folder` goes on with other settings, or why it cannot, in words."""
    old = before.training
    step = newest_step(folder)
    if wanted is None or old is None or step is None:
        return "there is no checkpoint to go on from"
    config: TrainedStageConfig = stage.config
    # A change that no checkpoint has been trained with yet is replaced by the next, or taken back.
    noted = [change for change in before.changed if change.step < step]
    untried = (change for change in reversed(before.changed) if change.step >= step)
    trained = old.config | {change.key: change.old for change in untried}
    keys = sorted(key for key in trained.keys() | wanted.config if trained.get(key) != wanted.config.get(key))
    # Keys that say what a step computes, and nothing about the network.
    free = ("loss.", "train.", *(f"{key}." for key, _ in optimizers_of(config)))
    changes = [f"{key} {_say(trained, key)} -> {_say(wanted.config, key)}" for key in keys]
    fixed = [change for key, change in zip(keys, changes, strict=True) if not key.startswith(free)]
    if fixed or old.others != wanted.others:
        what = ", ".join(fixed) or "its inputs, its seed or the version of its kind"
        return f"what it is made of has changed ({what}); only {', '.join(f'{part}*' for part in free)} may"
    # What was to be trained further, and was not, is finished where it was.
    if step > config.train.steps or (step == config.train.steps and set(keys) - {_STEPS}):
        return f"step {step} is its last; raise {stage.name}.{_STEPS}"
    differs = ", ".join(changes) or "as it was trained"
    schedule = config.schedule_of_length()
    reason = f"{differs}: goes on from step {step}"
    if _STEPS in keys and schedule is not None:
        reason += f"; {schedule} now ends with step {config.train.steps}, which is not the same as at once"
    noted += [
        Change(step=step, key=key, old=trained.get(key), new=wanted.config.get(key))
        for key in keys
        if key != _STEPS or schedule is not None
    ]
    # What was asked for once, and has not been trained with yet, is not asked for again.
    asked = {key for key in keys if old.config.get(key) != wanted.config.get(key)}
    return Continuation(step, differs, reason, tuple(noted), bool(asked - HOW - {_STEPS}))


def newest_step(folder: Path) -> int | None:
    """The step of the newest checkpoint in a stage's folder; None without one."""
    names = (path.stem.partition("=")[2] for path in (folder / "checkpoints").glob("step=*.ckpt"))
    return max((int(name) for name in names if name.isdecimal()), default=None)


def _say(config: dict[str, JsonValue], key: str) -> str:
    return setting_text(config.get(key))
