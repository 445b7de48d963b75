import pytest
import torch
from torch import nn

from agalign.errors import ConfigurationError
from agalign.method.descriptor import Descriptor

PATCHES = torch.randn(12, 1, 16, 16, generator=torch.Generator().manual_seed(0))


def parameters_of(net: Descriptor) -> dict[str, set[int]]:
    """Return the parameters with a gradient of a side's descriptor."""
    result = {}
    for name, side in (("fixed", 0), ("moving", 1)):
        net.zero_grad()
        net(PATCHES, side).sum().backward()
        result[name] = {id(p) for p in net.parameters() if p.grad is not None and bool((p.grad != 0).any())}
    return result


@pytest.mark.parametrize(("sharing", "shared"), [("siamese", 6), ("pseudo-siamese", 4), ("unshared", 0)])
def test_sides_share_weights_by_the_kind_of_sharing(sharing: str, shared: int) -> None:
    ids = parameters_of(Descriptor(sharing))
    assert len(ids["fixed"]) == len(ids["moving"]) == 6
    assert len(ids["fixed"] & ids["moving"]) == shared


def test_the_paper_network_is_conv_tanh_pool_conv_tanh_fc() -> None:
    net = Descriptor("siamese")
    plain = nn.Sequential(net.first[0].convolution, nn.Tanh(), nn.MaxPool2d(2), *net.trunk[0])
    torch.testing.assert_close(net(PATCHES, 0), plain(PATCHES), atol=1e-5, rtol=1e-5)
    assert [tuple(p.shape) for p in net.parameters()] == [
        (32, 1, 5, 5), (32,), (64, 32, 3, 3), (64,), (256, 1024), (256,),
    ]  # fmt: skip


def test_half_of_a_half_rectified_layer_ignores_contrast_reversal() -> None:
    net = Descriptor(half_rectified=True)
    nn.init.zeros_(net.first[0].convolution.bias)
    one, other = net.first[0](PATCHES), net.first[0](-PATCHES)
    torch.testing.assert_close(one[:, 16:], other[:, 16:])
    assert not torch.allclose(one[:, :16], other[:, :16])


def test_unit_length() -> None:
    lengths = Descriptor(unit_length=True)(PATCHES, 1).norm(dim=1)
    torch.testing.assert_close(lengths, torch.ones(12))


def test_channels_may_differ_between_the_sides() -> None:
    net = Descriptor("pseudo-siamese", (3, 1))
    assert net(torch.randn(2, 3, 16, 16), 0).shape == net(torch.randn(2, 1, 16, 16), 1).shape == (2, 256)
    with pytest.raises(ConfigurationError, match="pseudo-siamese"):
        Descriptor("siamese", (3, 1))


@pytest.mark.parametrize("sharing", ["siamese", "pseudo-siamese", "unshared"])
def test_describing_several_sides_equals_describing_each_side(sharing: str) -> None:
    net = Descriptor(sharing, (1, 1, 1), unit_length=True)
    together = net.describe([PATCHES, PATCHES[:5], PATCHES[3:]], [0, 1, 2])
    for result, (patches, side) in zip(together, ((PATCHES, 0), (PATCHES[:5], 1), (PATCHES[3:], 2)), strict=True):
        torch.testing.assert_close(result, net(patches, side), atol=1e-6, rtol=1e-5)
