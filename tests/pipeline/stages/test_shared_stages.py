"""Stages whose work all processes share: the same files, bit for bit, by one process and by two."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.slow

FIGURES = {"evaluate": "metrics.json"}
CAPTIONS = """
extends: small
name: small
stages:
  evaluate: {clips: 7, repeats: 3, size: 4}
"""
DANCES = """
extends: ude-small
name: ude-small
stages:
  evaluate: {kind: evaluate, clips: 5, repeats: 2, size: 4}
  evaluate_dances: {kind: evaluate_dances, clips: 3, repeats: 2, decodings: 2, shuffles: 1, pool: 4}
"""


def run(start: Callable[..., Any], *arguments: object) -> str:
    process = start(*arguments)
    output: str = process.communicate(timeout=240)[0]
    assert process.returncode == 0, output
    return output


@pytest.mark.parametrize(
    ("given", "recipe", "makers", "stages"),
    [
        ("small_run", CAPTIONS, ["gpt", "face_gpt"], {"tokens": "tokens-train.safetensors", **FIGURES}),
        ("ude_run", DANCES, ["ude"], {**FIGURES, "evaluate_dances": "metrics.json"}),
    ],
)
def test_two_processes_make_what_one_makes(
    given: str, recipe: str, makers: list[str], stages: dict[str, str], start: Callable[..., Any],
    tmp_path: Path, request: pytest.FixtureRequest,
) -> None:  # fmt: skip
    small: Any = request.getfixturevalue(given)
    shutil.copy(small.recipe, tmp_path / small.recipe.name)
    (tmp_path / "shared.yaml").write_text(recipe)
    made: list[dict[str, bytes]] = []
    for devices in (1, 2):
        folder = tmp_path / f"run{devices}"
        shutil.copytree(small.folder, folder)
        for stage in stages:
            run(
                start, "run", tmp_path / "shared.yaml", "--out", folder, "--from", stage, "--until", stage,
                "--set", f"hardware.devices={devices}",
            )  # fmt: skip
        assert not list(folder.glob("stages/*/work"))
        made.append({name: (folder / "stages" / name / file).read_bytes() for name, file in stages.items()})
    assert made[0] == made[1]
    for folder in (tmp_path / "run1", tmp_path / "run2"):
        # Again, by one process and by two, with the settings of the run's own recipe.
        again = run(start, "evaluate", folder)
        assert (folder / "evaluate/metrics.json").read_bytes() == made[0]["evaluate"]
        if "evaluate_dances" in stages:
            dances = folder / "evaluate/evaluate_dances/metrics.json"
            assert dances.read_bytes() == made[0]["evaluate_dances"]
        else:
            assert "R@1" in again
            figures = json.loads(made[0]["evaluate"])["figures"]
            assert {"tma.t2m_r1", "tma.matching_score"} <= {one["name"] for one in figures}
    # And what the export makes in the place of the run.
    run(start, "export", folder, "-o", tmp_path / "model")
    generators = [str(tmp_path / "model" / name) for name in makers]
    for stage in (name for name in stages if name.startswith("evaluate")):
        where = f"{stage}.inputs.generators={json.dumps(generators)}"
        run(
            start, "run", tmp_path / "shared.yaml", "--out", folder, "--from", stage, "--until", stage,
            "--set", where,
        )  # fmt: skip
        found = json.loads((folder / "stages" / stage / stages[stage]).read_text())
        before = json.loads(made[0][stage])
        assert before["about"]["made_by"] != found["about"]["made_by"]
        assert all(before[key] == found[key] for key in ("figures", "protocol"))
