"""A table of a paper as a file: its columns, its numbers as printed, and which model of ours each row is.

title: Reconstruction by different quantization methods (MPJPE)
section: "4.4"
measured: {data: Motion-X, split: test}
columns:
  - {name: All, unit: mm, better: lower, figure: reconstruction.mpjpe}
rows:
  - {method: Vanilla VQ (512), paper: "140.66", ours: {tokenizer: {kind: vq}}}

A model of ours is named by conditions: its kind, values of its config, and the stages that feed it.

{kind: gpt, where: {prior: tma, loss.align_weight: {above: 0}}, inputs: {tokenizer: {kind: h2vq}}}
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Literal

from pydantic import Field

from motionloom.datasets.base.config import Config
from motionloom.pipeline.store.run_state import StageRecord
from motionloom.pipeline.store.yaml import flatten

Scalar = bool | int | float | str | None


class Bounds(Config):
    """A number between bounds, themselves left out."""

    above: float = Field(-math.inf, allow_inf_nan=True)
    below: float = Field(math.inf, allow_inf_nan=True)


Condition = Bounds | list[Scalar] | Scalar
"""Condition on one value: bounds, any of several values, or the value itself."""


class StageMatch(Config):
    """Conditions that a stage must meet."""

    kind: str | list[str]
    """Its kind, or any of several."""
    where: dict[str, Condition] = Field(default_factory=dict)
    """Dotted keys of its config, such as `net.num_codes`."""
    inputs: dict[str, StageMatch | None] = Field(default_factory=dict)
    """Role -> what fills it; null: nothing may."""


def fits(match: StageMatch | None, stage: StageRecord | None) -> bool:
    """Whether a stage, or none, is what `match` wants; None wants none."""
    if match is None or stage is None:
        return match is None and stage is None
    return (
        stage.kind in ([match.kind] if isinstance(match.kind, str) else match.kind)
        and config_fits(match.where, stage.config)
        and all(fits(wanted, stage.inputs.get(role)) for role, wanted in match.inputs.items())
    )


def config_fits(where: Mapping[str, Condition], config: Mapping[str, object]) -> bool:
    """Whether every condition is met. A key that the config does not have meets none."""
    values = flatten(config)
    return all(key in values and _meets(condition, values[key]) for key, condition in where.items())


def _meets(condition: Condition, value: object) -> bool:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if isinstance(condition, Bounds):
        return number and condition.above < value < condition.below  # type: ignore[operator]
    wanted = condition if isinstance(condition, list) else [condition]
    # True is no 1.
    return any(isinstance(one, bool) == isinstance(value, bool) and one == value for one in wanted)


Measure = Literal["evaluate", "evaluate_dances", "retrieval"]
"""Source of a figure: a stage of one of the first two kinds, or the command `retrieval`."""

ROLES = ("tokenizer", "face_tokenizer", "generator", "face_generator", "alignment")
"""Roles of measured models; the last is measured by `retrieval`."""


class Column(Config):
    """A column of a paper's table."""

    name: str = Field(min_length=1)
    group: str = ""
    """Heading above several columns."""
    unit: str = ""
    better: Literal["lower", "higher"] | None = None
    figure: str | None = None
    """Name of our figure, such as `reconstruction.mpjpe`; `{protocol}` stands for a row's value. None: there
    is no such figure of ours, and `why` says why."""
    of: Measure = "evaluate"
    why: str = ""
    scale: float = 1.0
    """The paper's number is our figure times this: 100 where it prints percent."""
    differs: str = ""
    """Difference in definition between our figure and the paper's."""
    candidates: int | None = Field(None, ge=2)
    """Candidates of the paper's retrieval; ours are those of the evaluation."""
    data: str = ""
    """The data set, where columns of one table differ in it."""
    where: dict[str, Condition] = Field(default_factory=dict)
    """Further conditions on the config of a row's model, where the columns are its settings."""
    setting: dict[str, Scalar] = Field(default_factory=dict)
    """The paper's settings of this column's model; another one of ours is named below the table."""
    printed: bool = True
    """Whether the paper has this column; else it holds our figures alone."""

    @property
    def title(self) -> str:
        return f"{self.group} {self.name}".strip()


class Ours(Config):
    """Conditions on a run's models that belong to this row, by the role that an evaluation gives them."""

    tokenizer: StageMatch | None = None
    face_tokenizer: StageMatch | None = None
    generator: StageMatch | None = None
    face_generator: StageMatch | None = None
    alignment: StageMatch | None = None
    setting: dict[str, Scalar] = Field(default_factory=dict)
    """The paper's settings of the model; a stage of another one is this row all the same, and the difference
    is named below the table."""

    def conditions(self) -> dict[str, StageMatch | None]:
        """Role -> condition, as far as the file has them: None is one too."""
        return {role: getattr(self, role) for role in ROLES if role in self.model_fields_set}

    @property
    def role(self) -> str:
        """The role of the model that the row is about."""
        return next(role for role, match in self.conditions().items() if match is not None)


class Row(Config):
    """One row of the paper."""

    method: str = Field(min_length=1)
    """As the paper prints it."""
    paper: str
    """Its numbers, separated by |; - where the paper has none."""
    recorded: bool = False
    """Ground truth: ours are the recorded motions of the evaluations."""
    ours: Ours | None = None
    why: str = ""
    """Why no model of ours is this row."""
    values: dict[str, str] = Field(default_factory=dict)
    """Values of this row for `{...}` in a column's figure."""
    note: str = ""

    def printed(self) -> list[str]:
        """The paper's numbers, as text; empty where it has none."""
        cells = [cell.strip() for cell in self.paper.split("|")]
        return ["" if cell == "-" else cell for cell in cells]


class Measured(Config):
    """Protocol of the paper's numbers; None where it does not state one."""

    data: str
    split: str | None = "test"
    clips: int | None = None
    evaluator: str | None = None
    """The network that embeds motions and captions in the paper."""
    repeats: str | None = None
    sampling: str | None = None
    """The paper's settings of sampling."""
    spread: str | None = None
    """Meaning of the paper's ±."""
    note: str = ""


class DataSet(Config):
    """A data set of several that one table has columns of."""

    name: str
    hands: bool = True
    """Whether its motions have hands: our run on other data fills the columns of the first data set that is
    like its own."""


class PaperTable(Config):
    """A table of a paper."""

    title: str
    """Subject of the comparison."""
    section: str
    """Where the paper speaks of it."""
    measured: Measured
    data: list[DataSet] = Field(default_factory=list)
    """Where columns name theirs."""
    columns: list[Column] = Field(min_length=1)
    rows: list[Row] = Field(min_length=1)

    @property
    def measures(self) -> tuple[Measure, ...]:
        """Where its figures come from."""
        return tuple(dict.fromkeys(column.of for column in self.columns if column.figure is not None))
