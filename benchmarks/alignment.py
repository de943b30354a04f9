"""L_align as the loss sees it: of the truth, of a GPT's predictions after it, and of its own samples.

    python benchmarks/alignment.py runs/humantomato-learning [--stages gpt_unaligned gpt]

L_align (HumanTOMATO section 3.6) decodes tokens that are predicted after the *true* ones. What it can still
correct is its distance to the value that the true tokens have, decoded by the same tokenizer and read by the
same TMA. The model's own samples of the same lengths stand beside it, as generation makes them. Validation
clips, in batches of similar length; every other caption of a batch is a negative, or those that the filter
leaves.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from rich.console import Console
from rich.table import Table
from torch import Tensor

from motionloom.models.gpt.losses import group_counts, soft_codes
from motionloom.models.gpt.network import InterleavedGPT
from motionloom.models.gpt.sampling import generate
from motionloom.models.gpt.tokens import as_codes
from motionloom.models.tma.losses import info_nce
from motionloom.models.tokenizer.base import Tokenizer
from motionloom.pipeline.contract.lookup import finished_stages
from motionloom.pipeline.contract.stage import Inputs, StageCache
from motionloom.pipeline.store.networks import LoadedTma
from motionloom.pipeline.store.tokens import TokenBatches, gpt_clips

THRESHOLDS = (0.85, None)
ROWS = ("truth", "predicted after the truth", "own samples")


def batches(
    given: Inputs, tokenizer: Tokenizer, gpt: InterleavedGPT, tma: LoadedTma, size: int
) -> TokenBatches:
    """Validation clips with all their captions, endless, as the GPT stage trains on others."""
    text, store = given["text"].cache, given["tokens"].open("val")
    clips = gpt_clips(given["data"].split("val"), store, tokenizer, face=False, min_frames=16)
    return TokenBatches(
        clips.store,
        clips.captions,
        tma.embed_captions(clips.texts, text),
        torch.as_tensor(text.similarity(clips.texts)),
        gpt.pattern,
        gpt.num_codes,
        gpt.max_groups,
        size,
        0,
        present=clips.present,
    )


@torch.no_grad()
def measure(run: Path, stage: str, size: int, count: int) -> dict[tuple[str, float | None], float]:
    """(row, threshold of the filter) -> mean L_align over `count` batches."""
    stages, stage_cache = finished_stages(run), StageCache()
    if stage not in stages:
        raise SystemExit(f"{run}: stage '{stage}' has not finished; run it first")
    given, loaded = stage_cache.given(stages[stage].inputs), stage_cache.get(stages[stage])
    if loaded.prior != "tma":
        raise SystemExit(f"{run}: {stage} reads the prior '{loaded.prior}'; this script asks GPTs with TMA's")
    tokenizer, tma, gpt = given["tokenizer"].net, given["tma"], loaded.net
    data = batches(given, tokenizer, gpt, tma, size)
    found: dict[tuple[str, float | None], list[float]] = {(r, t): [] for r in ROWS for t in THRESHOLDS}
    torch.manual_seed(0)
    for k in range(count):
        batch = data[k]
        tokens, kinds, text = batch["tokens"], batch["kinds"], batch["text"]
        groups = group_counts(tokens, kinds, gpt.ends, len(gpt.pattern))
        logits = gpt(tokens, kinds, text, known=batch.get("known"))
        rows = tokens[:, : int(groups.max()) * len(gpt.pattern)].unflatten(1, (-1, len(gpt.pattern)))
        truth = as_codes(rows, gpt.pattern, groups).codes
        own = generate(gpt, text, groups=groups, seed=k).codes
        sizes = gpt.num_codes
        weights: dict[str, dict[str, Tensor]] = {
            "truth": {name: F.one_hot(codes, sizes[name]).float() for name, codes in truth.items()},
            "predicted after the truth": soft_codes(gpt, logits, groups, temperature=1.0, sample=True),
            "own samples": {name: F.one_hot(codes, sizes[name]).float() for name, codes in own.items()},
        }
        frames, present = groups * tokenizer.group_frames, batch.get("present")
        for row, codes in weights.items():
            latent = tma.embed_motion(tokenizer.decode_soft(codes, frames, present), frames, present)
            for threshold in THRESHOLDS:
                loss = info_nce(text, latent, batch["similarity"], threshold=threshold)
                found[row, threshold].append(float(loss))
    return {key: float(np.mean(values)) for key, values in found.items()}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("--stages", nargs="+", default=["gpt_unaligned", "gpt_predictions", "gpt"])
    parser.add_argument("--batch", type=int, default=16, help="captions that are told apart")
    parser.add_argument("--count", type=int, default=40, help="batches")
    args = parser.parse_args()
    table = Table("L_align", "filter", *args.stages, title=f"validation clips, batches of {args.batch}")
    found = [measure(args.run, stage, args.batch, args.count) for stage in args.stages]
    for row in ROWS:
        for threshold in THRESHOLDS:
            cells = (f"{each[row, threshold]:.3f}" for each in found)
            table.add_row(row, "none" if threshold is None else str(threshold), *cells)
    Console().print(table)


if __name__ == "__main__":
    main()
