"""Train HumanTOMATO's H²VQ tokenizer on shards: one loop in plain torch, to copy and to own.

    motionloom run humantomato-tiny --until data
    python train_h2vq.py runs/humantomato-tiny/stages/data/shards h2vq --steps 1400

`motionloom run` does more (ranks, background checkpoints, telemetry); this is what lies under it. A killed
training goes on with the same command, and its weights are those of an undisturbed one, bit for bit.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file
from torch.utils.data import DataLoader

from motionloom.datasets import FeatureStats, ShardDataset, Steps, WindowBatches, compute, joints_of
from motionloom.models import H2VQ, H2VQConfig, mpjpe
from motionloom.models.tokenizer.module import tokenizer_losses

# The network of `humantomato-tiny`. `H2VQConfig()` is the paper's: width, code_dim, num_codes 512, depth 3.
NET = H2VQConfig(
    width=96, depth=2, code_dim=96, num_codes=256, decay=0.9, reset_below=0.05,
    recon="smooth_l1", velocity_weight=0.5, root_gain=5.0, finger_gain=4.0,
)  # fmt: skip
WINDOW = 64  # frames of a training window
LOG_EVERY, SAVE_EVERY, VALIDATE_EVERY = 10, 100, 400


def main() -> None:
    """Read the arguments, train, and write `model.safetensors`, `stats.safetensors` and `log.jsonl`."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("shards", type=Path, help="a folder of shards with splits train and val")
    parser.add_argument("out", type=Path, help="the folder to write")
    parser.add_argument("--steps", type=int, default=1400)
    parser.add_argument("--batch", type=int, default=16, help="windows of a step")
    parser.add_argument("--lr", type=float, default=2e-3)
    parser.add_argument("--workers", type=int, default=0, help="processes that read")
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)

    # 1. Data. Motion is [T, D] in the columns of a layout; each column is normalised by the training split.
    train, val = (ShardDataset.open(given.shards, split) for split in ("train", "val"))
    stats = compute(train)
    stats.save(given.out / "stats.safetensors")

    # 2. Network. It reads the columns of body and hands; the 50 of the face have a tokenizer of their own.
    torch.manual_seed(given.seed)
    net = NET.build(train.layout).to(given.device)
    assert isinstance(net, H2VQ)
    # Fingers are read by how they bend (finger_gain): the network has to know the units of its columns.
    columns = net.columns.cpu().numpy()
    net.basis.learn(stats.mean[columns], stats.std[columns])
    # The codebooks are moving averages of what is encoded (no gradient); AdamW trains the rest.
    optimizer = torch.optim.AdamW(net.parameters(), lr=given.lr, betas=(0.9, 0.99))

    # 3. What an earlier process has left.
    checkpoint = given.out / "last.pt"
    step = 0
    rows = []
    if checkpoint.exists():
        state = torch.load(checkpoint, map_location=given.device, weights_only=True)
        net.load_state_dict(state["net"])
        optimizer.load_state_dict(state["optimizer"])
        step = state["step"]
        rows = state["rows"]
        print(f"goes on from step {step} of {given.steps}")

    # 4. Batches by number: batch k is a function of (seed, k), so the step is all that a resume has to know.
    def batches(rank: int, world: int) -> WindowBatches:
        size = given.batch
        return WindowBatches(train, stats, window=WINDOW, batch_size=size, seed=given.seed, columns=columns)

    loader = DataLoader(Steps(batches, given.steps, step), batch_size=None, num_workers=given.workers)
    first = step
    begin = time.perf_counter()
    for batch in loader:
        # 5. One step: loss, gradients, rate, weights.
        for group in optimizer.param_groups:
            group["lr"] = given.lr * rate(step, given.steps)
        moved = {k: v.to(given.device) if torch.is_tensor(v) else v for k, v in batch.items()}
        torch.manual_seed(given.seed * 1_000_003 + step)  # whatever draws at random draws by the step
        losses, _ = tokenizer_losses(net, moved)
        optimizer.zero_grad(set_to_none=True)
        losses["loss"].backward()
        norm = torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimizer.step()
        step += 1

        # 6. Figures, validation, checkpoint: all on whole steps, so that a resumed training repeats them.
        if step % LOG_EVERY == 0 or step == given.steps:
            figures = {name: round(value.item(), 5) for name, value in losses.items()}
            rows.append({"step": step, "grad_norm": round(norm.item(), 5), **figures})
            speed = (step - first) / (time.perf_counter() - begin)
            used = ", ".join(f"{s.name} {100 * figures[f'usage_{s.name}']:.0f} %" for s in net.streams)
            print(f"step {step}  loss {figures['loss']:.4f}  codes used: {used}  {speed:.1f} steps/s")
        if step % VALIDATE_EVERY == 0 or step == given.steps:
            rows.append({"step": step, "val_mpjpe_mm": round(validate(net, val, stats), 2)})
            print(f"step {step}  MPJPE of {len(val)} held-out clips: {rows[-1]['val_mpjpe_mm']} mm")
        if step % SAVE_EVERY == 0 or step == given.steps:
            state = {"net": net.state_dict(), "optimizer": optimizer.state_dict(), "step": step, "rows": rows}
            torch.save(state, partial := checkpoint.with_suffix(".part"))
            partial.replace(checkpoint)  # whole or not at all

    save_file({k: v.cpu().contiguous() for k, v in net.state_dict().items()}, given.out / "model.safetensors")
    (given.out / "log.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))


def rate(step: int, steps: int) -> float:
    """Share of the learning rate: 5 % of the steps to warm up, then half a cosine to 0."""
    warm = max(1, steps // 20)
    if step < warm:
        return (step + 1) / warm
    return 0.5 * (1 + math.cos(math.pi * (step - warm) / max(1, steps - warm)))


@torch.no_grad()
def validate(net: H2VQ, clips: ShardDataset, stats: FeatureStats) -> float:
    """MPJPE in mm of whole clips through tokens and back, each frame's root at the origin."""
    net.eval()
    device = next(net.parameters()).device
    columns = net.columns.cpu().numpy()
    errors = []
    for number in range(len(clips)):
        motion = np.asarray(clips.motion(number))[:, columns]
        motion = motion[: len(motion) // 4 * 4]  # tokens are of groups of four frames
        x = torch.from_numpy(stats.normalize(motion, columns))[None].to(device)
        held = clips.layout.present_columns[clips.present[number], columns]  # bool: hands may be missing
        present = torch.from_numpy(held)[None].to(device)
        codes = net.encode(x, present=present)  # {"body": [1, T / 2], "hand": [1, T / 4]}
        made = stats.denormalize(net.decode(codes, present=present)[0].cpu().numpy(), columns)
        pair = [torch.from_numpy(joints_of(features, clips.layout)) for features in (made, motion)]
        errors.append(mpjpe(*pair))  # [T]
    net.train()
    return float(torch.cat(errors).mean())


if __name__ == "__main__":
    main()
