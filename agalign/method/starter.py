"""Initial weights of recipe fast, learned by the same method on synthetic flights (tools/learn_starter.py).

They are those of a siamese network. Every side of a pseudo-siamese network starts with its first layer.
"""

from collections.abc import Mapping, Sequence
from functools import cache
from importlib import resources
from pathlib import Path

import torch
from safetensors.torch import load, save_file
from torch import Tensor

from agalign.method.descriptor import Descriptor

_FILE = "starter.safetensors"


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
    net.is_trained = True


def start_from_starter(net: Descriptor) -> None:
    """Initialise a network with the weights in the package."""
    start_from(net, _weights())


def save_starter(net: Descriptor, path: Path) -> None:
    """Write a siamese network in half precision."""
    save_file({name: value.detach().cpu().half().contiguous() for name, value in net.state_dict().items()}, path)


@cache
def _weights() -> dict[str, Tensor]:
    result: dict[str, Tensor] = load(resources.files("agalign.method").joinpath(_FILE).read_bytes())
    return {name: value.to(torch.float32) for name, value in result.items()}
