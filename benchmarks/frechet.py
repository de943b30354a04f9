"""FID of 10,000 embeddings of width 512 beside the public code's way, in one run.

    python benchmarks/frechet.py

The public evaluators take scipy's square root of the product of the covariances, which is no symmetric
matrix; ours takes eigenvalues of a symmetric one (`models/metrics/distributions.py`). Floor: the covariances,
which both need; what comes behind them is also timed alone.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
import scipy.linalg
import torch
from numpy.typing import NDArray

from motionloom.models.metrics.distributions import fid, frechet_distance, statistics

Array = NDArray[np.float64]


def public(a: Array, b: Array) -> float:
    """As the evaluators of Guo et al. have it."""
    return public_distance(a.mean(0), np.cov(a, rowvar=False), b.mean(0), np.cov(b, rowvar=False))


def public_distance(mean: Array, one: Array, other: Array, two: Array) -> float:
    """The same of means and covariances."""
    difference = mean - other
    root = scipy.linalg.sqrtm(one @ two)
    root = root.real if np.iscomplexobj(root) else root
    return float(difference @ difference + np.trace(one) + np.trace(two) - 2 * np.trace(root))


def seconds(work: Callable[[], object], repeats: int) -> float:
    """The fastest of several."""
    best = float("inf")
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        best = min(best, time.perf_counter() - start)
    return best


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rows", type=int, default=10_000)
    parser.add_argument("--width", type=int, default=512)
    parser.add_argument("--repeats", type=int, default=3)
    args = parser.parse_args()
    generator = torch.Generator().manual_seed(0)
    mix = torch.randn(args.width, args.width, generator=generator, dtype=torch.float64) / args.width**0.5
    a = torch.randn(args.rows, args.width, generator=generator, dtype=torch.float64) @ mix
    b = torch.randn(args.rows, args.width, generator=generator, dtype=torch.float64) @ mix + 0.1
    ours, theirs = float(fid(a, b)), public(a.numpy(), b.numpy())
    known = (*statistics(a), *statistics(b))
    arrays = tuple(x.numpy() for x in known)
    times = {
        "covariances alone": seconds(lambda: (statistics(a), statistics(b)), args.repeats),
        "behind them: ours": seconds(lambda: frechet_distance(*known), args.repeats),
        "behind them: sqrtm": seconds(lambda: public_distance(*arrays), args.repeats),
        "ours": seconds(lambda: fid(a, b), args.repeats),
        "scipy's sqrtm": seconds(lambda: public(a.numpy(), b.numpy()), args.repeats),
    }
    print(f"{args.rows} x {args.width}, {torch.get_num_threads()} threads")
    for name, taken in times.items():
        print(f"{name:20} {1000 * taken:8.0f} ms   {taken / times['ours']:.2f} x ours")
    print(f"ours {ours:.12g}, theirs {theirs:.12g}, relative difference {abs(ours - theirs) / theirs:.1e}")


if __name__ == "__main__":
    main()
