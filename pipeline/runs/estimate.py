"""What a recipe's trainings will take, before they run: each stage that trains is asked."""

from __future__ import annotations

from rich.table import Table

from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.lookup import previews
from motionloom.pipeline.contract.showing import ModelCard
from motionloom.pipeline.runs.recipe import Recipe


def estimate(recipe: Recipe) -> dict[str, ModelCard]:
    """A card for each stage that trains, by name; `UserError` when the layout of the data is not known."""
    stages = {stage.name: stage for stage in recipe.stages}
    cards = {}
    for stage in recipe.stages:
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
        parameters = f"{card.parameters / 1e6:.1f} M"
        if card.codebook:
            parameters += f" + {card.codebook / 1e6:.1f} M codebook"
        memory = f"{card.memory_bytes / 2**30:.1f} GiB"
        table.add_row(name, parameters, str(card.local_batch), memory, card.note)
    return table
