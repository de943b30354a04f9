"""What stands beside the papers' rows is measured as their recipes say: sampling, songs."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from motionloom.datasets.shards.clips import ClipDataset
from motionloom.pipeline.evaluation.dances import song_of
from motionloom.pipeline.evaluation.estimate import set_estimates
from motionloom.pipeline.runs.recipe import load_recipe

DRAWING = ("generate", "evaluate", "evaluate_dances", "report")


@pytest.mark.parametrize("size", ["tiny", "paper"])
@pytest.mark.parametrize(
    ("name", "temperature", "repeats"),
    [
        ("", None, {"paper": 3, "tiny": 2}),
        ("-no-z", 0.0, {"paper": 30, "tiny": 2}),
        ("-no-z-vq-decoder", 0.0, {"paper": 1, "tiny": 1}),
        ("-vq-decoder", 0.0, {"paper": 30, "tiny": 2}),
        ("-gru", 0.0, {"paper": 1, "tiny": 1}),
    ],
)
def test_every_stage_of_an_ablation_draws_alike(
    size: str, name: str, temperature: float | None, repeats: dict[str, int]
) -> None:
    """Tables 3 to 5: greedy tokens, whatever measures them; as often for music as for words."""
    recipe = load_recipe(f"ude-{size}{name}")
    stages: dict[str, Any] = {stage.name: stage.config for stage in recipe.stages if stage.name in DRAWING}
    nested = {stages[kind].decodings for kind in ("evaluate", "evaluate_dances")}
    assert nested == {30 if (size, name) == ("paper", "") else 1}, (
        "3 draws of tokens x 30 decodings (Table 1)"
    )
    assert stages.keys() == set(DRAWING)
    drawn = [config.sampling for config in stages.values()]
    assert all(sampling == drawn[0] for sampling in drawn)
    if temperature is not None:
        assert drawn[0].temperature == temperature
    assert {stages[kind].repeats for kind in ("evaluate", "evaluate_dances")} == {repeats[size]}


@pytest.mark.parametrize(
    "name", [f"{kind}-paper" for kind in ("humantomato", "baselines", "t2m-gpt", "ude")] + ["ude-paper-gru"]
)
def test_paper_recipes_evaluate_all_clips(name: str) -> None:
    """Among 256 by TMA, where the paper does; UDE's retrieval has a judge."""
    stages = [stage for stage in load_recipe(name).stages if stage.kind.name.startswith("evaluate")]
    configs: list[Any] = [stage.config for stage in stages]
    assert stages and {config.clips for config in configs} == {None}
    sizes = {config.size for config in configs if hasattr(config, "size")}
    assert sizes == {32 if name.startswith("ude") else 256}
    (inputs,) = [stage.inputs for stage in stages if stage.name == "evaluate"]
    assert inputs.get("tma") == "tma"
    # The judge of HumanTOMATO's columns, which is the evaluator of Guo et al.; UDE has none of them.
    assert ("evaluator" in inputs) != name.startswith("ude")


def test_decodings_of_one_draw_of_tokens_count_as_one() -> None:
    """Three draws decoded twice each: their interval is over three means, not over six repeats."""
    values = [1.0, 3.0, 4.0, 6.0, 8.0, 10.0]
    found = set_estimates([{"fid": value} for value in values], nested=2)["fid"]
    assert found == set_estimates([{"fid": 2.0}, {"fid": 5.0}, {"fid": 9.0}])["fid"]
    once = set_estimates([{"fid": value} for value in values], nested=6)["fid"]
    assert once == set_estimates([{"fid": value} for value in values])["fid"], "one draw: over decodings"


def test_recorded_dances_carry_their_song() -> None:
    """Clips of one piece are of one song, as those of the synthetic source; else each is its own."""
    metas = [
        SimpleNamespace(song="mBR0", truth=None), SimpleNamespace(song="mBR0", truth=None),
        SimpleNamespace(song=None, truth={"song": 7}), SimpleNamespace(song=None, truth=None),
    ]  # fmt: skip
    dataset = cast(ClipDataset, SimpleNamespace(ids=list("abcd"), meta=lambda i: metas[i]))
    assert [song_of(dataset, i) for i in range(4)] == ["mBR0", "mBR0", "7", "d"]
