"""Beat network: levels of 64 mel bands in, for each row the probability of a beat and of a downbeat out.

Row t is centred at t / 60 s. Dilated convolutions see some eight seconds to both sides of a row. The weights
in this package (`beats.safetensors`) were trained on songs with known beats, played by a band of General MIDI
instruments, and on excerpts of freedoom's MIDI files, by an earlier form of the recipe `ude-beats`.

Gain and equaliser of a recording are taken out before the network: power becomes decibels, of which each
band's mean over the piece is subtracted. Spectra need no librosa, whose import takes seconds.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from motionloom.datasets.audio.sound import Sound
from motionloom.datasets.base.config import Config
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.json_doors import parse_json

BANDS = 64
ROWS = 60
"""Rows a second."""
RATE = 30720
"""Sample rate that spectra are computed at, Hz."""

_HOP = RATE // ROWS
_FFT = 2048
_EDGES = (30.0, 14_000.0)
_SPECTRA = 2048
"""Rows of spectra that are computed at a time."""

WEIGHTS = Path(__file__).with_name("beats.safetensors")

_FLOOR = 1e-8
"""Power against the loudest of the piece: 80 dB below it is silence."""
_BLOCK = 4096


def band_power(sound: Sound) -> NDArray[np.float32]:
    """Return the power of a sound's bands, float32 [1 + n // 512, 64], n its samples at 30720 Hz.

    Bands are triangles, evenly spaced in mel from 30 Hz to 14 kHz, which every recording has something of.
    """
    from scipy.fft import rfft

    samples = np.pad(sound.resampled(RATE).samples, _FFT // 2)
    frames = np.lib.stride_tricks.sliding_window_view(samples, _FFT)[::_HOP]
    window = np.hanning(_FFT + 1)[:-1].astype(np.float32)
    blocks = []
    for start in range(0, len(frames), _SPECTRA):
        spectrum = np.abs(rfft(frames[start : start + _SPECTRA] * window, axis=1))
        blocks.append(spectrum**2 @ _filters())
    return np.concatenate(blocks)


def band_from(hertz: float) -> int:
    """Return the number of the first band whose centre is at or above a frequency."""
    return int(np.searchsorted(_centres()[1:-1], hertz))


def _centres() -> NDArray[np.float64]:
    """[66] Hz: the centres of the bands, and a point to each side of them."""
    low, high = (np.log1p(hertz / 700) for hertz in _EDGES)
    return np.asarray(700 * np.expm1(np.linspace(low, high, BANDS + 2)))


@lru_cache(maxsize=1)
def _filters() -> NDArray[np.float32]:
    """[1025, 64]: each band rises from the centre of the one below to its own and falls to the next."""
    hertz = np.fft.rfftfreq(_FFT, 1 / RATE)[:, None]
    points = _centres()
    below = points[:-2]
    centre = points[1:-1]
    above = points[2:]
    shape = np.minimum((hertz - below) / (centre - below), (above - hertz) / (above - centre))
    return np.maximum(shape, 0).astype(np.float32)


class BeatNetConfig(Config):
    """Sizes of the network."""

    width: int = Field(48, ge=1)
    layers: int = Field(8, ge=1, le=12)
    """Dilations are 1, 2, 4, ...: each layer doubles the reach."""
    kernel: int = Field(5, ge=3)
    dropout: float = Field(0.1, ge=0, lt=1)


class BeatNet(nn.Module):
    """Levels [B, T, 64] -> logits [B, T, 2] of beats and downbeats."""

    def __init__(self, config: BeatNetConfig) -> None:
        super().__init__()
        self.config = config
        width = config.width
        kernel = config.kernel
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
    """Return the network's input of a piece's power [T, 64]: levels in units of 10 dB, each band's mean 0."""
    loudest = float(power.max(initial=0.0))
    if loudest <= 0.0:
        return np.zeros_like(power)
    decibels = np.log10(power / loudest + _FLOOR, dtype=np.float32)
    return np.asarray(decibels - decibels.mean(axis=0), dtype=np.float32)


@torch.no_grad()
def activations(net: BeatNet, rows: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return probabilities [T, 2] of a beat and a downbeat of levels [T, 64]; long pieces block by block."""
    out = np.empty((len(rows), 2), dtype=np.float32)
    for start in range(0, len(rows), _BLOCK):
        stop = min(start + _BLOCK, len(rows))
        # Each block is read with all rows that its logits depend on, so that no seam shows.
        first = max(0, start - net.reach)
        around = torch.from_numpy(rows[first : stop + net.reach])
        logits = net(around[None])[0, start - first : stop - first]
        out[start:stop] = logits.sigmoid().numpy()
    return out


@lru_cache(maxsize=1)
def load_beat_net() -> BeatNet:
    """The trained network of this package."""
    return read_beat_net(WEIGHTS)


def read_beat_net(path: Path) -> BeatNet:
    """A network with the sizes that its file states, frozen; `UserError` for a file that is none."""
    try:
        with safe_open(path, "pt") as file:
            about = parse_json((file.metadata() or {}).get("config", "null"), str(path))
            state = {name: file.get_tensor(name).float() for name in list(file.keys())}
        net = BeatNet(BeatNetConfig.parse(about, str(path)))
        net.load_state_dict(state)
    except (OSError, SafetensorError, RuntimeError, ValueError) as error:
        why = " ".join(str(error).split())[:200]
        raise UserError(f"{path}: no weights of a beat network ({why}); install motionloom again") from None
    return net.eval().requires_grad_(False)
