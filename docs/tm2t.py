"""TM2T's tokenizer and captioner as weights that the stages `tm2t` and `captioner` read.

    python tm2t.py TM2T OUT

`TM2T` is your copy of the authors' repository with their checkpoints of HumanML3D in it. Nothing of it is
executed; the pickled word lists are read by a reader that makes plain values only. Needs torch, numpy
and safetensors.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

import torch
from guo_evaluator import ROWS, plain_pickle
from safetensors.torch import save_file

TOKENIZER = "checkpoints/t2m/VQVAEV3_CB1024_CMT_H1024_NRES3"
CAPTIONER = "checkpoints/t2m/M2T_EL4_DL4_NH8_PS/model/finest.tar"
FIRST = ["sos", "eos", "unk"]


def main() -> None:
    """Read the release, write tokenizer.safetensors, captioner.safetensors, mean.npy and std.npy."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("source", type=Path, help="the authors' repository with checkpoints/ and glove/")
    parser.add_argument("out", type=Path, help="the folder to make")
    given = parser.parse_args()
    source, out = given.source, given.out
    out.mkdir(parents=True, exist_ok=True)

    def state(path: Path, part: str, prefix: str = "") -> dict[str, torch.Tensor]:
        found = torch.load(path, map_location="cpu", weights_only=True)[part]
        return {prefix + name: value.float().clone() for name, value in found.items()}

    tokenizer: dict[str, torch.Tensor] = {}
    for part in ("vq_encoder", "quantizer", "vq_decoder"):
        tokenizer |= state(source / TOKENIZER / "model/finest.tar", part, f"{part}.")
    save_file(tokenizer, out / "tokenizer.safetensors")
    rows: dict[str, int] = plain_pickle(source / ROWS)
    words = sorted(rows, key=rows.__getitem__)
    if words[:3] != FIRST or sorted(rows.values()) != list(range(len(rows))):
        raise SystemExit(f"{source / ROWS}: does not begin with {', '.join(FIRST)}, or leaves numbers out")
    metadata = {"words": "\n".join(words[3:])}
    save_file(state(source / CAPTIONER, "m2t_transformer"), out / "captioner.safetensors", metadata)
    for name in ("mean", "std"):
        shutil.copyfile(source / TOKENIZER / f"meta/{name}.npy", out / f"{name}.npy")
    print(f"{out}: {len(words) - 3} words")


if __name__ == "__main__":
    main()
