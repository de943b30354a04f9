"""The learning proofs on a run of `humantomato-learning`, from its test split; as many as it is ready for.

    motionloom run humantomato-learning
    python benchmarks/learning.py runs/humantomato-learning

- Retrieval among 32 clips that all do something different (no two have the same truth), both ways.
- What the captions of opposite motions look like to TMA and to the frozen sentence encoder.
- Motions generated for held-out combinations of known words, measured on their joints: by the GPT with the
  alignment loss, by those without it, with it on predictions, and with the sentence embedding as the prior.
  Faces by each generator.

Writes `learning.json` and `learning.png` into the run's folder.
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from motionloom.datasets.motion.features.joints import joints_of
from motionloom.datasets.synth.face import read
from motionloom.datasets.synth.measure import agrees
from motionloom.models.gpt.drawing import sample_seeds
from motionloom.models.metrics.retrieval import recall
from motionloom.pipeline.contract.generation import GenerationRequest, Prompt
from motionloom.pipeline.contract.lookup import finished_stages, generators_of
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.stage import Finished, StageCache
from motionloom.pipeline.evaluation.truth import Truth, reconstruct_truth, truth_of
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.inference.requests import PromptEncoder
from motionloom.pipeline.store.networks import embed_motions

matplotlib.use("Agg")

PAIRS = (
    ("a person walks in a clockwise circle", "a person walks in a counter-clockwise circle"),
    ("a person walks forward", "a person walks backward"),
    ("a person turns to the left", "a person turns to the right"),
    ("a person kicks with the left leg", "a person kicks with the right leg"),
    ("a person squats once", "a person squats three times"),
)
SIZE = 32
GPTS = {
    "gpt": "L_align on samples",
    "gpt_unaligned": "without L_align",
    "gpt_predictions": "L_align on predictions",
    "gpt_sentence": "sentence prior, without L_align",
}

Shares = dict[str, dict[str, float]]
"""Held out or not -> attribute -> share of right ones."""
Judged = tuple[NDArray[Any], NDArray[Any] | None]
"""Joints [T, N, 3] and expression [T, 50], or None."""


def finished(run: Path, stage: str) -> bool:
    return (run / "stages" / stage / "artifact.json").is_file()


def test_truths(run: Path) -> list[Truth]:
    dataset = StageCache().get(finished_stages(run)["data"]).split("test")
    return [truth_of(dataset, i) for i in range(len(dataset))]


def told(truth: Truth) -> str:
    """What a clip does, as its body captions can say it: the face is told elsewhere, the style nowhere."""
    record = {k: v for k, v in (truth.truth or {}).items() if k not in ("face", "style")}
    return json.dumps(record, sort_keys=True)


def retrieval(
    run: Path, stage: str, truths: list[Truth], draws: int, motions: list[NDArray[np.float32]] | None = None
) -> dict[str, float]:
    """Mean recall over draws of 32 clips with different truths; `motions` made for their captions instead of
    their own."""
    found_stage, stage_cache = finished_stages(run)[stage], StageCache()
    tma, cache = stage_cache.get(found_stage), stage_cache.given(found_stage.inputs)["text"].cache
    text = tma.embed_captions([t.caption for t in truths], cache)
    motion = embed_motions(tma, [t.features for t in truths] if motions is None else motions)
    kinds: dict[str, list[int]] = defaultdict(list)
    for row, truth in enumerate(truths):
        kinds[told(truth)].append(row)
    rng = np.random.default_rng(0)
    found: dict[str, list[float]] = defaultdict(list)
    names = sorted(kinds)
    for _ in range(draws):
        chosen = [int(rng.choice(kinds[names[k]])) for k in rng.permutation(len(names))[:SIZE]]
        for name, value in recall(text[chosen], motion[chosen]).items():
            found[name].append(value)
    return {name: float(np.mean(values)) for name, values in found.items()} | {"kinds": len(names)}


def similarities(run: Path, stage: str = "tma") -> list[tuple[str, str, float, float]]:
    """(caption, caption, cosine of the sentence encoder, cosine of TMA)."""
    found, stage_cache = finished_stages(run)[stage], StageCache()
    tma, encoder = stage_cache.get(found), stage_cache.given(found.inputs)["text"].encoder
    rows = []
    for one, other in PAIRS:
        encoded = encoder.encode([one, other])
        latent = tma.embed_text(torch.as_tensor(encoded.tokens), torch.as_tensor(encoded.mask))
        pair = (torch.as_tensor(encoded.sentence), latent)
        cosines = [float(torch.nn.functional.cosine_similarity(v[0], v[1], dim=0)) for v in pair]
        rows.append((one, other, *cosines))
    return rows


def judge(
    truths: list[Truth], motions: Iterable[Judged], fps: float, hold_out: list[dict[str, Any]]
) -> Shares:
    """Shares of right attributes; "shape" is of hands that are not relaxed, "every" all attributes together,
    "whole" the share of clips that get all right."""
    rows: dict[str, dict[str, list[bool]]] = {"held out": defaultdict(list), "other": defaultdict(list)}
    for truth, (joints, face) in zip(truths, motions, strict=True):
        record = truth.truth or {}
        apart = any(all(record.get(k) == v for k, v in c.items()) for c in hold_out)
        kind = rows["held out" if apart else "other"]
        right = agrees(record, joints, face, fps)
        for name, value in right.items():
            kind[name].append(value)
            kind["every"].append(value)
            if name.endswith("_hand") and record[name] != "relaxed":
                kind["shape"].append(value)
        kind["whole"].append(all(right.values()))
    return {kind: {name: float(np.mean(v)) for name, v in found.items()} for kind, found in rows.items()}


def generation(
    run: Path, truths: list[Truth], hold_out: list[dict[str, Any]], sampling: SamplingConfig, draws: int
) -> tuple[dict[str, Shares], dict[str, dict[str, float]]]:
    """Shares of a guess, of the tokenizer's reconstructions and of every GPT of the run; and how well TMA
    finds the motions of every GPT (R-precision, Tables 5 and 8)."""
    stages, makers, stage_cache = finished_stages(run), generators_of(run), StageCache()
    tokenizer, face_makers = stage_cache.get(stages["tokenizer"]), makers_of_faces(makers, stage_cache)
    captions, faces = [t.caption for t in truths], [t.face_caption for t in truths]
    layout, fps = tokenizer.layout, tokenizer.layout.fps
    order = np.random.default_rng(0).permutation(len(truths))
    guess = ((truths[k].joints, truths[k].face) for k in order)
    rebuilt = (reconstruct_truth(tokenizer, t) for t in truths)
    out = {
        "another clip's motion": judge(truths, guess, fps, hold_out),
        "reconstruction": judge(truths, ((joints_of(x, layout), None) for x in rebuilt), fps, hold_out),
    }
    found = {}
    for name, title in GPTS.items():
        if finished(run, name):
            bundle = Bundle([stages[name], *face_makers], stage_cache)
            made = bundle.generate(captions, face=faces, sampling=sampling)
            out[title] = judge(truths, ((m.joints, m.face) for m in made), fps, hold_out)
            found[title] = retrieval(run, "tma", truths, draws, [m.features for m in made])
    return out, found


def makers_of_faces(makers: Iterable[Finished], stage_cache: StageCache) -> list[Finished]:
    return [stage for stage in makers if stage_cache.generator(stage).part == "face"]


def facial(run: Path, truths: list[Truth]) -> dict[str, float]:
    """Share of expressions that show what the caption says, for each generator (Table 4 in miniature)."""
    stage_cache = StageCache()
    shown = [t for t in truths if t.face is not None and (t.truth or {}).get("face")]
    prompts = [Prompt(t.face_caption) for t in shown]
    frames, seeds = [len(t.features) for t in shown], sample_seeds(0, len(shown))
    wanted = [(t.truth or {})["face"] for t in shown]
    order = np.random.default_rng(0).permutation(len(shown))
    out = {
        "another clip's face": float(np.mean([wanted[k] == w for k, w in zip(order, wanted, strict=True)]))
    }
    for stage in makers_of_faces(generators_of(run), stage_cache):
        generator = stage_cache.generator(stage)
        encoder = PromptEncoder(stage_cache.given(stage.inputs)["text"], stage_cache.device)
        conditions = encoder.encode(
            prompts, [p.words for p in prompts], generator.modalities, generator.layout.fps
        )
        made = generator.generate(GenerationRequest(conditions, frames, seeds))
        out[generator.method] = float(
            np.mean([read(face) == w for face, w in zip(made, wanted, strict=True)])
        )
    return out


def draw(shares: dict[str, Shares], path: Path) -> None:
    """Bars of every attribute on the held-out combinations, one colour a row of the table."""
    import matplotlib.pyplot as plt

    names = sorted({name for row in shares.values() for name in row["held out"]})
    figure, axes = plt.subplots(figsize=(11, 3.6), layout="constrained")
    for k, (title, row) in enumerate(shares.items()):
        at = np.arange(len(names)) + 0.16 * (k - len(shares) / 2)
        axes.bar(at, [100 * row["held out"].get(name, np.nan) for name in names], 0.15, label=title)
    axes.axhline(90, color="grey", lw=0.8, ls=":")
    axes.set_xticks(range(len(names)), names)
    axes.set_ylabel("right, %")
    axes.set_title("held-out combinations of words")
    figure.legend(loc="outside lower center", ncols=len(shares), fontsize=8)
    figure.savefig(path, dpi=120)


def percent(row: dict[str, float], names: Iterable[str]) -> list[str]:
    return [f"{100 * row[name]:.1f} %" if name in row else "" for name in names]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("--draws", type=int, default=200, help="draws of 32 different clips")
    parser.add_argument("--clips", type=int, default=10_000, help="test clips to generate for, at most")
    parser.add_argument("--temperature", type=float, default=1.0)
    parser.add_argument("--top-p", type=float, default=0.95)
    parser.add_argument(
        "--cfg-scale", type=float, default=1.0, help="classifier-free guidance of body and hands"
    )
    args = parser.parse_args()
    if not finished(args.run, "tma"):
        raise SystemExit(f"{args.run}: the proofs start with a trained TMA; run the stage `tma` first")
    run, console, truths = args.run, Console(), test_truths(args.run)
    found: dict[str, Any] = {"clips": len(truths), "retrieval": retrieval(run, "tma", truths, args.draws)}
    keys = ("t2m/R@1", "t2m/R@3", "m2t/R@1", "m2t/R@3")
    table = Table("text to motion R@1", "R@3", "motion to text R@1", "R@3")
    table.add_row(*percent(found["retrieval"], keys))
    table.title = f"retrieval among {SIZE} different motions, {len(truths)} test clips; a guess: 3.1 %, 9.4 %"
    console.print(table)
    table = Table("caption", "caption", "sentence encoder", "TMA", title="cosine of opposite captions")
    found["opposites"] = similarities(run)
    for one, other, sentence, aligned in found["opposites"]:
        table.add_row(one, other, f"{sentence:.2f}", f"{aligned:.2f}")
    console.print(table)
    if finished(run, "gpt"):
        hold_out = json.loads((run / "stages/data/artifact.json").read_text())["config"]["hold_out"]
        sampling = SamplingConfig(temperature=args.temperature, top_p=args.top_p, cfg_scale=args.cfg_scale)
        some = [truths[k] for k in np.random.default_rng(0).permutation(len(truths))[: args.clips]]
        found["generated"], found["sampling"] = len(some), sampling.dump()
        shares, found["precision"] = generation(run, some, hold_out, sampling, args.draws)
        found["generation"] = shares
        table = Table("generated by", "text to motion R@1", "R@3", "motion to text R@1", "R@3")
        table.title = f"retrieval of generated motions among {SIZE}, judged by the run's TMA"
        for title, row in found["precision"].items():
            table.add_row(title, *percent(row, keys))
        console.print(table)
        for kind in ("held out", "other"):
            names = sorted({name for row in shares.values() for name in row[kind]})
            table = Table("right", *shares, title=f"motions that do what the caption says: {kind}")
            for name in names:
                table.add_row(name, *(cell for row in shares.values() for cell in percent(row[kind], [name])))
            console.print(table)
        draw(shares, run / "learning.png")
    if finished(run, "face_gpt"):
        found["face"] = facial(run, truths)
        table = Table("generator", "right", title="faces that show what their caption says")
        for title, share in found["face"].items():
            table.add_row(title, f"{100 * share:.1f} %")
        console.print(table)
    (run / "learning.json").write_text(json.dumps(found, indent=1))
    console.print(f"{run / 'learning.json'}")


if __name__ == "__main__":
    main()
