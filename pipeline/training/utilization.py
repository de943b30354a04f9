"""Model FLOPs utilisation (MFU) and goodput of a training.

MFU is as in PaLM (Chowdhery et al. 2022, appendix B): matrix products and convolutions of one forward and one
backward pass, over the time of a step and the dense peak of the maker's data sheet. What is recomputed for
checkpointed activations, and all that is elementwise, counts nothing.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeCopyMode, FakeTensorMode
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from motionloom.models.training.alternating import AlternatingModule
from motionloom.models.training.stage_module import Batch, StageModule

PEAKS = {
    "H100 PCIe": (756, 51),
    "H100": (989, 67),
    "H200": (989, 67),
    "A100": (312, 19.5),
    "L40S": (362, 91.6),
    "L4": (121, 30.3),
    "RTX 4090": (165, 82.6),
    "RTX 3090": (71, 35.6),
}
"""Dense TFLOP/s by the makers' data sheets: half precision with float32 sums, and float32 without TF32."""


def peak_flops(device: torch.device, precision: str) -> float | None:
    """Return the peak FLOP/s of the device in a `train.precision`; None if unknown."""
    if device.type != "cuda":
        return None
    name = torch.cuda.get_device_name(device)
    found = next((pair for known, pair in PEAKS.items() if known in name), None)
    return None if found is None else 1e12 * found[precision == "32-true"]


def pass_flops(module: StageModule, batch: Batch) -> int:
    """Return the FLOPs of forward and backward pass over a batch, all groups' turns, on fake tensors."""
    with FakeTensorMode(allow_non_fake_inputs=True) as fake:
        with FakeCopyMode(fake):
            module, batch = copy.deepcopy((module, batch))
        module.eval()  # a group that begins later in the training counts from the first step on
        # Fused attention of CPUs is in no table of the counter; its parts are.
        with FlopCounterMode(display=False) as counter, sdpa_kernel(SDPBackend.MATH):
            torch.autograd.backward(_loss(module, module.losses(batch)))
    return int(counter.get_total_flops())


def _loss(module: StageModule, values: Mapping[str, Tensor]) -> Tensor:
    if not isinstance(module, AlternatingModule):
        return values["loss"]
    return torch.stack([values[f"{group.name}_loss"] for group in module.optimizer_groups()]).sum()


class Utilization:
    """MFU and goodput of one process, row by row; goodput goes on from the `rows` of the processes before.

    Goodput is the share of the time that went into steps which count, waits for their data included. The rest
    is validations, checkpoints, steps that a kill has undone, and the start of a process with its first step,
    which compiles and chooses kernels. The time between two processes counts on neither side. A step would
    take `at_peak` seconds at the device's peak; 0 where that is not known.
    """

    def __init__(
        self,
        rows: Sequence[Mapping[str, float]],
        step: int,
        at_peak: float,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self._at_peak = at_peak
        self._clock = clock
        kept = [row for row in rows if row["step"] <= step]
        self._spent = rows[-1].get("elapsed_seconds", 0.0) if rows else 0.0
        self._good = kept[-1].get("elapsed_seconds", 0.0) * kept[-1].get("goodput", 0.0) if kept else 0.0
        self._since = clock()
        self._aside = 0.0

    def row(self, steps: int, aside: float) -> tuple[float, dict[str, float]]:
        """Mean seconds of `steps` steps, and figures of their row; call it where the device is waited for.

        `aside` are the seconds of this process so far that were not good.
        """
        now = self._clock()
        good = max(0.0, now - self._since - (aside - self._aside))
        self._spent += now - self._since
        self._good += good
        self._since = now
        self._aside = aside
        seconds = max(good, 1e-9) / max(steps, 1)
        figures = {"elapsed_seconds": self._spent, "goodput": self._good / max(self._spent, 1e-9)}
        if self._at_peak and steps:
            figures["mfu"] = self._at_peak / seconds
        return seconds, figures
