"""The network that recipe fast starts from: learnt by the same method on synthetic flights (tools/learn_starter.py).

It is one siamese network. A pseudo-siamese one takes its first layer on every side and goes on from there.
"""

from functools import cache
from importlib import resources
from pathlib import Path

import torch
from safetensors.torch import load, save_file
from torch import Tensor

from agalign.descriptor import Descriptor

_FILE = "starter.safetensors"


def start_from_starter(net: Descriptor) -> None:
    """Give a network the starter's weights. The first layer's are shared out among the channels of a side."""
    state = net.state_dict()
    for name, value in state.items():
        group, _side, rest = name.split(".", 2)
        given = _weights()[f"{group}.0.{rest}"]
        channels = value.shape[1] // given.shape[1] if value.ndim == 4 else 1
        state[name] = given.repeat(1, channels, 1, 1) / channels if channels > 1 else given
    net.load_state_dict(state)
    net.learnt = True


def save_starter(net: Descriptor, path: Path) -> None:
    """Write a siamese network in half precision."""
    save_file({name: value.detach().cpu().half().contiguous() for name, value in net.state_dict().items()}, path)


@cache
def _weights() -> dict[str, Tensor]:
    found: dict[str, Tensor] = load(resources.files("agalign").joinpath(_FILE).read_bytes())
    return {name: value.to(torch.float32) for name, value in found.items()}
