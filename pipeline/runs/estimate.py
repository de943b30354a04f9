"""What a recipe's trainings will take, before they run: each stage that trains is asked."""

from __future__ import annotations

from collections.abc import Collection

from rich.table import Table

from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.lookup import previews
from motionloom.pipeline.contract.showing import ModelCard
from motionloom.pipeline.runs.recipe import Recipe


def estimate(recipe: Recipe, names: Collection[str] | None = None) -> dict[str, ModelCard]:
    """A card for each stage that trains, of `names` or of all; `UserError` when the layout of the data is not
    known.
    """
    stages = {stage.name: stage for stage in recipe.stages} | dict(recipe.outside)
    cards = {}
    for stage in recipe.stages:
        if names is not None and stage.name not in names:
            continue
        try:
            card = stage.kind.estimate(stage.config, previews(stage, stages), recipe.hardware)
        except UserError as error:
            raise UserError(f"stage {stage.name}: {error}") from None
        if card is not None:
            cards[stage.name] = card
    return cards


def estimate_table(cards: dict[str, ModelCard]) -> Table:
    """For a terminal."""
    table = Table(title="what the trainings take (one process)", title_justify="left")
    for column in ("stage", "parameters", "batch", "memory", "tokens"):
        table.add_column(column, overflow="fold")
    for name, card in cards.items():
        parameters = _count(card.parameters)
        if card.codebook:
            parameters += f" + {_count(card.codebook)} codebook"
        table.add_row(name, parameters, str(card.local_batch), _size(card.memory_bytes), card.note)
    return table


def _count(number: int) -> str:
    return f"{number / 1e6:.1f} M" if number >= 1e5 else f"{number / 1e3:.1f} k"


def _size(count: int) -> str:
    return f"{count / 2**30:.1f} GiB" if count >= 2**30 / 10 else f"{count / 2**20:.1f} MiB"
