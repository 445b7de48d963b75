"""The descriptor network, its losses, its optimiser and the weights that it starts from."""

from typing import get_args

import numpy as np
import pytest
import torch
from torch import nn

from agalign.config import JointSettings
from agalign.errors import ConfigurationError
from agalign.method.descriptor import REFERENCE, Descriptor, distance, retrieval, start_from, start_from_starter
from agalign.method.fast import Adam, in_batch_loss
from agalign.method.paper import contrastive_loss
from agalign.method.state import JointState
from agalign.values.choices import Recipe, Sharing

G = torch.Generator().manual_seed(0)
PATCHES = torch.randn(12, 1, 16, 16, generator=G)


def touched(net: Descriptor, side: int) -> set[int]:
    """Return the parameters with a gradient of a side's descriptor."""
    net.zero_grad()
    net(PATCHES, side).sum().backward()
    return {id(p) for p in net.parameters() if p.grad is not None and bool((p.grad != 0).any())}


@pytest.mark.parametrize(("sharing", "shared"), [("siamese", 6), ("pseudo-siamese", 4), ("unshared", 0)])
def test_sides_share_weights_by_the_kind_of_sharing(sharing: str, shared: int) -> None:
    net = Descriptor(sharing)
    fixed, moving = touched(net, 0), touched(net, 1)
    assert (len(fixed), len(moving), len(fixed & moving)) == (6, 6, shared)


def test_the_paper_network_is_conv_tanh_pool_conv_tanh_fc() -> None:
    net = Descriptor("siamese")
    plain = nn.Sequential(net.first[0].convolution, nn.Tanh(), nn.MaxPool2d(2), *net.trunk[0])
    torch.testing.assert_close(net(PATCHES, 0), plain(PATCHES), atol=1e-5, rtol=1e-5)
    shapes = [(32, 1, 5, 5), (32,), (64, 32, 3, 3), (64,), (256, 1024), (256,)]
    assert [tuple(p.shape) for p in net.parameters()] == shapes


def test_channels_may_differ_between_the_sides() -> None:
    net = Descriptor("pseudo-siamese", (3, 1))
    assert net(torch.randn(2, 3, 16, 16), 0).shape == net(torch.randn(2, 1, 16, 16), 1).shape == (2, 256)
    with pytest.raises(ConfigurationError, match="pseudo-siamese"):
        Descriptor("siamese", (3, 1))


@pytest.mark.parametrize("sharing", get_args(Sharing))
def test_describing_several_sides_equals_describing_each_side(sharing: Sharing) -> None:
    net = Descriptor(sharing, (1, 1, 1), unit_length=True)
    together = net.describe([PATCHES, PATCHES[:5], PATCHES[3:]], [0, 1, 2])
    for result, (patches, side) in zip(together, ((PATCHES, 0), (PATCHES[:5], 1), (PATCHES[3:], 2)), strict=True):
        torch.testing.assert_close(result, net(patches, side), atol=1e-6, rtol=1e-5)


# ---- starter


def described(recipe: Recipe, side: int, sharing: Sharing = "pseudo-siamese", rng_seed: int = 0) -> torch.Tensor:
    settings = JointSettings(recipe=recipe, sharing=sharing, rng_seed=rng_seed, device="cpu")
    return JointState(settings, lambda *_: None).fast_descriptor([1, 1, 1])(PATCHES, side)


@pytest.mark.parametrize("recipe", ["fast", "scratch"])
@pytest.mark.parametrize("sharing", get_args(Sharing))
def test_every_side_starts_with_equal_weights(recipe: Recipe, sharing: Sharing) -> None:
    torch.testing.assert_close(described(recipe, REFERENCE, sharing).norm(dim=1), torch.ones(12))
    for side in (1, 2):
        torch.testing.assert_close(described(recipe, REFERENCE, sharing), described(recipe, side, sharing))


def test_only_recipe_scratch_starts_from_random_weights() -> None:
    of_fast, of_scratch = ([described(recipe, 1, rng_seed=k) for k in (0, 1)] for recipe in ("fast", "scratch"))
    torch.testing.assert_close(*of_fast)
    assert (of_scratch[0] - of_scratch[1]).abs().max() > 0.1


def test_three_equal_channels_have_the_descriptor_of_one() -> None:
    net = Descriptor("pseudo-siamese", (3, 1), half_rectified=True, unit_length=True)
    start_from_starter(net)
    torch.testing.assert_close(net(PATCHES.repeat(1, 3, 1, 1), REFERENCE), net(PATCHES, 1))


def test_a_descriptor_starts_from_the_chosen_branches() -> None:
    learnt = Descriptor("unshared", [1, 1, 1], half_rectified=True, unit_length=True)
    two = Descriptor("unshared", [1, 1], half_rectified=True, unit_length=True)
    start_from(two, learnt.state_dict(), (REFERENCE, 2))
    with torch.no_grad():
        torch.testing.assert_close(two(PATCHES, REFERENCE), learnt(PATCHES, REFERENCE))
        torch.testing.assert_close(two(PATCHES, 1), learnt(PATCHES, 2))
        assert (two(PATCHES, 1) - learnt(PATCHES, 1)).abs().max() > 1e-3


# ---- losses

F = torch.randn(30, 8, generator=G, dtype=torch.float64)
F_PRIME = F + 0.3 * torch.randn(30, 8, generator=G, dtype=torch.float64)
ALL, NONE = torch.ones(30, 30, dtype=torch.bool), torch.eye(30, dtype=torch.bool)
"""The pairs that may be negatives of each other, and the diagonal."""


def test_distance_and_its_gradient_at_zero() -> None:
    np.testing.assert_allclose(distance(F, F_PRIME), np.linalg.norm(F - F_PRIME, axis=1), atol=1e-9)
    x = F.clone().requires_grad_()
    distance(x, F).sum().backward()
    assert torch.isfinite(x.grad).all()


def test_contrastive_loss_is_the_sum_in_the_paper() -> None:
    positive, negative = torch.tensor([0.2, 0.5]), torch.tensor([0.4, 1.7])
    assert float(contrastive_loss(positive, negative)) == pytest.approx(0.7 + 0.6)


def test_in_batch_is_symmetric_cross_entropy_without_the_excluded_negatives() -> None:
    f, f_prime = (nn.functional.normalize(x, dim=1) for x in (F, F_PRIME))
    logits = (f @ f_prime.T / 0.07).numpy()
    forward, backward = (np.log(np.exp(logits).sum(axis=axis)) - np.diag(logits) for axis in (1, 0))
    assert float(in_batch_loss(f, f_prime, ALL)) == pytest.approx((forward.mean() + backward.mean()) / 2)
    assert float(in_batch_loss(f, f, NONE)) == pytest.approx(0.0)


def test_retrieval_counts_exact_nearest_neighbours() -> None:
    swapped, unrelated = F.clone(), torch.randn(30, 8, generator=G, dtype=torch.float64)
    swapped[[0, 1]] = swapped[[1, 0]]
    assert retrieval(F, F, ALL) == retrieval(F, F.flip(0), NONE) == 1.0
    assert retrieval(F, swapped, ALL) == pytest.approx(28 / 30)
    assert retrieval(F, unrelated, ALL) < 0.3


def test_every_step_of_adam_equals_that_of_torch() -> None:
    ours, theirs = (nn.ModuleList([nn.Linear(5, 3), nn.Linear(5, 3)]) for _ in range(2))
    theirs.load_state_dict(ours.state_dict())
    actual, reference = Adam(ours.parameters(), 0.01), torch.optim.Adam(theirs.parameters(), 0.01)
    for step in range(20):
        which = step % 2  # the other half has no gradient and must stay
        x = torch.randn(8, 5)
        actual.step(ours[which](x).square().mean())
        reference.zero_grad()
        theirs[which](x).square().mean().backward()
        reference.step()
        for a, b in zip(ours.parameters(), theirs.parameters(), strict=True):
            torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-7)
