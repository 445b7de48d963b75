"""The network that recipe fast starts from: learnt by the same method on synthetic flights (tools/learn_starter.py).

It is one siamese network. A pseudo-siamese one takes its first layer on every side and is trained further.
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
    """Give a network the weights of another, as its state_dict has them.

    `sides` maps each side to the side of the other that it takes; by default the one with its number. Where the other
    has fewer, its last one is used. A first layer of other channels takes them together: what describes a grey image
    then describes three equal ones.
    """
    state = net.state_dict()
    for name, value in state.items():
        group, side, rest = name.split(".", 2)
        wanted = int(side) if sides is None else sides[int(side)]
        last = max(int(other.split(".")[1]) for other in weights if other.startswith(f"{group}."))
        given = weights[f"{group}.{min(wanted, last)}.{rest}"]
        if given.shape != value.shape:
            given = given.sum(dim=1, keepdim=True).expand_as(value) / value.shape[1]
        state[name] = given
    net.load_state_dict(state)
    net.learnt = True


def start_from_starter(net: Descriptor) -> None:
    """Give a network the weights that come with the package."""
    start_from(net, _weights())


def save_starter(net: Descriptor, path: Path) -> None:
    """Write a siamese network in half precision."""
    save_file({name: value.detach().cpu().half().contiguous() for name, value in net.state_dict().items()}, path)


@cache
def _weights() -> dict[str, Tensor]:
    result: dict[str, Tensor] = load(resources.files("agalign.method").joinpath(_FILE).read_bytes())
    return {name: value.to(torch.float32) for name, value in result.items()}
