"""Adam (Kingma & Ba 2015, Algorithm 1).

It replaces torch.optim.Adam, which imports torch's compiler: about one second per process.
"""

from collections.abc import Iterable

import torch
from torch import Tensor, nn

_BETA_1, _BETA_2, _EPSILON = 0.9, 0.999, 1e-8


class Adam:
    """Optimiser of a network's weights, tensors of any shape."""

    def __init__(self, weights: Iterable[nn.Parameter], learning_rate: float) -> None:
        self.weights = list(weights)
        self.learning_rate = learning_rate
        self._moments = [(torch.zeros_like(w), torch.zeros_like(w)) for w in self.weights]
        self._steps = [0] * len(self.weights)

    @torch.no_grad()
    def step(self, loss: Tensor) -> None:
        """Take one step down the gradient of a scalar loss.

        Weights that the loss does not depend on, and their moments, are unchanged.
        """
        for weight in self.weights:
            weight.grad = None
        torch.autograd.backward(loss)
        for i, (weight, (first, second)) in enumerate(zip(self.weights, self._moments, strict=True)):
            if weight.grad is None:
                continue
            self._steps[i] += 1
            first.lerp_(weight.grad, 1 - _BETA_1)
            second.mul_(_BETA_2).addcmul_(weight.grad, weight.grad, value=1 - _BETA_2)
            denominator = (second / (1 - _BETA_2 ** self._steps[i])).sqrt_().add_(_EPSILON)
            weight.addcdiv_(first, denominator, value=-self.learning_rate / (1 - _BETA_1 ** self._steps[i]))
