"""Parts of `benchmarks/fuzz.py`: mutations, the table of readers, and the workers that read."""

import sys
from pathlib import Path

sys.path.append(
    str(Path(__file__).resolve().parents[2] / "tests/helpers")
)  # whose clips and trees are the seeds
