"""What a model of synthetic clips knows, measured, as the card of its exported folder.

    motionloom run humantomato-synthetic
    motionloom export runs/humantomato-synthetic -o model --half
    python benchmarks/model_card.py runs/humantomato-synthetic model --cfg 1.5 --top-p 0.9

Motions are generated for the test clips' captions, once as they are worded in training and once in other
words (`synthetic_wordings.json` beside this script: sentences that the captions of synthetic clips never
make), and measured on their joints and expressions: does the motion do what the caption says? "Held out" are
combinations of words that training never showed. Beside them stands another clip's motion, which is what a
guess gets. The other words were written before the model was first measured on them.

Writes `README.md` (the card) and `card.json` (the figures) into the model's folder.
"""

from __future__ import annotations

import argparse
import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from learning import Shares, judge, test_truths
from rich.console import Console
from rich.table import Table

from motionloom.datasets.schema import UserError
from motionloom.datasets.synth.truth import ACTIONS, FACES, HANDS
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.evaluation.truth import Truth
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.inference.unknown import unknown_captions
from motionloom.pipeline.runs.recipe import load_recipe

WORDS = Path(__file__).with_name("synthetic_wordings.json")
IMPLIED = {"punch": "fist", "wave": "spread"}
"""Shapes that an action gives the hand it takes, which nobody says."""
FAMILIAR, OTHER, GUESS = "as in training", "other words", "another clip's motion"

CARD = Path(__file__).with_suffix(".md")


def words_of(truth: Mapping[str, Any], words: Mapping[str, Any], rng: np.random.Generator) -> tuple[str, str]:
    """A caption of the body and one of the face, in other words."""

    def pick(choices: Sequence[str]) -> str:
        return choices[int(rng.integers(len(choices)))]

    parts = [
        truth["action"],
        truth.get("direction"),
        truth.get("style") if truth["action"] == "turn" else None,
    ]
    said = pick(words["actions"][" ".join(part for part in parts if part)])
    count, speed, side = truth.get("count"), truth.get("speed"), truth.get("side")
    limb = {"wave": "hand", "raise": "arm"}.get(truth["action"])
    named = f"both {limb}s" if side == "both" else f"the {side} {limb}" if limb else side
    body = said.format(
        s=named,
        n=pick(words["times"][str(count)]) if count else "",
        v=pick(words["speed"][speed]) if speed else "",
    )
    shapes = {hand: truth.get(f"{hand}_hand", "relaxed") for hand in ("left", "right")}
    implied = IMPLIED.get(truth["action"])
    hands = [
        pick(words["hands"][shape]).format(h=f"the {hand} hand")
        for hand, shape in shapes.items()
        if shape != "relaxed" and not (shape == implied and side in (hand, "both"))
    ]
    face = pick(words["faces"][truth["face"]]) if truth.get("face") else ""
    who = pick(words["who"])
    return ", ".join([f"{who} {body}", *hands]), f"{who} {face}" if face else ""


def rows_of(shares: Mapping[str, Shares]) -> list[list[str]]:
    """Attribute, then held out and other for each way of wording, in percent."""
    names = sorted({name for share in shares.values() for row in share.values() for name in row})
    last = [name for name in ("shape", "every", "whole") if name in names]
    names = [name for name in names if name not in last] + last
    return [
        [name, *(f"{100 * share[kind][name]:.1f}" if name in share[kind] else ""
                 for share in shares.values() for kind in ("held out", "other"))]
        for name in names
    ]  # fmt: skip


def digests(folder: Path) -> dict[str, str]:
    """sha256 of every file of weights."""
    found = sorted(folder.glob("*/*.safetensors"))
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in found}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path, help="its test clips are what is asked for")
    parser.add_argument("model", type=Path, help="the exported folder")
    parser.add_argument("--name", help="what the card calls it; default: the recipe's name")
    parser.add_argument("--clips", type=int, default=10_000, help="test clips, at most")
    parser.add_argument("--top-p", type=float, default=0.95)
    parser.add_argument("--cfg", type=float, default=1.0, help="classifier-free guidance of body and hands")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--licence", default="apache-2.0")
    args = parser.parse_args()
    data = json.loads((args.run / "stages/data/artifact.json").read_text())["config"]
    words = json.loads(WORDS.read_text())
    truths = [truth for truth in test_truths(args.run) if truth.truth]
    truths = [truths[k] for k in np.random.default_rng(0).permutation(len(truths))[: args.clips]]
    rng = np.random.default_rng(args.seed)
    try:
        other = [words_of(truth.truth or {}, words, rng) for truth in truths]
    except KeyError as error:
        raise UserError(f"{WORDS.name} has no other words for {error}") from None
    bundle = Bundle.open(args.model)
    sampling = SamplingConfig(top_p=args.top_p, cfg_scale=args.cfg)
    fps, hold_out = bundle.layout.fps, data["hold_out"]
    said = {
        FAMILIAR: ([t.caption for t in truths], [t.face_caption for t in truths]),
        OTHER: ([body for body, _ in other], [face for _, face in other]),
    }
    order = np.random.default_rng(0).permutation(len(truths))
    shares = {GUESS: judge(truths, ((truths[k].joints, truths[k].face) for k in order), fps, hold_out)}
    for title, (captions, faces) in said.items():
        made = bundle.generate(captions, face=faces, sampling=sampling, seed=args.seed)
        shares[title] = judge(truths, ((motion.joints, motion.face) for motion in made), fps, hold_out)
    strange = {title: len(unknown_captions(bundle, captions)) for title, (captions, _) in said.items()}
    table = Table("right, %", *(f"{title}: {kind}" for title in shares for kind in ("held out", "other")))
    for row in rows_of(shares):
        table.add_row(*row)
    Console().print(table)
    figures = {
        "clips": len(truths),
        "sampling": sampling.dump(),
        "seed": args.seed,
        "right": shares,
        "unknown": strange,
    }
    (args.model / "card.json").write_text(json.dumps(figures, indent=1) + "\n")
    (args.model / "README.md").write_text(card(args, data, bundle, shares, other, strange, truths))
    Console().print(str(args.model / "README.md"))


def card(
    args: argparse.Namespace, data: dict[str, Any], bundle: Bundle, shares: dict[str, Shares],
    other: list[tuple[str, str]], strange: dict[str, int], truths: list[Truth],
) -> str:  # fmt: skip
    """The card as Markdown."""
    recipe = load_recipe(args.run / "recipe.yaml", strict=False)
    name = args.name or recipe.name
    head = ["right, %", *(f"{title}: {kind}" for title in shares for kind in ("held out", "other"))]
    lines = [head, ["---"] * len(head), *rows_of(shares)]
    apart = sum(
        any(all((t.truth or {}).get(k) == v for k, v in c.items()) for c in data["hold_out"]) for t in truths
    )
    size = sum(path.stat().st_size for path in args.model.rglob("*") if path.is_file()) / 1e6
    return CARD.read_text().format(
        licence=args.licence,
        name=name,
        description=recipe.description,
        folder=name,
        cfg=args.cfg,
        top_p=args.top_p,
        fps=bundle.layout.fps,
        bytes=size,
        clips=f"{data['clips']:,}",
        actions="Actions: " + ", ".join(data["actions"] or ACTIONS),
        hands=", ".join(data["hand_shapes"] or HANDS[1:]),
        faces=", ".join(FACES),
        count=len(truths),
        apart=apart,
        seed=args.seed,
        table="\n".join("| " + " | ".join(line) + " |" for line in lines),
        examples="; ".join(f'"{body}"' for body, _ in other[:3]),
        unknown=f"{strange[OTHER]} of these captions and {strange[FAMILIAR]} of the usual it calls unknown.",
        commands=f"motionloom run {recipe.name}\nmotionloom export runs/{recipe.name} -o model --half",
        recipe_seed=recipe.seed,
        digests="\n".join(f"- `{path}` `{digest}`" for path, digest in digests(args.model).items()),
    )


if __name__ == "__main__":
    main()
