"""The network that hears beats: levels of bands in, for each row how likely a beat and a downbeat are.

Dilated convolutions over 60 rows a second hear some eight seconds to both sides of a row. The weights in this
package (`beats.safetensors`) were trained by the recipe `beats` on songs that a band of General MIDI
instruments plays, whose beats are known; `stages/networks/beats.py` says how they are made.

What a recording does to music is taken out before the network: power becomes decibels, of which each band's
mean over the piece is subtracted, so that neither gain nor equaliser counts.
"""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from motionloom.datasets.audio.bands import BANDS
from motionloom.datasets.base.files import atomic_path
from motionloom.datasets.schema import Config, UserError

WEIGHTS = Path(__file__).with_name("beats.safetensors")

_FLOOR = 1e-8
"""Power against the loudest of the piece: 80 dB below it is silence."""
_BLOCK = 4096


class BeatNetConfig(Config):
    """Sizes of the network."""

    width: int = Field(48, ge=1)
    layers: int = Field(8, ge=1, le=12)
    """Dilations are 1, 2, 4, ...: each layer doubles how far is heard."""
    kernel: int = Field(5, ge=3)
    dropout: float = Field(0.1, ge=0, lt=1)


class BeatNet(nn.Module):
    """Levels [B, T, 64] -> logits [B, T, 2] of beats and downbeats."""

    def __init__(self, config: BeatNetConfig) -> None:
        super().__init__()
        self.config = config
        width, kernel = config.width, config.kernel
        self.first = nn.Conv1d(BANDS, width, kernel, padding="same")
        dilations = [2**layer for layer in range(config.layers)]
        self.heard = nn.ModuleList(
            nn.Conv1d(width, width, kernel, padding="same", dilation=step) for step in dilations
        )
        self.mixed = nn.ModuleList(nn.Conv1d(width, width, 1) for _ in dilations)
        self.dropout = nn.Dropout1d(config.dropout)
        self.last = nn.Conv1d(width, 2, 1)

    @property
    def reach(self) -> int:
        """Rows to each side of one that its logits depend on."""
        return self.config.kernel // 2 * (1 << self.config.layers)

    def forward(self, levels: Tensor) -> Tensor:
        """Silence, which is what levels of 0 stand for, continues both ends."""
        x = nn.functional.elu(self.first(levels.mT))
        for heard, mixed in zip(self.heard, self.mixed, strict=True):
            x = x + mixed(self.dropout(nn.functional.elu(heard(x))))
        logits: Tensor = self.last(nn.functional.elu(x))
        return logits.mT


def levels(power: NDArray[np.float32]) -> NDArray[np.float32]:
    """Power [T, 64] of a piece -> levels in units of 10 dB, each band's mean 0: what the network hears."""
    loudest = float(power.max(initial=0.0))
    if loudest <= 0.0:
        return np.zeros_like(power)
    found = np.log10(power / loudest + _FLOOR, dtype=np.float32)
    return np.asarray(found - found.mean(axis=0), dtype=np.float32)


@torch.no_grad()
def activations(net: BeatNet, heard: NDArray[np.float32]) -> NDArray[np.float32]:
    """Levels [T, 64] -> probabilities [T, 2] of a beat and a downbeat; long pieces block by block."""
    out = np.empty((len(heard), 2), dtype=np.float32)
    for start in range(0, len(heard), _BLOCK):
        stop = min(start + _BLOCK, len(heard))
        first = max(0, start - net.reach)
        around = torch.from_numpy(heard[first : stop + net.reach])
        logits = net(around[None])[0, start - first : stop - first]
        out[start:stop] = logits.sigmoid().numpy()
    return out


@lru_cache(maxsize=1)
def load_beat_net() -> BeatNet:
    """The trained network of this package."""
    return read_beat_net(WEIGHTS)


def read_beat_net(path: Path) -> BeatNet:
    """A network as `write_beat_net` wrote it, frozen; `UserError` for a file that is none."""
    try:
        with safe_open(path, "pt") as file:
            about = json.loads((file.metadata() or {}).get("config", "null"))
            state = {name: file.get_tensor(name).float() for name in list(file.keys())}
        net = BeatNet(BeatNetConfig.parse(about, str(path)))
        net.load_state_dict(state)
    except (OSError, SafetensorError, RuntimeError, ValueError) as error:
        why = " ".join(str(error).split())[:200]
        raise UserError(f"{path}: no weights of a beat network ({why}); install motionloom again") from None
    return net.eval().requires_grad_(False)


def write_beat_net(net: BeatNet, path: Path) -> None:
    """Weights in half precision, with the sizes of the network."""
    state = {name: value.detach().half().contiguous() for name, value in net.state_dict().items()}
    with atomic_path(path) as temporary:
        temporary.write_bytes(save(state, {"config": json.dumps(net.config.dump())}))
