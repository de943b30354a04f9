"""1-D convolutional encoder and decoder of the motion tokenizers (HumanTOMATO B.2).

- Borders are channels-last (`[B, T, D]`); inside, convolutions run channels-first (`[B, C, T]`).
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


def frame_padding(valid: Tensor | None, frames: int, stride: int) -> Tensor | None:
    """True where a position of a sequence at 1/stride of the frame rate is padding, [B, 1, frames/stride].

    `valid` [B] counts frames and must be a multiple of `stride`; None means that nothing is padded.
    """
    if valid is None:
        return None
    position = torch.arange(0, frames, stride, device=valid.device)
    return (position >= valid[:, None])[:, None]


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


def zero_padded(x: Tensor, padding: Tensor | None) -> Tensor:
    """x [B, C, T] with zeros where `padding` [B, 1, T]; None = nothing is padded."""
    return x if padding is None else x.masked_fill(padding, 0.0)


class ResidualBlock(nn.Module):
    """ReLU, dilated convolution, ReLU, 1x1 convolution, plus the input; [B, C, T] -> [B, C, T]."""

    def __init__(self, width: int, dilation: int) -> None:
        super().__init__()
        self.spread = nn.Conv1d(width, width, 3, padding=dilation, dilation=dilation)
        self.mix = nn.Conv1d(width, width, 1)

    def forward(self, x: Tensor, padding: Tensor | None) -> Tensor:
        """`padding` [B, 1, T] marks the positions to ignore."""
        hidden = self.spread(zero_padded(functional.relu(x), padding))
        mixed: Tensor = self.mix(functional.relu(hidden))
        return x + mixed


class ResidualStack(nn.Module):
    """`depth` residual blocks whose dilation falls from growth^(depth-1) to 1."""

    def __init__(self, width: int, depth: int, dilation_growth: int) -> None:
        super().__init__()
        dilations = [dilation_growth**i for i in reversed(range(depth))]
        self.blocks = nn.ModuleList(ResidualBlock(width, dilation) for dilation in dilations)
        self.reach = sum(dilations)
        """Positions to either side that one of its outputs looks at."""

    def forward(self, x: Tensor, padding: Tensor | None) -> Tensor:
        for block in self.blocks:
            x = block(x, padding)
        return x


class ConvEncoder(nn.Module):
    """Frames to latents: `halvings` stride-2 stages, [B, T, dim] -> [B, T / 2^halvings, out_dim]."""

    def __init__(
        self, dim: int, out_dim: int, *, width: int, halvings: int, depth: int, dilation_growth: int
    ) -> None:
        super().__init__()
        self.enter = nn.Conv1d(dim, width, 3, padding=1)
        # Kernel 4 with stride 2 and padding 1 halves T exactly and covers every frame equally often (twice).
        self.down = nn.ModuleList(nn.Conv1d(width, width, 4, stride=2, padding=1) for _ in range(halvings))
        self.stacks = nn.ModuleList(ResidualStack(width, depth, dilation_growth) for _ in range(halvings))
        self.leave = nn.Conv1d(width, out_dim, 3, padding=1)
        start_weights(self)

    def forward(self, x: Tensor, valid: Tensor | None = None) -> Tensor:
        """`valid` [B] = frames that are not padding, a multiple of 2^halvings; T is a multiple of it too."""
        frames = x.shape[1]
        padding = [frame_padding(valid, frames, 2**i) for i in range(len(self.down) + 1)]
        hidden = functional.relu(self.enter(zero_padded(x.transpose(1, 2), padding[0])))
        for i, (down, stack) in enumerate(zip(self.down, self.stacks, strict=True)):
            hidden = stack(down(zero_padded(hidden, padding[i])), padding[i + 1])
        latents: Tensor = self.leave(zero_padded(hidden, padding[-1]))
        return latents.transpose(1, 2)


class ConvDecoder(nn.Module):
    """Latents to frames: `doublings` nearest x2 stages, [B, L, dim] -> [B, L * 2^doublings, out_dim]."""

    def __init__(
        self, dim: int, out_dim: int, *, width: int, doublings: int, depth: int, dilation_growth: int
    ) -> None:
        super().__init__()
        self.stride = 2**doublings
        """Frames of one latent."""
        self.enter = nn.Conv1d(dim, width, 3, padding=1)
        self.stacks = nn.ModuleList(ResidualStack(width, depth, dilation_growth) for _ in range(doublings))
        # Nearest up-sampling, then a convolution: a transposed one leaves a pattern of uneven overlaps.
        self.up = nn.ModuleList(nn.Conv1d(width, width, 3, padding=1) for _ in range(doublings))
        self.refine = nn.Conv1d(width, width, 3, padding=1)
        self.leave = nn.Conv1d(width, out_dim, 3, padding=1)
        start_weights(self)
        with torch.no_grad():
            self.leave.weight.mul_(0.1)  # near the mean pose, which is zero

    def forward(self, z: Tensor, valid: Tensor | None = None) -> Tensor:
        """`valid` [B] = *frames* (after up-sampling) that are not padding; padded frames come out as zero."""
        doublings = len(self.up)
        frames = z.shape[1] * 2**doublings
        padding = [frame_padding(valid, frames, 2**i) for i in range(doublings + 1)]
        hidden = functional.relu(self.enter(zero_padded(z.transpose(1, 2), padding[-1])))
        for i, (stack, up) in enumerate(zip(self.stacks, self.up, strict=True)):
            level = doublings - i
            hidden = stack(hidden, padding[level]).repeat_interleave(2, dim=2)
            hidden = up(zero_padded(hidden, padding[level - 1]))
        hidden = functional.relu(self.refine(zero_padded(hidden, padding[0])))
        return zero_padded(self.leave(zero_padded(hidden, padding[0])), padding[0]).transpose(1, 2)

    def needs(self, first: int, last: int) -> tuple[int, int]:
        """First and last of the latents that frames `first` to `last` are made of; no others play a role."""
        first, last = first - 2, last + 2  # refine and leave have kernel 3: one frame to either side each
        for stack in reversed(self.stacks):
            assert isinstance(stack, ResidualStack)
            first, last = (first - 1) // 2 - stack.reach, (last + 1) // 2 + stack.reach
        return first - 1, last + 1
