from typing import get_args

import pytest
import torch

from agalign.config import JointSettings
from agalign.method.descriptor import REFERENCE, Descriptor
from agalign.method.starter import start_from, start_from_starter
from agalign.method.state import JointState, ThetaStart
from agalign.values.choices import Sharing

PATCHES = torch.randn(8, 1, 16, 16, generator=torch.Generator().manual_seed(1))


def started(sharing: Sharing, channels: tuple[int, ...]) -> Descriptor:
    net = Descriptor(sharing, channels, half_rectified=True, unit_length=True)
    start_from_starter(net)
    return net


@pytest.mark.parametrize("sharing", get_args(Sharing))
def test_every_side_starts_with_equal_weights(sharing: Sharing) -> None:
    net = started(sharing, (1, 1, 1))
    here, there, elsewhere = (net(PATCHES, side) for side in range(3))
    torch.testing.assert_close(here, there)
    torch.testing.assert_close(here, elsewhere)
    assert net.is_trained


def test_three_equal_channels_have_the_descriptor_of_one() -> None:
    net = started("pseudo-siamese", (3, 1))
    torch.testing.assert_close(net(PATCHES.repeat(1, 3, 1, 1), REFERENCE), net(PATCHES, 1))


def test_patches_are_distinguished_despite_reversed_contrast() -> None:
    net = started("siamese", (1,))
    f, reversed_f = net(PATCHES, REFERENCE), net(-PATCHES, REFERENCE)
    d = torch.cdist(f, f) + 10 * torch.eye(len(f))
    assert (f - reversed_f).norm(dim=1).median() < d.min(dim=1).values.median()


def test_recipe_fast_starts_from_the_starter_by_default() -> None:
    def first(*start: ThetaStart) -> torch.Tensor:
        state = JointState(JointSettings(device="cpu"), lambda *_: None)
        return state.fast_descriptor([1, 1], *start)(PATCHES, 1)

    torch.testing.assert_close(first(), started("pseudo-siamese", (1, 1))(PATCHES, 1))
    assert (first() - first("random")).abs().max() > 0.1


def test_each_side_takes_the_chosen_side() -> None:
    learnt = Descriptor("unshared", [1, 1, 1], half_rectified=True, unit_length=True)
    two = Descriptor("unshared", [1, 1], half_rectified=True, unit_length=True)
    start_from(two, learnt.state_dict(), (REFERENCE, 2))
    patches = torch.randn(8, 1, 16, 16, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        torch.testing.assert_close(two(patches, REFERENCE), learnt(patches, REFERENCE))
        torch.testing.assert_close(two(patches, 1), learnt(patches, 2))
        assert (two(patches, 1) - learnt(patches, 1)).abs().max() > 1e-3
