"""Training step of the EMA quantizer beside vector-quantize-pytorch, in one run on this machine.

    python benchmarks/quantizer.py [--threads 1] [--vectors 4096] [--dim 512] [--codes 512]

Prints the median milliseconds of a training-mode forward, the ratio, and the floor: the distance matmul, the
argmin and the segment sum without which no EMA quantizer can do.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import torch
from vector_quantize_pytorch import VectorQuantize

from motionloom.models.quantize.base import QuantizerConfig, nearest
from motionloom.models.quantize.ema import EmaQuantizer, cluster_sums


def interleaved_medians(calls: dict[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Median milliseconds of each call; calls take turns, so a slow phase of the machine hits all of them."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for i in range(repeats + 3):
        for name, call in calls.items():
            start = time.perf_counter()
            call()
            if i >= 3:
                times[name].append(1000 * (time.perf_counter() - start))
    return {name: statistics.median(values) for name, values in times.items()}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--vectors", type=int, default=4096)
    parser.add_argument("--dim", type=int, default=512)
    parser.add_argument("--codes", type=int, default=512)
    parser.add_argument("--repeats", type=int, default=20)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    torch.manual_seed(0)
    z = torch.randn(16, args.vectors // 16, args.dim)
    flat = z.reshape(-1, args.dim)
    ours = EmaQuantizer(QuantizerConfig(num_codes=args.codes, dim=args.dim))
    theirs = VectorQuantize(args.dim, args.codes, decay=0.99, threshold_ema_dead_code=1)
    ours(z)
    codebook = ours.codebook.clone()

    def floor() -> None:
        cluster_sums(flat, nearest(flat, codebook), args.codes)

    def train(quantizer: torch.nn.Module) -> Callable[[], object]:
        return lambda: quantizer(z)

    result = interleaved_medians(
        {"ours": train(ours), "vector-quantize-pytorch": train(theirs), "floor": floor}, args.repeats
    )
    for name, milliseconds in result.items():
        print(f"{name:<26}{milliseconds:8.1f} ms")
    print(f"{'ours / vqp':<26}{result['ours'] / result['vector-quantize-pytorch']:8.2f}")
    print(f"{'ours / floor':<26}{result['ours'] / result['floor']:8.2f}")


if __name__ == "__main__":
    main()
