"""The descriptor f(x; theta): a shallow CNN in siamese, pseudo-siamese or unshared form (paper, Sec. 4.4 and 5.3).

Conv(C, 32, 5) - Tanh - MaxPool(2) - Conv(32, 64, 3) - Tanh - FC(256) on 16 x 16 patches.
"""

from typing import Literal

import torch
from torch import Tensor, nn

Sharing = Literal["siamese", "pseudo-siamese", "unshared"]
Side = Literal["fixed", "moving"]

PATCH_PX = 16
DIMENSION = 256


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
        x = self.convolution(x)
        if self.half_rectified:
            signed, folded = x.chunk(2, dim=1)
            x = torch.cat([signed, folded.abs()], dim=1)
        return torch.tanh(nn.functional.max_pool2d(x, 2))


def _trunk() -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(32, 64, 3), nn.Tanh(), nn.Flatten(), nn.Linear(64 * 4 * 4, DIMENSION))


class Descriptor(nn.Module):
    """Two networks, one a side, that share all, all but the first layer, or nothing.

    `unit_length` scales every descriptor to length 1, which the in-batch loss needs and the paper's does not.
    """

    def __init__(
        self,
        sharing: Sharing = "pseudo-siamese",
        fixed_channels: int = 1,
        moving_channels: int = 1,
        *,
        half_rectified: bool = False,
        unit_length: bool = False,
    ) -> None:
        super().__init__()
        self.sharing = sharing
        self.unit_length = unit_length
        self.fixed_first = _FirstLayer(fixed_channels, half_rectified)
        self.moving_first = self.fixed_first if sharing == "siamese" else _FirstLayer(moving_channels, half_rectified)
        self.fixed_trunk = _trunk()
        self.moving_trunk = _trunk() if sharing == "unshared" else self.fixed_trunk
        # The NHWC layout makes the small convolutions nearly twice as fast on a CPU.
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, patches: Tensor, side: Side) -> Tensor:
        """(N, C, 16, 16) -> (N, 256)."""
        x = patches.contiguous(memory_format=torch.channels_last)
        first, trunk = {
            "fixed": (self.fixed_first, self.fixed_trunk),
            "moving": (self.moving_first, self.moving_trunk),
        }[side]
        f: Tensor = trunk(first(x))
        return nn.functional.normalize(f, dim=1) if self.unit_length else f
