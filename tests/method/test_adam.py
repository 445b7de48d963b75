import torch
from torch import nn

from agalign.method.adam import Adam


def test_every_step_equals_that_of_torch() -> None:
    torch.manual_seed(0)
    ours = nn.ModuleList([nn.Linear(5, 3), nn.Linear(5, 3)])
    theirs = nn.ModuleList([nn.Linear(5, 3), nn.Linear(5, 3)])
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
