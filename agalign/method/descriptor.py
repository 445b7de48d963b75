"""The descriptor f(x; theta), a shallow CNN with one first layer per band; distance and retrieval of descriptors
(paper, Sec. 4.4 and 5.3).

Conv(C, 32, 5) - Tanh - MaxPool(2) - Conv(32, 64, 3) - Tanh - FC(256) on 16 x 16 patches.
"""

from collections.abc import Mapping, Sequence
from functools import cache
from importlib import resources

import torch
from safetensors.torch import load
from torch import Tensor, nn

from agalign.errors import ConfigurationError
from agalign.values.choices import Sharing

PATCH_PX = 16
"""Side of a patch in samples."""
DIMENSION = 256
"""Of a descriptor."""
REFERENCE = 0
"""Side of the network that describes the reference image; moving bands use sides from 1."""


class _FirstLayer(nn.Module):
    """Conv - Tanh - MaxPool, computed as Conv - MaxPool - Tanh.

    Both orders are equal because tanh is increasing; this one computes a quarter of the tanh.

    `half_rectified` replaces tanh by |tanh| = tanh(|x|) in the second half of the channels. The responses to an edge
    then do not depend on its sign, which is reversed, for example, between visible and near-infrared bands of plants.
    """

    def __init__(self, channels: int, half_rectified: bool) -> None:
        super().__init__()
        self.convolution = nn.Conv2d(channels, 32, 5)
        self.half_rectified = half_rectified

    def forward(self, x: Tensor) -> Tensor:
        """Compute the responses of the layer, (N, C, 16, 16) -> (N, 32, 6, 6)."""
        x = self.convolution(x.contiguous(memory_format=torch.channels_last))
        if self.half_rectified:
            # In place: copying this tensor, the largest, takes longer than the convolution.
            x[:, x.shape[1] // 2 :].abs_()
        return nn.functional.max_pool2d(x, 2).tanh_()


def distance(f: Tensor, f_prime: Tensor) -> Tensor:
    """Return ||f(x) - f(x')||_2 row by row (paper, Eq. 3), (N, D) x (N, D) -> (N,). The gradient at 0 is 0."""
    return (f - f_prime).square().sum(dim=1).clamp_min(1e-12).sqrt()


def retrieval(f: Tensor, f_prime: Tensor, allowed: Tensor) -> float:
    """Return the share of rows i of `f` (N, D) with row i of `f_prime` (N, D) as nearest neighbour.

    It is averaged over both directions. Pairs that are False in `allowed` (N, N) are ignored; its diagonal is True.
    Chance is about 1 / N.
    """
    d = torch.cdist(f, f_prime).masked_fill(~allowed, float("inf"))
    target = torch.arange(len(f), device=f.device)
    hits = (d.argmin(dim=1) == target).float().mean() + (d.argmin(dim=0) == target).float().mean()
    return float(0.5 * hits)


class Descriptor(nn.Module):
    """One network per side: side 0 for the reference, one for each moving band.

    The sides share all weights (siamese), all but the first layer (pseudo-siamese) or none (unshared). `channels` is
    the number of channels of each side. `unit_length` normalises the descriptors, as the in-batch loss requires and
    the paper's loss does not. Raises ConfigurationError for a siamese network with different numbers of channels.
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
        self.unit_length = unit_length
        first_channels = channels if sharing != "siamese" else channels[:1]
        self.first = nn.ModuleList(_FirstLayer(c, half_rectified) for c in first_channels)
        self.trunk = nn.ModuleList(
            nn.Sequential(nn.Conv2d(32, 64, 3), nn.Tanh(), nn.Flatten(), nn.Linear(64 * 4 * 4, DIMENSION))
            for _ in (channels if sharing == "unshared" else channels[:1])
        )
        # The NHWC layout makes the small convolutions nearly twice as fast on a CPU.
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, patches: Tensor, side: int) -> Tensor:
        """Describe patches, (N, C, 16, 16) -> (N, 256)."""
        return self.describe([patches], [side])[0]

    def describe(self, patches: Sequence[Tensor], sides: Sequence[int]) -> list[Tensor]:
        """Describe patches (N, C, rows, columns) of each side in one batch; returns what `forward` returns for each."""
        responses = [self.first[min(side, len(self.first) - 1)](x) for x, side in zip(patches, sides, strict=True)]
        if len(self.trunk) == 1:
            joined: Tensor = self.trunk[0](torch.cat(responses))
            result = list(torch.split(joined, [len(x) for x in patches]))
        else:
            result = [self.trunk[side](x) for x, side in zip(responses, sides, strict=True)]
        return [nn.functional.normalize(f, dim=1) for f in result] if self.unit_length else result


def start_from(net: Descriptor, weights: Mapping[str, Tensor], sides: Sequence[int] | None = None) -> None:
    """Initialise a network with the weights (state_dict) of another.

    Side i takes the weights of side `sides[i]` of the other network, by default i, or of its last side if it has
    fewer. If the numbers of channels differ, the first layer's weights are summed over the channels and divided
    equally, so that an image of equal channels has the same descriptors in both networks.
    """
    state = net.state_dict()
    for name, value in state.items():
        group, side, rest = name.split(".", 2)
        source = int(side) if sides is None else sides[int(side)]
        last = max(int(other.split(".")[1]) for other in weights if other.startswith(f"{group}."))
        weight = weights[f"{group}.{min(source, last)}.{rest}"]
        if weight.shape != value.shape:
            weight = weight.sum(dim=1, keepdim=True).expand_as(value) / value.shape[1]
        state[name] = weight
    net.load_state_dict(state)


def start_from_starter(net: Descriptor) -> None:
    """Initialise a network with the weights in the package: those of a siamese network of recipe fast, learned by the
    same method on synthetic flights (tools/learn_starter.py).
    """
    start_from(net, _weights())


@cache
def _weights() -> dict[str, Tensor]:
    result: dict[str, Tensor] = load(resources.files("agalign.method").joinpath("starter.safetensors").read_bytes())
    return {name: value.to(torch.float32) for name, value in result.items()}
