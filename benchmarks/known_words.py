"""Does a model know what it does not know? Everyday sentences, what it makes of them, and what it says.

    python benchmarks/known_words.py synthetic
    python benchmarks/known_words.py synthetic --held-out

One motion is made for every sentence of `known_words.yaml` and measured on its joints: does it do what is
said? Beside it whether there was a note, because the model does not know the caption or because the joints
show something else; the latter by rules that judge here too. 1,200 sentences are for development; another 200
are held out: the rules of notes are decided without them.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import yaml
from rich.console import Console
from rich.table import Table

from motionloom.datasets.synth.measure import agrees, measure
from motionloom.pipeline.inference.bundle import Bundle, unknown_captions
from motionloom.pipeline.inference.notes import doubts
from motionloom.pipeline.inference.shipped_models import model_folder

SENTENCES = Path(__file__).with_suffix(".yaml")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "model", type=Path, help="a run, an exported folder, or the name of a model of the package"
    )
    parser.add_argument("--held-out", action="store_true", help="those that the rules were not decided by")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    *known, held_out = yaml.safe_load_all(SENTENCES.read_text(encoding="utf-8"))
    chosen = [held_out] if args.held_out else known
    rows = [(kind, *row) for group in chosen for kind, sentences in group.items() for row in sentences]
    bundle, console = Bundle.open(model_folder(args.model)), Console(soft_wrap=True)
    captions = [caption for _, caption, _ in rows]
    made = bundle.generate(captions, seed=args.seed)
    noted = {one.caption for one in unknown_captions(bundle, captions) if not one.read_as}
    noted |= {caption for caption, motion in zip(captions, made, strict=True) if doubts(bundle, [motion])}
    counts: dict[str, list[int]] = {}
    for (kind, caption, truth), motion in zip(rows, made, strict=True):
        right = truth is not None and all(agrees(truth, motion.joints, None, motion.fps).values())
        for name in (kind, "all"):
            count = counts.setdefault(name, [0, 0, 0, 0])
            count[2 * right] += caption in noted
            count[2 * right + 1] += 1
        if right == (caption in noted):
            did = measure(motion.joints, motion.fps).action
            console.print(f"{'noted, and right' if right else 'not noted, and wrong'}: '{caption}' ({did})")
    table = Table("sentences", "wrong: noted", "of", "right: noted", "of")
    for kind, count in counts.items():
        table.add_row(kind, *map(str, count))
    console.print(table)


if __name__ == "__main__":
    main()
