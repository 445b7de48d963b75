import pytest
import torch
from torch import nn

from agalign.descriptor import Descriptor

PATCHES = torch.randn(12, 1, 16, 16, generator=torch.Generator().manual_seed(0))


def parameters_of(net: Descriptor) -> dict[str, set[int]]:
    sides = {"fixed": (net.fixed_first, net.fixed_trunk), "moving": (net.moving_first, net.moving_trunk)}
    return {side: {id(p) for m in modules for p in m.parameters()} for side, modules in sides.items()}


@pytest.mark.parametrize(("sharing", "shared"), [("siamese", 6), ("pseudo-siamese", 4), ("unshared", 0)])
def test_what_is_shared(sharing: str, shared: int) -> None:
    ids = parameters_of(Descriptor(sharing))
    assert len(ids["fixed"]) == len(ids["moving"]) == 6
    assert len(ids["fixed"] & ids["moving"]) == shared


def test_the_paper_network_is_conv_tanh_pool_conv_tanh_fc() -> None:
    net = Descriptor("siamese")
    trunk = net.fixed_trunk
    plain = nn.Sequential(net.fixed_first.convolution, nn.Tanh(), nn.MaxPool2d(2), *trunk)
    torch.testing.assert_close(net(PATCHES, "fixed"), plain(PATCHES), atol=1e-5, rtol=1e-5)
    assert [tuple(p.shape) for p in net.parameters()] == [
        (32, 1, 5, 5), (32,), (64, 32, 3, 3), (64,), (256, 1024), (256,),
    ]  # fmt: skip


def test_half_rectified_layer_is_half_blind_to_contrast_reversal() -> None:
    net = Descriptor(half_rectified=True)
    nn.init.zeros_(net.fixed_first.convolution.bias)
    one, other = net.fixed_first(PATCHES), net.fixed_first(-PATCHES)
    torch.testing.assert_close(one[:, 16:], other[:, 16:])
    assert not torch.allclose(one[:, :16], other[:, :16])


def test_unit_length() -> None:
    lengths = Descriptor(unit_length=True)(PATCHES, "moving").norm(dim=1)
    torch.testing.assert_close(lengths, torch.ones(12))


def test_channels_may_differ_between_the_sides() -> None:
    net = Descriptor("pseudo-siamese", fixed_channels=3, moving_channels=1)
    assert net(torch.randn(2, 3, 16, 16), "fixed").shape == net(torch.randn(2, 1, 16, 16), "moving").shape == (2, 256)
