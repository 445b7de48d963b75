"""Learn the initial network of recipe fast on synthetic flights and write agalign/method/starter.safetensors.

    python tools/learn_starter.py [scenes, by default 40]

One siamese network is learned with in-batch negatives, without labels, on one capture of each of many synthetic fields.
It takes about a quarter of an hour on one core; equal numbers of scenes give equal networks. Compare the errors of
benchmarks/accuracy.py before and after.
"""

import sys
import tempfile
from pathlib import Path

import torch
from safetensors.torch import save_file

import agalign
from agalign.cameras.discover import discover
from agalign.capture.band_pair import read_pairs
from agalign.capture.seeding import find_seed, image_groups
from agalign.config import JointSettings, SeedSettings
from agalign.method.fast import Schedule, learn
from agalign.method.state import ImageGroup, JointState
from agalign.synthetic.flight import make_flight
from agalign.values.alignment import Seed
from agalign.values.capture import Capture

SCHEDULE = ((2e-3, 100), (5e-4, 50))
"""Learning rates, and the steps per scene at each."""


def read_group(capture: Capture) -> ImageGroup:
    """Read the images of a synthetic capture, which all have the same reference, with their seeds."""
    pairs, _ = read_pairs(capture, SeedSettings())
    seeds = {p.name: seed for p in pairs if isinstance(seed := find_seed(p, SeedSettings()), Seed)}
    (group,) = image_groups(pairs, seeds)
    return group


def main() -> None:
    scenes = int(sys.argv[1]) if len(sys.argv) > 1 else 40
    torch.set_num_threads(1)
    net = None
    with tempfile.TemporaryDirectory() as temporary:
        captures = []
        for number in range(scenes):
            folder = Path(temporary) / str(number)
            make_flight(folder, 1, rng_seed=1000 + number)
            captures += discover(folder).captures
        groups = [read_group(c) for c in captures]
    for rate, steps in SCHEDULE:
        # A retrieval of 1 is never exceeded, so that no level ends before `max_steps`.
        schedule = Schedule(learning_rate=rate, max_steps=steps, enough_retrieval=1.0)
        settings = JointSettings(recipe="scratch", sharing="siamese")
        state = JointState(settings, lambda _, share, rate=rate: print(f"rate {rate:g}: {share:.0%}", flush=True))
        if net is None:
            net = state.fast_descriptor([1] * (1 + len(groups[0].moving)))
        learn(state, groups, net, schedule=schedule)
    weights = {name: value.detach().half().contiguous() for name, value in net.cpu().state_dict().items()}
    save_file(weights, Path(agalign.__file__).parent / "method" / "starter.safetensors")


if __name__ == "__main__":
    main()
