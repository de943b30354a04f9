"""Measure again what a model of synthetic clips keeps of its training's captions, without training it.

    python benchmarks/known_captions.py synthetic

The captions that represent the training's stay as they are. How far the recipe's validation captions are from
them, the words of its training captions and the actions of its clips are measured on the recipe's captions,
which are made without motions, and written into the text stage of the model's folder.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from bench import arguments, command_line
from model_card import noted, synthetic_data
from safetensors.numpy import load_file

from motionloom.datasets.actions.measure import actions_of
from motionloom.datasets.synth.generate import captions_of, split_of, truth_of
from motionloom.datasets.text.encoder import load_text_encoder
from motionloom.datasets.text.vocabulary import word_counts
from motionloom.pipeline.contract.stage import stage_kind
from motionloom.pipeline.inference.shipped_models import model_folder
from motionloom.pipeline.runs.recipe import load_recipe
from motionloom.pipeline.store.artifact import Artifact
from motionloom.pipeline.store.known_captions import KNOWN_FILES, KnownCaptions, distances_to, save_known

KINDS = ("body", "face")
AT_ONCE = 64


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("model", type=Path, help="an exported folder, or the name of a model of the package")
    args = arguments(parser)
    model = model_folder(args.model)
    card = noted(model)
    configs = synthetic_data(load_recipe(card["recipe"], card.get("settings", []), strict=False))
    captions: dict[tuple[str, str], set[str]] = {
        (split, kind): set() for split in ("train", "val", "test") for kind in KINDS
    }
    actions: set[str] = set()
    for config in configs:
        for index in range(config.clips):
            split = split_of(index, config)
            for kind, texts in zip(KINDS, captions_of(index, config), strict=True):
                captions[split, kind].update(texts)
            if split == "train":
                actions.update(actions_of(truth_of(index, config).record(hands=True, face=True)))
    encoder, folder = load_text_encoder("minilm"), model / "text"
    texts, arrays = json.loads((folder / KNOWN_FILES[0]).read_text()), load_file(folder / KNOWN_FILES[1])
    known = {}
    for kind in KINDS:
        kept = texts[kind]["captions"] if isinstance(texts[kind], dict) else texts[kind]
        held_out = sorted(captions["val", kind], key=lambda text: (len(text), text))
        blocks = [held_out[start : start + AT_ONCE] for start in range(0, len(held_out), AT_ONCE)]
        vectors = np.concatenate([encoder.encode(block).sentence for block in blocks])
        embeddings = arrays[kind].astype(np.float32)
        known[kind] = KnownCaptions(tuple(kept), embeddings, distances_to(embeddings, vectors))
        assert captions["train", kind].issuperset(kept), f"{model}: captions that its recipe does not make"
    words = {*texts["words"], *word_counts(captions["train", "body"] | captions["train", "face"])}
    save_known(folder, known["body"], known["face"], tuple(words), tuple(actions))
    artifact = Artifact.find(folder)
    assert artifact is not None
    artifact.model_copy(update={"version": stage_kind("text", "here").version}).finish(folder)
    print(f"{folder}: {len(words)} words, {len(actions)} actions")


if __name__ == "__main__":
    main()
