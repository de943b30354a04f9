"""`ude-paper` as it comes, on what the converters make of AMASS with HumanML3D's captions and of AIST++."""

from __future__ import annotations

import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import amass_clips
import pytest

from motionloom.pipeline.evaluation.figures import MODEL, NEAREST_WORDS, FigureFile
from motionloom.pipeline.results.paper.compare import paper_table
from motionloom.pipeline.results.paper.fill import fill

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]

Call = Callable[..., Any]
DANCES = {"train": ["01", "02", "03"], "val": ["04"], "test": ["05", "06"]}
SMALL = """
extends: ude-paper
name: ude-paper-small
hardware: {accelerator: cpu, threads: 1}
defaults:
  trained: {train: {steps: 2, batch_size: 4, precision: 32-true, checkpoint_every: 2, validate_every: 2}}
stages:
  captioned: {path: texts}
  dances: {path: dances}
  text: {encoder: minilm}
  tokenizer: {net: {width: 16, code_dim: 8, num_codes: 16}, train: {batch_size: 4}}
  utt:
    net: {layers: 1, dim: 16, heads: 2, ff: 16}
    mate: {dim: 16, layers: 1, heads: 2, ff: 16}
    loss: {discriminator: {dim: 16, ff: 16, heads: 2}}
  dmd: {net: {dim: 80, ff: 16, encoder_layers: 1, decoder_layers: 1, heads: 2}}
  tma: {net: {latent: 16, ff: 16, layers: 1, heads: 2}, train: {steps: 2, batch_size: 4}}
  ude: {denoising_steps: 2}
  generate: {count: 1}
  evaluate: {decodings: 2}
  evaluate_dances: {decodings: 2}
"""


def amass(folder: Path) -> None:
    """Walks with HumanML3D's index, captions and splits."""
    rows = ["source_path,start_frame,end_frame,new_name"]
    ids: dict[str, list[str]] = {"train": [], "val": [], "test": []}
    (folder / "texts").mkdir(parents=True)
    for number in range(8):
        name, split = f"{number:06d}", {5: "val", 6: "test", 7: "test"}.get(number, "train")
        walk = amass_clips.walk(100.0, seconds=4.0 + 0.3 * number)
        amass_clips.save(folder / f"amass/KIT/3/walk{number}_poses.npz", **walk)
        rows.append(f"./pose_data/KIT/3/walk{number}_poses.npy,0,1000,{name}.npy")
        for one, side in ((name, "left"), (f"M{name}", "right")):
            (folder / f"texts/{one}.txt").write_text(f"walks {side} for {number} m#walk/VERB#0.0#0.0\n")
            ids[split].append(one)
    (folder / "index.csv").write_text("\n".join(rows))
    for split, names in ids.items():
        (folder / f"{split}.txt").write_text("\n".join(names))


def aistpp(fixture: Path, folder: Path) -> None:
    """Pieces of a real recording as dances to one song."""
    whole = pickle.loads((fixture / "motions/gBR_sBM_cAll_d04_mBR0_ch01.pkl").read_bytes())
    for name in ("motions", "splits", "wavs"):
        (folder / name).mkdir(parents=True)
    shutil.copyfile(fixture / "wavs/mBR0.wav", folder / "wavs/mBR0.wav")
    for split, numbers in DANCES.items():
        ids = [f"gBR_sBM_cAll_d04_mBR0_ch{number}" for number in numbers]
        (folder / f"splits/crossmodal_{split}.txt").write_text("\n".join(ids))
        for one, number in zip(ids, map(int, numbers), strict=True):
            cut = slice(70 * number, 70 * number + 200 + 10 * number)
            piece = whole | {name: whole[name][cut] for name in ("smpl_poses", "smpl_trans")}
            (folder / f"motions/{one}.pkl").write_bytes(pickle.dumps(piece, protocol=2))


def test_it_runs_to_the_end_and_fills_the_tables(
    shared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: Call
) -> None:
    monkeypatch.chdir(tmp_path)
    amass(tmp_path / "h")
    aistpp(shared / "data/layouts/aistpp", tmp_path / "aist")
    sets = ("humanml_index=h/index.csv", "humanml_texts=h/texts", "splits=h", "mirror=true")
    options = [word for one in sets for word in ("--set", one)]
    for words in (["amass", "h/amass", "texts", *options], ["aistpp", "aist", "dances"]):
        done = call("data", "convert", *words, "--set", "layout=smpl75", "--workers", 1)
        assert done.code == 0, done.err
    Path("small.yaml").write_text(SMALL)
    done = call("run", "small.yaml", "-o", "run")
    assert done.code == 0, done.err

    for number in (1, 2):
        table = fill(f"ude/{number}", paper_table(f"ude/{number}"), [Path("run")])
        (row,) = [row for row in table.rows if row.source == "ours"]
        assert row.method == "Ours" and all(row.cells), "every column has a figure"
        said = {what: ours for found in table.differences.values() for what, ours, _ in found}
        assert said["repeats"] == "3 of tokens, 2 of motion for each" and "dpm++" in said["sampling"]
    file = FigureFile.read(Path("run/stages/evaluate/metrics.json"))
    assert {file.of("tma.top-1", row) is not None for row in (MODEL, NEAREST_WORDS)} == {True}
    dances = FigureFile.read(Path("run/stages/evaluate_dances/metrics.json"))
    assert {one.protocol["songs"] for one in dances.figures} == {1}, "both test dances are to one piece"
