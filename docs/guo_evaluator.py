"""The published text-motion evaluator of Guo et al. as a folder that `kind: guo_evaluator` reads.

    python guo_evaluator.py TEXT_TO_MOTION OUT [--meta FOLDER]

`TEXT_TO_MOTION` is your copy of the authors' repository with their weights and word vectors in it. Read its
licence, and GloVe's, first: what is made of them is yours to keep and not to publish. Nothing of the
repository is executed; the pickled word lists are read by a reader that makes plain values only.

Needs torch, numpy and safetensors, and nothing of the repository's old environment.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import save_file

ENCODERS = ("movement_encoder", "motion_encoder", "text_encoder")
CHECKPOINT = "checkpoints/t2m/text_mot_match/model/finest.tar"
META = "checkpoints/t2m/Comp_v6_KLD01/meta"
"""Statistics that it was trained with; deviations of the root and the contacts are divided by 5."""
VECTORS, WORDS, ROWS = "glove/our_vab_data.npy", "glove/our_vab_words.pkl", "glove/our_vab_idx.pkl"
CLASSES = "utils/word_vectorizer.py"


class PlainUnpickler(pickle.Unpickler):
    """Reads plain values; whatever else a pickle asks for is refused."""

    def find_class(self, module: str, name: str) -> Any:
        """Never."""
        raise SystemExit(
            f"the pickle asks for {module}.{name}, which a list of words does not need: not read"
        )


def plain_pickle(path: Path) -> Any:
    """Lists, dicts, strings and numbers of a pickled file."""
    with path.open("rb") as file:
        return PlainUnpickler(file).load()


def constants(path: Path) -> dict[str, Any]:
    """Literal values that a module assigns to names, also by the names of earlier ones; none of it runs."""
    known: dict[str, Any] = {}

    def value(node: ast.expr) -> Any:
        if isinstance(node, ast.Name):
            return known[node.id]
        if isinstance(node, ast.Dict):
            return {ast.literal_eval(k): value(v) for k, v in zip(node.keys, node.values, strict=True) if k}
        return ast.literal_eval(node)

    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            try:
                known[node.targets[0].id] = value(node.value)
            except (KeyError, ValueError):
                continue
    return known


def tensors(path: Path) -> dict[str, torch.Tensor]:
    """Weights of the three encoders, by their published names."""
    checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    return {
        f"{encoder}.{name}": value.float().contiguous()
        for encoder in ENCODERS
        for name, value in checkpoint[encoder].items()
    }


def main() -> None:
    """Read the release, write the folder."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("source", type=Path, help="the authors' repository with checkpoints/ and glove/")
    parser.add_argument("out", type=Path, help="the folder to make")
    parser.add_argument("--meta", type=Path, help=f"folder with mean.npy and std.npy (default: {META})")
    given = parser.parse_args()
    source, out, meta = given.source, given.out, given.meta or given.source / META
    out.mkdir(parents=True, exist_ok=True)

    save_file(tensors(source / CHECKPOINT), out / "model.safetensors")
    stats = {name: np.load(meta / f"{name}.npy", allow_pickle=False) for name in ("mean", "std")}
    save_file({n: torch.from_numpy(v).float() for n, v in stats.items()}, out / "stats.safetensors")

    words, rows = plain_pickle(source / WORDS), plain_pickle(source / ROWS)
    vectors = np.load(source / VECTORS, allow_pickle=False)[[rows[word] for word in words]]
    save_file({"vectors": torch.from_numpy(vectors).float()}, out / "words.safetensors")
    found = constants(source / CLASSES)
    order = found["POS_enumerator"]
    about = {
        "words": list(words),
        "classes": sorted(order, key=order.__getitem__),
        "lists": {name: list(members) for name, members in found["VIP_dict"].items()},
    }
    (out / "words.json").write_text(json.dumps(about, ensure_ascii=False), encoding="utf-8")

    made = ("model.safetensors", "stats.safetensors", "words.safetensors", "words.json")
    sha256 = {name: hashlib.sha256((out / name).read_bytes()).hexdigest() for name in made}
    facts = {"version": 1, "layout": "h3d263", "sha256": sha256}
    (out / "evaluator.json").write_text(json.dumps(facts, indent=1), encoding="utf-8")
    print(f"{out}: {len(words)} words")


if __name__ == "__main__":
    main()
