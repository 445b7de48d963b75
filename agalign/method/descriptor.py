"""The descriptor f(x; theta), a shallow CNN with one first layer for each band, and how descriptors are compared
(paper, Sec. 4.4 and 5.3).

Conv(C, 32, 5) - Tanh - MaxPool(2) - Conv(32, 64, 3) - Tanh - FC(256) on 16 x 16 patches.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from agalign.errors import ConfigurationError
from agalign.values.choices import Sharing

PATCH_PX = 16
DIMENSION = 256
REFERENCE = 0
"""The side of the reference image; the moving bands follow from 1."""


class _FirstLayer(nn.Module):
    """Conv - Tanh - MaxPool, computed as Conv - MaxPool - Tanh: tanh is increasing, so they are equal, and there
    is a quarter as much of it.

    With `half_rectified`, |tanh| in the second half of the channels: an edge and its contrast-reversed twin then
    give the same response there from the first step on, which is what vegetation does between visible and near
    infra-red bands. |tanh(x)| = tanh(|x|), so the order does not matter here either.
    """

    def __init__(self, channels: int, half_rectified: bool) -> None:
        super().__init__()
        self.convolution = nn.Conv2d(channels, 32, 5)
        self.half_rectified = half_rectified

    def forward(self, x: Tensor) -> Tensor:
        """(N, C, 16, 16) -> (N, 32, 6, 6)."""
        x = self.convolution(x.contiguous(memory_format=torch.channels_last))
        if self.half_rectified:
            # In place: copies of the largest tensor there is would take longer than the convolution.
            x[:, x.shape[1] // 2 :].abs_()
        return nn.functional.max_pool2d(x, 2).tanh_()


def _trunk() -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(32, 64, 3), nn.Tanh(), nn.Flatten(), nn.Linear(64 * 4 * 4, DIMENSION))


def distance(f: Tensor, f_prime: Tensor) -> Tensor:
    """L0 of the paper: ||f(x) - f(x')||_2 row by row, (N, D) x (N, D) -> (N,). Its gradient at 0 is 0, not nan."""
    return (f - f_prime).square().sum(dim=1).clamp_min(1e-12).sqrt()


def retrieval(f: Tensor, f_prime: Tensor, allowed: Tensor) -> float:
    """Share of rows of `f` (N, D) with their own as nearest row of `f_prime` (N, D), averaged over both directions.

    Pairs that are not `allowed` (N, N) do not compete; the diagonal always does. Chance is about 1 / N.
    """
    d = torch.cdist(f, f_prime)
    keep = allowed | torch.eye(len(f), dtype=torch.bool, device=f.device)
    d = d.masked_fill(~keep, float("inf"))
    target = torch.arange(len(f), device=f.device)
    hits = (d.argmin(dim=1) == target).float().mean() + (d.argmin(dim=0) == target).float().mean()
    return float(0.5 * hits)


class Descriptor(nn.Module):
    """One network a side (the reference, and each moving band) that share all, all but the first layer, or nothing.

    `channels` has the number of channels of each side, the reference's first. `unit_length` scales every descriptor
    to length 1, which the in-batch loss needs and the paper's does not. Raises ConfigurationError where a siamese
    network is asked to take images of different channels.
    """

    def __init__(
        self,
        sharing: Sharing = "pseudo-siamese",
        channels: Sequence[int] = (1, 1),
        *,
        half_rectified: bool = False,
        unit_length: bool = False,
    ) -> None:
        super().__init__()
        if sharing == "siamese" and len(set(channels)) > 1:
            raise ConfigurationError(
                f"siamese networks need images of the same channels, not {tuple(channels)}; use pseudo-siamese"
            )
        self.sharing = sharing
        self.channels = tuple(channels)
        self.learnt = False
        """True where the weights are not random, so that psi may move from the first step on."""
        self.unit_length = unit_length
        own_first = channels if sharing != "siamese" else channels[:1]
        self.first = nn.ModuleList(_FirstLayer(c, half_rectified) for c in own_first)
        self.trunk = nn.ModuleList(_trunk() for _ in (channels if sharing == "unshared" else channels[:1]))
        # The NHWC layout makes the small convolutions nearly twice as fast on a CPU.
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, patches: Tensor, side: int) -> Tensor:
        """(N, C, 16, 16) -> (N, 256)."""
        return self.describe([patches], [side])[0]

    def describe(self, patches: Sequence[Tensor], sides: Sequence[int]) -> list[Tensor]:
        """`forward` for several sides at once: what they share runs once."""
        responses = [self.first[min(side, len(self.first) - 1)](x) for x, side in zip(patches, sides, strict=True)]
        if len(self.trunk) == 1:
            whole: Tensor = self.trunk[0](torch.cat(responses))
            result = list(torch.split(whole, [len(x) for x in patches]))
        else:
            result = [self.trunk[side](x) for x, side in zip(responses, sides, strict=True)]
        return [nn.functional.normalize(f, dim=1) for f in result] if self.unit_length else result
