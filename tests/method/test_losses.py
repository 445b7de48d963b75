import numpy as np
import pytest
import torch

from agalign.method.descriptor import distance, retrieval
from agalign.method.fast import in_batch_loss
from agalign.method.paper import contrastive_loss

g = torch.Generator().manual_seed(0)
F = torch.randn(30, 8, generator=g, dtype=torch.float64)
F_PRIME = F + 0.3 * torch.randn(30, 8, generator=g, dtype=torch.float64)
ALL = torch.ones(30, 30, dtype=torch.bool)


def test_distance_and_its_gradient_at_zero() -> None:
    np.testing.assert_allclose(distance(F, F_PRIME), np.linalg.norm(F - F_PRIME, axis=1), atol=1e-9)
    x = F.clone().requires_grad_()
    distance(x, F).sum().backward()
    assert torch.isfinite(x.grad).all()


def test_contrastive_loss_is_the_sum_in_the_paper() -> None:
    positive, negative = torch.tensor([0.2, 0.5]), torch.tensor([0.4, 1.7])
    assert float(contrastive_loss(positive, negative)) == pytest.approx(0.7 + 0.6)


def test_in_batch_is_symmetric_cross_entropy() -> None:
    f = torch.nn.functional.normalize(F, dim=1)
    f_prime = torch.nn.functional.normalize(F_PRIME, dim=1)
    logits = (f @ f_prime.T / 0.07).numpy()
    forward = np.log(np.exp(logits).sum(axis=1)) - np.diag(logits)
    backward = np.log(np.exp(logits).sum(axis=0)) - np.diag(logits)
    assert float(in_batch_loss(f, f_prime, ALL)) == pytest.approx((forward.mean() + backward.mean()) / 2)


def test_excluded_negatives_are_ignored() -> None:
    none = torch.eye(30, dtype=torch.bool) & False
    f = torch.nn.functional.normalize(F, dim=1)
    assert float(in_batch_loss(f, f, none)) == pytest.approx(0.0)
    assert retrieval(F, F.flip(0), none) == 1.0


def test_retrieval_counts_exact_nearest_neighbours() -> None:
    assert retrieval(F, F, ALL) == 1.0
    swapped = F.clone()
    swapped[[0, 1]] = swapped[[1, 0]]
    assert retrieval(F, swapped, ALL) == pytest.approx(28 / 30)
    unrelated = torch.randn(30, 8, generator=g, dtype=torch.float64)
    assert retrieval(F, unrelated, ALL) < 0.3
