"""The losses on descriptors and the retrieval that tells whether they mean anything."""

import torch
from torch import Tensor
from torch.nn import functional


def distance(f: Tensor, f_prime: Tensor) -> Tensor:
    """L0 of the paper: ||f(x) - f(x')||_2 row by row, (N, D) x (N, D) -> (N,). Its gradient at 0 is 0, not nan."""
    return (f - f_prime).square().sum(dim=1).clamp_min(1e-12).sqrt()


def contrastive(positive: Tensor, negative: Tensor, margin: float = 1.0) -> Tensor:
    """The paper's loss (its Eq. 2), a scalar: the sum of L0 over positive and of L1 = max(0, margin - L0) over
    negative pairs. Both arguments are distances, (P,) and (N,).
    """
    return positive.sum() + functional.relu(margin - negative).sum()


def in_batch(f: Tensor, f_prime: Tensor, allowed: Tensor, temperature: float = 0.07) -> Tensor:
    """InfoNCE in both directions with the other rows of the batch as negatives, a scalar.

    `f` and `f_prime` are (N, D) of unit length, row i of one matching row i of the other; `allowed` (N, N) is False
    where two keypoints are too close to count as negatives of each other (its diagonal does not matter).
    van den Oord et al. 2018, Eq. 4, symmetrised.
    """
    logits = f @ f_prime.T / temperature
    keep = allowed | torch.eye(len(f), dtype=torch.bool, device=f.device)
    logits = logits.masked_fill(~keep, float("-inf"))
    target = torch.arange(len(f), device=f.device)
    return 0.5 * (functional.cross_entropy(logits, target) + functional.cross_entropy(logits.T, target))


def retrieval(f: Tensor, f_prime: Tensor, allowed: Tensor) -> float:
    """Share of rows of `f` whose nearest row of `f_prime` is their own, averaged over both directions.

    Pairs that are not `allowed` (N, N) do not compete. Guessing gives about 1 / N.
    """
    d = torch.cdist(f, f_prime)
    keep = allowed | torch.eye(len(f), dtype=torch.bool, device=f.device)
    d = d.masked_fill(~keep, float("inf"))
    target = torch.arange(len(f), device=f.device)
    hits = (d.argmin(dim=1) == target).float().mean() + (d.argmin(dim=0) == target).float().mean()
    return float(0.5 * hits)
