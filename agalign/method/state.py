"""Inputs of a joint optimisation: the images of a capture, settings, device and random generator."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from agalign.config import JointSettings
from agalign.method.descriptor import Descriptor, start_from, start_from_starter
from agalign.method.device import choose_device
from agalign.values.geometry import Matrix
from agalign.values.image import Raster
from agalign.values.mapping import DisplacementField

Progress = Callable[[str, float], None]
"""Called with the name of a stage and its completed share, 0 to 1."""


@dataclass
class MovingImage:
    """A moving image of a capture, and the state of its alignment."""

    raster: Raster
    fixed_to_moving: Matrix
    """Undistorted px; the optimisation updates it."""
    side: int = 1
    """Side of the network that describes it."""
    trusted: bool = False
    """True for a seed that is likely to be right to a few pixels, for which recipe fast skips the coarse levels."""
    max_shift_px: float = math.inf
    """Maximum shift from the seed in the search at the coarsest level, px of the fixed image."""
    field: DisplacementField | None = None
    """Displacement of positions of the reference before the homography, px of the fixed image."""
    dropped_at: float | None = None
    """Held-out retrieval at a level where the descriptors cannot distinguish the patches. The image is neither trained
    on nor refined further."""
    name: str = ""
    """Name of the band, if several images are aligned together."""


@dataclass(frozen=True)
class ImageGroup:
    """The images of one capture."""

    fixed: Raster
    moving: Sequence[MovingImage]


class JointState:
    """Settings, device and random generator of one optimisation.

    Raises ConfigurationError for a device that cannot be used.
    """

    def __init__(self, settings: JointSettings, progress: Progress) -> None:
        self.settings = settings
        self.progress = progress
        self.device = choose_device(settings.device)
        self.generator = torch.Generator().manual_seed(settings.rng_seed)
        """The only source of randomness apart from the initial weights."""
        self.family = None if settings.model_family == "auto" else settings.model_family

    def fast_descriptor(self, channels: Sequence[int]) -> Descriptor:
        """Create the network of recipe fast with the weights in the package, of recipe scratch with random ones.

        They are equal for all sides. Half of the filters ignore the sign of the contrast, so the responses of equal
        random filters are similar where bands show the same: enough to search the first translation with them.
        """
        net = self.random_descriptor(channels, of_fast=True)
        if self.settings.recipe == "scratch":
            start_from(net, self.random_descriptor([1], of_fast=True).state_dict())
        else:
            start_from_starter(net)
        return net

    def random_descriptor(self, channels: Sequence[int], *, of_fast: bool = False) -> Descriptor:
        """Create the network of recipe paper, or of the other recipes, with weights that depend only on the rng_seed.

        `channels` are the numbers of channels per side, the reference first.
        """
        with torch.random.fork_rng(devices=[]):
            torch.default_generator.manual_seed(self.settings.rng_seed)
            net = Descriptor(self.settings.sharing, channels, half_rectified=of_fast, unit_length=of_fast)
        return net.to(self.device)
