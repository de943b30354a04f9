"""Licences and credits of data travel into everything that is made from it; the strictest holds."""

from __future__ import annotations

import json
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from bvh_clips import write_clip

from motionloom.datasets.base.licences import CMU, CREDITS, UNKNOWN, credits_of, strictest
from motionloom.datasets.schema import Manifest
from motionloom.pipeline.store.artifact import Artifact, InputStage, Terms

ORDER = (
    "CC0-1.0", CMU, "CC-BY-3.0", "CC-BY-SA-3.0", "CC-BY-NC-4.0", "CC-BY-NC-SA-4.0", "CC-BY-NC-ND-4.0",
    "bones-seed-license",
)  # fmt: skip
NAMES = (
    *ORDER, "MIT", "CC-BY-4.0", "CC-BY-2.1-JP", "AMASS-noncommercial", UNKNOWN, "",
    "CC-BY-4.0 AND LicenseRef-AIST-Dance-DB",
)  # fmt: skip


def test_order() -> None:
    assert all(strictest(pair) == pair[1] for pair in pairwise(ORDER))
    assert strictest(["CC-BY-4.0", CMU, "CC-BY-3.0"]) == "CC-BY-3.0 AND CC-BY-4.0"
    assert strictest([]) == strictest(["", "CC0-1.0"]) == UNKNOWN
    assert strictest(["CC-BY-4.0 AND LicenseRef-AIST-Dance-DB"]) == "LicenseRef-AIST-Dance-DB"


def test_who_is_to_be_named() -> None:
    assert credits_of(["CC0-1.0", "MIT", UNKNOWN], "x") == []
    assert credits_of([CMU], "x") == [CREDITS[CMU]]
    [asked] = credits_of(["CC-BY-4.0"], "walks")
    assert "'walks'" in asked and "CC-BY-4.0" in asked
    assert credits_of([CMU, "CC-BY-4.0"], "x", ["by A"]) == ["by A", CREDITS[CMU]]


def test_any_mix_of_any_stages_knows_all_of_its_data(tmp_path: Path) -> None:
    """Random graphs of stages: a stage has what all data above it has, whatever way it came."""
    random = np.random.default_rng(0)
    for number in range(60):
        stages: list[tuple[Path, set[str]]] = []
        for at in range(int(random.integers(2, 9))):
            folder = tmp_path / str(number) / "stages" / str(at)
            folder.mkdir(parents=True)
            above = [stages[i] for i in random.choice(at, size=min(at, 3), replace=False)] if at > 1 else []
            own = (
                set(random.choice(NAMES, size=random.integers(0, 3)))
                if above
                else {str(random.choice(NAMES))}
            )
            terms = Terms.union([Terms(licences=tuple(own)), Terms.of(place for place, _ in above)])
            inputs = {place.name: InputStage(stage=place.name, fingerprint="0") for place, _ in above}
            Artifact(
                stage=str(at), kind="mix", version=1, fingerprint="0", seed=0, config={}, inputs=inputs,
                terms=terms,
            ).finish(folder)  # fmt: skip
            stages.append((folder, own.union(*(found for _, found in above))))
        for folder, wanted in stages:
            terms = Terms.of([folder])
            assert set(terms.licences) == wanted and terms.licence == strictest(wanted)
        parts = [Terms.of([folder]) for folder, _ in stages]
        everything = {name for _, found in stages for name in found}
        assert (
            Terms.union(parts).licence == strictest(part.licence for part in parts) == strictest(everything)
        )
    (folder / "artifact.json").write_text((folder / "artifact.json").read_text().replace('"terms"', '"code"'))
    assert Terms.of([tmp_path / "gone"]).licence == UNKNOWN


RECIPE = """
name: credited
hardware: {accelerator: cpu, threads: 1, convert_workers: 1}
defaults: {trained: {train: {steps: 2, batch_size: 2}}}
stages:
  cmu: &clips
    {kind: bvh, source: AT/cmu, captions: AT/cmu/words.csv, licence: CMU-mocap, splits: AT/cmu}
  walks:
    {<<: *clips, source: AT/walks, captions: AT/walks/words.csv, licence: CC-BY-4.0, splits: AT/walks,
     name: walks}
  data: {kind: mix, inputs: {data: [cmu, walks]}, allow_leaks: true}
  stats: {kind: stats}
  text: {kind: text}
  tokenizer: {kind: rvq, net: {part: body, width: 8, depth: 1, code_dim: 8, num_codes: 8, levels: 1}}
  tokens: {kind: tokens}
  gpt: {kind: gpt, net: {layers: 1, dim: 16, heads: 2, ff: 16}, prior: sentence, loss: {align_weight: 0.0}}
"""


def test_from_files_to_card_and_page(tmp_path: Path, call: Callable[..., Any]) -> None:
    for number, name in enumerate(("cmu", "walks")):
        (tmp_path / name).mkdir()
        for clip in range(4):
            write_clip(tmp_path / name / f"{name}{clip}.bvh", 10 * number + clip)
        rows = [f"{name}{clip},a person walks" for clip in range(4)]
        (tmp_path / name / "words.csv").write_text("\n".join(["name,caption", *rows]))
        for split, clips in (("train", "01"), ("val", "2"), ("test", "3")):
            (tmp_path / name / f"{split}.txt").write_text("\n".join(f"{name}{clip}" for clip in clips))
    (tmp_path / "recipe.yaml").write_text(RECIPE.replace("AT", str(tmp_path)))
    run, model = tmp_path / "run", tmp_path / "model"
    assert call("run", tmp_path / "recipe.yaml", "-o", run).code == 0
    manifest = Manifest.load_json(run / "stages/cmu/shards/manifest.json")
    assert manifest.credits == [CREDITS[CMU]]
    [walks] = Manifest.load_json(run / "stages/walks/shards/manifest.json").credits
    expected = {"licences": [*sorted([CMU, "CC-BY-4.0"])], "credits": [CREDITS[CMU], walks]}
    for stage in ("data", "tokenizer", "gpt"):
        assert json.loads((run / f"stages/{stage}/artifact.json").read_text())["terms"] == expected
    done = call("export", run, "-o", model)
    assert done.code == 0 and "CC-BY-4.0, the strictest of its data" in done.out + done.err
    assert json.loads((model / "gpt/artifact.json").read_text())["terms"] == expected
    card = (model / "README.md").read_text()
    assert "\nlicense: cc-by-4.0\n" in card and CREDITS[CMU] in card and walks in card
    assert call("generate", model, "a person walks", "-o", tmp_path / "out", "--format", "html").code == 0
    assert CREDITS[CMU].split(". ")[0] in next((tmp_path / "out").glob("*.html")).read_text()
