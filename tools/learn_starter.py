"""Learns the network that recipe fast starts from, on synthetic flights, and writes agalign/method/starter.safetensors.

    python tools/learn_starter.py [scenes, by default 40]

The program's own method on its own generator: one siamese network, one capture of each of many fields, in-batch
negatives, no labels. Runs in about a quarter of an hour on one core; the same scenes give the same network.
benchmarks/starter.py compares it with random weights.
"""

import sys
import tempfile
from pathlib import Path

import torch

import agalign
from agalign.batch.learn import read_subject
from agalign.cameras.discover import discover
from agalign.config import JointSettings, Settings
from agalign.method.fast import Schedule, learn
from agalign.method.starter import save_starter
from agalign.method.state import JointState
from agalign.synthetic.flight import make_flight

SCHEDULE = ((2e-3, 100), (5e-4, 50))
"""Learning rates, and the steps a scene at each."""


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
        groups = [read_subject(c, Settings())[0] for c in captures]
    for rate, steps in SCHEDULE:
        # psi may move as always, but nothing is ever learnt well enough to stop.
        schedule = Schedule(learning_rate=rate, max_steps=steps, enough_retrieval=1.0)
        settings = JointSettings(sharing="siamese")
        state = JointState(settings, lambda _, share, rate=rate: print(f"rate {rate:g}: {share:.0%}", flush=True))
        if net is None:
            net = state.fast_descriptor([1] * (1 + len(groups[0].moving)), "random")
        learn(state, groups, net, schedule=schedule)
    save_starter(net, Path(agalign.__file__).parent / "method" / "starter.safetensors")


if __name__ == "__main__":
    main()
