"""1-D convolutional encoder and decoder of the motion tokenizers (HumanTOMATO B.2).

- All is channels-last (`[B, T, C]`), as `Conv` takes it.
- Down: kernel 4, stride 2. Up: nearest x2, then a convolution. Each resolution carries residual blocks with
  dilations growth^(depth-1), ..., growth, 1: the wide view first, as in the public T2M-GPT configuration.
- Weights start as He et al. (2015) have it for ReLU and residual branches near zero: with torch's own,
  signals shrink from layer to layer, and at an equal number of steps fingers are reconstructed a third worse.
- Padded frames are set to zero before every convolution that looks at neighbours. Zero is also what a
  convolution sees past the end of a clip, so a clip in a padded batch gives what it gives alone.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional


def real_frames(valid: Tensor | None, frames: int, stride: int) -> Tensor | None:
    """False where a position of a sequence at 1/stride of the frame rate is padding, [B, frames/stride, 1].

    `valid` [B] counts frames and must be a multiple of `stride`; None means that nothing is padded.
    """
    if valid is None:
        return None
    position = torch.arange(0, frames, stride, device=valid.device)
    return (position < valid[:, None])[..., None]


class Conv(nn.Conv1d):
    """`nn.Conv1d` of [B, T, C], padded with zeros by a number.

    torch copies the input of every 1-D convolution to [B, C, T], and cudnn and oneDNN copy it back before
    they compute. A 2-D one of height 1 keeps channels last; one with a kernel of 1 is a matrix product.
    """

    def forward(self, x: Tensor) -> Tensor:
        if self.kernel_size == self.stride == (1,):
            return functional.linear(x, self.weight[..., 0], self.bias)
        step = (1, *self.stride)
        padding = (0, int(self.padding[0]))
        dilation = (1, *self.dilation)
        weight = self.weight[:, :, None]
        out = functional.conv2d(x.mT[:, :, None], weight, self.bias, step, padding, dilation)
        return out[:, :, 0].mT


class ConvTranspose(nn.ConvTranspose1d):
    """`nn.ConvTranspose1d` of [B, T, C], for the same reason."""

    def forward(self, x: Tensor, output_size: list[int] | None = None) -> Tensor:
        step = (1, *self.stride)
        padding = (0, int(self.padding[0]))
        weight = self.weight[:, :, None]
        return functional.conv_transpose2d(x.mT[:, :, None], weight, self.bias, step, padding)[:, :, 0].mT


@torch.no_grad()
def start_weights(net: nn.Module, slope: float = 0.0) -> None:
    """Fresh weights for an encoder or decoder whose (leaky) ReLUs have this slope below zero."""
    for name, layer in net.named_modules():
        if isinstance(layer, nn.Conv1d):
            nn.init.kaiming_normal_(layer.weight, a=slope, nonlinearity="leaky_relu")
            assert layer.bias is not None
            nn.init.zeros_(layer.bias)
            if name.endswith(".mix"):
                layer.weight.mul_(0.1)


def zero_padded(x: Tensor, real: Tensor | None) -> Tensor:
    """x [B, T, C], finite, with zeros where `real` [B, T, 1] is false; None = nothing is padded."""
    return x if real is None else x * real  # one pass over memory; `masked_fill` takes two


class ResidualBlock(nn.Module):
    """ReLU, dilated convolution, ReLU, 1x1 convolution, plus the input; [B, T, C] -> [B, T, C]."""

    def __init__(self, width: int, dilation: int) -> None:
        super().__init__()
        self.spread = Conv(width, width, 3, padding=dilation, dilation=dilation)
        self.mix = Conv(width, width, 1)

    def forward(self, x: Tensor, real: Tensor | None) -> Tensor:
        """`real` [B, T, 1] is false at the positions to ignore."""
        hidden = self.spread(zero_padded(functional.relu(x), real))
        mixed: Tensor = self.mix(functional.relu(hidden))
        return x + mixed


class ResidualStack(nn.Module):
    """`depth` residual blocks whose dilation falls from growth^(depth-1) to 1."""

    def __init__(self, width: int, depth: int, dilation_growth: int) -> None:
        super().__init__()
        dilations = [dilation_growth**i for i in reversed(range(depth))]
        self.blocks = nn.ModuleList(ResidualBlock(width, dilation) for dilation in dilations)

    def forward(self, x: Tensor, real: Tensor | None) -> Tensor:
        for block in self.blocks:
            x = block(x, real)
        return x


class ConvEncoder(nn.Module):
    """Frames to latents: `halvings` stride-2 stages, [B, T, dim] -> [B, T / 2^halvings, out_dim]."""

    def __init__(
        self, dim: int, out_dim: int, *, width: int, halvings: int, depth: int, dilation_growth: int
    ) -> None:
        super().__init__()
        self.enter = Conv(dim, width, 3, padding=1)
        # Kernel 4 with stride 2 and padding 1 halves T exactly and covers every frame equally often (twice).
        self.down = nn.ModuleList(Conv(width, width, 4, stride=2, padding=1) for _ in range(halvings))
        self.stacks = nn.ModuleList(ResidualStack(width, depth, dilation_growth) for _ in range(halvings))
        self.leave = Conv(width, out_dim, 3, padding=1)
        start_weights(self)

    def forward(self, x: Tensor, valid: Tensor | None = None) -> Tensor:
        """`valid` [B] = frames that are not padding, a multiple of 2^halvings; T is a multiple of it too."""
        frames = x.shape[1]
        real = [real_frames(valid, frames, 2**i) for i in range(len(self.down) + 1)]
        hidden = functional.relu(self.enter(zero_padded(x, real[0])))
        for i, (down, stack) in enumerate(zip(self.down, self.stacks, strict=True)):
            hidden = stack(down(zero_padded(hidden, real[i])), real[i + 1])
        latents: Tensor = self.leave(zero_padded(hidden, real[-1]))
        return latents


class ConvDecoder(nn.Module):
    """Latents to frames: `doublings` nearest x2 stages, [B, L, dim] -> [B, L * 2^doublings, out_dim]."""

    def __init__(
        self, dim: int, out_dim: int, *, width: int, doublings: int, depth: int, dilation_growth: int
    ) -> None:
        super().__init__()
        self.enter = Conv(dim, width, 3, padding=1)
        self.stacks = nn.ModuleList(ResidualStack(width, depth, dilation_growth) for _ in range(doublings))
        # Nearest up-sampling, then a convolution: a transposed one leaves a pattern of uneven overlaps.
        self.up = nn.ModuleList(Conv(width, width, 3, padding=1) for _ in range(doublings))
        self.refine = Conv(width, width, 3, padding=1)
        self.leave = Conv(width, out_dim, 3, padding=1)
        start_weights(self)
        with torch.no_grad():
            self.leave.weight.mul_(0.1)  # near the mean pose, which is zero

    def forward(self, z: Tensor, valid: Tensor | None = None) -> Tensor:
        """`valid` [B] = *frames* (after up-sampling) that are not padding; padded frames come out as zero."""
        doublings = len(self.up)
        frames = z.shape[1] * 2**doublings
        real = [real_frames(valid, frames, 2**i) for i in range(doublings + 1)]
        hidden = functional.relu(self.enter(zero_padded(z, real[-1])))
        for i, (stack, up) in enumerate(zip(self.stacks, self.up, strict=True)):
            level = doublings - i
            hidden = stack(hidden, real[level]).repeat_interleave(2, dim=1)
            hidden = up(zero_padded(hidden, real[level - 1]))
        hidden = functional.relu(self.refine(zero_padded(hidden, real[0])))
        return zero_padded(self.leave(zero_padded(hidden, real[0])), real[0])
