"""Training longer: a stage of which only `train.steps` was raised goes on from its last checkpoint.

`started.json` holds, beside the fingerprint, a digest of all that the fingerprint covers but the number of
steps. Where that is the same and no learning-rate schedule ends with the training, what has been trained is
the beginning of what is wanted.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from motionloom.pipeline.contract.stage import Stage
from motionloom.pipeline.stages.train_config import TrainedStageConfig
from motionloom.pipeline.store.files import fingerprint_of


def extendable(stage: Stage, facts: dict[str, Any]) -> dict[str, Any] | None:
    """What `started.json` keeps of a stage that trains: its steps, and a digest of the other facts."""
    if not isinstance(stage.config, TrainedStageConfig):
        return None
    fields = dict(facts["config"])
    fields["train"] = {name: value for name, value in fields["train"].items() if name != "steps"}
    return {"steps": stage.config.train.steps, "others": fingerprint_of({**facts, "config": fields})}


def extension(stage: Stage, wanted: dict[str, Any] | None, folder: Path) -> tuple[bool, str] | None:
    """Whether a stage whose fingerprint has changed goes on from its checkpoints, and why (not).

    None where more than its steps has changed, or they became fewer, or nothing is there to go on from.
    """
    started = folder / "started.json"
    if wanted is None or not started.is_file():
        return None
    before = json.loads(started.read_text()).get("extendable")
    if before is None or before["others"] != wanted["others"] or before["steps"] >= wanted["steps"]:
        return None
    steps = f"train.steps {before['steps']} -> {wanted['steps']}"
    assert isinstance(stage.config, TrainedStageConfig)
    schedule = stage.config.schedule_of_length()
    if schedule is not None:
        return False, f"changed: {steps}, and {schedule} depends on it"
    if not any((folder / "checkpoints").glob("*.ckpt")):
        return None
    return True, f"{steps}: goes on from its last checkpoint"
